# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The flywheel motors: limits and lag of their torque, and their speed loop.

The friction of the bearings is in `plant.bearings`.
"""

from __future__ import annotations

from math import exp, inf, isnan
from typing import Any

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Fields, record
from fourbar_ros.mechanism.mechanism import Mechanism
import numpy as np

# Bandwidth of the speed loop in the electronics of the motor [rad/s].
SPEED_BANDWIDTH = 60.0

FIELDS: Fields = [
    ('torque_limit', float, (4,)),      # N m
    ('speed_limit', float, (4,)),       # rad/s
    ('time_constant', float, (4,)),     # s
    ('torque_constant', float, (4,)),   # N m/A
    ('resistance', float, (4,)),        # ohm
    ('voltage', float, (4,)),           # V
    ('inertia', float, (4,)),           # kg m^2, of the wheel
]

# A scalar of `FIELDS`, and perhaps more; numba knows its fields by name.
Motors = np.record


def motor_values(mechanism: Mechanism) -> dict[str, Any]:
    """Return the values of `FIELDS` by their names."""
    return {
        'torque_limit': mechanism.motor_torque_limits,
        'speed_limit': mechanism.motor_speed_limits,
        'time_constant': mechanism.motor_time_constants,
        'torque_constant': mechanism.motor_torque_constants,
        'resistance': mechanism.motor_resistances, 'voltage': mechanism.motor_voltages,
        'inertia': mechanism.flywheel_inertias}


def motors_of(mechanism: Mechanism) -> Motors:
    """Return the parameters of the four motors."""
    return record(FIELDS, **motor_values(mechanism))


@kernel
def speed_loop(wheel: int, target: float, speed: float, integral: float, step: float,
               motors: Motors) -> tuple[float, float]:
    """
    Control a wheel speed (PI, critically damped).

    :param target, speed: commanded and present speed relative to the link [rad/s].
    :param integral: integral part of the torque [N m], NaN at the beginning.
    :returns: commanded torque [N m], and the new integral, which is constant at the limit.
    """
    gain = SPEED_BANDWIDTH * motors.inertia[wheel]
    error = target - speed
    limit = motors.torque_limit[wheel]
    if isnan(integral) or ((gain * error + integral) * error > 0.0
                           and abs(gain * error + integral) >= limit):
        # At the limit the integral has no information; from this value the error decays without
        # overshoot.
        integral = -0.5 * gain * error
    torque = gain * error + integral
    if abs(torque) < limit:
        integral += 0.25 * SPEED_BANDWIDTH * gain * error * step
    return min(max(torque, -limit), limit), integral


@kernel
def available_torque(wheel: int, command: float, speed: float, motors: Motors) -> float:
    """
    Limit a commanded torque to the range of the motor [N m].

    The torque limit acts, then the supply voltage less the back-EMF. At the speed limit a torque
    that would drive the wheel further is zero.
    """
    limit = motors.torque_limit[wheel]
    torque = min(max(command, -limit), limit)
    if motors.resistance[wheel] > 0.0 and motors.voltage[wheel] < inf:
        constant = motors.torque_constant[wheel]
        slope, back = constant / motors.resistance[wheel], constant * speed
        torque = min(max(torque, slope * (-motors.voltage[wheel] - back)),
                     slope * (motors.voltage[wheel] - back))
    if abs(speed) >= motors.speed_limit[wheel] and torque * speed > 0.0:
        torque = 0.0
    return float(torque)


@kernel
def lagged_torque(wheel: int, torque: float, target: float, step: float, motors: Motors
                  ) -> tuple[float, float]:
    """
    Evaluate the lag of the torque towards its target over a step.

    :returns: mean over the step and value at its end [N m].
    """
    time_constant = motors.time_constant[wheel]
    if time_constant <= 0.0:
        return target, target
    left = exp(-step / time_constant)
    mean = target + (torque - target) * time_constant / step * (1.0 - left)
    return mean, target + (torque - target) * left
