# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Drift of the wheels, and the time until a wheel reaches its speed limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import exp, inf
from typing import Any

from fourbar_ros.control.momentum_margin import (
    DRIFT_TIME,
    MIN_DRIFT,
    MIN_MARGIN,
    MIN_TIME_LEFT,
    MomentumMonitor,
)
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.plant import InitialState
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

PERIOD = 4e-3
NONE = np.zeros(4)


def drifting(mechanism: Mechanism, seconds: float, acceleration: Array, start: Array = NONE,
             planned: Array = NONE, links: Array = NONE, period: float = PERIOD
             ) -> tuple[MomentumMonitor, Array]:
    """Let wheels drift at constant accelerations beyond the plan; return monitor and speeds."""
    monitor = MomentumMonitor(mechanism)
    monitor.reset(start)
    rate = acceleration + planned / mechanism.flywheel_inertias - links
    for n in range(round(seconds / period)):
        monitor.update(period, start + rate * (n + 1) * period, planned, links)
    return monitor, start + rate * round(seconds / period) * period


ACCELERATION = np.array([2.0, -1.0, 0.0, 0.5])


@pytest.mark.parametrize('period', [1e-3, 4e-3, 0.05])
@pytest.mark.parametrize('seconds', [1.0, 5.0, 40.0])
def test_drift_is_a_mean(seconds: float, period: float, prototype: Mechanism) -> None:
    """The drift depends neither on the rate of the loop nor on the plan."""
    monitor, _ = drifting(prototype, seconds, ACCELERATION, NONE + 7.0,
                          np.array([1e-3, 0.0, -1e-3, 0.0]), np.array([0.1, 0.2, 0.3, 0.4]),
                          period)
    np.testing.assert_allclose(
        monitor.drift, ACCELERATION * (1.0 - exp(-seconds / DRIFT_TIME)), rtol=1e-6, atol=1e-9)


def test_time_left_is_the_shortest_of_all_wheels(prototype: Mechanism) -> None:
    """After 8 time constants the error of the drift is 3e-4; the limit is 300 rad/s."""
    monitor, speeds = drifting(prototype, 40.0, ACCELERATION, np.array([0.0, -200.0, 250.0, 0.0]))
    expected = min((300.0 - speeds[0]) / 2.0, (300.0 + speeds[1]) / 1.0, (300.0 - speeds[3]) / 0.5)
    assert monitor.time_left(speeds) == pytest.approx(expected, rel=1e-3)
    assert monitor.warning(speeds) == ''


@pytest.mark.parametrize('seconds', [0.0, 0.5 * DRIFT_TIME])
def test_time_left_is_infinite_at_first(seconds: float, prototype: Mechanism) -> None:
    monitor, speeds = drifting(prototype, seconds, 100.0 * ACCELERATION)
    assert monitor.time_left(speeds) == inf


def test_time_left_of_a_slowing_wheel_is_that_to_the_opposite_limit(prototype: Mechanism) -> None:
    monitor, speeds = drifting(
        prototype, 40.0, np.array([-2.0, 0.0, 0.0, 0.0]), np.array([280.0, 0.0, 0.0, 0.0]))
    assert monitor.time_left(speeds) == pytest.approx((300.0 + speeds[0]) / 2.0, rel=1e-3)


@pytest.mark.parametrize('share', [0.9, 1.1])
def test_time_left_is_infinite_below_a_least_drift(share: float, prototype: Mechanism) -> None:
    monitor, speeds = drifting(
        prototype, 60.0, np.array([share * MIN_DRIFT * 300.0, 0.0, 0.0, 0.0]))
    assert (monitor.time_left(speeds) == inf) == (share < 1.0)


def test_wheel_without_a_limit_never_saturates(prototype: Mechanism) -> None:
    endless = replace(prototype, motor_speed_limits=np.full(4, inf))
    monitor, speeds = drifting(endless, 20.0, ACCELERATION)
    assert monitor.time_left(speeds) == inf
    assert monitor.warning(speeds) == ''
    np.testing.assert_array_equal(monitor.margins(speeds), 1.0)


def test_reset_sets_the_drift_to_zero(prototype: Mechanism) -> None:
    monitor, speeds = drifting(prototype, 20.0, ACCELERATION)
    monitor.reset(speeds)
    assert not monitor.drift.any()
    assert monitor.time_left(speeds) == inf
    # The speed before the reset does not look like a drift.
    monitor.update(PERIOD, speeds, NONE, NONE)
    assert not monitor.drift.any()


def test_tick_without_a_period_does_not_change_the_drift(prototype: Mechanism) -> None:
    monitor, speeds = drifting(prototype, 10.0, ACCELERATION)
    before = monitor.drift.copy()
    monitor.update(0.0, speeds + 50.0, NONE, NONE)
    np.testing.assert_array_equal(monitor.drift, before)


# Warnings

def test_warning_names_the_wheel_with_the_least_margin(prototype: Mechanism) -> None:
    monitor = MomentumMonitor(prototype)
    speeds = np.array([10.0, -(1.0 - MIN_MARGIN) * 300.0 - 1.0, 200.0, 0.0])
    warning = monitor.warning(speeds)
    assert all(word in warning for word in ('flywheel_b', '256', '300 rad/s'))
    speeds[1] += 2.0
    assert monitor.warning(speeds) == ''


def test_warning_at_a_short_time_left(prototype: Mechanism) -> None:
    drift = np.array([0.0, 0.0, 2.0, 0.0])
    monitor, speeds = drifting(prototype, 40.0, drift, np.array([0.0, 0.0, 100.0, 0.0]))
    left = monitor.time_left(speeds)
    assert left > MIN_TIME_LEFT
    sooner = speeds + drift * (left - MIN_TIME_LEFT + 1.0)
    assert f'{monitor.time_left(sooner):.0f} s' in monitor.warning(sooner)
    assert monitor.time_left(sooner) < MIN_TIME_LEFT


# In the loop

TORQUE = 4e-4


def test_saturation_by_a_constant_torque_is_predicted(steer: Callable[..., Any],
                                                      prototype: Mechanism) -> None:
    """
    The controller knows a constant torque on link a.

    The links hold, and wheels a and c take half of the torque each, so the time to their limit is
    known.
    """
    steered = steer(prototype, InitialState())
    steered.plant.apply_link_torques([TORQUE, 0.0, 0.0, 0.0])
    steered.disturbance = np.array([TORQUE, 0.0])
    steered.ticks(round(10.0 / PERIOD))
    truth, monitor = steered.plant.truth(), steered.controller.momentum
    assert np.abs(truth.link_rates).max() < 1e-5
    expected = 0.5 * TORQUE / prototype.flywheel_inertias[0]
    known = 1.0 - exp(-10.0 / DRIFT_TIME)
    # The delay of a tick and the lag of the motors are 7 ms of 5 s.
    np.testing.assert_allclose(monitor.drift, np.array([1.0, 0.0, 1.0, 0.0]) * expected * known,
                               rtol=2e-3, atol=2e-3 * expected)
    left = monitor.time_left(truth.wheel_speeds)
    assert left * known == pytest.approx(300.0 / expected - 10.0, rel=5e-3)


def test_planned_motion_is_no_drift(steer: Callable[..., Any], prototype: Mechanism) -> None:
    """Wheels accelerate by 15 rad/s^2 during a move, and the drift is zero."""
    steered = steer(prototype, InitialState(), setpoint_duration=3.5)
    steered.controller.setpoint(['link_a', 'link_b'], [0.4, 1.3])
    drifts, speeds = [], []
    for _ in range(round(4.0 / PERIOD)):
        steered.tick()
        drifts.append(steered.controller.momentum.drift.copy())
        speeds.append(steered.plant.truth().wheel_speeds)
        assert steered.controller.momentum.warning(speeds[-1]) == ''
    planned = np.abs(np.diff(speeds, axis=0)).max() / PERIOD
    assert planned > 10.0
    # Torques act later than planned by the motor lag and a tick.
    assert np.abs(drifts).max() < 0.01 * planned
