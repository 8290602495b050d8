# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Excitations for parameter identification: wheel torques from measurements, tick by tick.

An excitation returns the torques until the next tick; a wheel without torque coasts. An
excitation ends by itself, and raises an error where the linkage comes close to a change point or
a wheel close to its speed limit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Protocol

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.parameter_estimates import CalibrationError
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism, reduced_form
from fourbar_ros.mechanism.change_points import EXCITATION_CLEARANCE
import numpy as np

# Default torque over the motor's torque limit.
TORQUE_SHARE = 0.4
# Largest wheel speed over the motor's speed limit.
SPEED_SHARE = 0.9
# Margin below which an approaching coast-down ends early; the next step reverses it [rad].
SHORTEN_MARGIN = 2.0 * EXCITATION_CLEARANCE
# Speed below which a braked wheel counts as stopped [rad/s].
REST_SPEED = 3.0
# Largest change of the margin in `REST_WINDOW_S` of links at rest [rad].
REST_CHANGE = np.radians(0.5)
REST_WINDOW_S = 0.3
# Longest wait for the links to come to rest by joint friction [s].
MAX_REST_S = 6.0
# Least duration of the multi-sine: three periods of its lowest frequency [s].
MIN_DURATION_S = 10.0


class Excitation(Protocol):
    """
    A sequence of wheel torques.

    :cvar duration_s: longest duration [s].
    """

    duration_s: float

    def efforts(self, elapsed_s: float, link_angles: Floats, wheel_speeds: Floats
                ) -> Mapping[str, float] | None:
        """
        Return the torques until the next tick.

        :param elapsed_s: time since the first tick [s].
        :param link_angles: (4,) last measured angle of each link [rad].
        :param wheel_speeds: (4,) relative to the links [rad/s].
        :returns: torque by wheel [N m], None at the end.
        :raises CalibrationError: the linkage or a wheel is at a limit.
        """


def change_point_margin(link_angles: Floats) -> float:
    """Return the angle between the lines of links c and d [rad]; 0 at a change point."""
    return float(np.arcsin(min(1.0, abs(np.sin(link_angles[3] - link_angles[2])))))


class _SafetyLimits:
    """Limits of an excitation: margin to a change point, and wheel speeds."""

    def __init__(self, mechanism: Mechanism) -> None:
        self._speed_limits = SPEED_SHARE * mechanism.motor_speed_limits
        self._min_margin: float | None = None

    def check(self, link_angles: Floats, wheel_speeds: Floats) -> None:
        margin = change_point_margin(link_angles)
        if self._min_margin is None:
            # Links in a jig may start at any pose.
            self._min_margin = min(EXCITATION_CLEARANCE, 0.8 * margin)
        if margin < self._min_margin:
            raise CalibrationError(
                f'links c and d are within {np.degrees(margin):.1f} deg of a change point, limit '
                f'{np.degrees(self._min_margin):.1f} deg: start farther from it, or reduce the '
                'torque', reason='change_point', value=margin, limit=self._min_margin)
        for name, speed, limit in zip(FLYWHEEL_NAMES, np.abs(wheel_speeds), self._speed_limits):
            if speed > limit:
                raise CalibrationError(
                    f'{name} reached {speed:.0f} rad/s, limit {limit:.0f} rad/s: reduce the '
                    'torque', reason='speed', name=name, value=speed, limit=limit)


def _check_range(name: str, value: float, limit: float, unit: str) -> None:
    if not 0.0 < value <= limit:
        raise CalibrationError(f'{name} must be above 0 and at most {limit:g} {unit}, got '
                               f'{value:g}', reason='range', name=name, value=value, limit=limit)


class SpinAndCoast:
    """
    Spin-up and coast-down of one wheel after the other, in both directions.

    The first direction of each wheel moves the linkage away from change points, the second one
    moves it back.

    :param mechanism: motor limits and linkage.
    :param wheels: indices.
    :param top_speed: at the end of a spin-up [rad/s].
    :param torque: of a spin-up [N m].
    :param coast_s: longest coast-down [s].
    :param end_speed: speed at which a coast-down ends [rad/s].
    :raises CalibrationError: speed or torque above the motor limits, or a top speed below 1.5
        times the end speed.
    """

    def __init__(self, mechanism: Mechanism, wheels: Sequence[int], top_speed: float,
                 torque: float, coast_s: float, end_speed: float = 20.0) -> None:
        for wheel in wheels:
            name = FLYWHEEL_NAMES[wheel]
            _check_range(f'speed of {name}', top_speed,
                         SPEED_SHARE * mechanism.motor_speed_limits[wheel], 'rad/s')
            _check_range(f'torque of {name}', torque, mechanism.motor_torque_limits[wheel], 'N m')
        if top_speed < 1.5 * end_speed:
            raise CalibrationError(
                f'speed must be at least {1.5 * end_speed:g} rad/s for a coast-down, got '
                f'{top_speed:g} rad/s',
                reason='range', name='speed', value=top_speed, limit=1.5 * end_speed)
        self._mechanism = mechanism
        self._limits = _SafetyLimits(mechanism)
        self._top_speed, self._torque, self._end_speed = top_speed, torque, end_speed
        self._coast_s = coast_s
        self._steps = [(wheel, step) for wheel in wheels for step in (
            'rest', 'up', 'coast', 'reverse', 'coast_reverse', 'brake')]
        self._direction = 0.0
        self._step_start_s = 0.0
        self._margins: deque[tuple[float, float]] = deque()
        # Friction may take up to nine tenths of the torque.
        spin_s = [top_speed * mechanism.flywheel_inertias[wheel] / torque for wheel in wheels]
        self._spin_timeout_s = 10.0 * max(spin_s) + 1.0
        # Compile the kernel before the wheels turn.
        direction_from_change_points(mechanism, np.array([0.0, 1.0, 0.1, 1.2]), 0)
        self.duration_s = len(wheels) * (2.0 * coast_s + 2.0) + 8.0 * sum(spin_s)

    def efforts(self, elapsed_s: float, link_angles: Floats, wheel_speeds: Floats
                ) -> Mapping[str, float] | None:
        """Return the torque of the current wheel, see :class:`Excitation`."""
        self._limits.check(link_angles, wheel_speeds)
        self._shorten(elapsed_s, link_angles)
        while self._steps:
            wheel, step = self._steps[0]
            torque = self._step_torque(wheel, step, elapsed_s, link_angles, wheel_speeds[wheel])
            if torque is not None:
                # A command must name a wheel: name another one so that this wheel coasts.
                coasting = torque == 0.0
                return {FLYWHEEL_NAMES[(wheel + 1) % 4 if coasting else wheel]: torque}
            self._end_steps(1, elapsed_s)
        return None

    def _end_steps(self, count: int, elapsed_s: float) -> None:
        del self._steps[:count]
        self._step_start_s = elapsed_s

    def _approach(self) -> float:
        """Return the decrease of the margin within `REST_WINDOW_S` [rad]."""
        return self._margins[0][1] - self._margins[-1][1]

    def _shorten(self, elapsed_s: float, link_angles: Floats) -> None:
        """End the current step if it moves the links close to a change point."""
        self._margins.append((elapsed_s, change_point_margin(link_angles)))
        while elapsed_s - self._margins[0][0] > REST_WINDOW_S:
            self._margins.popleft()
        if (self._steps and self._margins[-1][1] < SHORTEN_MARGIN
                and self._approach() > REST_CHANGE):
            # Not the first spin-up, which moves the links away.
            count = {'coast': 1, 'reverse': 2, 'coast_reverse': 1}.get(self._steps[0][1], 0)
            if count:
                self._end_steps(count, elapsed_s)

    def _step_torque(self, wheel: int, step: str, elapsed_s: float, link_angles: Floats,
                     speed: float) -> float | None:
        """Return the torque in a step, None at its end."""
        in_step_s = elapsed_s - self._step_start_s
        if step == 'rest':
            rests = in_step_s >= REST_WINDOW_S and abs(self._approach()) < REST_CHANGE
            return None if rests or in_step_s >= MAX_REST_S else 0.0
        if step in ('coast', 'coast_reverse'):
            over = abs(speed) <= self._end_speed or in_step_s >= self._coast_s
            return None if over else 0.0
        if in_step_s > self._spin_timeout_s:
            raise CalibrationError(
                f'{FLYWHEEL_NAMES[wheel]} did not reach its speed within '
                f'{self._spin_timeout_s:.1f} s, it is at {speed:.1f} rad/s: increase the torque',
                reason='timeout', name=FLYWHEEL_NAMES[wheel], value=speed,
                limit=self._spin_timeout_s)
        if step == 'brake':
            return None if abs(speed) < REST_SPEED else -float(np.sign(speed)) * self._torque
        if step == 'up' and in_step_s == 0.0:
            self._direction = direction_from_change_points(self._mechanism, link_angles, wheel)
        direction = self._direction if step == 'up' else -self._direction
        return None if direction * speed >= self._top_speed else direction * self._torque


def direction_from_change_points(mechanism: Mechanism, link_angles: Floats, wheel: int) -> float:
    """Return the sign of a wheel torque that increases the margin to a change point."""
    form = reduced_form(mechanism, link_angles, np.zeros(4))
    acceleration = form.gamma @ np.linalg.solve(form.mass_matrix, -form.wheel_map[:, wheel])
    angle = link_angles[3] - link_angles[2]
    return 1.0 if np.sin(2.0 * angle) * (acceleration[1] - acceleration[0]) >= 0.0 else -1.0


class MultiSine:
    """
    Multi-sine excitation of all wheels, persistently exciting for both degrees of freedom.

    The wheel momentum is a sum of sines with a smooth ramp at the begin and the end; the torques
    are its derivative, so that the links oscillate about their initial pose without drift.
    Opposite wheels have equal torques, which do not load the joints.

    :param mechanism: motor limits.
    :param duration_s: of the excitation [s].
    :param torque: largest torque of a wheel [N m].
    :raises CalibrationError: a torque above the motor limits, or a duration below
        `MIN_DURATION_S`.
    """

    # Of both pairs of wheels; no frequency, sum or difference of two occurs twice [Hz].
    FREQUENCIES = ((0.31, 0.83), (0.43, 1.07))
    RAMP_S = 2.0

    def __init__(self, mechanism: Mechanism, duration_s: float, torque: float) -> None:
        for name, limit in zip(FLYWHEEL_NAMES, mechanism.motor_torque_limits):
            _check_range(f'torque of {name}', torque, limit, 'N m')
        if not duration_s >= MIN_DURATION_S:
            raise CalibrationError(
                f'duration must be at least {MIN_DURATION_S:g} s, got {duration_s:g} s',
                reason='range', name='duration', value=duration_s, limit=MIN_DURATION_S)
        self.duration_s = duration_s
        self._torque = torque
        self._limits = _SafetyLimits(mechanism)

    def efforts(self, elapsed_s: float, link_angles: Floats, wheel_speeds: Floats
                ) -> Mapping[str, float] | None:
        """Return the torques of all wheels, see :class:`Excitation`."""
        if elapsed_s >= self.duration_s:
            return None
        self._limits.check(link_angles, wheel_speeds)
        to_end_s = min(elapsed_s, self.duration_s - elapsed_s)
        share = min(1.0, to_end_s / self.RAMP_S)
        ramp = share * share * (3.0 - 2.0 * share)
        slope = 6.0 * share * (1.0 - share) / self.RAMP_S * (
            1.0 if elapsed_s < 0.5 * self.duration_s else -1.0)
        torques = []
        for frequencies in self.FREQUENCIES:
            omega = 2.0 * np.pi * np.array(frequencies)
            torque = 0.5 * self._torque * float(np.sum(
                ramp * np.cos(omega * elapsed_s) + slope * np.sin(omega * elapsed_s) / omega))
            torques.append(float(np.clip(torque, -self._torque, self._torque)))
        return dict(zip(FLYWHEEL_NAMES, (*torques, *torques)))
