# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Messages and signals of a DBC file, found by name.

Identifiers, bit positions and scales come from the file, so that a lab can change them in a copy.
cantools packs and unpacks the bits. Scaling and limits are handled here: cantools encodes NaN
without an error, does not check decoded values, and scales slowly.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy
import logging
from math import ceil, floor, inf, isfinite, isnan, nan, pi, remainder, tau
from pathlib import Path
from typing import Any, TYPE_CHECKING

from fourbar_ros.common.config_files import ConfigurationError, share_directory
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.hardware.checksum import checksum
from fourbar_ros.hardware.messages import Frame, FrameError

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

# Largest finite floating-point value by number of bits.
_LARGEST_FLOAT = {16: 65504.0, 32: 3.4028234663852886e38, 64: 1.7976931348623157e308}
# Relative tolerance of limits; float32 has a relative precision of 1.2e-7.
_TOLERANCE = 1e-6

# Label in a signal's value table of the count that means `no measurement`.
NO_VALUE = 'none'
CHECKSUM = 'CHECKSUM'


class DbcError(FourbarError):
    """
    A DBC file that is missing, malformed, or lacks a message or signal.

    Its `values` are `place` (the file), and those of `message`, `signal`, `value` and `limit` that
    apply.
    """


class SignalCodec(ABC):
    """
    Conversion of one signal between its value and its raw count.

    An instance states the requirements; :meth:`bind` returns a copy for a signal of a file.
    """

    def bind(self, signal: Signal, message: str) -> SignalCodec:
        """
        Return the codec for a signal.

        :raises DbcError: the signal does not meet the requirements; its `values` lack the file.
        """
        codec = copy(self)
        codec.message, codec.name = message, signal.name
        codec._bind(signal)
        return codec

    @abstractmethod
    def _bind(self, signal: Signal) -> None:
        """Take over scale and limits of the signal."""

    @abstractmethod
    def encode(self, value: Any) -> float:
        """
        Return the count of a value.

        :raises FrameError: the value does not fit.
        """

    @abstractmethod
    def decode(self, count: float) -> Any:
        """
        Return the value of a count.

        :raises FrameError: the count is invalid.
        """

    message: str
    name: str

    def _unsuitable(self, reason: str, value: object, limit: object) -> DbcError:
        return DbcError(f'{self.message}: {self.name} {reason}', message=self.message,
                        signal=self.name, value=value, limit=limit)

    def _refusal(self, value: object, allowed: str, limit: object) -> FrameError:
        return FrameError('value', f'{self.message}: {self.name} must be {allowed}, got {value}',
                          name=f'{self.message}.{self.name}', value=value, limit=limit)


class Number(SignalCodec):
    """
    A number with a unit.

    :param low, high: range that the signal must cover, to one count.
    :param optional: whether None is a value, sent as the count that the file labels `none`.
    """

    # Smallest allowed value, beside the limits of the file.
    minimum = -inf

    def __init__(self, low: float = 0.0, high: float = 0.0, optional: bool = False) -> None:
        self._required = low, high
        self._optional = optional
        self._no_value: int | None = None

    def _bind(self, signal: Signal) -> None:
        scale, self._offset = float(signal.scale), float(signal.offset)
        self._scale, self._is_float = scale, signal.is_float
        if not (isfinite(scale) and scale > 0.0 and isfinite(self._offset)):
            raise self._unsuitable(f'must have a positive factor, got {scale:g}', scale, 0.0)
        lowest, highest = self._representable(signal)
        below, above = -inf, inf
        if signal.minimum is not None and signal.maximum is not None and (
                signal.minimum < signal.maximum):
            below = (float(signal.minimum) - self._offset) / scale
            above = (float(signal.maximum) - self._offset) / scale
        # Exclusive limits in counts; an integer may be half a count outside and is rounded.
        if self._is_float:
            self._low = max(lowest, below - _TOLERANCE * abs(below) - 1e-30)
            self._high = min(highest, above + _TOLERANCE * abs(above) + 1e-30)
        else:
            self._low = max(lowest, ceil(below - 0.01) if isfinite(below) else lowest) - 0.5
            self._high = min(highest, floor(above + 0.01) if isfinite(above) else highest) + 0.5
        for count, label in (signal.choices or {}).items():
            if str(label).lower() == NO_VALUE:
                self._no_value = count
                self._low += count == ceil(self._low)
                self._high -= count == floor(self._high)
        (low, high), step = self._required, 0.0 if self._is_float else scale
        if self.limits[0] > low + step or self.limits[1] < high - step:
            raise self._unsuitable(
                f'is too narrow: its range is {self.limits[0]:.6g} to {self.limits[1]:.6g}, '
                f'{low:.6g} to {high:.6g} is required', self.limits, self._required)

    def _representable(self, signal: Signal) -> tuple[float, float]:
        """Return the smallest and largest count of the signal's bits."""
        if signal.is_float:
            if signal.length not in _LARGEST_FLOAT:
                raise self._unsuitable(f'is floating point of {signal.length} bits',
                                       signal.length, tuple(_LARGEST_FLOAT))
            return -_LARGEST_FLOAT[signal.length], _LARGEST_FLOAT[signal.length]
        if signal.is_signed:
            return -(1 << signal.length - 1), (1 << signal.length - 1) - 1
        return 0, (1 << signal.length) - 1

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest value."""
        return (ceil(self._low) * self._scale + self._offset,
                floor(self._high) * self._scale + self._offset)

    def encode(self, value: float | None) -> float:
        """Return the count of a value."""
        if value is None:
            if self._no_value is None or not self._optional:
                raise self._out_of_range(nan)
            return self._no_value
        count = (value - self._offset) / self._scale
        # Written so that NaN fails.
        if not (self._low < count < self._high and value >= self.minimum):
            raise self._out_of_range(value)
        return count if self._is_float else round(count)

    def decode(self, count: float) -> float | None:
        """Return the value of a count."""
        if self._optional and count == self._no_value:
            return None
        value = count * self._scale + self._offset
        if not (self._low < count < self._high and value >= self.minimum):
            raise self._out_of_range(value)
        return value

    def _out_of_range(self, value: float) -> FrameError:
        low, high = max(self.limits[0], self.minimum), self.limits[1]
        return self._refusal(value, f'from {low:.6g} to {high:.6g}', (low, high))


class UpperLimit(Number):
    """A limit of a magnitude: not negative, and rounded down so that it is never widened."""

    minimum = 0.0

    def encode(self, value: float | None) -> float:
        """Return the count of a limit."""
        count = super().encode(value)
        assert value is not None
        widened = count * self._scale + self._offset > value * (1.0 + _TOLERANCE)
        return count - 1 if widened and not self._is_float else count


class NanNumber(Number):
    """A floating-point number that is NaN where there is no measurement, decoded as None."""

    def decode(self, count: float) -> float | None:
        """Return the value of a count."""
        return None if isnan(count) else super().decode(count)


class Orientation(Number):
    """An angle in (-pi, pi] [rad]."""

    def __init__(self) -> None:
        super().__init__(-pi, pi)

    def encode(self, value: float | None) -> float:
        """Return the count of an angle."""
        if value is None or not abs(value) < pi + _TOLERANCE:
            raise self._out_of_range(nan if value is None else value)
        count = (value - self._offset) / self._scale
        if not count < self._high:
            # +pi may not be representable; -pi is the same orientation.
            count -= tau / self._scale
        return count if self._is_float else round(count)

    def decode(self, count: float) -> float:
        """Return the angle of a count."""
        value = super().decode(count)
        if value is None or not abs(value) < pi + max(0.5 * self._scale, _TOLERANCE):
            raise self._out_of_range(nan if value is None else value)
        value = remainder(value, tau)
        return value if value > -pi else pi


class Modulo(SignalCodec):
    """
    A number that wraps around; any finite number can be encoded.

    :param least: smallest allowed period, in the signal's unit.
    :param greatest: largest allowed period.
    :param whole: whether values are whole numbers.
    :ivar period: the values are 0 to this, in the signal's unit.
    """

    def __init__(self, least: float, greatest: float = inf, whole: bool = False) -> None:
        self._range = least, greatest
        self._whole = whole

    def _bind(self, signal: Signal) -> None:
        self._step, self._counts = float(signal.scale), 1 << signal.length
        if signal.is_float or signal.is_signed or signal.offset or not self._step > 0.0:
            raise self._unsuitable('must be unsigned, without an offset', self._step, 0.0)
        self.period: float = self._step * self._counts
        least, greatest = self._range
        if not least * (1.0 - _TOLERANCE) <= self.period <= greatest:
            raise self._unsuitable(f'must wrap at {least:.6g} to {greatest:.6g}, it wraps at '
                                   f'{self.period:.6g}', self.period, self._range)
        if self._whole:
            if not self.period.is_integer():
                raise self._unsuitable('must wrap at a whole number', self.period, int)
            self.period = int(self.period)

    def encode(self, value: float | None) -> int:
        """Return the count of a number of any size."""
        if value is None or not isfinite(value):
            raise self._refusal(value, 'finite', (-inf, inf))
        return round(value / self._step) % self._counts

    def decode(self, count: float) -> float:
        """Return the value of a count."""
        return round(count * self._step) if self._whole else count * self._step


class Integer(SignalCodec):
    """
    An unsigned integer without a scale.

    :param choices: number of values, from 0; counts beyond are invalid.
    :param kind: type of the value, made from the integer.
    """

    def __init__(self, choices: int, kind: type[Any] = int) -> None:
        self._choices = choices
        # Made once, since the construction of an enumeration is slow.
        self._values = None if kind is int else [kind(n) for n in range(choices)]

    def _bind(self, signal: Signal) -> None:
        if signal.is_float or signal.is_signed or signal.scale != 1 or signal.offset != 0:
            raise self._unsuitable('must be an unsigned integer without a scale',
                                   float(signal.scale), 1.0)
        bits = (self._choices - 1).bit_length()
        if signal.length < bits:
            raise self._unsuitable(f'is too narrow: it has {signal.length} bits, {bits} are '
                                   'required', signal.length, bits)

    def encode(self, value: int | None) -> int:
        """Return the count of a value."""
        if value is None or not 0 <= value < self._choices:
            raise self._refusal(value, f'from 0 to {self._choices - 1}', (0, self._choices - 1))
        return int(value)

    def decode(self, count: float) -> Any:
        """Return the value of a count."""
        integer = self.encode(int(count))
        return integer if self._values is None else self._values[integer]


class Constant(Integer):
    """An 8-bit integer that is always the same."""

    def __init__(self, code: int) -> None:
        super().__init__(256)
        self._code = code

    def encode(self, value: int | None) -> int:
        """Return the constant."""
        if value != self._code:
            raise self._refusal(value, str(self._code), self._code)
        return value


class Flags(Integer):
    """
    A set of names, one bit each.

    :param names: in the order of the bits, from the lowest.
    """

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__(1 << len(names))
        self._names = names

    def encode(self, value: Any) -> int:
        """Return the bits of a set of names."""
        if unknown := sorted(set(value) - set(self._names)):
            raise self._refusal(', '.join(unknown), f'of {", ".join(self._names)}', self._names)
        return sum(1 << bit for bit, name in enumerate(self._names) if name in value)

    def decode(self, count: float) -> frozenset[str]:
        """Return the names whose bits are set."""
        bits = super().encode(int(count))
        return frozenset(name for bit, name in enumerate(self._names) if bits >> bit & 1)


class MessageCodec:
    """
    Codec of one message: values of its signals to a frame and back.

    :param signals: requirements by name of the signal; other signals are sent as 0.
    :param has_checksum: whether the last byte is a checksum.
    :ivar name, frame_id: of the message.
    :ivar signals: codecs by name.
    :raises DbcError: the message or a signal does not meet the requirements.
    """

    def __init__(self, message: Message, signals: Mapping[str, SignalCodec],
                 has_checksum: bool) -> None:
        self.name, self.frame_id, self._length = message.name, message.frame_id, message.length
        self._has_checksum = has_checksum
        self._pack, self._unpack = message.encode, message.decode_simple
        if message.is_extended_frame or message.is_fd or self._length > 8:
            raise DbcError(f'{self.name}: it must be a classic frame with an 11-bit identifier',
                           message=self.name, value=self.frame_id, limit=0x7FF)
        if message.is_multiplexed():
            raise DbcError(f'{self.name}: it must not be multiplexed', message=self.name)
        available = {signal.name: signal for signal in message.signals}
        self._zeros = dict.fromkeys(available, 0)
        required = {**signals, **({CHECKSUM: Integer(256)} if has_checksum else {})}
        for name in required:
            if name not in available:
                raise DbcError(f'{self.name}: no signal {name}', message=self.name, signal=name)
        self.signals = {name: codec.bind(available[name], self.name)
                        for name, codec in required.items()}
        if self.signals.pop(CHECKSUM, None):
            signal = available[CHECKSUM]
            last = 8 * (self._length - 1) + (7 if signal.byte_order == 'big_endian' else 0)
            if signal.length != 8 or signal.start != last:
                raise DbcError(f'{self.name}: {CHECKSUM} must be the last byte',
                               message=self.name, signal=CHECKSUM)

    def encode(self, values: Mapping[str, Any]) -> Frame:
        """
        Return the frame of signal values.

        :raises FrameError: a value does not fit.
        """
        return self.pack({name: self.signals[name].encode(value)
                          for name, value in values.items()})

    def pack(self, counts: Mapping[str, float]) -> Frame:
        """Return the frame of signal counts."""
        data = self._pack({**self._zeros, **counts}, False, False, False)
        if self._has_checksum:
            data = data[:-1]
            data += bytes((checksum(self.frame_id, data),))
        return Frame(self.frame_id, data)

    def decode(self, frame: Frame) -> dict[str, Any]:
        """
        Return the signal values of a frame.

        :raises FrameError: wrong length, wrong checksum, or an invalid value.
        """
        counts = self.unpack(frame)
        return {name: codec.decode(counts[name]) for name, codec in self.signals.items()}

    def unpack(self, frame: Frame) -> dict[str, Any]:
        """
        Return the signal counts of a frame.

        :raises FrameError: wrong length or wrong checksum.
        """
        data = frame.data
        if len(data) != self._length:
            raise FrameError('length', f'{self.name} (0x{self.frame_id:03X}) must have '
                                       f'{self._length} bytes, got {len(data)}',
                             name=self.name, value=len(data), limit=self._length)
        if self._has_checksum and checksum(self.frame_id, data[:-1]) != data[-1]:
            raise FrameError('checksum', f'{self.name} (0x{self.frame_id:03X}): wrong checksum',
                             name=self.name, value=data[-1])
        counts: dict[str, Any] = self._unpack(data, False, False)
        return counts


class DbcFile:
    """
    A DBC file.

    :param name: `prototype` for config/prototype.dbc, or the path of a file.
    :ivar path: of the file.
    :raises ConfigurationError: no such file.
    :raises DbcError: the file is no DBC; cantools is not installed.
    """

    def __init__(self, name: str) -> None:
        self.path = _find_file(name)
        try:
            import cantools.database
        except ImportError as error:
            raise DbcError(f'{self.path}: cantools is missing: pip install fourbar_ros[hardware]',
                           place=str(self.path)) from error
        # It warns of identifiers that occur twice; `message` refuses those.
        logging.getLogger('cantools').addHandler(logging.NullHandler())
        logging.getLogger('cantools').propagate = False
        try:
            database = cantools.database.load_file(self.path, database_format='dbc')
        except OSError as error:
            raise DbcError(f'{self.path}: {error.strerror}', place=str(self.path)) from error
        except Exception as error:
            # The parser raises many kinds of errors for a malformed line.
            raise DbcError(f'{self.path}: not a usable DBC file: {" ".join(str(error).split())}',
                           place=str(self.path)) from error
        self._messages: list[Message] = list(getattr(database, 'messages', ()))

    def message(self, name: str, signals: Mapping[str, SignalCodec], has_checksum: bool = True
                ) -> MessageCodec:
        """
        Return the codec of a message; see :class:`MessageCodec`.

        :raises DbcError: the message is missing, ambiguous, or does not meet the requirements.
        """
        try:
            return MessageCodec(self._find(name), signals, has_checksum)
        except DbcError as error:
            raise error.at(self.path, DbcError) from None

    def _find(self, name: str) -> Message:
        matches = [each for each in self._messages if each.name == name]
        if len(matches) != 1:
            raise DbcError(f'{"more than one" if matches else "no"} message {name}', message=name)
        message, = matches
        for other in self._messages:
            if other is not message and (other.frame_id, other.is_extended_frame) == (
                    message.frame_id, message.is_extended_frame):
                raise DbcError(f'{name} and {other.name} have the same identifier '
                               f'0x{other.frame_id:03X}', message=name, value=other.frame_id)
        return message


def _find_file(name: str) -> Path:
    path = Path(name).expanduser()
    if '/' not in name and path.suffix != '.dbc':
        folder = share_directory() / 'config'
        preset = folder / f'{name}.dbc'
        if preset.is_file():
            return preset
        if not path.is_file():
            known = sorted(file.stem for file in folder.glob('*.dbc'))
            raise ConfigurationError(
                f'no DBC file {name!r}: available are {", ".join(known) or "none"}, or a path to '
                'a file', name=name, limit=known)
    if not path.is_file():
        raise ConfigurationError(f'DBC file {name}: no such file', name=name)
    return path
