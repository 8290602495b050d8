# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Motions of ours beside those of independent engines, as far as these are installed.

Torques and the angles of prescribed wheels are cosines of time (`Case`). How an engine samples
them differs, and decides how close it can come.
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
class Trial:
    """
    One motion to compare.

    :param name: what it is called in tables.
    :param case: what to simulate.
    :param reference: (n, 4) link angles known beforehand [rad], or None.
    """

    name: str
    case: Case
    reference: Array | None = None


@dataclass(frozen=True)
class Engine:
    """
    Somebody else's way to the same motion.

    :param torque: how it samples the torques.
    :param follow: a trial to its link angles (n, 4) [rad]; None if it does not do this one.
    """

    torque: str
    follow: Callable[[Trial], Array | None]


@dataclass(frozen=True, eq=False)
class Comparison:
    """A trial, our motion, and the link angles (n, 4) of others by engine [rad]."""

    trial: Trial
    ours: Motion
    others: dict[str, Array]

    def differences(self, engine: str) -> Array:
        """Return ours minus theirs (n, 4) [rad]."""
        return self.ours.link_angles - self.others[engine]

    def largest(self, engine: str) -> float:
        """Return the largest difference of any link at any time [rad]."""
        return float(np.abs(self.differences(engine)).max())

    def rms(self, engine: str) -> float:
        """Return the root mean square difference over links and times [rad]."""
        return float(np.sqrt(np.mean(self.differences(engine)**2)))


def compare(trials: Sequence[Trial], progress: Progress
            ) -> tuple[list[Comparison], dict[str, str], list[str]]:
    """
    Follow all trials with all engines.

    :returns: a comparison for each trial, how each engine samples the torques, and in a line
        each what was left out.
    """
    others, skipped = engines()
    jobs = [(trial, name) for trial in trials for name in ('ours', *others)]
    ours: dict[str, Motion] = {}
    followed: dict[str, dict[str, Array]] = {trial.name: {} for trial in trials}
    for trial, name in progress(jobs, len(jobs)):
        if name == 'ours':
            ours[trial.name] = simulate(trial.case, STEP)
        elif (angles := others[name].follow(trial)) is not None:
            followed[trial.name][name] = angles

    rules = {name: engine.torque for name, engine in others.items()}
    if set(MUJOCO_STEPS) <= set(rules):
        rules['mujoco_extrapolated'] = (
            'from these two to a step of zero, by what is of second order in it')
        for angles_of in followed.values():
            angles_of['mujoco_extrapolated'] = (
                4.0 * angles_of['mujoco_1ms'] - angles_of['mujoco_2ms']) / 3.0
    comparisons = [Comparison(trial, ours[trial.name], followed[trial.name]) for trial in trials]
    return comparisons, rules, skipped


def engines() -> tuple[dict[str, Engine], list[str]]:
    """Return the engines that can run here, by name, and which cannot and why."""
    found = {'reference': Engine('continuous, model in maximal coordinates',
                                 lambda trial: trial.reference)}
    skipped = []
    if installed('sympy'):
        found['kane'] = Engine('continuous, DOP853 to 1e-12', _kane)
    else:
        skipped.append('no comparison with the Kane derivation: sympy is missing')
    if installed('mujoco'):
        for name, step in MUJOCO_STEPS.items():
            found[name] = Engine(
                f'held over each RK4 step of {1e3 * step:g} ms at its value in the middle',
                partial(_mujoco, step=step))
    else:
        skipped.append('no comparison with MuJoCo: mujoco is missing')
    return found, skipped


def _kane(trial: Trial) -> Array:
    from fourbar_ros.studies.independent import kane
    return kane.simulate(trial.case).link_angles


def _mujoco(trial: Trial, step: float) -> Array:
    """
    Follow a trial in MuJoCo with its closure stiff and the torques held over each step.

    A prescribed wheel is locked to its link, its inertia added to it, and the link feels
    `-If d2(psi)/dt2`.
    """
    from fourbar_ros.studies.independent.mujoco_model import MujocoLinkage, State, stiff
    case = trial.case
    turn = 2.0 * np.pi * case.frequency_hz
    scale = case.amplitude * np.where(
        case.prescribed, -case.mechanism.flywheel_inertias * turn**2, 1.0)
    start = State(case.link_angles, case.link_rates, np.zeros(4), case.flywheel_speeds_absolute,
                  np.zeros(2), np.zeros(2))
    linkage = MujocoLinkage(case.mechanism, stiff('RK4', step), case.prescribed.tolist())
    return linkage.move(start, case.times, lambda t: scale * np.cos(turn * t + case.phase),
                        sampled=0.5).link_angles
