# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""ODrives and sensor boards: both ends decode each other, within CANSimple."""

from dataclasses import replace
from math import inf, nan, pi
import struct

from fourbar_ros.common.config_files import share_directory
from fourbar_ros.hardware.dbc import DbcError
from fourbar_ros.hardware.dbc_codec import DbcCodec
from fourbar_ros.hardware.messages import (
    AngleReport,
    BusError,
    ClockReport,
    Command,
    Frame,
    FrameError,
    Heartbeat,
    Limits,
    LinkState,
    MotorReport,
    Release,
    Stop,
    Sync,
    WheelReport,
)
from fourbar_ros.hardware.odrive_codec import OdriveCodec
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

repeatable = settings(deadline=None, derandomize=True)

CONSTANTS = (0.03, 0.04, 0.05, 0.06)
SINGLE = 2.0 ** -23
TURN = 256 * 2 * pi

links = st.integers(0, 3)


def make(**options):
    """Make one end of a bus."""
    return OdriveCodec(torque_constants=CONSTANTS, **options)


# Ends for messages without state.
HOST, LINK = make(), make()


def received(host, link, message):
    """Return what the link decodes of a message of the host, frame by frame."""
    return [link.from_host(frame) for frame in host.to_links(message)]


def identifier(node, command):
    """Return the identifier of CANSimple."""
    return node << 5 | command


def heartbeat(link, error, state):
    """Write a heartbeat as an ODrive does."""
    return Frame(identifier(link, 0x01), struct.pack('<IBBBx', error, state, 0, 0))


@repeatable
@given(links, st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_wheel(link, angle, speed):
    frame, = LINK.to_host(WheelReport(link, 3, angle, TURN, 5, 1 << 20, speed))
    back = HOST.from_links(frame)
    assert (back.link, back.counter, back.time_us) == (link, None, None)
    assert 0.0 <= back.angle <= back.turn == TURN
    assert (back.angle - angle + TURN / 2) % TURN == pytest.approx(
        TURN / 2, abs=1e4 * SINGLE + 1e-9)
    assert back.speed == pytest.approx(speed, rel=SINGLE, abs=1e-40)


@repeatable
@given(links, st.floats(-1e3, 1e3))
def test_motor(link, torque):
    frame, = LINK.to_host(MotorReport(link, torque, LinkState.ARMED, 7))
    back = HOST.from_links(frame)
    assert back == MotorReport(link, pytest.approx(torque, rel=SINGLE, abs=1e-40))


@repeatable
@given(links, st.floats(0.0, 10.0), st.floats(0.0, 1e4))
def test_limits(link, torque, speed):
    limits, = received(HOST, LINK, Limits(link, torque, speed))
    assert limits == Limits(link, pytest.approx(torque, rel=2 * SINGLE, abs=1e-40),
                            pytest.approx(speed, rel=2 * SINGLE, abs=1e-40))


@repeatable
@given(links, st.floats(-10.0, 10.0), st.booleans(), st.booleans())
def test_command_after_any_other(link, value, by_speed, enable):
    """The last frame has the effect of the command, after any other command."""
    command = received(HOST, LINK, Command(link, value, by_speed, enable, 0))[-1]
    assert (command.link, command.enable) == (link, enable)
    if enable:
        assert command.by_speed == by_speed
        assert command.value == pytest.approx(value, rel=2 * SINGLE, abs=1e-40)


def test_link_numbers_received_commands():
    host, link = make(), make()
    commands = [command for _ in range(200)
                for command in received(host, link, Command(1, 0.01, False, True, 9))]
    assert all((after.sequence - before.sequence) % 256 == 1
               for before, after in zip(commands, commands[1:]))


def sent(host, message):
    """Return node and command number of every frame."""
    return [(frame.frame_id >> 5, frame.frame_id & 31) for frame in host.to_links(message)]


def test_mode_and_state_are_sent_when_they_change():
    host = make()
    torque, speed = (Command(2, 0.5, by_speed, True, 0) for by_speed in (False, True))
    mode, state = (2, 0x0B), (2, 0x07)
    by_torque, by_speed = (2, 0x0E), (2, 0x0D)
    assert sent(host, torque) == [by_torque, mode, state, by_torque]
    assert sent(host, torque) == [by_torque]
    assert sent(host, speed) == [by_speed, mode, by_speed]
    assert sent(host, speed) == [by_speed]
    # The other link has received nothing yet.
    assert len(sent(host, replace(torque, link=3))) == 4


def test_power_off_is_repeated_and_power_on_is_not():
    host = make()
    enabled, disabled = (Command(0, 0.0, False, enable, 0) for enable in (True, False))
    assert [sent(host, disabled) for _ in range(3)] == [[(0, 0x07)]] * 3
    assert sent(host, enabled).count((0, 0x07)) == 1
    # Repeated commands do not arm an ODrive that has disarmed by itself.
    assert sent(host, enabled).count((0, 0x07)) == 0


@pytest.mark.parametrize('message', [Stop(), Release()])
def test_after_a_stop_everything_is_sent_again(message):
    host, link = make(), make()
    command = Command(1, 0.01, False, True, 0)
    host.to_links(command)
    assert received(host, link, message) == [message] * 4
    assert len(host.to_links(command)) == 4


def test_link_with_power_never_follows_an_old_value():
    """With power on, the link follows the last command or the present one in every mode."""
    host, link = make(), make()
    last = None
    for value, by_speed, enable in (
            (90.0, True, True), (0.5, True, False), (1.0, True, True), (0.25, False, True),
            (2.0, True, True), (0.0, False, False), (0.125, False, True)):
        present = (by_speed, pytest.approx(value, rel=1e-6))
        for commands in received(host, link, Command(0, value, by_speed, enable, 0)):
            assert not commands.enable or (commands.by_speed, commands.value) in (last, present)
        last = present if enable else None


def test_frames_are_those_of_the_manual():
    host = make()
    turns, newton_metres = struct.pack('<ff', 2.0, 0.0), struct.pack('<f', 0.25)
    speed = host.to_links(Command(1, 2.0 * 2 * pi, True, True, 0))
    assert speed == [
        Frame(0x02D, turns), Frame(0x02B, struct.pack('<II', 2, 1)),
        Frame(0x027, struct.pack('<II', 8, 0)), Frame(0x02D, turns)]
    assert host.to_links(Command(1, 0.25, False, True, 0))[:2] == [
        Frame(0x02E, newton_metres + bytes(4)), Frame(0x02B, struct.pack('<II', 1, 1))]
    assert host.to_links(Command(1, 0.0, False, False, 0)) == [
        Frame(0x027, struct.pack('<II', 1, 0))]
    assert host.to_links(Limits(2, 0.1, 4 * pi)) == [
        Frame(0x04F, struct.pack('<ff', 2.0, 0.1 / CONSTANTS[2]))]
    assert host.to_links(Stop()) == [Frame(identifier(node, 0x02)) for node in range(4)]
    assert host.to_links(Release()) == [Frame(identifier(node, 0x18), b'\0') for node in range(4)]


@pytest.mark.medium
def test_sync_requests_every_answer():
    """`SYNC` requests the sensor boards, remote frames the ODrives' wheel and motor messages."""
    host, link = make(), make()
    assert max(len(host.to_links(Sync(counter))) for counter in range(16)) == 9
    for node in range(4):
        host.from_links(heartbeat(node, 0, 1))
    seldom = []
    for counter in range(16):
        sync, *asked = host.to_links(Sync(counter))
        assert DbcCodec('prototype').from_host(sync) == link.from_host(sync) == Sync(counter)
        assert all(frame.remote and not frame.data for frame in asked)
        assert [link.from_host(frame) for frame in asked] == [None] * len(asked)
        ids = [frame.frame_id for frame in asked]
        assert ids[:8] == [identifier(node, command) for node in range(4)
                           for command in (0x09, 0x1C)]
        seldom += ids[8:]
    assert sorted(seldom) == sorted(identifier(node, command) for node in range(4)
                                    for command in (0x15, 0x17))


@pytest.mark.parametrize('error, axis_state, state, faults', [
    (0, 1, LinkState.IDLE, set()), (0, 8, LinkState.ARMED, set()), (0, 4, LinkState.IDLE, set()),
    (1 << 24, 1, LinkState.COASTING, set()), (1 << 25, 1, LinkState.STOPPED, set()),
    (1 << 25 | 1 << 5, 1, LinkState.STOPPED, {'driver'}),
    (1 << 24 | 1 << 9, 1, LinkState.FAULT, {'undervoltage'}),
    (1 << 3, 1, LinkState.FAULT, {'encoder'}), (1 << 26, 1, LinkState.FAULT, {'encoder'}),
    (1 << 13, 1, LinkState.FAULT, {'overtemperature'}),
    (1 << 14, 1, LinkState.FAULT, {'overtemperature'}),
    (1 << 15, 8, LinkState.FAULT, {'overspeed'}), (1 << 5, 1, LinkState.FAULT, {'driver'}),
    # Undefined bits are a driver fault.
    (1 << 31, 8, LinkState.FAULT, {'driver'}),
    (1 << 3 | 1 << 8 | 1 << 9, 1, LinkState.FAULT, {'encoder', 'driver', 'undervoltage'}),
])
def test_state_and_faults_of_an_odrive(error, axis_state, state, faults):
    report = OdriveCodec().from_links(heartbeat(2, error, axis_state))
    assert (report.link, report.state, report.faults) == (2, state, faults)
    assert (report.sequence, report.boot) == (None, None)


@pytest.mark.slow
@repeatable
@given(links, st.sampled_from(LinkState),
       st.frozensets(st.sampled_from(('driver', 'encoder', 'overspeed', 'undervoltage'))),
       st.floats(0.0, 60.0), st.floats(-20.0, 150.0))
def test_health_goes_through(link, state, faults, voltage, temperature):
    if (state is LinkState.FAULT) != bool(faults):
        # An ODrive reports no more than an error and that it is disarmed.
        faults = frozenset({'driver'}) if state is LinkState.FAULT else frozenset()
    host = OdriveCodec()
    for frame in OdriveCodec().to_host(
            Heartbeat(link, 3, state, faults, voltage, temperature, 9)):
        report = host.from_links(frame)
    assert report == Heartbeat(link, None, state, faults,
                               pytest.approx(voltage, rel=SINGLE, abs=1e-40),
                               pytest.approx(temperature, rel=SINGLE, abs=1e-40))


def test_fault_without_a_bit_is_still_a_fault():
    frame, = OdriveCodec().to_host(Heartbeat(0, 0, LinkState.FAULT, frozenset({'angle_sensor'})))
    assert OdriveCodec().from_links(frame).state is LinkState.FAULT


def test_voltage_and_temperature_complete_the_last_heartbeat():
    host = OdriveCodec()
    bus = Frame(identifier(1, 0x17), struct.pack('<ff', 24.0, 1.0))
    hot = Frame(identifier(1, 0x15), struct.pack('<ff', 40.0, 60.0))
    # The host has no state of this link yet.
    assert host.from_links(bus) is None
    assert host.from_links(heartbeat(1, 0, 8)) == Heartbeat(
        1, None, LinkState.ARMED, frozenset(), 24.0)
    assert host.from_links(hot) == Heartbeat(1, None, LinkState.ARMED, frozenset(), 24.0, 60.0)
    # A motor without a thermistor.
    cold = Frame(identifier(1, 0x15), struct.pack('<ff', 35.0, nan))
    assert host.from_links(cold).temperature == 35.0
    assert host.from_links(heartbeat(2, 0, 8)).voltage is None


def test_limits_are_missing_until_they_are_sent():
    host = make()
    assert host.from_links(heartbeat(1, 0, 1)).faults == {'no_limits'}
    host.to_links(Limits(1, 0.05, 300.0))
    assert host.from_links(heartbeat(1, 0, 1)).faults == set()
    assert host.from_links(heartbeat(2, 0, 1)).faults == {'no_limits'}
    # The ODrive restarts.
    assert 'no_limits' in host.from_links(heartbeat(1, 1, 0)).faults
    assert host.from_links(heartbeat(1, 0, 1)).faults == {'no_limits'}


def test_limits_are_sent_again_before_power():
    """The host may have missed the restart of an ODrive."""
    host, link = make(), make()
    limits = host.to_links(Limits(1, 0.05, 300.0))
    enabled, disabled = (Command(1, 0.01, False, enable, 0) for enable in (True, False))
    assert host.to_links(enabled)[:1] == limits
    assert limits[0] not in host.to_links(enabled)
    host.to_links(disabled)
    commands = received(host, link, enabled)
    assert isinstance(commands[0], Limits)
    assert [message.enable for message in commands[1:]] == [False, False, True, True]
    assert len(host.to_links(replace(disabled, enable=True, link=2))) == 4


def test_limits_without_torque_constants_are_those_of_the_odrive():
    host = OdriveCodec()
    assert list(host.to_links(Limits(1, 0.05, 300.0))) == []
    assert host.from_links(heartbeat(1, 0, 1)).faults == set()


@pytest.mark.parametrize('constants', [(0.03,) * 3, (0.03, 0.03, 0.03, inf), (0.0,) * 4,
                                       (0.03, nan, 0.03, 0.03), (-0.03,) * 4])
def test_impossible_torque_constants(constants):
    with pytest.raises(BusError) as caught:
        OdriveCodec(torque_constants=constants)
    assert caught.value.values['name'] == 'motor_torque_constants'


@pytest.mark.parametrize('message', [
    AngleReport(3, 5, 3.0, None, 500, 10 * 2 ** 20), ClockReport(2, 9, 2 ** 32 - 1, 4)])
def test_sensor_boards_use_the_messages_of_the_prototype(message):
    frames, = zip(LINK.to_host(message), DbcCodec('prototype').to_host(message))
    assert frames[0] == frames[1]
    back = HOST.from_links(frames[0])
    assert replace(back, angle=3.0) == message if isinstance(message, AngleReport) else (
        back == message)


def test_flipped_bit_of_a_sensor_board_is_caught():
    frame, = LINK.to_host(ClockReport(2, 9, 1234, 4))
    for bit in range(64):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        with pytest.raises(FrameError):
            HOST.from_links(frame._replace(data=bytes(data)))


def test_no_two_messages_share_an_identifier():
    """The test covers the messages of ODrives and of sensor boards."""
    assert len(HOST.frame_ids) == 4 * 12 + 1 + 4 * 2
    assert {frame_id for frame_id in HOST.frame_ids if frame_id < 0x80} == {
        identifier(node, command) for node in range(4) for command in
        (0x01, 0x02, 0x07, 0x09, 0x0B, 0x0D, 0x0E, 0x0F, 0x15, 0x17, 0x18, 0x1C)}


def test_sensor_boards_that_use_an_identifier_of_an_odrive_are_refused(
        tmp_path, refuses):
    text = (share_directory() / 'config' / 'prototype.dbc').read_text()
    path = tmp_path / 'lab.dbc'
    path.write_text(text.replace(' 304 ', ' 9 '))
    odrive = str(share_directory() / 'config' / 'odrive.dbc')
    with refuses(DbcError, place=odrive, value=0x009):
        OdriveCodec(str(path))


@pytest.mark.parametrize('old, new, message, signal', [
    ('Axis2_Get_Torques', 'Axis2_Torques', 'Axis2_Get_Torques', None),
    ('Pos_Estimate', 'Position', 'Axis0_Get_Encoder_Estimates', 'Pos_Estimate'),
    ('Axis_Error : 0|32', 'Axis_Error : 0|16', 'Axis0_Heartbeat', 'Axis_Error')])
def test_incomplete_file_is_refused(tmp_path, old, new, message, signal, refuses):
    text = (share_directory() / 'config' / 'odrive.dbc').read_text()
    path = tmp_path / 'lab.dbc'
    path.write_text(text.replace(old, new))
    with refuses(DbcError, place=str(path), message=message, signal=signal):
        OdriveCodec(name=str(path))


def test_foreign_frames_are_ignored():
    for frame_id in set(range(0x800)) - HOST.frame_ids:
        frame = Frame(frame_id, bytes(8))
        assert HOST.from_links(frame) is None and LINK.from_host(frame) is None


@pytest.mark.parametrize('frame_id', sorted(HOST.frame_ids), ids=hex)
def test_wrong_length(frame_id):
    """The end that the frame is for rejects it."""
    refused = 0
    for length in range(9):
        for read in (HOST.from_links, LINK.from_host):
            try:
                read(Frame(frame_id, bytes(length)))
            except FrameError as error:
                refused += error.kind == 'length'
    assert refused == 8


@pytest.mark.parametrize('message', [
    *(Command(0, value, by_speed, enable, 0) for value in (nan, inf, -inf, 1e40)
      for by_speed in (True, False) for enable in (True, False)),
    *(Limits(0, *values) for values in ((nan, 1.0), (1.0, nan), (-1.0, 1.0), (1.0, -1.0),
                                        (inf, 1.0))),
    Sync(256), Limits(4, 1.0, 1.0), Command(-1, 0.0, True, True, 0)], ids=str)
def test_invalid_value_is_not_encoded_by_the_host(message):
    with pytest.raises(FrameError) as caught:
        HOST.to_links(message)
    assert caught.value.kind == 'value'


@pytest.mark.parametrize('message', [
    *(WheelReport(0, 0, value, TURN, 0, 1, 0.0) for value in (nan, inf)),
    WheelReport(0, 0, 0.0, TURN, 0, 1, nan), MotorReport(0, nan, LinkState.IDLE),
    Heartbeat(0, 0, LinkState.IDLE, frozenset(), nan),
    Heartbeat(0, 0, LinkState.IDLE, frozenset(), 12.0, inf), MotorReport(4, 0.0)],
    ids=str)
def test_invalid_value_is_not_encoded_by_a_link(message):
    with pytest.raises(FrameError) as caught:
        LINK.to_host(message)
    assert caught.value.kind == 'value'


@pytest.mark.parametrize('command, data', [
    (0x09, struct.pack('<ff', nan, 0.0)), (0x09, struct.pack('<ff', 0.0, inf)),
    (0x1C, struct.pack('<ff', 0.0, nan)), (0x17, struct.pack('<ff', nan, 0.0)),
    (0x15, struct.pack('<ff', inf, 0.0))])
def test_invalid_value_is_not_decoded_from_a_link(command, data):
    with pytest.raises(FrameError) as caught:
        HOST.from_links(Frame(identifier(3, command), data))
    assert caught.value.kind == 'value'


@pytest.mark.parametrize('command, data', [
    (0x07, struct.pack('<II', 3, 0)), (0x0B, struct.pack('<II', 3, 1)),
    (0x0B, struct.pack('<II', 1, 2)), (0x0D, struct.pack('<ff', nan, 0.0)),
    (0x0E, struct.pack('<ff', inf, 0.0)), (0x0F, struct.pack('<ff', -1.0, 1.0)),
    (0x0F, struct.pack('<ff', 1.0, nan))])
def test_invalid_value_is_not_decoded_from_the_host(command, data):
    with pytest.raises(FrameError) as caught:
        LINK.from_host(Frame(identifier(3, command), data))
    assert caught.value.kind == 'value'
