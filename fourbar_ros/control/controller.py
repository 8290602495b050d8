# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The controller: estimates and setpoints in, wheel commands out, one set per tick."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, pi, sin
from typing import NamedTuple

from fourbar_ros.control.actuation_cost_sums import ActuationCostSums, MAX_PERIOD
from fourbar_ros.control.branch import Branch, PARALLELOGRAM
from fourbar_ros.control.branch_selection import select_branch
from fourbar_ros.control.feasibility import (
    check_needs,
    loads_along,
    Path,
    shortest_duration,
    Wheels,
)
from fourbar_ros.control.momentum_margin import MomentumMonitor
from fourbar_ros.control.reference_generator import ReferenceGenerator, set_pairs
from fourbar_ros.control.setpoint import check_names, follow_path, SetpointError
from fourbar_ros.control.settings import ControllerSettings
from fourbar_ros.control.soft_step import SoftStep, TrajectorySegment
from fourbar_ros.control.stability import check_gains, GainError
from fourbar_ros.control.tracking_law import TrackingLaw
from fourbar_ros.control.trajectory import Point, read_trajectory
from fourbar_ros.control.wheel_command import WheelCommand, WheelCommander
from fourbar_ros.control.wheel_fault_detection import SHORTED, WheelFaultDetector
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism
from fourbar_ros.mechanism.change_points import TORQUE_CUTOFF
from fourbar_ros.mechanism.closure import branch_of
from fourbar_ros.mechanism.constants import Array
import numpy as np

# Modes: the device is not armed; disabled or unstable gains; bring all rates to zero; hold the
# reference at rest; follow a move.
MODES = ('disarmed', 'idle', 'damp', 'hold', 'track')

# Modes in which the wheels get no torque.
UNDRIVEN = ('disarmed', 'idle')

# Largest difference of a setpoint's stamp from the last tick [s]; the stamp 0 means now.
SETPOINT_TIMEOUT = 1.0

# Time constants with which joints are taken for sticking at rest, and for sliding in motion [s].
#
# Tracking errors decay before the first; compensation must be there soon after a start.
STICKING_TIME, SLIDING_TIME = 0.3, 0.05

# Relative change of the period for which gains are checked again: far above jitter.
PERIOD_TOLERANCE = 0.05

# Consecutive periods of several ticks that count as a slower loop, and not as lost ticks.
SLOWER_TICKS = 10

# Share of the allocator's torque that a plan may use; the rest is for tracking errors.
PLANNED_SHARE = 0.9

# Longest time for which a plan extrapolates the drift of wheel speeds [s].
DRIFT_HORIZON = 60.0

ALL = np.ones(4, dtype=bool)


class Control(NamedTuple):
    """
    Output of the controller at a tick.

    :param stamp_ns: the tick [ns].
    :param command: to the wheels.
    :param torques: (4,) to act on the wheels, bearings apart [N m].
    :param reference_angles, reference_rates: (4,) of the links [rad], [rad/s].
    :param angle_errors, rate_errors: (4,) reference minus estimate [rad], [rad/s].
    :param energies: (4,) see `actuation_cost`.
    """

    stamp_ns: int
    command: WheelCommand
    torques: Array
    reference_angles: Array
    reference_rates: Array
    angle_errors: Array
    rate_errors: Array
    energies: Array


class Controller:
    """
    Computed-torque tracking of the linkage with four wheels.

    Until the device is armed, and after each disarm, the reference is the present estimate, the
    torques are zero and there is no goal.

    :ivar settings: changed by :meth:`tune`.
    :ivar mode: one of `MODES`.
    :ivar accepted, refused: number of setpoints and trajectories.
    :ivar last_refusal: message of the last refusal, or ''.
    :ivar problem: why a manoeuvre was aborted or the controller is idle, or ''.
    :ivar saturated: number of ticks at which the motors could not meet the demand.
    :ivar law, momentum, wheels: tracking law, momentum monitor and wheel fault detector.
    :ivar angles, rates, speeds: (4,) of the links and of the wheels, relative to the links, at
        the last tick [rad], [rad/s].
    """

    def __init__(self, mechanism: Mechanism, settings: ControllerSettings) -> None:
        self.settings = settings
        self.mode = 'disarmed'
        self.accepted = 0
        self.refused = 0
        self.last_refusal = ''
        self.problem = ''
        self.saturated = 0
        self.law = TrackingLaw(mechanism)
        self.momentum = MomentumMonitor(mechanism)
        self.wheels = WheelFaultDetector(mechanism)
        self.mechanism = mechanism
        self._reference = ReferenceGenerator(mechanism)
        self._commander = WheelCommander(mechanism)
        self._cost = ActuationCostSums(mechanism)
        self._armed = False
        self._enabled = True
        self.speeds = np.zeros(4)
        self.angles = np.zeros(4)
        self.rates = np.zeros(4)
        self._command = WheelCommand(np.zeros(4), False, ALL)
        self._sticking = 0.0
        self._stamp_ns: int | None = None
        self._last: Control | None = None
        self._period = 0.0
        self._checked_period = 0.0
        self._irregular_ticks = 0
        self._unknown_command = False
        self._gain_problem = ''
        self._apply(settings)
        self._compile()

    @property
    def goal(self) -> Array | None:
        """Last accepted goal of the links (4,) [rad], None without one."""
        return self._reference.goal

    @property
    def branch(self) -> str:
        """Branch of the reference: `parallelogram`, `folded`, `crossed` or `open`."""
        branch = self._reference.branch
        return branch_of(self._reference.angles) if branch is None else branch.name

    def tune(self, settings: ControllerSettings) -> None:
        """
        Apply settings; a move under way keeps its duration.

        :raises GainError: the gains are not stable at the present rate; nothing changes.
        """
        if self._checked_period:
            check_gains(settings, self.mechanism, self._checked_period)
        self._apply(settings)
        self.settings, self._gain_problem = settings, ''

    def device_armed(self, armed: bool) -> None:
        """Follow the arming state of the device."""
        self._armed = armed

    def enable(self, enabled: bool) -> None:
        """Drive the wheels when armed, from the next tick on; or give them no torque."""
        if enabled and not self._enabled and self._armed:
            # Nothing is known of the wheels while they were not driven.
            self._reset_wheels()
            self.mode = 'damp'
            self._hold()
        self._enabled = enabled

    def hold(self) -> None:
        """
        Come to rest and hold.

        :raises SetpointError: the wheels are not driven.
        """
        self._check_driving()
        self._hold()

    def damp(self) -> None:
        """
        Bring all rates to zero, at whatever angles.

        :raises SetpointError: the wheels are not driven.
        """
        self._check_driving()
        self.mode, self._reference.goal = 'damp', None

    def setpoint(self, names: Sequence[str], positions: Sequence[float], stamp_ns: int = 0
                 ) -> None:
        """
        Accept a setpoint; its move starts at the next tick.

        :param names: any of the four links; a link that is not named follows or holds.
        :param positions: goal angle of each [rad].
        :param stamp_ns: of the setpoint, 0 for now [ns].
        :raises SetpointError: the setpoint is refused as a whole and counted; nothing changes.
        """
        previous_mode = self.mode
        try:
            goals = check_names(names, positions)
            self._check_driving()
            self._check_stamp(stamp_ns)
            self._leave_damping()
            selection = select_branch(
                self.mechanism, goals, self._reference, self.settings.setpoint_duration,
                self.settings.change_points)
            step, present, branch = selection.step, selection.present, selection.branch
            if self.settings.setpoint_timing == 'shortest':
                step = self._shortest(step, present, branch)
            else:
                check_needs(self.mechanism, step, present,
                            self._wheels_with_drift(step.duration), crossing=self._crossing,
                            branch=branch)
        except SetpointError as error:
            self._refuse(error, previous_mode)
            raise
        if branch is not None and branch != self._reference.branch:
            self._reference.switch_branch(branch)
        self._accept(step, selection.goal)

    def trajectory(self, names: Sequence[str], points: Sequence[Point], stamp_ns: int = 0
                   ) -> None:
        """
        Accept a motion through several points; it starts at the next tick.

        :param names: of the links that the points contain.
        :param points: see `trajectory`.
        :param stamp_ns: time of its start, 0 for now [ns].
        :raises SetpointError: the trajectory is refused as a whole and counted; nothing changes.
        """
        previous_mode = self.mode
        try:
            self._check_driving()
            self._check_stamp(stamp_ns)
            self._leave_damping()
            reference, crossing = self._reference, self._crossing
            segment, goal = read_trajectory(
                self.mechanism, names, points, reference.motion.copy(), reference.angles,
                reference.destination, crossing=crossing, branch=reference.branch)
            check_needs(self.mechanism, segment, reference.angles,
                        self._wheels_with_drift(segment.duration), crossing=crossing,
                        branch=reference.branch)
        except SetpointError as error:
            self._refuse(error, previous_mode)
            raise
        self._accept(segment, goal)

    def tick(self, stamp_ns: int, link_angles: Array, link_rates: Array, disturbance: Array,
             wheel_speeds: Array, efforts: Array, *, late: bool = False) -> Control:
        """
        Evaluate one tick.

        :param link_angles: (4,) estimated [rad].
        :param link_rates: (4,) estimated [rad/s].
        :param disturbance: (2,) estimated torques on links a and b besides those of the wheels
            [N m].
        :param wheel_speeds: (4,) measured, relative to the links [rad/s].
        :param efforts: (4,) torques applied since the last tick [N m].
        :param late: whether the tick comes so late that the time at which its command acts is
            unknown.
        """
        if self._last is not None and self._last.stamp_ns == stamp_ns:
            # In lock-step a tick is sent again when its command was lost.
            return self._last
        period = self._measure_period(stamp_ns)
        self.speeds, self.angles, self.rates = wheel_speeds, link_angles, link_rates
        previous_mode, settings = self.mode, self.settings
        self._change_mode()
        reference, driving = self._reference, self.mode not in UNDRIVEN
        friction = self._commander.update_friction(
            wheel_speeds, settings.bearing_coulomb, settings.bearing_viscous)
        if driving and previous_mode not in UNDRIVEN:
            # The first period with a known command starts at the second tick in time. After a
            # gap the first speeds are means over all of it.
            unknown = late or not self._is_single(period)
            self._detect_faults(
                period, not (unknown or self._unknown_command), link_rates, wheel_speeds, efforts)
            self._unknown_command = unknown
        if reference.advance(stamp_ns) and self.mode == 'track':
            self.mode = 'hold'
        if not driving or self.mode == 'damp':
            reference.track_links(link_angles)
        self._update_sticking(period)
        output = self.law.update(
            reference, link_angles, link_rates, disturbance, wheel_speeds, friction,
            self._sticking if settings.rest_band > 0.0 else 0.0)
        self.momentum.update(period, wheel_speeds, output.planned, reference.accelerations)
        if driving and not self._near_change_point(link_angles):
            self.saturated += output.scale < 1.0
            torques = output.torques.copy()
            self._command = self._commander.command(
                torques, reference.accelerations, wheel_speeds, self.wheels.usable, self._period,
                settings.command == 'velocity')
        else:
            torques = np.zeros(4)
            self._commander.reset(wheel_speeds)
            self._command = WheelCommand(np.zeros(4), False, self.wheels.usable)
        self._cost.add(period, link_rates, wheel_speeds, efforts)
        self._last = Control(
            stamp_ns, self._command, torques, reference.angles.copy(), reference.rates.copy(),
            reference.angles - link_angles, reference.rates - link_rates,
            self._cost.energies.copy())
        return self._last

    @property
    def _crossing(self) -> bool:
        return self.settings.change_points != 'avoid'

    @property
    def _any_branch(self) -> bool:
        return self.settings.change_points == 'choose'

    def _apply(self, settings: ControllerSettings) -> None:
        self.law.tune(settings, self.wheels.usable)
        self.wheels.tune(settings.bearing_coulomb, settings.bearing_viscous)

    def _measure_period(self, stamp_ns: int) -> float:
        """Return the time since the last tick, 0 after a gap, and check the gains for it."""
        period = 0.0
        if self._stamp_ns is not None:
            period = (stamp_ns - self._stamp_ns) * 1e-9
        self._stamp_ns = stamp_ns
        if not 0.0 < period <= 1.0:
            return 0.0
        self._period = period
        known = self._checked_period
        whole = round(period / known) if known else 0
        # A lost tick makes a period of twice the length, and no new rate.
        if whole and abs(period - whole * known) <= PERIOD_TOLERANCE * period:
            self._irregular_ticks = 0 if whole == 1 else self._irregular_ticks + 1
        else:
            self._irregular_ticks = SLOWER_TICKS
        if self._irregular_ticks >= SLOWER_TICKS:
            self._checked_period, self._irregular_ticks = period, 0
            try:
                check_gains(self.settings, self.mechanism, period)
                self._gain_problem = ''
            except GainError as error:
                self._gain_problem = str(error)
        return period if period <= MAX_PERIOD else 0.0

    def _change_mode(self) -> None:
        previous_mode = self.mode
        if not self._armed:
            self.mode = 'disarmed'
        elif previous_mode == 'disarmed':
            self._reset_wheels()
            self._cost.reset()
            self.momentum.reset(self.speeds)
            self.problem = ''
            self.mode = 'hold'
        if self.mode != 'disarmed' and (not self._enabled or self._gain_problem):
            self.mode, self.problem = 'idle', self._gain_problem
        elif self.mode == 'idle':
            self.mode, self.problem = 'hold', ''
        if self.mode == 'hold' and previous_mode in UNDRIVEN:
            self._commander.reset(self.speeds)
            self._reset_wheels()
        if self.mode in UNDRIVEN or self.mode == 'hold' and previous_mode in UNDRIVEN:
            self._reference.rest_at(self.angles, any_branch=self._any_branch)

    def _reset_wheels(self) -> None:
        """Take all wheels for healthy, and use all of them."""
        self.wheels.reset()
        self.law.tune(self.settings, self.wheels.usable)

    def _is_single(self, period: float) -> bool:
        """Return whether no tick was missed since the last one."""
        return 0.0 < period < 1.5 * self._checked_period

    def _detect_faults(self, period: float, known: bool, link_rates: Array, speeds: Array,
                       efforts: Array) -> None:
        """Update the fault states, and stop using wheels that are broken."""
        if not known:
            self.wheels.restart(self._command, speeds, link_rates, efforts)
            return
        if not self.wheels.update(period, self._command, speeds, link_rates, efforts):
            return
        shorted = self.wheels.fault_states == SHORTED
        if shorted.any():
            self.problem = (f'{FLYWHEEL_NAMES[int(np.argmax(shorted))]} is driven without a '
                            'command and its power cannot be cut: press the emergency stop')
            self.mode, self._reference.goal = 'damp', None
        usable = self.wheels.usable
        if (usable == self.law.usable).all():
            return
        self.law.tune(self.settings, usable)
        lost = self.law.lost_axes()
        if lost:
            broken = [name for name, use in zip(FLYWHEEL_NAMES, usable) if not use]
            self.problem = (f'axis {" and ".join(lost)} cannot be driven without '
                            f'{", ".join(broken)}: the manoeuvre is aborted')
            self._hold()
        elif self._reference.moving and self.mode == 'track':
            self._extend_move()

    def _extend_move(self) -> None:
        """Extend a move to the shortest duration that the usable wheels allow."""
        reference, goal = self._reference, self._reference.goal
        if goal is None or self._stamp_ns is None:
            return
        left = reference.time_left(self._stamp_ns)
        try:
            step = self._shortest(SoftStep(reference.motion.copy(), goal[reference.axes], left),
                                  reference.angles, reference.branch, longer_than=left)
            if step.duration > left:
                reference.start(step, goal, self._stamp_ns)
        except SetpointError as error:
            self.problem = f'the usable wheels cannot complete the move, aborted: {error}'
            self._hold()

    def _update_sticking(self, period: float) -> None:
        resting = not self._reference.moving and self.mode == 'hold'
        target, time = (1.0, STICKING_TIME) if resting else (0.0, SLIDING_TIME)
        self._sticking += (1.0 - exp(-period / time)) * (target - self._sticking)

    def _near_change_point(self, angles: Array) -> bool:
        """Return whether the reduced form does not exist here, so that the wheels coast."""
        return not self._reference.paired and abs(sin(angles[3] - angles[2])) < TORQUE_CUTOFF

    def _wheels_with_drift(self, duration: float) -> Wheels:
        """Return the wheels with the speeds that adverse drift leads to within a time [s]."""
        adverse = np.sign(self.momentum.drift) == np.sign(self.speeds)
        speeds = self.speeds + self.momentum.drift * min(duration, DRIFT_HORIZON) * adverse
        friction = np.full(4, self.settings.bearing_coulomb)
        return Wheels(
            speeds, self.law.allocation, friction, PLANNED_SHARE * self.law.motor_share)

    def _shortest(self, step: SoftStep, present: Array, branch: Branch | None,
                  longer_than: float = 0.0) -> SoftStep:
        """Return a step with the shortest duration; its path is checked if that is longer."""
        duration = shortest_duration(
            self.mechanism, step, present, self._wheels_with_drift(0.0), crossing=self._crossing,
            branch=branch)
        shortest = SoftStep(step.start, step.goal, duration)
        if duration > longer_than:
            follow_path(
                self.mechanism, shortest, present, crossing=self._crossing, branch=branch)
        return shortest

    def _leave_damping(self) -> None:
        """Start from the measured motion of the links, where the reference does not move."""
        if self.mode == 'damp':
            self._hold()

    def _hold(self) -> None:
        if self._stamp_ns is None:
            return
        if self.mode == 'damp':
            self._reference.stop_from(
                self.angles, self.rates, self._stamp_ns, any_branch=self._any_branch)
        else:
            self._reference.stop(self._stamp_ns)
            self._reference.goal = None
        self.mode = 'hold'

    def _accept(self, segment: TrajectorySegment, goal: Array) -> None:
        assert self._stamp_ns is not None
        self._reference.start(segment, goal, self._stamp_ns)
        self.mode, self.problem = 'track', ''
        self.accepted += 1

    def _refuse(self, error: SetpointError, previous_mode: str) -> None:
        if self.mode != previous_mode:
            # Damping continues.
            self.mode = previous_mode
            self._reference.track_links(self.angles)
        self.refused += 1
        self.last_refusal = str(error)

    def _check_driving(self) -> None:
        if not self._armed or self.mode == 'disarmed' or self._stamp_ns is None:
            raise SetpointError('the device is not armed: arm it first', name='armed')
        if not self._enabled:
            raise SetpointError('the controller is not enabled: enable it first', name='enabled')
        if self.mode == 'idle':
            raise SetpointError(self.problem or 'the controller is idle', name='idle')
        if (self.wheels.fault_states == SHORTED).any():
            raise SetpointError(self.problem, name='shorted')

    def _check_stamp(self, stamp_ns: int) -> None:
        assert self._stamp_ns is not None
        age = (self._stamp_ns - stamp_ns) * 1e-9
        if stamp_ns and abs(stamp_ns - self._stamp_ns) > SETPOINT_TIMEOUT * 1e9:
            raise SetpointError(
                f'stamp is {age:.3f} s before the last tick, limit {SETPOINT_TIMEOUT:g} s either '
                'way', name='stamp', value=age, limit=SETPOINT_TIMEOUT)

    def _compile(self) -> None:
        """Compile the kernels now, and not while time runs."""
        square, none = np.array([0.0, pi / 2.0, 0.0, pi / 2.0]), np.zeros(4)
        self._reference.rest_at(square)
        self.law.update(self._reference, square, none, none[:2], none, none, 0.0)
        self.wheels.reset()
        for by_speed in (False, True):
            command = WheelCommand(none, by_speed, ALL)
            for _ in range(2):
                self.wheels.update(1e-3, command, none, none, none)
            self.wheels.restart(command, none, none, none)
            self._commander.command(none, none, none, ALL, 1e-3, by_speed)
        self.wheels.reset()
        self.momentum.update(1e-3, none, none, none)
        self.momentum.reset(none)
        self._commander.update_friction(none, 0.0, 0.0)
        self._cost.add(0.0, none, none, none)
        step = SoftStep(np.zeros((3, 2)), np.zeros(2), 1.0)
        set_pairs(step.at(0.5), PARALLELOGRAM.paired_links, np.zeros(2), np.zeros((3, 4)))
        # Not by `check_needs`: not every linkage closes with all angles the same.
        times = step.instants(2)
        branch = self._reference.branch or PARALLELOGRAM
        loads_along(self.mechanism, Path(
            times, np.tile(square, (2, 1)), step.sample(times)[:, 1:], self._reference.paired,
            branch.paired_links), self.law.allocation, none)
