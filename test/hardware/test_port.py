# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""One port for every bus: frames through, arrival times of one clock, and one kind of error."""

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
    """A bus that gives what it was given, and fails as it was told."""

    def __init__(self, *messages, error=None):
        self.messages = list(messages)
        self.error = error
        super().__init__('stub')

    def send(self, msg, timeout=None):
        if self.error is not None:
            raise self.error

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
    """Open two ports at one virtual channel."""
    return [open_port('virtual', request.node.name) for _ in range(2)]


def udp(request):
    """Open two ports that are peers."""
    first = UdpBus('127.0.0.1:0', ())
    second = UdpBus('127.0.0.1:0', '{}:{}'.format(*first.address))
    first.add_peer('{}:{}'.format(*second.address))
    return [Port(bus, 'fourbar_udp', '127.0.0.1:0') for bus in (first, second)]


def serial(request):
    """Open two ports at the ends of one line."""
    near, far = Line(), Line()
    request.addfinalizer(near.close)
    request.addfinalizer(far.close)
    Thread(target=connect, args=(near, far), daemon=True).start()
    return [open_port('serial', line.name) for line in (near, far)]


class Line:
    """A serial line with a port at one end, and with this program at the other."""

    def __init__(self):
        self.far, self._near = openpty()
        for end in (self.far, self._near):
            setraw(end)
        self.name = os.ttyname(self._near)

    def close(self):
        """Pull it out."""
        for end in (self.far, self._near):
            with suppress(OSError):
                os.close(end)


def connect(*lines):
    """Hand on what is said on one of two lines to the other, until one is closed."""
    ends = [line.far for line in lines]
    with suppress(OSError, ValueError):
        while True:
            for end in select(ends, (), ())[0]:
                os.write(ends[1 - ends.index(end)], os.read(end, 4096))


@pytest.fixture(params=[virtual, udp, serial], ids=lambda kind: kind.__name__)
def pair(request):
    """Open two ports that hear one another."""
    ports = request.param(request)
    yield ports
    for port in ports:
        port.close()


def now_ns():
    """Read the clock of arrivals."""
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
        # A float of system time is good to 0.3 us; both clocks are read one after the other.
        assert before_ns - 1_000_000 <= arrival_ns <= now_ns()


def test_remote_frame_asks_for_eight_bytes(stub):
    port = stub()
    sent = []
    port._bus.send = sent.append
    port.send(Frame(0x009, b'', True))
    assert (sent[0].dlc, sent[0].is_remote_frame) == (8, True)


@pytest.mark.parametrize('interface, age_s, back_s', [
    ('pcan', 0.2, 0.2), ('pcan', 0.0, 0.0), ('pcan', -0.5, 0.0),
    # Clocks of adapters, which begin when they like.
    ('pcan', 1.5, 0.0), ('pcan', -3600.0, 0.0), ('pcan', 1e9, 0.0),
    # Whose stamps are system time is believed: it waited while nobody read.
    ('socketcan', 1.5, 1.5), ('fourbar_udp', 30.0, 30.0), ('socketcan', -0.5, 0.0),
])
def test_arrival_of_what_waited(stub, interface, age_s, back_s):
    port = stub(can.Message(timestamp=time() - age_s, is_extended_id=False), interface=interface)
    before_ns = now_ns()
    _, arrival_ns = port.receive(0.0)
    assert before_ns <= arrival_ns + back_s * 1e9 + 1e6
    assert arrival_ns + back_s * 1e9 <= now_ns() + 1e6
    assert arrival_ns <= now_ns()


def test_what_is_no_classic_frame_is_counted_and_dropped(stub):
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


def test_trouble_of_the_bus_is_told(stub):
    port = stub(error_frame(0x008), error_frame(0x004, 0x10), error_frame(0x004, 0x40),
                error_frame(0x040))
    assert port.fault is None
    for expected in ('1 error frames', 'error passive', '3 error frames'):
        # One at a time.
        messages, port._bus.messages = port._bus.messages[1:], port._bus.messages[:1]
        assert port.receive(0.0) is None
        port._bus.messages = messages
        assert port.fault.startswith(expected) and 'bit rate' in port.fault
    with pytest.raises(BusError, match='^stub here: bus off: check wiring'):
        port.receive(0.0)
    assert port.diagnostic_values()['bus_trouble'] == port.fault


@pytest.mark.parametrize('state, told', [
    (can.BusState.ACTIVE, None), (can.BusState.PASSIVE, 'error passive'),
    (can.BusState.ERROR, 'bus off')])
def test_state_of_the_bus_is_told_where_python_can_does(stub, monkeypatch, state, told):
    monkeypatch.setattr(StubBus, 'state', state)
    fault = stub().fault
    assert fault is None if told is None else fault.startswith(told)


@pytest.mark.parametrize('error, told', [
    (can.CanOperationError('Failed to transmit: No buffer space available', errno.ENOBUFS),
     'the send buffer is full'),
    (can.CanOperationError('Transmit buffer full'), 'the send buffer is full'),
    (OSError(errno.ENOBUFS, 'No buffer space available'), 'the send buffer is full'),
    (can.CanOperationError('Failed to transmit: Network is down', errno.ENETDOWN), 'is down'),
    (OSError(errno.ENODEV, 'No such device'), 'no such interface'),
    (can.CanOperationError('the adapter\nis gone'), 'the adapter is gone'),
    (can.CanOperationError(), 'CanOperationError'),
    (ValueError('closed'), 'closed'),
])
def test_errors_on_the_way_are_told_in_one_line(stub, error, told):
    port = stub(error=error)
    with pytest.raises(BusError, match=f'^stub here: cannot send: .*{told}') as caught:
        port.send(FRAME)
    assert '\n' not in str(caught.value)
    with pytest.raises(BusError, match=f'^stub here: cannot receive: .*{told}'):
        port.receive(0.0)
    assert (port.sent, port.received) == (0, 0)


def test_closed_port_tells_so(pair):
    first, _ = pair
    first.close()
    first.close()
    for use in (lambda: first.send(FRAME), lambda: first.receive(0.0)):
        with pytest.raises(BusError, match='closed'):
            use()


def test_with_closes(request):
    with open_port('virtual', request.node.name) as port:
        port.send(FRAME)
    with pytest.raises(BusError, match='closed'):
        port.send(FRAME)


@pytest.mark.parametrize('interface, channel, options, told', [
    ('sockedcan', 'can0', '', 'no such interface .usual ones: socketcan, fourbar_udp'),
    # Where the kernel has CAN at all, it has no such interface.
    ('socketcan', 'can_none', '', 'no such interface|no CAN sockets'),
    ('virtual', 'x', 'novalue', "option 'novalue' must be key=value"),
    ('virtual', 'x', '=1', 'must be key=value'), ('virtual', 'x', 'a=', 'must be key=value'),
    ('virtual', 'x', 'a-b=1', 'must be key=value'),
    ('virtual', 'x', 'bitrate=1', 'bitrate is no option'),
    ('virtual', 'x', 'channel=y', 'channel is no option'),
    ('virtual', 'x', 'rx_queue_size=1 rx_queue_size=2', 'given twice'),
    ('virtual', 'x', 'rx_queue=1', 'no option rx_queue .known are .*rx_queue_size'),
    ('fourbar_udp', '127.0.0.1:0', '', 'needs peers'),
    ('fourbar_udp', '127.0.0.1:0', 'peers=127.0.0.1', 'HOST:PORT'),
    ('fourbar_udp', '127.0.0.1:0', 'peers=127.0.0.1:9 speed=1', 'knows no speed'),
    ('fourbar_udp', 'can0', 'peers=127.0.0.1:9', 'HOST:PORT'),
    ('serial', '/dev/ttyNONE', '', 'No such file or directory'),
    ('serial', '/dev/ttyNONE', 'baud=9600', 'no option baud .known are baudrate, rtscts.'),
])
def test_bus_that_cannot_be_opened_is_told_in_one_line(
        interface, channel, options, told, caplog, capfd):
    with pytest.raises(BusError, match=f'^{interface} {channel}: .*({told})') as caught:
        open_port(interface, channel, 500_000, options)
    assert '\n' not in str(caught.value)
    assert (caplog.text, *capfd.readouterr()) == ('', '', '')


def test_options_are_of_the_kind_they_look_like(request):
    with open_port('virtual', request.node.name,
                   options='receive_own_messages=true rx_queue_size=0x10') as port:
        port.send(FRAME)
        assert port.receive(PATIENCE_S)[0] == FRAME
        assert port._bus.queue.maxsize == 16


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


def test_line_that_says_half_a_frame_holds_nobody_up_and_is_heard_out(line):
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
    b'\xaa' + bytes(4) + b'\x09' + bytes(8),              # a length that is none
    b'\xaa' + bytes(4) + b'\x01\x00\x08\x00\x00\x00\xbb',   # an identifier that is none
    b'\xaa' + bytes(4) + b'\x01\x00\x01\x00\x00\x00\xbc'])  # an end that is none
def test_noise_on_a_line_costs_no_frame_after_it(line, noise):
    said = b'\xaa' + bytes(4) + b'\x02' + b'\x23\x01\x00\x00' + b'ab\xbb'
    with open_port('serial', line.name) as port:
        os.write(line.far, said + noise + 20 * said)
        assert [port.receive(PATIENCE_S)[0] for _ in range(21)] == [Frame(0x123, b'ab')] * 21
        assert port.receive(0.0) is None
        assert port.diagnostic_values()['bytes_garbled'] == 1


def test_line_that_is_pulled_out_is_told(line):
    with open_port('serial', line.name) as port:
        line.close()
        with pytest.raises(BusError, match=f'^serial {line.name}: cannot receive: '):
            port.receive(PATIENCE_S)


def test_line_belongs_to_one(line):
    with open_port('serial', line.name), pytest.raises(BusError, match=f'serial {line.name}: '):
        open_port('serial', line.name)


@pytest.mark.parametrize('interface, options', [('serial', ''), ('slcan', '')])
def test_without_pyserial_it_is_told_what_to_install(monkeypatch, interface, options):
    monkeypatch.setitem(sys.modules, 'serial', None)
    monkeypatch.setattr('can.interfaces.slcan.serial', None)
    with pytest.raises(BusError, match=r'not installed: .*pip install fourbar_ros\[hardware\]'):
        open_port(interface, '/dev/ttyNONE', 0, options)


def test_without_python_can_it_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, 'can', None)
    with pytest.raises(BusError, match=r'^socketcan can0: .*pip install fourbar_ros\[hardware\]'):
        open_port('socketcan', 'can0')


def test_python_can_is_not_imported_before_it_is_needed():
    code = ('import sys; from fourbar_ros.hardware import can_port, dbc_codec; '
            'sys.exit(bool({"can", "cantools"} & set(sys.modules)))')
    assert subprocess.run([sys.executable, '-c', code], timeout=60).returncode == 0


def test_who_forgets_to_close_is_not_scolded_on_stderr():
    code = ('from fourbar_ros.hardware.can_port import open_port; '
            'open_port("virtual", "x"); open_port("virtual", "y")')
    done = subprocess.run([sys.executable, '-c', code], timeout=60, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


def test_python_can_still_tells_who_wants_to_know(request):
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
