# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Fault detection and isolation for the wheels, from commands, measured speeds and efforts.

A model of a healthy wheel runs beside each wheel under the same commands. The residual is the
measured speed less that of the model. A residual beyond its threshold for several ticks means
that the wheel is broken; the effort that the motor reports and the resulting change of momentum
isolate the fault. Degradation, with which a wheel is still usable, shows as torque that is lost
between command and effort, or between effort and acceleration, or as a delay of the motor.
"""

from __future__ import annotations

from math import copysign, exp, inf, nan
from typing import NamedTuple

from fourbar_ros.control.records import Fields, Record, records
from fourbar_ros.control.wheel_command import WheelCommand
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.motors import (
    available_torque,
    lagged_torque,
    Motors,
    motors_of,
    SPEED_BANDWIDTH,
    speed_loop,
)
import numpy as np
from numpy.typing import NDArray

# Fault states of a wheel; arrays hold the index. From `dead` on a wheel is not used any more.
FAULT_STATES = ('healthy', 'degraded', 'dead', 'stuck', 'runaway', 'shorted')

HEALTHY, DEGRADED, DEAD, STUCK, RUNAWAY, SHORTED = range(len(FAULT_STATES))

# Detection of a broken wheel

# Largest residual of a healthy wheel [rad/s].
RESIDUAL_LIMIT = 2.5

# Consecutive ticks beyond the limit after which a wheel is not healthy.
RESIDUAL_TICKS = 4

# Extra residual [rad/s] of a motor that was near its limit within this time [s].
#
# The speed loop in its electronics is known less well at the limit.
STRAINED_ALLOWANCE, STRAINED_RECENTLY = 10.0, 0.3

# Extra residual [rad/s] of a slow wheel under torque commands, which static friction holds back.
#
# Its model is led back to the wheel with this time constant [s].
SLOW_ALLOWANCE, SLOW_RESET = 1.5, 2.0

# Time constants of the means for a broken and for a degraded wheel [s].
MEAN_TIME, LONG_MEAN_TIME = 0.02, 0.5

# Time constants for learning the usual friction loss, and for leading models back [s].
#
# Models of a wheel and of its speed loop drift, since they integrate errors. The slow one applies
# to a loss that is already half of what is reported.
LEARNING_TIME, SLOW_LEARNING_TIME = 5.0, 30.0

# Thresholds as shares of the torque limit, or of FRICTIONS times the Coulomb friction if larger.

# Smallest mean effort at which degradation is judged.
FRICTIONS = 50.0
MIN_EFFORT = 0.04

# Increase of the friction loss that is degradation.
FRICTION_LOSS = 8e-4

# Largest effort of a motor that gives none.
NO_TORQUE = 2e-3

# Effort beyond the expected from which a wheel is called runaway.
UNCOMMANDED = 0.04

# Lost torque from which a wheel is called stuck.
BRAKED = 0.1

# Thresholds as shares of the expected torque.

# Largest effort of a dead motor.
DEAD_SHARE = 0.15

# Torque that a healthy motor may lack under torque and under speed commands.
#
# A replica of the motor's speed loop is less exact, since it sees the speed less often.
MISSING, MISSING_BY_SPEED = 0.2, 0.25

# Share by which the inertia of a wheel may be wrong in the model.
INERTIA_ERROR = 0.06

# Thresholds of a delayed motor

# Mean residual of a delayed wheel under speed commands [rad/s].
DELAY_RESIDUAL = 0.35

# Under torque commands, ratio of mean squared errors without delay and with the best delay.
#
# The error without delay must also exceed this share of the torque limit.
DELAY_RATIO, DELAY_VISIBLE = 4.0, 5e-4

# First delay hypothesis [ticks], and number of ticks that are kept.
FIRST_DELAY, DELAYS = 3, 32

# Conditions

# Time for which degradation must last before it is reported [s].
DEGRADED_TIME = 0.5

# Degradation is not judged above this share of the torque limit, nor for this time after [s].
STRAINED, STRAINED_PAUSE = 0.5, 2.0

# Degradation is not judged for this time after another wheel broke [s].
#
# The others then give torques that they never gave before.
BROKEN_PAUSE = 3.0

# Friction is judged above this speed [rad/s], held for this time [s].
MIN_SPEED, MIN_SPEED_TIME = 5.0, 0.8

# Largest speed of a wheel that stands still although it is driven [rad/s].
STANDING = 1.0

# Time after the power cut in which a wheel must be undriven [s]; a shorted one is not.
CUT_TIME = 0.15

# Models

# Assumed period of the speed loop in the motor's electronics [s].
LOOP_STEP = 5e-4

# Longest integration step of the model [s].
MODEL_STEP = 1e-3

# Fields of the record of a control period.
SAMPLE_FIELDS: Fields = [
    ('period', float, ()),              # s
    ('commands', float, (4,)),          # N m or rad/s
    ('by_speed', np.int64, ()),         # 1 for speeds, 0 for torques
    ('powered', np.int64, (4,)),        # 1 for a wheel with power
    ('speeds', float, (4,)),            # rad/s, relative to the links, mean of the period
    ('link_rates', float, (4,)),        # rad/s, at its end
    ('efforts', float, (4,)),           # N m, reported by the motors, mean of the period
    ('coulomb', float, ()),             # N m, of the bearings
    ('viscous', float, ()),             # N m s
]

# Fields of the record of a wheel.
WHEEL_FIELDS: Fields = [
    ('model_speed', float, ()),         # rad/s
    ('model_torque', float, ()),        # N m
    ('model_integral', float, ()),      # N m, of its speed loop
    ('last_speed', float, ()),          # rad/s
    ('last_link_rate', float, ()),      # rad/s
    ('residual_ticks', float, ()),      # consecutive ticks beyond the limit
    # Means with MEAN_TIME:
    ('effort', float, ()),              # N m, reported
    ('expected', float, ()),            # N m, of the model
    ('inertial', float, ()),            # N m, change of the wheel's momentum
    # Means with LONG_MEAN_TIME:
    ('long_effort', float, ()),
    ('long_expected', float, ()),
    ('long_inertial', float, ()),
    ('long_residual', float, ()),       # rad/s
    ('loss', float, ()),                # N m, of effort, beyond the known friction
    # Learnt with LEARNING_TIME:
    ('usual_loss', float, ()),          # N m
    ('usual_inertial', float, ()),      # N m, at which it was learnt, along the speed
    ('loss_known', float, ()),          # 1 once there is a usual loss
    ('replica_integral', float, ()),    # N m, of the replica of the motor's speed loop
    ('replica_torque', float, ()),      # N m
    # Times of conditions:
    ('degraded_time', float, ()),       # s, negative in a pause
    ('turning_time', float, ()),        # s, above MIN_SPEED
    ('cut_time', float, ()),            # s, without power
    ('unstrained_time', float, ()),     # s
    ('asked', float, (DELAYS,)),        # N m, torques asked for, newest first
    ('delay_errors', float, (DELAYS,)),  # N^2 m^2, mean squares of effort less these
    ('state', np.int64, ()),            # index of FAULT_STATES
]


class _Observation(NamedTuple):
    """
    A wheel in a control period.

    :param residual: measured speed less that of the model [rad/s].
    :param gained: change of its speed [rad/s].
    :param inertial: change of its momentum per time [N m].
    :param expected: torque of the model [N m].
    :param scale: reference of the thresholds [N m].
    :param long: share by which long means follow.
    """

    residual: float
    gained: float
    inertial: float
    expected: float
    scale: float
    long: float


class WheelFaultDetector:
    """
    Detects and isolates faults of the four wheels.

    :param mechanism: the model of the linkage, its wheels and motors.
    :ivar usable: (4,) bool, wheels that can be driven; a new array when that changes.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.usable = np.ones(4, dtype=bool)
        self._motors = np.array([motors_of(mechanism)])
        self._sample = records(SAMPLE_FIELDS)
        self._wheels = records(WHEEL_FIELDS, 4)
        self._started = False

    @property
    def fault_states(self) -> NDArray[np.int64]:
        """Fault state of each wheel (4,), as index of `FAULT_STATES`."""
        states: NDArray[np.int64] = self._wheels['state']
        return states

    def tune(self, bearing_coulomb: float, bearing_viscous: float) -> None:
        """Set the friction of the bearings of the model [N m], [N m s]."""
        self._sample['coulomb'], self._sample['viscous'] = bearing_coulomb, bearing_viscous

    def reset(self) -> None:
        """Take all wheels for healthy, and forget everything about them."""
        self._wheels['state'] = HEALTHY
        self.usable = np.ones(4, dtype=bool)
        self._started = False

    def update(self, period: float, command: WheelCommand, speeds: Array, link_rates: Array,
               efforts: Array) -> bool:
        """
        Evaluate a control period.

        :param period: its length [s].
        :param command: in force during it.
        :param speeds: (4,) measured, relative to the links, mean of the period [rad/s].
        :param link_rates: (4,) of the links at its end [rad/s].
        :param efforts: (4,) reported by the motors, mean of the period [N m].
        :returns: whether a fault state has changed.
        """
        self._fill(period, command, speeds, link_rates, efforts)
        if not self._started:
            _start(self._sample, self._wheels)
            self._started = True
            return False
        changed = detect(self._sample, self._motors, self._wheels)
        if changed:
            self.usable = self.fault_states < DEAD
        return bool(changed)

    def restart(self, command: WheelCommand, speeds: Array, link_rates: Array, efforts: Array
                ) -> None:
        """
        Restart the models from the measured wheels; fault states stay.

        For a period with an unknown command, or one that was not observed.

        :param command: now in force.
        :param speeds, link_rates, efforts: see :meth:`update`.
        """
        if self._started:
            self._fill(0.0, command, speeds, link_rates, efforts)
            _restart(self._sample, self._motors, self._wheels)

    def faults(self) -> dict[str, str]:
        """Return the fault states by the name of the wheel, of wheels that are not healthy."""
        return {name: FAULT_STATES[state] for name, state in zip(
            FLYWHEEL_NAMES, self.fault_states.tolist()) if state}

    def _fill(self, period: float, command: WheelCommand, speeds: Array, link_rates: Array,
              efforts: Array) -> None:
        _fill_sample(self._sample, period, command.values, command.by_speed, command.powered,
                     speeds, link_rates, efforts)


@kernel
def _fill_sample(samples: NDArray[np.record], period: float, commands: Array, by_speed: bool,
                 powered: NDArray[np.bool_], speeds: Array, link_rates: Array, efforts: Array
                 ) -> None:
    sample = samples[0]
    sample.period, sample.by_speed = period, by_speed
    for j in range(4):
        sample.commands[j], sample.powered[j] = commands[j], powered[j]
        sample.speeds[j], sample.link_rates[j], sample.efforts[j] = (
            speeds[j], link_rates[j], efforts[j])


@kernel
def _start(samples: NDArray[np.record], wheels: NDArray[np.record]) -> None:
    sample = samples[0]
    for j in range(4):
        wheel = wheels[j]
        wheel.model_speed = wheel.last_speed = sample.speeds[j]
        wheel.last_link_rate, wheel.unstrained_time = sample.link_rates[j], STRAINED_PAUSE
        wheel.model_integral = wheel.replica_integral = nan
        wheel.model_torque = wheel.residual_ticks = 0.0
        wheel.effort = wheel.expected = wheel.inertial = 0.0
        wheel.long_effort = wheel.long_expected = wheel.long_inertial = 0.0
        wheel.long_residual = wheel.loss = 0.0
        wheel.usual_loss = wheel.usual_inertial = wheel.loss_known = wheel.replica_torque = 0.0
        wheel.degraded_time = wheel.turning_time = wheel.cut_time = 0.0
        wheel.asked[:], wheel.delay_errors[:] = 0.0, 0.0


@kernel
def _restart(samples: NDArray[np.record], packed: NDArray[np.record], wheels: NDArray[np.record]
             ) -> None:
    sample, motors = samples[0], packed[0]
    for j in range(4):
        wheel, effort = wheels[j], sample.efforts[j]
        wheel.model_speed = wheel.last_speed = sample.speeds[j]
        wheel.last_link_rate = sample.link_rates[j]
        wheel.model_torque = wheel.expected = wheel.effort = wheel.inertial = effort
        wheel.residual_ticks = wheel.unstrained_time = 0.0
        wheel.model_integral = wheel.replica_integral = nan
        if sample.by_speed:
            # The integral of the motor's speed loop is the effort beyond its proportional part.
            limit = motors.torque_limit[j]
            integral = effort - SPEED_BANDWIDTH * motors.inertia[j] * (
                sample.commands[j] - sample.speeds[j])
            wheel.model_integral = min(max(integral, -limit), limit)


@kernel
def detect(samples: NDArray[np.record], packed: NDArray[np.record], wheels: NDArray[np.record]
           ) -> bool:
    """
    Update the wheels, see :meth:`WheelFaultDetector.update`.

    :param samples: (1,) of `SAMPLE_FIELDS`.
    :param packed: (1,) of the motors.
    :param wheels: (4,) of `WHEEL_FIELDS`.
    """
    sample, motors, changed, period = samples[0], packed[0], False, samples[0].period
    short, long = 1.0 - exp(-period / MEAN_TIME), 1.0 - exp(-period / LONG_MEAN_TIME)
    # Where no motor gives any torque, the device does not drive: commands are late, or it was
    # disarmed and that is not known here yet. That is no fault of a wheel.
    driving = broke = False
    for j in range(4):
        driving |= sample.powered[j] != 0 and abs(
            sample.efforts[j]) > NO_TORQUE * _scale(j, sample, motors)
    for j in range(4):
        wheel, before = wheels[j], wheels[j].state
        inertia, limit = motors.inertia[j], motors.torque_limit[j]
        scale = _scale(j, sample, motors)
        speed, turned = sample.speeds[j], sample.link_rates[j] - wheel.last_link_rate
        gained = speed - wheel.last_speed
        inertial = inertia * (gained + turned) / period
        wheel.last_speed, wheel.last_link_rate = speed, sample.link_rates[j]
        wheel.effort += short * (sample.efforts[j] - wheel.effort)
        wheel.inertial += short * (inertial - wheel.inertial)
        if not sample.powered[j]:
            _follow_undriven(wheel, speed)
            wheel.cut_time += period
            if wheel.state == RUNAWAY and wheel.cut_time > CUT_TIME:
                # Friction brakes the wheel: anything else is a drive.
                if (abs(speed) > MIN_SPEED
                        and copysign(1.0, speed) * wheel.inertial > UNCOMMANDED * scale
                        or abs(wheel.effort) > UNCOMMANDED * scale):
                    wheel.state = SHORTED
            changed |= wheel.state != before
            continue
        wheel.cut_time = 0.0
        if not driving:
            _follow_undriven(wheel, speed)
            continue
        expected, residual = _run_model(j, wheel, sample, turned, motors)
        wheel.expected += short * (expected - wheel.expected)
        wheel.unstrained_time += period
        if max(abs(wheel.effort), abs(wheel.expected)) > STRAINED * limit:
            wheel.unstrained_time = 0.0
        allowed = RESIDUAL_LIMIT + (
            STRAINED_ALLOWANCE if wheel.unstrained_time < STRAINED_RECENTLY else 0.0)
        if not sample.by_speed and abs(speed) < MIN_SPEED:
            allowed += SLOW_ALLOWANCE
        wheel.residual_ticks = wheel.residual_ticks + 1.0 if abs(residual) > allowed else 0.0
        if wheel.residual_ticks >= RESIDUAL_TICKS:
            wheel.state = max(before, _isolate(wheel, speed, scale, sample))
            wheel.model_speed, wheel.residual_ticks = speed, 0.0
        if wheel.state == HEALTHY and _is_degraded(
                j, wheel, sample, _Observation(residual, gained, inertial, expected, scale, long),
                motors):
            wheel.state = DEGRADED
        changed |= wheel.state != before
        broke |= before < DEAD <= wheel.state
    if broke:
        for j in range(4):
            wheels[j].degraded_time = -BROKEN_PAUSE
    return changed


@kernel
def _scale(j: int, sample: Record, motors: Motors) -> float:
    """Return the reference of the thresholds [N m]."""
    return float(max(motors.torque_limit[j], FRICTIONS * sample.coulomb))


@kernel
def _follow_undriven(wheel: Record, speed: float) -> None:
    """Let the model follow a wheel that is not driven."""
    wheel.model_speed, wheel.model_torque, wheel.expected = speed, 0.0, 0.0
    wheel.model_integral = wheel.replica_integral = nan
    wheel.residual_ticks = wheel.degraded_time = wheel.turning_time = 0.0


@kernel
def _run_model(j: int, wheel: Record, sample: Record, turned: float, motors: Motors
               ) -> tuple[float, float]:
    """
    Advance the model of a healthy wheel by the period.

    :param turned: change of the link's rate [rad/s].
    :returns: its mean torque [N m], and the residual against its mean speed [rad/s].
    """
    inertia, period, command = motors.inertia[j], sample.period, sample.commands[j]
    coulomb, viscous, speed = sample.coulomb, sample.viscous, sample.speeds[j]
    steps = int(period / MODEL_STEP) + 1
    h = period / steps
    model, torque = wheel.model_speed, wheel.model_torque
    total = mean_speed = 0.0
    for _ in range(steps):
        asked = command
        if sample.by_speed:
            asked, wheel.model_integral = speed_loop(
                j, command, model, wheel.model_integral, h, motors)
        mean, torque = lagged_torque(
            j, torque, available_torque(j, asked, model, motors), h, motors)
        free = model + h * mean / inertia - turned * h / period
        # Dry friction cannot do more than stop the wheel.
        left = abs(free) * (1.0 - h * viscous / inertia) - h * coulomb / inertia
        after = copysign(max(left, 0.0), free)
        total += mean / steps
        mean_speed += 0.5 * (model + after) / steps
        model = after
    residual = speed - mean_speed
    if not sample.by_speed:
        model += residual * period / (LEARNING_TIME if abs(speed) > MIN_SPEED else SLOW_RESET)
    wheel.model_speed, wheel.model_torque = model, torque
    return total, residual


@kernel
def _isolate(wheel: Record, speed: float, scale: float, sample: Record) -> int:
    """Return the fault state of a wheel with a large residual."""
    effort, expected, coulomb = wheel.effort, wheel.expected, sample.coulomb
    nothing = NO_TORQUE * scale
    if (abs(effort) < DEAD_SHARE * abs(expected) + nothing
            and abs(effort - expected) > 2.0 * nothing):
        return DEAD
    friction = (copysign(coulomb, speed) + sample.viscous * speed
                if abs(speed) > STANDING else 0.0)
    lost = effort - friction - wheel.inertial
    if abs(lost) > max(5.0 * coulomb, BRAKED * scale) or (
            abs(speed) < STANDING and abs(effort) > 1.5 * coulomb + nothing
            and abs(lost) > 0.5 * abs(effort)):
        return STUCK
    uncommanded = abs(effort - expected) > UNCOMMANDED * scale + 0.5 * abs(expected)
    if uncommanded and (effort * expected < 0.0 or abs(effort) > 1.3 * abs(expected)):
        return RUNAWAY
    if (abs(effort - expected) <= MISSING * abs(expected) + nothing
            and abs(lost) <= FRICTION_LOSS * scale + INERTIA_ERROR * abs(wheel.inertial)):
        # The model drifted by no more than a wrong inertia explains.
        return HEALTHY
    return DEGRADED


@kernel
def _is_degraded(j: int, wheel: Record, sample: Record, observation: _Observation,
                 motors: Motors) -> bool:
    """Return whether a wheel has lacked torque or acted late for long enough."""
    scale, long, period = observation.scale, observation.long, sample.period
    speed, effort, expected = sample.speeds[j], sample.efforts[j], observation.expected
    if sample.by_speed:
        seen = speed - 0.5 * observation.gained * LOOP_STEP / period
        expected = _run_replica(j, wheel, sample, seen, motors)
    for delay in range(DELAYS - 1, 0, -1):
        wheel.asked[delay] = wheel.asked[delay - 1]
    wheel.asked[0] = expected
    wheel.long_effort += long * (effort - wheel.long_effort)
    wheel.long_expected += long * (expected - wheel.long_expected)
    wheel.long_inertial += long * (observation.inertial - wheel.long_inertial)
    wheel.long_residual += long * (observation.residual - wheel.long_residual)
    best, delay_errors = inf, wheel.delay_errors
    for delay in range(DELAYS):
        error = effort - wheel.asked[delay]
        delay_errors[delay] += long * (error * error - delay_errors[delay])
        if delay >= FIRST_DELAY:
            best = min(best, delay_errors[delay])
    wheel.turning_time = wheel.turning_time + period if abs(speed) > MIN_SPEED else 0.0
    if wheel.turning_time > 0.0:
        loss = ((effort - observation.inertial) * copysign(1.0, speed) - sample.coulomb
                - sample.viscous * abs(speed))
        # The plain mean until there is a usual loss.
        share = long if wheel.loss_known else max(long, period / wheel.turning_time)
        wheel.loss += share * (loss - wheel.loss)
    missing = abs(wheel.long_expected - wheel.long_effort) > (
        (MISSING_BY_SPEED if sample.by_speed else MISSING) * abs(wheel.long_expected)
        + NO_TORQUE * scale)
    if sample.by_speed:
        delayed = abs(wheel.long_residual) > DELAY_RESIDUAL
    else:
        delayed = delay_errors[0] > max(DELAY_RATIO * best, (DELAY_VISIBLE * scale) ** 2)
    dragging = (sample.coulomb > 0.0 and wheel.turning_time > MIN_SPEED_TIME
                and _is_dragging(wheel, speed, scale, period))
    # A share of a small torque is no evidence.
    missing &= max(abs(wheel.long_effort), abs(wheel.long_expected)) > MIN_EFFORT * scale
    if wheel.degraded_time < 0.0 or (
            wheel.unstrained_time > STRAINED_PAUSE and (missing or delayed or dragging)):
        wheel.degraded_time += period
    else:
        wheel.degraded_time = 0.0
    return bool(wheel.degraded_time > DEGRADED_TIME)


@kernel
def _is_dragging(wheel: Record, speed: float, scale: float, period: float) -> bool:
    """Return whether friction takes more than usual, and learn the usual loss."""
    inertial = wheel.long_inertial * copysign(1.0, speed)
    if wheel.loss_known == 0.0:
        wheel.usual_loss, wheel.usual_inertial, wheel.loss_known = wheel.loss, inertial, 1.0
    allowed = FRICTION_LOSS * scale + INERTIA_ERROR * abs(inertial - wheel.usual_inertial)
    if wheel.loss - wheel.usual_loss > allowed:
        return True
    # A loss that is about to be reported must not be learnt as usual.
    share = period / (
        LEARNING_TIME if wheel.loss - wheel.usual_loss < 0.5 * allowed else SLOW_LEARNING_TIME)
    wheel.usual_loss += share * (wheel.loss - wheel.usual_loss)
    wheel.usual_inertial += share * (inertial - wheel.usual_inertial)
    return False


@kernel
def _run_replica(j: int, wheel: Record, sample: Record, speed: float, motors: Motors
                 ) -> float:
    """
    Return the torque that the motor's speed loop asks for at a speed [N m].

    The replica is led back slowly to the reported effort: it integrates the rounding of speeds.
    """
    limit, period, effort = motors.torque_limit[j], sample.period, sample.efforts[j]
    command = sample.commands[j]
    if (not abs(wheel.replica_integral) <= limit
            or wheel.unstrained_time < STRAINED_PAUSE):
        wheel.replica_integral = effort - SPEED_BANDWIDTH * motors.inertia[j] * (command - speed)
    asked, wheel.replica_integral = speed_loop(
        j, command, speed, wheel.replica_integral, period, motors)
    wheel.replica_integral += (effort - asked) * period / LEARNING_TIME
    mean, wheel.replica_torque = lagged_torque(j, wheel.replica_torque, asked, period, motors)
    return mean
