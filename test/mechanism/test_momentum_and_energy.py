# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Momentum, energy and joint gaps, body by body, against cases by hand."""

from collections.abc import Callable
from dataclasses import replace

from fourbar_ros.mechanism import angular_momentum, kinetic_energy, Mechanism
from fourbar_ros.mechanism.momentum import (
    body_motion,
    joint_gaps,
    linear_momentum,
    mechanical_energy,
    total_angular_momentum,
)
from fourbar_ros.mechanism.state import (
    CENTRE_POSITION,
    CENTRE_VELOCITY,
    JOINT_GAP_RATES,
    JOINT_GAPS,
    LINK_ANGLES,
    LINK_RATES,
    make_state,
    WHEEL_SPEEDS,
)
import numpy as np
from numpy.typing import ArrayLike, NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]

SEEDS = range(20)
# A few dozen roundings of numbers of order one to ten.
ROUNDING = 1e-13


def cross(first: Array, second: Array) -> float:
    """Return the z component of a vector product."""
    return float(first[0] * second[1] - first[1] * second[0])


def with_open_joints(rng: np.random.Generator, linkage: Mechanism) -> tuple[Mechanism, Array]:
    """Return a compliant linkage and a state with random angles and gaps."""
    soft = replace(
        linkage, joint_stiffness=rng.uniform(10.0, 1e3, 4), joint_damping=rng.uniform(0, 9.0, 4))
    state = make_state(
        rng.uniform(-np.pi, np.pi, 4), rng.uniform(-1.0, 1.0, 4), rng.uniform(-9.0, 9.0, 4))
    for part, size in ((CENTRE_POSITION, 1.0), (CENTRE_VELOCITY, 1.0), (JOINT_GAPS, 0.1),
                       (JOINT_GAP_RATES, 0.1)):
        state[part] = rng.uniform(-size, size, state[part].size)
    return soft, state


# --- Cases by hand ----------------------------------------------------------------------------

@pytest.fixture
def square() -> Mechanism:
    """Make a square of 2 m of uniform links of 1 kg, whose other parameters differ in size."""
    return Mechanism(  # type: ignore[arg-type]
        [2.0] * 4, [1.0] * 4, [0.25] * 4, [[1.0, 0.0]] * 4, [0.5] * 4, joint_stiffness=[8.0] * 4)


def squared(rates: ArrayLike = 0.0, wheels: ArrayLike = 0.0) -> Array:
    """Return a state of the square with a and c along x, b and d along y, centred at 0."""
    state = make_state([0.0, np.pi / 2, 0.0, np.pi / 2])
    state[LINK_RATES], state[WHEEL_SPEEDS] = rates, wheels
    return state


def test_bodies_of_a_square_lie_around_its_middle(square: Mechanism) -> None:
    """With joint 1 at (-1, -1), a is below, d right, c above, b left."""
    place, speed = body_motion(square, squared())
    expected = [[0.0, -1.0], [-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]
    np.testing.assert_allclose(place, expected, rtol=0.0, atol=ROUNDING)
    np.testing.assert_array_equal(speed, np.zeros((4, 2)))


def test_square_that_turns_is_one_rigid_body(square: Mechanism) -> None:
    """The square has four bodies of 1 kg and 0.25 kg m^2 at 1 m, and wheels that turn too."""
    inertia = 4 * (0.25 + 1.0 * 1.0**2 + 0.5)
    state = squared(3.0, 3.0)
    assert total_angular_momentum(square, state) == pytest.approx(inertia * 3.0, rel=ROUNDING)
    assert mechanical_energy(square, state) == pytest.approx(inertia * 4.5, rel=ROUNDING)
    np.testing.assert_allclose(linear_momentum(square, state), 0.0, rtol=0.0, atol=ROUNDING)


def test_square_that_travels_has_the_momentum_of_its_mass(square: Mechanism) -> None:
    """The angular momentum of 4 kg at (5, 7) m with (2, 3) m/s is 4 (5 3 - 7 2)."""
    state = squared()
    state[CENTRE_POSITION], state[CENTRE_VELOCITY] = [5.0, 7.0], [2.0, 3.0]
    np.testing.assert_allclose(linear_momentum(square, state), [8.0, 12.0], rtol=ROUNDING)
    assert total_angular_momentum(square, state) == pytest.approx(4.0, rel=ROUNDING)
    assert mechanical_energy(square, state) == pytest.approx(0.5 * 4.0 * 13.0, rel=ROUNDING)


@pytest.mark.parametrize('wheel', range(4))
def test_wheel_alone_adds_its_spin(square: Mechanism, wheel: int) -> None:
    state = squared(wheels=np.eye(4)[wheel] * 6.0)
    assert total_angular_momentum(square, state) == pytest.approx(0.5 * 6.0, rel=ROUNDING)
    assert mechanical_energy(square, state) == pytest.approx(0.5 * 0.5 * 36.0, rel=ROUNDING)


@pytest.mark.parametrize('pair', [(0, 2), (1, 3)])
def test_one_pair_of_links_turns_and_shears_the_square(
    square: Mechanism, pair: tuple[int, int],
) -> None:
    """Both links turn about their mass centres and move the two others at 1 m/s per rad/s."""
    rates = np.zeros(4)
    rates[list(pair)] = 2.0
    state = squared(rates)
    inertia = 2 * 0.25 + 2 * 1.0 * 1.0**2
    assert mechanical_energy(square, state) == pytest.approx(inertia * 2.0, rel=ROUNDING)
    assert total_angular_momentum(square, state) == pytest.approx(inertia * 2.0, rel=ROUNDING)


@pytest.mark.parametrize(('gaps', 'expected'), [
    # With joint 1 open, joint 3 has the same gap, since the angles do not change.
    ([0.3, 0.4, 0.0, 0.0, 0.0, 0.0], [[0.3, 0.4], [0.0, 0.0], [0.3, 0.4], [0.0, 0.0]]),
    ([0.0, 0.0, 0.3, 0.4, 0.0, 0.0], [[0.0, 0.0], [0.3, 0.4], [0.3, 0.4], [0.0, 0.0]]),
    ([0.0, 0.0, 0.0, 0.0, 0.3, 0.4], [[0.0, 0.0], [0.0, 0.0], [-0.3, -0.4], [0.3, 0.4]])])
def test_open_joint_opens_joint_3(
    square: Mechanism, gaps: list[float], expected: list[list[float]],
) -> None:
    """Two springs of 8 N/m are stretched by 0.5 m."""
    state = squared()
    state[JOINT_GAPS] = gaps
    np.testing.assert_allclose(joint_gaps(square, state), expected, rtol=0.0, atol=ROUNDING)
    assert mechanical_energy(square, state) == pytest.approx(2 * 0.5 * 8.0 * 0.25, rel=ROUNDING)


def test_opening_joints_move_the_bodies(square: Mechanism) -> None:
    """When joint 2 opens, c moves away and the others at a third of its speed opposite to it."""
    state = squared()
    state[JOINT_GAP_RATES] = [0.0, 0.0, 4.0, 0.0, 0.0, 0.0]
    speed = body_motion(square, state)[1]
    expected = [[-1.0, 0.0], [-1.0, 0.0], [3.0, 0.0], [-1.0, 0.0]]
    np.testing.assert_allclose(speed, expected, rtol=0.0, atol=ROUNDING)
    assert mechanical_energy(square, state) == pytest.approx(0.5 * (3 * 1.0 + 9.0), rel=ROUNDING)
    # About the middle, c has 3 m/s one metre above and a has -1 m/s one metre below.
    assert total_angular_momentum(square, state) == pytest.approx(-3.0 - 1.0, rel=ROUNDING)


# --- Any linkage ------------------------------------------------------------------------------

@pytest.mark.parametrize('seed', SEEDS)
def test_rigid_linkage_has_the_momentum_of_its_link_angles(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The momentum is about the mass centre, which rests in the origin."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    expected = angular_momentum(
        linkage, state[LINK_ANGLES], state[LINK_RATES], state[WHEEL_SPEEDS])
    assert total_angular_momentum(linkage, state) == pytest.approx(
        expected, rel=ROUNDING, abs=ROUNDING)


@pytest.mark.parametrize('seed', SEEDS)
def test_rigid_linkage_has_the_energy_of_its_link_angles(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    expected = kinetic_energy(
        linkage, state[LINK_ANGLES], state[LINK_RATES], state[WHEEL_SPEEDS])
    assert mechanical_energy(linkage, state) == pytest.approx(expected, rel=ROUNDING)


@pytest.mark.parametrize('seed', SEEDS)
def test_rigid_joints_are_closed(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    gaps = joint_gaps(linkage, random_state(rng, linkage))
    np.testing.assert_allclose(gaps, 0.0, rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize('seed', SEEDS)
def test_translation_adds_that_of_the_total_mass(seed: int, random_linkage: Draw) -> None:
    """By Koenig's theorem they are the sum of those about and of the mass centre."""
    rng = np.random.default_rng(seed)
    linkage, travelling = with_open_joints(rng, random_linkage(rng))
    resting = travelling.copy()
    resting[CENTRE_POSITION] = resting[CENTRE_VELOCITY] = 0.0
    mass = linkage.link_masses.sum()
    place, speed = travelling[CENTRE_POSITION], travelling[CENTRE_VELOCITY]
    np.testing.assert_allclose(
        linear_momentum(linkage, travelling), mass * speed, rtol=0.0, atol=ROUNDING)
    assert total_angular_momentum(linkage, travelling) == pytest.approx(
        total_angular_momentum(linkage, resting) + mass * cross(place, speed), abs=ROUNDING)
    assert mechanical_energy(linkage, travelling) == pytest.approx(
        mechanical_energy(linkage, resting) + 0.5 * mass * speed @ speed, rel=ROUNDING)


@pytest.mark.parametrize('seed', SEEDS)
def test_gaps_are_those_of_the_state(seed: int, random_linkage: Draw) -> None:
    """The state has the gaps of joints 1, 2 and 4; that of joint 3 follows from the loop."""
    rng = np.random.default_rng(seed)
    linkage, state = with_open_joints(rng, random_linkage(rng))
    gaps = joint_gaps(linkage, state)
    np.testing.assert_allclose(
        gaps[[0, 1, 3]].ravel(), state[JOINT_GAPS], rtol=0.0, atol=ROUNDING)
    arms = linkage.link_lengths * np.exp(1j * state[LINK_ANGLES])
    ways = gaps @ [1.0, 1j]
    around = ways[0] + arms[1] + ways[1] + arms[2] - ways[2] - arms[3] - ways[3] - arms[0]
    assert abs(around) < ROUNDING


@pytest.mark.parametrize('seed', SEEDS)
def test_speeds_are_derivatives_of_the_positions(seed: int, random_linkage: Draw) -> None:
    """The test uses central differences of order four along a random change of the state."""
    rng = np.random.default_rng(seed)
    linkage, state = with_open_joints(rng, random_linkage(rng))
    slope = np.zeros_like(state)
    for part, rate in ((LINK_ANGLES, LINK_RATES), (CENTRE_POSITION, CENTRE_VELOCITY),
                       (JOINT_GAPS, JOINT_GAP_RATES)):
        slope[part] = state[rate]
    step = 1e-3
    near, far = (
        body_motion(linkage, state + k * step * slope)[0]
        - body_motion(linkage, state - k * step * slope)[0] for k in (1, 2))
    # Rounding is 1e-15 m over 2e-3 s; the error of the formula is 1e-3^4 / 30 times the fifth
    # power of 1 rad/s.
    np.testing.assert_allclose(
        (8.0 * near - far) / (12.0 * step), body_motion(linkage, state)[1], rtol=0.0, atol=2e-12)


@pytest.mark.parametrize('seed', SEEDS)
def test_energy_contains_that_of_the_springs(seed: int, random_linkage: Draw) -> None:
    rng = np.random.default_rng(seed)
    linkage, state = with_open_joints(rng, random_linkage(rng))
    stretch = np.abs(joint_gaps(linkage, state) @ [1.0, 1j])
    without = mechanical_energy(linkage.with_rigid_joints(), state)
    assert mechanical_energy(linkage, state) == pytest.approx(
        without + 0.5 * linkage.joint_stiffness @ stretch**2, rel=ROUNDING)
