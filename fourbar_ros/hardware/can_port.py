# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
A CAN bus through any interface of python-can, with one kind of error.

python-can is imported only in this module, in `udp_bus` and in `serial_bus`, and only when a bus
is opened.
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

# Examples in the message about an unknown interface.
USUAL_INTERFACES = ('socketcan', 'fourbar_udp', 'slcan', 'pcan', 'kvaser', 'gs_usb', 'vector',
                    'ixxat', 'virtual')

# Interfaces whose constructors name all options and ignore unknown ones without an error.
_UNCHECKED_OPTIONS = ('socketcan', 'slcan', 'gs_usb', 'serial', 'virtual')

# Counters of our own buses, by attribute; the values are keys of diagnostics.
_BUS_COUNTERS = {'foreign': 'datagrams_foreign', 'malformed': 'datagrams_malformed',
                 'unreachable': 'datagrams_unreachable', 'garbled': 'bytes_garbled'}

# Interfaces that stamp received frames with system time, so that the wait in the receive buffer
# is known.
SYSTEM_TIME = ('socketcan', 'fourbar_udp')
# Larger differences to system time are taken for the adapter's own clock [s].
MAX_FRAME_AGE_S = 1.0

# Error frames of SocketCAN (linux/can/error.h): bits of the identifier, and bits of the second
# byte for the state `error passive`.
_CONTROLLER, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100
_PASSIVE = 0x30

_CHECKLIST = 'wiring, termination, bit rate, and whether the links have power'
_CAUSES = {
    errno.ENOBUFS: f'the send buffer is full: check {_CHECKLIST}; or it is too short '
                   '(ip link set ... txqueuelen 1000)',
    errno.ENODEV: 'no such interface (`ip link` lists them)',
    errno.ENETDOWN: 'the interface is down (ip link set ... up type can bitrate ...)',
    errno.EAFNOSUPPORT: 'the system knows no CAN sockets',
}
_CAUSES[errno.EAGAIN] = _CAUSES[errno.ENOBUFS]


class Port:
    """
    An open bus for classic frames with 11-bit identifiers.

    :param bus: of python-can.
    :param interface, channel: names of interface and channel.
    :ivar name: interface and channel, for messages.
    :ivar sent, received: number of frames.
    :ivar errors: number of error frames.
    :ivar dropped: number of extended and CAN FD frames.
    """

    def __init__(self, bus: can.BusABC, interface: str, channel: str) -> None:
        import can
        self.name = f'{interface} {channel}'
        self.sent = self.received = self.errors = self.dropped = 0
        self._bus: can.BusABC | None = bus
        self._message = can.Message
        self._driver_errors = (can.CanError, OSError, ValueError)
        self._bus_states = {can.BusState.PASSIVE: 'error passive', can.BusState.ERROR: 'bus off'}
        self._system_time = interface in SYSTEM_TIME
        self._error_state: str | None = None

    def __enter__(self) -> Port:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self.close()

    @property
    def fault(self) -> str | None:
        """
        Fault of the bus, as far as its interface reports one; None if there is none.

        A wrong bit rate appears here, as error frames.
        """
        state = self._error_state
        if self._bus is not None:
            # Some interfaces of python-can report no state.
            with suppress(NotImplementedError, *self._driver_errors):
                state = self._bus_states.get(self._bus.state, state)
        if state is None and self.errors:
            state = f'{self.errors} error frames'
        return None if state is None else f'{state}: check {_CHECKLIST}'

    def send(self, frame: Frame) -> None:
        """
        Send one frame.

        :raises BusError: the send buffer is full, the bus is off or down, the port is closed.
        """
        frame_id, data, remote = frame
        try:
            # The length of a remote frame is that of the requested data: 8 in all our messages.
            self._open().send(self._message(
                arbitration_id=frame_id, is_extended_id=False, is_remote_frame=remote,
                dlc=8 if remote else None, data=data))
        except self._driver_errors as error:
            raise _bus_error(self.name, 'cannot send: ', error) from error
        self.sent += 1

    def receive(self, timeout_s: float) -> tuple[Frame, int] | None:
        """
        Wait for a frame.

        :param timeout_s: longest wait; 0: return at once.
        :returns: the frame and its time of arrival on the monotonic clock [ns]; None at the
            timeout.
        :raises BusError: the bus is off or down, the port is closed.
        """
        deadline = monotonic() + timeout_s if timeout_s > 0.0 else 0.0
        remaining_s = timeout_s
        while True:
            try:
                message = self._open().recv(remaining_s)
            except self._driver_errors as error:
                raise _bus_error(self.name, 'cannot receive: ', error) from error
            if message is None:
                return None
            if not (message.is_error_frame or message.is_extended_id or message.is_fd):
                break
            if message.is_error_frame:
                self._process_error(message)
            else:
                self.dropped += 1
            if deadline:
                remaining_s = max(0.0, deadline - monotonic())
        now_ns, age_s = monotonic_ns(), time() - message.timestamp
        if age_s < 0.0 or age_s > MAX_FRAME_AGE_S and not self._system_time:
            age_s = 0.0
        self.received += 1
        return Frame(message.arbitration_id, bytes(message.data), message.is_remote_frame), (
            now_ns - int(age_s * 1e9))

    def diagnostic_values(self) -> dict[str, object]:
        """Return counters and the present fault, by name."""
        values: dict[str, object] = {
            'bus_name': self.name, 'frames_sent': self.sent, 'frames_received': self.received,
            'frames_errors': self.errors, 'frames_dropped': self.dropped}
        values.update({key: getattr(self._bus, attribute) for attribute, key
                       in _BUS_COUNTERS.items() if hasattr(self._bus, attribute)})
        if fault := self.fault:
            values['bus_trouble'] = fault
        return values

    def close(self) -> None:
        """Close the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with suppress(*self._driver_errors):
                bus.shutdown()

    def _open(self) -> can.BusABC:
        if self._bus is None:
            raise BusError(f'{self.name} is closed', bus=self.name)
        return self._bus

    def _process_error(self, message: can.Message) -> None:
        self.errors += 1
        kind = message.arbitration_id
        if kind & _BUS_OFF:
            self._error_state = 'bus off'
            raise BusError(f'{self.name}: {self.fault}', bus=self.name, state='bus off')
        if kind & _RESTARTED:
            self._error_state = None
        elif kind & _CONTROLLER and len(message.data) > 1:
            self._error_state = 'error passive' if message.data[1] & _PASSIVE else None


def open_port(interface: str, channel: str, bitrate: int = 0, options: str = '') -> Port:
    """
    Open a bus.

    :param interface: its name in python-can: `socketcan`, `fourbar_udp`, ...
    :param channel: its name in python-can: `can0`, `/dev/ttyACM0`, `HOST:PORT`.
    :param bitrate: [bit/s], 0 to leave it unchanged; on SocketCAN the system sets it.
    :param options: further options of the interface: `key=value key=value`.
    :raises BusError: python-can is not installed; no such interface or channel; bad options. Its
        `values` have `bus`, `option` for a bad option, and `errno` of the system or None.
    """
    name = f'{interface} {channel}'
    settings = _settings(name, options)
    if bitrate:
        settings['bitrate'] = bitrate
    try:
        import can
    except ImportError as error:
        raise BusError(f'{name}: python-can is missing: pip install fourbar_ros[hardware]',
                       bus=name) from error
    _silence_logger()
    if interface not in can.VALID_INTERFACES:
        raise BusError(f'{name}: no such interface (usual ones: {", ".join(USUAL_INTERFACES)})',
                       bus=name)
    try:
        if interface in _UNCHECKED_OPTIONS:
            kind = _bus_class(interface)
            _check_options(name, kind, settings)
            if interface == 'serial':
                return Port(kind(channel, **settings), interface, channel)
        # Without the configuration files of python-can in the user's home.
        bus = can.Bus(channel, interface, ignore_config=True, **settings)
    except BusError:
        raise
    except (can.CanInterfaceNotImplementedError, ImportError, NameError) as error:
        # Some drivers of python-can import their library only here.
        raise _bus_error(name, 'a required package is not installed (serial lines and multicast: '
                         'pip install fourbar_ros[hardware]): ', error) from error
    except Exception as error:
        # Drivers raise many kinds of errors.
        raise _bus_error(name, '', error) from error
    return Port(bus, interface, channel)


def _settings(name: str, options: str) -> dict[str, Any]:
    settings: dict[str, Any] = {}
    for option in options.split():
        key, sign, text = option.partition('=')
        problem = ''
        if not sign or not key.isidentifier() or not text:
            problem = f'option {option!r} must be key=value'
        elif key in ('interface', 'channel', 'bitrate'):
            problem = f'{key} is no option, it has a parameter of its own'
        elif key in settings:
            problem = f'option {key} is given twice'
        if problem:
            raise BusError(f'{name}: {problem}', bus=name, option=option)
        settings[key] = _value(text)
    return settings


def _bus_class(interface: str) -> type[Any]:
    from can.interfaces import BACKENDS
    module, name = BACKENDS[interface]
    if interface == 'serial':
        # Same format on the line, but with timeouts and resynchronization.
        module = 'fourbar_ros.hardware.serial_bus'
    kind: type[Any] = getattr(import_module(module), name)
    return kind


def _check_options(name: str, kind: type[Any], settings: dict[str, Any]) -> None:
    known = signature(kind).parameters
    if unknown := sorted(set(settings) - set(known) - {'bitrate'}):
        options = sorted(set(known) - {'channel', 'bitrate', 'kwargs', 'can_filters'})
        raise BusError(f'{name}: no option {", ".join(unknown)} (known are {", ".join(options)})',
                       bus=name, option=unknown[0], limit=options)


def _value(text: str) -> str | int | float | bool:
    if text.lower() in ('true', 'false'):
        return text.lower() == 'true'
    if re.fullmatch(r'[-+]?(\d+|0[xX][0-9a-fA-F]+)', text):
        return int(text, 0) if 'x' in text.lower() else int(text)
    if re.fullmatch(r'[-+]?(\d+\.\d*|\.\d+)([eE][-+]?\d+)?', text):
        return float(text)
    return text


def _bus_error(name: str, action: str, error: BaseException) -> BusError:
    """Return an error in one line, with its cause, and a remedy where one is known."""
    number = getattr(error, 'error_code', None) or getattr(error, 'errno', None)
    text = ' '.join((getattr(error, 'strerror', None) or str(error)).split())
    if 'buffer full' in text.lower():
        number = errno.ENOBUFS
    text = _CAUSES.get(number or 0, text or type(error).__name__)
    return BusError(f'{name}: {action}{text}', bus=name, errno=number)


def _silence_logger() -> None:
    """Keep python-can from logging what errors report already."""
    logger = logging.getLogger('can')
    if not any(isinstance(handler, logging.NullHandler) for handler in logger.handlers):
        logger.addHandler(logging.NullHandler())
    logger.propagate = False
