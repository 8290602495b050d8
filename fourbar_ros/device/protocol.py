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

"""What a testbed offers, whether it is simulated or stands in the lab."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant import SensorReading, Truth
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Drive:
    """
    What the motors are asked for until the next tick.

    :param values: (4,) torque [N m], or speed of the wheel relative to its link [rad/s].
    :param by_speed: (4,) bool, which of both; speeds are followed by the motors' own electronics.
    :param powered: (4,) bool, whose power stage is on; a wheel without power coasts, whatever its
        value.
    """

    values: Array
    by_speed: NDArray[np.bool_]
    powered: NDArray[np.bool_]


def no_torque() -> Drive:
    """Let all wheels coast, without power."""
    return Drive(np.zeros(4), np.zeros(4, dtype=bool), np.zeros(4, dtype=bool))


@dataclass(frozen=True, eq=False)
class WheelSample:
    """
    The four wheels at a tick.

    :param angles: (4,) relative to the link, unwrapped [rad].
    :param speeds: (4,) relative to the link [rad/s].
    :param efforts: (4,) torque really applied to the wheel [N m].
    """

    angles: Array
    speeds: Array
    efforts: Array


@dataclass(frozen=True, eq=False)
class Samples:
    """Everything that a testbed has to say at a tick; `truth` only where it is simulated."""

    stamp_ns: int
    links: tuple[SensorReading, ...]
    wheels: WheelSample
    truth: Truth | None = None


class Device(Protocol):
    """
    A testbed.

    :cvar description: what it is, for people.
    :cvar mechanism: the linkage, its wheels and motor limits.
    :cvar period_ns: time between two ticks [ns].
    :cvar sensor_names: the sensors of the links, `link_a` and so on.
    :cvar measures_rates: whether they have gyros.
    """

    description: str
    mechanism: Mechanism
    period_ns: int
    sensor_names: tuple[str, ...]
    measures_rates: bool

    def step(self, stamp_ns: int, drive: Drive) -> Samples:
        """
        Drive the wheels up to a tick, and report what was measured since the last one.

        :param stamp_ns: the tick; the first call only sets the time [ns].
        :param drive: within the motor limits.
        :raises FourbarError: the device failed and must not be driven.
        """

    def diagnosis(self) -> dict[str, str]:
        """Tell what is not as it should be, by what it is about; nothing if all is well."""
