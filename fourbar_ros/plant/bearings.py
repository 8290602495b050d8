# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Friction of the wheel bearings.

Within a step of the plant the torque is constant, its mean: so impulse and work are exact.
"""

from __future__ import annotations

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Fields, record
from fourbar_ros.mechanism.forces import dry_friction
from fourbar_ros.mechanism.motors import FIELDS as MOTOR_FIELDS
from fourbar_ros.mechanism.motors import motor_values, Motors
from fourbar_ros.plant.table import WheelBearings

# Newton's method converges in three or four iterations unless a number is not finite.
MOST_ITERATIONS = 60

# Share of the speed that friction may take in a step that uses the friction at its middle.
MIDPOINT_LIMIT = 0.5

# The fields of the motors come last: numba warns about a record that begins like another record.
FIELDS: Fields = [
    ('viscous', float, ()),             # N m s
    ('coulomb', float, ()),             # N m
    ('static_ratio', float, ()),
    ('stribeck_speed', float, ()),      # rad/s
    ('smoothing', float, ()),           # rad/s
    *MOTOR_FIELDS,
]


def drives_of(mechanism: Mechanism, bearings: WheelBearings) -> Motors:
    """Return the parameters of the four motors and of the bearings of their wheels."""
    return record(
        FIELDS, **motor_values(mechanism), viscous=bearings.viscous, coulomb=bearings.coulomb,
        static_ratio=bearings.static_ratio, stribeck_speed=bearings.stribeck_speed,
        smoothing=bearings.smoothing)


@kernel
def bearing_torque(speed: float, extra_coulomb: float, motors: Motors) -> float:
    """
    Evaluate the friction between a wheel and its link, which acts against `speed` [N m].

    A function of the relative speed [rad/s] alone: viscous, Coulomb, and static friction that
    falls off with speed.

    :param extra_coulomb: beyond that of the bearing [N m].
    """
    dry = motors.coulomb * dry_friction(
        speed, motors.static_ratio, motors.stribeck_speed, motors.smoothing)
    if extra_coulomb > 0.0:
        dry += extra_coulomb * dry_friction(speed, 1.0, 1.0, motors.smoothing)
    return float((motors.viscous + dry) * speed)


@kernel
def friction_over_step(wheel: int, speed: float, torque: float, recoil: float,
                       extra_coulomb: float, step: float, motors: Motors) -> float:
    """
    Evaluate the friction torque that acts during a step [N m].

    Friction near rest is stiff, and an explicit step would chatter. Friction is evaluated at the
    speed in the middle of the step, or, where it changes too fast with speed, at the end.

    :param speed: of the wheel relative to the link [rad/s].
    :param torque: of the motor [N m].
    :param recoil: acceleration of the link [rad/s^2].
    """
    if motors.coulomb == 0.0 and motors.viscous == 0.0 and extra_coulomb == 0.0:
        return 0.0
    gain = step / motors.inertia[wheel]
    drive = torque * gain - recoil * step
    middle = _implicit_speed(speed + 0.5 * drive, 0.5 * gain, extra_coulomb, motors)
    friction = bearing_torque(middle, extra_coulomb, motors)
    end = speed + drive - gain * friction
    slowest = min(abs(speed), abs(end)) if speed * end > 0.0 else 0.0
    if gain * _friction_slope(slowest, extra_coulomb, motors) < MIDPOINT_LIMIT:
        return friction
    return bearing_torque(
        _implicit_speed(speed + drive, gain, extra_coulomb, motors), extra_coulomb, motors)


@kernel
def _friction_slope(speed: float, extra_coulomb: float, motors: Motors) -> float:
    """Estimate how fast friction grows with a speed that is not negative [N m s]."""
    further = 1e-3 * (speed + 0.1 * motors.smoothing)
    return float((bearing_torque(speed + further, extra_coulomb, motors)
                  - bearing_torque(speed, extra_coulomb, motors)) / further)


@kernel
def _implicit_speed(free: float, gain: float, extra_coulomb: float, motors: Motors) -> float:
    """Solve x + gain friction(x) = free; x lies between rest and free."""
    size = abs(free)
    low, high, x = 0.0, size, 0.0
    for _ in range(MOST_ITERATIONS):
        friction = bearing_torque(x, extra_coulomb, motors)
        rest = x + gain * friction - size
        if rest < 0.0:
            low = x
        else:
            high = x
        after = x - rest / (1.0 + gain * _friction_slope(x, extra_coulomb, motors))
        if not low <= after <= high:
            after = 0.5 * (low + high)
        if abs(after - x) <= 1e-14 * size:
            x = after
            break
        x = after
    return x if free >= 0.0 else -x
