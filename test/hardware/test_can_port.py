# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The port of every kind of bus: frames, arrival times on one clock, and errors."""

from contextlib import suppress
import errno
import logging
import os
from pty import openpty
from select import select
import subprocess
import sys
from threading import Thread
from time import clock_gettime_ns, CLOCK_MONOTONIC_RAW, time
from tty import setraw

import can
from fourbar_ros.hardware.can_port import open_port, Port
from fourbar_ros.hardware.messages import BusError, Frame
from fourbar_ros.hardware.udp_bus import UdpBus
import pytest

PATIENCE_S = 5.0
FRAME = Frame(0x123, b'\x01\x02\x03')


class StubBus(can.BusABC):
    """
    A bus that returns prepared messages, or fails.

    :ivar messages: messages to receive, one per call with a None as a pause.
    :ivar sent: sent messages.
    """

    def __init__(self, *messages, error=None):
        self.messages = list(messages)
        self.sent = []
        self.error = error
        super().__init__('stub')

    def send(self, msg, timeout=None):
        if self.error is not None:
            raise self.error
        self.sent.append(msg)

    def _recv_internal(self, timeout):
        if self.error is not None:
            raise self.error
        return (self.messages.pop(0) if self.messages else None), True


@pytest.fixture
def stub():
    """Return a function that makes a port over a stub."""
    ports = []

    def stub(*messages, interface='stub', **options):
        ports.append(Port(StubBus(*messages, **options), interface, 'here'))
        return ports[-1]
    yield stub
    for port in ports:
        port.close()


def virtual(request):
    """Open two ports on one virtual channel."""
    return [open_port('virtual', request.node.name) for _ in range(2)]


def udp(request):
    """Open two ports that are peers."""
    first = UdpBus('127.0.0.1:0', ())
    second = UdpBus('127.0.0.1:0', '{}:{}'.format(*first.address))
    first.add_peer('{}:{}'.format(*second.address))
    return [Port(bus, 'fourbar_udp', '127.0.0.1:0') for bus in (first, second)]


def serial(request):
    """Open two ports at the ends of one serial line."""
    near, far = Line(), Line()
    request.addfinalizer(near.close)
    request.addfinalizer(far.close)
    Thread(target=connect, args=(near, far), daemon=True).start()
    return [open_port('serial', line.name) for line in (near, far)]


class Line:
    """A serial line between a port and this program."""

    def __init__(self):
        self.far, self._near = openpty()
        for end in (self.far, self._near):
            setraw(end)
        self.name = os.ttyname(self._near)

    def close(self):
        """Disconnect the line."""
        for end in (self.far, self._near):
            with suppress(OSError):
                os.close(end)


def connect(*lines):
    """Forward the bytes of each of two lines to the other one until one is closed."""
    ends = [line.far for line in lines]
    with suppress(OSError, ValueError):
        while True:
            for end in select(ends, (), ())[0]:
                os.write(ends[1 - ends.index(end)], os.read(end, 4096))


@pytest.fixture(params=[virtual, udp, serial], ids=lambda kind: kind.__name__)
def pair(request):
    """Open two ports that receive frames of each other."""
    ports = request.param(request)
    yield ports
    for port in ports:
        port.close()


def now_ns():
    """Return the present time of the clock of arrival times [ns]."""
    return clock_gettime_ns(CLOCK_MONOTONIC_RAW)


def test_frames_go_through_and_are_counted(pair):
    first, second = pair
    frames = [FRAME, Frame(0x7FF, bytes(8)), Frame(0), Frame(0x009, b'', True)]
    for frame in frames:
        first.send(frame)
    assert [second.receive(PATIENCE_S)[0] for _ in frames] == frames
    assert second.receive(0.0) is None and second.receive(0.01) is None
    assert (first.sent, second.received, second.errors, second.dropped) == (4, 4, 0, 0)
    values = first.diagnostic_values()
    assert values['frames_sent'] == 4 and 'bus_trouble' not in values


def test_arrival_is_between_sending_and_receiving(pair):
    first, second = pair
    for _ in range(50):
        before_ns = now_ns()
        first.send(FRAME)
        _, arrival_ns = second.receive(PATIENCE_S)
        # A float of system time has a resolution of 0.3 us, and the clocks are read in turn.
        assert before_ns - 1_000_000 <= arrival_ns <= now_ns()


def test_remote_frame_requests_eight_bytes():
    bus = StubBus()
    with Port(bus, 'stub', 'here') as port:
        port.send(Frame(0x009, b'', True))
    assert (bus.sent[0].dlc, bus.sent[0].is_remote_frame) == (8, True)


@pytest.mark.parametrize('interface, age_s, back_s', [
    ('pcan', 0.2, 0.2), ('pcan', 0.0, 0.0), ('pcan', -0.5, 0.0),
    # Clocks of adapters with an arbitrary origin.
    ('pcan', 1.5, 0.0), ('pcan', -3600.0, 0.0), ('pcan', 1e9, 0.0),
    # These interfaces stamp with system time, so the age is that of an unread frame.
    ('socketcan', 1.5, 1.5), ('fourbar_udp', 30.0, 30.0), ('socketcan', -0.5, 0.0),
])
def test_arrival_time_of_a_frame_that_was_read_late(stub, interface, age_s, back_s):
    port = stub(can.Message(timestamp=time() - age_s, is_extended_id=False), interface=interface)
    before_ns = now_ns()
    _, arrival_ns = port.receive(0.0)
    assert before_ns <= arrival_ns + back_s * 1e9 + 1e6
    assert arrival_ns + back_s * 1e9 <= now_ns() + 1e6
    assert arrival_ns <= now_ns()


def test_other_than_classic_frames_are_counted_and_dropped(stub):
    port = stub(
        can.Message(arbitration_id=1, is_extended_id=True),
        can.Message(arbitration_id=1, is_extended_id=False, is_fd=True),
        can.Message(arbitration_id=8, is_extended_id=False, is_error_frame=True),
        can.Message(arbitration_id=0x123, is_extended_id=False))
    assert port.receive(PATIENCE_S)[0] == Frame(0x123)
    assert (port.received, port.dropped, port.errors) == (1, 2, 1)


def error_frame(kind, controller=0):
    """Make an error frame of SocketCAN."""
    return can.Message(arbitration_id=kind, is_extended_id=False, is_error_frame=True,
                       data=bytes([0, controller, 0, 0, 0, 0, 0, 0]))


def test_fault_of_the_bus_is_reported(stub):
    # None ends a call of receive without a frame.
    port = stub(error_frame(0x008), None, error_frame(0x004, 0x10), None,
                error_frame(0x004, 0x40), None, error_frame(0x040))
    assert port.fault is None
    for expected in ('1 error frames', 'error passive', '3 error frames'):
        assert port.receive(0.0) is None
        assert port.fault.startswith(expected) and 'bit rate' in port.fault
    with pytest.raises(BusError) as caught:
        port.receive(0.0)
    assert caught.value.values == {'bus': 'stub here', 'state': 'bus off'}
    assert port.diagnostic_values()['bus_trouble'] == port.fault


@pytest.mark.parametrize('state, expected', [
    (can.BusState.ACTIVE, None), (can.BusState.PASSIVE, 'error passive'),
    (can.BusState.ERROR, 'bus off')])
def test_state_of_the_bus_is_reported(stub, monkeypatch, state, expected):
    monkeypatch.setattr(StubBus, 'state', state)
    fault = stub().fault
    assert fault is None if expected is None else fault.startswith(expected)


@pytest.mark.parametrize('error, number, text', [
    (can.CanOperationError('Failed to transmit: No buffer space available', errno.ENOBUFS),
     errno.ENOBUFS, 'txqueuelen'),
    (can.CanOperationError('Transmit buffer full'), errno.ENOBUFS, 'txqueuelen'),
    (OSError(errno.ENOBUFS, 'No buffer space available'), errno.ENOBUFS, 'txqueuelen'),
    (can.CanOperationError('Failed to transmit: Network is down', errno.ENETDOWN),
     errno.ENETDOWN, 'ip link set'),
    (OSError(errno.ENODEV, 'No such device'), errno.ENODEV, 'ip link'),
    (can.CanOperationError('the adapter\nis gone'), None, 'the adapter is gone'),
    (can.CanOperationError(), None, 'CanOperationError'),
    (ValueError('closed'), None, 'closed'),
])
def test_driver_errors_are_reported_in_one_line(stub, refuses, error, number, text):
    port = stub(error=error)
    for use in (lambda: port.send(FRAME), lambda: port.receive(0.0)):
        with refuses(BusError, bus='stub here', errno=number) as caught:
            use()
        assert text in str(caught.value)
    assert (port.sent, port.received) == (0, 0)


def test_closed_port_cannot_be_used(pair, refuses):
    first, _ = pair
    first.close()
    first.close()
    for use in (lambda: first.send(FRAME), lambda: first.receive(0.0)):
        with refuses(BusError, bus=first.name):
            use()


def test_context_manager_closes_the_port(request, refuses):
    with open_port('virtual', request.node.name) as port:
        port.send(FRAME)
    with refuses(BusError, bus=port.name):
        port.send(FRAME)


@pytest.mark.parametrize('interface, channel, options, values, text', [
    ('sockedcan', 'can0', '', {}, 'socketcan, fourbar_udp'),
    # The kernel lacks either the interface or CAN.
    ('socketcan', 'can_none', '', {}, ''),
    ('virtual', 'x', 'novalue', {'option': 'novalue'}, 'key=value'),
    ('virtual', 'x', '=1', {'option': '=1'}, 'key=value'),
    ('virtual', 'x', 'a=', {'option': 'a='}, 'key=value'),
    ('virtual', 'x', 'a-b=1', {'option': 'a-b=1'}, 'key=value'),
    ('virtual', 'x', 'bitrate=1', {'option': 'bitrate=1'}, 'bitrate'),
    ('virtual', 'x', 'channel=y', {'option': 'channel=y'}, 'channel'),
    ('virtual', 'x', 'rx_queue_size=1 rx_queue_size=2', {'option': 'rx_queue_size=2'}, ''),
    ('virtual', 'x', 'rx_queue=1', {'option': 'rx_queue'}, 'rx_queue_size'),
    ('fourbar_udp', '127.0.0.1:0', '', {}, 'peers=HOST:PORT'),
    ('fourbar_udp', '127.0.0.1:0', 'peers=127.0.0.1', {}, "'127.0.0.1'"),
    ('fourbar_udp', '127.0.0.1:0', 'peers=127.0.0.1:9 speed=1', {}, 'speed'),
    ('fourbar_udp', 'can0', 'peers=127.0.0.1:9', {}, "'can0'"),
    ('serial', '/dev/ttyNONE', '', {'errno': errno.ENOENT}, ''),
    ('serial', '/dev/ttyNONE', 'baud=9600', {'option': 'baud', 'limit': ['baudrate', 'rtscts']},
     ''),
])
def test_bus_that_cannot_be_opened_is_reported_in_one_line(
        interface, channel, options, values, text, refuses, caplog, capfd):
    with refuses(BusError, bus=f'{interface} {channel}', **values) as caught:
        open_port(interface, channel, 500_000, options)
    assert text in str(caught.value) and f'{interface} {channel}: ' in str(caught.value)
    assert (caplog.text, *capfd.readouterr()) == ('', '', '')


def test_options_have_the_type_of_their_text(monkeypatch):
    received = {}

    def bus(channel, interface, ignore_config, **options):
        received.update(options)
        return StubBus()
    monkeypatch.setattr(can, 'Bus', bus)
    open_port('pcan', 'x', options='on=true off=False hex=0x10 number=-7 real=2.5e-1 text=1a'
              ).close()
    assert received == {'on': True, 'off': False, 'hex': 16, 'number': -7, 'real': 0.25,
                        'text': '1a'}


def test_open_bus_of_datagrams():
    with open_port('fourbar_udp', '127.0.0.1:0', 1_000_000, 'peers=127.0.0.1:9') as port:
        assert port.receive(0.0) is None
        assert port.diagnostic_values()['datagrams_foreign'] == 0


@pytest.fixture
def line():
    """Return a serial line."""
    line = Line()
    yield line
    line.close()


def test_incomplete_frame_does_not_block_and_is_completed_later(line):
    said = b'\xaa' + bytes(4) + b'\x02' + b'\x23\x01\x00\x00' + b'ab\xbb'
    with open_port('serial', line.name) as port:
        for begin, end in ((0, 1), (1, 7), (7, 12)):
            os.write(line.far, said[begin:end])
            assert port.receive(0.0) is None
        os.write(line.far, said[12:] + said)
        assert [port.receive(PATIENCE_S)[0] for _ in range(2)] == [Frame(0x123, b'ab')] * 2
        assert port.diagnostic_values()['bytes_garbled'] == 0


@pytest.mark.parametrize('noise', [
    b'\x12\x34', b'\xaa', b'\xaa\xaa\xaa\xaa\xaa\xaa\xaa\xaa\xaa\xaa\xaa\xaa', b'\xbb',
    b'\xaa' + bytes(4) + b'\x09' + bytes(8),              # an invalid length
    b'\xaa' + bytes(4) + b'\x01\x00\x08\x00\x00\x00\xbb',   # an invalid identifier
    b'\xaa' + bytes(4) + b'\x01\x00\x01\x00\x00\x00\xbc'])  # an invalid end
def test_noise_on_a_line_corrupts_no_later_frame(line, noise):
    said = b'\xaa' + bytes(4) + b'\x02' + b'\x23\x01\x00\x00' + b'ab\xbb'
    with open_port('serial', line.name) as port:
        os.write(line.far, said + noise + 20 * said)
        assert [port.receive(PATIENCE_S)[0] for _ in range(21)] == [Frame(0x123, b'ab')] * 21
        assert port.receive(0.0) is None
        assert port.diagnostic_values()['bytes_garbled'] == 1


def test_disconnected_line_is_reported(line, refuses):
    with open_port('serial', line.name) as port:
        line.close()
        with refuses(BusError, bus=f'serial {line.name}'):
            port.receive(PATIENCE_S)


def test_line_is_exclusive(line, refuses):
    with open_port('serial', line.name), refuses(BusError, bus=f'serial {line.name}'):
        open_port('serial', line.name)


@pytest.mark.parametrize('interface, options', [('serial', ''), ('slcan', '')])
def test_missing_pyserial_is_reported(monkeypatch, interface, options, refuses):
    monkeypatch.setitem(sys.modules, 'serial', None)
    monkeypatch.setattr('can.interfaces.slcan.serial', None)
    with refuses(BusError, bus=f'{interface} /dev/ttyNONE') as caught:
        open_port(interface, '/dev/ttyNONE', 0, options)
    assert 'pip install fourbar_ros[hardware]' in str(caught.value)


def test_missing_python_can_is_reported(monkeypatch, refuses):
    monkeypatch.setitem(sys.modules, 'can', None)
    with refuses(BusError, bus='socketcan can0') as caught:
        open_port('socketcan', 'can0')
    assert 'pip install fourbar_ros[hardware]' in str(caught.value)


def test_python_can_is_not_imported_before_it_is_needed():
    code = ('import sys; from fourbar_ros.hardware import can_port, dbc_codec; '
            'sys.exit(bool({"can", "cantools"} & set(sys.modules)))')
    assert subprocess.run([sys.executable, '-c', code], timeout=60).returncode == 0


def test_open_ports_at_exit_print_nothing():
    code = ('from fourbar_ros.hardware.can_port import open_port; '
            'open_port("virtual", "x"); open_port("virtual", "y")')
    done = subprocess.run([sys.executable, '-c', code], timeout=60, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


def test_messages_of_python_can_reach_a_log_handler(request):
    records = []
    handler = logging.Handler()
    handler.emit = records.append
    with open_port('virtual', request.node.name) as port:
        logging.getLogger('can').addHandler(handler)
        try:
            logging.getLogger('can.bus').warning('something')
        finally:
            logging.getLogger('can').removeHandler(handler)
        assert port.fault is None
    assert len(records) == 1
