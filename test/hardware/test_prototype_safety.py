# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What stops the prototype: limits, links that fail, a bus that goes away, frames that lie."""

from pathlib import Path

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.device import DeviceState, SupervisorSettings
from fourbar_ros.hardware.messages import (
    BusError,
    Command,
    Frame,
    Heartbeat,
    LinkState,
    Stop,
)
from fourbar_ros.hardware.safety_table import load_safety, SafetyError
from fourbar_ros.plant import Fault
import numpy as np
import pytest
import yaml

TORQUE = (0.01, 0.01, 0.01, 0.01)


@pytest.fixture
def driven(world):
    """Return a world whose wheels are driven."""
    world.torque(*TORQUE)
    assert world.arm() == (True, 'armed')
    world.run(0.2)
    assert world.testbed.gate.armed
    return world


def firmware(world, link: int):
    return world.wire.emulators[0].firmware[link]


def assert_coasting(world) -> None:
    """No link has power, and none gets torque."""
    world.run(0.1)
    assert not any(firmware(world, link).drive()[2] for link in range(4))
    np.testing.assert_allclose(
        world.wire.emulators[0].samples.wheels.efforts, 0.0, atol=1e-9)


def wait(world, condition, seconds: float) -> float:
    """Return after how long something is so [s]."""
    begin_ns = world.wire.now_ns
    while not condition():
        assert world.wire.now_ns - begin_ns < seconds * 1e9, 'not in time'
        world.tick()
    return (world.wire.now_ns - begin_ns) * 1e-9


@pytest.mark.parametrize(('trouble', 'state', 'within', 'word'), [
    ('silent', DeviceState.DISARMED, 0.07, 'its wheel has not answered for'),
    ('hot', DeviceState.DISARMED, 0.4, 'it has 90 deg C, limit 80'),
    ('low_battery', DeviceState.DISARMED, 0.4, 'its supply has 9.8 V, at least 10'),
    ('reboot', DeviceState.EMERGENCY_STOP, 0.15, 'it has started anew while it was armed'),
    ('corrupted', DeviceState.DISARMED, 0.07, 'its wheel has not answered for'),
])
def test_link_in_trouble_ends_it(driven, trouble, state, within, word) -> None:
    driven.wire.emulators[0].trouble('link_c', trouble)
    wait(driven, lambda: not driven.testbed.gate.armed, within)
    assert driven.testbed.gate.state is state
    assert driven.testbed.gate.reason.startswith('link_c: ')
    assert word in driven.testbed.gate.reason
    if trouble == 'reboot':
        # In one order or the other: it also does not drive when told to.
        assert_coasting(driven)
        return
    assert_coasting(driven)
    armed, reason = driven.arm()
    assert not armed
    assert 'link_c' in reason
    driven.wire.emulators[0].trouble('link_c', '')
    driven.run(1.5)
    assert driven.arm() == (True, 'armed')


@pytest.mark.parametrize(('trouble', 'state'), [
    ('silent', DeviceState.DISARMED), ('hot', DeviceState.DISARMED),
    ('reboot', DeviceState.EMERGENCY_STOP)])
def test_wheels_that_are_parked_under_power_are_watched_too(make_world, trouble, state) -> None:
    # Before the links coast by themselves.
    world = make_world(settings=SupervisorSettings(
        command_timeout=0.05, timeout_action='hold_speed'))
    world.run(1.0)
    world.torque(*TORQUE)
    assert world.arm() == (True, 'armed')
    world.run(0.2)
    world.command = None
    world.run(0.2)
    assert world.testbed.gate.state is DeviceState.DISARMED
    assert all(firmware(world, link).drive()[2] for link in range(4))
    world.wire.emulators[0].trouble('link_b', trouble)
    world.run(0.4)
    assert world.testbed.gate.state is state
    assert_coasting(world)


def test_heartbeat_lost_while_armed_is_an_emergency_stop(driven) -> None:
    emulator = driven.wire.emulators[0]
    # The wheel goes on answering: only the heartbeats are gone.
    emulator._beat_ns = 2 ** 62
    after = wait(driven, lambda: not driven.testbed.gate.armed, 0.7)
    assert driven.testbed.gate.state is DeviceState.EMERGENCY_STOP
    assert 'no heartbeat for' in driven.testbed.gate.reason
    assert after > 0.4
    assert_coasting(driven)


def test_link_that_stays_silent_is_disarmed_first_and_then_an_emergency_stop(driven) -> None:
    driven.wire.emulators[0].trouble('link_b', 'silent')
    assert wait(driven, lambda: not driven.testbed.gate.armed, 0.07) > 0.04
    assert driven.testbed.gate.state is DeviceState.DISARMED
    after = wait(
        driven, lambda: driven.testbed.gate.state is DeviceState.EMERGENCY_STOP, 0.6)
    assert after > 0.3
    assert 'link_b: no heartbeat for' in driven.testbed.gate.reason
    driven.wire.emulators[0].trouble('link_b', '')
    driven.run(1.5)
    armed, reason = driven.arm()
    assert not armed
    assert 'no heartbeat for' in reason
    driven.testbed.reset()
    driven.run(0.1)
    assert driven.arm() == (True, 'armed')


def test_link_that_falls_silent_while_nobody_drives_stops_nothing(driven) -> None:
    driven.testbed.disarm('test')
    driven.run(0.1)
    driven.wire.emulators[0].trouble('link_b', 'silent')
    driven.run(1.5)
    assert driven.testbed.gate.state is DeviceState.DISARMED


def test_link_that_is_heard_again_at_once_is_only_disarmed(driven) -> None:
    driven.wire.emulators[0].trouble('link_b', 'silent')
    wait(driven, lambda: not driven.testbed.gate.armed, 0.07)
    driven.wire.emulators[0].trouble('link_b', '')
    driven.run(1.0)
    # What comes later is of another time.
    driven.wire.emulators[0].trouble('link_b', 'silent')
    driven.run(1.0)
    assert driven.testbed.gate.state is DeviceState.DISARMED


def test_diagnosis_tells_all_of_a_link_the_worst_first(driven) -> None:
    driven.wire.emulators[0].trouble('link_c', 'hot')
    driven.run(1.5)
    assert driven.prototype.diagnostics() == {
        'link_c': 'link_c: it has 90 deg C, limit 80; link_c: it has 90 deg C, limit 65'}


@pytest.mark.parametrize('seconds', [1.0, 10.0])
def test_bus_that_drops_out_leaves_wheels_coasting_until_somebody_arms(driven, seconds) -> None:
    emulator = driven.wire.emulators[0]
    emulator.trouble('bus', 'off')
    begin_ns = driven.wire.now_ns
    while any(firmware(driven, link).drive()[2] for link in range(4)):
        driven.tick()
    assert driven.wire.now_ns - begin_ns <= 110_000_000
    driven.run(seconds)
    assert not driven.testbed.gate.armed
    assert not any(samples.complete for samples in driven.samples[-50:])
    emulator.trouble('bus', '')
    driven.run(2.0)
    # Commands come at every tick, and nothing moves for them.
    assert all(samples.complete for samples in driven.samples[-50:])
    assert_coasting(driven)
    assert driven.testbed.gate.state is DeviceState.EMERGENCY_STOP
    driven.testbed.reset()
    driven.run(0.1)
    assert driven.arm() == (True, 'armed')
    driven.run(0.2)
    assert emulator.samples.wheels.efforts == pytest.approx(TORQUE, rel=1e-3)


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


def test_bus_that_is_gone_is_a_fault_and_comes_back(driven) -> None:
    driven.wire.broken = True
    with pytest.raises(FourbarError, match='the bus is gone'):
        driven.tick()
    assert driven.testbed.gate.state is DeviceState.FAULT
    driven.wire.broken = False
    assert driven.testbed.reset()[0]
    driven.run(0.5)
    assert driven.arm() == (True, 'armed')


def test_links_without_gyros_are_told_where_there_should_be_some(world) -> None:
    world.prototype.measures_rates = True
    world.run(0.3)
    assert not any(samples.links for samples in world.samples[-50:])
    armed, reason = world.arm()
    assert not armed
    assert 'link_d: its angles come without a rate' in reason
    assert 'set gyro to false' in world.prototype.diagnostics()['link_a']


def test_bus_that_is_gone_during_a_stop_is_not_opened_at_every_tick(driven) -> None:
    """To open one may take seconds, in which nobody would be heard."""
    driven.testbed.emergency_stop('test')
    driven.wire.broken = True
    tried_ns: list[int] = []

    def open_bus():
        tried_ns.append(driven.wire.now_ns)
        return driven.open_bus()
    driven.prototype._open_bus = open_bus
    for _ in range(625):
        with pytest.raises(BusError):
            driven.tick()
    assert len(tried_ns) == 3
    assert min(np.diff(tried_ns)) >= 1_000_000_000
    driven.wire.broken = False
    driven.testbed.reset()
    driven.tick()
    driven.run(0.3)
    assert driven.testbed.gate.state is DeviceState.DISARMED


def test_emergency_stop_latches_in_the_links_too(driven) -> None:
    driven.testbed.emergency_stop('test')
    driven.run(0.01)
    assert [firmware(driven, link).state for link in range(4)] == [LinkState.STOPPED] * 4
    # Not even a command of somebody else moves them.
    driven.wire.emulators[0].take(
        driven.codec.to_links(Command(0, 0.01, False, True, 99))[0], driven.wire.now_ns)
    assert_coasting(driven)
    driven.testbed.reset()
    driven.run(0.1)
    assert [firmware(driven, link).state for link in range(4)] == [LinkState.IDLE] * 4


def test_link_that_starts_anew_during_a_stop_is_stopped(driven) -> None:
    driven.testbed.emergency_stop('test')
    driven.run(0.05)
    driven.wire.emulators[0].trouble('link_b', 'reboot')
    driven.run(0.1)
    assert firmware(driven, 1).state is LinkState.STOPPED


def test_leaving_ends_all_torque(driven) -> None:
    driven.wire.said.clear()
    driven.testbed.close()
    last = [driven.codec.from_host(frame) for frame in driven.wire.said][-4:]
    assert [(command.link, command.value, command.enable) for command in last] == [
        (link, 0.0, False) for link in range(4)]
    end_ns = driven.wire.now_ns + 10_000_000
    while driven.wire.now_ns < end_ns:
        driven.wire.receive(1e-3)
    assert [firmware(driven, link).state for link in range(4)] == [LinkState.IDLE] * 4


def test_two_links_with_one_id_are_told_and_stop_everything(driven) -> None:
    driven.wire.emulators.append(driven.emulator((1,), 'prototype', seed=7))
    wait(driven, lambda: driven.testbed.gate.state is DeviceState.EMERGENCY_STOP, 1.0)
    assert driven.testbed.gate.reason.startswith('link_b: ')
    driven.testbed.reset()
    driven.run(0.5)
    armed, reason = driven.arm()
    assert not armed
    assert 'link_b: 2 links answer to its id' in reason
    assert_coasting(driven)


def test_emulated_link_that_hears_its_own_id_says_so(world) -> None:
    frame = world.codec.to_host(Heartbeat(2, 3, LinkState.IDLE, frozenset(), 12.0, 20.0, 5))[0]
    with pytest.raises(BusError, match='link_c is on this bus already'):
        world.wire.emulators[0].take(frame, world.wire.now_ns)


@pytest.mark.parametrize('links', [(0, 1, 3), (0,)])
def test_missing_links_are_named_and_nothing_is_driven(make_world, links) -> None:
    world = make_world(links=links)
    world.run(1.0)
    missing = [f'link_{letter}' for n, letter in enumerate('abcd') if n not in links]
    assert not any(samples.complete for samples in world.samples)
    assert world.prototype.diagnostics()['missing'] == (
        f'waiting for {", ".join(missing)}: never heard')
    armed, reason = world.arm()
    assert not armed
    for name in missing:
        assert f'{name}: was never heard' in reason


@pytest.mark.parametrize('trouble', ['foreign', 'replayed'])
def test_frames_that_are_no_good_are_ignored_and_counted(driven, trouble) -> None:
    driven.wire.emulators[0].trouble('link_a', trouble)
    driven.run(2.5)
    assert driven.testbed.gate.armed
    facts = driven.prototype.facts()
    counted = facts.get('frames_foreign') if trouble == 'foreign' else facts['link_a.replayed']
    assert counted > 500
    assert facts.get('link_a.lost_heartbeats', 0) == 0
    assert 'frames a second are no good, limit 20' in driven.prototype.diagnostics()['bus']
    assert driven.samples[-1].wheels.efforts == pytest.approx(TORQUE, rel=1e-3)


def test_heartbeats_of_the_past_keep_no_link_alive(driven) -> None:
    beats = [driven.codec.to_host(Heartbeat(
        1, sequence, LinkState.ARMED, frozenset(), 12.0, 30.0,
        driven.prototype.links[1].heartbeat.boot))[0]
        for sequence in ((driven.prototype.links[1].heartbeat.sequence - back) % 16
                         for back in (1, 2))]
    driven.wire.emulators[0].trouble('link_b', 'silent')

    def stopped() -> bool:
        for frame in beats:
            driven.wire.inject(frame)
        return driven.testbed.gate.state is DeviceState.EMERGENCY_STOP
    wait(driven, stopped, 0.6)
    assert 'link_b: no heartbeat for' in driven.testbed.gate.reason


def test_heartbeats_count_on_after_a_long_silence(driven) -> None:
    """Whatever their number is by then."""
    for seconds in (1.2, 1.25, 1.3, 1.4, 1.6):
        driven.wire.emulators[0].trouble('link_b', 'silent')
        driven.run(seconds)
        driven.wire.emulators[0].trouble('link_b', '')
        driven.testbed.reset()
        driven.run(0.3)
        assert driven.arm() == (True, 'armed')


def test_old_command_does_not_move_a_wheel(driven) -> None:
    """A frame that was recorded while driving is played back after disarming."""
    recorded = [frame for frame in driven.wire.said
                if isinstance(driven.codec.from_host(frame), Command)][-4:]
    driven.testbed.disarm('test')
    driven.command = None
    driven.run(0.1)
    for frame in recorded:
        driven.wire.emulators[0].take(frame, driven.wire.now_ns)
    assert_coasting(driven)
    assert firmware(driven, 0).counts['replayed'] >= 1


def test_host_that_counts_anew_is_heard_after_a_silence_and_drives_nothing_by_that(world) -> None:
    """As after an outage in which more commands were lost than the count goes."""
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


def test_wheel_that_turns_too_fast_is_not_armed(world) -> None:
    world.torque(0.03, 0.0, 0.0, 0.0)
    assert world.arm()[0]
    wait(world, lambda: world.samples[-1].wheels.speeds[0] > 60.0, 2.0)
    world.testbed.disarm('test')
    world.run(0.1)
    armed, reason = world.arm()
    assert not armed
    assert 'link_a: its wheel turns at' in reason
    assert 'limit 30' in reason


def test_motor_that_gives_torque_without_power_stops_everything(world) -> None:
    world.torque(0.001)
    assert world.arm()[0]
    world.run(0.1)
    # Only wheel a has power: the others' electronics go mad.
    world.wire.emulators[0].table.break_down(
        'flywheel_c', Fault('flywheel_c', 'shorted', 0.02))
    wait(world, lambda: not world.testbed.gate.armed, 0.5)
    assert world.testbed.gate.state is DeviceState.EMERGENCY_STOP
    assert 'link_c: its motor gives' in world.testbed.gate.reason


def test_stop_frame_of_anybody_stops_the_links(driven) -> None:
    stop, = driven.codec.to_links(Stop())
    driven.wire.emulators[0].take(stop, driven.wire.now_ns)
    wait(driven, lambda: not driven.testbed.gate.armed, 0.2)
    assert 'says that it is stopped' in driven.testbed.gate.reason
    assert_coasting(driven)


def test_links_that_somebody_else_stopped_are_released_by_a_reset(world) -> None:
    """As by a host before this one, or where the release was lost."""
    world.wire.send(world.codec.to_links(Stop())[0])
    world.run(0.1)
    assert world.testbed.gate.state is DeviceState.DISARMED
    armed, reason = world.arm()
    assert not armed
    assert 'link_c: its electronics say stopped, call reset_emergency_stop first' in reason
    assert world.testbed.reset() == (
        True, 'link_a, link_b, link_c, link_d: the emergency stop is reset')
    world.run(0.1)
    assert [firmware(world, link).state for link in range(4)] == [LinkState.IDLE] * 4
    assert world.arm() == (True, 'armed')


def test_links_stay_no_longer_stopped_than_until_a_reset_reaches_them(driven) -> None:
    driven.testbed.emergency_stop('test')
    driven.run(0.1)
    driven.wire.broken = True
    driven.testbed.reset()
    with pytest.raises(BusError):
        driven.tick()
    assert driven.testbed.gate.state is DeviceState.FAULT
    driven.wire.broken = False
    driven.testbed.reset()
    driven.run(0.3)
    assert firmware(driven, 0).state is LinkState.STOPPED
    driven.testbed.reset()
    driven.run(0.3)
    assert driven.arm() == (True, 'armed')


def test_flood_of_foreign_frames_does_not_hold_the_host_up(driven) -> None:
    for _ in range(5000):
        driven.wire.inject(Frame(0x7FF, b'?'))
    driven.run(1.0)
    assert driven.testbed.gate.armed


# The table in the file

ROWS = load_safety('prototype')


def write(tmp_path: Path, **changes) -> str:
    values = {row: {'limit': rule.limit, 'lasting': rule.lasting,
                    'reaction': rule.reaction.name.lower()} for row, rule in ROWS.items()}
    for row, change in changes.items():
        if change is None:
            del values[row]
        else:
            values.setdefault(row, {}).update(change)
    path = tmp_path / 'safety.yaml'
    path.write_text(yaml.safe_dump(values))
    return str(path)


def test_limits_and_reactions_may_be_changed(tmp_path: Path) -> None:
    table = load_safety(write(tmp_path, hot={'limit': 50.0, 'reaction': 'coast'}))
    assert (table['hot'].limit, table['hot'].reaction.name) == (50.0, 'COAST')


@pytest.mark.parametrize(('changes', 'words'), [
    ({'hot': None}, 'hot missing'),
    ({'cold': {'limit': 1.0, 'lasting': 0.0, 'reaction': 'warn'}}, 'unknown cold'),
    ({'hot': {'limit': -1.0}}, 'hot: limit must be a number and not negative, got -1.0'),
    ({'hot': {'limit': 'much'}}, "hot: limit must be a number and not negative, got 'much'"),
    ({'hot': {'lasting': float('nan')}}, 'hot: lasting must be a number'),
    ({'hot': {'reaction': 'panic'}}, 'hot: reaction must be one of warn, coast, stop'),
    ({'wheel_silent': {'reaction': 'warn'}},
     'wheel_silent: reaction must be at least coast, got warn'),
])
def test_table_that_means_nothing_is_refused(tmp_path: Path, changes, words: str) -> None:
    with pytest.raises(SafetyError, match=words):
        load_safety(write(tmp_path, **changes))
