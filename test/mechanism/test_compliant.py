# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Compliant joints: independent derivation, conservation, rigid limit, change points."""

from collections.abc import Callable
from dataclasses import replace
from math import ceil

from fourbar_ros.mechanism import assemble, branch_of, Mechanism, reduced_form
from fourbar_ros.mechanism.compliant import RESOLUTION
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import move_held, move_with_cosines
from fourbar_ros.mechanism.momentum import (
    body_motion,
    joint_gaps,
    linear_momentum,
    mechanical_energy,
    total_angular_momentum,
)
from fourbar_ros.mechanism.state import (
    CENTRE_COMPENSATION,
    CENTRE_POSITION,
    CENTRE_VELOCITY,
    JOINT_GAP_RATES,
    JOINT_GAPS,
    LINK_ANGLES,
    LINK_RATES,
    make_state,
    WHEEL_ANGLES,
    WHEEL_SPEEDS,
)
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]

SEEDS = range(10)
NONE = np.zeros(4)
FREE = np.zeros(4, dtype=bool)


def soften(linkage: Mechanism, stiffness: float, ratio: float = 0.0) -> Mechanism:
    """
    Return a linkage with equal stiffness [N/m] and damping of all joints.

    :param ratio: damping ratio of 1 kg on one joint.
    """
    return replace(linkage, joint_stiffness=[stiffness] * 4,
                   joint_damping=[2.0 * ratio * np.sqrt(stiffness)] * 4)


def with_uneven_joints(rng: np.random.Generator, linkage: Mechanism) -> Mechanism:
    """Return a linkage with unequal stiffness and damping of the joints."""
    return replace(linkage, joint_stiffness=10.0**rng.uniform(2.0, 3.0, 4),
                   joint_damping=rng.uniform(0.0, 2.0, 4))


def opened(rng: np.random.Generator, state: Array) -> Array:
    """Open the joints of a state by about a centimetre, and add a motion of the whole."""
    state = state.copy()
    for part, size in ((CENTRE_POSITION, 1.0), (CENTRE_VELOCITY, 1.0), (JOINT_GAPS, 0.01),
                       (JOINT_GAP_RATES, 0.1)):
        state[part] = rng.uniform(-size, size, state[part].size)
    return state


def held(linkage: Mechanism, start: Array, step: float, steps: int, torques: Array = NONE
         ) -> Array:
    """Return the states (steps + 1, STATE_SIZE) under constant torques."""
    return move_with_cosines(
        start, step * np.arange(steps + 1), torques, NONE, NONE, 1.5 * step, linkage.constants,
        NOTHING)


# --- An independent derivation ----------------------------------------------------------------

def bodies_of(linkage: Mechanism, state: Array) -> Array:
    """Return a state in the coordinates of the independent derivation."""
    place, speed = body_motion(linkage, state)
    return np.concatenate([np.column_stack([place, state[LINK_ANGLES]]).ravel(),
                           np.column_stack([speed, state[LINK_RATES]]).ravel()])


def driven(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Draw amplitudes (of torques in N m or wheel angles in rad), frequencies and phases."""
    return rng.uniform(-0.3, 0.3, 4), rng.uniform(0.5, 3.0, 4), rng.uniform(-3.0, 3.0, 4)


@pytest.mark.slow
@pytest.mark.parametrize('seed', SEEDS)
def test_motion_agrees_with_an_independent_derivation(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    kane_compliant_motion: Callable[..., Array],
) -> None:
    """Wheels are driven or prescribed in any mix; joints are unequal."""
    rng = np.random.default_rng(seed)
    linkage = with_uneven_joints(rng, random_linkage(rng))
    start = opened(rng, random_state(rng, linkage))
    drive, prescribed = driven(rng), rng.random(4) < 0.5
    constants = linkage.constants_with(prescribed)
    time, step = 0.1, 0.02 / constants.fastest_joint_mode
    end = move_with_cosines(start, np.array([0.0, time]), *drive, step, constants, NOTHING)[-1]
    expected = kane_compliant_motion(linkage, start, time, *drive, prescribed)
    # The phase error of an oscillation of frequency w is w T (w h)^4 / 120 rad after a time T.
    # With gaps of 0.01 m links of at least 0.5 m oscillate by at most 0.03 rad, and their rates by
    # w times that.
    late = constants.fastest_joint_mode * time * 0.02**4 / 120.0
    error = np.abs(bodies_of(linkage, end) - expected)
    assert error[:12].max() < 0.03 * late + 1e-11
    assert error[12:].max() < constants.fastest_joint_mode * (0.03 * late + 1e-11)


@pytest.mark.medium
@pytest.mark.parametrize('seed', SEEDS)
def test_integration_is_of_order_four(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    kane_compliant_motion: Callable[..., Array],
) -> None:
    """Halving the step divides the error by 16."""
    rng = np.random.default_rng(seed)
    linkage = with_uneven_joints(rng, random_linkage(rng))
    start = opened(rng, random_state(rng, linkage))
    drive = driven(rng)
    longest = 0.4 * RESOLUTION / linkage.constants.fastest_joint_mode
    time = 64 * longest
    exact = kane_compliant_motion(linkage, start, time, *drive)
    errors = [
        np.abs(bodies_of(linkage, move_with_cosines(
            start, np.array([0.0, time]), *drive, longest / parts * (1.0 + 1e-9),
            linkage.constants, NOTHING)[-1]) - exact).max() for parts in (1, 2, 4)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    # The next order contributes about a tenth at these steps.
    np.testing.assert_allclose(orders, 4.0, rtol=0.0, atol=0.3)


@pytest.mark.parametrize('seed', SEEDS)
def test_held_wheels_count_as_part_of_their_links(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """A wheel that is prescribed at rest has no torque on its link beyond its inertia."""
    rng = np.random.default_rng(seed)
    linkage = with_uneven_joints(rng, random_linkage(rng))
    start = opened(rng, random_state(rng, linkage))
    fixed = rng.random(4) < 0.5
    start[WHEEL_SPEEDS][fixed] = start[LINK_RATES][fixed]
    heavier = replace(linkage, link_inertias=linkage.link_inertias + np.where(
        fixed, linkage.flywheel_inertias, 0.0))
    torques = np.where(fixed, 0.0, rng.uniform(-1.0, 1.0, 4))
    ours, expected = start.copy(), start.copy()
    move_held(ours, torques, 1e-3, 100, linkage.constants_with(fixed), NOTHING)
    move_held(expected, torques, 1e-3, 100, heavier.constants, NOTHING)
    # The numbers are equal, since these steps are not divided.
    np.testing.assert_array_equal(ours[:8], expected[:8])
    np.testing.assert_array_equal(ours[WHEEL_SPEEDS][fixed], ours[LINK_RATES][fixed])
    np.testing.assert_array_equal(ours[WHEEL_ANGLES][fixed], start[WHEEL_ANGLES][fixed])


# --- Conservation -----------------------------------------------------------------------------

# Phase of the fastest oscillation per step [rad]; the method damps it by (w h)^6 / 144.
FINE = 0.05
STEPS = 1000
TAKEN = STEPS * FINE**6 / 144.0


def swinging(seed: int, random_linkage: Draw, random_state: Callable[..., Array],
             damped: bool = False) -> tuple[Mechanism, Array, float]:
    """Move a linkage with uneven joints freely; return it, its states and the step."""
    rng = np.random.default_rng(seed)
    linkage = with_uneven_joints(rng, random_linkage(rng))
    start = opened(rng, random_state(rng, linkage))
    if not damped:
        linkage = replace(linkage, joint_damping=NONE)
    step = FINE / linkage.constants.fastest_joint_mode
    return linkage, held(linkage, start, step, STEPS), step


def opening(linkage: Mechanism, state: Array) -> Array:
    """Return the opening speeds of joints 1 to 4 amid their gaps, (4,) complex [m/s]."""
    rod = linkage.link_lengths * np.exp(1j * state[LINK_ANGLES])
    rates = state[LINK_RATES]
    slips = []
    for (first, second, fourth), side in (
            (state[JOINT_GAPS].view(complex), rod),
            (state[JOINT_GAP_RATES].view(complex), 1j * rates * rod)):
        third = first + side[1] + second + side[2] - side[3] - fourth - side[0]
        slips.append(np.array([first, second, third, fourth]))
    gaps, gap_rates = slips
    mean: Array = 0.5 * (rates[[0, 1, 3, 0]] + rates[[1, 2, 2, 3]])
    slip: Array = gap_rates - 1j * mean * gaps
    return slip


@pytest.mark.parametrize('damped', [False, True])
@pytest.mark.parametrize('seed', SEEDS)
def test_mass_centre_moves_uniformly(
    seed: int, damped: bool, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """Every Runge-Kutta method conserves linear momentum, a linear function of the state."""
    linkage, states, step = swinging(seed, random_linkage, random_state, damped)
    start, end = states[0], states[-1]
    # Bound: a thousand steps with one rounding of 1 kg m/s of one sign.
    np.testing.assert_allclose(
        linear_momentum(linkage, end), linear_momentum(linkage, start), rtol=0.0, atol=1e-12)
    way = STEPS * step * start[CENTRE_VELOCITY]
    np.testing.assert_allclose(
        end[CENTRE_POSITION], start[CENTRE_POSITION] + way, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('damped', [False, True])
@pytest.mark.parametrize('seed', SEEDS)
def test_angular_momentum_is_conserved(
    seed: int, damped: bool, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    linkage, states, _ = swinging(seed, random_linkage, random_state, damped)
    momentum = [total_angular_momentum(linkage, state) for state in states[::50]]
    # Bound: a thousand roundings of 5 kg m^2/s.
    np.testing.assert_allclose(momentum, momentum[0], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('seed', SEEDS)
def test_energy_is_conserved_without_damping(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    linkage, states, _ = swinging(seed, random_linkage, random_state)
    energies = [mechanical_energy(linkage, state) for state in states[::50]]
    # Energy of the oscillations: the springs, and 1 kg at each joint.
    stretch, speed = joint_gaps(linkage, states[0]) @ [1.0, 1j], opening(linkage, states[0])
    swings = 0.5 * float(linkage.joint_stiffness @ np.abs(stretch)**2 + (np.abs(speed)**2).sum())
    np.testing.assert_allclose(energies, energies[0], rtol=0.0, atol=TAKEN * swings)


@pytest.mark.medium
@pytest.mark.parametrize('seed', SEEDS)
def test_damping_reduces_the_energy_at_every_step(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    linkage, states, _ = swinging(seed, random_linkage, random_state, damped=True)
    energies = [mechanical_energy(linkage, state) for state in states]
    assert np.diff(energies).max() < 0.0


@pytest.mark.parametrize('seed', SEEDS)
def test_energy_loss_is_the_work_of_the_dampers(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The power is damping times opening speed squared, integrated by Simpson's rule."""
    linkage, states, step = swinging(seed, random_linkage, random_state, damped=True)
    lost = mechanical_energy(linkage, states[0]) - mechanical_energy(linkage, states[-1])
    power = np.array([linkage.joint_damping @ np.abs(opening(linkage, x))**2 for x in states])
    work = step / 3.0 * (
        power[0] + 4.0 * power[1::2].sum() + 2.0 * power[2:-1:2].sum() + power[-1])
    # The relative error of the rule is (2 w h)^4 / 180 at twice the frequency.
    assert lost == pytest.approx(work, rel=(2.0 * FINE)**4 / 180.0)
    assert lost > 0.01


# --- The rigid limit --------------------------------------------------------------------------

@pytest.mark.parametrize('seed', SEEDS)
def test_stiff_joints_approach_rigid_ones(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    move_freely: Callable[..., Array],
) -> None:
    """
    The difference in angle is inverse to the stiffness over two decades.

    After the transient the gaps are force over stiffness.
    """
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = random_state(rng, linkage, 0.7)
    rigid = move_freely(linkage, start, 1e-3, 300)[-1]
    apart = []
    for stiffness in (1e4, 1e5, 1e6):
        end = held(soften(linkage, stiffness, 1.0), start, 1e-3, 300)[-1]
        apart.append(np.abs(end[LINK_ANGLES] - rigid[LINK_ANGLES]).max())
    decades = np.log10(np.array(apart[:-1]) / apart[1:])
    # At 1e4 N/m the next power of 1 / stiffness contributes a few hundredths.
    np.testing.assert_allclose(decades, 1.0, rtol=0.0, atol=0.1)


@pytest.mark.parametrize('stiffness', [[1e4] * 4, [1e3, 4e3, 9e3, 2e4]])
def test_static_load_opens_joints_by_force_over_stiffness(
    paper: Mechanism, stiffness: list[float],
) -> None:
    """
    Opposite torques on opposite links of a parallelogram only load the joints.

    Each link takes its couple from two opposite forces, so all four joints carry one force P:
    `e_a x P` times its length balances the torque on link a, `e_b x -P` that on link b.
    """
    linkage = replace(paper, joint_stiffness=stiffness, joint_damping=0.1 * np.sqrt(stiffness))
    state = make_state([0.2, 1.2, 0.2, 1.2])
    torques = np.array([1e-3, -2e-3, -1e-3, 2e-3])
    move_held(state, torques, 1e-3, 50, linkage.constants, NOTHING)
    a, b = 0.1 * np.exp(0.2j), 0.1 * np.exp(1.2j)
    force = np.hypot(*np.linalg.solve([[-a.imag, a.real], [b.imag, -b.real]], torques[:2]))
    gaps = np.hypot(*joint_gaps(linkage, state).T)
    # The gaps turn the links by gap over length, and the force too.
    np.testing.assert_allclose(gaps * stiffness, force, rtol=gaps.max() / 0.1)


def near_alignment(link: int, mismatch: float, stiffness: float) -> tuple[Mechanism, Array]:
    """Return an almost equal-sided rhombus (1 m, 4 kg) near theta = 0 with a rate of 0.3 rad/s."""
    lengths = np.ones(4)
    lengths[link] += mismatch
    linkage = Mechanism(
        lengths, np.ones(4), np.full(4, 1 / 12), np.column_stack([lengths / 2, NONE]),
        np.full(4, 1e-3))
    if np.isfinite(stiffness):
        linkage = soften(linkage, stiffness, 0.1)
    angles, rates = assemble(linkage, 0.15, -0.15), np.array([-0.15, 0.15])
    dependent = reduced_form(linkage, angles, rates).gamma @ rates
    return linkage, make_state(angles, np.concatenate([rates, dependent]))


@pytest.mark.parametrize('mismatch', [1e-3, -1e-3])
@pytest.mark.parametrize('link', range(4))
def test_soft_rhombus_with_a_mismatch_passes(link: int, mismatch: float) -> None:
    """
    In line, four springs have the mismatch x and the energy stiffness x^2 / 8.

    At 1e3 N/m that is a hundredth of the kinetic energy of theta, 0.015 J.
    """
    linkage, state = near_alignment(link, mismatch, 1e3)
    move_held(state, NONE, 1e-3, 2000, linkage.constants, NOTHING)
    a, b, c, d = state[LINK_ANGLES]
    assert b - a > 0.25
    assert abs(c - a) < 0.02
    assert abs(d - b) < 0.02


@pytest.mark.parametrize('stiffness', [1e7, np.inf])
@pytest.mark.parametrize('link', range(4))
def test_stiff_rhombus_with_a_mismatch_folds(link: int, stiffness: float) -> None:
    """The pairs are then a with b and c with d; the sign of the mismatch decides the side."""
    ways = []
    for mismatch in (1e-3, -1e-3):
        linkage, state = near_alignment(link, mismatch, stiffness)
        move_held(state, NONE, 1e-3, 2000, linkage.constants, NOTHING)
        a, b, c, d = state[LINK_ANGLES]
        # Theta times the angle between the pairs is about mismatch over length.
        assert abs(b - a) < 0.01
        assert abs(d - c) < 0.01
        ways.append(c - a)
    assert min(np.abs(ways)) > 0.5
    assert ways[0] * ways[1] < 0.0


@pytest.mark.parametrize('change_point', [0.0, np.pi])
def test_soft_rhombus_passes_change_points_as_a_parallelogram(change_point: float) -> None:
    """With equal lengths the springs carry only the forces of the rotation."""
    linkage = soften(Mechanism(  # type: ignore[arg-type]
        [1.0] * 4, [1.0] * 4, [1 / 12] * 4, [[0.5, 0.0]] * 4, [1e-3] * 4), 1e4, 0.1)
    start = make_state(np.tile([0.15, change_point - 0.15], 2), np.tile([-0.15, 0.15], 2))
    end = held(linkage, start, 1e-3, 2000)[-1]
    # Uniform links in a parallelogram turn at constant rates.
    np.testing.assert_allclose(
        end[LINK_ANGLES], start[LINK_ANGLES] + 2.0 * start[LINK_RATES], rtol=0.0, atol=1e-3)
    assert branch_of(end[LINK_ANGLES]) == 'open'


# --- Steps ------------------------------------------------------------------------------------

@pytest.mark.medium
@pytest.mark.parametrize(('stiffness', 'damping'), [(1e5, 0.0), (1e5, 50.0), (1e3, 500.0)])
def test_long_steps_at_stiff_joints_stay_stable(stiffness: float, damping: float) -> None:
    """Links of 0.3 m and 0.6 kg start at rest with gaps of 1 mm; ten seconds at 5 ms."""
    linkage = Mechanism(  # type: ignore[arg-type]
        [0.3] * 4, [0.6] * 4, [6e-3] * 4, [[0.15, 0.0]] * 4, [1.2e-4] * 4,
        joint_stiffness=[stiffness] * 4, joint_damping=[damping] * 4)
    start = make_state([0.0, 1.0, 0.0, 1.0])
    start[JOINT_GAPS] = [1e-3, 0.0, 0.0, 1e-3, -1e-3, 1e-3]
    states = held(linkage, start, 5e-3, 2000)
    energies = np.array([mechanical_energy(linkage, state) for state in states])
    # Stable explicit methods damp every oscillation slightly.
    assert np.diff(energies).max() <= 1e-12 * energies[0]
    assert energies[-1] < energies[0]


@pytest.mark.parametrize('seed', SEEDS)
def test_long_step_is_divided_according_to_the_joints(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """One long step equals the same number of short ones."""
    rng = np.random.default_rng(seed)
    linkage = with_uneven_joints(rng, random_linkage(rng))
    start = opened(rng, random_state(rng, linkage))
    torques, step = rng.uniform(-1.0, 1.0, 4), 0.05
    parts = ceil(linkage.constants.fastest_joint_mode * step / RESOLUTION)
    assert parts > 3
    once, many = start.copy(), start.copy()
    move_held(once, torques, step, 1, linkage.constants, NOTHING)
    move_held(many, torques, step / parts, parts, linkage.constants, NOTHING)
    # The state is rounded between short steps; speeds reach about 10 rad/s. The last entries
    # are the compensation of rounding errors.
    np.testing.assert_allclose(
        once[:CENTRE_COMPENSATION.start], many[:CENTRE_COMPENSATION.start], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('seed', SEEDS)
def test_state_is_unchanged_after_conversion_to_bodies_and_back(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The test uses a step of zero time with open joints and any mass centre."""
    rng = np.random.default_rng(seed)
    linkage = with_uneven_joints(rng, random_linkage(rng))
    start = opened(rng, random_state(rng, linkage))
    there = start.copy()
    move_held(there, rng.uniform(-1.0, 1.0, 4), 0.0, 1, linkage.constants, NOTHING)
    np.testing.assert_allclose(there, start, rtol=0.0, atol=1e-14)
