# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The simulated table as a device."""

from __future__ import annotations

from fourbar_ros.device.protocol import LinkSample, Samples, WheelSample
from fourbar_ros.mechanism.parameters import Array
from fourbar_ros.plant import Plant

ALL_LINKS = (0, 1, 2, 3)


class SimulatedTable:
    """
    A plant behind the device protocol.

    :param plant: what is simulated.
    :param period_ns: time between two ticks [ns].
    :raises PlantError: the period is not a whole multiple of the plant step.
    """

    description = 'simulated table'

    def __init__(self, plant: Plant, period_ns: int) -> None:
        self.mechanism = plant.mechanism
        self.period_ns = period_ns
        self._plant = plant
        self._steps_per_period = plant.steps_in(period_ns * 1e-9)
        self._stamp_ns: int | None = None
        self._wheel_angles = plant.sense_wheels() - plant.truth().wheel_speeds * period_ns * 1e-9

    def step(self, stamp_ns: int, torques: Array) -> Samples:
        """Move the plant to the tick under constant torques, and sample all sensors there."""
        periods = 1
        if self._stamp_ns is not None:
            periods = max(1, round((stamp_ns - self._stamp_ns) / self.period_ns))
            self._plant.advance(periods * self._steps_per_period, torques)
        self._stamp_ns = stamp_ns
        truth = self._plant.truth()
        wheel_angles = self._plant.sense_wheels()
        speeds = (wheel_angles - self._wheel_angles) / (periods * self.period_ns * 1e-9)
        self._wheel_angles = wheel_angles
        return Samples(
            stamp_ns,
            (LinkSample(stamp_ns, ALL_LINKS, self._plant.sense_links()),),
            WheelSample(wheel_angles, speeds, truth.efforts),
            truth)
