# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Output-error model of the links: simulated link angles under the measured motion of the wheels.

The input is the measured motion of the wheels relative to the links, so the model depends on the
axial inertias of the wheels, but neither on torques nor on bearing friction. The recording is
divided into windows, each with an initial state. All windows and all parameter sets are simulated
in one batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.measurements import LinkMeasurements, WheelMeasurements
from fourbar_ros.analysis.calibration.parameter_estimates import CalibrationError
from fourbar_ros.mechanism import LINK_NAMES, Mechanism, nearest_assembly
from fourbar_ros.mechanism.constants import record
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.mechanism.forces import FIELDS, Surroundings
from fourbar_ros.mechanism.integration import link_trajectories
from fourbar_ros.mechanism.state import make_state
import numpy as np
from scipy.interpolate import CubicHermiteSpline, make_lsq_spline

# Length of a window [s]. It contains a period of the lowest frequency, while the effect of random
# torques stays below the sensor noise.
WINDOW_S = 4.0
# Knot interval of the splines through measured wheel angles [s].
WHEEL_KNOTS_S = 0.04
# Knot interval of the splines through measured link angles [s].
LINK_KNOTS_S = 0.2
# Least number of samples of a link.
MIN_SAMPLES = 50
# Largest integration step [s].
MAX_STEP_S = 1e-3
# Rate within which Coulomb friction builds up [rad/s]; larger where the step requires it.
SMOOTHING = 2e-4
# Rate at which static friction changes to Coulomb friction [rad/s].
STRIBECK_RATE = 0.1
# Rate below which a link counts as at rest [rad/s].
MOVING = 0.05


@dataclass(frozen=True)
class Losses:
    """
    Friction and drag of the links; an estimate of a parameter may be negative.

    :param joint_coulomb: Coulomb friction of each joint [N m].
    :param joint_static: static minus Coulomb friction of each joint [N m].
    :param joint_viscous: viscous friction of each joint [N m s].
    :param link_drag: drag force on each mass centre per speed [N s/m].
    :param spin_drag: drag torque on each link per angular rate [N m s].
    """

    joint_coulomb: float = 0.0
    joint_static: float = 0.0
    joint_viscous: float = 0.0
    link_drag: float = 0.0
    spin_drag: float = 0.0

    def surroundings(self, inertia: float) -> Surroundings:
        """
        Return the losses in the format of the kernels.

        :param inertia: smallest link inertia; friction must not stop it within a step [kg m^2].
        """
        largest = abs(self.joint_coulomb) + abs(self.joint_static)
        smoothing = max(SMOOTHING, 2.0 * MAX_STEP_S * largest / inertia)
        coulomb = self.joint_coulomb if abs(self.joint_coulomb) > 1e-12 else 1e-12
        return record(
            FIELDS, acting=True, smoothing=smoothing, stribeck_rate=STRIBECK_RATE,
            joint_static_ratio=1.0 + self.joint_static / coulomb, joint_coulomb=coulomb,
            joint_viscous=self.joint_viscous, link_drag=self.link_drag,
            link_spin_drag=self.spin_drag)


LOSS_NAMES = tuple(item.name for item in fields(Losses))


@dataclass(frozen=True, eq=False)
class Window:
    """
    Part of a recording that is simulated from one initial state.

    :param ticks: (m,) times [s]; m is equal in all windows.
    :param accelerations: (m - 1, 4) of the wheels relative to their links, mean over each tick
        [rad/s^2].
    :param samples: for each link the times of measurement [s] and the angles [rad].
    :param initial: (4,) initial guess of phi_a, phi_b [rad], omega_a, omega_b [rad/s].
    :param initial_angles: (4,) initial link angles, which determine the branch [rad].
    """

    ticks: Floats
    accelerations: Floats
    samples: tuple[tuple[Floats, Floats], ...]
    initial: Floats
    initial_angles: Floats


@dataclass(frozen=True, eq=False)
class ModelParameters:
    """Parameters of one simulation: linkage, losses, and (windows, 4) initial states."""

    mechanism: Mechanism
    losses: Losses
    initial_states: Floats


def divide(links: LinkMeasurements, wheels: WheelMeasurements, window_s: float = WINDOW_S
           ) -> list[Window]:
    """
    Divide a recording into windows.

    :param window_s: length of a window [s].
    :raises CalibrationError: the motion is shorter than two windows, ticks are missing, or a link
        has a gap in its samples.
    """
    period = float(np.median(np.diff(wheels.times)))
    late = int(np.sum(np.diff(wheels.times) > 1.5 * period))
    if late:
        raise CalibrationError(
            f'{late} ticks of flywheel_states are missing: record on a machine with less load',
            reason='missing_ticks', value=late, limit=0)
    speeds = np.column_stack([
        _spline(wheels.times, column, WHEEL_KNOTS_S).derivative()(wheels.times)
        for column in wheels.angles.T])
    curves = []
    for link, column in enumerate(links.angles.T):
        known = np.isfinite(column)
        gaps = np.diff(links.times[known])
        gap, limit = float(gaps.max(initial=0.0)), 2.0 * LINK_KNOTS_S
        if known.sum() < MIN_SAMPLES or gap > limit:
            raise CalibrationError(
                f'{LINK_NAMES[link]} has a gap of {gap:.2f} s in {known.sum()} samples, limit '
                f'{limit:g} s', reason='gap', name=LINK_NAMES[link], value=gap, limit=limit)
        curves.append(_spline(links.times[known], column[known], LINK_KNOTS_S))
    # Links at rest carry no information, since their static friction is unknown.
    inside = (wheels.times >= links.times[0]) & (wheels.times <= links.times[-1])
    moving = np.flatnonzero(inside & (np.max(
        [np.abs(curve.derivative()(wheels.times)) for curve in curves], axis=0) > MOVING))
    first, last = (moving[0], moving[-1]) if len(moving) else (0, 0)
    length = round(window_s / period)
    count = (last - first) // length
    if count < 2:
        duration_s = float((last - first) * period)
        raise CalibrationError(
            f'the links move for {duration_s:.1f} s, at least {2.0 * window_s:g} s are required',
            reason='too_short', value=duration_s, limit=2.0 * window_s)
    windows = []
    for n in range(count):
        begin_at = first + n * length
        ticks = wheels.times[begin_at:begin_at + length + 1]
        begin = ticks[0]
        samples = []
        for link in range(4):
            inside = ((links.times >= begin) & (links.times < ticks[-1])
                      & np.isfinite(links.angles[:, link]))
            samples.append((links.times[inside], links.angles[inside, link]))
        angles = np.array([curve(begin) for curve in curves])
        rates = [curves[link].derivative()(begin) for link in (0, 1)]
        accelerations = (np.diff(speeds[begin_at:begin_at + length + 1], axis=0)
                         / np.diff(ticks)[:, None])
        windows.append(Window(ticks, accelerations, tuple(samples),
                              np.array([angles[0], angles[1], *rates]), angles))
    return windows


def _spline(times: Floats, values: Floats, knots_s: float) -> Any:
    inner = np.linspace(times[0], times[-1], max(2, round(float(np.ptp(times)) / knots_s) + 1))
    knots = np.concatenate([[times[0]] * 3, inner, [times[-1]] * 3])
    return make_lsq_spline(times, values, knots, k=3)


def simulate_links(windows: Sequence[Window], variants: Sequence[ModelParameters]
                   ) -> list[list[list[Floats]]]:
    """
    Simulate all windows for all parameter sets in one batch.

    :returns: link angles at the samples, by parameter set, window and link [rad].
    :raises CalibrationError: a simulation diverged.
    """
    count = len(windows)
    states = np.array([
        _initial_state(variant.mechanism, initial, window.initial_angles)
        for variant in variants for window, initial in zip(windows, variant.initial_states)])
    constants = np.repeat(np.array([
        variant.mechanism.constants_with(np.ones(4, dtype=bool)) for variant in variants]), count)
    around = np.repeat(np.array([variant.losses.surroundings(float(
        variant.mechanism.link_inertias.min())) for variant in variants]), count)
    inertias = np.repeat(
        [variant.mechanism.flywheel_inertias for variant in variants], count, axis=0)
    steps = max(1, int(np.ceil(float(np.diff(windows[0].ticks).max()) / MAX_STEP_S - 1e-9)))
    period = float(np.ptp(windows[0].ticks)) / (len(windows[0].ticks) - 1)
    track = link_trajectories(
        states, np.array([window.accelerations for window in windows]),
        np.tile(np.arange(count), len(variants)), inertias, period / steps, steps, constants,
        around)
    if not np.isfinite(track).all():
        raise CalibrationError('the simulation of the links diverged', reason='diverged')
    result = []
    for variant in range(len(variants)):
        result.append([[
            CubicHermiteSpline(window.ticks, track[:, row, link], track[:, row, 4 + link])(times)
            for link, (times, _) in enumerate(window.samples)]
            for row, window in enumerate(windows, start=variant * count)])
    return result


def _initial_state(mechanism: Mechanism, initial: Floats, near: Floats) -> Floats:
    angles = nearest_assembly(mechanism, (0, 1), (float(initial[0]), float(initial[1])), near)
    gamma = gamma_matrix(angles, mechanism.constants.lengths)
    return make_state(angles, np.concatenate([initial[2:], gamma @ initial[2:]]))


def with_parameters(mechanism: Mechanism, values: Floats) -> Mechanism:
    """
    Return the linkage with other link parameters.

    :param values: (12,) inertias a to d [kg m^2], then x and y of the mass centres a to d [m].
    """
    return replace(mechanism, link_inertias=values[:4], com_positions=values[4:].reshape(4, 2))


def link_parameters(mechanism: Mechanism) -> Floats:
    """Return inertias and mass centres in the order of :func:`with_parameters`: (12,)."""
    return np.concatenate([mechanism.link_inertias, mechanism.com_positions.ravel()])
