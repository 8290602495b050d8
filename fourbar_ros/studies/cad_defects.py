# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Defects of a CAD model of the paper's links, and their effect in the two tests of Fig. 3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from fourbar_ros.mechanism import assemble, load_mechanism, Mechanism
from fourbar_ros.mechanism.case import Case, simulate
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies.validation import FREQUENCY_HZ, PAPER_TESTS
import numpy as np

RMS = (0.100, 0.102)
"""Differences that the paper reports for tests 1 and 2, taken as degrees."""
TESTS = ('paper_test_1', 'paper_test_2')
TIMES = np.linspace(0.0, 10.0, 101)
# Integration step of the search and of the checks [s].
STEP, FINE_STEP = 0.01, 1e-3
THETA = np.pi / 3.0     # at the start, as in study validation
# Turns and changes below this are not counted as visible [deg].
VISIBLE = 0.01

ALL, A_C, B_D = (1.0, 1.0, 1.0, 1.0), (1.0, 0.0, 1.0, 0.0), (0.0, 1.0, 0.0, 1.0)
A_ALONE, A_B, INSIDE = (1.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), (1.0, -1.0, -1.0, 1.0)


@dataclass(frozen=True)
class Defect:
    """
    One kind of defect.

    :param title: name in tables and figures.
    :param quantity: `length`, `mass`, `inertia`, `wheel`, all relative, or the displacement `x`,
        `y` of the mass centre in the link's frame [m].
    :param links: (4,) share of the size for each link.
    :param largest: largest size considered.
    :param typical: start of the search for two defects at once.
    :param even: whether the sign of the size has no effect.
    """

    title: str
    quantity: str
    links: tuple[float, ...]
    largest: float
    typical: float
    even: bool = False

    @property
    def metres(self) -> bool:
        """Whether the size is a length [m] instead of a ratio."""
        return self.quantity in ('x', 'y')

    def text(self, size: float) -> str:
        """Return a size with its unit."""
        return f'{1e3 * size:.3g} mm' if self.metres else f'{100.0 * size:+.3g} %'


# Largest sizes: half a link for mass centres, half of an inertia, a tenth of a length.
DEFECTS = {
    'offset_y_same': Defect('offset y, same in all frames', 'y', ALL, 0.05, 3e-3, True),
    'offset_x_same': Defect('offset x, same in all frames', 'x', ALL, 0.05, 3e-3, True),
    'offset_y_inside': Defect('offset y, to the inside', 'y', INSIDE, 0.05, 3e-4),
    'offset_y_a': Defect('offset y, link a', 'y', A_ALONE, 0.05, 3e-4),
    'offset_x_a': Defect('offset x, link a', 'x', A_ALONE, 0.05, 3e-4),
    'inertia_all': Defect('inertia, all links', 'inertia', ALL, 0.5, 0.02),
    'inertia_ac': Defect('inertia, links a and c', 'inertia', A_C, 0.5, 0.02),
    'inertia_bd': Defect('inertia, links b and d', 'inertia', B_D, 0.5, 0.02),
    'mass_bd': Defect('mass, links b and d', 'mass', B_D, 0.5, 0.01),
    'wheel_all': Defect('wheel inertia, all', 'wheel', ALL, 0.5, 0.01),
    'wheel_ac': Defect('wheel inertia, a and c', 'wheel', A_C, 0.5, 0.01),
    'length_all': Defect('length, all links', 'length', ALL, 0.1, 0.01),
    'length_ac': Defect('length, links a and c', 'length', A_C, 0.1, 0.01),
    'length_a': Defect('length, link a', 'length', A_ALONE, 0.1, 0.001),
    'length_ab': Defect('length, links a and b', 'length', A_B, 0.1, 0.001)}


NAMED = 'offset_y_same'
"""The single defect whose fit is checked and drawn."""

Sizes = Mapping[str, float]
"""Sizes of defects by name of `DEFECTS`."""


@dataclass(frozen=True)
class Effects:
    """
    Qualitative effects of a defect, which the paper states in words.

    :param resting_turn: largest turn of links b and d in test 1, where they should rest [deg].
    :param swing: relative change of the swing of links a and c in test 1.
    :param configuration: largest change of the configuration in test 2, ideally none [deg].
    """

    resting_turn: float
    swing: float
    configuration: float

    @property
    def as_stated(self) -> tuple[bool, bool, bool]:
        """Whether each is as the paper states: a small turn, a smaller swing, a change."""
        return self.resting_turn >= VISIBLE, self.swing < 0.0, self.configuration >= VISIBLE


@dataclass(frozen=True)
class Fit:
    """
    Defects that reproduce both numbers of the paper.

    :param sizes: of each defect, in its own unit.
    :param amplitude: of the wheels' angle [rad].
    :param residuals: of both numbers [deg].
    :param effects: of these defects.
    """

    sizes: Sizes
    amplitude: float
    residuals: tuple[float, float]
    effects: Effects


@dataclass(frozen=True, eq=False)
class SizeCurve:
    """
    Required size of one kind of defect over the amplitude.

    :param name: of the defect.
    :param sign: of its size.
    :param amplitudes: (n,) of the wheels' angle [rad].
    :param sizes: (n, 2) for the number of test 1, and of test 2; NaN where no size reproduces it.
    :param ratio: (n,) number of test 1 over that of test 2, at the size for test 2.
    :param fits: where both numbers are reproduced.
    """

    name: str
    sign: float
    amplitudes: Array
    sizes: Array
    ratio: Array
    fits: Sequence[Fit]


def defective(sizes: Sizes) -> Mechanism:
    """
    Return the paper's linkage with defects.

    :raises MechanismError: there is no such linkage.
    """
    paper = _paper()
    change = {name: np.zeros(4) for name in ('length', 'mass', 'inertia', 'wheel', 'x', 'y')}
    for name, size in sizes.items():
        change[DEFECTS[name].quantity] += size * np.array(DEFECTS[name].links)
    lengths = paper.link_lengths * (1.0 + change['length'])
    # The nominal mass centre is the middle of the link, whatever its length.
    return Mechanism(
        lengths, paper.link_masses * (1.0 + change['mass']),
        paper.link_inertias * (1.0 + change['inertia']),
        np.column_stack([0.5 * lengths + change['x'], change['y']]),
        paper.flywheel_inertias * (1.0 + change['wheel']))


@lru_cache(maxsize=None)
def _paper() -> Mechanism:
    """Read the preset once; the searches make some ten thousand linkages."""
    return load_mechanism('paper')


def simulate_test(mechanism: Mechanism, test: int, amplitude: float, theta: float = THETA,
                  step: float = STEP) -> Array:
    """
    Simulate a test of the paper from rest.

    :param test: 0 or 1.
    :param amplitude: of the wheels' angle [rad].
    :param theta: angle between links a and b at the start [rad].
    :param step: of the integration [s].
    :returns: link angles (n, 4) at TIMES [rad].
    """
    rest = np.zeros(4)
    return simulate(Case(
        mechanism, assemble(mechanism, 0.0, theta), rest, rest,
        amplitude * np.array(PAPER_TESTS[TESTS[test]]), np.full(4, FREQUENCY_HZ), rest, TIMES,
        np.ones(4, dtype=bool)), step).link_angles


def rms(sizes: Sizes, test: int, amplitude: float, theta: float = THETA, step: float = STEP
        ) -> float:
    """Return the rms difference of nominal and defective linkage over links and time [deg]."""
    difference = (simulate_test(defective(sizes), test, amplitude, theta, step)
                  - _nominal(test, amplitude, theta, step))
    return float(np.degrees(np.sqrt((difference ** 2).mean())))


@lru_cache(maxsize=4096)
def _nominal(test: int, amplitude: float, theta: float, step: float) -> Array:
    return simulate_test(defective({}), test, amplitude, theta, step)


def effects_of(sizes: Sizes, amplitude: float, theta: float = THETA) -> Effects:
    """Evaluate the qualitative effects of defects."""
    mechanism = defective(sizes)
    first, second = (simulate_test(mechanism, test, amplitude, theta) for test in (0, 1))
    swings = [float(np.ptp(angles[:, ::2], axis=0).mean())
              for angles in (first, _nominal(0, amplitude, theta, STEP))]
    configuration = np.diff(second, axis=1)
    return Effects(
        float(np.degrees(np.abs(first[:, 1::2] - first[0, 1::2]).max())),
        swings[0] / swings[1] - 1.0,
        float(np.degrees(np.abs(configuration - configuration[0]).max())))
