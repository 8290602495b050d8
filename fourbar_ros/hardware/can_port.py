# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
A bus, whatever carries it: any interface that python-can knows, and one kind of error.

python-can is imported only here, in `udp_bus` and in `serial_bus`, and not before a bus is opened.
"""

from __future__ import annotations

from contextlib import suppress
import errno
from importlib import import_module
from inspect import signature
import logging
import re
from time import monotonic, time
from types import TracebackType
from typing import Any, TYPE_CHECKING

from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.hardware.messages import BusError, Frame

if TYPE_CHECKING:
    import can

# Named where somebody asks for one that there is not.
USUAL_INTERFACES = ('socketcan', 'fourbar_udp', 'slcan', 'pcan', 'kvaser', 'gs_usb', 'vector',
                    'ixxat', 'virtual')

# Constructors that name every option they know, and let others pass.
_TOLERANT = ('socketcan', 'slcan', 'gs_usb', 'serial', 'virtual')

_BESIDE = {'foreign': 'datagrams_foreign', 'malformed': 'datagrams_malformed',
           'unreachable': 'datagrams_unreachable', 'garbled': 'bytes_garbled'}

# These stamp frames with system time, so that it is known how long a frame waited to be read.
SYSTEM_TIME = ('socketcan', 'fourbar_udp')
# Others may have clocks of their own: this far from system time it is one [s].
OWN_CLOCK_S = 1.0

# SocketCAN tells in the identifier of an error frame what is wrong (linux/can/error.h), and of
# the controller in the second byte.
_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100
_PASSIVE = 0x30

# Why nobody takes what is sent, or what all error frames look like.
_LOOK_AT = 'wiring, termination, bit rate, and whether the links have power'
_CAUSES = {
    errno.ENOBUFS: f'the send buffer is full: check {_LOOK_AT}; or it is too short '
                   '(ip link set ... txqueuelen 1000)',
    errno.ENODEV: 'no such interface (`ip link` lists them)',
    errno.ENETDOWN: 'the interface is down (ip link set ... up type can bitrate ...)',
    errno.EAFNOSUPPORT: 'the system knows no CAN sockets',
}
_CAUSES[errno.EAGAIN] = _CAUSES[errno.ENOBUFS]


class Port:
    """
    A bus that is open, and takes and gives classic frames with 11-bit identifiers.

    :param bus: of python-can.
    :param interface, channel: what it is called by.
    :ivar name: interface and channel, to tell it by.
    :ivar sent, received: number of frames.
    :ivar errors: number of error frames.
    :ivar dropped: number of frames that are extended or CAN FD.
    """

    def __init__(self, bus: can.BusABC, interface: str, channel: str) -> None:
        import can
        self.name = f'{interface} {channel}'
        self.sent = self.received = self.errors = self.dropped = 0
        self._bus: can.BusABC | None = bus
        self._message = can.Message
        self._problems = (can.CanError, OSError, ValueError)
        self._passive = {can.BusState.PASSIVE: 'error passive', can.BusState.ERROR: 'bus off'}
        self._system_time = interface in SYSTEM_TIME
        self._trouble: str | None = None

    def __enter__(self) -> Port:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self.close()

    @property
    def trouble(self) -> str | None:
        """
        Tell what is wrong with the bus itself, as far as its interface knows.

        :returns: a few words; None if nothing is known. A wrong bit rate is seen here.
        """
        state = self._trouble
        if self._bus is not None:
            with suppress(NotImplementedError, *self._problems):
                state = self._passive.get(self._bus.state, state)
        if state is None and self.errors:
            state = f'{self.errors} error frames'
        return None if state is None else f'{state}: check {_LOOK_AT}'

    def send(self, frame: Frame) -> None:
        """
        Send one frame.

        :raises BusError: the send buffer is full, the bus is off or down, the port is closed.
        """
        frame_id, data, remote = frame
        try:
            # A remote frame has the length of what it asks for; those of all that are asked for
            # is 8.
            self._open().send(self._message(
                arbitration_id=frame_id, is_extended_id=False, is_remote_frame=remote,
                dlc=8 if remote else None, data=data))
        except self._problems as error:
            raise BusError(f'{self.name}: cannot send: {_cause(error)}') from error
        self.sent += 1

    def receive(self, timeout_s: float) -> tuple[Frame, int] | None:
        """
        Wait for a frame.

        :param timeout_s: for how long; 0 to take what is there.
        :returns: the frame, and when it arrived on CLOCK_MONOTONIC_RAW [ns]; None if none did.
        :raises BusError: the bus is off or down, the port is closed.
        """
        deadline = monotonic() + timeout_s if timeout_s > 0.0 else 0.0
        remaining_s = timeout_s
        while True:
            try:
                message = self._open().recv(remaining_s)
            except self._problems as error:
                raise BusError(f'{self.name}: cannot receive: {_cause(error)}') from error
            if message is None:
                return None
            if not (message.is_error_frame or message.is_extended_id or message.is_fd):
                break
            if message.is_error_frame:
                self._take_error(message)
            else:
                self.dropped += 1
            if deadline:
                remaining_s = max(0.0, deadline - monotonic())
        now_ns, age_s = monotonic_ns(), time() - message.timestamp
        if age_s < 0.0 or age_s > OWN_CLOCK_S and not self._system_time:
            age_s = 0.0
        self.received += 1
        return Frame(message.arbitration_id, bytes(message.data), message.is_remote_frame), (
            now_ns - int(age_s * 1e9))

    def facts(self) -> dict[str, object]:
        """Tell what a person wants to know of the bus."""
        told: dict[str, object] = {
            'bus_name': self.name, 'frames_sent': self.sent, 'frames_received': self.received,
            'frames_errors': self.errors, 'frames_dropped': self.dropped}
        # What fourbar_udp and serial count beside.
        for name, fact in _BESIDE.items():
            if hasattr(self._bus, name):
                told[fact] = getattr(self._bus, name)
        if trouble := self.trouble:
            told['bus_trouble'] = trouble
        return told

    def close(self) -> None:
        """Close the bus, if it is not yet."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(*self._problems):
                bus.shutdown()

    def _open(self) -> can.BusABC:
        if self._bus is None:
            raise BusError(f'{self.name} is closed')
        return self._bus

    def _take_error(self, message: can.Message) -> None:
        self.errors += 1
        kind = message.arbitration_id
        if kind & _BUS_OFF:
            self._trouble = 'bus off'
            raise BusError(f'{self.name}: {self.trouble}')
        if kind & _RESTARTED:
            self._trouble = None
        elif kind & _CONTROLLER and len(message.data) > 1:
            self._trouble = 'error passive' if message.data[1] & _PASSIVE else None


def open_port(interface: str, channel: str, bitrate: int = 0, options: str = '') -> Port:
    """
    Open a bus.

    :param interface: as python-can calls it: `socketcan`, `fourbar_udp`, ...
    :param channel: the same: `can0`, `/dev/ttyACM0`, `HOST:PORT`.
    :param bitrate: [bit/s], 0 to leave it as it is; of SocketCAN it is the system that sets it.
    :param options: what else the interface takes: `key=value key=value`.
    :raises BusError: python-can is not installed; no such interface or channel; bad options.
    """
    name = f'{interface} {channel}'
    settings = _settings(name, options)
    if bitrate:
        settings['bitrate'] = bitrate
    try:
        import can
    except ImportError as error:
        raise BusError(f'{name}: python-can is missing: pip install fourbar_ros[hardware]'
                       ) from error
    _hush()
    if interface not in can.VALID_INTERFACES:
        raise BusError(f'{name}: no such interface (usual ones: {", ".join(USUAL_INTERFACES)})')
    try:
        if interface in _TOLERANT:
            kind = _kind(interface)
            _check_options(name, kind, settings)
            if interface == 'serial':
                return Port(kind(channel, **settings), interface, channel)
        # Nothing from the files that python-can keeps in the home of whoever runs this.
        bus = can.Bus(channel, interface, ignore_config=True, **settings)
    except BusError:
        raise
    except (can.CanInterfaceNotImplementedError, ImportError, NameError) as error:
        # Some drivers of python-can look for their library not before it is needed.
        raise BusError(f'{name}: what it needs is not installed: {_cause(error)} (serial lines '
                       'and multicast: pip install fourbar_ros[hardware])') from error
    except Exception as error:
        # Drivers raise what they like.
        raise BusError(f'{name}: {_cause(error)}') from error
    return Port(bus, interface, channel)


def _settings(name: str, options: str) -> dict[str, Any]:
    settings: dict[str, Any] = {}
    for option in options.split():
        key, sign, text = option.partition('=')
        if not sign or not key.isidentifier() or not text:
            raise BusError(f'{name}: option {option!r} must be key=value')
        if key in ('interface', 'channel', 'bitrate'):
            raise BusError(f'{name}: {key} is no option, it is given by itself')
        if key in settings:
            raise BusError(f'{name}: option {key} is given twice')
        settings[key] = _value(text)
    return settings


def _kind(interface: str) -> type[Any]:
    """Return the class of a bus."""
    from can.interfaces import BACKENDS
    module, name = BACKENDS[interface]
    if interface == 'serial':
        # The same bytes, but a line that is read as it shall be.
        module = 'fourbar_ros.hardware.serial_bus'
    kind: type[Any] = getattr(import_module(module), name)
    return kind


def _check_options(name: str, kind: type[Any], settings: dict[str, Any]) -> None:
    known = signature(kind).parameters
    if unknown := sorted(set(settings) - set(known) - {'bitrate'}):
        options = sorted(set(known) - {'channel', 'bitrate', 'kwargs', 'can_filters'})
        raise BusError(f'{name}: no option {", ".join(unknown)} (known are {", ".join(options)})')


def _value(text: str) -> str | int | float | bool:
    if text.lower() in ('true', 'false'):
        return text.lower() == 'true'
    if re.fullmatch(r'[-+]?(\d+|0[xX][0-9a-fA-F]+)', text):
        return int(text, 0) if 'x' in text.lower() else int(text)
    if re.fullmatch(r'[-+]?(\d+\.\d*|\.\d+)([eE][-+]?\d+)?', text):
        return float(text)
    return text


def _cause(error: BaseException) -> str:
    """Return in one line what went wrong, and what to do about it where that is known."""
    number = getattr(error, 'error_code', None) or getattr(error, 'errno', None)
    text = ' '.join((getattr(error, 'strerror', None) or str(error)).split())
    if 'buffer full' in text.lower():
        number = errno.ENOBUFS
    return _CAUSES.get(number or 0, text or type(error).__name__)


def _hush() -> None:
    """Keep python-can from writing about what is told by an error, or is of no interest."""
    logger = logging.getLogger('can')
    if not any(isinstance(handler, logging.NullHandler) for handler in logger.handlers):
        logger.addHandler(logging.NullHandler())
    logger.propagate = False
