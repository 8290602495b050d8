# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated table as a device: timing of its samples, and effects of its faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from fourbar_ros.device import Drive, Samples
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.mechanism import FLYWHEEL_NAMES, load_mechanism, Mechanism
from fourbar_ros.plant import (
    Fault,
    FaultError,
    InitialState,
    LinkSensorSettings,
    load_table,
    parse_fault,
    Plant,
    Table,
)
from fourbar_ros.plant.table import Surface, WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Make = Callable[..., SimulatedTable]

MS = 1_000_000
PERIOD_NS = 4 * MS
FIRST_NS = 1_000_000_000
NO_SPEED, ALL = np.zeros(4, dtype=bool), np.ones(4, dtype=bool)
PUSH = np.array([2e-3, -1e-3, 1.5e-3, 3e-3])


@pytest.fixture(scope='module')
def ideal() -> Mechanism:
    """Return the linkage of the prototype with motors without lag and windings."""
    return replace(
        load_mechanism('prototype'), motor_time_constants=np.zeros(4),
        motor_torque_constants=np.full(4, np.inf), motor_resistances=np.zeros(4),
        motor_voltages=np.full(4, np.inf))


@pytest.fixture(scope='module')
def make(ideal: Mechanism) -> Make:
    """Return a function that makes a table without errors except for given ones."""
    def made(period_ns: int = PERIOD_NS, initial: InitialState | None = None,
             **sensors: object) -> SimulatedTable:
        table = Table(LinkSensorSettings(**sensors), WheelEncoders(0))  # type: ignore[arg-type]
        return SimulatedTable(Plant(
            ideal, table, initial or InitialState(0.2, 1.3, 'open', 0.5, -0.8), 5e-4,
            np.random.default_rng(0)), period_ns)
    return made


def run(table: SimulatedTable, ticks: int, torques: Array = PUSH, first: int = 0
        ) -> list[Samples]:
    return [table.step(FIRST_NS + n * table.period_ns, Drive(torques, NO_SPEED, ALL))
            for n in range(first, first + ticks)]


def truths(make: Make) -> dict[int, Array]:
    """Return the true link angles at every millisecond of the same motion."""
    return {sample.stamp_ns: sample.truth.link_angles
            for sample in run(make(MS), 200) if sample.truth}


def assert_true(samples: list[Samples], truth: dict[int, Array]) -> None:
    """Check that every sample is the true value at its stamp."""
    for sample in samples:
        for reading in sample.links:
            np.testing.assert_allclose(
                reading.angles, truth[reading.stamp_ns], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(('latency_ms', 'ticks_later'), [(0, 0), (1, 1), (4, 1), (5, 2), (8, 2)])
def test_sample_arrives_at_the_first_tick_after_its_latency(
    latency_ms: int, ticks_later: int, make: Make,
) -> None:
    samples = run(make(latency=latency_ms * 1e-3), 30)
    assert_true(samples, truths(make))
    for n, sample in enumerate(samples):
        stamps = [reading.stamp_ns for reading in sample.links]
        assert stamps == ([FIRST_NS + (n - ticks_later) * PERIOD_NS] if n >= ticks_later else [])


@pytest.mark.parametrize(('rate', 'first_offsets_ms'), [
    (1000.0, [[0], [1, 2, 3, 4], [5, 6, 7, 8]]), (500.0, [[0], [2, 4], [6, 8]]),
    (125.0, [[0], [], [8], []]), (250.0, [[0], [4], [8]])])
def test_sensors_have_their_own_rate(
    rate: float, first_offsets_ms: list[list[int]], make: Make,
) -> None:
    """The rate is above, at and below the rate of ticks; stamps are times of measurement."""
    samples = run(make(rate=rate), 40)
    assert_true(samples, truths(make))
    offsets = [[(reading.stamp_ns - FIRST_NS) // MS for reading in sample.links]
               for sample in samples]
    assert offsets[:len(first_offsets_ms)] == first_offsets_ms
    assert sum(map(len, offsets)) == 1 + int(rate * 39 * 4e-3 + 1e-9)


def test_joint_sensors_measure_relative_angles_and_one_heading(make: Make) -> None:
    table = make(kind='joint', heading='link_c')
    assert table.sensor_names == ('joint_1', 'joint_2', 'joint_3', 'joint_4', 'link_c')
    for sample in run(table, 5):
        (reading,), truth = sample.links, sample.truth
        assert truth is not None
        a, b, c, d = truth.link_angles
        assert reading.names == table.sensor_names
        np.testing.assert_allclose(reading.angles, [b - a, c - b, d - c, a - d, c], atol=1e-12)


def gains(table: SimulatedTable, ticks: int = 25, torques: Array = PUSH) -> Array:
    """Return the speeds of initially resting wheels after some ticks, with the recoil (4,)."""
    *_, last = run(table, ticks + 1, torques)
    assert last.truth is not None
    return last.truth.wheel_speeds + last.truth.link_rates


@pytest.mark.parametrize(('text', 'share'), [
    ('dead', 0.0), ('weak 0.25', 0.25), ('weak 1', 1.0), ('none', 1.0)])
def test_weak_motor_gives_a_share_of_its_torque(text: str, share: float, make: Make) -> None:
    table = make(initial=InitialState())
    table.break_down('flywheel_b', parse_fault('flywheel_b', text))
    shares = np.array([1.0, share, 1.0, 1.0])
    np.testing.assert_allclose(gains(table), shares * PUSH / 1.2e-4 * 0.1, rtol=1e-9)


def test_runaway_torque_is_at_most_the_limit(make: Make) -> None:
    for torque, expected in ((3e-3, 3e-3), (-10.0, -0.05)):
        table = make(initial=InitialState())
        table.break_down('flywheel_d', Fault('flywheel_d', 'runaway', torque))
        speeds = gains(table, torques=np.zeros(4))
        assert speeds[3] == pytest.approx(expected / 1.2e-4 * 0.1, rel=1e-9)
        assert not speeds[:3].any()


@pytest.mark.parametrize(('kind', 'cut'), [('runaway', True), ('shorted', False)])
def test_power_of_one_wheel_is_cut_and_comes_back(kind: str, cut: bool, make: Make) -> None:
    """Without power, commands and a runaway give no torque; a short circuit does."""
    table = make()
    table.break_down('flywheel_d', Fault('flywheel_d', kind, 4e-3))
    rng = np.random.default_rng(7)
    table.step(FIRST_NS, Drive(PUSH, NO_SPEED, ALL))
    for n in range(1, 60):
        powered = rng.random(4) < 0.5
        sample = table.step(FIRST_NS + n * PERIOD_NS, Drive(PUSH, NO_SPEED, powered))
        expected = np.where(powered, PUSH, 0.0)
        expected[3] = 4e-3 if powered[3] or not cut else 0.0
        np.testing.assert_allclose(
            sample.wheels.efforts, expected, rtol=1e-12, err_msg=f'seed 7, tick {n}')


def test_stuck_wheel_turns_with_its_link_up_to_the_fault_torque(make: Make) -> None:
    table = make(initial=InitialState())
    table.break_down('flywheel_a', Fault('flywheel_a', 'stuck', 5e-3))
    for torque, sticks in ((4e-3, True), (6e-3, False)):
        *_, last = run(table, 50, np.array([torque, 0.0, 0.0, 0.0]), first=0 if sticks else 50)
        assert last.truth is not None
        assert bool(abs(last.truth.wheel_speeds[0]) < 1e-3) is sticks
        assert last.wheels.efforts[0] == pytest.approx(torque)


def test_torque_of_a_dragging_wheel_is_reduced_by_the_drag(make: Make) -> None:
    table = make(initial=InitialState())
    table.break_down('flywheel_c', Fault('flywheel_c', 'dragging', 5e-4))
    expected = (PUSH - [0.0, 0.0, 5e-4, 0.0]) / 1.2e-4 * 0.1
    np.testing.assert_allclose(gains(table), expected, rtol=2e-3)


@pytest.mark.parametrize('delay_ms', [0.5, 4.0, 10.0, 50.0])
def test_delayed_motor_follows_earlier_commands(delay_ms: float, make: Make) -> None:
    """The command changes every tick; the delay is exact to the step of 0.5 ms."""
    table = make()
    delay = round(delay_ms / 0.5)
    table.break_down('flywheel_c', Fault('flywheel_c', 'delayed', delay_ms * 1e-3))
    asked = np.random.default_rng(2).uniform(-3e-3, 3e-3, (40, 4))
    wanted = np.concatenate([np.zeros(delay), np.repeat(asked[:, 2], 8)])
    table.step(FIRST_NS, Drive(np.zeros(4), NO_SPEED, ALL))
    for n, torques in enumerate(asked):
        sample = table.step(FIRST_NS + (n + 1) * PERIOD_NS, Drive(torques, NO_SPEED, ALL))
        expected = torques.copy()
        expected[2] = wanted[8 * n:8 * n + 8].mean()
        np.testing.assert_allclose(sample.wheels.efforts, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize('delay_ms', [0.5, 10.0, 50.0])
def test_delayed_motor_is_cut_at_once(delay_ms: float, make: Make) -> None:
    """Power returns at once too, and the commands of the motor stay delayed."""
    table = make()
    delay = round(delay_ms / 0.5)
    table.break_down('flywheel_c', Fault('flywheel_c', 'delayed', delay_ms * 1e-3))
    rng = np.random.default_rng(5)
    powered = rng.random((60, 4)) < 0.7
    asked = np.where(powered, rng.uniform(-3e-3, 3e-3, (60, 4)), 0.0)
    wanted = np.concatenate([np.zeros(delay), np.repeat(asked[:, 2], 8)])
    table.step(FIRST_NS, Drive(np.zeros(4), NO_SPEED, ALL))
    for n in range(60):
        sample = table.step(
            FIRST_NS + (n + 1) * PERIOD_NS, Drive(asked[n], NO_SPEED, powered[n]))
        expected = asked[n].copy()
        expected[2] = wanted[8 * n:8 * n + 8].mean() if powered[n, 2] else 0.0
        np.testing.assert_allclose(sample.wheels.efforts, expected, rtol=1e-12, atol=1e-15,
                                   err_msg=f'seed 5, period {n}')


def test_delay_fault_during_a_run_repeats_earlier_commands(make: Make) -> None:
    """The motor follows again commands that it has already followed."""
    table = make()
    asked = np.arange(1.0, 41.0)[:, None] * 1e-4 * np.ones(4)
    for n, torques in enumerate(asked):
        if n == 20:
            table.break_down('flywheel_a', Fault('flywheel_a', 'delayed', 0.02))
        sample = table.step(FIRST_NS + n * PERIOD_NS, Drive(torques, NO_SPEED, ALL))
        if n:
            assert sample.wheels.efforts[0] == pytest.approx(
                torques[0] if n < 20 else asked[n - 5, 0], rel=1e-12)


def test_speed_commands_reach_the_motors(make: Make) -> None:
    table = make(initial=InitialState())
    mixed = Drive(np.array([20.0, 0.0, 1e-3, -10.0]), np.array([True, False, False, True]), ALL)
    for n in range(200):
        sample = table.step(FIRST_NS + n * PERIOD_NS, mixed)
    assert sample.truth is not None
    np.testing.assert_allclose(sample.truth.wheel_speeds[[0, 3]], [20.0, -10.0], atol=1e-2)
    assert sample.wheels.efforts[1] == 0.0
    assert sample.wheels.efforts[2] == pytest.approx(1e-3)


def test_wheel_that_follows_a_speed_coasts_while_it_is_cut(make: Make) -> None:
    """With power again the speed loop starts from the present speed."""
    table = make(initial=InitialState())
    wanted, only_b = np.array([20.0, 0.0, 0.0, -10.0]), np.array([False, True, False, False])
    for n in range(300):
        cut = 100 <= n < 200
        sample = table.step(FIRST_NS + n * PERIOD_NS, Drive(
            -wanted if cut else wanted, ALL, only_b if cut else ALL))
        assert sample.truth is not None
        if cut:
            assert not sample.wheels.efforts[[0, 2, 3]].any()
    np.testing.assert_allclose(sample.truth.wheel_speeds, wanted, atol=1e-2)


def test_scheduled_faults_begin_and_end_on_time(make: Make) -> None:
    table = make(initial=InitialState())
    table.schedule_faults([
        {'at': 0.04, 'until': 0.08, 'target': 'link_b', 'fault': 'off'},
        {'at': 0.06, 'target': 'flywheel_a', 'fault': 'dead'}], 'faults.yaml')
    for n, sample in enumerate(run(table, 40)):
        missing = 'link_b' not in sample.links[0].names
        assert missing is (10 <= n < 20), f'tick {n}'
        # A fault at a tick acts on the period that begins with this tick.
        assert bool(sample.wheels.efforts[0] == 0.0) is (n == 0 or n > 15), f'tick {n}'
    with pytest.raises(FaultError) as caught:
        table.schedule_faults(
            [{'at': 0.1, 'target': 'link_a', 'fault': 'off'}], 'faults.yaml')
    assert str(caught.value).startswith('faults.yaml, entry 1: at 0.1 s ')


@pytest.mark.parametrize('target', ['joint_1', 'flywheel_e', 'link_x'])
def test_fault_of_an_unknown_target_is_refused(target: str, make: Make) -> None:
    table = make()
    with pytest.raises(FaultError) as caught:
        table.break_down(target, None)
    assert target in str(caught.value)


def test_reset_sets_the_state_and_keeps_time_and_faults(make: Make) -> None:
    table = make()
    table.break_down('link_a', Fault('link_a', 'off'))
    run(table, 10)
    table.reset(InitialState(1.0, 2.0))
    sample, = run(table, 1, np.zeros(4), first=10)
    assert sample.links[0].names == ('link_b', 'link_c', 'link_d')
    assert sample.links[0].angles[0] == pytest.approx(2.0, abs=1e-9)
    np.testing.assert_allclose(sample.wheels.speeds, 0.0, atol=1e-9)


def test_prototype_with_all_effects_is_reproducible() -> None:
    """The same seed gives the same bytes, another seed gives others."""
    def record(seed: int) -> bytes:
        table = SimulatedTable(Plant(
            load_mechanism('prototype'), load_table('prototype'), InitialState(), 5e-4,
            np.random.default_rng(seed)), PERIOD_NS)
        out = []
        for sample in run(table, 100):
            out += [sample.wheels.angles, sample.wheels.efforts]
            out += [reading.angles for reading in sample.links]
        return np.concatenate(out).tobytes()
    assert record(3) == record(3)
    assert record(3) != record(4)


def test_wheels_are_named_as_in_the_topics(make: Make) -> None:
    assert make().injected_faults.targets[-4:] == FLYWHEEL_NAMES


def test_faults_are_reported_by_name(make: Make) -> None:
    table = make()
    assert table.diagnostics() == {}
    table.break_down('link_b', Fault('link_b', 'wrong', 0.25))
    table.break_down('flywheel_a', Fault('flywheel_a', 'dead'))
    assert table.diagnostics() == {'faults': 'link_b wrong 0.25, flywheel_a dead'}
    table.break_down('link_b', None)
    assert table.diagnostics() == {'faults': 'flywheel_a dead'}


def test_contact_with_the_edge_is_reported(ideal: Mechanism) -> None:
    plant = Plant(ideal, Table(LinkSensorSettings(), WheelEncoders(0), surface=Surface(
        tilt_x=0.05, size_x=0.7)), InitialState(), 5e-4, np.random.default_rng(0))
    table = SimulatedTable(plant, PERIOD_NS)
    for n in range(400):
        if 'edge' in table.diagnostics():
            break
        table.step(FIRST_NS + n * PERIOD_NS, Drive(np.zeros(4), NO_SPEED, ALL))
    assert table.diagnostics()['edge'].startswith('the linkage has met the edge of the table, ')
    table.reset(InitialState())
    assert table.diagnostics() == {}
