# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The prototype's protocol: decoding inverts encoding, and corrupted frames are rejected."""

from contextlib import suppress
from dataclasses import replace
from math import inf, nan, pi
import re

import cantools.database
from fourbar_ros.common.config_files import ConfigurationError, share_directory
from fourbar_ros.hardware.checksum import checksum
from fourbar_ros.hardware.dbc import DbcError
from fourbar_ros.hardware.dbc_codec import DbcCodec
from fourbar_ros.hardware.messages import (
    AngleReport,
    ClockReport,
    Command,
    Frame,
    FrameError,
    Heartbeat,
    Limits,
    LINK_FAULTS,
    LinkState,
    MotorReport,
    Release,
    Stop,
    Sync,
    ToHost,
    ToLinks,
    WheelReport,
)
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

repeatable = settings(deadline=None, derandomize=True)

CODEC = DbcCodec('prototype')
FILE = share_directory() / 'config' / 'prototype.dbc'
DATABASE = cantools.database.load_file(FILE)
TURN, WRAP_US = 256 * 2 * pi, 10 * 2 ** 20
# Half a count of angles [rad], and relative rounding of float32.
HALF_COUNT, SINGLE = pi / 65536, 2.0 ** -24

links, bytes_ = st.integers(0, 3), st.integers(0, 255)
nibbles = st.integers(0, 15)
torques = st.floats(-1000.0, 1000.0)
times = st.integers(0, WRAP_US - 1)

COMMAND = Command(1, 0.01, True, True, 7)
LIMITS = Limits(2, 0.05, 300.0)
WHEEL = WheelReport(3, 5, 1.25, TURN, 1000, WRAP_US)
MOTOR = MotorReport(0, 0.02, LinkState.ARMED, 77, True, 8)
ANGLE = AngleReport(0, 3, -1.0, 0.5, 50, WRAP_US)
CLOCK = ClockReport(1, 3, 4_000_000_000, 2)
HEARTBEAT = Heartbeat(2, 3, LinkState.FAULT, frozenset({'driver', 'no_limits'}), 12.0, 25.0, 1)
OF_HOST = [COMMAND, LIMITS, Sync(9), Stop(), Release()]
OF_LINKS = [WHEEL, MOTOR, ANGLE, CLOCK, HEARTBEAT]


def named(value):
    """Name a message by its kind: the order of a set of faults differs from run to run."""
    return type(value).__name__ if isinstance(value, ToHost | ToLinks) else str(value)


each_message = pytest.mark.parametrize('message', [*OF_HOST, *OF_LINKS], ids=named)


def written(message):
    """Return the one frame of a message."""
    write = CODEC.to_links if message in OF_HOST or isinstance(
        message, Command | Limits | Sync) else CODEC.to_host
    frame, = write(message)
    return frame


def read(frame):
    """Decode a frame at the end that it is for."""
    message = CODEC.from_links(frame)
    return CODEC.from_host(frame) if message is None else message


@repeatable
@given(links, torques, st.booleans(), st.booleans(), bytes_)
def test_command(link, value, by_speed, enable, sequence):
    command = Command(link, value, by_speed, enable, sequence)
    back = read(written(command))
    assert back.value == pytest.approx(value, rel=SINGLE, abs=1e-45)
    assert replace(back, value=value) == command


@repeatable
@given(links, st.floats(0.0, 1000.0), st.floats(0.0, 6553.5))
def test_limits_are_never_widened(link, torque, speed):
    back = read(written(Limits(link, torque, speed)))
    assert back.torque == pytest.approx(torque, rel=SINGLE, abs=1e-45)
    assert speed - 0.1 - 1e-9 <= back.speed <= speed * (1.0 + 1e-6)


@repeatable
@given(bytes_)
def test_sync(counter):
    assert read(written(Sync(counter))) == Sync(counter)


@pytest.mark.parametrize('message', [Stop(), Release()])
def test_stop_and_release(message):
    assert read(written(message)) == message


@repeatable
@given(links, bytes_, st.floats(-1e4, 1e4), times)
def test_wheel(link, counter, angle, time_us):
    back = read(written(WheelReport(link, counter, angle, TURN, time_us, WRAP_US)))
    assert (back.link, back.counter, back.speed) == (link, counter, None)
    assert (back.turn, back.wrap_us) == (pytest.approx(TURN, rel=1e-15), WRAP_US)
    assert 0.0 <= back.angle < back.turn
    assert (angle - back.angle + TURN / 2) % TURN == pytest.approx(
        TURN / 2, abs=HALF_COUNT + 1e-11)
    assert (time_us - back.time_us + WRAP_US // 2) % WRAP_US == pytest.approx(WRAP_US // 2, abs=5)


@repeatable
@given(links, torques, st.booleans(), bytes_, st.sampled_from(LinkState))
def test_motor(link, torque, answered, answers, state):
    report = MotorReport(link, torque, state, 200 + link, answered, answers)
    back = read(written(report))
    assert back.torque == pytest.approx(torque, rel=SINGLE, abs=1e-45)
    assert replace(back, torque=torque) == report


@repeatable
@given(links, nibbles, st.floats(-pi, pi), st.none() | st.floats(-32.767, 32.767), times)
def test_angle(link, sequence, angle, rate, time_us):
    back = read(written(AngleReport(link, sequence, angle, rate, time_us, WRAP_US)))
    assert (back.link, back.sequence, back.wrap_us) == (link, sequence, WRAP_US)
    assert -pi < back.angle <= pi
    assert (back.angle - angle + pi) % (2 * pi) == pytest.approx(pi, abs=HALF_COUNT + 1e-12)
    assert (back.rate is None) == (rate is None)
    assert rate is None or back.rate == pytest.approx(rate, abs=0.5e-3 + 1e-12)
    assert (time_us - back.time_us + WRAP_US // 2) % WRAP_US == pytest.approx(WRAP_US // 2, abs=5)


@repeatable
@given(links, bytes_, st.integers(0, 2 ** 32 - 1), bytes_)
def test_clock(link, counter, time_us, boot):
    report = ClockReport(link, counter, time_us, boot)
    assert read(written(report)) == report


@repeatable
@given(links, nibbles, st.sampled_from(LinkState), st.frozensets(st.sampled_from(LINK_FAULTS)),
       st.none() | st.floats(0.0, 40.94), st.none() | st.floats(-204.7, 204.7), bytes_)
def test_heartbeat(link, sequence, state, faults, voltage, temperature, boot):
    report = Heartbeat(link, sequence, state, faults, voltage, temperature, boot)
    back = read(written(report))
    for decoded, encoded, half_count in ((back.voltage, voltage, 0.005),
                                         (back.temperature, temperature, 0.05)):
        assert (decoded is None) == (encoded is None)
        assert encoded is None or decoded == pytest.approx(encoded, abs=half_count + 1e-9)
    assert replace(back, voltage=voltage, temperature=temperature) == report


def test_large_times_and_angles_are_wrapped():
    far = replace(WHEEL, angle=WHEEL.angle - 3 * TURN, time_us=WHEEL.time_us + 5 * WRAP_US)
    assert written(far) == written(WHEEL)


@each_message
def test_an_end_does_not_decode_its_own_messages(message):
    frame = written(message)
    assert (CODEC.from_host(frame) is None) == (message in OF_LINKS)
    assert (CODEC.from_links(frame) is None) == (message in OF_HOST)


@each_message
def test_every_flipped_bit_is_caught(message):
    frame = written(message)
    for bit in range(8 * len(frame.data)):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        with pytest.raises(FrameError) as caught:
            read(frame._replace(data=bytes(data)))
        assert caught.value.kind == 'checksum'


@each_message
def test_data_under_another_identifier_are_rejected(message):
    frame = written(message)
    for frame_id in CODEC.frame_ids - {frame.frame_id}:
        with pytest.raises(FrameError) as caught:
            read(frame._replace(frame_id=frame_id))
        assert caught.value.kind in ('checksum', 'length')


@each_message
def test_wrong_length(message):
    frame = written(message)
    for length in set(range(9)) - {len(frame.data)}:
        with pytest.raises(FrameError) as caught:
            read(frame._replace(data=frame.data.ljust(8, b'\0')[:length]))
        assert caught.value.kind == 'length'
        assert caught.value.values['value'] == length


def test_foreign_frames_are_ignored():
    for frame_id in set(range(0x800)) - CODEC.frame_ids:
        assert read(Frame(frame_id, bytes(8))) is None
    assert all(read(Frame(frame_id, b'', True)) is None for frame_id in CODEC.frame_ids)


@pytest.mark.parametrize('message', [
    *(replace(COMMAND, value=value) for value in (nan, inf, -inf, 1e39, 1001.0)),
    *(replace(COMMAND, sequence=sequence) for sequence in (-1, 256)),
    *(replace(LIMITS, torque=torque) for torque in (nan, inf, -0.01)),
    *(replace(LIMITS, speed=speed) for speed in (nan, inf, -1.0, 7000.0)),
    Sync(-1), Sync(256),
    *(replace(WHEEL, angle=angle) for angle in (nan, inf)),
    replace(WHEEL, counter=None), replace(WHEEL, time_us=None),
    *(replace(MOTOR, torque=torque) for torque in (nan, -inf, 2000.0)),
    replace(MOTOR, answers=256), replace(MOTOR, state=None),
    *(replace(ANGLE, angle=angle) for angle in (nan, inf, 3.2, -3.2)),
    # The lowest count stands for no gyro.
    *(replace(ANGLE, rate=rate) for rate in (nan, -inf, 33.0, -32.768)),
    replace(ANGLE, sequence=16),
    replace(CLOCK, counter=256), replace(CLOCK, boot=-1),
    *(replace(HEARTBEAT, voltage=voltage) for voltage in (nan, inf, -1.0, 40.95)),
    *(replace(HEARTBEAT, temperature=temperature) for temperature in (nan, 205.0, -204.8)),
    replace(HEARTBEAT, faults=frozenset({'tired'})), replace(HEARTBEAT, boot=None),
    replace(HEARTBEAT, sequence=None), replace(MOTOR, link=4), replace(COMMAND, link=-1),
], ids=named)
def test_invalid_value_is_not_encoded(message):
    with pytest.raises(FrameError) as caught:
        written(message)
    assert caught.value.kind == 'value' and 'limit' in caught.value.values
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('message, signal, count', [
    *((COMMAND, 'VALUE', value) for value in (nan, inf, -inf, 2000.0)),
    *((MOTOR, 'TORQUE', value) for value in (nan, inf)),
    *((LIMITS, 'TORQUE', value) for value in (nan, -1.0)),
    (MOTOR, 'STATE', 5), (HEARTBEAT, 'STATE', 15), (HEARTBEAT, 'FAULTS', 0x800),
    (Stop(), 'CODE', 0x3C), (Release(), 'CODE', 0),
], ids=named)
def test_invalid_count_is_not_decoded(message, signal, count):
    """The value is invalid and the checksum is correct."""
    frame = written(message)
    layout = DATABASE.get_message_by_frame_id(frame.frame_id)
    counts = layout.decode_simple(frame.data, decode_choices=False, scaling=False)
    data = layout.encode({**counts, signal: count}, scaling=False, strict=False)[:-1]
    with pytest.raises(FrameError) as caught:
        read(Frame(frame.frame_id, data + bytes((checksum(frame.frame_id, data),))))
    assert caught.value.kind == 'value'
    assert caught.value.values['name'] == f'{layout.name}.{signal}'


def test_half_a_turn_is_decoded_as_plus_pi():
    for angle in (pi, -pi):
        assert read(written(replace(ANGLE, angle=angle))).angle == pi


def test_no_two_messages_share_an_identifier():
    assert len(CODEC.frame_ids) == 3 + 4 * 7
    assert max(CODEC.frame_ids) < 0x800


# Changed copies of the file

@pytest.fixture
def changed(tmp_path):
    """Return a function that makes a codec of the file with something replaced."""
    def make(*changes):
        text = FILE.read_text()
        for pattern, replacement in changes:
            text, count = re.subn(pattern, replacement, text, flags=re.MULTILINE)
            assert count
        path = tmp_path / 'lab.dbc'
        path.write_text(text)
        return DbcCodec(str(path))
    return make


def test_identifiers_positions_and_scales_are_those_of_the_file(changed):
    codec = changed(
        (r'\b304\b', '400'),
        (r'^ SG_ ANGLE : 0\|16@1- .*$',
         ' SG_ ANGLE : 23|16@0- (0.0001,0) [-3.2|3.2] "rad" HOST'),
        (r'^ SG_ RATE : 16\|16@1- .*$', ' SG_ RATE : 0|16@1- (0.002,0) [0|0] "rad/s" HOST'))
    frame, = codec.to_host(ANGLE)
    assert frame.frame_id == 400
    assert frame.data[:4] == (250).to_bytes(2, 'little') + (-10000).to_bytes(2, 'big', signed=True)
    assert codec.from_links(frame) == ANGLE
    assert codec.from_links(written(ANGLE)) is None


def test_further_signals_are_ignored(changed):
    codec = changed(
        (r'^( SG_ ANSWERED : .*)$', r'\1\n SG_ CURRENT : 45|3@1+ (1,0) [0|0] "A" HOST'))
    assert codec.from_links(*codec.to_host(MOTOR)).state is MOTOR.state


@pytest.mark.parametrize('pattern, replacement, values', [
    (r'LINK_C_WHEEL', 'LINK_C_ROUND', {'message': 'LINK_C_WHEEL'}),
    (r'\bRATE\b', 'SPIN', {'message': 'LINK_A_ANGLE', 'signal': 'RATE'}),
    (r'^ SG_ CHECKSUM : 56.*$', ' SG_ SUM : 56|8@1+ (1,0) [0|0] "" HOST',
     {'message': 'LINK_A_COMMAND', 'signal': 'CHECKSUM'}),
    (r'CHECKSUM : 8\|8', 'CHECKSUM : 8|7',
     {'message': 'SYNC', 'signal': 'CHECKSUM', 'value': 7, 'limit': 8}),
    (r'(LINK_A_COMMAND: [\s\S]*?CHECKSUM : )56', r'\g<1>48',
     {'message': 'LINK_A_COMMAND', 'signal': 'CHECKSUM'}),
    (r'SEQUENCE : 52\|4', 'SEQUENCE : 52|3',
     {'message': 'LINK_A_ANGLE', 'signal': 'SEQUENCE', 'value': 3, 'limit': 4}),
    (r'SEQUENCE : 40\|8@1\+', 'SEQUENCE : 40|8@1-',
     {'message': 'LINK_A_COMMAND', 'signal': 'SEQUENCE'}),
    (r'ANGLE : 0\|16@1- \(9.5', 'ANGLE : 0|15@1- (9.5',
     {'message': 'LINK_A_ANGLE', 'signal': 'ANGLE', 'limit': (-pi, pi),
      'value': pytest.approx((-pi / 2, pi / 2), abs=1e-4)}),
    (r'TIME : 24\|20@1\+ ', 'TIME : 24|17@1+ ',
     {'message': 'LINK_A_WHEEL', 'signal': 'TIME', 'value': 10 * 2 ** 17, 'limit': (2e6, inf)}),
    (r'TIME : 0\|32@1\+ \(1,', 'TIME : 0|32@1+ (2,',
     {'message': 'LINK_A_CLOCK', 'signal': 'TIME', 'value': 2 ** 33, 'limit': (2 ** 32, 2 ** 32)}),
    (r'SPEED : 32\|16@1\+ \(0.1,', 'SPEED : 32|16@1+ (-0.1,',
     {'message': 'LINK_A_LIMITS', 'signal': 'SPEED', 'value': -0.1, 'limit': 0.0}),
    (r'\b257\b', '258', {'message': 'LINK_B_COMMAND', 'value': 0x102}),
    (r'^BO_ 272 ', 'BO_ 2147483920 ', {'message': 'LINK_A_WHEEL', 'value': 272, 'limit': 0x7FF}),
    # Overlapping signals, a signal beyond the end of the message, and an incomplete line.
    (r'^ SG_ MODE : 32\|1', ' SG_ MODE : 31|1', {}),
    (r'^ SG_ CHECKSUM : 56\|8', ' SG_ CHECKSUM : 56|9', {}), (r'^BU_:', 'BU_ ', {}),
])
def test_incomplete_file_is_refused_in_one_line(
        changed, pattern, replacement, values, refuses, tmp_path):
    path = str(tmp_path / 'lab.dbc')
    with refuses(DbcError, place=path, **values) as caught:
        changed((pattern, replacement))
    assert path in str(caught.value)


@pytest.mark.parametrize('content', [
    b'', b'nonsense', b'\xff\xfe\x00', b'BO_ 1 A: 8 X\n SG_ S : 0|8@1+ (1,0', b'BO_ x y',
    b'VERSION ""\n', b'mechanism: {}\n'])
def test_invalid_dbc_file_is_refused_in_one_line(tmp_path, content, refuses):
    path = tmp_path / 'bad.dbc'
    path.write_bytes(content)
    with refuses(DbcError, place=str(path)):
        DbcCodec(str(path))


@pytest.mark.medium
def test_file_cut_anywhere_is_refused_or_read(tmp_path):
    """The only possible error is that of the package."""
    text = FILE.read_text()
    path = tmp_path / 'cut.dbc'
    for length in range(0, len(text), len(text) // 60):
        path.write_text(text[:length])
        with suppress(DbcError):
            DbcCodec(str(path))


@pytest.mark.parametrize('name, presets', [
    ('nothing', ['odrive', 'prototype']), ('./nothing.dbc', None)])
def test_missing_file_is_refused(name, presets, refuses):
    with refuses(ConfigurationError, name=name, limit=presets):
        DbcCodec(name)


def test_messages_that_are_not_selected_are_ignored():
    codec = DbcCodec('prototype', ('SYNC', 'CLOCK'))
    assert codec.from_links(written(CLOCK)) == CLOCK
    assert codec.to_links(Stop()) == () and codec.to_host(ANGLE) == ()
    assert codec.from_links(written(ANGLE)) is None and codec.from_host(written(Stop())) is None
