# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Wheel faults during a manoeuvre: isolation, and completion with the other wheels."""

from dataclasses import dataclass, field, replace
from math import inf, pi

from fourbar_ros.loop.run import make_loop, run_scenario
from fourbar_ros.loop.scenario import load_scenario, Scenario
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
from fourbar_ros.plant import Fault
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
PERIOD_S = 4e-3
COMMANDS = ('velocity', pytest.param('effort', marks=pytest.mark.slow))

# Largest angle errors after a wheel fault, at the end and on the way.
LARGEST_FINAL_ERROR, LARGEST_TRANSIENT = 0.2, 3.0   # deg
# Speed error at which a wheel is reported [rad/s], and longest detection delay [s].
UNFOLLOWED, NAMED_WITHIN = 4.0, 1.0
# Detection delay of a degraded wheel [s], from the time at which it gave this torque [N m].
DEGRADED_WITHIN, EFFORT = 3.0, 2e-3


@dataclass
class Story:
    """
    The events after a fault; times are relative to the fault [s], errors in degrees.

    :param named: time of each decision, by wheel and fault.
    :param unfollowed: time at which the speed error of each wheel reached `UNFOLLOWED`.
    :param strained: time at which each wheel gave `EFFORT`, on the mean of a quarter of a second.
    """

    named: dict[str, dict[str, float]] = field(default_factory=dict)
    unfollowed: dict[str, float] = field(default_factory=dict)
    strained: dict[str, float] = field(default_factory=dict)
    transient: float = 0.0
    final: float = inf
    off_b: float = 0.0
    mode: str = ''
    problem: str = ''
    powered: Array = field(default_factory=lambda: np.ones(4))
    cut_after: float = inf


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    return replace(load_scenario('prototype'), duration=12.0)


def run(scenario: Scenario, command: str, at: float, *faults: Fault) -> Story:
    """Inject wheel faults during a quarter turn of the whole, and return the events."""
    loop = make_loop(replace(scenario, controller=replace(scenario.controller, command=command)))
    story, asked, before = Story(), np.zeros(4), np.zeros(4)
    efforts, inertias = np.zeros(4), scenario.model.flywheel_inertias
    goal = np.array(scenario.setpoints[-1].positions)
    for tick, step in enumerate(run_scenario(scenario, loop)):
        since = tick * PERIOD_S - at
        if tick == round(at / PERIOD_S):
            for fault in faults:
                loop.supervisor.device.break_down(fault.target, fault)
        truth, control = step.samples.truth, step.control
        assert truth is not None
        if control is None:
            continue
        if since <= 0.0:
            before = truth.wheel_speeds
            continue
        off = np.degrees(control.reference_angles - truth.link_angles)
        story.transient = max(story.transient, float(np.abs(off).max()))
        story.off_b = max(story.off_b, abs(float(off[1])))
        asked += control.torques / inertias * PERIOD_S
        efforts += 0.016 * (truth.efforts - efforts)
        for wheel, name in enumerate(FLYWHEEL_NAMES):
            if abs(asked[wheel] - (truth.wheel_speeds - before)[wheel]) >= UNFOLLOWED:
                story.unfollowed.setdefault(name, since)
            if abs(efforts[wheel]) > EFFORT:
                story.strained.setdefault(name, since)
        for name, decision in loop.controller.wheels.faults().items():
            story.named.setdefault(name, {}).setdefault(decision, since)
        if not control.command.powered.all():
            story.cut_after = min(story.cut_after, since)
        story.final = float(np.degrees(np.abs(truth.link_angles[:2] - goal).max()))
        story.powered = control.command.powered
    story.mode, story.problem = loop.controller.mode, loop.controller.problem
    return story


def only(story: Story, wheel: str) -> None:
    assert set(story.named) == {wheel}


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
@pytest.mark.parametrize(('wheel', 'kind', 'at'), [
    (0, 'dead', 2.4), (3, 'dead', 6.4), (1, 'stuck', 3.0), (2, 'stuck', 5.4)])
def test_faulty_wheel_is_isolated_and_the_others_finish(
    wheel: int, kind: str, at: float, command: str, scenario: Scenario,
) -> None:
    name = FLYWHEEL_NAMES[wheel]
    story = run(scenario, command, at, Fault(name, kind))
    only(story, name)
    assert story.named[name][kind] <= story.unfollowed[name] + NAMED_WITHIN
    assert story.transient <= LARGEST_TRANSIENT
    assert story.final <= LARGEST_FINAL_ERROR
    np.testing.assert_array_equal(story.powered, np.arange(4) != wheel)


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
@pytest.mark.parametrize(('wheel', 'kind', 'value', 'at'), [
    (1, 'weak', None, 3.0), (2, 'dragging', None, 3.4), (0, 'delayed', None, 2.4)])
def test_degraded_wheel_is_isolated_and_keeps_its_power(
    wheel: int, kind: str, value: float | None, at: float, command: str, scenario: Scenario,
) -> None:
    name = FLYWHEEL_NAMES[wheel]
    story = run(scenario, command, at, Fault(name, kind, value))
    only(story, name)
    assert set(story.named[name]) == {'degraded'}
    assert story.named[name]['degraded'] <= story.strained[name] + DEGRADED_WITHIN
    assert story.transient <= LARGEST_TRANSIENT
    assert story.final <= LARGEST_FINAL_ERROR
    assert story.powered.all()


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
@pytest.mark.parametrize('at', [2.4, 6.4])
def test_runaway_wheel_is_cut_within_0_2_s(at: float, command: str, scenario: Scenario) -> None:
    story = run(scenario, command, at, Fault('flywheel_c', 'runaway'))
    only(story, 'flywheel_c')
    assert set(story.named['flywheel_c']) == {'runaway'}
    assert story.cut_after <= 0.2
    assert story.transient <= LARGEST_TRANSIENT
    assert story.final <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
def test_shorted_wheel_stops_the_manoeuvre(
    command: str, scenario: Scenario,
) -> None:
    story = run(scenario, command, 3.0, Fault('flywheel_d', 'shorted'))
    assert story.named['flywheel_d']['shorted'] < 0.5
    assert story.mode == 'damp'
    for part in ('flywheel_d', 'power cannot be cut', 'press the emergency stop'):
        assert part in story.problem


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
def test_one_wheel_of_each_pair_completes_the_manoeuvre(command: str, scenario: Scenario) -> None:
    story = run(scenario, command, 4.0, Fault('flywheel_a', 'dead'), Fault('flywheel_b', 'stuck'))
    assert set(story.named) == {'flywheel_a', 'flywheel_b'}
    assert story.transient <= LARGEST_TRANSIENT
    assert story.final <= LARGEST_FINAL_ERROR


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
def test_lost_axis_is_named_and_the_other_one_is_held(command: str, scenario: Scenario) -> None:
    story = run(scenario, command, 4.0, Fault('flywheel_a', 'dead'), Fault('flywheel_c', 'dead'))
    for part in ('axis a cannot', 'flywheel_a, flywheel_c'):
        assert part in story.problem
    assert story.mode == 'hold'
    assert story.off_b < 1.0


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
def test_no_wheel_fault_with_wrong_inertias(command: str, scenario: Scenario) -> None:
    """Errors of 5 % of wheel and link inertias cause no wheel fault in either manoeuvre."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        real = scenario.mechanism
        model = replace(
            real, link_inertias=real.link_inertias * (1.0 + rng.choice([-0.05, 0.05], 4)),
            flywheel_inertias=real.flywheel_inertias * (1.0 + rng.choice([-0.05, 0.05], 4)))
        goal = (0.0, pi / 3.0 + pi / 4.0) if seed else (-pi / 2.0, -pi / 6.0)
        setpoint = replace(scenario.setpoints[0], names=LINK_NAMES[:2], positions=goal)
        story = run(replace(scenario, model=model, setpoints=(setpoint,), seed=seed),
                    command, 0.5)
        assert story.named == {}, f'seed {seed}'
        assert story.final < 0.1, f'seed {seed}'


@pytest.mark.slow
@pytest.mark.parametrize('command', COMMANDS)
def test_device_that_does_not_drive_is_no_fault_of_its_wheels(
    command: str, scenario: Scenario,
) -> None:
    """All motors are dead, as if commands did not arrive or the device were disarmed."""
    story = run(scenario, command, 3.0, *(Fault(name, 'dead') for name in FLYWHEEL_NAMES))
    assert story.named == {}
