# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Torques of the tracking law in the equations of motion of all four links."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi

from fourbar_ros.control import ControllerSettings
from fourbar_ros.control.allocation import ALLOCATIONS
from fourbar_ros.control.branch import Branch, BRANCHES, PARALLELOGRAM
from fourbar_ros.control.reference_generator import ReferenceGenerator
from fourbar_ros.control.tracking_law import (
    HORIZON,
    LawOutput,
    motor_bounds,
    TrackingLaw,
)
from fourbar_ros.mechanism import assemble, load_mechanism, Mechanism, reduced_form
from fourbar_ros.mechanism.change_points import HOLD_FADES_TO
from fourbar_ros.mechanism.motors import available_torque, motors_of
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Accelerations = Callable[[Mechanism, Array, Array, Array], Array]

SEEDS = range(10)
NONE, QUIET, ALL = np.zeros(4), np.zeros(2), np.ones(4, dtype=bool)
STIFFNESS, DAMPING = 16.0, 7.2

each_seed = pytest.mark.parametrize('seed', SEEDS)


def without_limits(mechanism: Mechanism) -> Mechanism:
    """Return a linkage with very large motor limits; `bounded` needs finite ones."""
    return replace(
        mechanism, motor_torque_limits=np.full(4, 1e3), motor_speed_limits=np.full(4, 1e9),
        motor_voltages=np.full(4, np.inf))


def reference_at(mechanism: Mechanism, angles: Array, rates: Array, accelerations: Array
                 ) -> ReferenceGenerator:
    """Make a reference in motion."""
    reference = ReferenceGenerator(mechanism)
    reference.rest_at(angles)
    reference.angles[:] = angles
    reference.rates[:], reference.accelerations[:] = rates, accelerations
    return reference


def consistent(mechanism: Mechanism, angles: Array, rates: Array) -> Array:
    """Complete the rates of links a and b by paper eq. 6."""
    gamma = reduced_form(mechanism, angles, rates).gamma
    return np.concatenate([rates, gamma @ rates])


def law_of(mechanism: Mechanism, usable: NDArray[np.bool_] = ALL, **settings: float | str
           ) -> TrackingLaw:
    law = TrackingLaw(mechanism)
    law.tune(ControllerSettings(**settings), usable)  # type: ignore[arg-type]
    return law


def update(law: TrackingLaw, reference: ReferenceGenerator, angles: Array, rates: Array,
           disturbance: Array = QUIET, speeds: Array = NONE, friction: Array = NONE,
           sticking: float = 0.0) -> LawOutput:
    return law.update(reference, angles, rates, disturbance, speeds, friction, sticking)


# Accelerations of the links

@pytest.mark.parametrize('target', ['free', 'balanced', 'zero', 'bias'])
@pytest.mark.parametrize('allocation', ALLOCATIONS)
@each_seed
def test_links_have_the_demanded_accelerations(
    seed: int, allocation: str, target: str, uneven: Mechanism, accelerations: Accelerations,
) -> None:
    """Null-space torques have no effect in any pose and motion."""
    rng = np.random.default_rng(seed)
    mechanism = without_limits(uneven)
    phi_a = rng.uniform(-3.0, 3.0)
    angles = assemble(mechanism, phi_a, phi_a + rng.uniform(0.9, 2.0),
                      'open' if seed % 2 else 'crossed')
    rates = consistent(mechanism, angles, rng.uniform(-1.0, 1.0, 2))
    behind, slower = rng.uniform(-0.05, 0.05, 4), rng.uniform(-0.5, 0.5, 4)
    planned = rng.uniform(-2.0, 2.0, 4)
    reference = reference_at(mechanism, angles + behind, rates + slower, planned)
    found = update(law_of(mechanism, allocation=allocation, wheel_target=target), reference,
                   angles, rates, speeds=rng.uniform(-100.0, 100.0, 4))
    assert found.scale == 1.0
    asked = planned + DAMPING * slower + STIFFNESS * behind
    given = accelerations(mechanism, angles, rates, found.torques)
    np.testing.assert_allclose(given[:2], asked[:2], rtol=1e-9, atol=1e-9, err_msg=f'seed {seed}')
    # The planned torques give the planned accelerations.
    np.testing.assert_allclose(
        accelerations(mechanism, angles, rates, found.planned)[:2], planned[:2], rtol=1e-9,
        atol=1e-9, err_msg=f'seed {seed}')


@pytest.mark.parametrize('linkage', ['paper', 'prototype', 'parallelogram'])
@each_seed
def test_pairs_have_the_demanded_accelerations(
    seed: int, linkage: str, request: pytest.FixtureRequest, accelerations: Accelerations,
) -> None:
    """The pairs stay on the branch by the hold and by the closure."""
    rng = np.random.default_rng(seed)
    mechanism = without_limits(request.getfixturevalue(linkage))
    theta = rng.choice([rng.uniform(0.4, 2.7), rng.uniform(0.02, 0.3), pi - 0.01])
    angles = rng.uniform(-3.0, 3.0) + np.array([0.0, theta, 0.0, theta])
    rates, behind, planned = (np.tile(rng.uniform(-size, size, 2), 2) for size in (1.0, 0.05, 2.0))
    reference = reference_at(mechanism, angles + behind, NONE, planned)
    found = update(law_of(mechanism, wheel_target='zero'), reference, angles, rates,
                   speeds=rng.uniform(-100.0, 100.0, 4))
    asked = planned - DAMPING * rates + STIFFNESS * behind
    # Next to a change point the joint forces are large, and their rounding errors too.
    np.testing.assert_allclose(
        accelerations(mechanism, angles, rates, found.torques), asked, rtol=1e-7, atol=1e-7,
        err_msg=f'seed {seed}')


@pytest.mark.parametrize('wheels', [(0, 1, 2, 3), (1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)])
@pytest.mark.parametrize('theta', [0.0, pi])
@pytest.mark.parametrize('linkage', ['paper', 'prototype', 'parallelogram'])
def test_eta_has_the_demanded_acceleration_at_a_change_point(
    linkage: str, theta: float, wheels: tuple[int, ...], request: pytest.FixtureRequest,
    accelerations: Accelerations,
) -> None:
    """With four wheels or three, the accelerations of the pairs do not depend on eta."""
    mechanism = without_limits(request.getfixturevalue(linkage))
    angles, rates = 0.3 + np.array([0.0, theta, 0.0, theta]), np.tile([0.2, -0.5], 2)
    law = law_of(mechanism, np.isin(range(4), wheels), branch_bandwidth=8.0)
    resting = reference_at(mechanism, angles, rates, NONE)
    free = update(law, resting, angles, rates).axes.wheel_map[2].copy()
    eta, eta_rate, planned = 0.01, -0.05, np.tile([0.7, -0.4], 2)
    reference = reference_at(mechanism, angles, rates, planned)
    reference.angles -= eta * free
    reference.rates -= eta_rate * free
    found = update(law, reference, angles, rates)
    assert found.axes.hold == 1.0
    given = accelerations(mechanism, angles, rates, found.torques)
    asked = -64.0 * eta - 16.0 * eta_rate
    np.testing.assert_allclose(given - planned, asked * free, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('wheels', [(0, 1), (2, 3), (0, 3)])
@pytest.mark.parametrize('theta', [0.0, pi])
def test_two_wheels_do_not_control_eta(
    theta: float, wheels: tuple[int, ...], paper: Mechanism, accelerations: Accelerations,
) -> None:
    """They drive the axes as demanded, independent of errors of eta."""
    mechanism = without_limits(paper)
    angles, planned = 0.3 + np.array([0.0, theta, 0.0, theta]), np.tile([0.7, -0.4], 2)
    law = law_of(mechanism, np.isin(range(4), wheels))
    reference = reference_at(mechanism, angles, NONE, planned)
    fine = update(law, reference, angles, NONE).torques.copy()
    reference.angles += 0.01 * law.output.axes.wheel_map[2]
    found = update(law, reference, angles, NONE)
    np.testing.assert_allclose(found.torques, fine, atol=1e-16)
    assert not found.torques[~np.isin(range(4), wheels)].any()
    given = accelerations(mechanism, angles, NONE, found.torques)
    np.testing.assert_allclose(0.5 * (given[:2] + given[2:]), planned[:2], rtol=1e-10)


@pytest.mark.parametrize('branch', BRANCHES[1:], ids=lambda branch: branch.name)
@pytest.mark.parametrize('linkage', ['paper', 'prototype'])
@each_seed
def test_pairs_of_other_branches_have_the_demanded_accelerations(
    seed: int, linkage: str, branch: Branch, request: pytest.FixtureRequest,
    accelerations: Accelerations,
) -> None:
    rng = np.random.default_rng(seed)
    mechanism = without_limits(request.getfixturevalue(linkage))
    theta = rng.choice([rng.uniform(0.4, 2.7), rng.uniform(0.05, 0.3), pi - 0.05])
    phi, pair_angle = rng.uniform(-3.0, 3.0), np.full(2, branch.pair_angle)
    angles = branch.to_links(np.array([phi, phi + theta]), pair_angle)
    rates, behind, planned = (branch.to_links(rng.uniform(-size, size, 2), np.zeros(2))
                              for size in (1.0, 0.05, 2.0))
    reference = reference_at(mechanism, angles, NONE, planned)
    reference.branch = branch
    reference.angles[:] = angles + behind
    found = update(law_of(mechanism, wheel_target='zero'), reference, angles, rates,
                   speeds=rng.uniform(-100.0, 100.0, 4))
    asked = planned - DAMPING * rates + STIFFNESS * behind
    # Next to a change point the joint forces are large, and their rounding errors too.
    np.testing.assert_allclose(
        accelerations(mechanism, angles, rates, found.torques), asked, rtol=1e-7, atol=1e-7,
        err_msg=f'seed {seed}')


@pytest.mark.parametrize('usable', [4, 3])
@pytest.mark.parametrize('linkage', ['paper', 'parallelogram'])
def test_torques_are_smooth_where_the_hold_decreases(
    linkage: str, usable: int, request: pytest.FixtureRequest,
) -> None:
    """Second differences of a smooth function are quadratic in the step, of a corner linear."""
    mechanism = without_limits(request.getfixturevalue(linkage))
    law = law_of(mechanism, np.arange(4) < usable, wheel_target='balanced')

    def largest(count: int) -> float:
        torques = []
        for theta in np.linspace(0.02, np.arcsin(HOLD_FADES_TO) + 0.1, count):
            angles = np.array([0.0, theta, 0.0, theta])
            reference = reference_at(mechanism, angles + [0.01, -0.02, 0.005, 0.01], NONE, NONE)
            reference.branch = PARALLELOGRAM
            torques.append(update(law, reference, angles, NONE,
                                  speeds=np.array([50.0, -20.0, 10.0, 80.0])).torques.copy())
        return float(np.abs(np.diff(torques, 2, axis=0)).max())
    assert largest(801) < 0.3 * largest(401)


@each_seed
def test_compensated_disturbance_has_no_effect(
    seed: int, uneven: Mechanism, accelerations: Accelerations,
) -> None:
    """The wheels take the given share of torques on links a and b."""
    rng = np.random.default_rng(seed)
    mechanism, share = without_limits(uneven), float(rng.uniform(0.0, 1.0))
    angles = assemble(mechanism, 0.1, 0.1 + rng.uniform(0.9, 2.0))
    pushed = np.append(rng.uniform(-1e-4, 1e-4, 2), [0.0, 0.0])
    law = law_of(mechanism, disturbance_compensation=share)
    found = update(law, reference_at(mechanism, angles, NONE, NONE), angles, NONE, pushed[:2])
    with_wheels = accelerations(mechanism, angles, NONE, found.torques - pushed)
    alone = accelerations(mechanism, angles, NONE, -pushed)
    np.testing.assert_allclose(with_wheels, (1.0 - share) * alone, rtol=1e-8, atol=1e-8,
                               err_msg=f'seed {seed}')


# Bounds

@pytest.mark.parametrize('name', ['paper', 'prototype'])
@each_seed
def test_motors_can_give_all_torques_within_their_bounds(seed: int, name: str) -> None:
    """The test uses the motor law of the plant with friction; zero is always within the bounds."""
    rng = np.random.default_rng(seed)
    mechanism = load_mechanism(name)
    motors = motors_of(mechanism)
    limits, inertias = mechanism.motor_speed_limits, mechanism.flywheel_inertias
    speeds = rng.uniform(-1.2, 1.2, 4) * limits
    friction = rng.uniform(-0.1, 0.1, 4) * mechanism.motor_torque_limits
    lower, upper = np.empty(4), np.empty(4)
    share = float(rng.uniform(0.5, 1.0))
    motor_bounds(speeds, friction, share, motors, lower, upper)
    assert (lower <= 0.0).all()
    assert (upper >= 0.0).all()
    for wheel in range(4):
        for torque in (lower[wheel], upper[wheel]):
            if torque == 0.0:
                continue
            asked = torque + friction[wheel]
            assert available_torque(wheel, asked, speeds[wheel], motors) == asked, f'seed {seed}'
            # The speed stays within its limit for the horizon, and no excess increases.
            reached = speeds[wheel] + HORIZON * torque / inertias[wheel]
            assert abs(reached) <= max(limits[wheel], abs(speeds[wheel])) * (1.0 + 1e-12)
    # Far from the limits the bounds are the share of the motor limit.
    motor_bounds(np.zeros(4), NONE, share, motors, lower, upper)
    largest = np.minimum(mechanism.motor_torque_limits, inertias / HORIZON * limits)
    np.testing.assert_allclose(upper, np.minimum(
        share * mechanism.motor_torque_limits, largest), rtol=1e-12)
    np.testing.assert_allclose(lower, -upper, rtol=1e-12)


@pytest.mark.parametrize('target', ['free', 'bias'])
@pytest.mark.parametrize('allocation', ALLOCATIONS)
@each_seed
def test_bounds_are_kept_with_all_contributions(
    seed: int, allocation: str, target: str, prototype: Mechanism,
) -> None:
    """The errors exceed the capacity of the motors, near and far from change points."""
    rng = np.random.default_rng(seed)
    theta = rng.choice([0.02, 0.2, 0.3, 1.2])
    angles = np.array([0.0, theta, 0.0, theta])
    reference = reference_at(prototype, angles, NONE, NONE)
    reference.angles += rng.uniform(-0.5, 0.5, 4)
    law = law_of(prototype, rng.permutation([True, True, True, bool(seed % 2)]),
                 allocation=allocation, wheel_target=target, wheel_bandwidth=5.0)
    friction = rng.uniform(-1e-3, 1e-3, 4)
    found = update(law, reference, angles, rng.uniform(-0.5, 0.5, 4),
                   speeds=rng.uniform(-300.0, 300.0, 4), friction=friction)
    assert 0.0 <= found.scale <= 1.0
    assert (found.torques >= found.lower - 1e-15).all(), f'seed {seed}'
    assert (found.torques <= found.upper + 1e-15).all(), f'seed {seed}'
    assert not found.torques[~law.usable].any()
    assert (np.abs(found.torques + friction) <= prototype.motor_torque_limits).all()


def test_plan_contains_no_feedback(prototype: Mechanism) -> None:
    """A reference at rest has no planned torque at any errors."""
    angles = np.array([0.0, 1.0, 0.0, 1.0])
    reference = reference_at(prototype, angles + 0.1, NONE, NONE)
    found = update(law_of(prototype), reference, angles, NONE)
    assert found.torques.any()
    np.testing.assert_allclose(found.planned, 0.0, atol=1e-18)


# Lost axes

@pytest.mark.parametrize(('wheels', 'lost'), [
    ((0, 1, 2, 3), []), ((0, 1), []), ((2, 3), []), ((0, 3), []), ((1, 2, 3), []),
    ((0, 2), ['b']), ((1, 3), ['a']), ((0,), ['b']), ((3,), ['a'])])
def test_axes_that_no_wheel_turns_are_lost(
    wheels: tuple[int, ...], lost: list[str], paper: Mechanism,
) -> None:
    law = law_of(paper, np.isin(range(4), wheels))
    angles = assemble(paper, 0.0, 1.0)
    update(law, reference_at(paper, angles, NONE, NONE), angles, NONE)
    assert law.lost_axes() == lost


def test_no_branch_is_held_off_the_parallelogram(uneven: Mechanism) -> None:
    angles = assemble(uneven, 0.0, 1.0)
    found = update(law_of(uneven), reference_at(uneven, angles, NONE, NONE), angles, NONE)
    assert found.axes.hold == 0.0
    assert not found.axes.eta_row.any()
