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

"""One round of what emulated links do: wait for a frame or a step, and answer."""

from __future__ import annotations

from collections.abc import Callable

from fourbar_ros.device.prototype.emulator import Emulator
from fourbar_ros.device.prototype.prototype import Bus


def attend(emulator: Emulator, bus: Bus, steady_ns: Callable[[], int]) -> int:
    """
    Wait for the next frame or for the table's next step, and do what it takes.

    :param steady_ns: reads the clock of the emulator [ns].
    :returns: the time afterwards [ns].
    :raises BusError: the bus is gone, or somebody else speaks for one of these links.
    """
    received = bus.receive(max((emulator.next_ns - steady_ns()) * 1e-9, 0.0))
    while received is not None:
        for frame in emulator.take(received[0], steady_ns()):
            bus.send(frame)
        # A step that is due comes first, or a flood would stop the table.
        received = bus.receive(0.0) if steady_ns() < emulator.next_ns else None
    now_ns = steady_ns()
    if now_ns >= emulator.next_ns:
        for frame in emulator.advance(now_ns):
            bus.send(frame)
    return now_ns
