# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Wheel commands, torques or speeds, that make the torques of the law act."""

from __future__ import annotations

from math import copysign
from typing import NamedTuple

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.motors import SPEED_BANDWIDTH
import numpy as np
from numpy.typing import NDArray

# Largest distance of a commanded speed from the measured one.
#
# It is a share of the distance at which the motor's speed loop asks for its torque limit. Beyond
# that the command winds up and causes a late overshoot.
SPEED_REACH = 0.8

# Speed below which the compensated Coulomb friction fades out [rad/s].
#
# The sign of a slower wheel is the rounding error of its encoder.
FRICTION_SPEED = 0.5


class WheelCommand(NamedTuple):
    """
    Command to the wheels.

    :param values: (4,) torques [N m], or speeds relative to the links [rad/s].
    :param by_speed: whether the values are speeds.
    :param powered: (4,) bool; a wheel without power is left out of the command message.
    """

    values: Array
    by_speed: bool
    powered: NDArray[np.bool_]


class WheelCommander:
    """
    Turns torques of the law into commands.

    Under speed commands the loop in the motor's electronics overcomes the bearing friction: the
    wheel gains the commanded momentum. To torque commands the friction is added.

    :param mechanism: the model of the linkage.
    :ivar friction: (4,) of the bearings at the last tick, against the speeds [N m].
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.friction = np.zeros(4)
        self._inertias = mechanism.flywheel_inertias
        self._reach = SPEED_REACH * mechanism.motor_torque_limits / (
            SPEED_BANDWIDTH * mechanism.flywheel_inertias)
        self._limits = mechanism.motor_torque_limits
        self._speeds = np.zeros(4)

    def reset(self, speeds: Array) -> None:
        """Start from the measured speeds (4,) [rad/s]."""
        self._speeds[:] = speeds

    def update_friction(self, speeds: Array, coulomb: float, viscous: float) -> Array:
        """Evaluate the bearing friction at measured speeds, against them (4,) [N m]."""
        bearing_friction(speeds, coulomb, viscous, self.friction)
        return self.friction

    def command(self, torques: Array, link_accelerations: Array, speeds: Array,
                powered: NDArray[np.bool_], period: float, by_speed: bool) -> WheelCommand:
        """
        Return the command that makes torques act.

        :param torques: (4,) on the wheels, bearings apart [N m].
        :param link_accelerations: (4,) of the reference [rad/s^2].
        :param speeds: (4,) measured, relative to the links [rad/s].
        :param powered: (4,) bool, wheels that may be driven.
        :param period: to the next command [s].
        """
        if not by_speed:
            self._speeds[:] = speeds
            return WheelCommand(
                motor_torques(torques, self.friction, self._limits), False, powered)
        next_speeds(self._speeds, torques, link_accelerations, speeds, powered, period,
                    self._inertias, self._reach)
        return WheelCommand(self._speeds.copy(), True, powered)


def by_name(command: WheelCommand) -> tuple[tuple[str, ...], list[float], list[float]]:
    """
    Return the fields of the message of a command.

    :returns: names of the wheels with power, and either their velocities or their efforts.
    """
    names: tuple[str, ...] = FLYWHEEL_NAMES
    values = command.values.tolist()
    if not command.powered.all():
        wheels = np.flatnonzero(command.powered).tolist()
        names = tuple(FLYWHEEL_NAMES[wheel] for wheel in wheels)
        values = [values[wheel] for wheel in wheels]
    return (names, values, []) if command.by_speed else (names, [], values)


@kernel
def bearing_friction(speeds: Array, coulomb: float, viscous: float, friction: Array) -> None:
    """Evaluate the bearing friction (4,) [N m], see :class:`WheelCommander`."""
    for j in range(4):
        sign = copysign(min(abs(speeds[j]) / FRICTION_SPEED, 1.0), speeds[j])
        friction[j] = coulomb * sign + viscous * speeds[j]


@kernel
def motor_torques(torques: Array, friction: Array, limits: Array) -> Array:
    """Add the friction that the motors must overcome, within their limits (4,) [N m]."""
    commanded = np.empty(4)
    for j in range(4):
        commanded[j] = min(max(torques[j] + friction[j], -limits[j]), limits[j])
    return commanded


@kernel
def next_speeds(commanded: Array, torques: Array, link_accelerations: Array, speeds: Array,
                powered: NDArray[np.bool_], period: float, inertias: Array, reach: Array) -> None:
    """Advance the commanded speeds, in place: `If (d omega/dt + d Omega/dt) = tau`."""
    for j in range(4):
        if not powered[j]:
            commanded[j] = speeds[j]
            continue
        speed = commanded[j] + period * (torques[j] / inertias[j] - link_accelerations[j])
        commanded[j] = min(max(speed, speeds[j] - reach[j]), speeds[j] + reach[j])
