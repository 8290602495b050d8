# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The prototype as a device: four links on a bus.

At every tick the host sends `Sync` to all links and waits for the answers of wheels and motors;
angle samples, clock reports and heartbeats are received at the same time. A command is sent as
soon as it arrives. While the device is not armed, every tick repeats to all links that they have
no power.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from fourbar_ros.common.settings import setting, Settings
from fourbar_ros.device.arming import DeviceState
from fourbar_ros.device.interface import (
    Device,
    DeviceFault,
    Drive,
    no_torque,
    Samples,
    WheelSample,
)
from fourbar_ros.hardware import messages
from fourbar_ros.hardware.link_telemetry import LinkTelemetry
from fourbar_ros.hardware.messages import Bus, BusError, Codec, COUNTERS, FrameError
from fourbar_ros.hardware.safety_monitor import SafetyMonitor
from fourbar_ros.hardware.safety_table import SafetyTable
from fourbar_ros.mechanism import LINK_NAMES, Mechanism
from fourbar_ros.mechanism.samples import LinkSample
import numpy as np

LINKS = range(4)

# Frames that are received in one call without waiting; the limit keeps a flooded bus from blocking
# the host.
MAX_FRAMES_PER_POLL = 2000
# Counters whose sum per second is compared with the rule `bad_frames`.
REJECTED_FRAMES = ('length', 'checksum', 'value', 'replayed', 'late', 'wrong_time', 'foreign')
# Minimum interval between two attempts to open the bus again [ns].
REOPEN_NS = 1_000_000_000
# Number of repetitions of the last command when the host leaves; a frame may be lost.
FINAL_COMMANDS = 3
NO_RATE = 'its angle samples have no rate and are ignored: without a gyro set gyro to false'


@dataclass(frozen=True)
class PrototypeSettings(Settings):
    """Settings of the prototype, beside those of the bus."""

    safety: str = setting('prototype', '', 'preset or path of a table of limits and reactions')
    answer_timeout: float = setting(
        0.002, 's', 'longest wait of a tick for the answers of the wheels', low=1e-4,
        high=0.1)
    gyro: bool = setting(False, '', 'whether the links have gyros')


class Prototype(Device):
    """
    Four links behind the device interface.

    :param mechanism: the linkage, its wheels, motor limits and offsets of the angle sensors.
    :param open_bus: opens the bus, at the start and after a bus fault; raises `BusError`.
    :param codec: protocol on the bus.
    :param safety: limits and reactions.
    :param settings: answer timeout and gyros.
    :param period_ns: time between two ticks [ns].
    :param monotonic_ns: reads the host's monotonic clock [ns].
    :param stamp_of: converts its times to stamps [ns].
    :ivar links: telemetry of the links.
    """

    description = 'prototype'
    sensor_names = LINK_NAMES
    timing_names = ('bus_round_trip_s', 'angle_age_s', 'clock_jitter_s')

    def __init__(self, mechanism: Mechanism, open_bus: Callable[[], Bus], codec: Codec,
                 safety: SafetyTable, settings: PrototypeSettings, period_ns: int,
                 monotonic_ns: Callable[[], int], stamp_of: Callable[[int], int]) -> None:
        self.mechanism = mechanism
        self.period_ns = period_ns
        self.measures_rates = settings.gyro
        self.links = [LinkTelemetry() for _ in LINKS]
        self._codec = codec
        self._open_bus = open_bus
        self._bus: Bus | None = open_bus()
        # After a failed attempt to open the bus: the time of the next one, and the error.
        self._reopen_ns: int | None = None
        self._open_error = ''
        self._without_rate: set[str] = set()
        self._monotonic_ns = monotonic_ns
        self._stamp_of = stamp_of
        self._answer_timeout_ns = round(settings.answer_timeout * 1e9)
        self._counts: Counter[str] = Counter()
        self._state = DeviceState.DISARMED
        self._drive = no_torque()
        self._sequences = [0, 0, 0, 0]
        self._counter = 0
        self._sync_sent_ns = [0] * COUNTERS
        self._silence_limit_ns = safety['wheel_silent'].limit * 1e9
        self._monitor = SafetyMonitor(mechanism, safety, self.links, monotonic_ns())

    def step(self, stamp_ns: int, drive: Drive) -> Samples:
        """
        Exchange commands and answers with the links, and check the safety rules.

        :raises BusError: the bus cannot be used. The next step opens it again, but not more often
            than every second unless the arming state has changed.
        """
        if self._bus is None:
            self._bus = self._reopen()
        self._drive = drive
        try:
            round_trip_ns = self._exchange(drive)
        except BusError:
            self._close_bus()
            raise
        now_ns = self._monotonic_ns()
        self._monitor.check(now_ns, self._drive, sum(
            self._counts[kind] + sum(link.counts[kind] for link in self.links)
            for kind in REJECTED_FRAMES))
        return self._samples(stamp_ns, now_ns, round_trip_ns)

    def drive(self, drive: Drive) -> None:
        """
        Send a drive to the links.

        :raises BusError: the bus cannot be used.
        """
        self._drive = drive
        if self._bus is None:
            return
        try:
            self._send_drive(drive)
        except BusError:
            self._close_bus()
            raise

    def arming_changed(self, state: DeviceState) -> None:
        """Pass an emergency stop on to the links."""
        self._state = state
        self._reopen_ns = None
        self._monitor.arming_changed(state, self._monotonic_ns())
        if state is DeviceState.EMERGENCY_STOP:
            self._try_send(messages.Stop())

    def release(self) -> Sequence[str]:
        """Release all links; return those that report the state `stopped`."""
        self._try_send(messages.Release())
        if self._bus is None:
            return []
        return [name for name, link in zip(LINK_NAMES, self.links)
                if link.state is messages.LinkState.STOPPED]

    def arming_blockers(self) -> Sequence[str]:
        """Return what prevents arming: missing rates, and what the safety monitor reports."""
        return [*(f'{name}: {NO_RATE}' for name in sorted(self._without_rate)),
                *self._monitor.arming_blockers()]

    def faults(self) -> Sequence[DeviceFault]:
        """Return the faults of the last step to which the device must react."""
        return self._monitor.faults

    def diagnostics(self) -> dict[str, str]:
        """Return present faults and warnings by subject."""
        if self._bus is None:
            return {'bus': 'the bus is closed'}
        texts: dict[str, str] = {}
        if fault := self._bus.fault:
            texts['bus'] = fault
        if missing := [name for name, link in zip(LINK_NAMES, self.links)
                       if link.heartbeat_ns is None]:
            texts['missing'] = f'waiting for {", ".join(missing)}: no heartbeat since start'
        texts.update(dict.fromkeys(sorted(self._without_rate), NO_RATE))
        for subject, text in self._monitor.diagnostics().items():
            texts[subject] = '; '.join(filter(None, (texts.get(subject), text)))
        return texts

    def diagnostic_values(self) -> dict[str, object]:
        """Return counters of the bus, and health and clock of each link."""
        values = {} if self._bus is None else self._bus.diagnostic_values()
        values.update({f'frames_{kind}': count for kind, count in sorted(self._counts.items())})
        for name, link in zip(LINK_NAMES, self.links):
            heartbeat = link.heartbeat
            if heartbeat is None:
                continue
            values[f'{name}.state'] = '' if link.state is None else link.state.name.lower()
            values[f'{name}.faults'] = ', '.join(sorted(heartbeat.faults))
            if heartbeat.voltage is not None:
                values[f'{name}.voltage_v'] = f'{heartbeat.voltage:.2f}'
            if heartbeat.temperature is not None:
                values[f'{name}.temperature_deg_c'] = f'{heartbeat.temperature:.1f}'
            values[f'{name}.clock_drift_ppm'] = f'{link.clock.drift * 1e6:.2f}'
            values[f'{name}.clock_jitter_us'] = f'{link.clock.jitter * 1e6:.1f}'
            values[f'{name}.restarts'] = link.restarts
            values.update({f'{name}.{kind}': count for kind, count in sorted(link.counts.items())})
        return values

    def close(self) -> None:
        """Switch the power of all links off, and close the bus."""
        self._state = DeviceState.DISARMED
        if self._bus is not None:
            with suppress(BusError):
                for _ in range(FINAL_COMMANDS):
                    self._send_drive(no_torque())
        self._close_bus()

    # Exchange of frames

    def _exchange(self, drive: Drive) -> int | None:
        """
        Send drive and `Sync` of a tick, and receive the answers.

        :returns: time until all wheels and motors have answered [ns], None if one did not.
        """
        self._receive_pending()
        counter = self._counter = (self._counter + 1) % COUNTERS
        for link in self.links:
            link.start_cycle()
        if self._state is DeviceState.EMERGENCY_STOP:
            # Repeated at every tick, since a link that restarts forgets it.
            self._send(messages.Stop())
        elif self._state is not DeviceState.ARMED:
            self._send_drive(drive)
        sent_ns = self._sync_sent_ns[counter] = self._monotonic_ns()
        self._send(messages.Sync(counter))
        expected = [link for link in self.links if link.answer_ns is not None] or self.links
        deadline_ns = sent_ns + self._answer_timeout_ns
        while any(link.missing for link in expected):
            remaining_ns = deadline_ns - self._monotonic_ns()
            if remaining_ns <= 0 or not self._receive_one(remaining_ns * 1e-9):
                break
        self._receive_pending()
        if any(link.missing for link in self.links):
            return None
        return max(link.answer_ns or 0 for link in self.links) - sent_ns

    def _receive_pending(self) -> None:
        for _ in range(MAX_FRAMES_PER_POLL):
            if not self._receive_one(0.0):
                return

    def _receive_one(self, timeout_s: float) -> bool:
        """Wait for a frame and process it; tell whether one arrived."""
        assert self._bus is not None
        received = self._bus.receive(timeout_s)
        if received is None:
            return False
        frame, arrival_ns = received
        try:
            report = self._codec.from_links(frame)
        except FrameError as error:
            self._counts[error.kind] += 1
            return True
        if report is None:
            self._counts['foreign'] += 1
            return True
        link = self.links[report.link]
        if isinstance(report, messages.WheelReport):
            link.update_wheel(report, self._counter, self._sync_sent_ns[self._counter], arrival_ns)
        elif isinstance(report, messages.MotorReport):
            link.update_motor(report, self._counter)
        elif isinstance(report, messages.AngleReport):
            link.update_angle(report, arrival_ns)
        elif isinstance(report, messages.ClockReport):
            link.update_clock(report, self._sent_ns(report.counter, arrival_ns), arrival_ns)
        else:
            link.update_heartbeat(report, arrival_ns)
            if 'no_limits' in report.faults:
                self._send(messages.Limits(
                    report.link, float(self.mechanism.motor_torque_limits[report.link]),
                    float(self.mechanism.motor_speed_limits[report.link])))
        return True

    def _sent_ns(self, counter: int, arrival_ns: int) -> int | None:
        """Return when a `Sync` was sent, None if the last one with this counter is too old."""
        sent_ns = self._sync_sent_ns[counter]
        return sent_ns if 0 <= arrival_ns - sent_ns < 0.5 * COUNTERS * self.period_ns else None

    def _send_drive(self, drive: Drive) -> None:
        for link in LINKS:
            powered = bool(drive.powered[link])
            self._sequences[link] = (self._sequences[link] + 1) % COUNTERS
            self._send(messages.Command(
                link, float(drive.values[link]) if powered else 0.0,
                powered and bool(drive.by_speed[link]), powered, self._sequences[link]))

    def _send(self, message: messages.ToLinks) -> None:
        assert self._bus is not None
        for frame in self._codec.to_links(message):
            self._bus.send(frame)

    def _try_send(self, message: messages.ToLinks) -> None:
        """Send a message if the bus can be used; the next step reports if it cannot."""
        if self._bus is None:
            return
        try:
            self._send(message)
        except BusError:
            self._close_bus()

    def _reopen(self) -> Bus:
        """
        Open the bus again, at intervals that are long against the time that an attempt takes.

        :raises BusError: the attempt failed, or the last one did and the interval is not over.
        """
        begin_ns = self._monotonic_ns()
        if self._reopen_ns is not None and begin_ns < self._reopen_ns:
            raise BusError(self._open_error)
        try:
            return self._open_bus()
        except BusError as error:
            self._open_error, end_ns = str(error), self._monotonic_ns()
            self._reopen_ns = end_ns + max(REOPEN_NS, 10 * (end_ns - begin_ns))
            raise

    def _close_bus(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()

    # Samples from the telemetry

    def _samples(self, stamp_ns: int, now_ns: int, round_trip_ns: int | None) -> Samples:
        offset_ns = self._stamp_of(now_ns) - now_ns
        samples = []
        for index, (name, link) in enumerate(zip(LINK_NAMES, self.links)):
            while link.angles:
                measured_ns, angle, rate = link.angles.popleft()
                angle -= self.mechanism.link_angle_offsets[index]
                rates = np.empty(0)
                if self.measures_rates:
                    if rate is None:
                        self._without_rate.add(name)
                        continue
                    self._without_rate.discard(name)
                    rates = np.array([rate])
                samples.append(LinkSample(
                    measured_ns + offset_ns, (name,),
                    np.array([np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi]), rates))
        samples.sort(key=lambda sample: sample.stamp_ns)
        complete = all(
            link.answer_ns is not None and now_ns - link.answer_ns <= self._silence_limit_ns
            for link in self.links)
        wheels = WheelSample(
            np.array([link.wheel_at(stamp_ns - offset_ns) for link in self.links]),
            np.array([link.wheel_speed for link in self.links]),
            np.array([link.torque for link in self.links]))
        ages = [now_ns - link.angle_ns for link in self.links if link.angle_ns is not None]
        return Samples(
            stamp_ns, tuple(samples), wheels, complete=complete, timing=(
                None if round_trip_ns is None else round_trip_ns * 1e-9,
                max(ages) * 1e-9 if ages else None,
                max(link.clock.jitter for link in self.links)))
