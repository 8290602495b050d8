# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Supervision of a device: arming, checks and limits of commands, timeouts, reaction to faults.

All times are arguments: `stamp_ns` is the time scale of messages, `monotonic_ns` that of the
watchdogs.
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
# Number of lost ticks whose late answers are still timed.
MAX_LATE_TICKS = 100


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
    Timing of the control loop.

    :param round_trip_s: from a tick to the command that answers it, None without a new one [s].
    :param command_age_s: time since the last command, None before the first [s].
    :param lost: ticks that were not answered within one period, since the first answer.
    :param step_s: duration of the last step of the device [s].
    """

    round_trip_s: float | None
    command_age_s: float | None
    lost: int
    step_s: float


class DeviceSupervisor:
    """
    A device with arming and watchdogs.

    :ivar arming: whether the wheels may be driven.
    :ivar rejected: number of rejected commands by kind.
    :ivar clipped: number of commands beyond a motor limit.
    :ivar last_rejection: reason of the last rejection, or ''.
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
        self._sample_ns: dict[str, int] = {}
        self._reported_state = self.arming.state
        self._stamp_ns = 0
        self._tick_ns: int | None = None
        # Time of publication of ticks without an answer, by stamp. After one period a tick counts
        # as lost, but its round trip is still reported when the answer arrives.
        self._open_ticks: dict[int, int] = {}
        self._lost_ticks: dict[int, int] = {}
        self._step_ns = 0
        self._command_stamp_ns: int | None = None
        self._command_ns: int | None = None
        self._armed_ns = 0
        self._round_trip_ns: int | None = None
        self._lost = 0

    def tick(self, stamp_ns: int, monotonic_ns: int) -> tuple[Samples, Timing]:
        """
        Step the device to a tick and sample it.

        :raises FourbarError: the device failed; the state is `fault` until a reset.
        """
        timing = self._timing(monotonic_ns)
        self._check_command_timeout(stamp_ns, monotonic_ns)
        try:
            samples = self.device.step(stamp_ns, self._present_drive())
        except FourbarError as error:
            self._fail(stamp_ns, error)
            raise
        self._stamp_ns = stamp_ns
        for sample in samples.links:
            for name in sample.names:
                self._sample_ns[name] = max(sample.stamp_ns, self._sample_ns.get(name, 0))
        if samples.complete:
            self._tick_ns = stamp_ns
            self._wheel_speeds = samples.wheels.speeds
        self._react_to_faults()
        return samples, timing

    def published(self, monotonic_ns: int, step_ns: int) -> None:
        """
        Register the publication of the samples of the last tick.

        :param step_ns: duration of the step of the device [ns].
        """
        if self._tick_ns is not None and self._tick_ns == self._stamp_ns:
            self._open_ticks[self._tick_ns] = monotonic_ns
        self._step_ns = step_ns

    def command(self, stamp_ns: int, names: Sequence[str], positions: Sequence[float],
                velocities: Sequence[float], efforts: Sequence[float], monotonic_ns: int) -> None:
        """
        Accept a wheel command, which acts until the next one.

        While armed, only the wheels that it names have power.

        :param stamp_ns: stamp of the tick that it answers [ns].
        :raises RejectedError: the whole command is rejected and counted.
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
            # Ticks before the first command had no controller to answer them.
            self._open_ticks = {tick: published_ns for tick, published_ns
                                in self._open_ticks.items() if tick >= stamp_ns}
        self._command_stamp_ns = stamp_ns
        self._command_ns = monotonic_ns
        self._answered(stamp_ns, monotonic_ns)
        self._drive = replace(drive, values=limited)
        if self.arming.armed:
            self._send_drive()

    def arm(self, monotonic_ns: int, arming_blockers: Sequence[str]) -> tuple[bool, str]:
        """
        Arm the device, unless something prevents it.

        :param arming_blockers: reasons beyond those of sensors and device.
        :returns: whether the device is armed now, and the reason.
        """
        silent = [name for name in self.device.sensor_names
                  if name not in self._sample_ns
                  or self._stamp_ns - self._sample_ns[name] > self._settings.sensor_timeout * 1e9]
        if silent:
            arming_blockers = [*arming_blockers, f'no sample from {", ".join(silent)} for '
                               f'{self._settings.sensor_timeout:g} s']
        arming_blockers = [*arming_blockers, *self.device.arming_blockers()]
        was_armed = self.arming.armed
        armed, message = self.arming.arm(self._stamp_ns, arming_blockers)
        if armed and not was_armed:
            self._armed_ns = monotonic_ns
            self._parked = None
            self._drive = no_torque()
            self._arming_changed()
        return armed, message

    def disarm(self, reason: str) -> None:
        """Disarm: the wheels coast without power."""
        parked, self._parked = self._parked is not None, None
        self.arming.disarm(self._stamp_ns, reason, parked)
        self._arming_changed()

    def emergency_stop(self, reason: str) -> None:
        """Disarm until a reset: the wheels coast without power."""
        self._parked = None
        self.arming.emergency_stop(self._stamp_ns, reason)
        self._arming_changed()

    def reset(self) -> tuple[bool, str]:
        """
        End emergency stop or fault, here and in the device; the wheels stay disarmed.

        The device may be stopped although the supervisor is not, by another or an earlier host.
        """
        latched = self.arming.state in (DeviceState.EMERGENCY_STOP, DeviceState.FAULT)
        answer = self.arming.reset(self._stamp_ns)
        self._arming_changed()
        if self.arming.state is not DeviceState.DISARMED:
            return answer
        held = self.device.release()
        if held and not latched:
            return True, f'{", ".join(held)}: the emergency stop is reset'
        return answer

    def close(self) -> None:
        """Disarm and close the device."""
        self.disarm('the node ends')
        self.device.close()

    def diagnostics(self) -> dict[str, object]:
        """Return states, counters and present faults by name."""
        return {
            'state': self.arming.state.value, 'reason': self.arming.reason,
            'ticks_lost': self._lost, 'commands_clipped': self.clipped,
            'last_rejection': self.last_rejection,
            **{f'commands_rejected_{kind}': count
               for kind, count in sorted(self.rejected.items())},
            **self.device.diagnostics(), **self.device.diagnostic_values()}

    def _arming_changed(self) -> None:
        """Report a change of the arming state to the device."""
        if self.arming.state is self._reported_state:
            return
        self._reported_state = self.arming.state
        self.device.arming_changed(self.arming.state)
        self._send_drive()

    def _send_drive(self) -> None:
        try:
            self.device.drive(self._present_drive())
        except FourbarError as error:
            self._fail(self._stamp_ns, error)

    def _fail(self, stamp_ns: int, error: FourbarError) -> None:
        self._parked = None
        self.arming.fail(stamp_ns, str(error))
        self._reported_state = self.arming.state

    def _react_to_faults(self) -> None:
        for fault in self.device.faults():
            if fault.reaction is Reaction.STOP:
                self.emergency_stop(fault.text)
            elif fault.reaction is Reaction.COAST:
                self.disarm(fault.text)

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
        """Return the timing since the last tick, and count the ticks that are lost now."""
        overdue = [stamp_ns for stamp_ns, published_ns in self._open_ticks.items()
                   if monotonic_ns - published_ns > self.device.period_ns]
        for stamp_ns in overdue:
            self._lost_ticks[stamp_ns] = self._open_ticks.pop(stamp_ns)
            self._lost += self._command_stamp_ns is not None
        while len(self._lost_ticks) > MAX_LATE_TICKS:
            del self._lost_ticks[next(iter(self._lost_ticks))]
        round_trip_ns, self._round_trip_ns = self._round_trip_ns, None
        return Timing(
            round_trip_ns * 1e-9 if round_trip_ns is not None else None,
            (monotonic_ns - self._command_ns) * 1e-9
            if self._command_ns is not None else None,
            self._lost, self._step_ns * 1e-9)

    def _check_command_timeout(self, stamp_ns: int, monotonic_ns: int) -> None:
        if not self.arming.armed:
            return
        last_ns = max(self._armed_ns, self._command_ns or 0)
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
