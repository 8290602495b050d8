# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Supervisor: commands, arming, timeouts, limits, faults and timing."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from math import exp, nan
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.device import (
    DeviceFault,
    DeviceState,
    DeviceSupervisor,
    Drive,
    Reaction,
    SupervisorSettings,
)
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.mechanism import angular_momentum, LINK_NAMES, Mechanism
from fourbar_ros.plant import Fault, InitialState, Plant, PlantError, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
from hypothesis import example, given, note, settings
from hypothesis import strategies as st
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Operate = Callable[..., Any]

NONE = [0.0, 0.0, 0.0, 0.0]
PERIOD_NS = 4_000_000
LIMIT = 1e-4
NO_SPEED, ALL = np.zeros(4, dtype=bool), np.ones(4, dtype=bool)
OFF = [False] * 4


# Commands

def test_accepted_command_drives_from_the_next_step_on(operate: Operate) -> None:
    bed = operate()
    bed.command(1e-5, -2e-5, 3e-5, -4e-5)
    for _ in range(3):
        bed.tick()
        assert bed.driven == [1e-5, -2e-5, 3e-5, -4e-5]
    assert bed.powered == [True] * 4
    bed.command(5e-5)
    bed.tick()
    assert bed.driven == [5e-5, 0.0, 0.0, 0.0]
    assert bed.powered == [True, False, False, False]


def test_command_of_zero_torque_powers_the_named_wheels(operate: Operate) -> None:
    bed = operate()
    bed.tick()
    assert bed.powered == OFF
    bed.command(0.0, 0.0, names=['flywheel_d', 'flywheel_b'])
    bed.tick()
    assert bed.powered == [False, True, False, True]


def test_torque_beyond_the_limit_is_clipped_and_counted(operate: Operate) -> None:
    bed = operate()
    bed.command(1.0, -1.0, LIMIT, -LIMIT / 2)
    bed.tick()
    assert bed.driven == [LIMIT, -LIMIT, LIMIT, -LIMIT / 2]
    assert bed.supervisor.clipped == 1
    bed.command(LIMIT, -LIMIT)
    assert bed.supervisor.clipped == 1


@pytest.mark.parametrize(('kind', 'fields'), [
    ('names', (['wheel'], [], [], [0.0])),
    ('names', (['flywheel_a'] * 2, [], [], [0.0, 0.0])),
    ('length', (['flywheel_a', 'flywheel_b'], [], [], [0.0])),
    ('length', ([], [], [], [])),
    ('finite', (['flywheel_b', 'flywheel_a'], [], [], [0.0, nan])),
    ('fields', (['flywheel_a'], [], [1.0], [0.0])),
])
def test_rejected_command_changes_only_its_counter(
    kind: str, fields: tuple[Any, ...], operate: Operate,
) -> None:
    bed = operate()
    bed.command(1e-5, 2e-5)
    with pytest.raises(RejectedError) as caught:
        bed.supervisor.command(bed.stamp_ns, *fields, bed.monotonic_ns)
    assert caught.value.kind == kind
    assert bed.supervisor.rejected == Counter({kind: 1})
    assert bed.supervisor.last_rejection == str(caught.value)
    bed.tick()
    assert bed.driven == [1e-5, 2e-5, 0.0, 0.0]
    assert bed.powered == [True, True, False, False]


@pytest.mark.parametrize('ahead_ms', [-101, 1, 1000, -3_600_000])
def test_stale_or_future_stamp_is_rejected(ahead_ms: int, operate: Operate) -> None:
    bed = operate()
    bed.tick(100, monotonic=1)
    with pytest.raises(RejectedError) as caught:
        bed.command(1e-5, ahead_ns=ahead_ms * 1_000_000)
    assert caught.value.kind == 'stale'
    assert f'{abs(ahead_ms) * 1e-3:g} s' in str(caught.value)
    assert bed.supervisor.rejected == Counter(stale=1)
    bed.tick()
    assert bed.driven == NONE


def test_stamp_of_a_recent_tick_is_accepted(operate: Operate) -> None:
    bed = operate()
    bed.tick(100, monotonic=1)
    bed.command(1e-5, ahead_ns=-99_000_000)
    bed.tick()
    assert bed.driven[0] == 1e-5


def test_command_older_than_the_last_one_is_rejected(operate: Operate) -> None:
    bed = operate()
    bed.tick()
    bed.command(1e-5)
    with pytest.raises(RejectedError) as caught:
        bed.command(2e-5, ahead_ns=-PERIOD_NS)
    assert caught.value.kind == 'stale'
    bed.command(3e-5)
    bed.tick()
    assert bed.driven[0] == 3e-5


def test_command_before_the_first_tick_is_rejected(operate: Operate) -> None:
    bed = operate(armed=False)
    with pytest.raises(RejectedError) as caught:
        bed.command(1e-5)
    assert caught.value.kind == 'stale'


# Arming

def test_arming_does_not_restore_the_old_torque(operate: Operate) -> None:
    bed = operate(armed=False)
    bed.tick()
    bed.command(1e-5)
    bed.tick()
    assert bed.driven == NONE
    bed.arm()
    bed.tick()
    assert bed.driven == NONE


def test_arming_again_while_armed_does_not_interrupt(operate: Operate) -> None:
    bed = operate()
    bed.command(1e-5)
    assert bed.arm() == (True, 'already armed')
    bed.tick()
    assert bed.driven[0] == 1e-5


@pytest.mark.parametrize('silent', [(0,), (1, 3), (0, 1, 2, 3)])
def test_arming_needs_every_link_sensor(silent: tuple[int, ...], operate: Operate) -> None:
    bed = operate(armed=False)
    bed.tick()
    bed.device.links = tuple(link for link in range(4) if link not in silent)
    # The samples expire after 0.2 s, which is 50 periods.
    for _ in range(50):
        bed.tick()
    assert bed.arm()[0]
    bed.supervisor.disarm('test')
    bed.tick()
    armed, message = bed.arm()
    assert not armed
    for link, name in enumerate(LINK_NAMES):
        assert (name in message) is (link in silent)
    bed.device.links = (0, 1, 2, 3)
    bed.tick()
    assert bed.arm()[0]


def test_arming_before_the_first_tick_is_refused(operate: Operate) -> None:
    armed, message = operate(armed=False).arm()
    assert not armed
    assert 'link_a, link_b, link_c, link_d' in message


def test_other_arming_blockers_are_reported_too(operate: Operate) -> None:
    bed = operate(armed=False)
    assert 'two publishers' in bed.arm('two publishers')[1]
    bed.tick()
    assert bed.arm('two publishers') == (False, 'refused: two publishers')


@pytest.mark.parametrize('way', ['disarm', 'emergency_stop'])
def test_every_way_out_of_armed_ends_torque_and_power(way: str, operate: Operate) -> None:
    bed = operate()
    bed.command(1e-5)
    bed.tick()
    getattr(bed.supervisor, way)('test')
    bed.tick()
    assert (bed.driven, bed.powered) == (NONE, OFF)
    bed.command(1e-5)
    bed.tick()
    assert (bed.driven, bed.powered) == (NONE, OFF)
    if way == 'emergency_stop':
        assert not bed.arm()[0]
        assert bed.supervisor.reset()[0]
        assert bed.supervisor.arming.state is DeviceState.DISARMED
    assert bed.arm()[0]
    bed.tick()
    assert (bed.driven, bed.powered) == (NONE, OFF)


def test_failing_device_latches_a_fault(operate: Operate) -> None:
    bed = operate()
    bed.command(1e-5)
    bed.device.breaks = True
    with pytest.raises(FourbarError):
        bed.tick()
    bed.device.breaks = False
    assert bed.supervisor.arming.state is DeviceState.FAULT
    assert bed.supervisor.arming.reason == 'the bus is off'
    bed.tick()
    assert (bed.driven, bed.powered) == (NONE, OFF)
    assert not bed.arm()[0]
    bed.supervisor.reset()
    assert bed.arm()[0]
    bed.tick()
    assert bed.driven == NONE


# Calls of the device between steps, and its faults

def test_commands_are_sent_to_the_device_at_once_and_only_while_armed(operate: Operate) -> None:
    bed = operate(armed=False)
    bed.tick()
    bed.command(1e-5)
    assert bed.device.drives == []
    bed.arm()
    bed.device.drives.clear()
    bed.command(2e-5)
    drive, = bed.device.drives
    assert (drive.values[0], drive.powered.tolist()) == (2e-5, [True, False, False, False])


@pytest.mark.parametrize('way', ['disarm', 'emergency_stop', 'watchdog', 'close'])
def test_loss_of_power_is_sent_to_the_device_at_once(way: str, operate: Operate) -> None:
    bed = operate()
    bed.command(1e-5)
    bed.device.drives.clear()
    if way == 'watchdog':
        bed.tick(periods=26)
    elif way == 'close':
        bed.supervisor.close()
    else:
        getattr(bed.supervisor, way)('test')
    assert [drive.powered.any() for drive in bed.device.drives] == [False]
    assert bed.device.states[-1] is bed.supervisor.arming.state is not DeviceState.ARMED
    assert bed.device.closed == (way == 'close')


def test_every_change_of_arming_is_sent_to_the_device_once(operate: Operate) -> None:
    bed = operate()
    bed.supervisor.emergency_stop('test')
    bed.supervisor.emergency_stop('again')
    bed.supervisor.reset()
    bed.supervisor.disarm('test')
    bed.arm()
    assert bed.device.states == [DeviceState.ARMED, DeviceState.EMERGENCY_STOP,
                                 DeviceState.DISARMED, DeviceState.ARMED]


def test_reset_releases_stopped_parts_of_the_device_and_never_while_armed(
    operate: Operate,
) -> None:
    bed = operate()
    assert bed.supervisor.reset() == (True, 'nothing to reset: armed')
    assert bed.device.releases == 0
    bed.supervisor.emergency_stop('test')
    assert bed.supervisor.reset() == (True, 'emergency_stop is reset, disarmed')
    assert bed.device.releases == 1
    assert bed.supervisor.reset() == (True, 'nothing to reset: disarmed')
    bed.device.held = ['link_a', 'link_c']
    assert bed.supervisor.reset() == (True, 'link_a, link_c: the emergency stop is reset')
    assert bed.device.releases == 3


def test_device_error_during_a_command_latches_a_fault(operate: Operate) -> None:
    bed = operate()
    bed.device.breaks = True
    bed.command(1e-5)
    assert (bed.supervisor.arming.state, bed.supervisor.arming.reason) == (
        DeviceState.FAULT, 'the bus is off')


@pytest.mark.parametrize(('reaction', 'state'), [
    (Reaction.WARN, DeviceState.ARMED), (Reaction.COAST, DeviceState.DISARMED),
    (Reaction.STOP, DeviceState.EMERGENCY_STOP)])
def test_fault_of_the_device_has_its_reaction(
    reaction: Reaction, state: DeviceState, operate: Operate,
) -> None:
    bed = operate()
    bed.command(1e-5)
    bed.device.present_faults = [DeviceFault(reaction, 'link_b is hot')]
    bed.tick()
    assert bed.supervisor.arming.state is state
    assert (bed.supervisor.arming.reason == 'link_b is hot') == (state is not DeviceState.ARMED)
    bed.device.present_faults = []
    bed.tick()
    assert bed.powered == (
        [True, False, False, False] if state is DeviceState.ARMED else OFF)


def test_arming_blockers_of_the_device_prevent_arming(
    operate: Operate,
) -> None:
    bed = operate(armed=False)
    bed.tick()
    bed.device.blockers = ['link_c: no heartbeat']
    assert bed.arm() == (False, 'refused: link_c: no heartbeat')


def test_step_without_all_wheels_is_no_tick(operate: Operate) -> None:
    bed = operate()
    bed.command(1e-5)
    answered_ns = bed.stamp_ns
    bed.device.complete = False
    bed.tick()
    with pytest.raises(RejectedError) as caught:
        bed.command(1e-5)
    assert caught.value.kind == 'stale'
    _, timing = bed.tick(periods=3.0)
    assert timing.lost == 0
    bed.supervisor.command(
        answered_ns, ['flywheel_a'], [], [], [2e-5], bed.monotonic_ns)


# Command timeout

def test_device_is_disarmed_after_the_command_timeout(operate: Operate) -> None:
    bed = operate()
    bed.command(1e-5)
    # The command is valid for 0.1 s, which is 25 periods of 4 ms.
    for _ in range(25):
        bed.tick()
        assert bed.driven[0] == 1e-5
    bed.tick()
    assert bed.driven == NONE
    assert bed.supervisor.arming.state is DeviceState.DISARMED
    assert bed.supervisor.arming.reason == 'no flywheel_command for 0.1 s'
    bed.command(1e-5)
    bed.tick()
    assert bed.driven == NONE


@pytest.mark.parametrize(('action', 'powered'), [
    ('coast', False), ('hold_speed', True), ('brake', True)])
def test_wheels_keep_their_power_after_a_timeout_only_if_parked(
    action: str, powered: bool, operate: Operate,
) -> None:
    """All wheels are parked, also those missing in the last command."""
    bed = operate(timeout_action=action)
    bed.command(1e-5)
    for _ in range(25):
        bed.tick()
        assert bed.powered == [True, False, False, False]
    for _ in range(3):
        bed.tick()
        assert bed.supervisor.arming.state is DeviceState.DISARMED
        assert bed.powered == [powered] * 4
    bed.supervisor.emergency_stop('test')
    bed.tick()
    assert bed.powered == OFF


def test_timeout_of_the_first_command_is_the_same(operate: Operate) -> None:
    bed = operate()
    for _ in range(25):
        bed.tick()
    assert bed.supervisor.arming.armed
    bed.tick()
    assert not bed.supervisor.arming.armed


def test_commands_in_time_keep_the_device_armed(operate: Operate) -> None:
    bed = operate()
    for _ in range(200):
        bed.command(1e-5)
        bed.tick()
    assert bed.supervisor.arming.armed


def test_command_timeout_acts_with_frozen_stamps(operate: Operate) -> None:
    bed = operate()
    for _ in range(26):
        bed.tick(periods=1e-6, monotonic=1.0)
    assert not bed.supervisor.arming.armed


def test_command_timeout_does_not_depend_on_fast_stamps(operate: Operate) -> None:
    bed = operate()
    for _ in range(25):
        bed.tick(periods=1000.0, monotonic=1.0)
    assert bed.supervisor.arming.armed


def test_rejected_commands_do_not_restart_the_timeout(operate: Operate) -> None:
    bed = operate()
    for _ in range(26):
        bed.tick()
        with pytest.raises(RejectedError):
            bed.command(nan)
    assert not bed.supervisor.arming.armed
    assert bed.supervisor.rejected == Counter(finite=26)


@pytest.fixture(scope='module')
def uneven() -> Mechanism:
    """Make a linkage whose link rates vary in free motion."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.11, 0.10], [0.02, 0.03, 0.025, 0.018], [2.2e-5, 1.5e-5, 3e-5, 1.8e-5],
        [[0.05, 0.01], [0.04, -0.01], [0.06, 0.005], [0.05, 0.0]], [3e-7, 4e-7, 5e-7, 2e-7],
        [1e-4] * 4, [500.0] * 4)


def left_alone(mechanism: Mechanism, action: str) -> tuple[list[Any], DeviceSupervisor]:
    """
    Spin up the wheels of a moving linkage, then stop the commands.

    :returns: ground truth of the ticks of 1 s after the timeout, and the supervisor.
    """
    plant = Plant(mechanism, Table(LinkSensorSettings(), WheelEncoders(0)),
                  InitialState(0.3, 1.6, 'open', 1.0, 0.6), 5e-4, np.random.default_rng(0))
    testbed = DeviceSupervisor(
        SimulatedTable(plant, PERIOD_NS), SupervisorSettings(timeout_action=action))
    truths = []
    for n in range(320):
        now = (1 + n) * PERIOD_NS
        samples, _ = testbed.tick(now, now)
        if n == 0:
            assert testbed.arm(now, [])[0]
        if n < 40:
            # The last command is zero, so the absolute speeds are constant at the timeout.
            drive = [4e-5, -3e-5] if n < 39 else [0.0, 0.0]
            testbed.command(now, ['flywheel_a', 'flywheel_c'], [], [], drive, now)
        if not testbed.arming.armed and n:
            truths.append(samples.truth)
    assert len(truths) > 250
    return truths, testbed


def momentum(mechanism: Mechanism, truth: Any) -> float:
    return angular_momentum(mechanism, truth.link_angles, truth.link_rates,
                            truth.wheel_speeds + truth.link_rates)


def test_coasting_wheels_keep_their_momentum(uneven: Mechanism) -> None:
    truths, _ = left_alone(uneven, 'coast')
    absolute = np.array([truth.wheel_speeds + truth.link_rates for truth in truths])
    np.testing.assert_allclose(absolute, absolute[0] + np.zeros((len(absolute), 4)), rtol=1e-14)
    assert not any(truth.efforts.any() for truth in truths)


def test_hold_speed_keeps_wheel_speeds_on_links_with_varying_rates(uneven: Mechanism) -> None:
    truths, testbed = left_alone(uneven, 'hold_speed')
    speeds = np.array([truth.wheel_speeds for truth in truths])
    rates = np.array([truth.link_rates for truth in truths])
    # The loop with two poles at 30 rad/s has a smaller error for slow accelerations than a
    # proportional loop with a bandwidth of 60 rad/s, whose error is acceleration / 60.
    bound = np.abs(np.diff(rates, axis=0)).max() / 4e-3 / 60.0
    assert np.abs(speeds - speeds[0]).max() < bound
    # Without the loop the wheel speeds would vary as the link rates do.
    assert np.abs(rates - rates[0]).max() > 5.0 * bound
    assert testbed.arming.state is DeviceState.DISARMED
    assert momentum(uneven, truths[-1]) == pytest.approx(momentum(uneven, truths[0]), rel=1e-11)


def test_brake_brings_the_wheels_to_rest(uneven: Mechanism) -> None:
    still = replace(uneven, link_lengths=np.array([0.1, 0.1, 0.1, 0.1]),
                    com_positions=np.array([[0.05, 0.0]] * 4),
                    link_masses=np.full(4, 0.02), link_inertias=np.full(4, 2.2e-5))
    truths, testbed = left_alone(still, 'brake')
    speeds = np.array([truth.wheel_speeds for truth in truths])
    # With 2e-7 kg m^2 or more, 1e-4 N m reduces the speed by 20 rad/s in 0.1 s. In the other
    # 0.9 s the speed decays at 20 /s or more; the loop has 30 /s. A rhombus has constant rates.
    assert np.abs(speeds[0]).max() > 10.0
    assert np.abs(speeds[-1]).max() < np.abs(speeds[0]).max() * exp(-20.0 * 0.9)
    assert testbed.arming.state is DeviceState.DISARMED
    # The links have all momentum.
    assert momentum(still, truths[-1]) == pytest.approx(momentum(still, truths[0]), rel=1e-11)


@pytest.mark.parametrize('way', ['disarm', 'emergency_stop', 'fault', 'fault, then reset', 'arm'])
def test_parking_ends_with_any_request(way: str, operate: Operate) -> None:
    bed = operate(timeout_action='brake')
    for _ in range(30):
        bed.tick()
    assert any(bed.driven)
    if way == 'arm':
        assert bed.arm()[0]
    elif way.startswith('fault'):
        bed.device.breaks = True
        with pytest.raises(FourbarError):
            bed.tick()
        bed.device.breaks = False
        if way != 'fault':
            bed.supervisor.reset()
    else:
        getattr(bed.supervisor, way)('test')
    bed.device.speeds = np.full(4, 50.0)
    bed.tick()
    bed.tick()
    assert bed.driven == NONE


def test_parking_respects_the_torque_limit(operate: Operate) -> None:
    bed = operate(timeout_action='brake')
    bed.device.speeds = np.full(4, 400.0)
    for _ in range(40):
        bed.tick()
        assert np.abs(bed.driven).max() <= LIMIT
    assert np.abs(bed.driven).max() == LIMIT


# Random sequences

ticks = st.tuples(st.just('tick'), st.sampled_from([1.0, 1.0, 30.0]))
commands = st.tuples(st.just('command'), st.lists(
    st.sampled_from([0.0, 5e-5, -1e-4, 1.0, nan]), min_size=0, max_size=4))
others = st.sampled_from(
    ['arm', 'arm', 'fail', 'fail', 'reset', 'disarm', 'stop', 'silence', 'old command'])


@pytest.mark.slow
@settings(deadline=None, max_examples=400, derandomize=True)
@example(action='hold_speed', events=[('tick', 30.0), ('disarm', None), ('tick', 1.0)])
@given(
    action=st.sampled_from(['coast', 'hold_speed', 'brake']),
    events=st.lists(st.one_of(ticks, ticks, commands, others.map(lambda name: (name, None))),
                    max_size=60))
def test_wheels_are_driven_only_when_allowed_and_within_limits(
    action: str, events: list[tuple[str, Any]], operate: Operate,
) -> None:
    """
    Check that wheels have torque only while armed or parked, and within the limits.

    An armed device powers the wheels of the last command since arming, a parked one all wheels.
    """
    bed = operate(timeout_action=action)
    arming = bed.supervisor.arming
    named = 0
    for name, value in events:
        before = arming.state
        if name == 'tick':
            try:
                bed.tick(value)
            except FourbarError:
                bed.device.breaks = False
            torques = np.abs(bed.driven)
            assert torques.max() <= LIMIT
            state, reason = bed.device.arming_then
            parking = (action != 'coast' and state is DeviceState.DISARMED
                       and reason.startswith('no flywheel_command'))
            if torques.any():
                note(f'{state} {reason}')
                assert (state is DeviceState.ARMED and named) or parking
            live = 4 if parking else named if state is DeviceState.ARMED else 0
            assert bed.powered == [wheel < live for wheel in range(4)], f'{state} {reason}'
        elif name == 'command':
            try:
                bed.command(*value)
                named = len(value)
            except RejectedError:
                pass
        elif name == 'old command':
            with pytest.raises(RejectedError):
                bed.command(1e-5, ahead_ns=-10 ** 12)
        elif name == 'arm':
            if bed.arm()[0] and before is not DeviceState.ARMED:
                named = 0
        elif name == 'disarm':
            bed.supervisor.disarm('test')
        elif name == 'stop':
            bed.supervisor.emergency_stop('test')
        elif name == 'reset':
            bed.supervisor.reset()
        elif name == 'fail':
            bed.device.breaks = True
        elif name == 'silence':
            bed.device.links = (0, 1)


# Timing

def test_timing_is_unknown_before_the_first_answer(operate: Operate) -> None:
    bed = operate(armed=False)
    for _ in range(3):
        _, timing = bed.tick()
        assert (timing.round_trip_s, timing.command_age_s, timing.lost) == (None, None, 0)


def test_round_trip_and_age_are_on_the_monotonic_clock(operate: Operate) -> None:
    bed = operate()
    bed.tick()
    bed.monotonic_ns += 700_000
    bed.command(0.0)
    _, timing = bed.tick()
    assert timing.round_trip_s == pytest.approx(0.7e-3, rel=1e-12)
    assert timing.command_age_s == pytest.approx(4e-3, rel=1e-12)
    assert timing.step_s == pytest.approx(1e-6, rel=1e-12)
    _, timing = bed.tick()
    assert timing.round_trip_s is None
    assert timing.command_age_s == pytest.approx(8e-3, rel=1e-12)


def test_only_the_first_answer_counts_as_the_round_trip(operate: Operate) -> None:
    bed = operate()
    bed.tick()
    bed.monotonic_ns += 700_000
    bed.command(0.0)
    bed.monotonic_ns += 700_000
    bed.command(0.0)
    _, timing = bed.tick()
    assert timing.round_trip_s == pytest.approx(0.7e-3, rel=1e-12)


@settings(deadline=None, derandomize=True)
@given(delays=st.lists(
    st.one_of(st.none(), st.integers(0, 4_000_000), st.integers(4_000_001, 12_000_000)),
    max_size=20))
def test_ticks_without_an_answer_within_one_period_are_lost(
    delays: list[int | None], operate: Operate,
) -> None:
    """The first tick is answered at once, the others after a delay [ns] or never (None)."""
    bed = operate()
    answers = [(n * PERIOD_NS + delay, n) for n, delay in enumerate([0, *delays])
               if delay is not None]
    start, first = bed.monotonic_ns, bed.stamp_ns
    for n in range(len(delays) + 4):
        if n:
            bed.monotonic_ns = start + (n - 1) * PERIOD_NS
            _, timing = bed.tick()
        for due, answered in sorted(answers):
            if n * PERIOD_NS <= due < (n + 1) * PERIOD_NS:
                bed.monotonic_ns = start + due
                try:
                    bed.command(0.0, ahead_ns=first + answered * PERIOD_NS - bed.stamp_ns)
                except RejectedError:
                    # A newer answer has arrived, so this one is more than a period late.
                    pass
        bed.monotonic_ns = start + n * PERIOD_NS
        if n == len(delays) + 3:
            # The ticks after the last delay have no answer yet; one of them counts as lost.
            late = sum(delay is None or delay > PERIOD_NS for delay in delays)
            assert timing.lost == late + 1


def test_rejected_command_is_no_answer(operate: Operate) -> None:
    bed = operate()
    bed.command(0.0)
    bed.tick()
    with pytest.raises(RejectedError):
        bed.command(nan)
    bed.tick()
    _, timing = bed.tick()
    assert timing.lost == 1
    assert timing.round_trip_s is None


# The simulated table as a device

def test_wheel_speeds_are_what_the_encoders_moved(paper: Mechanism) -> None:
    plant = Plant(paper, Table(LinkSensorSettings(), WheelEncoders(4096)), InitialState(), 5e-4,
                  np.random.default_rng(0))
    table = SimulatedTable(plant, PERIOD_NS)
    before = table.step(0, Drive(np.zeros(4), NO_SPEED, ALL))
    for n in range(1, 20):
        # Every third tick is two periods late.
        stamp = before.stamp_ns + PERIOD_NS * (3 if n % 3 == 0 else 1)
        now = table.step(stamp, Drive(np.full(4, 5e-5), NO_SPEED, ALL))
        moved = (now.wheels.angles - before.wheels.angles) / ((stamp - before.stamp_ns) * 1e-9)
        np.testing.assert_allclose(now.wheels.speeds, moved, rtol=1e-12)
        before = now
    # The torque is constant, so the speeds show the elapsed time.
    expected = 5e-5 / paper.flywheel_inertias * before.stamp_ns * 1e-9
    truth = before.truth
    assert truth is not None
    np.testing.assert_allclose(truth.wheel_speeds + truth.link_rates, expected, rtol=1e-11)


@pytest.mark.parametrize(('kind', 'cut'), [('runaway', True), ('shorted', False)])
def test_torque_of_faulty_motors_while_disarmed(
    kind: str, cut: bool, paper: Mechanism,
) -> None:
    """A runaway needs power and a short circuit does not."""
    plant = Plant(paper, Table(LinkSensorSettings(), WheelEncoders(0)), InitialState(), 5e-4,
                  np.random.default_rng(0))
    table = SimulatedTable(plant, PERIOD_NS)
    table.break_down('flywheel_b', Fault('flywheel_b', kind, 5e-5))
    testbed = DeviceSupervisor(table, SupervisorSettings())
    now = 0

    def efforts(wheels: str = '') -> list[float]:
        """Command some wheels or none, and return the efforts."""
        nonlocal now
        if wheels:
            names = [f'flywheel_{letter}' for letter in wheels]
            testbed.command(now, names, [], [], [1e-5] * len(names), now)
        now += PERIOD_NS
        samples, _ = testbed.tick(now, now)
        given: list[float] = samples.wheels.efforts.tolist()
        return given

    idle = pytest.approx([0.0, 0.0 if cut else 5e-5, 0.0, 0.0], rel=1e-12)
    efforts()
    assert efforts() == idle
    assert efforts('abcd') == idle
    assert testbed.arm(now, [])[0]
    assert efforts() == idle
    assert efforts('abcd') == pytest.approx([1e-5, 5e-5, 1e-5, 1e-5], rel=1e-12)
    assert efforts('acd') == pytest.approx([1e-5, 0.0 if cut else 5e-5, 1e-5, 1e-5], rel=1e-12)
    assert efforts('b') == pytest.approx([0.0, 5e-5, 0.0, 0.0], rel=1e-12)
    testbed.disarm('test')
    assert efforts() == idle
    testbed.arm(now, [])
    efforts('abcd')
    testbed.emergency_stop('test')
    assert efforts('abcd') == idle


def test_period_that_is_no_multiple_of_the_step_is_refused(paper: Mechanism) -> None:
    plant = Plant(paper, Table(LinkSensorSettings(), WheelEncoders(0)), InitialState(), 3e-4,
                  np.random.default_rng(0))
    with pytest.raises(PlantError) as caught:
        SimulatedTable(plant, PERIOD_NS)
    assert '0.0003' in str(caught.value)


def test_late_answer_counts_once_as_lost_and_has_its_round_trip(operate: Operate) -> None:
    """The answer is two periods late; its round trip is reported."""
    bed = operate()
    bed.tick()
    bed.command(0.0)
    asked_ns = bed.stamp_ns
    for _ in range(3):
        bed.tick()
        bed.command(0.0, ahead_ns=asked_ns - bed.stamp_ns)
    _, timing = bed.tick()
    # Three ticks are unanswered, two of them for more than a period.
    assert timing.lost == 2
    late_ns = bed.stamp_ns - 2 * PERIOD_NS
    bed.command(0.0, ahead_ns=late_ns - bed.stamp_ns)
    _, timing = bed.tick()
    assert timing.round_trip_s == pytest.approx(2 * PERIOD_NS * 1e-9, rel=1e-12)
    assert timing.lost == 3
