# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Null-space torques exchange momentum within pairs of wheels and move no link."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

from fourbar_ros.control.allocation_solver import MotorState
from fourbar_ros.control.null_space import (
    null_torques,
    target_speeds,
    TargetError,
    TARGETS,
    towards,
)
from fourbar_ros.mechanism import assemble, Mechanism, reduced_form
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.linalg import null_space

Array = NDArray[np.float64]
SEEDS = range(20)
STEP = 5e-4
NO_LIMIT = np.full(4, np.inf)

Refuses = Callable[..., AbstractContextManager[None]]

each_seed = pytest.mark.parametrize('seed', SEEDS)


def take(rows: Array, metric: Array, wanted: Array, lower: Array = -NO_LIMIT,
         upper: Array = NO_LIMIT, given: Array | None = None) -> tuple[Array, float]:
    """Return the result of `null_torques` and its factor."""
    out = np.full(4, np.nan)
    factor = null_torques(
        rows, metric, wanted, MotorState(lower, upper, np.zeros(4)),
        np.zeros(4) if given is None else given, out)
    return out, factor


@pytest.fixture(scope='module')
def at_rest(uneven: Mechanism) -> Callable[[int], Plant]:
    """Return a function that makes a plant at rest in a random pose."""
    def make(seed: int) -> Plant:
        return Plant(uneven, Table(LinkSensorSettings(), WheelEncoders(0)),
                     InitialState(0.1 * seed, 0.1 * seed + 1.2), STEP, np.random.default_rng(0))
    return make


@pytest.mark.parametrize('room', [1e-3, 1e-6, 0.0])
@each_seed
def test_no_link_moves(seed: int, room: float, at_rest: Callable[[int], Plant], uneven: Mechanism
                       ) -> None:
    """The plant does not move, for torques within the bounds and for scaled torques."""
    plant = at_rest(seed)
    rows = reduced_form(uneven, plant.truth().link_angles, np.zeros(2)).wheel_map
    rng = np.random.default_rng(seed)
    torques, factor = take(
        rows, uneven.flywheel_inertias,
        rng.uniform(-5e-5, 5e-5, 4), -room * rng.uniform(0.1, 1.0, 4),
        room * rng.uniform(0.1, 1.0, 4))
    assert (factor == 1.0) == (room == 1e-3)
    assert torques.any() == (room > 0.0)
    plant.advance(1, torques)
    truth = plant.truth()
    np.testing.assert_allclose(
        truth.wheel_speeds, torques * STEP / uneven.flywheel_inertias, rtol=1e-9, atol=1e-12)
    # A single torque gives 1 rad/s^2 * 0.5 ms; the sum is zero within rounding.
    assert np.abs(truth.link_rates).max() < 1e-14


@pytest.mark.parametrize('failed', [None, 0, 3])
@each_seed
def test_null_torques_are_the_nearest_to_the_wanted_ones(
    seed: int, failed: int | None, at_rest: Callable[[int], Plant], uneven: Mechanism,
) -> None:
    """The difference is orthogonal to the null space in the metric."""
    rows = reduced_form(uneven, at_rest(seed).truth().link_angles, np.zeros(2)).wheel_map
    rng = np.random.default_rng(seed)
    available = np.arange(4) != failed
    metric = np.where(available, uneven.flywheel_inertias, 0.0)
    wanted = rng.uniform(-1.0, 1.0, 4)
    torques, factor = take(rows, metric, wanted)
    assert factor == 1.0
    assert not torques[~available].any()
    np.testing.assert_allclose(rows @ torques, 0.0, atol=1e-14)
    free = null_space(rows[:, available])
    assert free.shape[1] == available.sum() - 2
    left_out = (wanted - torques)[available] / (metric[available] / metric.max())
    np.testing.assert_allclose(free.T @ left_out, 0.0, atol=1e-13)


@each_seed
def test_given_torques_have_priority(seed: int, at_rest: Callable[[int], Plant], uneven: Mechanism
                                     ) -> None:
    """The sum with the given torques is within the bounds, and the factor is the largest one."""
    rows = reduced_form(uneven, at_rest(seed).truth().link_angles, np.zeros(2)).wheel_map
    metric = uneven.flywheel_inertias
    rng = np.random.default_rng(seed)
    lower, upper = -rng.uniform(0.0, 1.0, 4), rng.uniform(0.0, 1.0, 4)
    given, wanted = rng.uniform(lower, upper), rng.uniform(-3.0, 3.0, 4)
    torques, factor = take(rows, metric, wanted, lower, upper, given)
    full, _ = take(rows, metric, wanted)
    np.testing.assert_allclose(torques, factor * full, atol=1e-15)
    margins = np.minimum(upper - given - torques, given + torques - lower)
    assert margins.min() >= -1e-15
    assert factor == 1.0 or margins.min() < 1e-15


def test_motor_at_its_limit_gives_no_null_torque(paper: Mechanism) -> None:
    form = reduced_form(paper, assemble(paper, 0.0, 1.0), np.zeros(2))
    metric, limits = np.ones(4), np.ones(4)
    given = np.array([1.0, 0.2, 1.0 + 1e-16, 0.2])
    # Motor a or c is at its limit; one factor applies to all.
    torques, factor = take(form.wheel_map, metric, np.array([1.0, 1.0, -1.0, -1.0]), -limits,
                           limits, given)
    assert factor == 0.0
    assert not torques.any()
    # The pair b, d does not need a and c, in spite of rounding.
    torques, factor = take(form.wheel_map, metric, np.array([0.0, 0.5, 0.0, -0.5]), -limits,
                           limits, given)
    assert factor == 1.0
    np.testing.assert_allclose(torques, [0.0, 0.5, 0.0, -0.5], atol=1e-15)


def test_opposite_torques_near_a_change_point_are_no_null_motion(paper: Mechanism) -> None:
    """With eta as an axis the null space of a rhombus has one dimension, (1, -1, -1, 1)."""
    rows = np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0], [0.5, 0.5, -0.5, -0.5]])
    torques, _ = take(rows, np.ones(4), np.array([1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(torques, [0.25, -0.25, -0.25, 0.25], rtol=1e-14)


@pytest.mark.parametrize('wanted', [(1.0, 0.0, 0.0, 0.0), (0.3, -2.0, 5.0, 1.0)])
def test_wheel_without_partner_has_no_null_motion(wanted: tuple[float, ...]) -> None:
    rows = np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0]])
    torques, factor = take(rows, np.array([1.0, 0.0, 0.0, 1.0]), np.array(wanted))
    assert factor == 1.0
    np.testing.assert_allclose(torques, 0.0, atol=1e-15)


def test_null_torques_do_not_act_on_a_lost_direction() -> None:
    """Wheel c has too little leverage to drive axis a, and would still move it."""
    rows = np.array([[1.0, 0.0, 0.01, 0.3], [0.0, 1.0, 0.4, 1.0]])
    torques, _ = take(rows, np.array([0.0, 1.0, 1.0, 1.0]), np.array([0.0, 1.0, 2.0, -1.0]))
    assert np.abs(torques).max() > 0.1
    np.testing.assert_allclose(rows @ torques, 0.0, atol=1e-15)


# Targets

def settle(mechanism: Mechanism, target: Array, speeds: Array, metric: Array) -> Array:
    """Return the speeds of wheels of a rhombus after 20 time constants."""
    rows = reduced_form(mechanism, assemble(mechanism, 0.0, 1.0), np.zeros(2)).wheel_map
    inertias = mechanism.flywheel_inertias
    for _ in range(4000):
        torques, _ = take(rows, metric, towards(speeds, target, inertias, 5.0))
        speeds = speeds + torques / inertias * 1e-3
    return speeds


@pytest.fixture(scope='module')
def unequal_wheels(paper: Mechanism) -> Mechanism:
    """Make the linkage of the paper with four different wheels."""
    return replace(
        paper, flywheel_inertias=paper.flywheel_inertias * np.array([1.0, 2.0, 3.0, 0.5]))


def test_balanced_wheels_share_the_momentum_of_their_pair(unequal_wheels: Mechanism) -> None:
    """Equal speeds have the least energy; the error after 20 time constants is 1e-8."""
    inertias = unequal_wheels.flywheel_inertias
    start = np.array([100.0, -20.0, -50.0, 60.0])
    rates = np.array([0.1, 0.2, 0.1, 0.2])
    speeds = settle(unequal_wheels, target_speeds('balanced', rates, 30.0), start,
                    inertias)
    momenta = inertias * start
    pairs = momenta[:2] + momenta[2:]
    expected = pairs / (inertias[:2] + inertias[2:])
    np.testing.assert_allclose(speeds, np.tile(expected, 2), atol=1e-5)


def test_target_zero_is_zero_speed_relative_to_the_links() -> None:
    rates = np.array([0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(target_speeds('zero', rates, 30.0), rates)
    assert not towards(rates, target_speeds('zero', rates, 30.0), np.ones(4), 5.0).any()


def test_target_bias_keeps_unloaded_wheels_turning(paper: Mechanism
                                                   ) -> None:
    inertias = paper.flywheel_inertias
    metric = inertias
    target = target_speeds('bias', np.zeros(4), 30.0)
    np.testing.assert_allclose(
        settle(paper, target, np.zeros(4), metric), [30.0, 30.0, -30.0, -30.0], atol=1e-5)
    # The momentum of a pair adds the same speed to both wheels.
    np.testing.assert_allclose(
        settle(paper, target, np.array([10.0, 0.0, 10.0, 0.0]), metric),
        [40.0, 30.0, -20.0, -30.0], atol=1e-5)


def test_wheel_approaches_its_target_exponentially(paper: Mechanism) -> None:
    """The error is exp(-bandwidth t) to 1e-4, with steps of 1e-4 time constants."""
    inertias, speeds, target = paper.flywheel_inertias, np.full(4, 80.0), np.full(4, 30.0)
    for _ in range(20_000):
        speeds = speeds + towards(speeds, target, inertias, 5.0) / inertias * 2e-5
    np.testing.assert_allclose(speeds, 30.0 + 50.0 * np.exp(-2.0), rtol=1e-3)


def test_unknown_target_is_refused(refuses: Refuses) -> None:
    with refuses(TargetError, name='wheel_target', value='fast', limit=TARGETS):
        target_speeds('fast', np.zeros(4), 1.0)
    for name in TARGETS:
        assert target_speeds(name, np.zeros(4), 1.0).shape == (4,)


@pytest.mark.medium
def test_null_torques_are_finite_for_any_input() -> None:
    """Cases: dependent rows, no wheels, empty bounds; seed 7."""
    rng = np.random.default_rng(7)
    for trial in range(5000):
        rows = rng.choice([0.0, 1.0, -1.0, 0.5, 1e-9, 30.0], (int(rng.integers(1, 4)), 4))
        metric = rng.choice([0.0, 1.0, 0.5, 0.01], 4)
        limits = rng.choice([0.0, 1.0, np.inf], 4)
        wanted = rng.choice([0.0, 1.0, -2.0, 1e-18], 4)
        torques, factor = take(rows, metric, wanted, -limits, limits)
        assert 0.0 <= factor <= 1.0, f'trial {trial}'
        assert np.isfinite(torques).all(), f'trial {trial}'
        assert (np.abs(torques) <= limits).all(), f'trial {trial}'
        # Directions with less than 1e-12 of the largest gain, at most 60, are ignored. Torques
        # are at most 4, and ten times as large in the metric.
        assert np.abs(rows @ torques).max() < 1e-12 * 60.0 * 40.0, f'trial {trial}'
