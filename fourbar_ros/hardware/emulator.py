# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The prototype without a prototype: what four links would say on a bus, over a simulated table.

The electronics step the table a thousand times a second by the host's clock, but tell the time by
their own clocks, which began at another moment and run a little too fast or too slow.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.device.clock_modes import RealtimeClock
from fourbar_ros.device.interface import Drive, Samples
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.hardware.firmware import Firmware, FirmwareSettings
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
    MotorReport,
    Release,
    SEQUENCES,
    Stop,
    Sync,
    ToHost,
    WheelReport,
)
from fourbar_ros.mechanism import LINK_NAMES
import numpy as np

LINKS = range(4)

# A wheel's angle as it is told starts over after so many turns.
TURN = 256 * 2.0 * np.pi
# Link time in reports starts over after this [us].
WRAP_US = 10 * 2 ** 20
# The time is told with every so many questions.
CLOCK_EVERY = 16
HEARTBEAT_NS = 50_000_000
# A stall of this process that is caught up with; what is longer is left out [ns].
PATIENCE_NS = 100_000_000

# What may be wrong with a link or the bus beside what may be with sensors and wheels.
LINK_TROUBLES = ('silent', 'hot', 'low_battery', 'reboot', 'corrupted', 'foreign', 'replayed')
BUS_TROUBLES = ('off',)


class TroubleError(FourbarError):
    """A trouble that there is not."""


@dataclass(frozen=True)
class ClockSettings:
    """
    The clocks of the links against the host's.

    :param offsets_s: (4,) what they show at the start [s].
    :param drifts: (4,) how much faster they run [s/s].
    """

    offsets_s: tuple[float, ...]
    drifts: tuple[float, ...]


def check_trouble(target: str, kind: str) -> None:
    """
    Make sure that there is such a trouble.

    :param target, kind: as for `Emulator.trouble`.
    :raises TroubleError: there is no such target or trouble.
    """
    known = BUS_TROUBLES if target == 'bus' else LINK_TROUBLES
    if target != 'bus' and target not in LINK_NAMES:
        raise TroubleError(f'trouble for {target}: must be bus or {", ".join(LINK_NAMES)}')
    if kind not in ('', *known):
        raise TroubleError(f'trouble of {target} must be one of {", ".join(known)}, got {kind!r}')


class Emulator:
    """
    Four links, or some of them, and the table under them.

    :param table: with a period of a millisecond or so.
    :param codec: what is spoken on the bus.
    :param links: indices of those that are there.
    :param clocks: of all four.
    :param rng: of what differs from start to start.
    :param now_ns: host time now, when the electronics start [ns].
    :param stamp_ns: the same in the time that stamps carry [ns].
    :raises TroubleError: the table has no angle sensor on each link.
    :ivar samples: of the table at its last step, None before.
    :ivar counts: of frames by what became of them.
    """

    def __init__(self, table: SimulatedTable, codec: Codec, links: Sequence[int],
                 firmware: FirmwareSettings, clocks: ClockSettings, rng: np.random.Generator,
                 now_ns: int, stamp_ns: int) -> None:
        if table.sensor_names != LINK_NAMES:
            raise TroubleError(f'links tell their own angles, but the table has the sensors '
                               f'{", ".join(table.sensor_names)}: give one of kind absolute')
        self.samples: Samples | None = None
        self.counts: Counter[str] = Counter()
        self.table = table
        self.links = tuple(links)
        self._codec = codec
        self._clocks = clocks
        self._settings = firmware
        self._rng = rng
        self._began_ns, self._shift_ns = now_ns, stamp_ns - now_ns
        self._pace = RealtimeClock(stamp_ns, now_ns, table.period_ns, PATIENCE_NS)
        self._firmware = [Firmware(link, firmware) for link in LINKS]
        self._boots = [int(boot) for boot in rng.integers(0, COUNTERS, 4)]
        self._sequences = np.zeros((2, 4), dtype=int)
        self._torques, self._steps = np.zeros(4), 0
        self._beat_ns = now_ns
        self._troubles: dict[str, str] = {}
        self._last_sent: dict[int, Frame] = {}

    @property
    def next_ns(self) -> int:
        """When the table is due to move again [ns]."""
        return self._pace.next_ns - self._shift_ns

    @property
    def firmware(self) -> Sequence[Firmware]:
        """The electronics of all four links."""
        return self._firmware

    def trouble(self, target: str, kind: str) -> None:
        """
        Make trouble for a link or the bus, or end it with ''.

        :param target: `link_a` to `link_d`, or `bus`.
        :param kind: of `LINK_TROUBLES` or `BUS_TROUBLES`.
        :raises TroubleError: there is no such target or trouble.
        """
        check_trouble(target, kind)
        self._troubles[target] = kind
        if target == 'bus':
            return
        link = LINK_NAMES.index(target)
        self._firmware[link].temperature = 90.0 if kind == 'hot' else 30.0
        self._firmware[link].voltage = 9.8 if kind == 'low_battery' else 12.0
        if kind == 'reboot':
            self._firmware[link] = Firmware(link, self._settings)
            # Another one for sure.
            ahead = 1 + int(self._rng.integers(0, 200))
            self._boots[link] = (self._boots[link] + ahead) % COUNTERS

    def advance(self, now_ns: int) -> list[Frame]:
        """
        Move the table up to now.

        :param now_ns: host time [ns].
        :returns: what the links say by themselves meanwhile.
        """
        frames: list[Frame] = []
        while (stamp_ns := self._pace.due(now_ns)) is not None:
            self._step(stamp_ns, frames)
        if now_ns - self._beat_ns >= HEARTBEAT_NS:
            self._beat_ns = now_ns
            for link in self.links:
                self._beat(link, frames)
        return frames

    def take(self, frame: Frame, now_ns: int) -> list[Frame]:
        """
        Hear a frame.

        :returns: the answers.
        :raises BusError: somebody else speaks for one of these links.
        """
        if self._troubles.get('bus') or frame.remote:
            # What a remote frame asks for is said with the answers to a question.
            return []
        try:
            message = self._codec.from_host(frame)
        except FrameError as error:
            self.counts[error.kind] += 1
            return []
        frames: list[Frame] = []
        if message is None:
            self._hear_other(frame)
        elif isinstance(message, Sync):
            for link in self.links:
                self._answer(link, message.counter, now_ns, frames)
            self._torques[:], self._steps = 0.0, 0
        elif isinstance(message, Stop | Release):
            for link in self.links:
                if self._hears(link):
                    firmware = self._firmware[link]
                    firmware.stop() if isinstance(message, Stop) else firmware.release()
        elif message.link in self.links and self._hears(message.link):
            firmware = self._firmware[message.link]
            if isinstance(message, Command):
                firmware.command(message, now_ns)
            elif isinstance(message, Limits):
                firmware.load_limits(message)
        return frames

    def _step(self, stamp_ns: int, frames: list[Frame]) -> None:
        """Move the table up to a stamp."""
        drives = [firmware.drive() if link in self.links else (0.0, False, False)
                  for link, firmware in enumerate(self._firmware)]
        values, by_speed, powered = zip(*drives)
        samples = self.table.step(
            stamp_ns, Drive(np.array(values), np.array(by_speed), np.array(powered)))
        self.samples = samples
        self._torques += samples.wheels.efforts
        self._steps += 1
        for link in self.links:
            self._firmware[link].watch(
                float(samples.wheels.speeds[link]), stamp_ns - self._shift_ns)
        for reading in samples.links:
            for index, name in enumerate(reading.names):
                link = LINK_NAMES.index(name)
                if link in self.links:
                    rate = float(reading.rates[index]) if len(reading.rates) else None
                    self._tell_angle(link, reading.stamp_ns - self._shift_ns,
                                     float(reading.angles[index]), rate, frames)

    def _tell_angle(self, link: int, measured_ns: int, angle: float, rate: float | None,
                    frames: list[Frame]) -> None:
        self._sequences[0, link] = (self._sequences[0, link] + 1) % SEQUENCES
        self._say(AngleReport(link, int(self._sequences[0, link]), angle, rate,
                              self._link_us(link, measured_ns) % WRAP_US, WRAP_US), frames)

    def _answer(self, link: int, counter: int, now_ns: int, frames: list[Frame]) -> None:
        """Tell the host what it asked for."""
        samples, firmware = self.samples, self._firmware[link]
        if samples is None:
            return
        torque = float(self._torques[link]) / max(self._steps, 1)
        measured_us = self._link_us(link, samples.stamp_ns - self._shift_ns)
        self._say(MotorReport(
            link, torque, firmware.state, counter, True, firmware.sequence), frames)
        self._say(WheelReport(
            link, counter, float(samples.wheels.angles[link]) % TURN, TURN,
            measured_us % WRAP_US, WRAP_US, float(samples.wheels.speeds[link])), frames)
        if counter % CLOCK_EVERY == 0:
            self._say(ClockReport(link, counter, self._link_us(link, now_ns) % 2 ** 32,
                                  self._boots[link]), frames)

    def _beat(self, link: int, frames: list[Frame]) -> None:
        firmware = self._firmware[link]
        self._sequences[1, link] = (self._sequences[1, link] + 1) % SEQUENCES
        self._say(Heartbeat(
            link, int(self._sequences[1, link]), firmware.state, firmware.faults,
            firmware.voltage, firmware.temperature, self._boots[link]), frames)

    def _say(self, report: ToHost, frames: list[Frame]) -> None:
        """Write down what a link says, with the trouble that it has."""
        trouble = self._troubles.get(LINK_NAMES[report.link], '')
        if trouble == 'silent' or self._troubles.get('bus'):
            return
        said = list(self._codec.to_host(report))
        fresh = {frame.frame_id: frame for frame in said}
        if trouble == 'corrupted':
            said = [frame._replace(data=bytes([frame.data[0] ^ 0x10]) + frame.data[1:])
                    for frame in said]
        elif trouble == 'foreign':
            said += [Frame(0x7FF, b'?')]
        elif trouble == 'replayed':
            said += [self._last_sent.get(frame.frame_id, frame) for frame in said]
        self._last_sent.update(fresh)
        frames += said

    def _hears(self, link: int) -> bool:
        return self._troubles.get(LINK_NAMES[link]) != 'silent'

    def _hear_other(self, frame: Frame) -> None:
        """Notice that somebody else speaks for a link of ours."""
        try:
            report = self._codec.from_links(frame)
        except FrameError:
            report = None
        if report is None:
            self.counts['foreign'] += 1
        elif report.link in self.links:
            raise BusError(f'{LINK_NAMES[report.link]} is on this bus already: two links with '
                           'one id')

    def _link_us(self, link: int, host_ns: int) -> int:
        elapsed_s = (host_ns - self._began_ns) * 1e-9
        return round((self._clocks.offsets_s[link]
                      + elapsed_s * (1.0 + self._clocks.drifts[link])) * 1e6)
