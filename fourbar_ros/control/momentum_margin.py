# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Momentum margin: how far the wheels are from their speed limits, and when drift saturates them.

On a table without friction the momentum of the wheels at rest never changes. Drag, a tether and
tilt change it, and friction in the joints moves it between the pairs. A free-floating linkage
cannot dump momentum.
"""

from __future__ import annotations

from math import exp, inf

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import FLYWHEEL_NAMES, Mechanism
from fourbar_ros.mechanism.constants import Array
import numpy as np

# Time constant of the mean drift of wheel speeds [s].
#
# It averages the noise of encoders and the lag of motors; nothing is predicted before it has
# passed.
DRIFT_TIME = 5.0

# Share of a speed limit below which the margin causes a warning: room for a short manoeuvre.
MIN_MARGIN = 0.15

# Predicted time to saturation below which there is a warning [s]: time for an operator to act.
MIN_TIME_LEFT = 30.0

# Drift below this share of the speed limit per second is ignored [1/s].
MIN_DRIFT = 1e-4


class MomentumMonitor:
    """
    Estimates the drift of the wheel speeds and the margin to their limits.

    :ivar drift: (4,) acceleration of the wheels beyond that of the plan, mean over `DRIFT_TIME`
        [rad/s^2].
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.drift = np.zeros(4)
        self._limits = mechanism.motor_speed_limits
        self._inertias = mechanism.flywheel_inertias
        self._last = np.zeros(4)
        self._observed = 0.0

    def reset(self, speeds: Array) -> None:
        """Restart the estimate from measured speeds (4,) [rad/s]."""
        self.drift[:] = 0.0
        self._last[:] = speeds
        self._observed = 0.0

    def update(self, period: float, speeds: Array, planned: Array, link_accelerations: Array
               ) -> None:
        """
        Add a period to the mean.

        :param period: its length [s].
        :param speeds: (4,) of the wheels at its end, relative to the links [rad/s].
        :param planned: (4,) torques of the plan in it [N m].
        :param link_accelerations: (4,) likewise [rad/s^2].
        """
        if period <= 0.0:
            return
        self._observed += period
        learn_drift(period, speeds, planned, link_accelerations, self._inertias, self._last,
                    self.drift)

    def margins(self, speeds: Array) -> Array:
        """Return the share of each speed limit that is left (4,)."""
        margins: Array = 1.0 - np.abs(speeds) / self._limits
        return margins

    def time_left(self, speeds: Array) -> float:
        """Return the time to the first speed limit at constant drift, or inf [s]."""
        if self._observed < DRIFT_TIME:
            return inf
        left = inf
        for speed, drift, limit in zip(
                speeds.tolist(), self.drift.tolist(), self._limits.tolist()):
            if abs(drift) > MIN_DRIFT * limit < inf:
                left = min(left, max(0.0, (limit - speed if drift > 0.0 else limit + speed)
                                     / abs(drift)))
        return left

    def warning(self, speeds: Array) -> str:
        """Return a warning, or ''."""
        margins = self.margins(speeds)
        wheel = int(np.argmin(margins))
        if margins[wheel] < MIN_MARGIN:
            return (f'{FLYWHEEL_NAMES[wheel]} near its speed limit ({abs(speeds[wheel]):.0f} of '
                    f'{self._limits[wheel]:.0f} rad/s): reverse the manoeuvre to unload it')
        left = self.time_left(speeds)
        if left < MIN_TIME_LEFT:
            return (f'drift brings a wheel to its speed limit in {left:.0f} s, warning below '
                    f'{MIN_TIME_LEFT:g} s')
        return ''


@kernel
def learn_drift(period: float, speeds: Array, planned: Array, link_accelerations: Array,
                inertias: Array, last: Array, drift: Array) -> None:
    """Update the mean drift, in place, see :meth:`MomentumMonitor.update`."""
    share = 1.0 - exp(-period / DRIFT_TIME)
    for j in range(4):
        beyond = (speeds[j] - last[j]) / period - (
            planned[j] / inertias[j] - link_accelerations[j])
        drift[j] += share * (beyond - drift[j])
        last[j] = speeds[j]
