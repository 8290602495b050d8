# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
CAN frames over UDP, one per datagram, for links on Wi-Fi.

The name of the interface in python-can is `fourbar_udp`. A datagram has, in network byte order,
`FB`, the version 1, flags (1 extended, 2 remote, 4 error), the identifier in 4 bytes, the length
code and the data; a remote frame has no data. Datagrams are unicast: Wi-Fi delays broadcasts until
a beacon, and does not repeat lost ones.
"""

from __future__ import annotations

from collections.abc import Sequence
import errno
from select import select
import socket
from struct import Struct
from time import monotonic, time
from typing import Any

import can
from can.typechecking import CanFilters

_HEADER = Struct('>2sBBIB')
_MAGIC, _VERSION = b'FB', 1
_EXTENDED, _REMOTE, _ERROR = 1, 2, 4
_LONGEST = _HEADER.size + 8

# Size of the receive buffer of the kernel [bytes].
_RECEIVE_BUFFER = 1 << 20
# Not in the socket module of every Python; its data are a timespec.
_SO_TIMESTAMPNS = getattr(socket, 'SO_TIMESTAMPNS', 35)
_TIMESPEC = Struct('@ll')
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size)

# Errors that mean an absent peer.
_UNREACHABLE = {errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.EHOSTDOWN}

# Time for which a receive call without timeout discards foreign datagrams [s].
_MAX_DISCARD_S = 0.001

Address = tuple[str, int]


class UdpBus(can.BusABC):
    """
    CAN frames in UDP datagrams, to and from known peers (IPv4).

    :param channel: `HOST:PORT` to bind; port 0 selects a free one.
    :param peers: addresses that send and receive all frames: `HOST:PORT,HOST:PORT`, or a sequence
        of `HOST:PORT`, which may be empty if `add_peer` is called later.
    :param can_filters: as for every bus of python-can.
    :param bitrate: ignored.
    :ivar address: bound host and port.
    :ivar foreign: number of datagrams from other senders than peers.
    :ivar malformed: number of datagrams from peers that are no frames.
    :ivar unreachable: number of frames to an absent peer.
    :raises can.CanInitializationError: invalid address, no peers, or port in use.
    """

    def __init__(self, channel: str, peers: str | Sequence[str] | None = None,
                 can_filters: CanFilters | None = None, bitrate: int | None = None,
                 **others: Any) -> None:
        if others:
            raise can.CanInitializationError(
                f'fourbar_udp knows no {", ".join(sorted(others))} (only peers)')
        if peers is None or peers == '':
            raise can.CanInitializationError(
                'fourbar_udp needs peers: peers=HOST:PORT,HOST:PORT')
        self.foreign = self.malformed = self.unreachable = 0
        self._peers: dict[Address, None] = {}
        for peer in peers.split(',') if isinstance(peers, str) else peers:
            self.add_peer(peer)
        local = _resolved(channel, 0)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            try:
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            except OSError:
                pass  # without it, the time of reading is the time of arrival
            self._socket.bind(local)
        except OSError as error:
            self._socket.close()
            raise can.CanInitializationError(
                f'cannot bind {channel}: {error.strerror or error}') from error
        self.address: Address = self._socket.getsockname()
        self.channel_info = f'fourbar_udp {self.address[0]}:{self.address[1]}'
        self._readers = [self._socket]
        # One byte longer than a frame, to detect datagrams that are too long.
        self._buffer = bytearray(_LONGEST + 1)
        self._into = [self._buffer]
        super().__init__(channel=channel, can_filters=can_filters)

    def add_peer(self, peer: str) -> None:
        """
        Add a peer.

        :param peer: `HOST:PORT`.
        :raises can.CanInitializationError: invalid address.
        """
        self._peers[_resolved(peer, 1)] = None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """
        Send a frame to every peer.

        :param timeout: not used; the call does not wait.
        :raises can.CanOperationError: the send buffer is full, or the network is down.
        """
        if msg.is_fd or msg.dlc > 8:
            raise can.CanOperationError('fourbar_udp carries classic CAN frames only')
        flags = (_EXTENDED * msg.is_extended_id | _REMOTE * msg.is_remote_frame
                 | _ERROR * msg.is_error_frame)
        datagram = _HEADER.pack(_MAGIC, _VERSION, flags, msg.arbitration_id, msg.dlc) + msg.data
        failed: OSError | None = None
        for peer in self._peers:
            try:
                self._socket.sendto(datagram, peer)
            except OSError as error:
                if error.errno in _UNREACHABLE:
                    self.unreachable += 1
                else:
                    # Raised after the other peers have the frame.
                    failed = error
        if failed is not None:
            raise can.CanOperationError(
                f'cannot send: {failed.strerror or failed}', failed.errno) from failed

    def fileno(self) -> int:
        """Return the file descriptor for `select`."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Close the socket."""
        super().shutdown()
        self._socket.close()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        deadline: float | None = None
        while True:
            try:
                length, ancillary, _, sender = self._socket.recvmsg_into(self._into, _ANCILLARY)
            except BlockingIOError:
                if timeout is None:
                    select(self._readers, (), ())
                    continue
                if timeout <= 0.0:
                    return None, False
                if deadline is None:
                    deadline = monotonic() + timeout
                if not select(self._readers, (), (), max(0.0, deadline - monotonic()))[0]:
                    return None, False
                continue
            except ConnectionError:
                self.unreachable += 1
                continue
            except (OSError, ValueError) as error:
                raise can.CanOperationError(f'cannot receive: {error}') from error
            message = self._message(length, ancillary, sender)
            if message is not None:
                return message, False
            # A flood of foreign datagrams must not extend a call without timeout.
            if deadline is None and timeout is not None:
                deadline = monotonic() + max(timeout, _MAX_DISCARD_S)
            if deadline is not None and monotonic() >= deadline:
                return None, False

    def _message(self, length: int, ancillary: list[Any], sender: Address) -> can.Message | None:
        if sender not in self._peers:
            self.foreign += 1
            return None
        if not _HEADER.size <= length <= _LONGEST:
            self.malformed += 1
            return None
        magic, version, flags, frame_id, dlc = _HEADER.unpack_from(self._buffer)
        data_length = 0 if flags & _REMOTE else dlc
        if (magic != _MAGIC or version != _VERSION or flags > 7 or dlc > 8
                or length != _HEADER.size + data_length
                or frame_id > (0x1FFFFFFF if flags & (_EXTENDED | _ERROR) else 0x7FF)):
            self.malformed += 1
            return None
        if ancillary and len(ancillary[0][2]) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(ancillary[0][2])
            timestamp = seconds + nanoseconds * 1e-9
        else:
            timestamp = time()
        return can.Message(
            timestamp, frame_id, bool(flags & _EXTENDED), bool(flags & _REMOTE),
            bool(flags & _ERROR), None, dlc, self._buffer[_HEADER.size:length])


def _resolved(address: str, lowest_port: int) -> Address:
    """Return numeric host and port of `HOST:PORT`."""
    host, _, port = address.strip().rpartition(':')
    if not host or not port.isdecimal() or not lowest_port <= int(port) <= 65535:
        raise can.CanInitializationError(
            f'{address!r} is no address: HOST:PORT is needed, the port from {lowest_port} '
            'to 65535')
    try:
        resolved = socket.getaddrinfo(host, int(port), socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise can.CanInitializationError(
            f'{address!r}: no such host ({getattr(error, "strerror", None) or error})'
        ) from error
    return str(resolved[0][4][0]), int(port)
