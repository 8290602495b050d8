# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Arming: the states in which the wheels may or may not be driven."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum


class DeviceState(Enum):
    """State of the device; the wheels may be driven only in `armed`."""

    DISARMED = 'disarmed'
    ARMED = 'armed'
    EMERGENCY_STOP = 'emergency_stop'
    FAULT = 'fault'


class Arming:
    """
    State machine of arming.

    Emergency stop and fault are latched: only a reset ends them, and it leads to disarmed.

    :ivar state: present state.
    :ivar reason: reason of the last change.
    :ivar since_ns: stamp of the last change [ns].
    """

    def __init__(self) -> None:
        self.state = DeviceState.DISARMED
        self.reason = 'not armed since start'
        self.since_ns = 0

    @property
    def armed(self) -> bool:
        """Whether the wheels may be driven."""
        return self.state is DeviceState.ARMED

    def arm(self, stamp_ns: int, arming_blockers: Sequence[str]) -> tuple[bool, str]:
        """
        Arm, unless the state or another reason prevents it.

        :param arming_blockers: other reasons.
        :returns: whether the state is armed now, and the reason.
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
        Disarm; a latched state stays.

        :param parked: whether wheels have power although disarmed; then the reason changes too.
        """
        if self.armed or (parked and self.state is DeviceState.DISARMED):
            self._enter(DeviceState.DISARMED, reason, stamp_ns)

    def emergency_stop(self, stamp_ns: int, reason: str) -> None:
        """Latch an emergency stop; the first reason is kept."""
        if self.state is not DeviceState.EMERGENCY_STOP:
            self._enter(DeviceState.EMERGENCY_STOP, reason, stamp_ns)

    def fail(self, stamp_ns: int, reason: str) -> None:
        """Latch a fault of the device; an emergency stop stays."""
        if self.state not in (DeviceState.EMERGENCY_STOP, DeviceState.FAULT):
            self._enter(DeviceState.FAULT, reason, stamp_ns)

    def reset(self, stamp_ns: int) -> tuple[bool, str]:
        """End emergency stop or fault; the device is disarmed then."""
        if self.state not in (DeviceState.EMERGENCY_STOP, DeviceState.FAULT):
            return True, f'nothing to reset: {self.state.value}'
        before = self.state.value
        self._enter(DeviceState.DISARMED, f'{before} was reset', stamp_ns)
        return True, f'{before} is reset, disarmed'

    def _enter(self, state: DeviceState, reason: str, stamp_ns: int) -> None:
        self.state, self.reason, self.since_ns = state, reason, stamp_ns
