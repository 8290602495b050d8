# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Which wheels still do what they are told: command against measured speed and effort.

Beside each wheel runs a model of a healthy one under the same commands. What the wheel does not
follow adds up to a difference of speeds, and a large one means that it is broken; what the motor
says that it gives, and what the wheel makes of it, tell how. Smaller faults, with which a wheel is
still of use, show as torque that is lost on the way from command to effort or from effort to
acceleration, or as a motor that acts late.
"""

from __future__ import annotations

from math import copysign, exp, inf, nan

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

VERDICTS = ('healthy', 'degraded', 'dead', 'stuck', 'runaway', 'shorted')
"""What may be said of a wheel; the number in arrays is the index. From `dead` on it is out."""

HEALTHY, DEGRADED, DEAD, STUCK, RUNAWAY, SHORTED = range(len(VERDICTS))

# A wheel that is so much faster or slower than it should be [rad/s], for so many ticks in a row,
# is broken or degraded.
UNFOLLOWED = 2.5
UNFOLLOWED_TICKS = 4
# So much more is allowed [rad/s] of a motor that was strained so lately [s]: what its own loop
# does in the limit is known less well.
OF_STRAINED, JUST_STRAINED = 10.0, 0.3
# And of a slow wheel that is driven by torque, which static friction holds back more [rad/s]; its
# model is led back sooner [s].
OF_SLOW, SOON = 1.5, 2.0

# Time constants of means [s]: for a wheel that breaks, and for one that degrades; with which a
# healthy one is learnt, and models of a wheel and its loop are led back to it, since errors add
# up there.
SHORT, LONG, SLOW, VERY_SLOW = 0.02, 0.5, 5.0, 30.0

# In shares of the motor's torque limit, or of so many times its friction if that is more:
# degradation is looked at from this effort on; torque that friction takes; a motor that gives
# nothing; one that gives what nobody asked for; a brake.
FRICTIONS = 50.0
LOOKED_AT, FRICTION_LOSS, NOTHING, UNASKED, BRAKED = 0.04, 8e-4, 2e-3, 0.04, 0.1

# Shares of the expected torque: that of a dead motor at most, and what a healthy one may lack; of
# the measured change of torque, by how much the inertia of a wheel may be believed wrongly.
DEAD_SHARE, MISSING, INERTIA_ERROR = 0.15, 0.2, 0.06
# Of what a motor's own loop asks for a replica knows less, since it sees the speed less often.
MISSING_BY_SPEED = 0.25

# A wheel that follows speeds is late if it is so far behind on the mean [rad/s]; one that follows
# torques, if some delay explains its effort better than none by this factor, in squares, and the
# difference is more than this share, as above.
BEHIND, EXPLAINED_BETTER, VISIBLE = 0.35, 4.0, 5e-4

# Degradation must last so long to be said [s], and is not looked at while the motor gives more
# than this share of its limit, nor for so long afterwards [s].
PERSISTENT, STRAINED, AFTER_STRAIN = 0.5, 0.5, 2.0
# Nor for so long after another wheel broke [s].
AFTER_BREAK = 3.0

# The friction of slower wheels is not known [rad/s], nor that of one which was slow so lately [s].
SLOWEST, AFTER_SLOW = 5.0, 0.8

# At most this slow, a wheel that is pushed stands still [rad/s].
STANDING = 1.0

# A wheel without power that is driven after so long cannot be cut [s].
CUT_WITHIN = 0.15

# Delays of commands that are thought of, in ticks: from the first to the last.
FIRST_DELAY, DELAYS = 3, 32

# The loop in the motor's electronics is taken to see the speed as often as this [s].
LOOP_STEP = 5e-4

# Longest step of the model [s].
STEP = 1e-3

# What is kept of each wheel.
(MODEL_SPEED, MODEL_TORQUE, INTEGRAL, LAST_SPEED, LAST_RATE, AGAINST, EFFORT, EXPECTED, GAIN,
 LONG_EFFORT, LONG_EXPECTED, LONG_GAIN, LONG_BEHIND, LEARNT, LEARNT_GAIN, REPLICA, REPLICA_TORQUE,
 SUSPECT_FOR, FAST_FOR, CUT_FOR, KNOWN, LOST, SETTLED) = range(23)
COLUMNS = 23


class WheelFaultDetector:
    """
    Watches the four wheels.

    :param mechanism: the linkage, its wheels and motors.
    :ivar verdicts: (4,) what is the matter with each wheel, as index of `VERDICTS`.
    :ivar usable: (4,) bool, which wheels can be driven; a new array when that changes.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.verdicts = np.zeros(4, np.int64)
        self.usable = np.ones(4, dtype=bool)
        self._motors = np.array([motors_of(mechanism)])
        self._kept = np.zeros((4, COLUMNS))
        self._past = np.zeros((4, DELAYS))
        self._late = np.zeros((4, DELAYS))
        self._started = False

    def begin(self) -> None:
        """Think well of all wheels, and know nothing of them."""
        self.verdicts[:] = HEALTHY
        self.usable = np.ones(4, dtype=bool)
        self._started = False

    def look(self, period: float, commands: Array, by_speed: bool, powered: NDArray[np.bool_],
             speeds: Array, link_rates: Array, efforts: Array, friction: Array) -> bool:
        """
        Look at what the wheels did in a period.

        :param period: its length [s].
        :param commands: (4,) torques [N m] or speeds [rad/s] that were commanded for it.
        :param by_speed: which of both.
        :param powered: (4,) which wheels had power.
        :param speeds: (4,) measured, relative to the links, mean of the period [rad/s].
        :param link_rates: (4,) of the links at its end [rad/s].
        :param efforts: (4,) that the motors say they gave, mean of the period [N m].
        :param friction: (2,) of the bearings: Coulomb [N m] and viscous [N m s].
        :returns: whether a verdict has changed.
        """
        if not self._started:
            _begin(self._kept, self._past, self._late, speeds, link_rates)
            self._started = True
            return False
        changed = look_at_wheels(
            period, commands, by_speed, powered, speeds, link_rates, efforts, friction,
            self._motors, self._kept, self._past, self._late, self.verdicts)
        if changed:
            self.usable = self.verdicts < DEAD
        return bool(changed)

    def lose(self, commands: Array, by_speed: bool, speeds: Array, link_rates: Array,
             efforts: Array) -> None:
        """
        Begin again from the wheels as they are, thinking of them as before.

        For a period of which it is not known what the wheels were told, or that was not seen.

        :param commands, by_speed: now in force.
        :param speeds, link_rates, efforts: as of :meth:`look`.
        """
        if self._started:
            _lose(commands, by_speed, speeds, link_rates, efforts, self._motors, self._kept)

    def faults(self) -> dict[str, str]:
        """Return what is the matter, by the name of the wheel; nothing if all are healthy."""
        return {name: VERDICTS[verdict] for name, verdict in zip(
            FLYWHEEL_NAMES, self.verdicts.tolist()) if verdict}


@kernel
def _begin(kept: Array, past: Array, late: Array, speeds: Array, rates: Array) -> None:
    kept[:], past[:], late[:] = 0.0, 0.0, 0.0
    for j in range(4):
        kept[j, MODEL_SPEED] = kept[j, LAST_SPEED] = speeds[j]
        kept[j, LAST_RATE], kept[j, SETTLED] = rates[j], AFTER_STRAIN
        kept[j, INTEGRAL] = kept[j, REPLICA] = nan


@kernel
def _lose(commands: Array, by_speed: bool, speeds: Array, rates: Array, efforts: Array,
          boxed: NDArray[np.record], kept: Array) -> None:
    motors = boxed[0]
    for j in range(4):
        wheel, effort = kept[j], efforts[j]
        wheel[MODEL_SPEED] = wheel[LAST_SPEED] = speeds[j]
        wheel[LAST_RATE] = rates[j]
        wheel[MODEL_TORQUE] = wheel[EXPECTED] = wheel[EFFORT] = wheel[GAIN] = effort
        wheel[AGAINST] = wheel[SETTLED] = 0.0
        wheel[INTEGRAL] = wheel[REPLICA] = nan
        if by_speed:
            # What the motor's own loop has learnt is what it gives beyond the error.
            limit = motors.torque_limit[j]
            learnt = effort - SPEED_BANDWIDTH * motors.inertia[j] * (commands[j] - speeds[j])
            wheel[INTEGRAL] = min(max(learnt, -limit), limit)


@kernel
def look_at_wheels(period: float, commands: Array, by_speed: bool, powered: NDArray[np.bool_],
                   speeds: Array, rates: Array, efforts: Array, friction: Array,
                   boxed: NDArray[np.record], kept: Array, past: Array, late: Array,
                   verdicts: NDArray[np.int64]) -> bool:
    """
    Look at the wheels, see :meth:`WheelFaultDetector.look`.

    :param kept: (4, COLUMNS) of each wheel.
    :param past: (4, DELAYS) torques that were asked for, newest first [N m].
    :param late: (4, DELAYS) mean squares of effort less these [N^2 m^2].
    """
    motors, changed = boxed[0], False
    short, long = 1.0 - exp(-period / SHORT), 1.0 - exp(-period / LONG)
    # Where no motor gives anything, the device does not drive: commands are late, or it is
    # disarmed and that is not known here yet. No wheel is to blame.
    driving = broke = False
    for j in range(4):
        driving |= powered[j] and abs(efforts[j]) > NOTHING * _scale(j, friction, motors)
    for j in range(4):
        wheel, before = kept[j], verdicts[j]
        inertia, limit = motors.inertia[j], motors.torque_limit[j]
        scale = _scale(j, friction, motors)
        speed, turned = speeds[j], rates[j] - wheel[LAST_RATE]
        gained = speed - wheel[LAST_SPEED]
        gain = inertia * (gained + turned) / period
        wheel[LAST_SPEED], wheel[LAST_RATE] = speed, rates[j]
        wheel[EFFORT] += short * (efforts[j] - wheel[EFFORT])
        wheel[GAIN] += short * (gain - wheel[GAIN])
        if not powered[j]:
            _without_power(wheel, speed, period)
            if verdicts[j] == RUNAWAY and wheel[CUT_FOR] > CUT_WITHIN:
                # Friction brakes it: anything else is driven.
                if (abs(speed) > SLOWEST and copysign(1.0, speed) * wheel[GAIN] > UNASKED * scale
                        or abs(wheel[EFFORT]) > UNASKED * scale):
                    verdicts[j] = SHORTED
            changed |= verdicts[j] != before
            continue
        wheel[CUT_FOR] = 0.0
        if not driving:
            _wait(wheel, speed)
            continue
        asked, behind = _follow_model(
            j, wheel, commands[j], by_speed, speed, turned, period, friction, boxed)
        wheel[EXPECTED] += short * (asked - wheel[EXPECTED])
        wheel[SETTLED] += period
        if max(abs(wheel[EFFORT]), abs(wheel[EXPECTED])) > STRAINED * limit:
            wheel[SETTLED] = 0.0
        allowed = UNFOLLOWED + (OF_STRAINED if wheel[SETTLED] < JUST_STRAINED else 0.0)
        if not by_speed and abs(speed) < SLOWEST:
            allowed += OF_SLOW
        wheel[AGAINST] = wheel[AGAINST] + 1.0 if abs(behind) > allowed else 0.0
        if wheel[AGAINST] >= UNFOLLOWED_TICKS:
            verdicts[j] = max(before, _broken(wheel, speed, scale, friction))
            wheel[MODEL_SPEED], wheel[AGAINST] = speed, 0.0
        if verdicts[j] == HEALTHY and _degraded(
                j, wheel, asked, by_speed, speed, behind, efforts[j], gain, commands[j], period,
                long, gained, friction, boxed, past[j], late[j]):
            verdicts[j] = DEGRADED
        changed |= verdicts[j] != before
        broke |= before < DEAD <= verdicts[j]
    if broke:
        # The others now give what they never gave before.
        kept[:, SUSPECT_FOR] = -AFTER_BREAK
    return changed


@kernel
def _scale(j: int, friction: Array, motors: Motors) -> float:
    """Return what torques are measured against [N m]."""
    return float(max(motors.torque_limit[j], FRICTIONS * friction[0]))


@kernel
def _without_power(wheel: Array, speed: float, period: float) -> None:
    _wait(wheel, speed)
    wheel[CUT_FOR] += period


@kernel
def _wait(wheel: Array, speed: float) -> None:
    """Let the model follow the wheel, which nobody drives."""
    wheel[MODEL_SPEED], wheel[MODEL_TORQUE], wheel[EXPECTED] = speed, 0.0, 0.0
    wheel[INTEGRAL] = wheel[REPLICA] = nan
    wheel[AGAINST] = wheel[SUSPECT_FOR] = wheel[FAST_FOR] = 0.0


@kernel
def _follow_model(j: int, wheel: Array, command: float, by_speed: bool, speed: float,
                  turned: float, period: float, friction: Array, boxed: NDArray[np.record]
                  ) -> tuple[float, float]:
    """
    Let a healthy wheel do what this one was told.

    :param turned: what the link's rate gained [rad/s].
    :returns: its mean torque [N m], and measured speed less its mean speed [rad/s].
    """
    motors = boxed[0]
    inertia = motors.inertia[j]
    steps = int(period / STEP) + 1
    h = period / steps
    model, torque = wheel[MODEL_SPEED], wheel[MODEL_TORQUE]
    total = mean_speed = 0.0
    for _ in range(steps):
        asked = command
        if by_speed:
            asked, wheel[INTEGRAL] = speed_loop(j, command, model, wheel[INTEGRAL], h, motors)
        mean, torque = lagged_torque(
            j, torque, available_torque(j, asked, model, motors), h, motors)
        free = model + h * mean / inertia - turned * h / period
        # Dry friction stops it at most.
        left = abs(free) * (1.0 - h * friction[1] / inertia) - h * friction[0] / inertia
        after = copysign(max(left, 0.0), free)
        total += mean / steps
        mean_speed += 0.5 * (model + after) / steps
        model = after
    behind = speed - mean_speed
    if not by_speed:
        model += behind * period / (SLOW if abs(speed) > SLOWEST else SOON)
    wheel[MODEL_SPEED], wheel[MODEL_TORQUE] = model, torque
    return total, behind


@kernel
def _broken(wheel: Array, speed: float, scale: float, friction: Array) -> int:
    """Tell what is the matter with a wheel that does not follow."""
    effort, expected = wheel[EFFORT], wheel[EXPECTED]
    nothing = NOTHING * scale
    if (abs(effort) < DEAD_SHARE * abs(expected) + nothing
            and abs(effort - expected) > 2.0 * nothing):
        return DEAD
    taken = copysign(friction[0], speed) + friction[1] * speed if abs(speed) > STANDING else 0.0
    lost = effort - taken - wheel[GAIN]
    dry = friction[0]
    if abs(lost) > max(5.0 * dry, BRAKED * scale) or (
            abs(speed) < STANDING and abs(effort) > 1.5 * dry + nothing
            and abs(lost) > 0.5 * abs(effort)):
        return STUCK
    unasked = abs(effort - expected) > UNASKED * scale + 0.5 * abs(expected)
    if unasked and (effort * expected < 0.0 or abs(effort) > 1.3 * abs(expected)):
        return RUNAWAY
    if (abs(effort - expected) <= MISSING * abs(expected) + nothing
            and abs(lost) <= FRICTION_LOSS * scale + INERTIA_ERROR * abs(wheel[GAIN])):
        # The model drifted, as far as its inertia may be wrong.
        return HEALTHY
    return DEGRADED


@kernel
def _degraded(j: int, wheel: Array, asked: float, by_speed: bool, speed: float, behind: float,
              effort: float, gain: float, command: float, period: float, long: float,
              gained: float, friction: Array, boxed: NDArray[np.record], past: Array,
              late: Array) -> bool:
    """Tell whether a wheel lacks torque or acts late, for long enough to say so."""
    motors = boxed[0]
    scale = _scale(j, friction, motors)
    if by_speed:
        seen = speed - 0.5 * gained * LOOP_STEP / period
        asked = _replicate(j, wheel, command, seen, effort, period, boxed)
    for delay in range(DELAYS - 1, 0, -1):
        past[delay] = past[delay - 1]
    past[0] = asked
    wheel[LONG_EFFORT] += long * (effort - wheel[LONG_EFFORT])
    wheel[LONG_EXPECTED] += long * (asked - wheel[LONG_EXPECTED])
    wheel[LONG_GAIN] += long * (gain - wheel[LONG_GAIN])
    wheel[LONG_BEHIND] += long * (behind - wheel[LONG_BEHIND])
    best = inf
    for delay in range(DELAYS):
        error = effort - past[delay]
        late[delay] += long * (error * error - late[delay])
        if delay >= FIRST_DELAY:
            best = min(best, late[delay])
    wheel[FAST_FOR] = wheel[FAST_FOR] + period if abs(speed) > SLOWEST else 0.0
    if wheel[FAST_FOR] > 0.0:
        lost = (effort - gain) * copysign(1.0, speed) - friction[0] - friction[1] * abs(speed)
        # Nothing is known at first: then the plain mean.
        share = long if wheel[KNOWN] else max(long, period / wheel[FAST_FOR])
        wheel[LOST] += share * (lost - wheel[LOST])
    missing = abs(wheel[LONG_EXPECTED] - wheel[LONG_EFFORT]) > (
        (MISSING_BY_SPEED if by_speed else MISSING) * abs(wheel[LONG_EXPECTED])
        + NOTHING * scale)
    if by_speed:
        tardy = abs(wheel[LONG_BEHIND]) > BEHIND
    else:
        tardy = late[0] > max(EXPLAINED_BETTER * best, (VISIBLE * scale) ** 2)
    rubbing = (friction[0] > 0.0 and wheel[FAST_FOR] > AFTER_SLOW
               and _rubs(wheel, speed, scale, period))
    # A share of little is no evidence.
    missing &= max(abs(wheel[LONG_EFFORT]), abs(wheel[LONG_EXPECTED])) > LOOKED_AT * scale
    if wheel[SUSPECT_FOR] < 0.0 or (
            wheel[SETTLED] > AFTER_STRAIN and (missing or tardy or rubbing)):
        wheel[SUSPECT_FOR] += period
    else:
        wheel[SUSPECT_FOR] = 0.0
    return bool(wheel[SUSPECT_FOR] > PERSISTENT)


@kernel
def _rubs(wheel: Array, speed: float, scale: float, period: float) -> bool:
    """Tell whether friction takes more than it used to, and learn what it is used to."""
    accelerated = wheel[LONG_GAIN] * copysign(1.0, speed)
    if wheel[KNOWN] == 0.0:
        wheel[LEARNT], wheel[LEARNT_GAIN], wheel[KNOWN] = wheel[LOST], accelerated, 1.0
    allowed = FRICTION_LOSS * scale + INERTIA_ERROR * abs(accelerated - wheel[LEARNT_GAIN])
    if wheel[LOST] - wheel[LEARNT] > allowed:
        return True
    # What is about to be too much is not learnt as usual.
    share = period / (SLOW if wheel[LOST] - wheel[LEARNT] < 0.5 * allowed else VERY_SLOW)
    wheel[LEARNT] += share * (wheel[LOST] - wheel[LEARNT])
    wheel[LEARNT_GAIN] += share * (accelerated - wheel[LEARNT_GAIN])
    return False


@kernel
def _replicate(j: int, wheel: Array, command: float, speed: float, effort: float, period: float,
               boxed: NDArray[np.record]) -> float:
    """
    Return what the motor's electronics ask for, seeing this command and this speed [N m].

    Led back slowly to what the motor gives, or the rounding of the speeds would add up.
    """
    motors = boxed[0]
    limit = motors.torque_limit[j]
    if not abs(wheel[REPLICA]) <= limit or wheel[SETTLED] < AFTER_STRAIN:
        wheel[REPLICA] = effort - SPEED_BANDWIDTH * motors.inertia[j] * (command - speed)
    asked, wheel[REPLICA] = speed_loop(j, command, speed, wheel[REPLICA], period, motors)
    wheel[REPLICA] += (effort - asked) * period / SLOW
    mean, wheel[REPLICA_TORQUE] = lagged_torque(
        j, wheel[REPLICA_TORQUE], asked, period, motors)
    return mean
