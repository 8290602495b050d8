# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The prototype as a device: four links on a bus.

At every tick the host asks all links at once for their wheels (`Sync`) and waits a moment for the
answers; what the links say by themselves, their angles above all, is taken along. Commands go out
as soon as they are there. While the gate is closed every tick tells all links so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

from fourbar_ros.device.arming import DeviceState
from fourbar_ros.device.interface import (
    Device,
    DeviceFault,
    Drive,
    LinkSample,
    no_torque,
    Samples,
    WheelSample,
)
from fourbar_ros.hardware.link_telemetry import LinkTelemetry
from fourbar_ros.hardware.messages import (
    AngleReport,
    BusError,
    ClockReport,
    Codec,
    Command,
    COUNTERS,
    Frame,
    FrameError,
    Heartbeat,
    Limits,
    LinkState,
    MotorReport,
    Release,
    Stop,
    Sync,
    WheelReport,
)
from fourbar_ros.hardware.safety_monitor import SafetyMonitor
from fourbar_ros.hardware.safety_table import SafetyTable
from fourbar_ros.mechanism import LINK_NAMES, Mechanism
import numpy as np

LINKS = range(4)

# A frame that nobody waits for is taken as long as it is there at once; but not for ever, should
# somebody flood the bus.
MOST_FRAMES = 2000

# Counters of frames that are no good, whose sum per second is watched.
BAD = ('length', 'checksum', 'value', 'replayed', 'late', 'wrong_time', 'foreign')

# While a gone bus keeps an emergency stop company, it is opened again at most so often [ns].
RETRY_NS = 1_000_000_000

NO_RATE = 'its angles come without a rate, so none is taken: it has no gyro, set gyro to false'

# How often the last command is repeated when the host leaves.
LAST_WORDS = 3


class Bus(Protocol):
    """What sends and receives frames; times are of the host's steady clock [ns]."""

    @property
    def trouble(self) -> str | None:
        """Tell what is wrong with the bus itself, None if nothing is known."""

    def send(self, frame: Frame) -> None:
        """
        Send a frame.

        :raises BusError: the bus is gone.
        """

    def receive(self, timeout_s: float) -> tuple[Frame, int] | None:
        """
        Wait for a frame.

        :returns: the frame and when it arrived, None if none came in time.
        :raises BusError: the bus is gone.
        """

    def facts(self) -> dict[str, object]:
        """Tell what a person wants to know of it, the number of frames above all."""

    def close(self) -> None:
        """Leave the bus."""


class Prototype(Device):
    """
    Four links behind the device protocol.

    :param mechanism: the linkage, its wheels, motor limits and offsets of the angle sensors.
    :param open_bus: called to open the bus, now and again after it failed; raises `BusError`.
    :param codec: what is spoken on it.
    :param safety: limits and reactions.
    :param period_ns: time between two ticks [ns].
    :param answer_timeout_s: how long a tick waits for the answers of the wheels [s].
    :param gyro: whether the links have gyros.
    :param steady_ns: reads the host's steady clock [ns].
    :param stamp_of: turns its times into stamps [ns].
    """

    description = 'prototype'
    sensor_names = LINK_NAMES
    timing_names = ('bus_round_trip_s', 'angle_age_s', 'clock_jitter_s')

    def __init__(self, mechanism: Mechanism, open_bus: Callable[[], Bus], codec: Codec,
                 safety: SafetyTable, period_ns: int, answer_timeout_s: float, gyro: bool,
                 monotonic_ns: Callable[[], int], stamp_of: Callable[[int], int]) -> None:
        self.mechanism = mechanism
        self.period_ns = period_ns
        self.measures_rates = gyro
        self.links = [LinkTelemetry() for _ in LINKS]
        self._codec = codec
        self._open_bus = open_bus
        self._bus: Bus | None = open_bus()
        # When it may be opened again, if that has failed.
        self._retry_ns: int | None = None
        self._refusal = ''
        self._rateless: set[str] = set()
        self._steady_ns = monotonic_ns
        self._stamp_of = stamp_of
        self._answer_timeout_ns = round(answer_timeout_s * 1e9)
        self._counts: Counter[str] = Counter()
        self._state = DeviceState.DISARMED
        self._drive = no_torque()
        self._sequences = [0, 0, 0, 0]
        self._counter = 0
        self._sent_ns = [0] * COUNTERS
        self._silent_ns = safety['wheel_silent'].limit * 1e9
        self._lookout = SafetyMonitor(mechanism, safety, self.links, monotonic_ns())

    def step(self, stamp_ns: int, drive: Drive) -> Samples:
        """
        Ask the wheels, take along what else was said, and look whether all is well.

        :raises BusError: the bus is gone; it is tried to be opened again at the next step after
            the gate has changed, and now and then.
        """
        if self._bus is None:
            self._bus = self._opened_again()
        self._drive = drive
        try:
            round_trip_ns = self._ask(drive)
        except BusError:
            self._lose_bus()
            raise
        now_ns = self._steady_ns()
        self._lookout.look(now_ns, self._drive, sum(
            self._counts[kind] + sum(link.counts[kind] for link in self.links) for kind in BAD))
        return self._samples(stamp_ns, now_ns, round_trip_ns)

    def drive(self, drive: Drive) -> None:
        """
        Send it.

        :raises BusError: the bus is gone.
        """
        self._drive = drive
        if self._bus is None:
            return
        try:
            self._send_drive(drive)
        except BusError:
            self._lose_bus()
            raise

    def gate_changed(self, state: DeviceState) -> None:
        """Stop the links at once, and remember how they are when they are armed."""
        self._state = state
        self._retry_ns = None
        self._lookout.gate_changed(state, self._steady_ns())
        if state is DeviceState.EMERGENCY_STOP:
            self._send_if_there(Stop())

    def release(self) -> Sequence[str]:
        """Release all links; tell which of them say that they are stopped."""
        self._send_if_there(Release())
        if self._bus is None:
            return []
        return [name for name, link in zip(LINK_NAMES, self.links)
                if link.state is LinkState.STOPPED]

    def arming_blockers(self) -> Sequence[str]:
        """Tell what speaks against arming: links, wheels, clocks, and what must not go on."""
        return [*(f'{name}: {NO_RATE}' for name in sorted(self._rateless)),
                *self._lookout.arming_blockers()]

    def faults(self) -> Sequence[DeviceFault]:
        """Tell what was found at the last step that must have consequences."""
        return self._lookout.faults

    def diagnostics(self) -> dict[str, str]:
        """Tell what is not as it should be."""
        if self._bus is None:
            return {'bus': 'the bus is closed'}
        told: dict[str, str] = {}
        if trouble := self._bus.trouble:
            told['bus'] = trouble
        if missing := [name for name, link in zip(LINK_NAMES, self.links)
                       if link.heartbeat_ns is None]:
            told['missing'] = f'waiting for {", ".join(missing)}: never heard'
        told.update(dict.fromkeys(sorted(self._rateless), NO_RATE))
        for where, text in self._lookout.troubles().items():
            told[where] = '; '.join(filter(None, (told.get(where), text)))
        return told

    def facts(self) -> dict[str, object]:
        """Tell counters of the bus, and of each link its health and its clock."""
        told: dict[str, object] = {}
        if self._bus is not None:
            told = self._bus.facts()
        told.update({f'frames_{kind}': count for kind, count in sorted(self._counts.items())})
        for name, link in zip(LINK_NAMES, self.links):
            beat = link.heartbeat
            if beat is None:
                continue
            told[f'{name}.state'] = '' if link.state is None else link.state.name.lower()
            told[f'{name}.faults'] = ', '.join(sorted(beat.faults))
            if beat.voltage is not None:
                told[f'{name}.voltage_v'] = f'{beat.voltage:.2f}'
            if beat.temperature is not None:
                told[f'{name}.temperature_deg_c'] = f'{beat.temperature:.1f}'
            told[f'{name}.clock_drift_ppm'] = f'{link.clock.drift * 1e6:.2f}'
            told[f'{name}.clock_jitter_us'] = f'{link.clock.jitter * 1e6:.1f}'
            told[f'{name}.restarts'] = link.boots
            told.update({f'{name}.{kind}': count for kind, count in sorted(link.counts.items())})
        return told

    def close(self) -> None:
        """Tell all links that they have no power, and leave the bus."""
        bus, self._state = self._bus, DeviceState.DISARMED
        if bus is None:
            return
        try:
            for _ in range(LAST_WORDS):
                self._send_drive(no_torque())
        except BusError:
            pass
        self._bus = None
        bus.close()

    # The exchange

    def _ask(self, drive: Drive) -> int | None:
        """
        Send what belongs to a tick, and take all that is there.

        :returns: time until all wheels had answered, None if they did not [ns].
        """
        self._take_waiting()
        counter = self._counter = (self._counter + 1) % COUNTERS
        for link in self.links:
            link.asked()
        if self._state is DeviceState.EMERGENCY_STOP:
            # Again and again: one that starts anew must not miss it.
            self._send(Stop())
        elif self._state is not DeviceState.ARMED:
            self._send_drive(drive)
        sent_ns = self._sent_ns[counter] = self._steady_ns()
        self._send(Sync(counter))
        expected = [link for link in self.links if link.answer_ns is not None] or self.links
        deadline_ns = sent_ns + self._answer_timeout_ns
        while not all(link.complete for link in expected):
            left_ns = deadline_ns - self._steady_ns()
            if left_ns <= 0 or not self._take_next(left_ns * 1e-9):
                break
        self._take_waiting()
        if not all(link.complete for link in self.links):
            return None
        return max(link.answer_ns or 0 for link in self.links) - sent_ns

    def _take_waiting(self) -> None:
        for _ in range(MOST_FRAMES):
            if not self._take_next(0.0):
                return

    def _take_next(self, timeout_s: float) -> bool:
        """Wait for a frame and take it; tell whether one came."""
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
        if isinstance(report, WheelReport):
            link.take_wheel(report, self._counter, self._sent_ns[self._counter], arrival_ns)
        elif isinstance(report, MotorReport):
            link.take_motor(report, self._counter)
        elif isinstance(report, AngleReport):
            link.take_angle(report, arrival_ns)
        elif isinstance(report, ClockReport):
            link.take_clock(report, self._sent_at(report.counter, arrival_ns), arrival_ns)
        else:
            self._take_heartbeat(report, link, arrival_ns)
        return True

    def _sent_at(self, counter: int, arrival_ns: int) -> int | None:
        """Return when a `Sync` went out, None if there was none with this counter lately."""
        sent_ns = self._sent_ns[counter]
        return sent_ns if 0 <= arrival_ns - sent_ns < 0.5 * COUNTERS * self.period_ns else None

    def _take_heartbeat(self, report: Heartbeat, link: LinkTelemetry, arrival_ns: int) -> None:
        link.take_heartbeat(report, arrival_ns)
        if 'no_limits' in report.faults:
            self._send(Limits(
                report.link, float(self.mechanism.motor_torque_limits[report.link]),
                float(self.mechanism.motor_speed_limits[report.link])))

    def _send_drive(self, drive: Drive) -> None:
        for link in LINKS:
            powered = bool(drive.powered[link])
            self._sequences[link] = (self._sequences[link] + 1) % COUNTERS
            self._send(Command(
                link, float(drive.values[link]) if powered else 0.0,
                powered and bool(drive.by_speed[link]), powered, self._sequences[link]))

    def _send(self, message: Command | Limits | Sync | Stop | Release) -> None:
        assert self._bus is not None
        for frame in self._codec.to_links(message):
            self._bus.send(frame)

    def _send_if_there(self, message: Stop | Release) -> None:
        """Send it where there is a bus; the next step tells that there is none any more."""
        if self._bus is None:
            return
        try:
            self._send(message)
        except BusError:
            self._lose_bus()

    def _opened_again(self) -> Bus:
        """
        Open the bus, but do not live for that: it may take a while.

        :raises BusError: it is not there, or was not a moment ago.
        """
        begin_ns = self._steady_ns()
        if self._retry_ns is not None and begin_ns < self._retry_ns:
            raise BusError(self._refusal)
        try:
            return self._open_bus()
        except BusError as error:
            self._refusal, end_ns = str(error), self._steady_ns()
            self._retry_ns = end_ns + max(RETRY_NS, 10 * (end_ns - begin_ns))
            raise

    def _lose_bus(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()

    # What comes of it

    def _samples(self, stamp_ns: int, now_ns: int, round_trip_ns: int | None) -> Samples:
        shift_ns = self._stamp_of(now_ns) - now_ns
        offsets = self.mechanism.link_angle_offsets
        readings = []
        for index, (name, link) in enumerate(zip(LINK_NAMES, self.links)):
            while link.angles:
                measured_ns, angle, rate = link.angles.popleft()
                angle -= offsets[index]
                rates = np.empty(0)
                if self.measures_rates:
                    if rate is None:
                        self._rateless.add(name)
                        continue
                    self._rateless.discard(name)
                    rates = np.array([rate])
                readings.append(LinkSample(
                    measured_ns + shift_ns, (name,),
                    np.array([np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi]), rates))
        readings.sort(key=lambda reading: reading.stamp_ns)
        complete = all(link.answer_ns is not None and now_ns - link.answer_ns <= self._silent_ns
                       for link in self.links)
        tick_ns = stamp_ns - shift_ns
        wheels = WheelSample(
            np.array([link.wheel_at(tick_ns) if link.wheel_ns is not None else 0.0
                      for link in self.links]),
            np.array([link.wheel_speed for link in self.links]),
            np.array([link.torque for link in self.links]))
        ages = [now_ns - link.angle_ns for link in self.links if link.angle_ns is not None]
        return Samples(
            stamp_ns, tuple(readings), wheels, complete=complete, timing=(
                None if round_trip_ns is None else round_trip_ns * 1e-9,
                max(ages) * 1e-9 if ages else None,
                max(link.clock.jitter for link in self.links)))
