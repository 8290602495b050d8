# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""One round of what emulated links do: wait for a frame or a step, and answer."""

from __future__ import annotations

from collections.abc import Callable

from fourbar_ros.hardware.emulator import Emulator
from fourbar_ros.hardware.prototype import Bus


def attend(emulator: Emulator, bus: Bus, monotonic_ns: Callable[[], int]) -> int:
    """
    Wait for the next frame or for the table's next step, and do what it takes.

    :param steady_ns: reads the clock of the emulator [ns].
    :returns: the time afterwards [ns].
    :raises BusError: the bus is gone, or somebody else speaks for one of these links.
    """
    received = bus.receive(max((emulator.next_ns - monotonic_ns()) * 1e-9, 0.0))
    while received is not None:
        for frame in emulator.take(received[0], monotonic_ns()):
            bus.send(frame)
        # A step that is due comes first, or a flood would stop the table.
        received = bus.receive(0.0) if monotonic_ns() < emulator.next_ns else None
    now_ns = monotonic_ns()
    if now_ns >= emulator.next_ns:
        for frame in emulator.advance(now_ns):
            bus.send(frame)
    return now_ns
