# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Sensor faults during a manoeuvre: bounded error of the estimate, and isolation."""

from collections.abc import Iterator
from dataclasses import replace
from math import inf, pi, radians

from fourbar_ros.control import ControllerSettings
from fourbar_ros.loop.closed_loop import ClosedLoop, Step
from fourbar_ros.loop.run import make_loop
from fourbar_ros.loop.scenario import load_scenario, Scenario
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.plant import Fault
import numpy as np
import pytest

PERIOD_S = 4e-3
SETPOINT_S, FASTEST_S, END_S = 1.0, 3.0, 5.5
# Largest error of an angle with any fault of one sensor [rad].
LARGEST_ERROR = radians(1.0)
NAMED_WITHIN_S = 2.0

FAULTS = [('off', None), ('stuck', None), ('garbage', None), ('wrong', 0.1),
          ('wrong', radians(-0.35)), ('slow', 0.2), ('delayed', 0.1), ('delayed', 0.03),
          ('intermittent', 0.5)]


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    return load_scenario('prototype')


def quarter_turn(loop: ClosedLoop) -> Iterator[tuple[float, Step]]:
    """Run a quarter turn of both pairs in 4 s, with the peak rate in the middle."""
    loop.controller.settings = ControllerSettings(setpoint_duration=4.0)
    for tick in range(round(END_S / PERIOD_S)):
        step = loop.step()
        if tick == 125:
            assert loop.arm()[0]
        if tick == round(SETPOINT_S / PERIOD_S):
            assert step.estimate is not None
            loop.controller.setpoint(
                LINK_NAMES[:2], list(step.estimate.link_angles[:2] + pi / 2.0),
                step.samples.stamp_ns)
        yield tick * PERIOD_S, step


def error_of(step: Step) -> float:
    """Return the largest error of an angle, infinite without an estimate [rad]."""
    if step.estimate is None or step.samples.truth is None:
        return inf
    return float(np.abs(step.estimate.link_angles - step.samples.truth.link_angles).max())


@pytest.mark.slow
@pytest.mark.parametrize(('link', 'kind', 'value'), [
    (n % 4, *fault) for n, fault in enumerate(FAULTS)])
def test_fault_of_one_sensor_is_isolated_and_the_error_is_small(
    link: int, kind: str, value: float | None, scenario: Scenario,
) -> None:
    """The fault begins at the peak rate, and no other sensor is reported."""
    name = LINK_NAMES[link]
    loop = make_loop(replace(scenario, seed=10 + link))
    named_s, worst = inf, 0.0
    for now_s, step in quarter_turn(loop):
        if now_s == FASTEST_S:
            loop.supervisor.device.break_down(name, Fault(name, kind, value))
        named = loop.estimator.sensor_faults()
        if now_s > 0.5:
            worst = max(worst, error_of(step))
        if named_s == inf and list(named) == [name]:
            named_s = now_s - FASTEST_S
        if now_s < FASTEST_S:
            assert named == {}
        else:
            assert not named or name in named
    assert named_s < NAMED_WITHIN_S
    assert worst < LARGEST_ERROR


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(2))
def test_wheels_alone_drive_the_estimate_for_a_second_until_it_is_lost(
    seed: int, scenario: Scenario,
) -> None:
    loop = make_loop(replace(scenario, seed=seed))
    lost_s = inf
    for now_s, step in quarter_turn(loop):
        if now_s == FASTEST_S:
            for name in LINK_NAMES:
                loop.supervisor.device.break_down(name, Fault(name, 'off'))
        if 0.5 < now_s < FASTEST_S + 1.0:
            assert error_of(step) < LARGEST_ERROR, f'seed {seed}'
        if lost_s == inf and now_s > FASTEST_S and step.estimate is None:
            lost_s = now_s - FASTEST_S
            assert 'lost' in loop.estimator.waiting_for
    assert 1.0 <= lost_s < 1.1
    assert not loop.supervisor.arming.armed


@pytest.mark.slow
def test_no_sensor_is_reported_without_a_fault(scenario: Scenario) -> None:
    """Without a fault no sensor is reported; a hundred runs are in `study consistency`."""
    for seed in range(2):
        loop = make_loop(replace(scenario, seed=100 + seed))
        for _ in quarter_turn(loop):
            assert loop.estimator.sensor_faults() == {}, f'seed {seed}'
