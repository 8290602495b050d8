# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulated motion of the links under the measured motion of their wheels.

The wheels' angles relative to the links are what the links are driven by, so neither torques nor
the friction of the bearings enter, only the axial inertias. The recording is divided into windows
with initial states of their own; all windows and all changes of parameters run side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.quantity import CalibrationError
from fourbar_ros.analysis.calibration.signals import LinkSignal, WheelSignal
from fourbar_ros.mechanism import LINK_NAMES, Mechanism, nearest_assembly
from fourbar_ros.mechanism.constants import record
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.mechanism.forces import FIELDS, Surroundings
from fourbar_ros.mechanism.integration import link_trajectories
from fourbar_ros.mechanism.state import make_state
import numpy as np
from scipy.interpolate import CubicHermiteSpline, make_lsq_spline

# Long enough for the slow part of the motion, short enough for random torques to stay below the
# noise of the sensors [s].
WINDOW_S = 4.0
# Pieces of the curves through measured wheel and link angles [s].
WHEEL_KNOTS_S = 0.04
LINK_KNOTS_S = 0.2
LONGEST_STEP_S = 1e-3
# Dry friction of the joints builds up within the one, or as soon as the step allows, and falls off
# around the other [rad/s].
SMOOTHING = 2e-4
STRIBECK_RATE = 0.1
# Links that are all slower do not move [rad/s].
MOVING = 0.05


@dataclass(frozen=True)
class Losses:
    """
    What acts on the links besides the wheels; numbers that an estimate may take below zero.

    :param joint_coulomb: of each joint [N m].
    :param joint_static: by which static friction exceeds that [N m].
    :param joint_viscous: of each joint [N m s].
    :param link_drag: force on each mass centre per speed [N s/m].
    :param spin_drag: torque on each link per rate [N m s].
    """

    joint_coulomb: float = 0.0
    joint_static: float = 0.0
    joint_viscous: float = 0.0
    link_drag: float = 0.0
    spin_drag: float = 0.0

    def surroundings(self, inertia: float) -> Surroundings:
        """
        Return them as the kernels take them.

        :param inertia: of the lightest link, which friction must not stop within a step [kg m^2].
        """
        largest = abs(self.joint_coulomb) + abs(self.joint_static)
        smoothing = max(SMOOTHING, 2.0 * LONGEST_STEP_S * largest / inertia)
        coulomb = self.joint_coulomb if abs(self.joint_coulomb) > 1e-12 else 1e-12
        return record(
            FIELDS, acting=True, smoothing=smoothing, stribeck_rate=STRIBECK_RATE,
            joint_static_ratio=1.0 + self.joint_static / coulomb, joint_coulomb=coulomb,
            joint_viscous=self.joint_viscous, link_drag=self.link_drag,
            link_spin_drag=self.spin_drag)


LOSSES = tuple(item.name for item in fields(Losses))


@dataclass(frozen=True, eq=False)
class Window:
    """
    A stretch of the recording with an initial state of its own.

    :param ticks: (m,) [s], equally many in all windows.
    :param accelerations: (m - 1, 4) of the wheels relative to their links, mean over each tick
        [rad/s^2].
    :param samples: for each link the instants where it was measured [s], and the angles [rad].
    :param start: (4,) guess of phi_a, phi_b [rad], omega_a, omega_b [rad/s].
    :param near: (4,) link angles there, which tell the branch [rad].
    """

    ticks: Floats
    accelerations: Floats
    samples: tuple[tuple[Floats, Floats], ...]
    start: Floats
    near: Floats


@dataclass(frozen=True, eq=False)
class Variant:
    """One choice of everything: the linkage, its losses, and (windows, 4) initial states."""

    mechanism: Mechanism
    losses: Losses
    starts: Floats


def windows_of(links: LinkSignal, wheels: WheelSignal, window_s: float = WINDOW_S
               ) -> list[Window]:
    """
    Divide a recording.

    :param window_s: how long they are [s].
    :raises CalibrationError: it is shorter than two windows, ticks are missing, or the links were
        not measured.
    """
    period = float(np.median(np.diff(wheels.times)))
    late = int(np.sum(np.diff(wheels.times) > 1.5 * period))
    if late:
        raise CalibrationError(
            f'{late} ticks of flywheel_states are missing: record on a machine with less to do')
    speeds = np.column_stack([
        _curve(wheels.times, column, WHEEL_KNOTS_S).derivative()(wheels.times)
        for column in wheels.angles.T])
    curves = []
    for link, column in enumerate(links.angles.T):
        known = np.isfinite(column)
        gaps = np.diff(links.times[known])
        if known.sum() < 50 or gaps.max() > 2.0 * LINK_KNOTS_S:
            raise CalibrationError(
                f'{LINK_NAMES[link]} was silent for {gaps.max() if len(gaps) else 0.0:.2f} s, '
                f'limit {2.0 * LINK_KNOTS_S:g} s')
        curves.append(_curve(links.times[known], column[known], LINK_KNOTS_S))
    # Links that stick to each other tell nothing, and their friction is anybody's guess.
    inside = (wheels.times >= links.times[0]) & (wheels.times <= links.times[-1])
    moving = np.flatnonzero(inside & (np.max(
        [np.abs(curve.derivative()(wheels.times)) for curve in curves], axis=0) > MOVING))
    first, last = (moving[0], moving[-1]) if len(moving) else (0, 0)
    length = round(window_s / period)
    count = (last - first) // length
    if count < 2:
        raise CalibrationError(
            f'the links move for {(last - first) * period:.1f} s, and {2.0 * window_s:g} s are '
            'needed at least')
    found = []
    for n in range(count):
        resume_at = first + n * length
        ticks = wheels.times[resume_at:resume_at + length + 1]
        begin = ticks[0]
        samples = []
        for link in range(4):
            inside = ((links.times >= begin) & (links.times < ticks[-1])
                      & np.isfinite(links.angles[:, link]))
            samples.append((links.times[inside], links.angles[inside, link]))
        at = np.array([curve(begin) for curve in curves])
        rates = [curves[link].derivative()(begin) for link in (0, 1)]
        found.append(Window(
            ticks, np.diff(speeds[resume_at:resume_at + length + 1], axis=0)
            / np.diff(ticks)[:, None], tuple(samples), np.array([at[0], at[1], *rates]), at))
    return found


def _curve(times: Floats, values: Floats, knots_s: float) -> Any:
    inner = np.linspace(times[0], times[-1], max(2, round(float(np.ptp(times)) / knots_s) + 1))
    knots = np.concatenate([[times[0]] * 3, inner, [times[-1]] * 3])
    return make_lsq_spline(times, values, knots, k=3)


def simulate(windows: Sequence[Window], variants: Sequence[Variant]) -> list[list[list[Floats]]]:
    """
    Integrate all windows for all variants at once.

    :returns: link angles at the samples, by variant, window and link [rad].
    :raises CalibrationError: a variant leaves what the linkage can do.
    """
    count = len(windows)
    states = np.array([
        _start(variant.mechanism, start, window.near)
        for variant in variants for window, start in zip(windows, variant.starts)])
    constants = np.repeat(np.array([
        variant.mechanism.constants_with(np.ones(4, dtype=bool)) for variant in variants]), count)
    around = np.repeat(np.array([variant.losses.surroundings(float(
        variant.mechanism.link_inertias.min())) for variant in variants]), count)
    inertias = np.repeat(
        [variant.mechanism.flywheel_inertias for variant in variants], count, axis=0)
    steps = max(1, int(np.ceil(float(np.diff(windows[0].ticks).max()) / LONGEST_STEP_S - 1e-9)))
    period = float(np.ptp(windows[0].ticks)) / (len(windows[0].ticks) - 1)
    track = link_trajectories(
        states, np.array([window.accelerations for window in windows]),
        np.tile(np.arange(count), len(variants)), inertias, period / steps, steps, constants,
        around)
    if not np.isfinite(track).all():
        raise CalibrationError('the motion that was simulated left the finite numbers')
    result = []
    for variant in range(len(variants)):
        result.append([[
            CubicHermiteSpline(window.ticks, track[:, row, link], track[:, row, 4 + link])(times)
            for link, (times, _) in enumerate(window.samples)]
            for row, window in enumerate(windows, start=variant * count)])
    return result


def _start(mechanism: Mechanism, start: Floats, near: Floats) -> Floats:
    angles = nearest_assembly(mechanism, (0, 1), (float(start[0]), float(start[1])), near)
    gamma = gamma_matrix(angles, mechanism.constants.lengths)
    return make_state(angles, np.concatenate([start[2:], gamma @ start[2:]]))


def with_parameters(mechanism: Mechanism, values: Floats) -> Mechanism:
    """
    Return the linkage with other links.

    :param values: (12,) inertias a to d [kg m^2], then x and y of their mass centres [m].
    """
    return replace(mechanism, link_inertias=values[:4], com_positions=values[4:].reshape(4, 2))


def parameters_of(mechanism: Mechanism) -> Floats:
    """Return what :func:`with_parameters` takes."""
    return np.concatenate([mechanism.link_inertias, mechanism.com_positions.ravel()])
