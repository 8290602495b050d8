# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""CAN frames in datagrams between peers, stamped on arrival."""

import socket
import struct
from time import monotonic, time

import can
from fourbar_ros.hardware.udp_bus import UdpBus
import numpy as np
import pytest

# Time limit of a wait on a busy machine [s].
PATIENCE_S = 5.0


def address(bus):
    """Return the address of a bus."""
    return '{}:{}'.format(*bus.address)


@pytest.fixture
def make():
    """Return a function that opens a bus at a free port by its name in python-can."""
    buses = []

    def make(peers=()):
        bus = can.Bus(interface='fourbar_udp', channel='127.0.0.1:0', peers=peers,
                      ignore_config=True)
        buses.append(bus)
        return bus
    yield make
    for bus in buses:
        bus.shutdown()


@pytest.fixture
def pair(make):
    """Open two buses that are peers."""
    first = make()
    second = make(address(first))
    first.add_peer(address(second))
    return first, second


@pytest.fixture
def plain():
    """Open a socket for datagrams of any kind."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plain:
        plain.bind(('127.0.0.1', 0))
        plain.settimeout(PATIENCE_S)
        yield plain


def test_python_can_finds_it(make):
    assert isinstance(make(), UdpBus)


@pytest.mark.parametrize('seed', range(3))
def test_frames_arrive_as_they_were_sent(pair, seed):
    first, second = pair
    rng = np.random.default_rng(seed)
    for sender, receiver in (pair, pair[::-1]) * 20:
        extended, remote = bool(rng.integers(2)), bool(rng.integers(2))
        sent = can.Message(
            arbitration_id=int(rng.integers(1 << (29 if extended else 11))),
            is_extended_id=extended, is_remote_frame=remote,
            dlc=8 if remote else None, data=None if remote else rng.bytes(rng.integers(9)))
        sender.send(sent)
        received = receiver.recv(PATIENCE_S)
        assert received.equals(sent, timestamp_delta=None, check_direction=False), f'seed {seed}'


def test_error_frames_are_carried(pair):
    pair[0].send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
    received = pair[1].recv(PATIENCE_S)
    assert received.is_error_frame and received.arbitration_id == 0x40


def test_datagram_is_laid_out_as_documented(make, plain):
    bus = make('127.0.0.1:{}'.format(plain.getsockname()[1]))
    bus.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b'\x01\x02'))
    assert plain.recv(100) == b'FB\x01\x00\x00\x00\x01\x23\x02\x01\x02'
    bus.send(can.Message(arbitration_id=0x7, is_extended_id=True, is_remote_frame=True, dlc=8))
    assert plain.recv(100) == b'FB\x01\x03\x00\x00\x00\x07\x08'


def test_stamps_are_of_arrival_and_never_go_back(pair):
    first, second = pair
    before = time()
    for number in range(200):
        first.send(can.Message(arbitration_id=number, is_extended_id=False))
    sent = time()
    # The test reads the frames after all of them have arrived.
    received = [second.recv(PATIENCE_S) for _ in range(200)]
    assert [message.arbitration_id for message in received] == list(range(200))
    stamps = [message.timestamp for message in received]
    assert stamps == sorted(stamps)
    # A float of system time has a resolution below a microsecond.
    assert before - 1e-6 <= stamps[0] and stamps[-1] <= sent + 1e-6


def test_every_peer_receives_every_frame(make):
    sender = make()
    receivers = [make(address(sender)) for _ in range(3)]
    for receiver in receivers:
        sender.add_peer(address(receiver))
    sender.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    assert [receiver.recv(PATIENCE_S).arbitration_id for receiver in receivers] == [0x80] * 3


def test_peers_are_named_in_one_string(make):
    receivers = [make(), make()]
    sender = make(', '.join(map(address, receivers)))
    for receiver in receivers:
        receiver.add_peer(address(sender))
    sender.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    assert all(receiver.recv(PATIENCE_S) for receiver in receivers)


def test_foreign_datagrams_are_ignored_and_counted(pair, plain):
    first, second = pair
    for _ in range(3):
        plain.sendto(b'FB\x01\x00\x00\x00\x01\x23\x00', second.address)
    first.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    assert second.recv(PATIENCE_S).arbitration_id == 0x80
    assert (second.foreign, second.malformed) == (3, 0)


MALFORMED = [
    b'', b'FB', bytes(9), bytes(17), bytes(1000),
    struct.pack('>2sBBIB', b'XX', 1, 0, 1, 0), struct.pack('>2sBBIB', b'FB', 2, 0, 1, 0),
    struct.pack('>2sBBIB', b'FB', 1, 8, 1, 0), struct.pack('>2sBBIB', b'FB', 1, 0, 0x800, 0),
    struct.pack('>2sBBIB', b'FB', 1, 1, 1 << 29, 0), struct.pack('>2sBBIB', b'FB', 1, 0, 1, 9),
    struct.pack('>2sBBIB', b'FB', 1, 0, 1, 9) + bytes(9),
    struct.pack('>2sBBIB', b'FB', 1, 0, 1, 4) + bytes(3),
    struct.pack('>2sBBIB', b'FB', 1, 0, 1, 4) + bytes(5),
    struct.pack('>2sBBIB', b'FB', 1, 2, 1, 4) + bytes(4),
]


@pytest.mark.parametrize('datagram', MALFORMED, ids=bytes.hex)
def test_malformed_datagrams_are_ignored_and_counted(make, plain, datagram):
    bus = make('127.0.0.1:{}'.format(plain.getsockname()[1]))
    plain.sendto(datagram, bus.address)
    plain.sendto(b'FB\x01\x00\x00\x00\x01\x23\x00', bus.address)
    assert bus.recv(PATIENCE_S).arbitration_id == 0x123
    assert (bus.foreign, bus.malformed) == (0, 1)


def test_receive_returns_at_once_without_a_timeout_and_at_the_timeout(pair):
    first, _ = pair
    began = monotonic()
    assert first.recv(0) is None
    assert first.recv(0.05) is None
    assert 0.05 <= monotonic() - began < PATIENCE_S


def test_absent_peer_is_no_error(make, plain):
    unused = plain.getsockname()[1]
    plain.close()
    bus = make(f'127.0.0.1:{unused}')
    for _ in range(5):
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        assert bus.recv(0) is None


def test_file_descriptor_is_readable_when_a_frame_has_arrived(pair):
    first, second = pair
    notified = can.Notifier(second, [reader := can.BufferedReader()], timeout=0.01)
    try:
        assert second.fileno() >= 0
        first.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        assert reader.get_message(PATIENCE_S).arbitration_id == 0x80
    finally:
        notified.stop()


def test_filters_are_those_of_python_can(pair):
    first, second = pair
    second.set_filters([{'can_id': 0x100, 'can_mask': 0x700}])
    for frame_id in (0x080, 0x103):
        first.send(can.Message(arbitration_id=frame_id, is_extended_id=False))
    assert second.recv(PATIENCE_S).arbitration_id == 0x103


def test_only_classic_frames(pair):
    with pytest.raises(can.CanOperationError):
        pair[0].send(can.Message(arbitration_id=1, is_fd=True, data=bytes(12)))


def test_closed_bus_cannot_be_used(make):
    bus = make()
    bus.shutdown()
    bus.shutdown()
    bus.add_peer('127.0.0.1:9')
    with pytest.raises(can.CanOperationError):
        bus.send(can.Message(arbitration_id=1))
    with pytest.raises(can.CanOperationError):
        bus.recv(0)


def test_port_in_use(make):
    bus = make()
    with pytest.raises(can.CanInitializationError) as caught:
        UdpBus(address(bus), ())
    assert address(bus) in str(caught.value)


@pytest.mark.parametrize('channel, options, refused', [
    ('127.0.0.1', {'peers': ()}, "'127.0.0.1'"), (':1', {'peers': ()}, "':1'"),
    ('127.0.0.1:65536', {'peers': ()}, "'127.0.0.1:65536'"),
    ('127.0.0.1:x', {'peers': ()}, "'127.0.0.1:x'"),
    # The host name is too long, so that no name server is queried.
    (f'{"x" * 64}:0', {'peers': ()}, f"'{'x' * 64}:0'"),
    ('192.0.2.1:0', {'peers': ()}, '192.0.2.1:0'),
    ('127.0.0.1:0', {}, 'peers'), ('127.0.0.1:0', {'peers': ''}, 'peers'),
    ('127.0.0.1:0', {'peers': '127.0.0.1:0'}, "'127.0.0.1:0'"),
    ('127.0.0.1:0', {'peers': '127.0.0.1:5,'}, "''"),
    ('127.0.0.1:0', {'peers': (), 'perrs': 1}, 'perrs'),
])
def test_bad_address_or_option_is_reported_in_one_line(channel, options, refused):
    with pytest.raises(can.CanInitializationError) as caught:
        UdpBus(channel, **options)
    assert refused in str(caught.value) and '\n' not in str(caught.value)
