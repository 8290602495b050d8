# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The decay rate of the sampled loop agrees with simulations, and unstable gains are refused."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from typing import Any

from fourbar_ros.control import ControllerSettings, GainError
from fourbar_ros.control.stability import (
    check_gains,
    decay_rate,
    largest_bandwidth,
    MIN_DECAY,
)
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.motors import lagged_torque, motors_of, speed_loop
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Refuses = Callable[..., AbstractContextManager[None]]

SEEDS = range(60)
STEP = 5e-5


def unchecked(**values: Any) -> ControllerSettings:
    """Return settings with values beyond the limits of the parameters."""
    settings = ControllerSettings()
    for name, value in values.items():
        object.__setattr__(settings, name, value)
    return settings


def with_lag(mechanism: Mechanism, lag: float) -> Mechanism:
    return replace(mechanism, motor_time_constants=np.full(4, lag),
                   motor_torque_limits=np.full(4, np.inf))


@kernel
def simulate(bandwidth: float, damping: float, period: float, by_speed: bool, errors: Array,
             packed: NDArray[np.record]) -> None:
    """
    Simulate the control law on a double integrator with the motor of the plant.

    Torques are in units of acceleration times the inertia of the wheel. A command is computed from
    the sample of the previous period, and is held.

    :param errors: output; norm of the error and its rate over the bandwidth at each sample.
    """
    motors = packed[0]
    inertia = motors.inertia[0]
    error, rate = 1.0, 0.0
    torque = speed = integral = answer = total = 0.0
    steps = max(round(period / STEP), 20)
    h = period / steps
    for n in range(errors.size):
        errors[n] = (error * error + (rate / bandwidth) ** 2) ** 0.5
        wanted = answer
        answer = -bandwidth ** 2 * error - 2.0 * damping * bandwidth * rate
        total += wanted * period
        for _ in range(steps):
            asked = wanted * inertia
            if by_speed:
                asked, integral = speed_loop(0, total, speed, integral, h, motors)
            mean, torque = lagged_torque(0, torque, asked, h, motors)
            acceleration = mean / inertia
            speed += acceleration * h
            error += rate * h + 0.5 * acceleration * h * h
            rate += acceleration * h


@pytest.mark.medium
@pytest.mark.parametrize('by_speed', [False, True])
@pytest.mark.parametrize('seed', SEEDS)
def test_errors_of_the_simulated_loop_decay_at_the_predicted_rate(
    seed: int, by_speed: bool, prototype: Mechanism,
) -> None:
    """Gains, rates and lags are random; sign and size of the decay rate agree."""
    rng = np.random.default_rng(seed)
    bandwidth, damping = float(rng.uniform(0.5, 40.0)), float(rng.uniform(0.3, 2.0))
    period, lag = float(rng.uniform(1e-3, 0.05)), float(rng.choice([0.0, 3e-3, 0.02]))
    predicted = decay_rate(bandwidth, damping, period, lag, by_speed)
    seconds = min(max(20.0 / max(abs(predicted), 1e-3), 60.0 * period), 2000.0 * period)
    errors = np.empty(round(seconds / period))
    simulate(bandwidth, damping, period, by_speed, errors,
             np.array([motors_of(with_lag(prototype, lag))]))
    # The envelope of oscillating errors is the peak in the first and in the last fifth.
    fifth = errors.size // 5
    first, last = (np.log(errors[part].max()) for part in (
        slice(fifth, 2 * fifth), slice(-fifth, None)))
    apart = period * (errors.size - 2 * fifth)
    found = (first - last) / apart
    # The sampled peaks and the other modes at the begin cause a factor of at most ten.
    assert abs(found - predicted) < 0.05 * abs(predicted) + np.log(10.0) / apart, f'seed {seed}'
    settings = unchecked(bandwidth=bandwidth, damping=damping, branch_bandwidth=0.0,
                         command='velocity' if by_speed else 'effort')
    with suppress(GainError):
        check_gains(settings, with_lag(prototype, lag), period)
        assert errors[-1] < 0.1 * errors[0], f'seed {seed}'


@pytest.mark.parametrize('by_speed', [False, True])
@pytest.mark.parametrize(('period', 'lag'), [(4e-3, 3e-3), (0.02, 0.0), (0.05, 3e-3), (0.2, 0.01)])
@pytest.mark.parametrize('damping', [0.5, 0.9, 2.0])
def test_refusal_has_the_largest_bandwidth_that_is_accepted(
    damping: float, period: float, lag: float, by_speed: bool, prototype: Mechanism,
    refuses: Refuses,
) -> None:
    """A slightly smaller bandwidth is accepted, a slightly larger one is refused."""
    mechanism = with_lag(prototype, lag)
    others = {'damping': damping, 'branch_bandwidth': 0.0,
              'command': 'velocity' if by_speed else 'effort'}
    largest = largest_bandwidth(damping, period, lag, by_speed)
    with refuses(GainError, name='bandwidth', value=1000.0, limit=largest, rate_hz=1.0 / period):
        check_gains(unchecked(bandwidth=1000.0, **others), mechanism, period)
    check_gains(unchecked(bandwidth=0.99 * largest, **others), mechanism, period)
    with pytest.raises(GainError):
        check_gains(unchecked(bandwidth=1.01 * largest, **others), mechanism, period)


@pytest.mark.parametrize('by_speed', [False, True])
def test_limit_is_a_decay_rate_of_a_fifth_of_the_nominal_one(by_speed: bool) -> None:
    largest = largest_bandwidth(0.9, 0.01, 3e-3, by_speed)
    assert decay_rate(largest, 0.9, 0.01, 3e-3, by_speed) == pytest.approx(
        MIN_DECAY * 0.9 * largest, rel=0.02)


def test_branch_is_checked_as_well_and_named(
    prototype: Mechanism, refuses: Refuses,
) -> None:
    with refuses(GainError, name='branch_bandwidth', value=300.0):
        check_gains(unchecked(branch_bandwidth=300.0), prototype, 4e-3)
    check_gains(ControllerSettings(branch_bandwidth=0.0), prototype, 4e-3)


def test_slow_gains_have_the_nominal_decay_rate() -> None:
    """The nominal decay rate is the real part of the poles of the double integrator."""
    for damping in (0.3, 0.9, 1.0):
        assert decay_rate(1.0, damping, 1e-4, 0.0, False) == pytest.approx(damping, rel=0.02)


@pytest.mark.parametrize('command', ['effort', 'velocity'])
def test_defaults_are_stable_at_the_usual_rates(
    command: str, paper: Mechanism, prototype: Mechanism,
) -> None:
    for mechanism in (paper, prototype):
        for rate in (100.0, 250.0, 1000.0):
            check_gains(ControllerSettings(command=command), mechanism, 1.0 / rate)
