# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Reactions of the prototype: safety rules, link faults, bus faults, invalid frames."""

from math import inf, nan
from pathlib import Path

from fourbar_ros.device import DeviceState, Reaction, SupervisorSettings
from fourbar_ros.hardware.messages import (
    BusError,
    Command,
    Frame,
    Heartbeat,
    LinkState,
    Stop,
)
from fourbar_ros.hardware.prototype import NO_RATE, PrototypeSettings
from fourbar_ros.hardware.safety_table import load_safety, SafetyError
from fourbar_ros.plant import Fault
import numpy as np
import pytest
import yaml

TORQUE = (0.01, 0.01, 0.01, 0.01)


@pytest.fixture
def driven(world):
    """Return a world with driven wheels."""
    world.torque(*TORQUE)
    assert world.arm() == (True, 'armed')
    world.run(0.2)
    assert world.testbed.arming.armed
    return world


def firmware(world, link: int):
    return world.wire.emulators[0].firmware[link]


def assert_coasting(world) -> None:
    """Check that no link has power or torque."""
    world.run(0.1)
    assert not any(firmware(world, link).drive()[2] for link in range(4))
    np.testing.assert_allclose(
        world.wire.emulators[0].samples.wheels.efforts, 0.0, atol=1e-9)


def wait(world, condition, seconds: float) -> float:
    """Wait for a condition, and return the duration of the wait [s]."""
    begin_ns = world.wire.now_ns
    while not condition():
        assert world.wire.now_ns - begin_ns < seconds * 1e9, 'not in time'
        world.tick()
    return (world.wire.now_ns - begin_ns) * 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(('kind', 'state', 'within', 'rule', 'numbers'), [
    ('silent', DeviceState.DISARMED, 0.07, 'wheel_silent', ['0.05 s']),
    ('hot', DeviceState.DISARMED, 0.4, 'overtemperature', ['90 deg C', '80 deg C']),
    ('low_battery', DeviceState.DISARMED, 0.4, 'undervoltage', ['9.8 V', '10 V']),
    ('reboot', DeviceState.EMERGENCY_STOP, 0.15, 'reboot', []),
    ('corrupted', DeviceState.DISARMED, 0.07, 'wheel_silent', ['0.05 s']),
])
def test_link_fault_stops_the_wheels(driven, kind, state, within, rule, numbers) -> None:
    driven.wire.emulators[0].inject_fault('link_c', kind)
    wait(driven, lambda: not driven.testbed.arming.armed, within)
    assert driven.testbed.arming.state is state
    assert driven.testbed.arming.reason.startswith(f'link_c: {rule}: ')
    assert all(number in driven.testbed.arming.reason for number in numbers)
    if kind == 'reboot':
        # The rule `not_armed` applies too, earlier or later.
        assert_coasting(driven)
        return
    assert_coasting(driven)
    armed, reason = driven.arm()
    assert not armed
    assert 'link_c' in reason
    driven.wire.emulators[0].inject_fault('link_c', '')
    driven.run(1.5)
    assert driven.arm() == (True, 'armed')


@pytest.mark.slow
@pytest.mark.parametrize(('kind', 'state'), [
    ('silent', DeviceState.DISARMED), ('hot', DeviceState.DISARMED),
    ('reboot', DeviceState.EMERGENCY_STOP)])
def test_parked_wheels_are_monitored_too(make_world, kind, state) -> None:
    # The timeout is shorter than that of the links.
    world = make_world(supervisor=SupervisorSettings(
        command_timeout=0.05, timeout_action='hold_speed'))
    world.run(1.0)
    world.torque(*TORQUE)
    assert world.arm() == (True, 'armed')
    world.run(0.2)
    world.command = None
    world.run(0.2)
    assert world.testbed.arming.state is DeviceState.DISARMED
    assert all(firmware(world, link).drive()[2] for link in range(4))
    world.wire.emulators[0].inject_fault('link_b', kind)
    world.run(0.4)
    assert world.testbed.arming.state is state
    assert_coasting(world)


@pytest.mark.slow
def test_heartbeat_lost_while_armed_is_an_emergency_stop(driven) -> None:
    # Only the heartbeats are lost: the wheels answer.
    driven.wire.lost_ids.update(
        driven.codec.to_host(Heartbeat(link, 0, LinkState.IDLE, frozenset(), boot=0))[0].frame_id
        for link in range(4))
    after = wait(driven, lambda: not driven.testbed.arming.armed, 0.7)
    assert driven.testbed.arming.state is DeviceState.EMERGENCY_STOP
    assert ': heartbeat_lost: ' in driven.testbed.arming.reason
    assert after > 0.4
    assert_coasting(driven)


@pytest.mark.medium
def test_link_that_stays_silent_is_disarmed_first_and_then_an_emergency_stop(driven) -> None:
    driven.wire.emulators[0].inject_fault('link_b', 'silent')
    assert wait(driven, lambda: not driven.testbed.arming.armed, 0.07) > 0.04
    assert driven.testbed.arming.state is DeviceState.DISARMED
    after = wait(
        driven, lambda: driven.testbed.arming.state is DeviceState.EMERGENCY_STOP, 0.6)
    assert after > 0.3
    assert 'link_b: heartbeat_lost: ' in driven.testbed.arming.reason
    driven.wire.emulators[0].inject_fault('link_b', '')
    driven.run(1.5)
    armed, reason = driven.arm()
    assert not armed
    assert 'link_b: heartbeat_lost: ' in reason
    driven.testbed.reset()
    driven.run(0.1)
    assert driven.arm() == (True, 'armed')


@pytest.mark.medium
def test_silent_link_has_no_effect_while_disarmed(driven) -> None:
    driven.testbed.disarm('test')
    driven.run(0.1)
    driven.wire.emulators[0].inject_fault('link_b', 'silent')
    driven.run(1.5)
    assert driven.testbed.arming.state is DeviceState.DISARMED


@pytest.mark.medium
def test_link_that_returns_at_once_is_only_disarmed(driven) -> None:
    driven.wire.emulators[0].inject_fault('link_b', 'silent')
    wait(driven, lambda: not driven.testbed.arming.armed, 0.07)
    driven.wire.emulators[0].inject_fault('link_b', '')
    driven.run(1.0)
    # A later fault does not continue the first one.
    driven.wire.emulators[0].inject_fault('link_b', 'silent')
    driven.run(1.0)
    assert driven.testbed.arming.state is DeviceState.DISARMED


@pytest.mark.medium
def test_diagnostics_list_the_faults_of_a_link_by_severity(driven) -> None:
    driven.wire.emulators[0].inject_fault('link_c', 'hot')
    driven.run(1.5)
    assert driven.prototype.diagnostics() == {
        'link_c': 'link_c: overtemperature: temperature 90 deg C, limit 80 deg C; '
                  'link_c: hot: temperature 90 deg C, limit 65 deg C'}


@pytest.mark.slow
@pytest.mark.parametrize('seconds', [1.0, 10.0])
def test_after_a_bus_failure_wheels_coast_until_armed(driven, seconds) -> None:
    emulator = driven.wire.emulators[0]
    emulator.inject_fault('bus', 'off')
    begin_ns = driven.wire.now_ns
    while any(firmware(driven, link).drive()[2] for link in range(4)):
        driven.tick()
    assert driven.wire.now_ns - begin_ns <= 110_000_000
    driven.run(seconds)
    assert not driven.testbed.arming.armed
    assert not any(samples.complete for samples in driven.samples[-50:])
    emulator.inject_fault('bus', '')
    driven.run(2.0)
    # Commands arrive at every tick and have no effect.
    assert all(samples.complete for samples in driven.samples[-50:])
    assert_coasting(driven)
    assert driven.testbed.arming.state is DeviceState.EMERGENCY_STOP
    driven.testbed.reset()
    driven.run(0.1)
    assert driven.arm() == (True, 'armed')
    driven.run(0.2)
    assert emulator.samples.wheels.efforts == pytest.approx(TORQUE, rel=1e-3)


@pytest.mark.medium
def test_links_coast_by_themselves_when_the_host_is_gone(driven) -> None:
    wire = driven.wire
    end_ns = wire.now_ns + 110_000_000
    while wire.now_ns < end_ns:
        wire.receive(1e-3)
    assert [firmware(driven, link).state for link in range(4)] == [LinkState.COASTING] * 4
    end_ns += 100_000_000
    while wire.now_ns < end_ns:
        wire.receive(1e-3)
    assert_coasting(driven)


@pytest.mark.medium
def test_broken_bus_is_a_fault_and_is_opened_again(driven) -> None:
    driven.wire.broken = True
    with pytest.raises(BusError):
        driven.tick()
    assert driven.testbed.arming.state is DeviceState.FAULT
    driven.wire.broken = False
    assert driven.testbed.reset()[0]
    driven.run(0.5)
    assert driven.arm() == (True, 'armed')


@pytest.mark.medium
def test_missing_gyros_are_reported(make_world) -> None:
    world = make_world(settings=PrototypeSettings(gyro=True))
    world.run(1.0)
    world.run(0.3)
    assert not any(samples.links for samples in world.samples[-50:])
    armed, reason = world.arm()
    assert not armed
    assert f'link_d: {NO_RATE}' in reason
    assert world.prototype.diagnostics()['link_a'] == NO_RATE


@pytest.mark.medium
def test_broken_bus_during_a_stop_is_not_opened_at_every_tick(driven) -> None:
    """Opening a bus may take seconds, in which nothing is received."""
    driven.testbed.emergency_stop('test')
    driven.wire.broken = True
    driven.wire.opened_ns.clear()
    for _ in range(625):
        with pytest.raises(BusError):
            driven.tick()
    assert len(driven.wire.opened_ns) == 3
    assert min(np.diff(driven.wire.opened_ns)) >= 1_000_000_000
    driven.wire.broken = False
    driven.testbed.reset()
    driven.tick()
    driven.run(0.3)
    assert driven.testbed.arming.state is DeviceState.DISARMED


@pytest.mark.medium
def test_emergency_stop_latches_in_the_links_too(driven) -> None:
    driven.testbed.emergency_stop('test')
    driven.run(0.01)
    assert [firmware(driven, link).state for link in range(4)] == [LinkState.STOPPED] * 4
    # A command of another host has no effect either.
    driven.wire.emulators[0].receive(
        driven.codec.to_links(Command(0, 0.01, False, True, 99))[0], driven.wire.now_ns)
    assert_coasting(driven)
    driven.testbed.reset()
    driven.run(0.1)
    assert [firmware(driven, link).state for link in range(4)] == [LinkState.IDLE] * 4


@pytest.mark.medium
def test_link_that_restarts_during_a_stop_is_stopped(driven) -> None:
    driven.testbed.emergency_stop('test')
    driven.run(0.05)
    driven.wire.emulators[0].inject_fault('link_b', 'reboot')
    driven.run(0.1)
    assert firmware(driven, 1).state is LinkState.STOPPED


def test_close_ends_all_torque(driven) -> None:
    driven.wire.sent_frames.clear()
    driven.testbed.close()
    last = [driven.codec.from_host(frame) for frame in driven.wire.sent_frames][-4:]
    assert [(command.link, command.value, command.enable) for command in last] == [
        (link, 0.0, False) for link in range(4)]
    end_ns = driven.wire.now_ns + 10_000_000
    while driven.wire.now_ns < end_ns:
        driven.wire.receive(1e-3)
    assert [firmware(driven, link).state for link in range(4)] == [LinkState.IDLE] * 4


@pytest.mark.medium
def test_two_links_with_one_identifier_stop_all(driven) -> None:
    driven.wire.emulators.append(driven.emulator((1,), 'prototype', seed=7))
    wait(driven, lambda: driven.testbed.arming.state is DeviceState.EMERGENCY_STOP, 1.0)
    assert driven.testbed.arming.reason.startswith('link_b: ')
    driven.testbed.reset()
    driven.run(0.5)
    armed, reason = driven.arm()
    assert not armed
    assert 'link_b: two_of_one_id: 2 links' in reason
    assert_coasting(driven)


def test_emulated_link_reports_a_second_sender_of_its_identifier(world, refuses) -> None:
    frame = world.codec.to_host(Heartbeat(2, 3, LinkState.IDLE, frozenset(), 12.0, 20.0, 5))[0]
    with refuses(BusError, name='link_c'):
        world.wire.emulators[0].receive(frame, world.wire.now_ns)


@pytest.mark.medium
@pytest.mark.parametrize('links', [(0, 1, 3), (0,)])
def test_missing_links_are_named_and_nothing_is_driven(make_world, links) -> None:
    world = make_world(links=links)
    world.run(1.0)
    missing = [f'link_{letter}' for n, letter in enumerate('abcd') if n not in links]
    assert not any(samples.complete for samples in world.samples)
    assert f'waiting for {", ".join(missing)}: ' in world.prototype.diagnostics()['missing']
    armed, reason = world.arm()
    assert not armed
    for name in missing:
        assert f'{name}: no heartbeat' in reason


@pytest.mark.medium
@pytest.mark.parametrize('kind', ['foreign', 'replayed'])
def test_bad_frames_are_ignored_and_counted(driven, kind) -> None:
    driven.wire.emulators[0].inject_fault('link_a', kind)
    driven.run(2.5)
    assert driven.testbed.arming.armed
    values = driven.prototype.diagnostic_values()
    counted = values.get('frames_foreign') if kind == 'foreign' else values['link_a.replayed']
    assert counted > 500
    assert values.get('link_a.lost_heartbeats', 0) == 0
    text = driven.prototype.diagnostics()['bus']
    assert text.startswith('bus: bad_frames: ') and text.endswith(' 20')
    assert driven.samples[-1].wheels.efforts == pytest.approx(TORQUE, rel=1e-3)


@pytest.mark.medium
def test_repeated_heartbeats_are_rejected(driven) -> None:
    beats = [driven.codec.to_host(Heartbeat(
        1, sequence, LinkState.ARMED, frozenset(), 12.0, 30.0,
        driven.prototype.links[1].heartbeat.boot))[0]
        for sequence in ((driven.prototype.links[1].heartbeat.sequence - back) % 16
                         for back in (1, 2))]
    driven.wire.emulators[0].inject_fault('link_b', 'silent')

    def stopped() -> bool:
        for frame in beats:
            driven.wire.inject(frame)
        return driven.testbed.arming.state is DeviceState.EMERGENCY_STOP
    wait(driven, stopped, 0.6)
    assert 'link_b: heartbeat_lost: ' in driven.testbed.arming.reason


@pytest.mark.slow
def test_heartbeats_are_accepted_after_a_long_silence(driven) -> None:
    """The durations give different sequence numbers of the first heartbeat after the silence."""
    for seconds in (1.2, 1.25, 1.3, 1.4, 1.6):
        driven.wire.emulators[0].inject_fault('link_b', 'silent')
        driven.run(seconds)
        driven.wire.emulators[0].inject_fault('link_b', '')
        driven.testbed.reset()
        driven.run(0.3)
        assert driven.arm() == (True, 'armed')


@pytest.mark.medium
def test_old_command_does_not_move_a_wheel(driven) -> None:
    """Frames recorded while the wheels are driven are replayed after disarming."""
    recorded = [frame for frame in driven.wire.sent_frames
                if isinstance(driven.codec.from_host(frame), Command)][-4:]
    driven.testbed.disarm('test')
    driven.command = None
    driven.run(0.1)
    for frame in recorded:
        driven.wire.emulators[0].receive(frame, driven.wire.now_ns)
    assert_coasting(driven)
    assert firmware(driven, 0).counts['replayed'] >= 1


def test_host_with_a_new_count_is_accepted_after_a_timeout_without_power(world) -> None:
    """The case is an outage longer than the range of the command counter."""
    link, now_ns = firmware(world, 0), world.wire.now_ns
    limit_ns = 110_000_000
    disarm, drive = (Command(0, 0.0, False, enable, (link.sequence + 200) % 256)
                     for enable in (False, True))
    link.command(disarm, now_ns)
    link.command(drive, now_ns + limit_ns)
    assert link.sequence != disarm.sequence
    assert link.counts['replayed'] == 2
    link.command(disarm, now_ns + limit_ns)
    assert link.sequence == disarm.sequence
    assert link.state is LinkState.IDLE


@pytest.mark.medium
def test_wheel_that_turns_too_fast_is_not_armed(world) -> None:
    world.torque(0.03, 0.0, 0.0, 0.0)
    assert world.arm()[0]
    wait(world, lambda: world.samples[-1].wheels.speeds[0] > 60.0, 2.0)
    world.testbed.disarm('test')
    world.run(0.1)
    armed, reason = world.arm()
    assert not armed
    assert 'link_a: wheel_speed_to_arm: ' in reason
    assert reason.endswith(' 30 rad/s')


@pytest.mark.medium
def test_motor_that_gives_torque_without_power_stops_everything(world) -> None:
    world.torque(0.001)
    assert world.arm()[0]
    world.run(0.1)
    # Only wheel a is commanded; the driver of wheel c gives torque by itself.
    world.wire.emulators[0].table.break_down(
        'flywheel_c', Fault('flywheel_c', 'shorted', 0.02))
    wait(world, lambda: not world.testbed.arming.armed, 0.5)
    assert world.testbed.arming.state is DeviceState.EMERGENCY_STOP
    assert 'link_c: unasked_torque: ' in world.testbed.arming.reason


@pytest.mark.medium
def test_stop_of_another_host_stops_the_links(driven) -> None:
    stop, = driven.codec.to_links(Stop())
    driven.wire.emulators[0].receive(stop, driven.wire.now_ns)
    wait(driven, lambda: not driven.testbed.arming.armed, 0.2)
    assert ': not_armed: ' in driven.testbed.arming.reason
    assert 'stopped' in driven.testbed.arming.reason
    assert_coasting(driven)


@pytest.mark.medium
def test_links_stopped_by_another_host_are_released_by_a_reset(world) -> None:
    """An earlier host has stopped the links, or the release was lost."""
    world.wire.send(world.codec.to_links(Stop())[0])
    world.run(0.1)
    assert world.testbed.arming.state is DeviceState.DISARMED
    armed, reason = world.arm()
    assert not armed
    assert 'link_c: its state is stopped, call reset_emergency_stop first' in reason
    assert world.testbed.reset() == (
        True, 'link_a, link_b, link_c, link_d: the emergency stop is reset')
    world.run(0.1)
    assert [firmware(world, link).state for link in range(4)] == [LinkState.IDLE] * 4
    assert world.arm() == (True, 'armed')


@pytest.mark.medium
def test_links_stay_stopped_until_a_reset_arrives(driven) -> None:
    driven.testbed.emergency_stop('test')
    driven.run(0.1)
    driven.wire.broken = True
    driven.testbed.reset()
    with pytest.raises(BusError):
        driven.tick()
    assert driven.testbed.arming.state is DeviceState.FAULT
    driven.wire.broken = False
    driven.testbed.reset()
    driven.run(0.3)
    assert firmware(driven, 0).state is LinkState.STOPPED
    driven.testbed.reset()
    driven.run(0.3)
    assert driven.arm() == (True, 'armed')


@pytest.mark.slow
def test_flood_of_foreign_frames_does_not_delay_the_host(driven) -> None:
    for _ in range(5000):
        driven.wire.inject(Frame(0x7FF, b'?'))
    driven.run(1.0)
    assert driven.testbed.arming.armed


# Safety table

ROWS = load_safety('prototype')


def write(tmp_path: Path, **changes) -> str:
    values = {row: {'limit': rule.limit, 'lasting': rule.lasting,
                    'reaction': rule.reaction} for row, rule in ROWS.items()}
    for row, change in changes.items():
        if change is None:
            del values[row]
        else:
            values.setdefault(row, {}).update(change)
    path = tmp_path / 'safety.yaml'
    path.write_text(yaml.safe_dump(values))
    return str(path)


def test_safety_table_of_emulated_links_differs_only_in_timeouts() -> None:
    """The timeout is half a second, because a shared computer may stall."""
    real, emulated = load_safety('prototype'), load_safety('emulated')
    assert {name for name in real if real[name] != emulated[name]} == {
        'wheel_silent', 'heartbeat_lost', 'not_armed', 'unasked_torque'}
    assert emulated['wheel_silent'].limit == 0.5
    assert emulated['wheel_silent'].level == real['wheel_silent'].level


def test_limits_and_reactions_may_be_changed(tmp_path: Path) -> None:
    table = load_safety(write(tmp_path, hot={'limit': 50.0, 'reaction': 'coast'}))
    assert (table['hot'].limit, table['hot'].level) == (50.0, Reaction.COAST)


@pytest.mark.parametrize(('changes', 'values'), [
    ({'hot': None}, {'missing': ['hot']}),
    ({'cold': {'limit': 1.0, 'lasting': 0.0, 'reaction': 'warn'}}, {'unknown': ['cold']}),
    ({'hot': {'limit': -1.0}}, {'name': 'hot.limit', 'value': -1.0, 'limit': (0.0, inf)}),
    ({'hot': {'limit': 'much'}}, {'name': 'hot.limit', 'value': 'much', 'limit': float}),
    ({'hot': {'lasting': nan}}, {'name': 'hot.lasting', 'limit': (0.0, inf)}),
    ({'hot': {'lasting': inf}}, {'name': 'hot.lasting', 'value': inf, 'limit': (0.0, inf)}),
    ({'hot': {'reaction': 'panic'}},
     {'name': 'hot.reaction', 'value': 'panic', 'limit': ('warn', 'coast', 'stop')}),
    ({'hot': {'colour': 'red'}}, {'unknown': ['colour']}),
    ({'wheel_silent': {'reaction': 'warn'}},
     {'name': 'wheel_silent.reaction', 'value': 'warn', 'limit': 'coast'}),
])
def test_invalid_table_is_refused(tmp_path: Path, changes, values, refuses) -> None:
    with refuses(SafetyError, **values):
        load_safety(write(tmp_path, **changes))
