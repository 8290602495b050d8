# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The allocation `min_max_speed` minimises the largest wheel speed within the bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi
from typing import Any

from fourbar_ros.control.allocation import (
    ALLOCATIONS,
    make_allocation,
    MinMaxSpeed,
    SPEED_HORIZON,
)
from fourbar_ros.control.allocation_solver import MARGIN, MotorState
from fourbar_ros.control.soft_step import SoftStep
from fourbar_ros.mechanism import assemble, Mechanism, reduced_form
from fourbar_ros.plant import InitialState
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.linalg import null_space
from scipy.optimize import linprog

Array = NDArray[np.float64]

SEEDS = range(40)
ALL = np.ones(4, dtype=bool)
TORQUE, SPEED = 1e-4, 100.0

each_seed = pytest.mark.parametrize('seed', SEEDS)


class Case:
    """A random linkage, demand, bounds and wheel speeds; every third case lacks a wheel."""

    def __init__(self, mechanism: Mechanism, seed: int) -> None:
        rng = np.random.default_rng(seed)
        angles = assemble(mechanism, 0.0, rng.uniform(0.6, 2.0), 'open' if seed % 2 else 'crossed')
        self.wheel_map = reduced_form(mechanism, angles, np.zeros(2)).wheel_map
        self.inertias = rng.uniform(2e-7, 1e-6, 4)
        self.usable = np.arange(4) != (rng.integers(4) if seed % 3 == 0 else 4)
        self.demand = rng.uniform(-0.3, 0.3, 2) * TORQUE
        self.motors = MotorState(rng.uniform(-3.0, -1.0, 4) * TORQUE,
                                 rng.uniform(1.0, 3.0, 4) * TORQUE,
                                 rng.uniform(-SPEED, SPEED, 4))

    def solve(self) -> tuple[Array, float]:
        return make_allocation('min_max_speed', self.inertias, self.usable).solve(
            self.wheel_map, self.demand, self.motors)

    def fastest(self, torques: Array) -> float:
        """Return the largest speed of usable wheels after the horizon [rad/s]."""
        speeds = self.motors.speeds + SPEED_HORIZON * torques / self.inertias
        return float(np.abs(speeds[self.usable]).max())

    def least(self) -> float:
        """Return the smallest largest speed by a linear program [rad/s]."""
        used = self.usable
        gain = np.diag(SPEED_HORIZON * TORQUE / self.inertias)[:, used]
        unit = np.ones((4, 1))
        solution = linprog(
            np.append(np.zeros(used.sum()), 1.0),
            A_ub=np.vstack([np.hstack([gain, -unit]), np.hstack([-gain, -unit])])[
                np.tile(used, 2)],
            b_ub=np.concatenate([-self.motors.speeds[used], self.motors.speeds[used]]),
            A_eq=np.column_stack([self.wheel_map[:, used], np.zeros(2)]),
            b_eq=-self.demand / TORQUE,
            bounds=[*zip(self.motors.lower[used] / TORQUE, self.motors.upper[used] / TORQUE),
                    (0.0, None)])
        assert solution.success
        return float(solution.x[-1])


@each_seed
def test_demand_is_met_exactly_within_bounds(seed: int, uneven: Mechanism) -> None:
    case = Case(uneven, seed)
    torques, scale = case.solve()
    assert scale == 1.0
    np.testing.assert_allclose(-case.wheel_map @ torques, case.demand, atol=1e-9 * TORQUE)
    assert (torques <= case.motors.upper).all()
    assert (torques >= case.motors.lower).all()
    assert not torques[~case.usable].any()


@each_seed
def test_largest_speed_is_that_of_a_linear_program(seed: int, uneven: Mechanism) -> None:
    """The allocation ignores wheels with little leverage, so its speed is slightly larger."""
    case = Case(uneven, seed)
    fastest, least = case.fastest(case.solve()[0]), case.least()
    assert fastest >= least - 1e-6 * SPEED
    assert fastest <= least + 2.0 * MARGIN * SPEED


@each_seed
def test_no_random_torques_that_meet_the_demand_are_better(seed: int, uneven: Mechanism) -> None:
    """The test draws 20000 torques from the null space within the bounds."""
    case = Case(uneven, seed)
    torques, _ = case.solve()
    free = null_space(case.wheel_map[:, case.usable])
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(-4.0, 4.0, (20_000, free.shape[1])) * TORQUE
    others = np.zeros((len(drawn), 4))
    others[:, case.usable] = torques[case.usable] + drawn @ free.T
    inside = ((others <= case.motors.upper) & (others >= case.motors.lower)).all(axis=1)
    speeds = np.abs(case.motors.speeds + SPEED_HORIZON * others / case.inertias)
    best = speeds[inside][:, case.usable].max(axis=1).min(initial=np.inf)
    assert case.fastest(torques) <= best + 2.0 * MARGIN * SPEED


def test_wheels_of_a_pair_take_equal_speeds(paper: Mechanism) -> None:
    """Wheels a and c of the rhombus are a pair; their speeds are equal after the horizon."""
    wheel_map = reduced_form(paper, assemble(paper, 0.0, 1.0), np.zeros(2)).wheel_map
    limits, inertias = np.full(4, 1e-2), paper.flywheel_inertias
    torques, scale = make_allocation('min_max_speed', inertias, ALL).solve(
        wheel_map, np.zeros(2), MotorState(-limits, limits, np.array([100.0, 5.0, 40.0, 3.0])))
    assert scale == 1.0
    expected = 30.0 * inertias[0] / SPEED_HORIZON
    np.testing.assert_allclose(torques, [-expected, 0.0, expected, 0.0], atol=1e-12 * expected)


def test_almost_equal_lengths_cause_no_opposite_torques_of_a_slow_pair(paper: Mechanism) -> None:
    """With length errors of 1e-4 the pair b, d could unload a and c by 1e-3 of its own speed."""
    longer = replace(paper, link_lengths=paper.link_lengths * (1.0 + 1e-4 * np.arange(4.0)))
    wheel_map = reduced_form(longer, assemble(longer, 0.0, 1.0), np.zeros(2)).wheel_map
    limits, inertias = np.full(4, 1e-2), paper.flywheel_inertias
    torques, _ = make_allocation('min_max_speed', inertias, ALL).solve(
        wheel_map, np.zeros(2), MotorState(-limits, limits, np.array([100.0, 0.0, 100.0, 0.0])))
    assert np.abs(torques).max() < 1e-2 * SPEED * inertias[0] / SPEED_HORIZON


def peak_speed(mechanism: Mechanism, name: str, travel: tuple[float, float]) -> float:
    """Run a soft step from rest and return the largest wheel speed [rad/s]."""
    start = np.array([[0.0, pi / 3], [0.0, 0.0], [0.0, 0.0]])
    step, period = SoftStep(start, start[0] + travel, 5.0), 4e-3
    inertias, limits = mechanism.flywheel_inertias, mechanism.motor_torque_limits
    rule, speeds, peak = make_allocation(name, inertias, ALL), np.zeros(4), 0.0
    for time in np.arange(0.5 * period, 5.0, period):
        angle, rate, acceleration = step.at(float(time))
        form = reduced_form(mechanism, assemble(mechanism, *angle), rate)
        torques, scale = rule.solve(form.wheel_map, form.mass_matrix @ acceleration + form.bias,
                                    MotorState(-limits, limits, speeds))
        assert scale == 1.0
        speeds = speeds + torques / inertias * period
        peak = max(peak, float(np.abs(speeds).max()))
    return peak


TRAVELS = [(pi / 2, pi / 2), (0.5, -0.3), (-0.4, 0.8)]


@pytest.mark.slow
@pytest.mark.parametrize('travel', TRAVELS)
@pytest.mark.parametrize('linkage', ['uneven', 'parallelogram', 'unequal_wheels'])
def test_no_other_rule_has_a_smaller_peak_speed_from_rest(
    linkage: str, travel: tuple[float, float], request: pytest.FixtureRequest,
) -> None:
    """
    Speeds are optimal for the momentum at the horizon h, and the momentum changes until then.

    With the angular frequency w = 2 pi / 5 s of the step the effect is (h w)^2 / 2, below 1 %.
    """
    mechanism = request.getfixturevalue(linkage)
    mechanism = replace(mechanism, motor_torque_limits=np.full(4, 1e-2))
    peaks = {name: peak_speed(mechanism, name, travel) for name in ALLOCATIONS}
    assert peaks['min_max_speed'] <= 1.01 * min(peaks.values()), peaks


@pytest.fixture(scope='module')
def unequal_wheels(paper: Mechanism) -> Mechanism:
    return replace(
        paper, flywheel_inertias=paper.flywheel_inertias * np.array([1.0, 2.0, 3.0, 0.5]))


@pytest.mark.medium
@pytest.mark.parametrize('seed', range(10))
def test_torques_follow_speeds_and_demand_without_jumps(seed: int, uneven: Mechanism) -> None:
    """
    Halved steps along a path of speeds and demands halve the largest change of the torques.

    The torques are a continuous, piecewise linear function; a jump would keep its size.
    """
    case = Case(uneven, 3 * seed + 1)
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-SPEED, SPEED, (2, 4)), rng.uniform(-0.3, 0.3, (2, 2)) * TORQUE
    rule = MinMaxSpeed(case.inertias, case.inertias)

    def largest_change(count: int) -> float:
        torques = []
        for share in np.linspace(0.0, 1.0, count):
            speeds, demand = ((1.0 - share) * first + share * last for first, last in ends)
            torques.append(rule.solve(
                case.wheel_map, demand, case.motors._replace(speeds=speeds))[0])
        return float(np.abs(np.diff(torques, axis=0)).max())
    coarse = largest_change(1001)
    assert largest_change(8001) <= coarse / 8.0 * 1.05 + 1e-9 * TORQUE


def test_manoeuvre_continues_after_loss_of_wheel(steer: Callable[..., Any], prototype: Mechanism
                                                 ) -> None:
    """The links reach their goal with three wheels, and the lost wheel has no power."""
    steered = steer(prototype, InitialState(), allocation='min_max_speed', setpoint_duration=4.0)
    steered.controller.setpoint(['link_a', 'link_b'], [0.4, 1.3])
    steered.ticks(300)
    steered.controller.law.tune(steered.controller.settings, np.arange(4) != 2)
    controls = steered.ticks(1000)
    assert all(control.torques[2] == 0.0 for control in controls)
    np.testing.assert_allclose(steered.plant.truth().link_angles[:2], [0.4, 1.3], atol=1e-3)
    # With noise of an encoder the balancing torque stays far below the motor limit.
    assert np.abs([control.torques for control in controls[-100:]]).max() < 1e-3
