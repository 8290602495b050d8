# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The prototype's own language, as config/prototype.dbc or a lab's copy of it lays it out.

Messages and signals are found by name. One small class for each message tells what its signals
are; with which identifier, where in the frame and in which scale is the file's business.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from math import tau
from typing import Any, ClassVar

from fourbar_ros.hardware.dbc import DbcError, DbcFile, Layout
from fourbar_ros.hardware.messages import (
    AngleReport,
    ClockReport,
    Command,
    Frame,
    FrameError,
    Heartbeat,
    Limits,
    LINK_FAULTS,
    LinkState,
    MotorReport,
    Release,
    Stop,
    Sync,
    ToHost,
    ToLinks,
    WheelReport,
)

LINK_NAMES = 'ABCD'

# What CODE must be.
_STOP, _RELEASE = 0xC3, 0x3C

# Of times of measurement: the host must know in which round one is, and takes what is up to half a
# second old [us].
_SHORTEST_WRAP_US = 2e6
_STATES = tuple(LinkState)


class MessageCodec(ABC):
    """
    One message of the language, for one link where it is of one.

    :param layout: the message in the file.
    :param link: 0 to 3.
    """

    message: ClassVar[type]
    name: ClassVar[str]

    def __init__(self, layout: Layout, link: int) -> None:
        self.layout = layout
        self.link = link

    @abstractmethod
    def write(self, message: Any) -> Mapping[str, float]:
        """Return the counts of the signals."""

    @abstractmethod
    def read(self, counts: Mapping[str, Any]) -> ToHost | ToLinks:
        """Return the message of these counts."""


class _Command(MessageCodec):
    message, name = Command, 'COMMAND'

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        # It goes both ways.
        self._value = layout.number('VALUE', -1.0, 1.0)
        self._mode, self._enable = layout.count('MODE', 2), layout.count('ENABLE', 2)
        self._sequence = layout.count('SEQUENCE', 256)

    def write(self, message: Command) -> Mapping[str, float]:
        return {'VALUE': self._value.write(message.value), 'MODE': int(message.by_speed),
                'ENABLE': int(message.enable), 'SEQUENCE': self._sequence.write(message.sequence)}

    def read(self, counts: Mapping[str, Any]) -> Command:
        return Command(
            self.link, self._value.read(counts['VALUE']), bool(self._mode.read(counts['MODE'])),
            bool(self._enable.read(counts['ENABLE'])), self._sequence.read(counts['SEQUENCE']))


class _Limits(MessageCodec):
    message, name = Limits, 'LIMITS'

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        self._torque, self._speed = layout.number('TORQUE'), layout.number('SPEED')

    def write(self, message: Limits) -> Mapping[str, float]:
        if message.torque < 0.0:
            raise self._torque.refusal(message.torque)
        if message.speed < 0.0:
            raise self._speed.refusal(message.speed)
        return {'TORQUE': self._torque.write_at_most(message.torque),
                'SPEED': self._speed.write_at_most(message.speed)}

    def read(self, counts: Mapping[str, Any]) -> Limits:
        torque = self._torque.read(counts['TORQUE'])
        speed = self._speed.read(counts['SPEED'])
        if torque < 0.0:
            raise self._torque.refusal(torque)
        if speed < 0.0:
            raise self._speed.refusal(speed)
        return Limits(self.link, torque, speed)


class _Sync(MessageCodec):
    message, name = Sync, 'SYNC'

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        self._counter = layout.count('COUNTER', 256)

    def write(self, message: Sync) -> Mapping[str, float]:
        return {'COUNTER': self._counter.write(message.counter)}

    def read(self, counts: Mapping[str, Any]) -> Sync:
        return Sync(self._counter.read(counts['COUNTER']))


class _Fixed(MessageCodec):
    """A message that says nothing but itself."""

    code: ClassVar[int]

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        layout.count('CODE', 256)

    def write(self, message: Any) -> Mapping[str, float]:
        return {'CODE': self.code}

    def read(self, counts: Mapping[str, Any]) -> ToHost | ToLinks:
        if counts['CODE'] != self.code:
            raise FrameError('value', f'{self.layout.name}: CODE must be 0x{self.code:02X}, '
                                      f'got 0x{counts["CODE"]:02X}')
        message: ToHost | ToLinks = self.message()
        return message


class _Stop(_Fixed):
    message, name, code = Stop, 'STOP', _STOP


class _Release(_Fixed):
    message, name, code = Release, 'RELEASE', _RELEASE


class _Wheel(MessageCodec):
    message, name = WheelReport, 'WHEEL'

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        self._angle = layout.modulo('ANGLE', tau)
        self._time = layout.modulo('TIME', _SHORTEST_WRAP_US)
        self._counter = layout.count('COUNTER', 256)
        self._turn = self._angle.step * self._angle.counts
        self._wrap_us = _whole(self._time.step * self._time.counts, layout)
        self._number = layout.number('ANGLE')

    def write(self, message: WheelReport) -> Mapping[str, float]:
        if not abs(message.angle) < float('inf'):
            raise self._number.refusal(message.angle)
        if message.time_us is None:
            raise FrameError('value', f'{self.layout.name}: TIME must be told')
        return {'ANGLE': self._angle.write(message.angle),
                'TIME': self._time.write(message.time_us),
                'COUNTER': self._counter.write(message.counter)}

    def read(self, counts: Mapping[str, Any]) -> WheelReport:
        return WheelReport(
            self.link, self._counter.read(counts['COUNTER']), counts['ANGLE'] * self._angle.step,
            self._turn, round(counts['TIME'] * self._time.step), self._wrap_us)


class _Motor(MessageCodec):
    message, name = MotorReport, 'MOTOR'

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        self._torque = layout.number('TORQUE')
        self._answers, self._state = layout.count('ANSWERS', 256), layout.count('STATE', 5)
        self._answered = layout.count('ANSWERED', 2)
        self._counter = layout.count('COUNTER', 256)

    def write(self, message: MotorReport) -> Mapping[str, float]:
        if message.state is None:
            raise FrameError('value', f'{self.layout.name}: STATE must be told')
        if message.counter is None:
            raise FrameError('value', f'{self.layout.name}: COUNTER must be told')
        answered = message.answers is not None
        return {'TORQUE': self._torque.write(message.torque), 'STATE': message.state.value,
                'ANSWERED': int(answered), 'COUNTER': self._counter.write(message.counter),
                'ANSWERS': self._answers.write(message.answers if answered else 0)}

    def read(self, counts: Mapping[str, Any]) -> MotorReport:
        answers = self._answers.read(counts['ANSWERS'])
        return MotorReport(
            self.link, self._torque.read(counts['TORQUE']),
            answers if self._answered.read(counts['ANSWERED']) else None,
            _STATES[self._state.read(counts['STATE'])], self._counter.read(counts['COUNTER']))


class _Angle(MessageCodec):
    message, name = AngleReport, 'ANGLE'

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        self._angle = layout.orientation('ANGLE')
        self._rate = layout.number('RATE', -1.0, 1.0)
        self._time = layout.modulo('TIME', _SHORTEST_WRAP_US)
        self._sequence = layout.count('SEQUENCE', 16)
        self._wrap_us = _whole(self._time.step * self._time.counts, layout)

    def write(self, message: AngleReport) -> Mapping[str, float]:
        return {'ANGLE': self._angle.write(message.angle),
                'RATE': self._rate.write_optional(message.rate),
                'TIME': self._time.write(message.time_us),
                'SEQUENCE': self._sequence.write(message.sequence)}

    def read(self, counts: Mapping[str, Any]) -> AngleReport:
        return AngleReport(
            self.link, self._sequence.read(counts['SEQUENCE']), self._angle.read(counts['ANGLE']),
            self._rate.read_optional(counts['RATE']), round(counts['TIME'] * self._time.step),
            self._wrap_us)


class _Clock(MessageCodec):
    message, name = ClockReport, 'CLOCK'

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        self._time = layout.modulo('TIME', float(1 << 32))
        if self._time.step * self._time.counts != 1 << 32:
            raise DbcError(f'{layout.path}: {layout.name}: TIME must start over at 2^32 us')
        self._counter, self._boot = layout.count('COUNTER', 256), layout.count('BOOT', 256)

    def write(self, message: ClockReport) -> Mapping[str, float]:
        return {'TIME': self._time.write(message.time_us),
                'COUNTER': self._counter.write(message.counter),
                'BOOT': self._boot.write(message.boot)}

    def read(self, counts: Mapping[str, Any]) -> ClockReport:
        return ClockReport(
            self.link, self._counter.read(counts['COUNTER']),
            round(counts['TIME'] * self._time.step), self._boot.read(counts['BOOT']))


class _Heartbeat(MessageCodec):
    message, name = Heartbeat, 'HEARTBEAT'

    def __init__(self, layout: Layout, link: int) -> None:
        super().__init__(layout, link)
        self._state = layout.count('STATE', len(LinkState))
        self._faults = layout.count('FAULTS', 1 << len(LINK_FAULTS))
        self._voltage, self._temperature = layout.number('VOLTAGE'), layout.number('TEMPERATURE')
        self._boot, self._sequence = layout.count('BOOT', 256), layout.count('SEQUENCE', 16)

    def write(self, message: Heartbeat) -> Mapping[str, float]:
        if unknown := message.faults - set(LINK_FAULTS):
            raise FrameError('value', f'{self.layout.name}: no fault {", ".join(sorted(unknown))}')
        faults = sum(1 << bit for bit, fault in enumerate(LINK_FAULTS) if fault in message.faults)
        return {'STATE': message.state.value, 'FAULTS': faults,
                'VOLTAGE': self._voltage.write_optional(message.voltage),
                'TEMPERATURE': self._temperature.write_optional(message.temperature),
                'BOOT': self._boot.write(message.boot),
                'SEQUENCE': self._sequence.write(message.sequence)}

    def read(self, counts: Mapping[str, Any]) -> Heartbeat:
        faults = self._faults.read(counts['FAULTS'])
        return Heartbeat(
            self.link, self._sequence.read(counts['SEQUENCE']),
            _STATES[self._state.read(counts['STATE'])],
            frozenset(fault for bit, fault in enumerate(LINK_FAULTS) if faults >> bit & 1),
            self._voltage.read_optional(counts['VOLTAGE']),
            self._temperature.read_optional(counts['TEMPERATURE']),
            self._boot.read(counts['BOOT']))


_TO_ALL: tuple[type[MessageCodec], ...] = (_Sync, _Stop, _Release)
_TO_ONE: tuple[type[MessageCodec], ...] = (_Command, _Limits)
_FROM_ONE: tuple[type[MessageCodec], ...] = (_Wheel, _Motor, _Angle, _Clock, _Heartbeat)


class DbcCodec:
    """
    A `Codec` of the messages of a DBC file.

    What starts over does so as the file says: when a report is written, its `turn` and `wrap_us`
    do not count, and its angle and time may be of any size.

    :param name: `prototype` for config/prototype.dbc, or the path of a file.
    :param words: names of the messages that are spoken (`SYNC`, `ANGLE`, ...), default all; the
        others need not be in the file, and are not written or understood.
    :ivar frame_ids: of all its messages.
    :raises DbcError: the file is no DBC, or a message or signal is missing or too narrow.
    :raises ConfigurationError: no such file.
    """

    name = 'dbc'
    has_angles = True
    has_clock = True

    def __init__(self, name: str = 'prototype', words: Sequence[str] | None = None) -> None:
        file = DbcFile(name)
        self._say: dict[tuple[type, int | None], MessageCodec] = {}
        self._of_host: dict[int, MessageCodec] = {}
        self._of_links: dict[int, MessageCodec] = {}
        for kind in (*_TO_ALL, *_TO_ONE, *_FROM_ONE):
            if words is not None and kind.name not in words:
                continue
            understood = self._of_links if kind in _FROM_ONE else self._of_host
            if kind in _TO_ALL:
                word = kind(file.layout(kind.name), 0)
                self._say[kind.message, None] = understood[word.layout.frame_id] = word
                continue
            for link, letter in enumerate(LINK_NAMES):
                word = kind(file.layout(f'LINK_{letter}_{kind.name}'), link)
                self._say[kind.message, link] = understood[word.layout.frame_id] = word
        self.frame_ids = frozenset(self._of_host) | frozenset(self._of_links)

    def to_links(self, message: ToLinks) -> Sequence[Frame]:
        """
        Write what the host says.

        :raises FrameError: kind `value`: a number that is not finite or does not fit.
        """
        return self._written(message)

    def to_host(self, message: ToHost) -> Sequence[Frame]:
        """
        Write what a link says.

        :raises FrameError: likewise.
        """
        return self._written(message)

    def from_links(self, frame: Frame) -> ToHost | None:
        """
        Read at the host what a link says.

        :returns: the message; None for a frame that is none of a link's.
        :raises FrameError: a wrong length, a wrong checksum, or what cannot be.
        """
        word = self._of_links.get(frame.frame_id)
        if word is None or frame.remote:
            return None
        message: Any = word.read(word.layout.counts(frame))
        return message  # type: ignore[no-any-return]

    def from_host(self, frame: Frame) -> ToLinks | None:
        """
        Read at the links what the host says.

        :returns: the message; None for a frame that is none of the host's.
        :raises FrameError: likewise.
        """
        word = self._of_host.get(frame.frame_id)
        if word is None or frame.remote:
            return None
        message: Any = word.read(word.layout.counts(frame))
        return message  # type: ignore[no-any-return]

    def _written(self, message: ToLinks | ToHost) -> Sequence[Frame]:
        link = getattr(message, 'link', None)
        word = self._say.get((type(message), link))
        if word is not None:
            return (word.layout.frame(word.write(message)),)
        if link is not None and not 0 <= link < len(LINK_NAMES):
            raise FrameError('value', f'links are 0 to {len(LINK_NAMES) - 1}, got {link}')
        return ()


def _whole(wrap_us: float, layout: Layout) -> int:
    """Return after how many microseconds a time starts over."""
    if wrap_us != round(wrap_us):
        raise DbcError(f'{layout.path}: {layout.name}: TIME must start over after whole us')
    return round(wrap_us)
