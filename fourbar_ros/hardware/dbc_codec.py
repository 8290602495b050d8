# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The prototype's own protocol, laid out by config/prototype.dbc or a lab's copy of it.

Messages and signals are found by name. The table below relates the attributes of each message
class to signals; identifiers, bit positions and scales come from the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import tau
from typing import Any, NamedTuple

from fourbar_ros.hardware import messages
from fourbar_ros.hardware.dbc import (
    Constant,
    DbcFile,
    Flags,
    Integer,
    MessageCodec,
    Modulo,
    Number,
    Orientation,
    SignalCodec,
    UpperLimit,
)
from fourbar_ros.hardware.messages import COUNTERS, Frame, LINK_FAULTS, LinkState, SEQUENCES

LINK_LETTERS = 'ABCD'


class _Row(NamedTuple):
    """
    A message of the protocol.

    :param kind: its class.
    :param name: its name in the file, for a message of one link without the prefix `LINK_A_`.
    :param signals: by attribute of the class, the name of the signal and its requirements.
    """

    kind: type[Any]
    name: str
    signals: Mapping[str, tuple[str, SignalCodec]]


_COUNTER, _SEQUENCE = ('COUNTER', Integer(COUNTERS)), ('SEQUENCE', Integer(SEQUENCES))
_BOOT, _STATE = ('BOOT', Integer(COUNTERS)), ('STATE', Integer(len(LinkState), LinkState))
# Link times [us]. The host accepts samples up to half a second old, and a period of 2 s makes the
# time of such a sample unambiguous.
_TIME = ('TIME', Modulo(2e6, whole=True))

_TO_ALL_LINKS = (
    _Row(messages.Sync, 'SYNC', {'counter': _COUNTER}),
    _Row(messages.Stop, 'STOP', {'code': ('CODE', Constant(messages.Stop.code))}),
    _Row(messages.Release, 'RELEASE', {'code': ('CODE', Constant(messages.Release.code))}),
)
_TO_ONE_LINK = (
    _Row(messages.Command, 'COMMAND', {
        'value': ('VALUE', Number(-1.0, 1.0)), 'by_speed': ('MODE', Integer(2, bool)),
        'enable': ('ENABLE', Integer(2, bool)), 'sequence': ('SEQUENCE', Integer(COUNTERS))}),
    _Row(messages.Limits, 'LIMITS', {
        'torque': ('TORQUE', UpperLimit()), 'speed': ('SPEED', UpperLimit())}),
)
_FROM_ONE_LINK = (
    _Row(messages.WheelReport, 'WHEEL', {
        'angle': ('ANGLE', Modulo(tau)), 'time_us': _TIME, 'counter': _COUNTER}),
    _Row(messages.MotorReport, 'MOTOR', {
        'torque': ('TORQUE', Number()), 'answers': ('ANSWERS', Integer(COUNTERS)),
        'answered': ('ANSWERED', Integer(2, bool)), 'state': _STATE, 'counter': _COUNTER}),
    _Row(messages.AngleReport, 'ANGLE', {
        'angle': ('ANGLE', Orientation()), 'rate': ('RATE', Number(-1.0, 1.0, optional=True)),
        'time_us': _TIME, 'sequence': _SEQUENCE}),
    _Row(messages.ClockReport, 'CLOCK', {
        'time_us': ('TIME', Modulo(2 ** 32, 2 ** 32, whole=True)), 'counter': _COUNTER,
        'boot': _BOOT}),
    _Row(messages.Heartbeat, 'HEARTBEAT', {
        'state': _STATE, 'faults': ('FAULTS', Flags(LINK_FAULTS)),
        'voltage': ('VOLTAGE', Number(optional=True)),
        'temperature': ('TEMPERATURE', Number(optional=True)), 'boot': _BOOT,
        'sequence': _SEQUENCE}),
)
# Attributes of reports that hold the period of another attribute.
_PERIODS = {'turn': 'angle', 'wrap_us': 'time_us'}


class _Message:
    """
    One message of one link, or of all.

    :param link: 0 to 3, None for a message to all links.
    """

    def __init__(self, file: DbcFile, row: _Row, link: int | None) -> None:
        prefix = '' if link is None else f'LINK_{LINK_LETTERS[link]}_'
        self.codec: MessageCodec = file.message(prefix + row.name, dict(row.signals.values()))
        self._kind = row.kind
        # Attribute, name of the signal, and its conversion; faster than `encode` and `decode`.
        signals = [(attribute, name, self.codec.signals[name])
                   for attribute, (name, _) in row.signals.items()]
        self._encoders = [(attribute, name, signal.encode) for attribute, name, signal in signals]
        self._decoders = [(attribute, name, signal.decode) for attribute, name, signal in signals]
        self._constants: dict[str, Any] = {} if link is None else {'link': link}
        for attribute, other in _PERIODS.items():
            if attribute in row.kind.__dataclass_fields__:
                signal = self.codec.signals[row.signals[other][0]]
                assert isinstance(signal, Modulo)
                self._constants[attribute] = signal.period

    def encode(self, message: Any) -> Frame:
        return self.codec.pack({name: encode(getattr(message, attribute))
                                for attribute, name, encode in self._encoders})

    def decode(self, frame: Frame) -> Any:
        counts = self.codec.unpack(frame)
        return self._kind(**self._constants, **{
            attribute: decode(counts[name]) for attribute, name, decode in self._decoders})


class DbcCodec:
    """
    A `Codec` of the messages of a DBC file.

    Angles and times wrap as the file says: `turn` and `wrap_us` of a report are ignored when it is
    encoded, and its angle and time may be of any size.

    :param name: `prototype` for config/prototype.dbc, or the path of a file.
    :param selected: names of the messages in use (`SYNC`, `ANGLE`, ...), by default all; the
        others may be missing in the file, and are neither encoded nor decoded.
    :ivar frame_ids: identifiers of all messages in use.
    :raises DbcError: the file is no DBC, or a message or signal is missing or too narrow.
    :raises ConfigurationError: no such file.
    """

    def __init__(self, name: str = 'prototype', selected: Sequence[str] | None = None) -> None:
        file = DbcFile(name)
        self._encoders: dict[tuple[type, int | None], _Message] = {}
        self._from_host: dict[int, _Message] = {}
        self._from_links: dict[int, _Message] = {}
        for row in (*_TO_ALL_LINKS, *_TO_ONE_LINK, *_FROM_ONE_LINK):
            if selected is not None and row.name not in selected:
                continue
            decoders = self._from_links if row in _FROM_ONE_LINK else self._from_host
            for link in (None,) if row in _TO_ALL_LINKS else range(len(LINK_LETTERS)):
                message = _Message(file, row, link)
                self._encoders[row.kind, link] = message
                decoders[message.codec.frame_id] = message
        self.frame_ids = frozenset(self._from_host) | frozenset(self._from_links)

    def to_links(self, message: messages.ToLinks) -> Sequence[Frame]:
        """
        Encode a message of the host.

        :raises messages.FrameError: kind `value`: a number is not finite or does not fit.
        """
        return self._encode(message)

    def to_host(self, message: messages.ToHost) -> Sequence[Frame]:
        """
        Encode a message of a link.

        :raises messages.FrameError: kind `value`, as :meth:`to_links`.
        """
        return self._encode(message)

    def from_links(self, frame: Frame) -> messages.ToHost | None:
        """
        Decode at the host a message of a link.

        :returns: the message; None for a frame that no link sends.
        :raises messages.FrameError: wrong length, wrong checksum, or an invalid value.
        """
        message: messages.ToHost | None = _decode(self._from_links, frame)
        return message

    def from_host(self, frame: Frame) -> messages.ToLinks | None:
        """
        Decode at a link a message of the host.

        :returns: the message; None for a frame that the host does not send.
        :raises messages.FrameError: as :meth:`from_links`.
        """
        message: messages.ToLinks | None = _decode(self._from_host, frame)
        return message

    def _encode(self, message: messages.ToLinks | messages.ToHost) -> Sequence[Frame]:
        link = getattr(message, 'link', None)
        encoder = self._encoders.get((type(message), link))
        if encoder is not None:
            return (encoder.encode(message),)
        if link is not None:
            messages.check_link(link)
        return ()


def _decode(decoders: Mapping[int, _Message], frame: Frame) -> Any:
    message = decoders.get(frame.frame_id)
    return None if message is None or frame.remote else message.decode(frame)
