# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""From the torques that shall act to what the wheels are told: torques, or speeds."""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign

from fourbar_ros.control.settings import ControllerSettings
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.motors import SPEED_BANDWIDTH
import numpy as np
from numpy.typing import NDArray

# A commanded speed is kept this near to the measured one, as a share of what makes the motor's
# own loop ask for all it has: what is beyond adds up to nothing but a late overshoot.
REACH = 0.8

# Up to this speed a bearing's friction takes less than all of its Coulomb friction [rad/s]: the
# sign of a slower wheel is that of its encoder's rounding.
UNSURE = 0.5


@dataclass(frozen=True, eq=False)
class WheelCommand:
    """
    What the wheels are told.

    :param values: (4,) torques [N m], or speeds relative to the links [rad/s].
    :param by_speed: which of both.
    :param powered: (4,) bool; a wheel without power is not named in the command.
    """

    values: Array
    by_speed: bool
    powered: NDArray[np.bool_]


class WheelCommander:
    """
    Turns torques into commands.

    Speeds are followed by the motors' own electronics, whatever their bearings take: the wheel
    gains the momentum that it is told to gain. Torques need the friction added.

    :param mechanism: the linkage that the controller believes in.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.friction = np.zeros(4)
        self._inertias = mechanism.flywheel_inertias
        self._reach = REACH * mechanism.motor_torque_limits / (
            SPEED_BANDWIDTH * mechanism.flywheel_inertias)
        self._limits = mechanism.motor_torque_limits
        self._speeds = np.zeros(4)

    def begin(self, speeds: Array) -> None:
        """Start from the measured speeds [rad/s]."""
        self._speeds[:] = speeds

    def look(self, speeds: Array, settings: ControllerSettings) -> Array:
        """Work out what the bearings take, against the speeds (4,) [N m]."""
        bearing_friction(speeds, settings.bearing_coulomb, settings.bearing_viscous,
                         self.friction)
        return self.friction

    def command(self, torques: Array, link_accelerations: Array, speeds: Array,
                powered: NDArray[np.bool_], period: float, by_speed: bool) -> WheelCommand:
        """
        Command what makes torques act.

        :param torques: (4,) on the wheels, bearings apart [N m].
        :param link_accelerations: (4,) that are asked for [rad/s^2].
        :param speeds: (4,) measured, relative to the links [rad/s].
        :param powered: (4,) bool, wheels that may be driven.
        :param period: to the next command [s].
        """
        if not by_speed:
            self._speeds[:] = speeds
            values = np.clip(torques + self.friction, -self._limits, self._limits)
            return WheelCommand(values, False, powered)
        next_speeds(self._speeds, torques, link_accelerations, speeds, powered, period,
                    self._inertias, self._reach)
        return WheelCommand(self._speeds.copy(), True, powered)


def by_name(command: WheelCommand) -> tuple[tuple[str, ...], list[float], list[float]]:
    """
    Write a command as its message has it.

    :returns: the wheels that have power, and for these either velocities or efforts.
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
    """Evaluate what bearings take of the torque (4,) [N m], see :class:`WheelCommander`."""
    for j in range(4):
        sign = copysign(min(abs(speeds[j]) / UNSURE, 1.0), speeds[j])
        friction[j] = coulomb * sign + viscous * speeds[j]


@kernel
def next_speeds(commanded: Array, torques: Array, link_accelerations: Array, speeds: Array,
                powered: NDArray[np.bool_], period: float, inertias: Array, reach: Array) -> None:
    """Advance the commanded speeds, in place: `If (d omega/dt + d Omega/dt) = tau`."""
    for j in range(4):
        if not powered[j]:
            commanded[j] = speeds[j]
            continue
        wanted = commanded[j] + period * (torques[j] / inertias[j] - link_accelerations[j])
        commanded[j] = min(max(wanted, speeds[j] - reach[j]), speeds[j] + reach[j])
