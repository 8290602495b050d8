# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
CAN frames over a serial line, in the format of python-can's interface `serial`.

A frame is 0xAA, a time of the sender in 4 bytes, the length code, the identifier in 4 bytes with
flags in the high bits (extended, remote, error), the data and 0xBB. Low bytes come first; a remote
frame has no data. Unlike python-can's own class, this one observes the timeout of a receive call
and finds the next frame after a wrong byte.
"""

from __future__ import annotations

from select import select
from struct import Struct
from time import monotonic, time
from typing import Any

import can

_BEGIN, _END = 0xAA, 0xBB
_HEADER = Struct('<BIBI')
_EXTENDED, _REMOTE, _ERROR = 1 << 31, 1 << 30, 1 << 29
_LONG, _SHORT = (1 << 29) - 1, (1 << 11) - 1

# Largest number of bytes per read.
_CHUNK = 4096
# Longest time of a write; then the line is not connected or too slow [s].
_WRITE_TIMEOUT_S = 0.05


class SerialBus(can.BusABC):
    """
    CAN frames on a serial line.

    :param channel: the device, as `/dev/ttyUSB0`.
    :param baudrate: [bit/s].
    :param rtscts: whether the line has hardware handshake.
    :param bitrate: ignored.
    :ivar garbled: number of sequences of bytes that are no frame.
    :raises can.CanInterfaceNotImplementedError: pyserial is not installed.
    :raises OSError: no such device, or it is in use.
    :raises ValueError: the device does not support the baud rate.
    """

    def __init__(self, channel: str, baudrate: int = 115_200, rtscts: bool = False,
                 bitrate: int | None = None) -> None:
        try:
            import serial
        except ImportError as error:
            raise can.CanInterfaceNotImplementedError('pyserial') from error
        self.garbled = 0
        self.channel_info = f'serial {channel}'
        self._bytes = bytearray()
        self._skipping = False
        # Exclusive, since two readers would each receive only a part of the bytes.
        self._line: Any = serial.Serial(
            channel, baudrate, timeout=0.0, write_timeout=_WRITE_TIMEOUT_S, rtscts=rtscts,
            exclusive=True)
        super().__init__(channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """
        Send a frame.

        :param timeout: not used; a write takes at most 50 ms.
        :raises can.CanOperationError: not a classic frame.
        :raises OSError: the line accepts no data, or is disconnected.
        """
        if msg.is_fd or msg.dlc > 8:
            raise can.CanOperationError('serial carries classic CAN frames only')
        frame_id = (msg.arbitration_id | _EXTENDED * msg.is_extended_id
                    | _REMOTE * msg.is_remote_frame | _ERROR * msg.is_error_frame)
        data = b'' if msg.is_remote_frame else bytes(msg.data)
        self._line.write(_HEADER.pack(_BEGIN, 0, msg.dlc, frame_id) + data + bytes((_END,)))

    def fileno(self) -> int:
        """Return the file descriptor for `select`."""
        return int(self._line.fileno())

    def shutdown(self) -> None:
        """Close the line."""
        super().shutdown()
        self._line.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline = None if timeout is None else monotonic() + timeout
        while True:
            message = self._message()
            if message is not None:
                return message, False
            chunk = self._line.read(_CHUNK)
            if chunk:
                self._bytes += chunk
                message = self._message()
                if message is not None:
                    return message, False
            remaining = None if deadline is None else deadline - monotonic()
            if remaining is not None and remaining <= 0.0:
                return None, False
            select((self._line,), (), (), remaining)

    def _message(self) -> can.Message | None:
        """Return the next complete frame from the received bytes."""
        data = self._bytes
        while data:
            if data[0] != _BEGIN:
                if not self._skipping:
                    self.garbled, self._skipping = self.garbled + 1, True
                begin = data.find(_BEGIN)
                del data[:begin if begin >= 0 else len(data)]
                continue
            if len(data) < _HEADER.size:
                return None
            _, _, dlc, flagged = _HEADER.unpack_from(data)
            end = _HEADER.size + (0 if flagged & _REMOTE else dlc)
            if dlc <= 8 and len(data) <= end:
                return None
            frame_id = flagged & _LONG
            highest = _LONG if flagged & (_EXTENDED | _ERROR) else _SHORT
            if dlc > 8 or data[end] != _END or frame_id > highest:
                # Not the begin of a frame; one may begin within these bytes.
                if not self._skipping:
                    self.garbled, self._skipping = self.garbled + 1, True
                del data[:1]
                continue
            self._skipping = False
            payload = bytes(data[_HEADER.size:end])
            del data[:end + 1]
            return can.Message(
                time(), frame_id, bool(flagged & _EXTENDED), bool(flagged & _REMOTE),
                bool(flagged & _ERROR), None, dlc, payload)
        return None
