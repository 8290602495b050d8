# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Terms of paper eq. 6 on axes that are regular at change points, and the feedback law."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

from fourbar_ros.control.branch import Branch, CROSSED, FOLDED, UNPAIRED_AXES
from fourbar_ros.control.computed_torque import (
    AXES_FIELDS,
    demanded,
    evaluate_axes,
    Feedback,
    hold_on_branch,
    MOTION_FIELDS,
)
from fourbar_ros.control.records import records
from fourbar_ros.mechanism import (
    assemble,
    kinetic_energy,
    Mechanism,
    reduced_form,
    ReducedForm,
)
from fourbar_ros.mechanism.change_points import HOLD_FADES_FROM, HOLD_FADES_TO
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

SEEDS = range(20)
NONE = np.zeros(4)
PARALLELOGRAMS = ('paper', 'prototype', 'parallelogram')

each_seed = pytest.mark.parametrize('seed', SEEDS)
each_parallelogram = pytest.mark.parametrize('linkage', PARALLELOGRAMS)


@dataclass
class Axes:
    """Result of `evaluate_axes`, see `AXES_FIELDS`."""

    record: Any

    def __getattr__(self, name: str) -> Any:
        return getattr(self.record, name)

    @property
    def matrix(self) -> Array:
        return np.array([[self.a00, self.a01], [self.a01, self.a11]])

    @property
    def inertias(self) -> Array:
        """The known elements of the mass matrix."""
        return np.array([self.a00, self.a01, self.a11, *self.eta_row])


def axes_at(mechanism: Mechanism, angles: Array, rates: Array, parallel: bool,
            reference_angles: Array | None = None, reference_rates: Array = NONE,
            paired_links: NDArray[np.int64] = UNPAIRED_AXES) -> Axes:
    motion, axes = records(MOTION_FIELDS), records(AXES_FIELDS)
    motion['angles'], motion['rates'] = angles, rates
    motion['reference_angles'] = angles if reference_angles is None else reference_angles
    motion['reference_rates'] = reference_rates
    motion['paired'], motion['paired_links'] = parallel, paired_links
    for name in axes.dtype.names or ():
        axes[name] = np.nan
    evaluate_axes(motion[0], mechanism.constants, axes[0])
    return Axes(axes[0])


def on_branch(phi_a: float, theta: float) -> Array:
    return np.array([phi_a, phi_a + theta, phi_a, phi_a + theta])


def check_reduced_form(axes: Axes, form: ReducedForm, seed: int) -> None:
    # The reduced form divides by |sin theta|^2 = 0.09, which amplifies the rounding.
    scale = np.abs(form.mass_matrix).max()
    np.testing.assert_allclose(axes.matrix, form.mass_matrix, atol=1e-14 * scale,
                               err_msg=f'seed {seed}')
    np.testing.assert_allclose(axes.bias[:2], form.bias, atol=1e-12 * scale * 4.0,
                               err_msg=f'seed {seed}')
    np.testing.assert_allclose(
        axes.wheel_map[:2], form.wheel_map, atol=1e-13, err_msg=f'seed {seed}')


@pytest.fixture
def mechanism(linkage: str, request: pytest.FixtureRequest) -> Mechanism:
    found: Mechanism = request.getfixturevalue(linkage)
    return found


# Paper eq. 6

@each_seed
@each_parallelogram
def test_parallelogram_agrees_with_the_reduced_form(
    seed: int, linkage: str, mechanism: Mechanism,
) -> None:
    rng = np.random.default_rng(seed)
    theta = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, pi - 0.3)
    angles, rates = on_branch(rng.uniform(-10.0, 10.0), theta), np.tile(rng.uniform(-2, 2, 2), 2)
    form, axes = reduced_form(mechanism, angles, rates), axes_at(mechanism, angles, rates, True)
    check_reduced_form(axes, form, seed)


@each_seed
def test_general_linkage_has_the_reduced_form_without_a_third_axis(seed: int, uneven: Mechanism
                                                                   ) -> None:
    rng = np.random.default_rng(seed)
    angles = assemble(uneven, 0.3 * seed, 0.3 * seed + rng.uniform(0.9, 2.0),
                      'open' if seed % 2 else 'crossed')
    rates, wanted = rng.uniform(-1.0, 1.0, 4), rng.uniform(-1.0, 1.0, 4)
    form = reduced_form(uneven, angles, rates)
    axes = axes_at(uneven, angles, rates, False, angles + 0.1 * wanted, wanted)
    np.testing.assert_array_equal(axes.matrix, form.mass_matrix)
    np.testing.assert_array_equal(axes.bias, [*form.bias, 0.0])
    np.testing.assert_array_equal(axes.wheel_map, [*form.wheel_map, NONE])
    np.testing.assert_allclose(axes.errors, [0.1 * wanted[:2], (wanted - rates)[:2]], atol=1e-14)
    assert not axes.eta_row.any()
    assert axes.eta == axes.eta_rate == axes.hold == 0.0
    assert axes.condition == pytest.approx(np.linalg.cond(form.mass_matrix), rel=1e-12)


@pytest.mark.parametrize('theta', [0.0, pi, -pi, 2.0 * pi])
@each_parallelogram
def test_terms_are_finite_and_continuous_through_change_points(
    theta: float, linkage: str, mechanism: Mechanism,
) -> None:
    """Terms vary as cosines and sines of theta; the row of eta is constant."""
    rates, step = np.array([0.7, -1.3, 0.7, -1.3]), 1e-6
    before, at, after = (axes_at(mechanism, on_branch(0.4, theta + change), rates, True)
                         for change in (-step, 0.0, step))
    assert all(np.isfinite(values).all()
               for values in (at.wheel_map, at.bias, at.inertias, at.errors))
    scale = np.abs(at.inertias).max()
    for near in (before, after):
        np.testing.assert_array_equal(near.wheel_map, at.wheel_map)
        np.testing.assert_allclose(near.inertias, at.inertias, atol=4.0 * scale * step)
        np.testing.assert_allclose(near.bias, at.bias, atol=4.0 * scale * step * 1.3 ** 2)
        assert near.hold == at.hold == 1.0


@pytest.mark.parametrize('theta', [0.0, pi])
@each_parallelogram
def test_row_of_eta_is_the_free_motion_of_the_closure(
    theta: float, linkage: str, mechanism: Mechanism,
) -> None:
    """By `l_c eta_c = l_a eta_a` and so on joint 3 stays closed and the pairs do not turn."""
    angles = on_branch(0.4, theta)
    rows = axes_at(mechanism, angles, NONE, True).wheel_map
    free = rows[2]
    assert free[2] - free[0] == 1.0
    np.testing.assert_allclose(rows[:2] @ free, 0.0, atol=1e-16)
    arms = np.array([-1.0, 1.0, 1.0, -1.0]) * mechanism.link_lengths
    assert abs((arms * free) @ np.exp(1j * angles)) < 1e-16


@each_seed
@each_parallelogram
def test_inertia_of_the_three_axes_is_that_of_the_links(
    seed: int, linkage: str, mechanism: Mechanism,
) -> None:
    """The kinetic energies of any rates on the axes agree."""
    rng = np.random.default_rng(seed)
    angles = on_branch(rng.uniform(-3.0, 3.0), rng.uniform(-0.1, 0.1))
    axes, on_axes = axes_at(mechanism, angles, NONE, True), rng.uniform(-1.0, 1.0, 3)
    coupling, own = axes.eta_row[:2], axes.eta_row[2]
    matrix = np.block([[axes.matrix, coupling[:, None]], [coupling[None, :], np.array([[own]])]])
    assert 0.5 * on_axes @ matrix @ on_axes == pytest.approx(
        kinetic_energy(mechanism, angles, axes.wheel_map.T @ on_axes, NONE),
        rel=1e-12), f'seed {seed}'
    assert axes.condition == pytest.approx(np.linalg.cond(axes.matrix), rel=1e-9)


@each_seed
@each_parallelogram
def test_errors_are_those_of_the_pairs_and_of_eta(
    seed: int, linkage: str, mechanism: Mechanism,
) -> None:
    rng = np.random.default_rng(seed)
    angles, rates = on_branch(0.3, rng.choice([0.01, pi - 0.01])), rng.uniform(-1.0, 1.0, 4)
    free = axes_at(mechanism, angles, NONE, True).wheel_map[2]
    (pair_a, pair_b, eta), (rate_a, rate_b, eta_rate) = rng.uniform(-0.1, 0.1, (2, 3))
    axes = axes_at(mechanism, angles, rates, True,
                   angles + [pair_a, pair_b, pair_a, pair_b] - eta * free,
                   rates + [rate_a, rate_b, rate_a, rate_b] - eta_rate * free)
    np.testing.assert_allclose(axes.errors, [[pair_a, pair_b], [rate_a, rate_b]], atol=1e-14,
                               err_msg=f'seed {seed}')
    np.testing.assert_allclose([axes.eta, axes.eta_rate], [eta, eta_rate],
                               atol=1e-14, err_msg=f'seed {seed}')


# Other branches of a rhombus

def on_other(branch: Branch, phi_a: float, theta: float) -> Array:
    return branch.to_links(np.array([phi_a, phi_a + theta]), np.full(2, branch.pair_angle))


@pytest.mark.parametrize('turn', [0.0, 2.0 * pi])
@pytest.mark.parametrize('theta', [0.0, pi])
@pytest.mark.parametrize('branch', [FOLDED, CROSSED], ids=lambda branch: branch.name)
@pytest.mark.parametrize('linkage', ['paper', 'prototype'])
def test_row_of_eta_on_other_branches_is_the_free_motion(
    linkage: str, branch: Branch, theta: float, turn: float, mechanism: Mechanism,
) -> None:
    """Paired links turn apart and joint 3 stays closed, also with a difference of one turn."""
    angles = on_other(branch, 0.4, theta)
    angles[branch.followers[1]] += turn
    axes = axes_at(mechanism, angles, NONE, True, paired_links=branch.paired_links)
    free = axes.wheel_map[2]
    for axis, (first, second) in enumerate(branch.pairs):
        assert abs(free[second] - free[first]) == 1.0
        np.testing.assert_array_equal(
            np.flatnonzero(axes.wheel_map[axis]), sorted((first, second)))
    np.testing.assert_allclose(axes.wheel_map[:2] @ free, 0.0, atol=1e-16)
    arms = np.array([-1.0, 1.0, 1.0, -1.0]) * mechanism.link_lengths
    assert abs((arms * free) @ np.exp(1j * angles)) < 1e-16
    assert axes.hold == pytest.approx(1.0)


@each_seed
@pytest.mark.parametrize('linkage', ['paper', 'prototype'])
def test_crossed_branch_agrees_with_the_reduced_form(
    seed: int, linkage: str, mechanism: Mechanism,
) -> None:
    """The axes of the crossed branch are links a and b."""
    rng = np.random.default_rng(seed)
    theta = rng.choice([-1.0, 1.0]) * rng.uniform(0.3, pi - 0.3)
    angles = on_other(CROSSED, rng.uniform(-3.0, 3.0), theta)
    rates = CROSSED.to_links(rng.uniform(-2, 2, 2), np.zeros(2))
    form = reduced_form(mechanism, angles, rates)
    axes = axes_at(mechanism, angles, rates, True, paired_links=CROSSED.paired_links)
    check_reduced_form(axes, form, seed)


@each_seed
@pytest.mark.parametrize('linkage', ['paper', 'prototype'])
def test_folded_and_crossed_branch_are_the_same_for_identical_links(
    seed: int, linkage: str, mechanism: Mechanism,
) -> None:
    """The two branches differ by a turn of one pair by pi."""
    rng = np.random.default_rng(seed)
    phi, theta = rng.uniform(-3.0, 3.0, 2)
    rates = rng.uniform(-2.0, 2.0, 2)
    folded, crossed = (
        axes_at(mechanism, on_other(branch, phi, theta + branch.pair_angle),
                branch.to_links(rates, np.zeros(2)), True, paired_links=branch.paired_links)
        for branch in (FOLDED, CROSSED))
    scale = np.abs(folded.matrix).max()
    np.testing.assert_allclose(crossed.matrix, folded.matrix, atol=1e-14 * scale,
                               err_msg=f'seed {seed}')
    np.testing.assert_allclose(crossed.bias[:2], folded.bias[:2], atol=1e-14 * scale * 4.0,
                               err_msg=f'seed {seed}')


def test_hold_is_full_at_change_points_and_decreases_smoothly() -> None:
    """The hold is a cubic with a slope of at most 1.5 / width and a curvature of 6 / width^2."""
    theta = np.linspace(-pi, 2.0 * pi, 30_001)
    hold, sizes = np.array([hold_on_branch(angle) for angle in theta]), np.abs(np.sin(theta))
    assert (hold[sizes <= HOLD_FADES_FROM] == 1.0).all()
    assert (hold[sizes >= HOLD_FADES_TO] == 0.0).all()
    step, width = theta[1] - theta[0], HOLD_FADES_TO - HOLD_FADES_FROM
    assert np.abs(np.diff(hold)).max() <= 1.5 / width * step
    assert np.abs(np.diff(hold, 2)).max() <= (6.0 / width ** 2 + 1.5 / width) * step ** 2
    order = np.argsort(sizes)
    assert (np.diff(hold[order]) <= 1e-12).all()


# The law

def demand_of(axes: Axes, errors: Array, acceleration: Array = NONE[:2], band: float = 0.0,
              sticking: float = 0.0, disturbance: Array = NONE[:2], stiffness: float = 16.0,
              damping: float = 7.2) -> Array:
    demand = np.full(3, np.nan)
    demanded(acceleration, Feedback(errors, stiffness, damping, band, sticking, disturbance),
             axes.record, demand)
    return demand


@pytest.fixture(params=SEEDS)
def random_axes(request: pytest.FixtureRequest, uneven: Mechanism) -> Axes:
    """Evaluate the linkage in a random pose at rest, where b = 0."""
    rng = np.random.default_rng(request.param)
    return axes_at(uneven, assemble(uneven, 0.1, 0.1 + rng.uniform(0.9, 2.0)), NONE, False)


def acceleration_of(axes: Axes, demand: Array) -> Array:
    found: Array = np.linalg.solve(axes.matrix, demand[:2] - axes.bias[:2])
    return found


def test_links_accelerate_according_to_the_law(random_axes: Axes) -> None:
    errors, planned = np.array([[0.01, -0.03], [0.2, 0.1]]), np.array([0.5, -0.7])
    demand = demand_of(random_axes, errors, planned, band=0.01)
    np.testing.assert_allclose(
        acceleration_of(random_axes, demand), planned + 7.2 * errors[1] + 16.0 * errors[0],
        rtol=1e-11)


@pytest.mark.parametrize('sticking', [0.0, 0.3, 1.0])
def test_attitude_errors_act_at_any_friction_band(sticking: float, random_axes: Axes) -> None:
    """Equal errors of all links turn no joint, so no band applies."""
    errors = np.array([[1e-4, 1e-4], [0.0, 0.0]])
    demand = demand_of(random_axes, errors, band=0.05, sticking=sticking)
    np.testing.assert_allclose(acceleration_of(random_axes, demand), 16.0 * 1e-4, rtol=1e-10)


def configuration_error(axes: Axes, theta: float) -> Array:
    """Return errors that turn the joints without angular momentum of the whole."""
    first, second = axes.matrix.sum(axis=0) / axes.matrix.sum()
    return np.array([[-second * theta, first * theta], [0.0, 0.0]])


@pytest.mark.parametrize('theta', [0.0, 3e-4, -5e-4, 8e-4, -0.01])
def test_configuration_errors_within_the_band_have_no_effect(theta: float, random_axes: Axes
                                                             ) -> None:
    """Beyond the band the law acts on the error minus the band."""
    band = 5e-4
    demand = demand_of(random_axes, configuration_error(random_axes, theta), band=band,
                       sticking=1.0)
    beyond = np.sign(theta) * max(abs(theta) - band, 0.0)
    np.testing.assert_allclose(
        demand, demand_of(random_axes, configuration_error(random_axes, beyond)),
        atol=1e-14 * 16.0 * band * np.abs(random_axes.matrix).max())
    moving = demand_of(random_axes, configuration_error(random_axes, theta), band=band)
    np.testing.assert_array_equal(
        moving, demand_of(random_axes, configuration_error(random_axes, theta)))


def test_disturbance_is_compensated_in_motion(random_axes: Axes) -> None:
    """The links accelerate as without the disturbance."""
    pushed = np.array([3e-6, -5e-6])
    np.testing.assert_allclose(
        demand_of(random_axes, np.zeros((2, 2)), disturbance=pushed)[:2], -pushed, rtol=1e-12)


def test_at_rest_only_torque_on_the_whole_is_compensated(random_axes: Axes) -> None:
    """Joint friction acts between the links, so its sum over the links is zero."""
    still = np.zeros((2, 2))
    pushed = np.array([3e-6, -5e-6])
    demand = demand_of(random_axes, still, disturbance=pushed, sticking=1.0)
    assert demand[:2].sum() == pytest.approx(-pushed.sum(), rel=1e-12)
    turned = acceleration_of(random_axes, demand)
    assert turned[0] == pytest.approx(turned[1], rel=1e-10)
    between = demand_of(random_axes, still, disturbance=np.array([4e-6, -4e-6]), sticking=1.0)
    # The tolerance is the rounding of a difference of almost equal torques.
    np.testing.assert_allclose(between, 0.0, atol=4e-6 * 1e-15)
