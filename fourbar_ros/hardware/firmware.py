# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What the electronics of one link do: arming, limits, watchdog, faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
from dataclasses import dataclass
from math import copysign

from fourbar_ros.hardware.messages import Command, COUNTERS, Limits, LinkState

# A wheel beyond its speed limit by this factor is a fault of its own [1].
OVERSPEED = 1.2


@dataclass(frozen=True)
class FirmwareSettings:
    """
    What a link does by itself.

    :param command_timeout_s: longest time without a command while armed [s].
    :param hottest: beyond this the motor gets no current [deg C].
    :param lowest_voltage: below this likewise [V].
    """

    command_timeout_s: float = 0.1
    hottest: float = 95.0
    lowest_voltage: float = 9.5


class Firmware:
    """
    The electronics of a link, from its start on; times are of any steady clock [ns].

    :ivar state: what it does.
    :ivar faults: of `LINK_FAULTS`, as it tells them.
    :ivar sequence: of the last command that was obeyed.
    :ivar counts: of commands that were lost or not taken.
    :ivar temperature, voltage: as it measures them [deg C], [V].
    :ivar broken: faults that somebody made.
    """

    def __init__(self, link: int, settings: FirmwareSettings) -> None:
        self.link = link
        self.state = LinkState.IDLE
        self.sequence = 0
        self.counts: Counter[str] = Counter()
        self.temperature = 30.0
        self.voltage = 12.0
        self.broken: Set[str] = frozenset()
        self._settings = settings
        self._limits: Limits | None = None
        self._command: Command | None = None
        self._command_ns = 0
        self._overspeed = False

    @property
    def faults(self) -> frozenset[str]:
        """What is wrong with it."""
        found = set(self.broken)
        if self._limits is None:
            found.add('no_limits')
        if self._overspeed:
            found.add('overspeed')
        if self.temperature > self._settings.hottest:
            found.add('overtemperature')
        if self.voltage < self._settings.lowest_voltage:
            found.add('undervoltage')
        return frozenset(found)

    def load_limits(self, limits: Limits) -> None:
        """Take limits over; without them it is never armed."""
        self._limits = limits

    def stop(self) -> None:
        """Cut the power until it is released."""
        self.state = LinkState.STOPPED

    def release(self) -> None:
        """End the emergency stop."""
        if self.state is LinkState.STOPPED:
            self.state = LinkState.IDLE

    def command(self, command: Command, now_ns: int) -> None:
        """Take a command that is for this link, unless it came before."""
        last = self._command
        if last is not None:
            ahead = (command.sequence - last.sequence) % COUNTERS
            if ahead == 0 or ahead > COUNTERS // 2:
                # After a silence nobody knows how many were lost; but nothing that would drive a
                # wheel begins a new count.
                silent = now_ns - self._command_ns > self._settings.command_timeout_s * 1e9
                if command.enable or not silent:
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

    def watch(self, speed: float, now_ns: int) -> None:
        """
        Stop by itself where it must.

        :param speed: of the wheel relative to the link [rad/s].
        """
        limits = self._limits
        if limits is not None and abs(speed) > OVERSPEED * limits.speed:
            self._overspeed = True
        if self.state is LinkState.ARMED:
            if self._stopping_faults():
                self.state = LinkState.FAULT
            elif now_ns - self._command_ns > self._settings.command_timeout_s * 1e9:
                self.state = LinkState.COASTING

    def drive(self) -> tuple[float, bool, bool]:
        """Return what the motor is asked for, whether it is a speed, and whether it has power."""
        command, limits = self._command, self._limits
        if self.state is not LinkState.ARMED or command is None or limits is None:
            return 0.0, False, False
        limit = limits.speed if command.by_speed else limits.torque
        value = command.value
        if abs(value) > limit:
            value = copysign(limit, value)
            self.counts['clipped'] += 1
        return value, command.by_speed, True

    def _stopping_faults(self) -> frozenset[str]:
        return self.faults - {'no_limits'}
