# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Runs of scenarios, and their records with the messages of the nodes."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from math import pi

from fourbar_ros.control import WheelCommand
from fourbar_ros.device import LinkSample
from fourbar_ros.loop import (
    ClosedLoop,
    load_scenario,
    record_run,
    run_scenario,
    RunError,
    RunRecord,
    Scenario,
    ScriptedSetpoint,
    Step,
)
import numpy as np
import pytest

HALF_A_DEGREE = pi / 360.0
PERIOD_NS = 4_000_000


@pytest.mark.medium
@pytest.mark.parametrize('name', ['paper', 'prototype'])
def test_preset_completes_its_quarter_turn(name: str) -> None:
    scenario = load_scenario(name)
    found = record_run(scenario).arrays()
    stamps = found['sim/link_states.stamp_ns']
    assert stamps[-1] - stamps[0] == scenario.duration * 1e9
    true, wanted = found['sim/link_states.position'], found['reference.position']
    assert np.abs(true[-1] - true[0] - pi / 2).max() < HALF_A_DEGREE
    # The reference is the estimate before the first command, and missing before the first sample.
    assert np.abs((wanted - true[-len(wanted):])[100:]).max() < HALF_A_DEGREE
    # The peak is the peak rate of the soft step times the inertia of a pair, by two wheels, from
    # the file of the mechanism. Joint friction moves momentum between the pairs of the prototype,
    # so the test takes the mean of all wheels.
    speeds = found['sim/flywheel_states.velocity']
    peak = np.abs(speeds.mean(axis=1)).max()
    assert peak == pytest.approx({'paper': 62.37, 'prototype': 48.0}[name], rel=0.05)
    assert np.abs(speeds).max() < 1.3 * peak
    # The record has NaN for fields that the commands omit.
    given, left_out = ('effort', 'velocity') if name == 'paper' else ('velocity', 'effort')
    driven = found[f'flywheel_command.{given}'][100:]
    assert np.isfinite(driven).all()
    assert np.isnan(found[f'flywheel_command.{left_out}'][100:]).all()


@pytest.mark.slow
@pytest.mark.parametrize('heading', ['link_a', 'link_d'])
def test_prototype_with_joint_encoders_and_one_heading(heading: str) -> None:
    """The estimate of the turn is as accurate with sensors of the other kind."""
    scenario = load_scenario('prototype')
    sensors = replace(scenario.table.link_sensors, kind='joint', heading=heading)
    scenario = replace(scenario, table=replace(scenario.table, link_sensors=sensors))
    recording = record_run(scenario)
    found = recording.arrays()
    true, estimate = found['sim/link_states.position'], found['estimate/link_states.position']
    assert np.abs(true[-1] - true[0] - pi / 2).max() < HALF_A_DEGREE
    # The error is below the noise of one sample.
    assert np.abs((estimate - true[-len(estimate):])[100:]).max() < sensors.noise_rms
    names, table = recording.table()
    innovations = table[:, [names.index(f'innovation_{name}') for name in (
        f'{heading[-1]}', 'joint_1', 'joint_2', 'joint_3', 'joint_4')]]
    assert (~np.isnan(innovations)).mean() > 0.95


def strong_scenario() -> Scenario:
    """Return a scenario with motors strong enough for moves within half a second."""
    scenario = load_scenario('paper')
    strong = replace(scenario.mechanism, motor_torque_limits=np.full(4, 1e-2),
                     motor_speed_limits=np.full(4, 5e4))
    return replace(scenario, mechanism=strong, model=strong)


def test_script_acts_from_the_next_tick_on() -> None:
    scenario = replace(
        strong_scenario(), arm_at=0.1, duration=0.5,
        setpoints=(ScriptedSetpoint(0.199, ('link_a',), (0.1,), 0.2),))
    found = record_run(scenario).arrays()
    commanded = np.flatnonzero(found['flywheel_command.effort'].any(axis=1))
    # The device is armed after tick 25 at 0.1 s, and the next tick has the first torque.
    assert commanded[0] == 26
    moving = np.flatnonzero(found['reference.velocity'].any(axis=1))
    # Tick 50 is the first after 0.199 s, and the move ends after 50 more.
    assert moving[0] == 51
    assert moving[-1] == 99
    assert found['reference.position'][-1, 0] == 0.1


def test_duration_of_a_setpoint_applies_to_no_other_one() -> None:
    base = strong_scenario()
    scenario = replace(
        base, arm_at=0.1, duration=1.0,
        controller=replace(base.controller, setpoint_duration=0.4),
        setpoints=(ScriptedSetpoint(0.2, ('link_a',), (0.05,), 0.1),
                   ScriptedSetpoint(0.4, ('link_a',), (0.1,))))
    moving = record_run(scenario).arrays()['reference.velocity'].any(axis=1)
    assert np.flatnonzero(moving).tolist() == [*range(51, 75), *range(101, 200)]


def test_setpoint_after_the_end_has_no_effect() -> None:
    scenario = replace(load_scenario('paper'), duration=0.2)
    steps = list(run_scenario(scenario))
    assert len(steps) == 51
    assert not any(step.control.torques.any() for step in steps if step.control)


def test_refused_setpoint_ends_the_run_and_names_the_entry(
    refuses: Callable[..., AbstractContextManager[None]],
) -> None:
    scenario = replace(load_scenario('paper'), arm_at=0.1, setpoints=(
        ScriptedSetpoint(0.2, ('link_a',), (0.1,)),
        ScriptedSetpoint(0.3, ('link_a', 'link_c'), (0.1, 0.2))))
    with refuses(RunError, name='setpoints, entry 2', value=0.3):
        list(run_scenario(scenario))


def test_refused_arming_ends_the_run(
    monkeypatch: pytest.MonkeyPatch, refuses: Callable[..., AbstractContextManager[None]],
) -> None:
    monkeypatch.setattr(ClosedLoop, 'arm', lambda _: (False, 'refused: no sample from link_b'))
    with refuses(RunError, name='arm_at', value=0.3):
        list(run_scenario(load_scenario('paper')))


@pytest.mark.medium
@pytest.mark.parametrize('name', ['paper', 'prototype'])
def test_same_seed_same_bytes(name: str) -> None:
    scenario = replace(load_scenario(name), duration=0.6)
    first, again, other = (
        ''.join(record_run(replace(scenario, seed=seed)).lines()) for seed in (7, 7, 8))
    assert first == again
    assert first != other


# The recording

def test_record_has_the_values_of_the_steps() -> None:
    scenario = replace(load_scenario('paper'), duration=0.1)
    steps = list(run_scenario(scenario))
    found = record_run(scenario).arrays()
    wanted: dict[str, list[np.ndarray]] = {  # type: ignore[type-arg]
        'flywheel_states.velocity': [step.samples.wheels.speeds for step in steps],
        'link_angles.position': [step.samples.links[0].angles for step in steps],
        'sim/flywheel_states.position': [
            step.samples.truth.wheel_angles for step in steps if step.samples.truth],
        'estimate/sigma.velocity': [
            step.estimate.rate_sigmas for step in steps if step.estimate],
        'tracking_error.position': [step.control.angle_errors for step in steps if step.control],
        'flywheel_command.effort': [step.control.torques for step in steps if step.control]}
    for name, rows in wanted.items():
        np.testing.assert_array_equal(found[name], rows, err_msg=name)
    # The tick that starts the filter has no innovation.
    assert len(found['estimate/innovation.position']) == len(steps) - 1
    np.testing.assert_array_equal(
        found['estimate/innovation.tick_ns'], found['flywheel_states.stamp_ns'][1:])


def thinned(step: Step, samples: tuple[LinkSample, ...]) -> Step:
    """Return a step with other samples of the links."""
    return replace(step, samples=replace(step.samples, links=samples))


def test_missing_samples_are_missing_in_the_record() -> None:
    """The ticks have no sample, one sample of two links, and two samples of different stamps."""
    scenario = replace(load_scenario('paper'), duration=0.012)
    steps = list(run_scenario(scenario))
    first_ns = steps[0].samples.stamp_ns
    partial = LinkSample(
        first_ns + 3_000_000, ('link_b', 'link_d'), np.array([1.0, 3.0]), np.empty(0))
    newer = LinkSample(first_ns + 5_000_000, ('link_b',), np.array([1.5]), np.empty(0))
    recording = RunRecord()
    recording.add(replace(thinned(steps[0], ()), estimate=None, control=None))
    recording.add(thinned(steps[1], (partial,)))
    recording.add(thinned(steps[2], (partial, newer)))
    names, *lines = (line.rstrip('\n').split(',') for line in recording.lines())
    rows = [dict(zip(names, line)) for line in lines]
    assert [row['t'] for row in rows] == ['0', '0.0040000000000000001', '0.0080000000000000002']
    assert {name for name, text in rows[0].items() if text} == {
        name for name in names if name.startswith(('t', 'flywheel_angle', 'flywheel_speed',
                                                   'flywheel_effort'))}
    measured = [[row[f'measured_link_{link}'] for link in 'abcd'] for row in rows]
    assert measured == [['', '', '', ''], ['', '1', '', '3'], ['', '1.5', '', '3']]
    assert [float(row['measured_at_link_b'] or 'nan') for row in rows[1:]] == [0.003, 0.005]
    assert rows[2]['measured_at_link_a'] == ''
    np.testing.assert_array_equal(
        recording.arrays()['link_angles.tick_ns'] - first_ns,
        [PERIOD_NS, 2 * PERIOD_NS, 2 * PERIOD_NS])


def test_table_reads_back_bit_for_bit() -> None:
    scenario = replace(load_scenario('paper'), duration=0.5)
    recording = record_run(scenario)
    names, table = recording.table()
    header, *lines = recording.lines()
    assert header == ','.join(names) + '\n'
    read = np.array([[float(cell) if cell else np.nan for cell in line.rstrip('\n').split(',')]
                     for line in lines])
    assert read.tobytes() == table.tobytes() or np.array_equal(read, table, equal_nan=True)
    column = names.index('command_c')
    np.testing.assert_array_equal(
        table[:, column], recording.arrays()['flywheel_command.effort'][:, 2])


def test_steps_pass_through_the_progress_display() -> None:
    seen: list[int] = []

    def watch(steps, total):  # type: ignore[no-untyped-def]
        seen.append(total)
        for step in steps:
            seen.append(step.samples.stamp_ns)
            yield step
    recording = record_run(replace(load_scenario('paper'), duration=0.02), watch)
    assert seen == [6, *recording.tick_stamps_ns]


def test_command_of_a_wheel_without_power_is_missing_in_the_record() -> None:
    """The other wheels have a speed command; a disarmed loop commands torques."""
    scenario = replace(load_scenario('prototype'), duration=0.02)
    steps = list(run_scenario(scenario))[-2:]
    values, powered = np.array([1.0, 2.0, 3.0, 4.0]), np.array([True, False, True, True])
    recording = RunRecord(scenario.table.link_sensors.sensor_names)
    for by_speed, step in zip((False, True), steps):
        assert step.control is not None
        recording.add(replace(step, control=step.control._replace(
            command=WheelCommand(values, by_speed, powered))))
    found = recording.arrays()
    left = [1.0, np.nan, 3.0, 4.0]
    np.testing.assert_array_equal(found['flywheel_command.effort'], [left, [np.nan] * 4])
    np.testing.assert_array_equal(found['flywheel_command.velocity'], [[np.nan] * 4, left])
    names, *lines = (line.rstrip('\n').split(',') for line in recording.lines())
    torques, speeds = ([[dict(zip(names, line))[f'{prefix}{link}'] for link in 'abcd']
                        for line in lines] for prefix in ('command_', 'command_speed_'))
    assert torques == [['1', '', '3', '4'], [''] * 4]
    assert speeds == [[''] * 4, ['1', '', '3', '4']]
