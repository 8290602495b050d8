# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Torques that make a device show its parameters, tick by tick from what it measures.

An excitation is asked at every tick for the torques until the next one; wheels that it does not
name have no power. It ends by itself, and stops where the linkage or a wheel goes too far.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Protocol

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.quantity import CalibrationError
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism, reduced_form
from fourbar_ros.mechanism.change_points import EXCITATION_CLEARANCE
import numpy as np

# Share of the motors' limits that is used.
TORQUE_SHARE = 0.4
SPEED_SHARE = 0.9
# At twice of which a wheel's turn is cut short, since what comes next drives the links back.
TURN_BACK = 2.0 * EXCITATION_CLEARANCE
# A wheel slower than this is left alone [rad/s].
RESTING = 3.0
# Links that turn by less in a while are at rest; joints stop them by and by [rad, s].
SETTLED, WHILE_S, LONGEST_REST_S = np.radians(0.5), 0.3, 6.0


class Excitation(Protocol):
    """
    What drives the wheels.

    :cvar duration_s: how long it takes at most [s].
    """

    duration_s: float

    def efforts(self, elapsed_s: float, link_angles: Floats, wheel_speeds: Floats
                ) -> Mapping[str, float] | None:
        """
        Return the torques until the next tick.

        :param elapsed_s: since the first tick [s].
        :param link_angles: (4,) the last that was measured of each [rad].
        :param wheel_speeds: (4,) relative to the links [rad/s].
        :returns: torque by wheel [N m], None at the end.
        :raises CalibrationError: it must not go on.
        """


def clearance(link_angles: Floats) -> float:
    """Return how far links c and d are from a line [rad]."""
    return float(np.arcsin(min(1.0, abs(np.sin(link_angles[3] - link_angles[2])))))


class _Guard:
    """Stops an excitation that brings the linkage to a change point, or a wheel to its limit."""

    def __init__(self, mechanism: Mechanism) -> None:
        self._limits = SPEED_SHARE * mechanism.motor_speed_limits
        self._least: float | None = None

    def check(self, link_angles: Floats, wheel_speeds: Floats) -> None:
        now = clearance(link_angles)
        if self._least is None:
            # Links that are held in a jig may be held anywhere.
            self._least = min(EXCITATION_CLEARANCE, 0.8 * now)
        if now < self._least:
            raise CalibrationError(
                f'links c and d came within {np.degrees(now):.1f} deg of a line, limit '
                f'{np.degrees(self._least):.1f} deg: begin farther from a change point, or drive '
                'less')
        for wheel, name in enumerate(FLYWHEEL_NAMES):
            if abs(wheel_speeds[wheel]) > self._limits[wheel]:
                raise CalibrationError(
                    f'{name} reached {abs(wheel_speeds[wheel]):.0f} rad/s, limit '
                    f'{self._limits[wheel]:.0f} rad/s: drive less')


class SpinAndCoast:
    """
    One wheel after the other: spun up, let coast, the other way round, and braked to rest.

    Each begins in the direction that leads the linkage away from change points; the second brings
    it back.

    :param mechanism: its motors' limits, and the linkage.
    :param wheels: indices.
    :param top_speed: up to which they are spun [rad/s].
    :param torque: of the spin-up [N m].
    :param coast_s: longest coast-down [s].
    :param slowest: speed at which a coast-down ends [rad/s].
    :raises CalibrationError: more speed or torque than the motors have, or no range to coast in.
    """

    def __init__(self, mechanism: Mechanism, wheels: Sequence[int], top_speed: float,
                 torque: float, coast_s: float, slowest: float = 20.0) -> None:
        for wheel in wheels:
            for asked, limit, what, unit in (
                    (top_speed, SPEED_SHARE * mechanism.motor_speed_limits[wheel], 'speed',
                     'rad/s'),
                    (torque, mechanism.motor_torque_limits[wheel], 'torque', 'N m')):
                if not 0.0 < asked <= limit:
                    raise CalibrationError(
                        f'the {what} of {FLYWHEEL_NAMES[wheel]} must lie between 0 and '
                        f'{limit:g} {unit}, got {asked:g}')
        if top_speed < 1.5 * slowest:
            raise CalibrationError(
                f'the speed must be {1.5 * slowest:g} rad/s at least, to coast down from, got '
                f'{top_speed:g} rad/s')
        self._mechanism = mechanism
        self._guard = _Guard(mechanism)
        self._top, self._torque, self._slowest = top_speed, torque, slowest
        self._coast_s = coast_s
        self._steps = [(wheel, step) for wheel in wheels for step in (
            'rest', 'up', 'coast', 'back', 'return', 'brake')]
        self._direction = 0.0
        self._since_s = 0.0
        self._seen: deque[tuple[float, float]] = deque()
        # Friction may take much of the torque, so ten times as long is not yet too long.
        spin_s = [top_speed * mechanism.flywheel_inertias[wheel] / torque for wheel in wheels]
        self._patience_s = 10.0 * max(spin_s) + 1.0
        # Compile the kernel now, not while the wheels turn.
        away_from_change_points(mechanism, np.array([0.0, 1.0, 0.1, 1.2]), 0)
        self.duration_s = len(wheels) * (2.0 * coast_s + 2.0) + 8.0 * sum(spin_s)

    def efforts(self, elapsed_s: float, link_angles: Floats, wheel_speeds: Floats
                ) -> Mapping[str, float] | None:
        """Return the torque of the wheel whose turn it is, see :class:`Excitation`."""
        self._guard.check(link_angles, wheel_speeds)
        self._turn_back(elapsed_s, link_angles)
        while self._steps:
            wheel, step = self._steps[0]
            torque = self._act(wheel, step, elapsed_s, link_angles, wheel_speeds[wheel])
            if torque is not None:
                # Who coasts has no power, and a command names somebody.
                coasting = torque == 0.0
                return {FLYWHEEL_NAMES[(wheel + 1) % 4 if coasting else wheel]: torque}
            self._steps.pop(0)
            self._since_s = elapsed_s
        return None

    def _approach(self) -> float:
        """Return by how much the links came closer to a change point lately [rad]."""
        return self._seen[0][1] - self._seen[-1][1]

    def _turn_back(self, elapsed_s: float, link_angles: Floats) -> None:
        """Go on to the step that drives the links the other way, where they come too close."""
        self._seen.append((elapsed_s, clearance(link_angles)))
        while elapsed_s - self._seen[0][0] > WHILE_S:
            self._seen.popleft()
        if not (self._steps and self._seen[-1][1] < TURN_BACK and self._approach() > SETTLED):
            return
        # The first spin-up leads away, and is not to blame.
        skipped = {'coast': ('coast',), 'back': ('back', 'return'),
                   'return': ('return',)}.get(self._steps[0][1], ())
        for _ in skipped:
            self._steps.pop(0)
            self._since_s = elapsed_s

    def _act(self, wheel: int, step: str, elapsed_s: float, link_angles: Floats, speed: float
             ) -> float | None:
        """Return the torque in a step, None once it is over."""
        in_step_s = elapsed_s - self._since_s
        if step == 'rest':
            # At the begin of all, and where links are held, they rest already.
            rests = in_step_s >= WHILE_S and abs(self._approach()) < SETTLED
            return None if rests or in_step_s >= LONGEST_REST_S else 0.0
        if step in ('coast', 'return'):
            over = abs(speed) <= self._slowest or in_step_s >= self._coast_s
            return None if over else 0.0
        if in_step_s > self._patience_s:
            raise CalibrationError(
                f'{FLYWHEEL_NAMES[wheel]} did not reach its speed within '
                f'{self._patience_s:.1f} s, it is at {speed:.1f} rad/s: give more torque')
        if step == 'brake':
            return None if abs(speed) < RESTING else -float(np.sign(speed)) * self._torque
        if step == 'up' and in_step_s == 0.0:
            self._direction = away_from_change_points(self._mechanism, link_angles, wheel)
        direction = self._direction if step == 'up' else -self._direction
        return None if direction * speed >= self._top else direction * self._torque


def away_from_change_points(mechanism: Mechanism, link_angles: Floats, wheel: int) -> float:
    """Return the sign of the torque on a wheel that moves links c and d away from a line."""
    form = reduced_form(mechanism, link_angles, np.zeros(4))
    turning = form.gamma @ np.linalg.solve(form.mass_matrix, -form.wheel_map[:, wheel])
    fold = link_angles[3] - link_angles[2]
    return 1.0 if np.sin(2.0 * fold) * (turning[1] - turning[0]) >= 0.0 else -1.0


class MultiSine:
    """
    Momentum to and fro between wheels and links, each pair with frequencies of its own.

    The momentum is a sum of sines that grows from nothing and ends in nothing; the torques are
    its derivative. So the links swing about where they are and do not drift off. Opposite wheels
    get the same torque, so that nothing only loads the joints.

    :param mechanism: its motors' limits.
    :param duration_s: of the whole [s].
    :param torque: largest of one wheel [N m].
    :raises CalibrationError: more torque than the motors have, or no time.
    """

    # Without a common divisor below a tenth of a hertz, and no sum or difference twice [Hz].
    FREQUENCIES = ((0.31, 0.83), (0.43, 1.07))
    # For growing and ending [s].
    RAMP_S = 2.0

    def __init__(self, mechanism: Mechanism, duration_s: float, torque: float) -> None:
        for wheel, name in enumerate(FLYWHEEL_NAMES):
            if not 0.0 < torque <= mechanism.motor_torque_limits[wheel]:
                raise CalibrationError(
                    f'the torque of {name} must lie between 0 and '
                    f'{mechanism.motor_torque_limits[wheel]:g} N m, got {torque:g}')
        if not duration_s >= 10.0:
            raise CalibrationError(f'the excitation must last 10 s at least, got {duration_s:g} s')
        self.duration_s = duration_s
        self._torque = torque
        self._guard = _Guard(mechanism)

    def efforts(self, elapsed_s: float, link_angles: Floats, wheel_speeds: Floats
                ) -> Mapping[str, float] | None:
        """Return the torques of all wheels, see :class:`Excitation`."""
        if elapsed_s >= self.duration_s:
            return None
        self._guard.check(link_angles, wheel_speeds)
        ends_s = min(elapsed_s, self.duration_s - elapsed_s)
        share = min(1.0, ends_s / self.RAMP_S)
        ramp = share * share * (3.0 - 2.0 * share)
        slope = 6.0 * share * (1.0 - share) / self.RAMP_S * (
            1.0 if elapsed_s < 0.5 * self.duration_s else -1.0)
        pair = []
        for chosen in self.FREQUENCIES:
            omega = 2.0 * np.pi * np.array(chosen)
            asked = 0.5 * self._torque * float(np.sum(
                ramp * np.cos(omega * elapsed_s) + slope * np.sin(omega * elapsed_s) / omega))
            pair.append(float(np.clip(asked, -self._torque, self._torque)))
        return dict(zip(FLYWHEEL_NAMES, (pair[0], pair[1], pair[0], pair[1])))
