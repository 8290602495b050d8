# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The motion of the wheels, which drives the prediction, from the best available source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from typing import NamedTuple

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
import numpy as np

# Random walk of the disturbance torques where wheels are not measured, over the largest motor
# torque [1/sqrt(s)]: the friction of the wheel bearings is unknown then.
UNKNOWN_SHARE = 0.02

# Time for which a command drives the prediction [ns]: a device disarms after the same time.
COMMAND_VALID_NS = 100_000_000

BY_SPEED, BY_EFFORT, BY_COMMAND, BY_NOTHING = (
    'wheel speeds', 'wheel efforts', 'commanded efforts', 'nothing')
"""Sources of the motion of the wheels, best first."""


class WheelTorques(NamedTuple):
    """
    Torques that accelerated the wheels over a period.

    :param torques: (4,) If dOmega/dt relative to the links [N m].
    :param unknown: density of a random walk of their error, 0 if measured [N m/sqrt(s)].
    """

    torques: Array
    unknown: float


class WheelMotion:
    """
    Derives the torques on the wheels from speeds, efforts or commands.

    :ivar source: of the last torques, BY_SPEED, BY_EFFORT, BY_COMMAND or BY_NOTHING.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.source = BY_SPEED
        self._inertias = mechanism.flywheel_inertias
        self._unknown = UNKNOWN_SHARE * float(mechanism.motor_torque_limits.max())
        # Mean speeds over the last period, and speeds at its end [rad/s].
        self._speeds: tuple[Array, Array] | None = None
        self._command: tuple[int, Array] | None = None

    def restart(self) -> None:
        """Forget the speeds: the next period has no predecessor."""
        self._speeds = None

    def set_command(self, stamp_ns: int, efforts: Sequence[float]) -> None:
        """
        Set the commanded efforts.

        :param stamp_ns: last tick [ns].
        :param efforts: (4,) torques on the wheels [N m]; unusable ones are ignored.
        """
        if len(efforts) == 4 and all(map(isfinite, efforts)):
            self._command = stamp_ns, np.array(efforts, dtype=float)

    def torques(self, from_ns: int | None, to_ns: int, speeds: Array, efforts: Array,
                accelerations: Callable[[], Array]) -> WheelTorques:
        """
        Return the torques between two ticks.

        :param from_ns: the earlier tick, None for the first period [ns].
        :param speeds: (4,) mean over the period, relative to the links [rad/s], or empty.
        :param efforts: (4,) torques on the wheels [N m], or empty.
        :param accelerations: returns those of the links (4,) [rad/s^2].
        """
        last, self._speeds = self._speeds, None
        if speeds.size:
            # A mean over the period is the speed in its middle: half a period before the tick.
            self._speeds = speeds, (
                speeds if last is None else speeds + 0.5 * (speeds - last[0]))
        if from_ns is None:
            return WheelTorques(np.zeros(4), 0.0)
        if self._speeds is not None and last is not None:
            self.source = BY_SPEED
            elapsed = (to_ns - from_ns) * 1e-9
            return WheelTorques(self._inertias * (self._speeds[1] - last[1]) / elapsed, 0.0)
        if efforts.size:
            self.source = BY_EFFORT
        elif self._command is not None and to_ns - self._command[0] <= COMMAND_VALID_NS:
            self.source, efforts = BY_COMMAND, self._command[1]
        else:
            self.source = BY_NOTHING
            return WheelTorques(np.zeros(4), self._unknown)
        # Motor torques accelerate the wheels absolutely; subtract the part of the links.
        return WheelTorques(efforts - self._inertias * accelerations(), self._unknown)
