# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Motions of this package compared with those of independent engines, as far as installed.

Torques and the angles of prescribed wheels are cosines of time (`Case`). The way in which an
engine samples them limits its accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from fourbar_ros.common.progress import Progress
from fourbar_ros.mechanism.case import Case, Motion, simulate
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies.independent import installed
import numpy as np

STEP = 1e-3
OURS = 'continuous: at the begin, middle and end of each RK4 step of 1 ms'

MUJOCO_STEPS = {'mujoco_2ms': 2e-3, 'mujoco_1ms': 1e-3}


@dataclass(frozen=True, eq=False)
class ComparedMotion:
    """
    A motion to compare.

    :param name: its name in tables.
    :param case: the simulated case.
    :param reference: (n, 4) known link angles [rad], or None.
    """

    name: str
    case: Case
    reference: Array | None = None


@dataclass(frozen=True)
class IndependentEngine:
    """
    An independent implementation of the dynamics.

    :param sampling: how it samples the torques.
    :param simulate: maps a motion to its link angles (n, 4) [rad]; None if not applicable.
    """

    sampling: str
    simulate: Callable[[ComparedMotion], Array | None]


@dataclass(frozen=True, eq=False)
class EngineComparison:
    """A motion as simulated here, and link angles (n, 4) by name of the other engines [rad]."""

    motion: ComparedMotion
    ours: Motion
    others: dict[str, Array]

    def differences(self, engine: str) -> Array:
        """Return our link angles minus those of an engine (n, 4) [rad]."""
        return self.ours.link_angles - self.others[engine]

    def largest(self, engine: str) -> float:
        """Return the largest difference of any link at any time [rad]."""
        return float(np.abs(self.differences(engine)).max())

    def rms(self, engine: str) -> float:
        """Return the root mean square difference over links and times [rad]."""
        return float(np.sqrt(np.mean(self.differences(engine)**2)))


def compare(motions: Sequence[ComparedMotion], progress: Progress
            ) -> tuple[list[EngineComparison], dict[str, str], list[str]]:
    """
    Simulate all motions with all engines.

    :returns: a comparison for each motion, the sampling of the torques by engine, and one line for
        each engine that is missing.
    """
    engines, skipped = available_engines()
    jobs = [(motion, name) for motion in motions for name in ('ours', *engines)]
    ours: dict[str, Motion] = {}
    others: dict[str, dict[str, Array]] = {motion.name: {} for motion in motions}
    for motion, name in progress(jobs, len(jobs)):
        if name == 'ours':
            ours[motion.name] = simulate(motion.case, STEP)
        elif (angles := engines[name].simulate(motion)) is not None:
            others[motion.name][name] = angles

    sampling = {name: engine.sampling for name, engine in engines.items()}
    if set(MUJOCO_STEPS) <= set(sampling):
        sampling['mujoco_extrapolated'] = (
            'from these two to a step of zero, by what is of second order in it')
        for angles_of in others.values():
            angles_of['mujoco_extrapolated'] = (
                4.0 * angles_of['mujoco_1ms'] - angles_of['mujoco_2ms']) / 3.0
    return ([EngineComparison(motion, ours[motion.name], others[motion.name])
             for motion in motions], sampling, skipped)


def available_engines() -> tuple[dict[str, IndependentEngine], list[str]]:
    """Return the installed engines by name, and one line for each missing one."""
    engines = {'reference': IndependentEngine('continuous, model in maximal coordinates',
                                              lambda motion: motion.reference)}
    skipped = []
    if installed('sympy'):
        engines['kane'] = IndependentEngine('continuous, DOP853 to 1e-12', _kane)
    else:
        skipped.append('no comparison with the Kane derivation: sympy is missing')
    if installed('mujoco'):
        for name, step in MUJOCO_STEPS.items():
            engines[name] = IndependentEngine(
                f'held over each RK4 step of {1e3 * step:g} ms at its value in the middle',
                partial(_mujoco, step=step))
    else:
        skipped.append('no comparison with MuJoCo: mujoco is missing')
    return engines, skipped


def _kane(motion: ComparedMotion) -> Array:
    from fourbar_ros.studies.independent import kane
    return kane.simulate(motion.case).link_angles


def _mujoco(motion: ComparedMotion, step: float) -> Array:
    """
    Simulate a motion in MuJoCo with a stiff closure and torques held over each step.

    A prescribed wheel is locked to its link and adds its inertia to it; the link is driven by
    `-If d2(psi)/dt2`.
    """
    from fourbar_ros.studies.independent.mujoco_model import MujocoLinkage, State, stiff
    case = motion.case
    turn = 2.0 * np.pi * case.frequency_hz
    scale = case.amplitude * np.where(
        case.prescribed, -case.mechanism.flywheel_inertias * turn**2, 1.0)
    start = State(case.link_angles, case.link_rates, np.zeros(4), case.flywheel_speeds_absolute,
                  np.zeros(2), np.zeros(2))
    linkage = MujocoLinkage(case.mechanism, stiff('RK4', step), case.prescribed.tolist())
    return linkage.move(start, case.times, lambda t: scale * np.cos(turn * t + case.phase),
                        sampled=0.5).link_angles
