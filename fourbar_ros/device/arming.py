# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The arming gate: whether the wheels may be driven, and why not."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum


class DeviceState(Enum):
    """Whether the wheels may be driven; only `armed` lets torque through."""

    DISARMED = 'disarmed'
    ARMED = 'armed'
    EMERGENCY_STOP = 'emergency_stop'
    FAULT = 'fault'


class Arming:
    """
    A small state machine with one way to drive wheels and many ways to stop.

    Emergency stop and fault are latched: only a reset leads out of them, and only to disarmed.

    :ivar state: present state.
    :ivar reason: why it is in this state.
    :ivar since_ns: stamp of the change [ns].
    """

    def __init__(self) -> None:
        self.state = DeviceState.DISARMED
        self.reason = 'not armed since start'
        self.since_ns = 0

    @property
    def armed(self) -> bool:
        """Tell whether torque may pass."""
        return self.state is DeviceState.ARMED

    def arm(self, stamp_ns: int, arming_blockers: Sequence[str]) -> tuple[bool, str]:
        """
        Ask to let torque through.

        :param obstacles: what else speaks against it.
        :returns: whether the gate is armed now, and why (not).
        """
        if self.armed:
            return True, 'already armed'
        if self.state is not DeviceState.DISARMED:
            return False, (f'refused: {self.state.value} ({self.reason}), '
                           'call reset_emergency_stop first')
        if arming_blockers:
            return False, f'refused: {"; ".join(arming_blockers)}'
        self._enter(DeviceState.ARMED, 'armed on request', stamp_ns)
        return True, 'armed'

    def disarm(self, stamp_ns: int, reason: str, parked: bool = False) -> None:
        """
        Stop driving; a latched state stays.

        :param parked: whether wheels had power though disarmed, so that there is something to end.
        """
        if self.armed or (parked and self.state is DeviceState.DISARMED):
            self._enter(DeviceState.DISARMED, reason, stamp_ns)

    def emergency_stop(self, stamp_ns: int, reason: str) -> None:
        """Stop driving until reset; the first reason is kept."""
        if self.state is not DeviceState.EMERGENCY_STOP:
            self._enter(DeviceState.EMERGENCY_STOP, reason, stamp_ns)

    def fail(self, stamp_ns: int, reason: str) -> None:
        """Stop driving because the device failed; an emergency stop stays what it is."""
        if self.state not in (DeviceState.EMERGENCY_STOP, DeviceState.FAULT):
            self._enter(DeviceState.FAULT, reason, stamp_ns)

    def reset(self, stamp_ns: int) -> tuple[bool, str]:
        """Release emergency stop or fault; the wheels stay disarmed."""
        if self.state not in (DeviceState.EMERGENCY_STOP, DeviceState.FAULT):
            return True, f'nothing to reset: {self.state.value}'
        before = self.state.value
        self._enter(DeviceState.DISARMED, f'{before} was reset', stamp_ns)
        return True, f'{before} is reset, disarmed'

    def _enter(self, state: DeviceState, reason: str, stamp_ns: int) -> None:
        self.state, self.reason, self.since_ns = state, reason, stamp_ns
