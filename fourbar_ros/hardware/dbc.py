# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Messages of a DBC file, found by their names and those of their signals.

Identifiers, places and scales are the file's, so that a lab can move them in a copy. cantools
packs and unpacks the bits; scales and limits are looked after here, because cantools encodes what
is not a number, and takes its time over scaling.
"""

from __future__ import annotations

from collections.abc import Mapping
import logging
from math import ceil, floor, inf, isfinite, pi, remainder, tau
from pathlib import Path
from typing import Any, TYPE_CHECKING

from fourbar_ros.common.config_files import ConfigurationError, share_directory
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.hardware.checksum import begun, finished
from fourbar_ros.hardware.messages import Frame, FrameError

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

# The largest numbers of floating point, by their bits.
_LARGEST = {16: 65504.0, 32: 3.4028234663852886e38, 64: 1.7976931348623157e308}
# Of a limit that the file gives, for numbers of single precision may be so far beyond.
_SLACK = 1e-6

# What a value is called, in a table of values, that stands for nothing measured.
NONE = 'none'
CHECKSUM = 'CHECKSUM'


class DbcError(FourbarError):
    """A DBC file that is not there, is none, or lacks what is needed."""


class Number:
    """
    A signal that is a number in some unit.

    :ivar scale: unit per count.
    :ivar none: the count that stands for nothing measured, if there is one.
    """

    def __init__(self, signal: Signal, origin: str, message: str) -> None:
        self.scale, self.none = float(signal.scale), None
        self._where = f'{message}: {signal.name}'
        self._offset = float(signal.offset)
        self._is_float = signal.is_float
        if not (isfinite(self.scale) and self.scale > 0.0 and isfinite(self._offset)):
            raise DbcError(f'{origin}: the factor must be positive, got {self.scale:g}')
        highest: float
        lowest: float
        if self._is_float:
            if signal.length not in _LARGEST:
                raise DbcError(f'{origin}: floating point of {signal.length} bits')
            highest = _LARGEST[signal.length]
            lowest = -highest
        elif signal.is_signed:
            lowest = -(1 << signal.length - 1)
            highest = -lowest - 1
        else:
            lowest, highest = 0, (1 << signal.length) - 1
        below, above = -inf, inf
        if signal.minimum is not None and signal.maximum is not None and (
                signal.minimum < signal.maximum):
            below = (float(signal.minimum) - self._offset) / self.scale
            above = (float(signal.maximum) - self._offset) / self.scale
        # Counts, exclusive: half a count beyond is still rounded to a whole one inside.
        if self._is_float:
            self._lowest = max(lowest, below - _SLACK * abs(below) - 1e-30)
            self._highest = min(highest, above + _SLACK * abs(above) + 1e-30)
        else:
            self._lowest = max(lowest, ceil(below - 0.01) if isfinite(below) else lowest) - 0.5
            self._highest = min(highest, floor(above + 0.01) if isfinite(above) else highest) + 0.5
        for count, name in (signal.choices or {}).items():
            if str(name).lower() == NONE:
                self.none = count
                if count == ceil(self._lowest):
                    self._lowest += 1.0
                elif count == floor(self._highest):
                    self._highest -= 1.0

    @property
    def lowest(self) -> float:
        """The lowest number that it can be."""
        return ceil(self._lowest) * self.scale + self._offset

    @property
    def highest(self) -> float:
        """The highest number that it can be."""
        return floor(self._highest) * self.scale + self._offset

    def write(self, value: float) -> float:
        """
        Return the count.

        :raises FrameError: not finite, or out of range.
        """
        count = (value - self._offset) / self.scale
        # Not a number is not between.
        if not self._lowest < count < self._highest:
            raise self.refusal(value)
        return count if self._is_float else round(count)

    def write_at_most(self, value: float) -> float:
        """Return the count, rounded down: of a limit."""
        count = self.write(value)
        if count * self.scale + self._offset > value * (1.0 + _SLACK) and not self._is_float:
            return count - 1
        return count

    def write_optional(self, value: float | None) -> float:
        """Return the count, or the one for nothing measured."""
        if value is not None:
            return self.write(value)
        if self.none is None:
            raise FrameError('value', f'{self._where} must be a number, there is no word for none')
        return self.none

    def read(self, count: float) -> float:
        """
        Return the number.

        :raises FrameError: not finite, or out of range.
        """
        if not self._lowest < count < self._highest:
            raise self.refusal(count * self.scale + self._offset)
        return count * self.scale + self._offset

    def read_optional(self, count: float) -> float | None:
        """Return the number; None where nothing was measured."""
        return None if count == self.none else self.read(count)

    def refusal(self, value: float) -> FrameError:
        """Make the error for a value that it cannot be."""
        if not isfinite(value):
            return FrameError('value', f'{self._where} must be finite, got {value}')
        return FrameError('value', f'{self._where} must be from {self.lowest:.6g} to '
                                   f'{self.highest:.6g}, got {value:.6g}')


class Orientation(Number):
    """A signal that is an angle in (-pi, pi] [rad]."""

    def write(self, value: float) -> float:
        """
        Return the count.

        :raises FrameError: not finite, or beyond half a turn.
        """
        if not -pi - _SLACK < value < pi + _SLACK:
            raise self.refusal(value)
        count = (value - self._offset) / self.scale
        if not count < self._highest:
            # Half a turn is the same to the other side, where that can be said.
            count -= tau / self.scale
        return count if self._is_float else round(count)

    def read(self, count: float) -> float:
        """
        Return the angle.

        :raises FrameError: not finite, or beyond half a turn.
        """
        value = super().read(count)
        if not abs(value) < pi + max(0.5 * self.scale, _SLACK):
            raise self.refusal(value)
        value = remainder(value, tau)
        return value if value > -pi else pi


class Modulo:
    """
    A signal that starts over.

    :ivar step: unit per count.
    :ivar counts: how many there are.
    """

    def __init__(self, step: float, counts: int) -> None:
        self.step, self.counts = step, counts

    def write(self, value: float) -> int:
        """Return the count of a number of any size."""
        return round(value / self.step) % self.counts

    def read(self, count: int) -> float:
        """Return the number."""
        return count * self.step


class Count:
    """
    A signal that counts, or numbers something.

    :param choices: how many it distinguishes; a wider signal must not say more.
    """

    def __init__(self, where: str, choices: int) -> None:
        self._where, self._choices = where, choices

    def write(self, value: int | None) -> int:
        """
        Return the value if it is one.

        :raises FrameError: it is not.
        """
        if value is None or not 0 <= value < self._choices:
            raise FrameError(
                'value', f'{self._where} must be from 0 to {self._choices - 1}, got {value}')
        return value

    def read(self, count: int) -> int:
        """Return the value if it is one."""
        return self.write(count)


class Layout:
    """
    A message as the file lays it out.

    :param checked: whether its last byte is a checksum.
    :ivar name: of the message.
    :ivar frame_id: of the message.
    :ivar path: of the file.
    """

    def __init__(self, message: Message, path: Path, checked: bool) -> None:
        self.name, self.frame_id, self._length = message.name, message.frame_id, message.length
        self.path = path
        origin = f'{path}: {self.name}'
        if message.is_extended_frame or message.is_fd or not 0 <= self._length <= 8:
            raise DbcError(f'{origin}: it must be a classic frame with an 11-bit identifier')
        if message.is_multiplexed():
            raise DbcError(f'{origin}: it must not be multiplexed')
        self._signals = {signal.name: signal for signal in message.signals}
        self._blank = dict.fromkeys(self._signals, 0)
        self._encode, self._decode = message.encode, message.decode_simple
        self._register = begun(self.frame_id) if checked else None
        if checked:
            signal = self._integer(CHECKSUM, 8)
            last = 8 * (self._length - 1) + (7 if signal.byte_order == 'big_endian' else 0)
            if signal.length != 8 or signal.start != last:
                raise DbcError(f'{origin}: {CHECKSUM} must be the last byte')

    def number(self, name: str, lowest: float = 0.0, highest: float = 0.0) -> Number:
        """
        Find a number.

        :param lowest, highest: what it must be able to say, to a count.
        :raises DbcError: it is not there, or is too narrow.
        """
        return self._wide_enough(name, Number, lowest, highest)

    def orientation(self, name: str) -> Number:
        """Find an angle in (-pi, pi], as `number`."""
        return self._wide_enough(name, Orientation, -pi, pi)

    def count(self, name: str, choices: int) -> Count:
        """
        Find what counts.

        :param choices: how many it must distinguish.
        :raises DbcError: it is not there, is too narrow, has a scale or a sign.
        """
        self._integer(name, (choices - 1).bit_length())
        return Count(f'{self.name}: {name}', choices)

    def modulo(self, name: str, least: float) -> Modulo:
        """
        Find what starts over.

        :param least: after how much it may start over at the earliest.
        :raises DbcError: it is not there, does so too early, or has a sign or an offset.
        """
        signal = self._signal(name)
        step, counts = float(signal.scale), 1 << signal.length
        if signal.is_float or signal.is_signed or signal.offset or not step > 0.0:
            raise DbcError(f'{self.path}: {self.name}: {name} must be unsigned, without an offset')
        if step * counts < least * (1.0 - _SLACK):
            raise DbcError(f'{self.path}: {self.name}: {name} is too narrow: it starts over at '
                           f'{step * counts:.6g}, {least:.6g} is needed')
        return Modulo(step, counts)

    def frame(self, counts: Mapping[str, float]) -> Frame:
        """Write a frame; signals that are not given are 0."""
        data = self._encode({**self._blank, **counts}, False, False, False)
        if self._register is not None:
            data = data[:-1]
            data += bytes((finished(self._register, data),))
        return Frame(self.frame_id, data)

    def counts(self, frame: Frame) -> dict[str, Any]:
        """
        Read a frame.

        :raises FrameError: wrong length, or corrupted.
        """
        data = frame.data
        if len(data) != self._length:
            raise FrameError('length', f'{self.name} (0x{self.frame_id:03X}) must have '
                                       f'{self._length} bytes, got {len(data)}')
        if self._register is not None and finished(self._register, data[:-1]) != data[-1]:
            raise FrameError('checksum', f'{self.name} (0x{self.frame_id:03X}): wrong checksum')
        counts: dict[str, Any] = self._decode(data, False, False)
        return counts

    def _signal(self, name: str) -> Signal:
        if name not in self._signals:
            raise DbcError(f'{self.path}: {self.name}: no signal {name}')
        return self._signals[name]

    def _integer(self, name: str, bits: int) -> Signal:
        signal = self._signal(name)
        origin = f'{self.path}: {self.name}: {name}'
        if signal.is_float or signal.is_signed or signal.scale != 1 or signal.offset != 0:
            raise DbcError(f'{origin} must be an unsigned integer without a scale')
        if signal.length < bits:
            raise DbcError(f'{origin} is too narrow: it has {signal.length} bits, '
                           f'{bits} are needed')
        return signal

    def _wide_enough(self, name: str, kind: type[Number], lowest: float, highest: float) -> Number:
        signal, origin = self._signal(name), f'{self.path}: {self.name}: {name}'
        number = kind(signal, origin, self.name)
        tolerance = 0.0 if signal.is_float else number.scale
        if number.lowest > lowest + tolerance or number.highest < highest - tolerance:
            raise DbcError(f'{origin} is too narrow: it goes from {number.lowest:.6g} to '
                           f'{number.highest:.6g}, {lowest:.6g} to {highest:.6g} is needed')
        return number


class DbcFile:
    """
    A DBC file.

    :param name: `prototype` for config/prototype.dbc, or the path of a file.
    :ivar path: of the file.
    :raises DbcError: no such file, or it is no DBC; cantools is not installed.
    """

    def __init__(self, name: str) -> None:
        self.path = _found(name)
        try:
            import cantools.database
        except ImportError as error:
            raise DbcError(f'{self.path}: cantools is missing: pip install fourbar_ros[hardware]'
                           ) from error
        # It writes about identifiers that occur twice, which are refused in `layout`.
        logging.getLogger('cantools').addHandler(logging.NullHandler())
        logging.getLogger('cantools').propagate = False
        try:
            database = cantools.database.load_file(self.path, database_format='dbc')
        except OSError as error:
            raise DbcError(f'{self.path}: {error.strerror}') from error
        except Exception as error:
            # The parser lets through whatever a malformed line leads to.
            raise DbcError(f'{self.path} is no DBC file that can be used: '
                           f'{" ".join(str(error).split())}') from error
        self._messages: list[Message] = list(getattr(database, 'messages', ()))

    def layout(self, name: str, checked: bool = True) -> Layout:
        """
        Find a message.

        :param checked: whether its last byte is a checksum.
        :raises DbcError: it is not there, or cannot be used.
        """
        found = [message for message in self._messages if message.name == name]
        if len(found) != 1:
            raise DbcError(f'{self.path}: {"no" if not found else "more than one"} message {name}')
        for message in self._messages:
            if message is not found[0] and message.frame_id == found[0].frame_id and (
                    message.is_extended_frame == found[0].is_extended_frame):
                raise DbcError(f'{self.path}: {name} and {message.name} have the same identifier '
                               f'0x{message.frame_id:03X}')
        return Layout(found[0], self.path, checked)


def _found(name: str) -> Path:
    path = Path(name).expanduser()
    if '/' not in name and path.suffix != '.dbc':
        folder = share_directory() / 'config'
        preset = folder / f'{name}.dbc'
        if preset.is_file():
            return preset
        if not path.is_file():
            known = ', '.join(sorted(file.stem for file in folder.glob('*.dbc')))
            raise ConfigurationError(
                f'no DBC file {name!r}: available are {known or "none"}, or a path to a file')
    if not path.is_file():
        raise ConfigurationError(f'DBC file {name}: no such file')
    return path
