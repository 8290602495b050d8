# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What a CAD model may have wrong: kinds of defects of the paper's links, and their sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from fourbar_ros.mechanism import load_mechanism, Mechanism
import numpy as np

ALL, A_C, B_D = (1.0, 1.0, 1.0, 1.0), (1.0, 0.0, 1.0, 0.0), (0.0, 1.0, 0.0, 1.0)
A_ALONE, A_B, INSIDE = (1.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0), (1.0, -1.0, -1.0, 1.0)


@dataclass(frozen=True)
class Defect:
    """
    One kind of defect.

    :param title: for people.
    :param of: `length`, `mass`, `inertia`, `wheel`, all relative, or `x`, `y`, in metres: of the
        mass centre in the link's frame, from where it should be.
    :param links: (4,) share of the size that each link has.
    :param largest: size that is worth considering.
    :param typical: size to begin the search of two at once with.
    :param even: whether the sign of the size changes nothing.
    """

    title: str
    of: str
    links: tuple[float, ...]
    largest: float
    typical: float
    even: bool = False

    @property
    def metres(self) -> bool:
        """Tell whether the size is a length."""
        return self.of in ('x', 'y')

    def said(self, size: float) -> str:
        """Write a size for people."""
        return f'{1e3 * size:.3g} mm' if self.metres else f'{100.0 * size:+.3g} %'


# Half a link for mass centres, half of an inertia, a tenth of a length.
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


def defective(sizes: Mapping[str, float]) -> Mechanism:
    """
    Return the paper's linkage with some defects.

    :param sizes: by name of `DEFECTS`.
    :raises MechanismError: there is no such linkage.
    """
    paper = _paper()
    change = {of: np.zeros(4) for of in ('length', 'mass', 'inertia', 'wheel', 'x', 'y')}
    for name, size in sizes.items():
        change[DEFECTS[name].of] += size * np.array(DEFECTS[name].links)
    lengths = paper.link_lengths * (1.0 + change['length'])
    # A link of another length has its mass centre in its middle all the same.
    return Mechanism(
        lengths, paper.link_masses * (1.0 + change['mass']),
        paper.link_inertias * (1.0 + change['inertia']),
        np.column_stack([0.5 * lengths + change['x'], change['y']]),
        paper.flywheel_inertias * (1.0 + change['wheel']))


@lru_cache(maxsize=None)
def _paper() -> Mechanism:
    """Read the preset once: linkages are made by the ten thousand."""
    return load_mechanism('paper')
