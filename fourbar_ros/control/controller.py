# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The controller: estimates and setpoints in, wheel commands out, one set per tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, pi, sin

from fourbar_ros.control.actuation_cost import Accounts, LONGEST_PERIOD
from fourbar_ros.control.branch import Branch, LINKS_ALONE
from fourbar_ros.control.branch_selection import choose
from fourbar_ros.control.feasibility import (
    check_needs,
    shortest_duration,
    wheel_loads,
    Wheels,
)
from fourbar_ros.control.momentum_margin import MomentumMonitor
from fourbar_ros.control.reference_generator import ReferenceGenerator
from fourbar_ros.control.setpoint import check_names, follow, SetpointError
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

MODES = ('disarmed', 'idle', 'damp', 'hold', 'track')
"""
What the controller does: nothing, since the device is not armed, or since it was told so; stop all
rates; hold where the links are; follow a move.
"""

# A setpoint with a stamp (not zero, which means now) may be this far from the last tick [s].
SETPOINT_TIMEOUT = 1.0

# How soon joints count as sticking when the reference rests, and as sliding when it moves [s].
TO_STICK, TO_SLIDE = 0.3, 0.05

# A period that differs by more than this share from that for which gains were checked is new.
SAME_PERIOD = 0.05

# So many periods in a row of more than one tick are a slower loop, and no losses.
LOST_IN_A_ROW = 10

# Of what the law may share out, a plan may use so much; the rest is for errors.
PLANNED = 0.9

ALL = np.ones(4, dtype=bool)


@dataclass(frozen=True, eq=False)
class Control:
    """
    What the controller does at a tick.

    :param stamp_ns: the tick [ns].
    :param command: what the wheels are told.
    :param torques: (4,) that shall act on the wheels, bearings apart [N m].
    :param reference_angles, reference_rates: (4,) of the links [rad], [rad/s].
    :param angle_errors, rate_errors: (4,) reference minus estimate [rad], [rad/s].
    :param energies: (4,) see accounts.
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
    Computed-torque tracking of the linkage, shared by four wheels.

    Until the device is armed, and after each disarm, the reference is the present estimate, the
    torques are zero and there is no goal.

    :ivar settings: as they are; changed by :meth:`tune`.
    :ivar mode: one of `MODES`.
    :ivar accepted, refused: number of setpoints and trajectories.
    :ivar last_refusal: why the last one was refused, or ''.
    :ivar problem: what stopped a manoeuvre, or keeps the controller from driving, or ''.
    :ivar saturated: number of ticks at which the motors could not give what was asked.
    :ivar law, momentum, wheels: its parts, to be looked at.
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
        self._guide = ReferenceGenerator(mechanism)
        self._drive = WheelCommander(mechanism)
        self._accounts = Accounts(mechanism)
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
        self._lost = 0
        self._unknown = False
        self._gain_problem = ''
        self._bearings = _bearings_of(settings)
        self.law.tune(settings, ALL)
        self._compile()

    @property
    def goal(self) -> Array | None:
        """Last accepted goal of the links (4,) [rad], None without one."""
        return self._guide.goal

    @property
    def branch(self) -> str:
        """The branch of the reference: `parallelogram`, `folded`, `crossed` or `open`."""
        branch = self._guide.branch
        return branch_of(self._guide.angles) if branch is None else branch.name

    def tune(self, settings: ControllerSettings) -> None:
        """
        Take over settings; a move under way keeps its duration.

        :raises GainError: they are not stable at the rate at which it runs; nothing changes.
        :raises AllocationError: there is no such allocation; nothing changes.
        """
        if self._checked_period:
            check_gains(settings, self.mechanism, self._checked_period)
        self.law.tune(settings, self.wheels.usable)
        self.settings, self._gain_problem = settings, ''
        self._bearings = _bearings_of(settings)

    def device_armed(self, armed: bool) -> None:
        """Follow the device's arming state."""
        self._armed = armed

    def enable(self, enabled: bool) -> None:
        """Drive the wheels when armed, from the next tick on; or leave them alone."""
        if enabled and not self._enabled and self._armed:
            # What they did while nobody drove them says nothing.
            self._forget_wheels()
            self.mode = 'damp'
            self._hold()
        self._enabled = enabled

    def hold(self) -> None:
        """
        Come to rest and stay there.

        :raises SetpointError: nothing can be held now, and why.
        """
        self._check_driving()
        self._hold()

    def damp(self) -> None:
        """
        Stop all rates, wherever that ends.

        :raises SetpointError: nothing can be stopped now, and why.
        """
        self._check_driving()
        self.mode, self._guide.goal = 'damp', None

    def setpoint(self, names: Sequence[str], positions: Sequence[float], stamp_ns: int = 0
                 ) -> None:
        """
        Accept a new goal, to be reached by a soft step that starts at the next tick.

        :param names: any of the four links; one that is not named follows or holds.
        :param positions: goal angle of each [rad].
        :param stamp_ns: when it was given, 0 for now [ns].
        :raises SetpointError: it is refused whole, and nothing changes; also counted.
        """
        was = self.mode
        try:
            goals = check_names(names, positions)
            self._check_driving()
            self._check_stamp(stamp_ns)
            self._leave_damping()
            chosen = choose(self.mechanism, goals, self._guide, self.settings.setpoint_duration,
                            self.settings.change_points)
            step, present, branch = chosen.step, chosen.present, chosen.branch
            if self.settings.setpoint_timing == 'shortest':
                step = self._shortest(step, present, branch)
            else:
                check_needs(self.mechanism, step, present, self._wheels_after(step.duration),
                            crossing=self._crossing, branch=branch)
        except SetpointError as error:
            self._refuse(error, was)
            raise
        if branch is not None and branch != self._guide.branch:
            self._guide.change_to(branch)
        self._accept(step, chosen.goal)

    def trajectory(self, names: Sequence[str], points: Sequence[Point], stamp_ns: int = 0
                   ) -> None:
        """
        Accept a motion through several points, to start at the next tick.

        :param names: of the links that the points are about.
        :param points: see trajectory.
        :param stamp_ns: when it shall start, 0 for now [ns].
        :raises SetpointError: it is refused whole, and nothing changes; also counted.
        """
        was = self.mode
        try:
            self._check_driving()
            self._check_stamp(stamp_ns)
            self._leave_damping()
            guide, crossing = self._guide, self._crossing
            way, goal = read_trajectory(
                self.mechanism, names, points, guide.motion.copy(), guide.angles,
                guide.destination, crossing=crossing, branch=guide.branch)
            check_needs(self.mechanism, way, guide.angles, self._wheels_after(way.duration),
                        crossing=crossing, branch=guide.branch)
        except SetpointError as error:
            self._refuse(error, was)
            raise
        self._accept(way, goal)

    def tick(self, stamp_ns: int, link_angles: Array, link_rates: Array, disturbance: Array,
             wheel_speeds: Array, efforts: Array, *, late: bool = False) -> Control:
        """
        Decide on the commands for one tick.

        :param link_angles: (4,) estimated [rad].
        :param link_rates: (4,) estimated [rad/s].
        :param disturbance: (2,) estimated torques on links a and b besides those of the wheels
            [N m].
        :param wheel_speeds: (4,) measured, relative to the links [rad/s].
        :param efforts: (4,) torques really applied since the last tick [N m].
        :param late: whether the tick comes so late that nobody knows when the answer will act.
        """
        if self._last is not None and self._last.stamp_ns == stamp_ns:
            # A lock-step sends a tick again when its answer was lost.
            return self._last
        period = self._measure_period(stamp_ns)
        self.speeds, self.angles, self.rates = wheel_speeds, link_angles, link_rates
        was = self.mode
        self._change_mode()
        guide, driving = self._guide, self.mode not in ('disarmed', 'idle')
        friction = self._drive.look(wheel_speeds, self.settings)
        if driving and was not in ('disarmed', 'idle'):
            # The first period of which the command is known begins at the second tick in time, and
            # after a gap the first speeds are means of all of it.
            unknown = late or not self._is_single(period)
            self._watch(period, not (unknown or self._unknown), link_rates, wheel_speeds, efforts)
            self._unknown = unknown
        if guide.follow(stamp_ns) and self.mode == 'track':
            self.mode = 'hold'
        if not driving or self.mode == 'damp':
            guide.stand_at(link_angles)
        self._stick(period)
        found = self.law.decide(
            guide, link_angles, link_rates, disturbance, wheel_speeds, friction, self._sticking
            if self.settings.rest_band > 0.0 else 0.0)
        self.momentum.look(period, wheel_speeds, found.planned, guide.accelerations)
        if driving and not self._out_of_hold(link_angles):
            self.saturated += found.scale < 1.0
            torques = found.torques.copy()
            self._command = self._drive.command(
                torques, guide.accelerations, wheel_speeds, self.wheels.usable, self._period,
                self.settings.command == 'velocity')
        else:
            torques = np.zeros(4)
            self._drive.begin(wheel_speeds)
            self._command = WheelCommand(np.zeros(4), False, self.wheels.usable)
        self._accounts.book(period, link_rates, wheel_speeds, efforts)
        self._last = Control(
            stamp_ns, self._command, torques, guide.angles.copy(), guide.rates.copy(),
            guide.angles - link_angles, guide.rates - link_rates,
            self._accounts.energies.copy())
        return self._last

    @property
    def _crossing(self) -> bool:
        return self.settings.change_points != 'avoid'

    @property
    def _choosing(self) -> bool:
        return self.settings.change_points == 'choose'

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
        # A tick that got lost makes a period of twice the length, and no new rate.
        if whole and abs(period - whole * known) <= SAME_PERIOD * period:
            self._lost = 0 if whole == 1 else self._lost + 1
        else:
            self._lost = LOST_IN_A_ROW
        if self._lost >= LOST_IN_A_ROW:
            self._checked_period, self._lost = period, 0
            try:
                check_gains(self.settings, self.mechanism, period)
                self._gain_problem = ''
            except GainError as error:
                self._gain_problem = str(error)
        return period if period <= LONGEST_PERIOD else 0.0

    def _change_mode(self) -> None:
        was = self.mode
        if not self._armed:
            self.mode = 'disarmed'
        elif was == 'disarmed':
            self._forget_wheels()
            self._accounts.begin()
            self.momentum.begin(self.speeds)
            self.problem = ''
            self.mode = 'hold'
        if self.mode != 'disarmed' and (not self._enabled or self._gain_problem):
            self.mode, self.problem = 'idle', self._gain_problem
        elif self.mode == 'idle':
            self.mode, self.problem = 'hold', ''
        if self.mode == 'hold' and was in ('disarmed', 'idle'):
            self._guide.begin(self.angles, choosing=self._choosing)
            self._drive.begin(self.speeds)
            self._forget_wheels()
        elif self.mode in ('disarmed', 'idle'):
            self._guide.begin(self.angles, choosing=self._choosing)

    def _forget_wheels(self) -> None:
        """Think well of all wheels again, and share among all."""
        self.wheels.begin()
        self.law.tune(self.settings, self.wheels.usable)

    def _is_single(self, period: float) -> bool:
        """Tell whether no tick was missed since the last one."""
        return 0.0 < period < 1.5 * self._checked_period

    def _watch(self, period: float, known: bool, link_rates: Array, speeds: Array,
               efforts: Array) -> None:
        """Look at the wheels; take out of the allocation which cannot be used any more."""
        command = self._command
        if not known:
            self.wheels.lose(command.values, command.by_speed, speeds, link_rates, efforts)
            return
        if not self.wheels.look(
                period, command.values, command.by_speed, command.powered, speeds, link_rates,
                efforts, self._bearings):
            return
        if (self.wheels.verdicts == SHORTED).any():
            wheel = int(np.argmax(self.wheels.verdicts == SHORTED))
            self.problem = (f'{FLYWHEEL_NAMES[wheel]} runs away and cannot be cut: press the '
                            'emergency stop')
            self.mode, self._guide.goal = 'damp', None
        usable = self.wheels.usable
        if (usable == self.law.usable).all():
            return
        self.law.tune(self.settings, usable)
        lost = self.law.lost_axes()
        if lost:
            broken = [name for name, use in zip(FLYWHEEL_NAMES, usable) if not use]
            self.problem = (f'axis {" and ".join(lost)} is lost: {", ".join(broken)} cannot be '
                            'used')
            self._hold()
        elif self._guide.moving and self.mode == 'track':
            self._go_on()

    def _go_on(self) -> None:
        """Take as much longer for a move as the wheels that are left need."""
        guide, goal = self._guide, self._guide.goal
        if goal is None or self._stamp_ns is None:
            return
        left = guide.time_left(self._stamp_ns)
        try:
            shortest = shortest_duration(
                self.mechanism, guide.motion.copy(), goal[guide.axes], guide.angles,
                self._wheels_after(0.0), crossing=self._crossing,
                branch=guide.branch)
            if shortest > left:
                move = SoftStep(guide.motion.copy(), goal[guide.axes], shortest)
                follow(self.mechanism, move, guide.angles, crossing=self._crossing,
                       branch=guide.branch)
                guide.go(move, goal, self._stamp_ns)
        except SetpointError as error:
            self.problem = f'the wheels that are left cannot go on: {error}'
            self._hold()

    def _stick(self, period: float) -> None:
        resting = not self._guide.moving and self.mode == 'hold'
        goes_to, time = (1.0, TO_STICK) if resting else (0.0, TO_SLIDE)
        self._sticking += (1.0 - exp(-period / time)) * (goes_to - self._sticking)

    def _out_of_hold(self, angles: Array) -> bool:
        """Tell whether the reduced form does not exist here: the wheels coast through it."""
        return not self._guide.paired and abs(sin(angles[3] - angles[2])) < TORQUE_CUTOFF

    def _wheels_after(self, duration: float) -> Wheels:
        """Return the wheels as they are, and what their drift takes in a time [s]."""
        speeds = self.speeds + self.momentum.drift * min(duration, 60.0) * (
            np.sign(self.momentum.drift) == np.sign(self.speeds))
        friction = np.full(4, self.settings.bearing_coulomb)
        return Wheels(speeds, self.law.mobilities, friction, PLANNED * self.law.share)

    def _shortest(self, move: SoftStep, present: Array, branch: Branch | None) -> SoftStep:
        duration = shortest_duration(
            self.mechanism, move.start, move.goal, present, self._wheels_after(0.0),
            crossing=self._crossing, branch=branch)
        shortest = SoftStep(move.start, move.goal, duration)
        follow(self.mechanism, shortest, present, crossing=self._crossing, branch=branch)
        return shortest

    def _leave_damping(self) -> None:
        """Begin from the links as they move, where there is no reference that moves."""
        if self.mode == 'damp':
            self._hold()

    def _hold(self) -> None:
        if self._stamp_ns is None:
            return
        if self.mode == 'damp':
            self._guide.move_from(
                self.angles, self.rates, self._stamp_ns, choosing=self._choosing)
        else:
            self._guide.halt(self._stamp_ns)
            self._guide.goal = None
        self.mode = 'hold'

    def _accept(self, way: TrajectorySegment, goal: Array) -> None:
        assert self._stamp_ns is not None
        self._guide.go(way, goal, self._stamp_ns)
        self.mode, self.problem = 'track', ''
        self.accepted += 1

    def _refuse(self, error: SetpointError, was: str) -> None:
        if self.mode != was:
            # It goes on to damp.
            self.mode = was
            self._guide.stand_at(self.angles)
        self.refused += 1
        self.last_refusal = str(error)

    def _check_driving(self) -> None:
        if not self._armed or self.mode == 'disarmed' or self._stamp_ns is None:
            raise SetpointError('the device is not armed')
        if not self._enabled:
            raise SetpointError('the controller is not enabled')
        if self.mode == 'idle':
            raise SetpointError(self.problem or 'the controller is idle')
        if (self.wheels.verdicts == SHORTED).any():
            raise SetpointError(self.problem)

    def _check_stamp(self, stamp_ns: int) -> None:
        assert self._stamp_ns is not None
        if stamp_ns and abs(stamp_ns - self._stamp_ns) > SETPOINT_TIMEOUT * 1e9:
            raise SetpointError(
                f'stamp is {(self._stamp_ns - stamp_ns) * 1e-9:.3f} s before the last tick, limit '
                f'{SETPOINT_TIMEOUT:g} s either way')

    def _compile(self) -> None:
        """Compile the kernels now, not while time runs."""
        square, none = np.array([0.0, pi / 2.0, 0.0, pi / 2.0]), np.zeros(4)
        self._guide.begin(square)
        self.law.decide(self._guide, square, none, none[:2], none, none, 0.0)
        self.wheels.begin()
        for by_speed in (False, True):
            for _ in range(2):
                self.wheels.look(1e-3, none, by_speed, ALL, none, none, none, none[:2])
            self.wheels.lose(none, by_speed, none, none, none)
            self._drive.command(none, none, none, ALL, 1e-3, by_speed)
        self.wheels.begin()
        self.momentum.look(1e-3, none, none, none)
        self.momentum.begin(none)
        self._drive.look(none, self.settings)
        self._accounts.book(0.0, none, none, none)
        move = SoftStep(np.zeros((3, 2)), np.zeros(2), 1.0)
        move.at(0.5)
        # Not by `check_needs`: not every linkage closes with all angles the same.
        times = move.instants(2)
        wheel_loads(
            times, np.tile(square, (2, 1)), move.sample(times)[:, 1:], self._guide.paired,
            LINKS_ALONE, self.law.mobilities, np.array([self.mechanism.constants]))


def _bearings_of(settings: ControllerSettings) -> Array:
    return np.array([settings.bearing_coulomb, settings.bearing_viscous])
