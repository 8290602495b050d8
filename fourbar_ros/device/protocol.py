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
from fourbar_ros.mechanism.parameters import Array
from fourbar_ros.plant import Truth


@dataclass(frozen=True, eq=False)
class LinkSample:
    """
    Link orientations measured at one instant.

    :param stamp_ns: time of measurement [ns].
    :param links: indices of the links that gave a sample (0 for link a), increasing.
    :param angles: (n,) orientation of each in frame `table`, in (-pi, pi] [rad].
    """

    stamp_ns: int
    links: tuple[int, ...]
    angles: Array


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
    links: tuple[LinkSample, ...]
    wheels: WheelSample
    truth: Truth | None = None


class Device(Protocol):
    """
    A testbed.

    :cvar description: what it is, for people.
    :cvar mechanism: the linkage, its wheels and motor limits.
    :cvar period_ns: time between two ticks [ns].
    """

    description: str
    mechanism: Mechanism
    period_ns: int

    def step(self, stamp_ns: int, torques: Array) -> Samples:
        """
        Apply torques up to a tick, and report what was measured since the last one.

        :param stamp_ns: the tick; the first call only sets the time [ns].
        :param torques: (4,) within the motor limits [N m].
        :raises FourbarError: the device failed and must not be driven.
        """
