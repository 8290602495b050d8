# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Electronics of one emulated link: arming, limits, command timeout, faults."""

from __future__ import annotations

from collections import Counter
from math import copysign

from fourbar_ros.hardware.messages import Command, COUNTERS, Limits, LinkState

# Ratio of wheel speed to speed limit above which a link reports `overspeed`; the margin covers the
# overshoot of a speed controller at the limit.
OVERSPEED = 1.2


# Limits at which a link cuts the power [deg C], [V]; beyond those of the host's safety rules, so
# that the host reacts first.
MAX_TEMPERATURE, MIN_VOLTAGE = 95.0, 9.5


class Firmware:
    """
    Electronics of a link since their start; times are of any monotonic clock [ns].

    :param command_timeout_s: longest time without a command while armed [s].
    :ivar state: present state.
    :ivar sequence: of the last command that was carried out.
    :ivar counts: number of lost, repeated and limited commands.
    :ivar temperature, voltage: measured values [deg C], [V].
    """

    def __init__(self, command_timeout_s: float) -> None:
        self.state = LinkState.IDLE
        self.sequence = 0
        self.counts: Counter[str] = Counter()
        self.temperature = 30.0
        self.voltage = 12.0
        self._timeout_ns = command_timeout_s * 1e9
        self._limits: Limits | None = None
        self._command: Command | None = None
        self._command_ns = 0
        self._overspeed = False

    @property
    def faults(self) -> frozenset[str]:
        """Present faults, of `LINK_FAULTS`."""
        present = {
            'no_limits': self._limits is None, 'overspeed': self._overspeed,
            'overtemperature': self.temperature > MAX_TEMPERATURE,
            'undervoltage': self.voltage < MIN_VOLTAGE}
        return frozenset(fault for fault, is_present in present.items() if is_present)

    def load_limits(self, limits: Limits) -> None:
        """Accept limits; a link without limits cannot be armed."""
        self._limits = limits

    def stop(self) -> None:
        """Cut the power until `release`."""
        self.state = LinkState.STOPPED

    def release(self) -> None:
        """End the emergency stop."""
        if self.state is LinkState.STOPPED:
            self.state = LinkState.IDLE

    def command(self, command: Command, now_ns: int) -> None:
        """Accept a command to this link, unless it is a repetition of an earlier one."""
        last = self._command
        if last is not None:
            ahead = (command.sequence - last.sequence) % COUNTERS
            if ahead == 0 or ahead > COUNTERS // 2:
                # After a timeout the number of lost commands is unknown, so any sequence is
                # accepted, but only from a command without power.
                timed_out = self._is_timed_out(now_ns)
                if command.enable or not timed_out:
                    self.counts['replayed'] += 1
                    return
                ahead = 1
            self.counts['lost_commands'] += ahead - 1
        self._command, self._command_ns = command, now_ns
        self.sequence = command.sequence
        if not command.enable:
            if self.state is not LinkState.STOPPED:
                self._overspeed = False
                self.state = LinkState.FAULT if self._stopping_faults() else LinkState.IDLE
        elif self.state is LinkState.IDLE and not self.faults:
            self.state = LinkState.ARMED

    def monitor(self, speed: float, now_ns: int) -> None:
        """
        Check limits and command timeout.

        :param speed: of the wheel relative to the link [rad/s].
        """
        limits = self._limits
        if limits is not None and abs(speed) > OVERSPEED * limits.speed:
            self._overspeed = True
        if self.state is LinkState.ARMED:
            if self._stopping_faults():
                self.state = LinkState.FAULT
            elif self._is_timed_out(now_ns):
                self.state = LinkState.COASTING

    def drive(self) -> tuple[float, bool, bool]:
        """Return the input of the motor, whether it is a speed, and whether it has power."""
        command, limits = self._command, self._limits
        if self.state is not LinkState.ARMED or command is None or limits is None:
            return 0.0, False, False
        limit = limits.speed if command.by_speed else limits.torque
        value = command.value
        if abs(value) > limit:
            value = copysign(limit, value)
            self.counts['clipped'] += 1
        return value, command.by_speed, True

    def _is_timed_out(self, now_ns: int) -> bool:
        return now_ns - self._command_ns > self._timeout_ns

    def _stopping_faults(self) -> frozenset[str]:
        return self.faults - {'no_limits'}
