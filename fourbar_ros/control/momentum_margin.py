# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
How much momentum the wheels can still take, and how long that lasts.

On a table without friction the momentum that the wheels hold at rest never changes. Drag, a
tether and tilt change it, friction in the joints moves it between the pairs, and a free-floating
linkage has nothing to dump it on: this watches, and warns.
"""

from __future__ import annotations

from math import exp, inf

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism
from fourbar_ros.mechanism.constants import Array
import numpy as np

# Of the drift of the wheels' speeds, the time over which the mean is taken [s]; a mean over less
# than that is no prediction.
MEMORY = 5.0

# Warned is when less of a motor's speed limit is left than this share, or it lasts no longer [s].
LEAST_MARGIN = 0.15
LEAST_TIME = 30.0

# Slower drift than this, in shares of the speed limit per second, is none.
STEADY = 1e-4


class MomentumMonitor:
    """
    Watches the momentum of the wheels.

    :ivar drift: (4,) acceleration of the wheels beyond what the reference asks for, mean over the
        last seconds [rad/s^2].
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.drift = np.zeros(4)
        self._limits = mechanism.motor_speed_limits
        self._inertias = mechanism.flywheel_inertias
        self._last = np.zeros(4)
        self._since = 0.0

    def begin(self, speeds: Array) -> None:
        """Know nothing of any drift."""
        self.drift[:] = 0.0
        self._last[:] = speeds
        self._since = 0.0

    def look(self, period: float, speeds: Array, planned: Array, link_accelerations: Array
             ) -> None:
        """
        Look at a period.

        :param period: its length [s].
        :param speeds: (4,) of the wheels at its end, relative to the links [rad/s].
        :param planned: (4,) torques that the reference asked for in it [N m].
        :param link_accelerations: (4,) likewise [rad/s^2].
        """
        if period <= 0.0:
            return
        self._since += period
        learn_drift(period, speeds, planned, link_accelerations, self._inertias, self._last,
                    self.drift)

    def margins(self, speeds: Array) -> Array:
        """Return the share of each motor's speed limit that is left (4,)."""
        margins: Array = 1.0 - np.abs(speeds) / self._limits
        return margins

    def time_left(self, speeds: Array) -> float:
        """Return when the first wheel reaches its limit if the drift goes on, maybe inf [s]."""
        if self._since < MEMORY:
            return inf
        left = inf
        for speed, drift, limit in zip(
                speeds.tolist(), self.drift.tolist(), self._limits.tolist()):
            if abs(drift) > STEADY * limit < inf:
                left = min(left, max(0.0, (limit - speed if drift > 0.0 else limit + speed)
                                     / abs(drift)))
        return left

    def warning(self, speeds: Array) -> str:
        """Return what to warn of, or ''."""
        margins = self.margins(speeds)
        wheel = int(np.argmin(margins))
        if margins[wheel] < LEAST_MARGIN:
            return (f'{FLYWHEEL_NAMES[wheel]} turns at {abs(speeds[wheel]):.0f} rad/s of '
                    f'{self._limits[wheel]:.0f} rad/s: momentum is not lost, turn back')
        left = self.time_left(speeds)
        if left < LEAST_TIME:
            return f'drift saturates a wheel in {left:.0f} s'
        return ''


@kernel
def learn_drift(period: float, speeds: Array, planned: Array, link_accelerations: Array,
                inertias: Array, last: Array, drift: Array) -> None:
    """Update the mean drift, in place, see :meth:`MomentumMonitor.look`."""
    share = 1.0 - exp(-period / MEMORY)
    for j in range(4):
        beyond = (speeds[j] - last[j]) / period - (
            planned[j] / inertias[j] - link_accelerations[j])
        drift[j] += share * (beyond - drift[j])
        last[j] = speeds[j]
