# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The reduced equations against values by hand and against an independent derivation."""

from collections.abc import Callable
from typing import Any

from fourbar_ros.mechanism import (
    angular_momentum,
    kinetic_energy,
    load_mechanism,
    Mechanism,
    reduced_form,
)
from fourbar_ros.mechanism.constrained import constrained_accelerations, directions, LinkMotion
from fourbar_ros.mechanism.dynamics import ChangePointError, mass_matrix
from fourbar_ros.mechanism.forces import NOTHING, System
from fourbar_ros.mechanism.integration import evaluate
from fourbar_ros.mechanism.reduced import reduced_accelerations, ReducedMotion, side_of_joint_3
from fourbar_ros.mechanism.state import (
    LINK_ANGLES,
    LINK_RATES,
    make_state,
    WHEEL_SPEEDS,
)
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]

SEEDS = range(40)
ANGLES = (0.05, 0.3, 1.0, np.pi / 2, 2.0, 3.0, -0.8)


def parallelogram(length_a: float, length_b: float, offsets: Any = (0.0,) * 4) -> Mechanism:
    """Make the links of the paper with other lengths and offsets of the mass centres."""
    lengths = np.array([length_a, length_b, length_a, length_b])
    return Mechanism(
        lengths, [0.02] * 4, [2.2e-5] * 4, np.column_stack([0.5 * lengths, offsets]),
        [3.4e-7] * 4)


def condition(linkage: Mechanism, theta: float) -> float:
    """Return the condition number of A of a parallelogram."""
    angles = [0.0, theta, 0.0, theta]
    return float(np.linalg.cond(reduced_form(linkage, angles, [0.0, 0.0]).mass_matrix))


def accelerations(linkage: Mechanism, state: Array, torques: Array) -> Array:
    """Return the accelerations of the links under motor torques by the default form."""
    out = np.empty_like(state)
    evaluate(state, torques, linkage.constants, NOTHING, out)
    return out[LINK_RATES]


def by_reduced_form(linkage: Mechanism, state: Array, torques: Array) -> Array:
    """Return the accelerations of the links by the reduced form."""
    a, b, c, d = state[LINK_ANGLES]
    motion = ReducedMotion(a, np.cos(b - a), np.sin(b - a), side_of_joint_3(c, d),
                           *state[LINK_RATES][:2], (0.0, 0.0))
    return np.array(reduced_accelerations(
        motion, torques, System(linkage.constants, NOTHING)).accelerations)


def by_constrained_form(linkage: Mechanism, state: Array, torques: Array) -> Array:
    """Return the accelerations of the links by the constrained form."""
    angles = tuple(state[LINK_ANGLES])
    motion = LinkMotion(angles[0], *directions(angles), tuple(state[LINK_RATES]), (0.0, 0.0))
    return np.array(constrained_accelerations(
        motion, torques, System(linkage.constants, NOTHING), True).accelerations)


# --- Values by hand ---------------------------------------------------------------------------

@pytest.mark.parametrize('theta', ANGLES)
def test_mass_matrix_of_the_paper_is_the_same_in_every_configuration(theta: float) -> None:
    """For identical uniform links A = (2 I + m l^2 / 2) times the unit matrix."""
    form = reduced_form(load_mechanism('paper'), [0.0, theta, 0.0, theta], [0.3, -0.2])
    np.testing.assert_allclose(form.mass_matrix, 1.44e-4 * np.eye(2), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(('ratio', 'expected'), [
    (0.25, 2.8657), (0.5, 2.0870), (1.0, 1.0000), (2.0, 3.0833), (4.0, 11.4167)])
@pytest.mark.parametrize('theta', ANGLES)
def test_conditioning_against_the_ratio_of_lengths(
    theta: float, ratio: float, expected: float,
) -> None:
    """The values are those of paper fig. 6a in any configuration."""
    assert condition(parallelogram(0.1 * ratio, 0.1), theta) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize(('theta', 'offset', 'expected'), [
    (np.pi / 2, 0.02, 1.0), (np.pi / 2, 0.04, 1.0), (0.3, 0.02, 1.1059), (0.3, 0.04, 1.4204)])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_conditioning_against_the_same_offset_in_every_body_frame(
    theta: float, offset: float, expected: float, sign: float,
) -> None:
    """
    All mass centres have y = offset in the frames of their links.

    The offset is towards the inside of the loop for a and d, and to the outside for b and c.
    """
    linkage = parallelogram(0.1, 0.1, [sign * offset] * 4)
    assert condition(linkage, theta) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize(('theta', 'offset', 'expected'), [
    (np.pi / 2, 0.02, 3.0), (np.pi / 2, 0.04, 7.6667), (0.3, 0.02, 1.3468), (0.3, 0.04, 1.5884)])
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_conditioning_against_the_offset_towards_the_inside(
    theta: float, offset: float, expected: float, sign: float,
) -> None:
    """With the signs +, -, -, + (a, b, c, d) all are inside the loop for 0 < theta < pi."""
    linkage = parallelogram(0.1, 0.1, sign * offset * np.array([1.0, -1.0, -1.0, 1.0]))
    assert condition(linkage, theta) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize('theta', ANGLES)
@pytest.mark.parametrize('length_a', [0.05, 0.1, 0.3])
def test_uniform_parallelogram_has_no_bias(length_a: float, theta: float) -> None:
    """The mass centre is the intersection of the diagonals, so A is constant and b is zero."""
    linkage = parallelogram(length_a, 0.1)
    bias = reduced_form(linkage, [0.4, 0.4 + theta, 0.4, 0.4 + theta], [1.0, -2.0]).bias
    # Rounding of I omega^2 is amplified by 1 / sin(theta).
    scale = 4.0 * linkage.constants.cosine.max()
    np.testing.assert_allclose(bias, 0.0, rtol=0.0, atol=1e-14 * scale / abs(np.sin(theta)))


# --- Structure --------------------------------------------------------------------------------

@pytest.mark.parametrize('seed', SEEDS)
def test_mass_matrix_of_the_links_is_symmetric_and_positive(
    seed: int, random_linkage: Draw,
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    matrix = mass_matrix(rng.uniform(-4.0, 4.0, 4), linkage.constants)
    np.testing.assert_allclose(matrix, matrix.T, rtol=0.0, atol=1e-14)
    assert np.linalg.eigvalsh(matrix)[0] > linkage.link_inertias.min() * (1.0 - 1e-12)


@pytest.mark.parametrize('seed', SEEDS)
def test_reduced_mass_matrix_is_symmetric_and_positive(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    matrix = reduced_form(linkage, state[LINK_ANGLES], state[LINK_RATES]).mass_matrix
    assert matrix[0, 1] == matrix[1, 0]
    # The matrix is W^T M W with W^T W >= 1, so no eigenvalue is below the smallest inertia.
    assert np.linalg.eigvalsh(matrix)[0] > linkage.link_inertias.min() * (1.0 - 1e-12)


@pytest.mark.parametrize('seed', SEEDS)
def test_accelerations_meet_the_closure(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The second derivative of the gap, sum of s l (E e alpha - e omega^2), is zero."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    torques = rng.uniform(-1.0, 1.0, 4)
    alpha = accelerations(linkage, state, torques)
    arms = np.array([-1.0, 1.0, 1.0, -1.0]) * linkage.link_lengths * np.exp(1j * state[:4])
    gap = np.sum(arms * (1j * alpha - state[LINK_RATES]**2))
    assert abs(gap) < 1e-13 * np.abs(arms * (1j * alpha - state[LINK_RATES]**2)).sum() / 0.3


@pytest.mark.parametrize('angles', [[0.0] * 4, [0.5] * 4])
def test_reduced_form_is_refused_at_a_change_point(angles: list[float]) -> None:
    with pytest.raises(ChangePointError):
        reduced_form(load_mechanism('paper'), angles, [0.1, 0.2])


def test_wheel_map_of_a_parallelogram() -> None:
    """In paper eq. 6 the columns of c and d equal those of a and b in a parallelogram."""
    form = reduced_form(load_mechanism('paper'), [0.0, 1.0, 0.0, 1.0], [0.0, 0.0])
    np.testing.assert_allclose(
        form.wheel_map, [[1, 0, 1, 0], [0, 1, 0, 1]], rtol=0.0, atol=1e-15)


# --- Reduced and constrained form -------------------------------------------------------------

# In units of order one, the error is a few hundred roundings; the reduced form divides twice by
# the fold.
@pytest.mark.parametrize('fold', [0.3, 0.05])
@pytest.mark.parametrize('seed', SEEDS)
def test_reduced_and_constrained_solutions_agree(
    seed: int, fold: float, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage, fold)
    torques = rng.uniform(-1.0, 1.0, 4)
    reduced = by_reduced_form(linkage, state, torques)
    constrained = by_constrained_form(linkage, state, torques)
    sine = np.sin(state[3] - state[2])
    np.testing.assert_allclose(
        reduced, constrained, rtol=0.0, atol=1e-13 / sine**2 * np.abs(constrained).max())


@pytest.mark.parametrize('theta', [0.0, np.pi])
@pytest.mark.parametrize('seed', SEEDS)
def test_accelerations_are_finite_at_a_change_point(
    seed: int, theta: float, random_parallelogram: Draw,
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_parallelogram(rng)
    phi_a = rng.uniform(-3.0, 3.0)
    rates = rng.uniform(-1.0, 1.0, 2)
    state = make_state(np.tile([phi_a, phi_a + theta], 2), np.tile(rates, 2))
    alpha = accelerations(linkage, state, np.zeros(4))
    assert np.isfinite(alpha).all()


# --- An independent derivation ----------------------------------------------------------------

@pytest.mark.slow
@pytest.mark.parametrize('seed', SEEDS)
def test_accelerations_agree_with_an_independent_model(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    kane_accelerations: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    torques = rng.uniform(-1.0, 1.0, 4)
    expected = kane_accelerations(linkage, state, torques)
    ours = np.empty_like(state)
    evaluate(state, torques, linkage.constants, NOTHING, ours)
    # Rounding times the condition number of the equations in units of order one.
    np.testing.assert_allclose(
        ours[LINK_RATES], expected[:4], rtol=0.0, atol=1e-11 * np.abs(expected[:4]).max())
    np.testing.assert_allclose(ours[WHEEL_SPEEDS], expected[4:], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize('seed', SEEDS)
def test_reduced_form_agrees_with_an_independent_model(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    kane_accelerations: Callable[..., Array],
) -> None:
    """The accelerations of the independent model meet A du + b = -G tau."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    torques = rng.uniform(-1.0, 1.0, 4)
    acceleration = kane_accelerations(linkage, state, torques)[:2]
    form = reduced_form(linkage, state[LINK_ANGLES], state[LINK_RATES])
    inertial = form.mass_matrix @ acceleration + form.bias
    applied = -form.wheel_map @ torques
    scale = np.abs(form.mass_matrix).max() * np.abs(acceleration).max()
    np.testing.assert_allclose(inertial, applied, rtol=0.0, atol=1e-11 * scale)


@pytest.mark.parametrize('seed', SEEDS)
def test_energy_is_the_sum_over_the_bodies(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    momentum_and_energy: Callable[..., tuple[float, float]],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    ours = kinetic_energy(linkage, *np.split(state[:8], 2), state[WHEEL_SPEEDS])
    expected = momentum_and_energy(linkage, *np.split(state[:8], 2), state[WHEEL_SPEEDS])[1]
    assert ours == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize('seed', SEEDS)
def test_momentum_is_the_sum_over_the_bodies(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    momentum_and_energy: Callable[..., tuple[float, float]],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    ours = angular_momentum(linkage, *np.split(state[:8], 2), state[WHEEL_SPEEDS])
    expected = momentum_and_energy(linkage, *np.split(state[:8], 2), state[WHEEL_SPEEDS])[0]
    assert ours == pytest.approx(expected, rel=1e-13, abs=1e-13)


# --- Rates of conserved quantities ------------------------------------------------------------

def rate_of(quantity: Callable[..., float], linkage: Mechanism, state: Array, torques: Array
            ) -> float:
    """Differentiate along the motion by central differences of sixth order."""
    slope = np.empty_like(state)
    evaluate(state, torques, linkage.constants, NOTHING, slope)
    step = 2e-3 / max(1.0, np.abs(slope[LINK_RATES]).max())
    rate = 0.0
    for k, weight in ((1, 45.0), (2, -9.0), (3, 1.0)):
        for sign in (1.0, -1.0):
            there = state + sign * k * step * slope
            rate += sign * weight * quantity(
                linkage, there[LINK_ANGLES], there[LINK_RATES], there[WHEEL_SPEEDS])
    return rate / (60.0 * step)


# Values of about 10 J or kg m^2/s have a relative rounding error of 1e-15, and differences are
# over 2e-3. The error of the formula is about (2e-3)^6; the step is inverse to the rates, since
# accelerations of the random states reach 100 rad/s^2.
ROUNDING_OF_RATES = 1e-15 * 45.0 / 60.0 / 2e-3


@pytest.mark.parametrize('seed', SEEDS)
def test_energy_changes_by_the_power_of_the_motors(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The power of a motor is torque times wheel speed relative to the link."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    torques = rng.uniform(-1.0, 1.0, 4)
    power = torques @ (state[WHEEL_SPEEDS] - state[LINK_RATES])
    rate = rate_of(kinetic_energy, linkage, state, torques)
    energy = kinetic_energy(linkage, *np.split(state[:8], 2), state[WHEEL_SPEEDS])
    alpha = accelerations(linkage, state, torques)
    bound = 10.0 * ROUNDING_OF_RATES * energy * max(1.0, np.abs(alpha).max())
    assert rate == pytest.approx(power, rel=0.0, abs=bound)


@pytest.mark.parametrize('seed', SEEDS)
def test_momentum_does_not_change_under_motor_torques(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    torques = rng.uniform(-1.0, 1.0, 4)
    rate = rate_of(angular_momentum, linkage, state, torques)
    size = (np.abs(linkage.constants.cosine).sum() * np.abs(state[LINK_RATES]).max()
            + linkage.flywheel_inertias @ np.abs(state[WHEEL_SPEEDS]))
    alpha = accelerations(linkage, state, torques)
    assert abs(rate) < 10.0 * ROUNDING_OF_RATES * size * max(1.0, np.abs(alpha).max())


@pytest.mark.parametrize('seed', SEEDS)
def test_opposite_torques_on_opposite_wheels_only_load_the_joints(
    seed: int, random_parallelogram: Draw, random_state: Callable[..., Array],
) -> None:
    """This is the third special case of paper section 3, away from change points."""
    rng = np.random.default_rng(seed)
    linkage = random_parallelogram(rng)
    theta = rng.uniform(0.3, np.pi - 0.3)
    phi_a = rng.uniform(-3.0, 3.0)
    rates = rng.uniform(-1.0, 1.0, 2)
    state = make_state(np.tile([phi_a, phi_a + theta], 2), np.tile(rates, 2))
    first, second = rng.uniform(-1.0, 1.0, 2)
    with_torques = accelerations(
        linkage, state, np.array([first, second, -first, -second]))
    without = accelerations(linkage, state, np.zeros(4))
    # Rounding of tau / I, about 1 N m over the smallest 0.006 kg m^2 of the draw.
    np.testing.assert_allclose(with_torques, without, rtol=0.0, atol=1e-15 / 0.006 / 0.3**2)
