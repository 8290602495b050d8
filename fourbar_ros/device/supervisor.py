# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
A device behind its arming gate: commands are checked, watched, limited, and stopped.

All times come in as arguments: `stamp_ns` is the time that messages carry, `monotonic_ns` a clock
that nobody can set or freeze.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.common.settings import setting, Settings
from fourbar_ros.device.arming import Arming, DeviceState
from fourbar_ros.device.command import drive_by_name
from fourbar_ros.device.interface import Device, Drive, no_torque, Reaction, Samples
from fourbar_ros.mechanism.constants import Array
import numpy as np

TIMEOUT_ACTIONS = ('coast', 'hold_speed', 'brake')


# Ticks after which an answer is no longer waited for.
LONGEST_WAIT = 100


@dataclass(frozen=True)
class SupervisorSettings(Settings):
    """
    Control rate, watchdogs and reaction of the supervisor; common to every device.

    `timeout_action` is `coast` (no power), `hold_speed`, or `brake` (to rest relative to the link;
    the momentum of the wheels goes into the links).
    """

    rate: float = setting(
        250.0, 'Hz', 'control rate, one tick per period', low=1.0, high=2000.0)
    command_timeout: float = setting(
        0.1, 's', 'longest time without a command while armed', low=0.002, high=10.0)
    sensor_timeout: float = setting(
        0.2, 's', 'a link without a sample for this time blocks arming', low=0.002, high=10.0)
    timeout_action: str = setting(
        'coast', '', 'reaction of the wheels when commands time out', choices=TIMEOUT_ACTIONS)

    @property
    def period_ns(self) -> int:
        """Time between two ticks [ns]."""
        return round(1e9 / self.rate)


@dataclass(frozen=True)
class Timing:
    """
    How the loop around the device keeps time.

    :param round_trip_s: from a tick to the command that answers it, None if none did [s].
    :param command_age_s: how long ago the command now in force came, None if none is [s].
    :param lost: ticks that were not answered within one period, since the first answer.
    :param step_s: time that the device needed for the last step [s].
    """

    round_trip_s: float | None
    command_age_s: float | None
    lost: int
    step_s: float


class DeviceSupervisor:
    """
    One device, its gate, its watchdogs.

    :ivar gate: whether the wheels may be driven.
    :ivar rejected: number of rejected commands by kind.
    :ivar clipped: number of commands that asked more than a motor has.
    :ivar last_rejection: what was wrong with the last rejected command, or ''.
    """

    def __init__(self, device: Device, settings: SupervisorSettings) -> None:
        self.device = device
        self.arming = Arming()
        self.rejected: Counter[str] = Counter()
        self.clipped = 0
        self.last_rejection = ''
        self._settings = settings
        self._drive = no_torque()
        self._parked: Drive | None = None
        self._wheel_speeds = np.zeros(4)
        self._seen_ns: dict[str, int] = {}
        self._known_state = self.arming.state
        self._stamp_ns = 0
        self._tick_ns: int | None = None
        # Ticks without an answer so far: when each went out, by stamp. Those that have waited for
        # more than a period are counted as lost, but their round trip is still told if it ends.
        self._open_ticks: dict[int, int] = {}
        self._lost_ticks: dict[int, int] = {}
        self._step_ns = 0
        self._command_stamp_ns: int | None = None
        self._command_steady_ns: int | None = None
        self._armed_steady_ns = 0
        self._round_trip_ns: int | None = None
        self._lost = 0

    def tick(self, stamp_ns: int, monotonic_ns: int) -> tuple[Samples, Timing]:
        """
        Drive the device up to a tick and sample it.

        :raises FourbarError: the device failed; the gate is in `fault`, and stays there.
        """
        timing = self._timing(monotonic_ns)
        self._watch_commands(stamp_ns, monotonic_ns)
        try:
            samples = self.device.step(stamp_ns, self._present_drive())
        except FourbarError as error:
            self._fail(stamp_ns, error)
            raise
        self._stamp_ns = stamp_ns
        for sample in samples.links:
            for name in sample.names:
                self._seen_ns[name] = max(sample.stamp_ns, self._seen_ns.get(name, 0))
        if samples.complete:
            self._tick_ns = stamp_ns
            self._wheel_speeds = samples.wheels.speeds
        self._heed()
        return samples, timing

    def published(self, monotonic_ns: int, step_ns: int) -> None:
        """
        Note when the samples of the last tick went out.

        :param step_ns: time that the device needed for it [ns].
        """
        if self._tick_ns is not None and self._tick_ns == self._stamp_ns:
            self._open_ticks[self._tick_ns] = monotonic_ns
        self._step_ns = step_ns

    def command(self, stamp_ns: int, names: Sequence[str], positions: Sequence[float],
                velocities: Sequence[float], efforts: Sequence[float], monotonic_ns: int) -> None:
        """
        Take a wheel command, to act from the last tick on.

        While armed it powers the wheels that it names, and no others.

        :param stamp_ns: the tick that it answers [ns].
        :raises RejectedError: it is rejected whole; also counted.
        """
        try:
            self._check_stamp(stamp_ns)
            drive = drive_by_name(names, positions, velocities, efforts)
        except RejectedError as error:
            self.rejected[error.kind] += 1
            self.last_rejection = str(error)
            raise
        mechanism = self.device.mechanism
        limits = np.where(
            drive.by_speed, mechanism.motor_speed_limits, mechanism.motor_torque_limits)
        limited = np.clip(drive.values, -limits, limits)
        self.clipped += bool((limited != drive.values).any())
        if self._command_stamp_ns is None:
            # Nobody was there yet to answer the ticks before this one.
            self._open_ticks = {tick: published_ns for tick, published_ns
                                in self._open_ticks.items() if tick >= stamp_ns}
        self._command_stamp_ns = stamp_ns
        self._command_steady_ns = monotonic_ns
        self._answered(stamp_ns, monotonic_ns)
        self._drive = replace(drive, values=limited)
        if self.arming.armed:
            self._tell_device()

    def arm(self, monotonic_ns: int, arming_blockers: Sequence[str]) -> tuple[bool, str]:
        """
        Ask to drive the wheels.

        :param obstacles: what speaks against it beyond what is known here.
        :returns: whether it is armed now, and why (not).
        """
        silent = [name for name in self.device.sensor_names
                  if name not in self._seen_ns
                  or self._now_ns - self._seen_ns[name] > self._settings.sensor_timeout * 1e9]
        if silent:
            arming_blockers = [*arming_blockers, f'no sample from {", ".join(silent)} for '
                                     f'{self._settings.sensor_timeout:g} s']
        arming_blockers = [*arming_blockers, *self.device.arming_blockers()]
        was_armed = self.arming.armed
        armed, message = self.arming.arm(self._now_ns, arming_blockers)
        if armed and not was_armed:
            self._armed_steady_ns = monotonic_ns
            self._parked = None
            self._drive = no_torque()
            self._arming_changed()
        return armed, message

    def disarm(self, reason: str) -> None:
        """Stop driving: the wheels coast, without power."""
        parked, self._parked = self._parked is not None, None
        self.arming.disarm(self._now_ns, reason, parked)
        self._arming_changed()

    def emergency_stop(self, reason: str) -> None:
        """Stop driving until reset: the wheels coast, without power."""
        self._parked = None
        self.arming.emergency_stop(self._now_ns, reason)
        self._arming_changed()

    def reset(self) -> tuple[bool, str]:
        """
        Release emergency stop or fault, here and in the device; the wheels stay disarmed.

        The device may be stopped though the gate is not: by an earlier host, or by others.
        """
        latched = self.arming.state in (DeviceState.EMERGENCY_STOP, DeviceState.FAULT)
        answer = self.arming.reset(self._now_ns)
        self._arming_changed()
        if self.arming.state is not DeviceState.DISARMED:
            return answer
        held = self.device.release()
        if held and not latched:
            return True, f'{", ".join(held)}: the emergency stop is reset'
        return answer

    def close(self) -> None:
        """Leave the wheels without power, and the device to others."""
        self.disarm('the node ends')
        self.device.close()

    def diagnostics(self) -> dict[str, object]:
        """Tell what a person wants to know when something is wrong."""
        return {
            'state': self.arming.state.value, 'reason': self.arming.reason,
            'ticks_lost': self._lost, 'commands_clipped': self.clipped,
            'last_rejection': self.last_rejection,
            **{f'commands_rejected_{kind}': count
               for kind, count in sorted(self.rejected.items())},
            **self.device.diagnostics(), **self.device.diagnostic_values()}

    @property
    def _now_ns(self) -> int:
        """Return the stamp of the last step of the device, 0 before the first [ns]."""
        return self._stamp_ns

    def _arming_changed(self) -> None:
        """Let the device know at once, if it does not yet."""
        if self.arming.state is self._known_state:
            return
        self._known_state = self.arming.state
        self.device.arming_changed(self.arming.state)
        self._tell_device()

    def _tell_device(self) -> None:
        try:
            self.device.drive(self._present_drive())
        except FourbarError as error:
            self._fail(self._now_ns, error)

    def _fail(self, stamp_ns: int, error: FourbarError) -> None:
        self._parked = None
        self.arming.fail(stamp_ns, str(error))
        self._known_state = self.arming.state

    def _heed(self) -> None:
        """Do what the findings of the device lead to."""
        for finding in self.device.faults():
            if finding.reaction is Reaction.STOP:
                self.emergency_stop(finding.text)
            elif finding.reaction is Reaction.COAST:
                self.disarm(finding.text)

    def _check_stamp(self, stamp_ns: int) -> None:
        if self._tick_ns is None:
            raise RejectedError('stale', 'no tick to answer yet')
        age_s = (self._tick_ns - stamp_ns) * 1e-9
        if age_s > self._settings.command_timeout:
            raise RejectedError('stale', f'stamp is {age_s:g} s older than the last tick, limit '
                                        f'{self._settings.command_timeout:g} s')
        if age_s < 0.0:
            raise RejectedError('stale', f'stamp is {-age_s:g} s ahead of the last tick')
        if self._command_stamp_ns is not None and stamp_ns < self._command_stamp_ns:
            raise RejectedError('stale', 'stamp is older than that of the last command')

    def _answered(self, stamp_ns: int, monotonic_ns: int) -> None:
        if stamp_ns in self._open_ticks:
            self._round_trip_ns = monotonic_ns - self._open_ticks.pop(stamp_ns)
            self._lost += self._round_trip_ns > self.device.period_ns
        elif stamp_ns in self._lost_ticks:
            self._round_trip_ns = monotonic_ns - self._lost_ticks.pop(stamp_ns)

    def _timing(self, monotonic_ns: int) -> Timing:
        """Report the last answer, and give up on ticks that waited for more than a period."""
        overdue = [stamp_ns for stamp_ns, published_ns in self._open_ticks.items()
                   if monotonic_ns - published_ns > self.device.period_ns]
        for stamp_ns in overdue:
            self._lost_ticks[stamp_ns] = self._open_ticks.pop(stamp_ns)
            self._lost += self._command_stamp_ns is not None
        while len(self._lost_ticks) > LONGEST_WAIT:
            del self._lost_ticks[next(iter(self._lost_ticks))]
        round_trip_ns, self._round_trip_ns = self._round_trip_ns, None
        return Timing(
            round_trip_ns * 1e-9 if round_trip_ns is not None else None,
            (monotonic_ns - self._command_steady_ns) * 1e-9
            if self._command_steady_ns is not None else None,
            self._lost, self._step_ns * 1e-9)

    def _watch_commands(self, stamp_ns: int, monotonic_ns: int) -> None:
        if not self.arming.armed:
            return
        last_ns = max(self._armed_steady_ns, self._command_steady_ns or 0)
        if monotonic_ns - last_ns > self._settings.command_timeout * 1e9:
            self.arming.disarm(
                stamp_ns, f'no flywheel_command for {self._settings.command_timeout:g} s')
            if self._settings.timeout_action == 'hold_speed':
                self._parked = _at_speeds(self._wheel_speeds)
            elif self._settings.timeout_action == 'brake':
                self._parked = _at_speeds(np.zeros(4))
            self._arming_changed()

    def _present_drive(self) -> Drive:
        if self.arming.armed:
            return self._drive
        return self._parked or no_torque()


def _at_speeds(speeds: Array) -> Drive:
    return Drive(speeds.copy(), np.ones(4, dtype=bool), np.ones(4, dtype=bool))
