# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Emulation of the prototype's links on a bus, over a simulated table.

The electronics step the table at their own rate by the host's clock, but report times of their own
clocks, which have an offset and a drift.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import setting, Settings
from fourbar_ros.device.clock_modes import RealtimeClock
from fourbar_ros.device.interface import Drive, Samples
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.hardware import messages
from fourbar_ros.hardware.firmware import Firmware
from fourbar_ros.hardware.messages import Bus, BusError, Codec, COUNTERS, Frame, FrameError
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.mechanism.samples import LinkSample
import numpy as np

LINKS = range(4)

# Period of reported wheel angles [rad]: 24 bits of the DBC signal, 16 bits per turn.
TURN = 256 * 2.0 * np.pi
# Period of link times in reports [us]: 20 bits of 10 us.
WRAP_US = 10 * 2 ** 20
# Number of `Sync` between two clock reports.
CLOCK_EVERY = 16
# Interval of heartbeats [ns].
HEARTBEAT_NS = 50_000_000
# Longest delay of this process after which no step is skipped [ns].
CATCH_UP_NS = 100_000_000

INJECTABLE_LINK_FAULTS = (
    'silent', 'hot', 'low_battery', 'reboot', 'corrupted', 'foreign', 'replayed')
# Faults of the electronics and the bus; those of sensors and wheels belong to the table.
INJECTABLE_BUS_FAULTS = ('off',)


class EmulatorError(FourbarError):
    """An emulation that is not possible, or a fault that cannot be injected."""


@dataclass(frozen=True)
class EmulatorSettings(Settings):
    """Rate of the electronics, and the clocks of the links against the host's."""

    rate: float = setting(1000.0, 'Hz', 'control rate of the electronics', low=100.0, high=2000.0)
    truth_rate: float = setting(
        250.0, 'Hz', 'rate of the ground truth on sim/', low=1.0, high=1000.0)
    command_timeout: float = setting(
        0.1, 's', 'longest time without a command before a link coasts', low=0.01, high=10.0)
    clock_offset: float = setting(
        100.0, 's', 'reading of the clock of link a at the start; each next link is 7 s ahead',
        low=0.0, high=4000.0)
    clock_drift: float = setting(
        30e-6, 's/s', 'rate error of the clocks: positive in links a and b, negative in c and d',
        low=0.0, high=1e-3)

    @property
    def clocks(self) -> ClockSettings:
        """Offsets and drifts of the four clocks."""
        drift = self.clock_drift
        return ClockSettings(tuple(self.clock_offset + 7.0 * link for link in LINKS),
                             (drift, 0.5 * drift, -0.5 * drift, -drift))


@dataclass(frozen=True)
class ClockSettings:
    """
    Clocks of the links against the host's.

    :param offsets_s: (4,) readings at the start [s].
    :param drifts: (4,) relative errors of the rate [s/s].
    """

    offsets_s: tuple[float, ...]
    drifts: tuple[float, ...]


def check_injected_fault(target: str, kind: str) -> None:
    """
    Check a fault before it is injected.

    :param target, kind: as for `Emulator.inject_fault`.
    :raises EmulatorError: unknown target or fault.
    """
    if target not in (*LINK_NAMES, 'bus'):
        raise EmulatorError(f'fault target must be bus or {", ".join(LINK_NAMES)}, got {target}',
                            name='target', value=target, limit=('bus', *LINK_NAMES))
    known = INJECTABLE_BUS_FAULTS if target == 'bus' else INJECTABLE_LINK_FAULTS
    if kind not in ('', *known):
        raise EmulatorError(f'fault of {target} must be one of {", ".join(known)}, got {kind!r}',
                            name=target, value=kind, limit=known)


class Emulator:
    """
    Up to four links and the table under them.

    :param table: with an absolute angle sensor on each link.
    :param codec: protocol on the bus.
    :param links: indices of the emulated links.
    :param rng: for boot numbers.
    :param now_ns: host time at which the electronics start [ns].
    :param stamp_ns: the same instant as a stamp [ns].
    :param clocks: of all four links, by default those of the settings.
    :raises EmulatorError: the table has no angle sensor on each link.
    :ivar samples: of the table at its last step, None before.
    :ivar counts: number of rejected frames, by reason.
    :ivar firmware: electronics of all four links.
    """

    def __init__(self, table: SimulatedTable, codec: Codec, links: Sequence[int],
                 settings: EmulatorSettings, rng: np.random.Generator, now_ns: int, stamp_ns: int,
                 clocks: ClockSettings | None = None) -> None:
        if table.sensor_names != LINK_NAMES:
            raise EmulatorError(
                'links report their own angles, but the table has the sensors '
                f'{", ".join(table.sensor_names)}: choose a table with sensors of kind absolute',
                name='sensors', value=table.sensor_names, limit=LINK_NAMES)
        self.samples: Samples | None = None
        self.counts: Counter[str] = Counter()
        self.table = table
        self.links = tuple(links)
        self.firmware = [Firmware(settings.command_timeout) for _ in LINKS]
        self._codec = codec
        self._clocks = clocks or settings.clocks
        self._settings = settings
        self._rng = rng
        self._start_ns, self._stamp_offset_ns = now_ns, stamp_ns - now_ns
        self._clock = RealtimeClock(stamp_ns, now_ns, table.period_ns, CATCH_UP_NS)
        self._boots = [int(boot) for boot in rng.integers(0, COUNTERS, 4)]
        self._angle_sequences, self._heartbeat_sequences = [0] * 4, [0] * 4
        # Sum of the torques [N m] and number of steps since the last `Sync`.
        self._torques, self._steps = np.zeros(4), 0
        self._heartbeat_ns = now_ns
        self._faults: dict[str, str] = {}
        self._last_sent: dict[int, Frame] = {}

    @property
    def next_ns(self) -> int:
        """Host time of the next step of the table [ns]."""
        return self._clock.next_ns - self._stamp_offset_ns

    def inject_fault(self, target: str, kind: str) -> None:
        """
        Inject a fault into a link or the bus.

        :param target: `link_a` to `link_d`, or `bus`.
        :param kind: of `INJECTABLE_LINK_FAULTS` or `INJECTABLE_BUS_FAULTS`, '' to end it.
        :raises EmulatorError: unknown target or fault.
        """
        check_injected_fault(target, kind)
        self._faults[target] = kind
        if target == 'bus':
            return
        link = LINK_NAMES.index(target)
        if kind == 'reboot':
            self.firmware[link] = Firmware(self._settings.command_timeout)
            # Different from the present boot number.
            ahead = 1 + int(self._rng.integers(0, 200))
            self._boots[link] = (self._boots[link] + ahead) % COUNTERS
        self.firmware[link].temperature = 90.0 if kind == 'hot' else 30.0
        self.firmware[link].voltage = 9.8 if kind == 'low_battery' else 12.0

    def serve(self, bus: Bus, monotonic_ns: Callable[[], int]) -> int:
        """
        Wait for the next frame or the next step, and process it.

        :param monotonic_ns: reads the host's clock [ns].
        :returns: the time afterwards [ns].
        :raises BusError: the bus cannot be used, or another link uses an emulated identifier.
        """
        received = bus.receive(max((self.next_ns - monotonic_ns()) * 1e-9, 0.0))
        while received is not None:
            for frame in self.receive(received[0], monotonic_ns()):
                bus.send(frame)
            # A due step takes precedence, so that a flood of frames does not stop the table.
            received = bus.receive(0.0) if monotonic_ns() < self.next_ns else None
        now_ns = monotonic_ns()
        if now_ns >= self.next_ns:
            for frame in self.advance(now_ns):
                bus.send(frame)
        return now_ns

    def advance(self, now_ns: int) -> list[Frame]:
        """
        Step the table up to now.

        :param now_ns: host time [ns].
        :returns: frames that the links send by themselves: angle samples and heartbeats.
        """
        frames: list[Frame] = []
        while (stamp_ns := self._clock.due(now_ns)) is not None:
            self._step(stamp_ns, frames)
        if now_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            for link in self.links:
                self._send_heartbeat(link, frames)
        return frames

    def receive(self, frame: Frame, now_ns: int) -> list[Frame]:
        """
        Process a frame of the host.

        :returns: the answers.
        :raises BusError: another link uses an emulated identifier.
        """
        if self._faults.get('bus') or frame.remote:
            # The answers to `Sync` hold what remote frames request.
            return []
        try:
            message = self._codec.from_host(frame)
        except FrameError as error:
            self.counts[error.kind] += 1
            return []
        frames: list[Frame] = []
        if message is None:
            self._check_other_sender(frame)
        elif isinstance(message, messages.Sync):
            for link in self.links:
                self._answer(link, message.counter, now_ns, frames)
            self._torques[:], self._steps = 0.0, 0
        elif isinstance(message, messages.Command | messages.Limits):
            if self._receives(message.link):
                firmware = self.firmware[message.link]
                if isinstance(message, messages.Command):
                    firmware.command(message, now_ns)
                else:
                    firmware.load_limits(message)
        else:
            for link in filter(self._receives, self.links):
                firmware = self.firmware[link]
                firmware.stop() if isinstance(message, messages.Stop) else firmware.release()
        return frames

    def _step(self, stamp_ns: int, frames: list[Frame]) -> None:
        """Step the table to a stamp."""
        drives = [firmware.drive() if link in self.links else (0.0, False, False)
                  for link, firmware in enumerate(self.firmware)]
        values, by_speed, powered = zip(*drives)
        samples = self.samples = self.table.step(
            stamp_ns, Drive(np.array(values), np.array(by_speed), np.array(powered)))
        self._torques += samples.wheels.efforts
        self._steps += 1
        for link in self.links:
            self.firmware[link].monitor(
                float(samples.wheels.speeds[link]), stamp_ns - self._stamp_offset_ns)
        for sample in samples.links:
            for index, name in enumerate(sample.names):
                link = LINK_NAMES.index(name)
                if link in self.links:
                    self._send_angle(link, sample, index, frames)

    def _send_angle(self, link: int, sample: LinkSample, index: int, frames: list[Frame]) -> None:
        sequence = self._angle_sequences[link] = (
            self._angle_sequences[link] + 1) % messages.SEQUENCES
        rate = float(sample.rates[index]) if len(sample.rates) else None
        time_us = self._link_us(link, sample.stamp_ns - self._stamp_offset_ns)
        self._send(messages.AngleReport(
            link, sequence, float(sample.angles[index]), rate, time_us % WRAP_US, WRAP_US), frames)

    def _answer(self, link: int, counter: int, now_ns: int, frames: list[Frame]) -> None:
        """Answer a `Sync`."""
        samples, firmware = self.samples, self.firmware[link]
        if samples is None:
            return
        torque = float(self._torques[link]) / max(self._steps, 1)
        measured_us = self._link_us(link, samples.stamp_ns - self._stamp_offset_ns)
        self._send(messages.MotorReport(
            link, torque, firmware.state, counter, True, firmware.sequence), frames)
        self._send(messages.WheelReport(
            link, counter, float(samples.wheels.angles[link]) % TURN, TURN,
            measured_us % WRAP_US, WRAP_US, float(samples.wheels.speeds[link])), frames)
        if counter % CLOCK_EVERY == 0:
            self._send(messages.ClockReport(
                link, counter, self._link_us(link, now_ns) % 2 ** 32, self._boots[link]), frames)

    def _send_heartbeat(self, link: int, frames: list[Frame]) -> None:
        firmware = self.firmware[link]
        sequence = self._heartbeat_sequences[link] = (
            self._heartbeat_sequences[link] + 1) % messages.SEQUENCES
        self._send(messages.Heartbeat(
            link, sequence, firmware.state, firmware.faults, firmware.voltage,
            firmware.temperature, self._boots[link]), frames)

    def _send(self, report: messages.ToHost, frames: list[Frame]) -> None:
        """Append the frames of a report, changed by an injected fault of the link."""
        fault = self._faults.get(LINK_NAMES[report.link], '')
        if fault == 'silent' or self._faults.get('bus'):
            return
        encoded = list(self._codec.to_host(report))
        unchanged = {frame.frame_id: frame for frame in encoded}
        if fault == 'corrupted':
            encoded = [frame._replace(data=bytes([frame.data[0] ^ 0x10]) + frame.data[1:])
                       for frame in encoded]
        elif fault == 'foreign':
            encoded += [Frame(0x7FF, b'?')]
        elif fault == 'replayed':
            encoded += [self._last_sent.get(frame.frame_id, frame) for frame in encoded]
        self._last_sent.update(unchanged)
        frames += encoded

    def _receives(self, link: int) -> bool:
        return link in self.links and self._faults.get(LINK_NAMES[link]) != 'silent'

    def _check_other_sender(self, frame: Frame) -> None:
        """Detect another link with the identifier of an emulated one."""
        try:
            report = self._codec.from_links(frame)
        except FrameError:
            report = None
        if report is None:
            self.counts['foreign'] += 1
        elif report.link in self.links:
            name = LINK_NAMES[report.link]
            raise BusError(f'{name} is on this bus already: two links with one identifier',
                           name=name)

    def _link_us(self, link: int, host_ns: int) -> int:
        """Return the reading of a link's clock at a host time [us]."""
        elapsed_s = (host_ns - self._start_ns) * 1e-9
        return round((self._clocks.offsets_s[link]
                      + elapsed_s * (1.0 + self._clocks.drifts[link])) * 1e6)
