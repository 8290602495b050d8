# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Control allocation: demands, costs, bounds, and lost directions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from itertools import combinations
from math import pi

from fourbar_ros.control.allocation import (
    Allocation,
    AllocationError,
    ALLOCATIONS,
    ConstrainedNorm,
    make_allocation,
    MinMaxSpeed,
    WeightedNorm,
)
from fourbar_ros.control.allocation_solver import (
    controllable,
    largest_scale,
    LOST,
    MARGIN,
    MotorState,
    principal_axes,
    WEAK,
)
from fourbar_ros.control.allocation_solver import (
    Problem as ReducedProblem,
)
from fourbar_ros.control.soft_step import SoftStep
from fourbar_ros.mechanism import assemble, Mechanism, reduced_form
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.linalg import null_space
from scipy.optimize import linprog, minimize, nnls

Array = NDArray[np.float64]
SEEDS = range(40)

# Size of demands and torques, to which the tolerances refer [N m].
SIZE = 1e-4
# Gains of the random linkages are above WEAK, and Gamma is at most 8. The error is a few roundings
# of their ratio, or the clipping of torques beyond a bound (1e-10 of the torques, times Gamma).
MET = 1e-8 * SIZE

NO_LIMIT = np.full(4, np.inf)
OPPOSITE = np.array([0.5, 0.5, -0.5, -0.5])

each_seed = pytest.mark.parametrize('seed', SEEDS)
each_allocation = pytest.mark.parametrize('name', ALLOCATIONS)
each_norm = pytest.mark.parametrize('name', ALLOCATIONS[:4])
Refuses = Callable[..., AbstractContextManager[None]]


@dataclass(frozen=True, eq=False)
class Problem:
    """
    An allocation problem.

    :param wheel_map: (n, 4).
    :param demand: (n,) [N m].
    :param inertias: (4,) of the wheels [kg m^2].
    :param available: (4,) bool.
    :param lower, upper: (4,) bounds of the torques [N m].
    :param speeds: (4,) of the wheels [rad/s].
    """

    wheel_map: Array
    demand: Array
    inertias: Array
    available: NDArray[np.bool_]
    lower: Array
    upper: Array
    speeds: Array = field(default_factory=lambda: np.zeros(4))

    def share(self, name: str) -> tuple[Array, float]:
        """Return torques (4,) and the scale."""
        return self.rule(name).solve(
            self.wheel_map, self.demand, MotorState(self.lower, self.upper, self.speeds))

    def rule(self, name: str) -> Allocation:
        """Return the allocation of a name."""
        return make_allocation(name, self.inertias, self.available)

    def metric(self, name: str) -> Array:
        """Return the inverse weights (4,)."""
        return self.rule(name).weights_inv


Draw = Callable[[int], Problem]


@pytest.fixture(scope='module')
def draw(uneven: Mechanism) -> Draw:
    """
    Draw a linkage, two or three axes, and a demand up to three times the capacity of the motors.

    Every fifth motor is at its speed limit, one wheel may be faulty; all axes can be driven.
    """
    def make(seed: int) -> Problem:
        rng = np.random.default_rng(seed)
        lower, upper = rng.uniform(-1.0, -0.1, 4) * SIZE, rng.uniform(0.1, 1.0, 4) * SIZE
        lower[rng.random(4) < 0.1] = 0.0
        upper[rng.random(4) < 0.1] = 0.0
        inertias = rng.uniform(2e-7, 1e-6, 4)
        while True:
            phi_a, theta = rng.uniform(-pi, pi), rng.uniform(0.3, 2.0)
            angles = assemble(uneven, phi_a, phi_a + theta, str(rng.choice(['open', 'crossed'])))
            rows = reduced_form(uneven, angles, np.zeros(2)).wheel_map
            if rng.random() < 0.3:
                rows = np.vstack([rows, OPPOSITE])
            available = np.ones(4, dtype=bool)
            if rng.random() < 0.4:
                available[rng.integers(4)] = False
            problem = Problem(rows, rng.uniform(-1.5, 1.5, len(rows)) * SIZE, inertias, available,
                              lower, upper)
            well_driven = all((controllable(rows, problem.metric(name))[1] == 1.0).all()
                              for name in ALLOCATIONS[1:])
            if abs(np.sin(angles[3] - angles[2])) > 0.2 and well_driven:
                return problem
    return make


def unlimited(problem: Problem) -> Problem:
    return replace(problem, lower=-NO_LIMIT, upper=NO_LIMIT)


# Without bounds

@each_allocation
@each_seed
def test_demand_is_met_within_the_capacity_of_the_wheels(name: str, seed: int, draw: Draw) -> None:
    """Two wheels of two pairs drive two axes almost everywhere, and never three."""
    problem = unlimited(draw(seed))
    torques, scale = problem.share(name)
    directions, shares = controllable(problem.wheel_map, problem.metric(name))
    assert scale == 1.0
    missed = directions @ (problem.wheel_map @ torques + problem.demand)
    np.testing.assert_allclose(missed[shares == 1.0], 0.0, rtol=0.0, atol=MET)
    assert name == 'two_wheels' or (shares == 1.0).all()


@each_norm
@each_seed
def test_any_other_allocation_costs_more(name: str, seed: int, draw: Draw) -> None:
    problem = unlimited(draw(seed))
    metric = problem.metric(name)
    used = metric > 0.0
    torques, _ = problem.share(name)
    assert not torques[~used].any()
    least = (torques[used] ** 2 / metric[used]).sum()
    free = null_space(problem.wheel_map[:, used])
    rng = np.random.default_rng(seed)
    for _ in range(50 if free.size else 0):
        other = torques[used] + free @ rng.uniform(-SIZE, SIZE, free.shape[1])
        assert (other ** 2 / metric[used]).sum() > least


def test_least_norm_is_that_of_accelerations_and_least_energy_that_of_speeds() -> None:
    inertias = np.array([1.0, 2.0, 3.0, 4.0])
    everything = np.ones(4, dtype=bool)
    np.testing.assert_array_equal(
        make_allocation('min_norm', inertias, everything).weights_inv, inertias ** 2)
    for name in ('min_energy', 'bounded', 'min_max_speed'):
        np.testing.assert_array_equal(
            make_allocation(name, inertias, everything).weights_inv, inertias)


@pytest.mark.parametrize(('available', 'used'), [
    ((1, 1, 1, 1), (1, 1, 0, 0)), ((0, 1, 1, 1), (0, 1, 1, 0)), ((1, 0, 1, 1), (1, 0, 0, 1)),
    ((1, 1, 0, 0), (1, 1, 0, 0)), ((0, 0, 1, 1), (0, 0, 1, 1)), ((0, 1, 0, 1), (0, 1, 0, 0)),
    ((0, 0, 0, 0), (0, 0, 0, 0))])
def test_two_wheels_are_one_of_each_pair(available: tuple[int, ...], used: tuple[int, ...]
                                         ) -> None:
    metric = make_allocation(
        'two_wheels', np.ones(4), np.array(available, dtype=bool)).weights_inv
    np.testing.assert_array_equal(metric > 0.0, np.array(used, dtype=bool))


def test_faulty_wheel_has_no_torque_in_any_allocation() -> None:
    for name in ALLOCATIONS:
        for wheel in range(4):
            available = np.arange(4) != wheel
            assert make_allocation(name, np.ones(4), available).weights_inv[wheel] == 0.0


def test_unknown_allocation_is_refused(refuses: Refuses) -> None:
    with refuses(AllocationError, name='allocation', value='even', limit=ALLOCATIONS):
        make_allocation('even', np.ones(4), [True] * 4)


def test_paired_wheels_of_the_rhombus_share_equally(paper: Mechanism) -> None:
    for theta in (0.4, pi / 3, pi / 2, 2.5):
        form = reduced_form(paper, assemble(paper, 0.3, 0.3 + theta), np.zeros(2))
        torques, _ = Problem(
            form.wheel_map, np.array([1e-5, -3e-6]), paper.flywheel_inertias,
            np.ones(4, dtype=bool), -NO_LIMIT, NO_LIMIT).share('min_norm')
        np.testing.assert_allclose(torques, [-5e-6, 1.5e-6, -5e-6, 1.5e-6], rtol=1e-12)


@pytest.mark.parametrize(('name', 'ratio'), [('min_norm', 4.0), ('min_energy', 2.0)])
def test_larger_wheel_of_a_pair_takes_the_larger_share(name: str, ratio: float, paper: Mechanism
                                                       ) -> None:
    """
    A wheel with twice the inertia takes four times or twice the torque.

    Least accelerations s at a given sum of If s are proportional to If, so torques to its square;
    least energy has equal accelerations, so torques proportional to If.
    """
    inertias = np.array([3e-7, 3e-7, 6e-7, 6e-7])
    form = reduced_form(paper, assemble(paper, 0.0, pi / 3), np.zeros(2))
    torques, _ = Problem(form.wheel_map, np.array([1e-5, 1e-5]), inertias, np.ones(4, dtype=bool),
                         -NO_LIMIT, NO_LIMIT).share(name)
    np.testing.assert_allclose(torques[2:] / torques[:2], [ratio, ratio], rtol=1e-12)


def quarter_turn(mechanism: Mechanism, name: str) -> tuple[float, float, Array]:
    """
    Turn the rhombus by a quarter in 10 s from rest.

    :returns: peak absolute wheel speed [rad/s], peak energy of the wheels (paper eq. 7) [J], and
        speeds at half time (4,) [rad/s].
    """
    start = np.array([[0.0, pi / 3], [0.0, 0.0], [0.0, 0.0]])
    step = SoftStep(start, start[0] + pi / 2, 10.0)
    inertias = mechanism.flywheel_inertias
    limits = mechanism.motor_torque_limits
    # Midpoints of 2 ms: the error is (h / 10 s)^2 of the speed.
    times = np.arange(1e-3, 10.0, 2e-3)
    speeds, peak, energy, half = np.zeros(4), 0.0, 0.0, np.zeros(4)
    for time in times:
        angle, rate, acceleration = step.at(float(time))
        form = reduced_form(mechanism, assemble(mechanism, *angle), rate)
        demand = form.mass_matrix @ acceleration + form.bias
        torques, scale = Problem(form.wheel_map, demand, inertias, np.ones(4, dtype=bool),
                                 -limits, limits).share(name)
        assert scale == 1.0
        speeds += torques / inertias * 2e-3
        peak = max(peak, float(np.abs(speeds).max()))
        energy = max(energy, 0.5 * float(inertias @ speeds ** 2))
        if time < 5.0:
            half = speeds.copy()
    return peak, energy, half


@pytest.mark.medium
@pytest.mark.parametrize(('name', 'speed', 'energy'), [
    ('min_norm', 62.37, 2.6452e-3), ('min_energy', 62.37, 2.6452e-3),
    ('bounded', 62.37, 2.6452e-3), ('min_max_speed', 62.37, 2.6452e-3),
    ('two_wheels', 124.74, 5.2904e-3)])
def test_quarter_turn_of_the_paper(name: str, speed: float, energy: float, paper: Mechanism
                                   ) -> None:
    """The expected values follow from A = 1.44e-4 kg m^2 and the peak rate of the soft step."""
    assert quarter_turn(paper, name)[:2] == (
        pytest.approx(speed, abs=0.005), pytest.approx(energy, abs=5e-8))


@pytest.mark.medium
def test_least_energy_keeps_the_speeds_of_unequal_wheels_equal(paper: Mechanism) -> None:
    """The energy is the least one of a pair: momentum squared over twice the inertia."""
    uneven_wheels = replace(
        paper, flywheel_inertias=paper.flywheel_inertias * np.array([1.0, 2.0, 3.0, 0.5]))
    inertias = uneven_wheels.flywheel_inertias
    _, _, speeds = quarter_turn(uneven_wheels, 'min_energy')
    np.testing.assert_allclose(speeds[:2], speeds[2:], rtol=1e-9)
    _, _, others = quarter_turn(uneven_wheels, 'min_norm')
    momenta, pairs = inertias * speeds, inertias * others
    np.testing.assert_allclose(
        momenta[:2] + momenta[2:], pairs[:2] + pairs[2:], rtol=1e-9)
    assert inertias @ speeds ** 2 < 0.9 * (inertias @ others ** 2)


# Proportional scaling

@pytest.mark.parametrize('name', ALLOCATIONS[:3])
@each_seed
def test_torques_are_reduced_in_proportion(name: str, seed: int, draw: Draw) -> None:
    problem = draw(seed)
    torques, scale = problem.share(name)
    full, _ = unlimited(problem).share(name)
    np.testing.assert_allclose(torques, scale * full, rtol=0.0, atol=1e-9 * SIZE)
    assert (torques <= problem.upper).all() and (torques >= problem.lower).all()
    # The scaling is the smallest one: one torque is at its bound.
    margin = np.where(full > 0.0, problem.upper - torques, torques - problem.lower)
    assert scale == 1.0 or margin[full != 0.0].min() <= 1e-9 * SIZE


def test_rounding_at_a_bound_of_zero_does_not_stop_the_others() -> None:
    rows = np.array([[1.0, 0.0, 1.0, 1e-17], [0.0, 1.0, -1e-17, 1.0]])
    upper = np.array([1.0, 0.0, 1.0, 0.0])
    problem = Problem(rows, np.array([-1.0, 0.0]), np.ones(4), np.ones(4, dtype=bool),
                      -np.array([1.0, 0.0, 1.0, 0.0]), upper)
    for name in ('min_norm', 'bounded', 'min_max_speed'):
        torques, scale = problem.share(name)
        assert scale == 1.0
        np.testing.assert_allclose(torques, [0.5, 0.0, 0.5, 0.0], rtol=1e-15)


# Optimum within the bounds

def admitted(problem: Problem) -> float:
    """Return the largest scale that the bounds admit, by a linear program; at most 10."""
    used = problem.available
    solution = linprog(
        np.append(np.zeros(used.sum()), -1.0),
        A_eq=np.column_stack([problem.wheel_map[:, used], problem.demand / SIZE]),
        b_eq=np.zeros(len(problem.demand)),
        bounds=[*zip(problem.lower[used] / SIZE, problem.upper[used] / SIZE), (0.0, 10.0)])
    assert solution.success
    return float(solution.x[-1])


def pushes_of(problem: Problem) -> tuple[Array, Array, Array]:
    """Return rows (n, 4) and bounds (4,) in the metric of `bounded`."""
    root = np.sqrt(problem.metric('bounded') / problem.metric('bounded').max())
    room = np.divide([problem.lower, problem.upper], root, out=np.zeros((2, 4)), where=root > 0.0)
    return problem.wheel_map * root, room[0], room[1]


def circles(problem: Problem) -> tuple[float, float]:
    """
    Return bounds of the demand that wheels can meet.

    :returns: lower bound, and an upper bound, at which all wheels give the largest torque.
    """
    pushes, low, high = pushes_of(problem)
    count = len(pushes)
    reaches = []
    for others in combinations(np.flatnonzero(problem.available), count - 1):
        normal = null_space(pushes[:, others].T)[:, 0]
        along = normal @ pushes
        reaches += [np.maximum(along * low, along * high).sum(),
                    np.maximum(-along * low, -along * high).sum()]
    return min(reaches), float(
        np.linalg.norm(pushes, axis=0).max() * np.maximum(-low, high).sum())


@each_seed
def test_without_margin_the_scale_is_what_the_bounds_admit(seed: int, draw: Draw) -> None:
    problem = draw(seed)
    _, low, high = pushes_of(problem)
    directions, effectiveness, gains, _ = principal_axes(
        problem.wheel_map, problem.metric('bounded'))
    goal = np.zeros(3)
    goal[:len(directions)] = -directions @ problem.demand
    scale = largest_scale(ReducedProblem(
        effectiveness, gains, goal, len(directions), low, high, np.ones(4)), 0.0)
    # The tolerance is that of the linear program.
    assert min(scale, 10.0) == pytest.approx(admitted(problem), abs=1e-7)


@each_seed
def test_demand_is_met_in_proportion_within_bounds(seed: int, draw: Draw) -> None:
    """The scale is at least the largest one times the margin."""
    problem = draw(seed)
    torques, scale = problem.share('bounded')
    np.testing.assert_allclose(
        -problem.wheel_map @ torques, scale * problem.demand, rtol=0.0, atol=MET)
    assert (torques <= problem.upper).all() and (torques >= problem.lower).all()
    assert not torques[~problem.available].any()
    largest = min(admitted(problem), 1.0)
    least, most = circles(problem)
    assert scale <= largest + 1e-7
    if least > MARGIN * most:
        assert scale >= largest * (1.0 - MARGIN * most / least) - 1e-7


@each_seed
def test_torques_within_bounds_meet_the_optimality_conditions(seed: int, draw: Draw) -> None:
    """
    The Karush-Kuhn-Tucker conditions are sufficient in a convex problem.

    The gradient tau / v is the rows times multipliers, minus non-negative multipliers of the upper
    bounds, plus those of the lower bounds.
    """
    problem = draw(seed)
    torques, _ = problem.share('bounded')
    used = problem.available
    x = torques[used] / SIZE
    at_upper = x > problem.upper[used] / SIZE - 1e-9
    at_lower = x < problem.lower[used] / SIZE + 1e-9
    metric = problem.metric('bounded')[used]
    gradient = x * metric.mean() / metric
    walls, rows = np.eye(used.sum()), problem.wheel_map[:, used].T
    _, residual = nnls(np.column_stack(
        [rows, -rows, -walls[:, at_upper], walls[:, at_lower]]), gradient)
    # Torques within 1e-9 of a bound count as at the bound; the rows amplify that by ten.
    assert residual < 1e-8


@pytest.mark.parametrize('seed', range(10))
def test_torques_within_bounds_are_those_of_a_general_solver(seed: int, draw: Draw) -> None:
    problem = draw(seed)
    torques, scale = problem.share('bounded')
    used = problem.available
    metric = problem.metric('bounded')[used] / problem.inertias.max()
    rows, goal = problem.wheel_map[:, used], -scale * problem.demand / SIZE
    solution = minimize(
        lambda x: (x ** 2 / metric).sum(), np.zeros(used.sum()), jac=lambda x: 2.0 * x / metric,
        method='SLSQP', bounds=[*zip(problem.lower[used] / SIZE, problem.upper[used] / SIZE)],
        constraints={'type': 'eq', 'fun': lambda x: rows @ x - goal, 'jac': lambda x: rows},
        options={'ftol': 1e-14, 'maxiter': 200})
    assert solution.success
    np.testing.assert_allclose(torques[used] / SIZE, solution.x, rtol=0.0, atol=1e-6)


def test_partner_replaces_a_wheel_at_its_speed_limit(paper: Mechanism) -> None:
    form = reduced_form(paper, assemble(paper, 0.0, pi / 3), np.zeros(2))
    problem = Problem(form.wheel_map, np.array([-5e-5, 2e-5]), paper.flywheel_inertias,
                      np.ones(4, dtype=bool), np.full(4, -1e-4), np.array([0.0, 1e-4, 1e-4, 1e-4]))
    torques, scale = problem.share('bounded')
    assert scale == 1.0
    np.testing.assert_allclose(torques, [0.0, -1e-5, 5e-5, -1e-5], atol=1e-15)
    torques, scale = problem.share('min_energy')
    assert scale == 0.0
    assert not torques.any()


def lipschitz(problem: Problem) -> float:
    """
    Return the Lipschitz constant of the torques as a function of the demand.

    Torques of least norm are those of some wheels, with the others at their bounds. They meet the
    demand or its projection to the admissible region. The boundary of this region lies between an
    inner and an outer circle, so a change of direction is amplified by at most the ratio of the
    radii. The margin reduces the inner radius.
    """
    pushes, _, _ = pushes_of(problem)
    steepest = max(1.0 / np.linalg.svd(pushes[:, [i, k]], compute_uv=False)[-1]
                   for i, k in combinations(range(4), 2))
    least, most = circles(problem)
    return float(steepest * (1.0 + most / (least - MARGIN * most)))


@pytest.mark.medium
@pytest.mark.parametrize('seed', range(10))
def test_torques_follow_the_demand_without_jumps(seed: int, draw: Draw) -> None:
    problem = draw(seed)
    limits = np.maximum(problem.upper, 0.2 * SIZE)
    problem = replace(problem, wheel_map=problem.wheel_map[:2], available=np.ones(4, dtype=bool),
                      lower=-limits, upper=limits)
    bound = lipschitz(problem)
    before, last, degraded = None, None, 0
    for turn in np.linspace(0.0, 4.0 * pi, 8001):
        demand = SIZE * (0.3 + 0.2 * turn) * np.array([np.cos(turn), np.sin(turn)])
        torques, scale = replace(problem, demand=demand).share('bounded')
        degraded += scale < 1.0
        if before is not None:
            change = np.abs(torques - before).max()
            assert change <= bound * np.linalg.norm(demand - last) + 1e-9 * SIZE, f'at {turn:.4f}'
        before, last = torques, demand
    assert 1000 < degraded < 8000


@pytest.mark.parametrize('mismatch', [1e-12, 1e-6, 1e-4])
def test_pair_with_small_demand_has_no_opposite_torques(mismatch: float, paper: Mechanism
                                                        ) -> None:
    """Almost equal lengths give almost the torques of equal lengths, at the limit too."""
    longer = replace(paper, link_lengths=paper.link_lengths * (1.0 + mismatch * np.arange(4.0)))
    shared = []
    for mechanism in (paper, longer):
        form = reduced_form(mechanism, assemble(mechanism, 0.0, 1.0), np.zeros(2))
        torques, scale = Problem(
            form.wheel_map, np.array([2.3e-4, 1e-5]), paper.flywheel_inertias,
            np.ones(4, dtype=bool), np.full(4, -1e-4), np.full(4, 1e-4)).share('bounded')
        assert scale < 1.0
        shared.append(torques)
    # Gamma differs by ten times the mismatch, and the torques of two wheels by that share of both.
    np.testing.assert_allclose(shared[1], shared[0], rtol=0.0, atol=1e-13 + 1e-4 * 40 * mismatch)


def test_pair_at_its_speed_limit_causes_no_opposite_torques_of_the_other(paper: Mechanism) -> None:
    """Opposite torques of wheels a and c could replace a small part of b and d."""
    longer = replace(paper, link_lengths=paper.link_lengths * (1.0 + 1e-3 * np.arange(4.0)))
    form = reduced_form(longer, assemble(longer, 0.0, 1.0), np.zeros(2))
    assert abs(form.gamma[0, 1]) > 1e-4
    torques, scale = Problem(
        form.wheel_map, np.array([0.0, -5e-5]), paper.flywheel_inertias, np.ones(4, dtype=bool),
        np.full(4, -1e-4), np.array([1e-4, 0.0, 1e-4, 0.0])).share('bounded')
    assert scale == 0.0
    assert not torques.any()


# Directions that cannot be driven

def test_axis_without_wheels_is_dropped_and_the_other_one_is_met(paper: Mechanism) -> None:
    form = reduced_form(paper, assemble(paper, 0.2, 1.4), np.zeros(2))
    problem = Problem(form.wheel_map, np.array([3e-5, -4e-5]), paper.flywheel_inertias,
                      np.array([False, True, False, True]), np.full(4, -1e-4), np.full(4, 1e-4))
    for name in ALLOCATIONS:
        expected = [0.0, 4e-5, 0.0, 0.0] if name == 'two_wheels' else [0.0, 2e-5, 0.0, 2e-5]
        torques, scale = problem.share(name)
        assert scale == 1.0
        np.testing.assert_allclose(torques, expected, rtol=1e-12, atol=1e-18)
    directions, shares = controllable(problem.wheel_map, problem.metric('min_norm'))
    np.testing.assert_array_equal(np.sort(shares), [0.0, 1.0])
    np.testing.assert_allclose(np.abs(directions[shares == 1.0]), [[0.0, 1.0]], atol=1e-12)


@each_seed
def test_directions_are_orthonormal_and_wheels_act_on_each_alone(seed: int, draw: Draw) -> None:
    """The directions are the left singular vectors of rows v^(1/2)."""
    problem = draw(seed)
    metric = problem.metric('min_energy')
    directions, shares = controllable(problem.wheel_map, metric)
    pushes = directions @ problem.wheel_map * np.sqrt(metric / metric.max())
    # Entries and gains are at most 8.
    np.testing.assert_allclose(directions @ directions.T, np.eye(len(shares)), atol=1e-14)
    product = pushes @ pushes.T
    np.testing.assert_allclose(product - np.diag(np.diag(product)), 0.0, atol=1e-12)
    np.testing.assert_allclose(
        np.sort(np.sqrt(np.diag(product))),
        np.sort(np.linalg.svd(
            problem.wheel_map * np.sqrt(metric / metric.max()), compute_uv=False)),
        rtol=1e-12)


@pytest.mark.medium
def test_demand_is_reduced_before_torques_grow() -> None:
    """
    Wheels b and c drive both axes until wheel c has no leverage on axis a.

    Torques are at most 1 / WEAK times the demand. As a function of the rows they are the demand
    times a function of singular values, whose slope is steepest next to LOST: (f / gain)' =
    1 / (WEAK - LOST) / LOST; a function of matrices has the Lipschitz constant of the number's.
    """
    demand = np.array([0.8, 0.6])
    metric = np.array([0.0, 1.0, 1.0, 0.0])
    steepest = 1.0 / (WEAK - LOST) / LOST
    before, seen = None, set()
    step = 1e-4
    for gamma in np.arange(-0.4, 0.4, step):
        rows = np.array([[1.0, 0.0, gamma, 0.3], [0.0, 1.0, 0.4, 1.0]])
        torques, _ = WeightedNorm(metric).solve(
            rows, demand, MotorState(-NO_LIMIT, NO_LIMIT, np.zeros(4)))
        assert np.linalg.norm(torques) <= 1.0 / WEAK * (1.0 + 1e-12)
        if before is not None:
            assert np.linalg.norm(torques - before) <= steepest * step * (1.0 + 1e-9)
        before = torques
        directions, shares = controllable(rows, metric)
        np.testing.assert_allclose(
            directions @ rows @ torques, -shares * (directions @ demand), atol=1e-13)
        seen.add(float(np.ceil(shares.min())) + float(np.floor(shares.min())))
    assert seen == {0.0, 1.0, 2.0}      # lost, weak and good


@pytest.mark.medium
@pytest.mark.parametrize('kind', ['proportional', 'bounded', 'min_max_speed'])
def test_torques_are_finite_and_within_bounds_for_any_problem(kind: str) -> None:
    """Cases: dependent rows, zero demand, empty bounds, no wheels, unequal sizes; seed 5."""
    rng = np.random.default_rng(5)
    for trial in range(20_000):
        count = int(rng.integers(1, 4))
        rows = rng.choice([0.0, 1.0, -1.0, 0.5, 1e-9, 1.0 + 1e-15, 30.0], (count, 4))
        if rng.random() < 0.3:
            rows[-1] = rows[0] * rng.choice([0.0, 1.0, -2.0])
        demand = rng.choice([0.0, 1.0, -1.0, 1e-18, 1e3, 0.3], count)
        metric = rng.choice([0.0, 1.0, 0.5, 1e-9, 1e-14], 4)
        lower, upper = -rng.choice([0.0, 1.0, 1e-6, 2.0], 4), rng.choice([0.0, 1.0, 0.5], 4)
        if rng.random() < 0.2:
            upper[rng.integers(4)] = np.inf
        if kind == 'min_max_speed':
            rule: Allocation = MinMaxSpeed(metric, np.ones(4))
        else:
            rule = (ConstrainedNorm if kind == 'bounded' else WeightedNorm)(metric)
        speeds = np.zeros(4)
        if kind == 'min_max_speed':
            speeds = rng.choice([0.0, 1.0, -300.0, 20.0], 4)
        torques, scale = rule.solve(rows, demand, MotorState(lower, upper, speeds))
        assert 0.0 <= scale <= 1.0, f'trial {trial}'
        assert np.isfinite(torques).all(), f'trial {trial}'
        assert (torques <= upper).all() and (torques >= lower).all(), f'trial {trial}'
        assert not torques[metric == 0.0].any(), f'trial {trial}'
        if kind != 'proportional' and not (np.isfinite(lower).all() and np.isfinite(upper).all()):
            continue
        directions, shares = controllable(rows, metric)
        missed = directions @ (rows @ torques) + scale * shares * (directions @ demand)
        # Torques up to scale demand / WEAK may exceed a bound by 1e-10 and are then clipped; a
        # row amplifies that by 60.
        limit = 1e-10 / WEAK * 60.0 * scale * np.linalg.norm(demand)
        if kind == 'min_max_speed':
            # The null space adds torques up to the bounds of 2 N m with the same relative error.
            limit += 1e-10 * 2.0 * 60.0
        assert (np.abs(missed[shares > 0.0]) <= limit + 1e-12).all(), f'trial {trial}'
