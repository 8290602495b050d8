# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Motion through change points: ideal linkages pass, others fold as in other engines."""

from collections.abc import Callable

from fourbar_ros.mechanism import (
    angular_momentum,
    assemble,
    branch_of,
    kinetic_energy,
    load_mechanism,
    Mechanism,
    reduced_form,
)
from fourbar_ros.mechanism.case import Case, simulate
from fourbar_ros.mechanism.dynamics import mass_matrix
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import move_with_cosines
from fourbar_ros.mechanism.state import LINK_ANGLES, LINK_RATES, make_state, WHEEL_SPEEDS
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]

SEEDS = range(20)
NONE = np.zeros(4)


def momentum(linkage: Mechanism, state: Array) -> float:
    """Return the angular momentum of links and wheels."""
    return angular_momentum(
        linkage, state[LINK_ANGLES], state[LINK_RATES], state[WHEEL_SPEEDS])


def momentum_scale(linkage: Mechanism, state: Array) -> float:
    """Return the sum of the sizes of the terms of the momentum, which may cancel."""
    matrix = np.abs(mass_matrix(state[LINK_ANGLES], linkage.constants))
    return float(matrix.sum(axis=0) @ np.abs(state[LINK_RATES])
                 + linkage.flywheel_inertias @ np.abs(state[WHEEL_SPEEDS]))


def energy_of_links(linkage: Mechanism, state: Array) -> float:
    """Return the energy of the links; that of the wheels is larger and constant."""
    return kinetic_energy(linkage, state[LINK_ANGLES], state[LINK_RATES], NONE)


def centripetal_bias(angles: Array, rates: Array, linkage: Mechanism) -> Array:
    """Return the bias h (4,) [N m]."""
    difference = angles[None, :] - angles[:, None]
    constants = linkage.constants
    slope = constants.sine * np.cos(difference) - constants.cosine * np.sin(difference)
    bias: Array = slope @ rates**2
    return bias


def move_under_constant_torques(
    linkage: Mechanism, start: Array, torques: Array, step: float, steps: int,
) -> Array:
    """Return the states (steps + 1, STATE_SIZE) after every step."""
    return move_with_cosines(
        start, step * np.arange(steps + 1), torques, NONE, NONE, 1.5 * step, linkage.constants,
        NOTHING)


CHANGE_POINTS = (0.0, np.pi)
STEP = 5e-4
# Within 1e-4 rad of the change point a rounding of 4e-16 rad changes the rates by 4e-12 of their
# size, once per step that ends there: at 0.01 rad/s about forty times.
ROUNDING = 1e-9


def parallel_state(rng: np.random.Generator, theta: float, rates: Array) -> Array:
    """Make a state of a parallelogram with turning wheels."""
    phi_a = rng.uniform(-3.0, 3.0)
    return make_state(
        np.tile([phi_a, phi_a + theta], 2), np.tile(rates, 2), rng.uniform(-9.0, 9.0, 4))


def passage(
    seed: int, change_point: float, random_parallelogram: Draw,
    torques: Array = NONE, before: float = 1.0,
) -> tuple[Mechanism, Array]:
    """
    Move an ideal parallelogram of four different bodies through a change point.

    It starts 0.03 rad before the change point (times `before`), and theta changes by 0.06 rad at a
    rate of 0.01 to 1 rad/s in either direction. The whole turns at a similar rate.
    """
    rng = np.random.default_rng(seed)
    linkage = random_parallelogram(rng)
    speed = 10.0**rng.uniform(-2.0, 0.0) * rng.choice([-1.0, 1.0])
    rate_a = rng.uniform(-1.0, 1.0) * speed
    start = parallel_state(
        rng, change_point - 0.03 * before * np.sign(speed), np.array([rate_a, rate_a + speed]))
    return linkage, move_under_constant_torques(
        linkage, start, torques * speed**2, STEP, round(0.06 / abs(speed) / STEP))


def motion_of_two_angles(linkage: Mechanism, start: Array, torques: Array, time: float) -> Array:
    """
    Return (phi_a, phi_b, omega_a, omega_b) of a linkage that is a parallelogram by constraint.

    Its A and b follow from c = a and d = b and are regular at the change points.
    """
    def slope(y: Array) -> Array:
        angles, rates = np.tile(y[:2], 2), np.tile(y[2:], 2)
        matrix = mass_matrix(angles, linkage.constants)
        force = -torques - centripetal_bias(angles, rates, linkage)
        pairs = matrix.reshape(2, 2, 2, 2).sum(axis=(0, 2))
        return np.concatenate([y[2:], np.linalg.solve(pairs, force.reshape(2, 2).sum(axis=0))])

    # With steps of 3e-4 rad the truncation error is below rounding.
    y, steps = start[[0, 1, 4, 5]], 200
    step = time / steps
    for _ in range(steps):
        k1 = slope(y)
        k2 = slope(y + 0.5 * step * k1)
        k3 = slope(y + 0.5 * step * k2)
        k4 = slope(y + step * k3)
        y = y + step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return y


def assert_moves_like_two_angles(linkage: Mechanism, states: Array, torques: Array) -> None:
    """Check the end of a motion against that of the parallelogram without change points."""
    expected = motion_of_two_angles(linkage, states[0], torques, STEP * (len(states) - 1))
    rate = np.abs(states[0, LINK_RATES]).max()
    end = states[-1]
    np.testing.assert_allclose(
        end[LINK_ANGLES], np.tile(expected[:2], 2), rtol=0.0, atol=ROUNDING)
    np.testing.assert_allclose(
        end[LINK_RATES], np.tile(expected[2:], 2), rtol=0.0, atol=ROUNDING * rate)


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_crosses_the_change_point(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    _, states = passage(seed, change_point, random_parallelogram)
    side = states[[0, -1], 1] - states[[0, -1], 0] - change_point
    assert side[0] * side[1] < 0.0


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_opposite_links_stay_parallel_during_a_passage(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    _, states = passage(seed, change_point, random_parallelogram)
    apart = np.abs(states[:, 2:4] - states[:, 0:2])
    assert apart.max() < ROUNDING


@pytest.mark.medium
@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_conserves_momentum(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    linkage, states = passage(seed, change_point, random_parallelogram)
    links_alone = states.copy()
    links_alone[:, WHEEL_SPEEDS] = 0.0
    drift = [abs(momentum(linkage, x) - momentum(linkage, links_alone[0])) for x in links_alone]
    assert max(drift) < ROUNDING * momentum_scale(linkage, links_alone[0])


@pytest.mark.medium
@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_conserves_energy(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    linkage, states = passage(seed, change_point, random_parallelogram)
    energies = [energy_of_links(linkage, x) for x in states]
    np.testing.assert_allclose(energies, energies[0], rtol=ROUNDING)


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_has_no_jump(seed: int, change_point: float, random_parallelogram: Draw) -> None:
    """Changes within one step are at most those of the fastest rate, nearly."""
    _, states = passage(seed, change_point, random_parallelogram)
    fastest = 1.5 * np.abs(states[[0, -1], LINK_RATES]).max()
    assert np.abs(np.diff(states[:, LINK_ANGLES], axis=0)).max() < STEP * fastest


@pytest.mark.medium
@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_is_that_of_a_linkage_without_change_points(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    linkage, states = passage(seed, change_point, random_parallelogram)
    assert_moves_like_two_angles(linkage, states, NONE)


@pytest.mark.medium
@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_motion_may_start_on_a_change_point(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    linkage, states = passage(seed, change_point, random_parallelogram, before=0.0)
    assert_moves_like_two_angles(linkage, states, NONE)


@pytest.mark.medium
@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_moving_linkage_passes_under_torque_too(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    """Ideal joints hold the branch against opposite torques while theta changes."""
    torques = np.random.default_rng(seed + 1000).uniform(-0.1, 0.1, 4)
    linkage, states = passage(seed, change_point, random_parallelogram, torques)
    speed = states[0, 5] - states[0, 4]
    assert_moves_like_two_angles(linkage, states, torques * speed**2)


@pytest.mark.parametrize('direction', [1.0, -1.0])
@pytest.mark.parametrize('change_point', CHANGE_POINTS)
def test_step_may_end_on_a_change_point(
    change_point: float, direction: float,
) -> None:
    """Uniform links turn at constant rates, and binary fractions end exactly on it."""
    step, steps, rate = 2.0**-11, 128, 0.25 * direction
    start = make_state(np.tile([0.5, 0.5 + change_point - rate * step * steps / 2], 2),
                       np.tile([0.0, rate], 2))
    linkage = load_mechanism('paper')
    states = move_under_constant_torques(linkage, start, NONE, step, steps)
    hit = states[steps // 2]
    assert abs(np.sin(hit[1] - hit[0])) < 1e-10
    expected = start[LINK_ANGLES] + step * steps * start[LINK_RATES]
    np.testing.assert_allclose(states[-1, LINK_ANGLES], expected, rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
def test_linkage_at_rest_on_a_change_point_stays(change_point: float) -> None:
    start = make_state(np.tile([0.5, 0.5 + change_point], 2))
    states = move_under_constant_torques(load_mechanism('paper'), start, NONE, STEP, 1000)
    np.testing.assert_array_equal(states[-1], start)


@pytest.mark.parametrize(('change_point', 'sign'), [(0.0, 1.0), (np.pi, -1.0)])
def test_opposite_torques_at_rest_lead_to_the_other_branch(
    change_point: float, sign: float,
) -> None:
    """
    On the change point the torques drive `eta = omega_c - omega_a`; `omega_d - omega_b = +-eta`.

    The generalized force on eta is `((tau_a - tau_c) +- (tau_b - tau_d)) / 2`.
    """
    torque = 1e-5
    start = make_state(np.tile([0.5, 0.5 + change_point], 2))
    torques = torque * np.array([1.0, sign, -1.0, -sign])
    states = move_under_constant_torques(load_mechanism('paper'), start, torques, STEP, 400)
    turned = states[-1, LINK_ANGLES] - start[LINK_ANGLES]
    assert turned[2] - turned[0] > 1e-3
    assert turned[3] - turned[1] == pytest.approx(sign * (turned[2] - turned[0]), rel=1e-6)


# --- A thousand passages ----------------------------------------------------------------------

def thousandth_passage(seed: int) -> tuple[Mechanism, Array]:
    """
    Draw a rhombus or parallelogram and its passage at a rate from 0.01 to 3 rad/s.

    A third starts on the change point, and a third is uniform and has a step that ends on it.
    """
    rng = np.random.default_rng(seed)
    length_a = rng.uniform(0.05, 1.5)
    length_b = length_a if seed % 2 else rng.uniform(0.5, 2.0) * length_a
    lengths = np.array([length_a, length_b, length_a, length_b])
    uniform = seed % 3 == 2
    masses = np.full(4, 0.02) if uniform else rng.uniform(0.5, 2.0, 4)
    across = np.zeros(4) if uniform else rng.uniform(-0.3, 0.3, 4) * lengths
    along = 0.5 * lengths if uniform else rng.uniform(0.2, 0.8, 4) * lengths
    inertias = masses * lengths**2 / 12.0
    linkage = Mechanism(
        lengths, masses, inertias, np.column_stack([along, across]), 0.02 * inertias)
    rate = 10.0**rng.uniform(-2.0, np.log10(3.0)) * rng.choice([-1.0, 1.0])
    rate_a = rng.uniform(-1.0, 1.0) * rate
    steps = int(rng.uniform(0.04, 0.4) / abs(rate) / STEP)
    before = 0.0 if seed % 3 == 1 else abs(rate) * STEP * (steps // 2)
    theta = rng.choice(CHANGE_POINTS) - before * np.sign(rate)
    phi_a = rng.uniform(-3.0, 3.0)
    start = make_state(np.tile([phi_a, phi_a + theta], 2), np.tile([rate_a, rate_a + rate], 2))
    return linkage, move_under_constant_torques(linkage, start, NONE, STEP, steps)


@pytest.mark.slow
@pytest.mark.parametrize('hundred', range(10))
def test_a_thousand_passages_stay_on_the_branch(hundred: int) -> None:
    """States are finite and continuous, momentum is conserved, opposite links stay parallel."""
    for seed in range(100 * hundred, 100 * hundred + 100):
        linkage, states = thousandth_passage(seed)
        assert np.isfinite(states).all(), f'seed {seed}'
        fastest = np.abs(states[:, LINK_RATES]).max()
        jump = np.abs(np.diff(states[:, LINK_ANGLES], axis=0)).max()
        # The rounding of the closure within 1e-4 rad of the change point is 1e-11.
        assert jump <= STEP * fastest + 1e-11, f'seed {seed}'
        few = states[::max(1, len(states) // 20)]
        drift = max(abs(momentum(linkage, x) - momentum(linkage, states[0])) for x in few)
        assert drift <= 1e-10 * momentum_scale(linkage, states[0]), f'seed {seed}'
        assert np.abs(states[:, 2:4] - states[:, 0:2]).max() < ROUNDING, f'seed {seed}'
        assert {branch_of(x[LINK_ANGLES]) for x in few} == {'open'}, f'seed {seed}'


# --- Imperfect lengths: they fold -------------------------------------------------------------

def fold(mismatch: float, change_point: float, rate: float, link: int) -> Case:
    """Return the case of a rhombus with one longer link that moves to a change point."""
    lengths = np.full(4, 0.1)
    lengths[link] *= 1.0 + mismatch
    linkage = Mechanism(
        lengths, [0.02] * 4, [2.2e-5] * 4, np.column_stack([0.5 * lengths, NONE]), [3.4e-7] * 4)
    angles = assemble(linkage, 0.3, 0.3 + change_point - 0.2 * np.sign(rate))
    rates = np.array([0.2 * rate, 1.2 * rate])
    dependent = reduced_form(linkage, angles, rates).gamma @ rates
    return Case(linkage, angles, np.concatenate([rates, dependent]), NONE, NONE, NONE, NONE,
                1e-4 * np.arange(0, round(6e3 / abs(rate)) + 1, 50))


FOLDS = [(1e-3, 0.0, 1.0, 0), (-1e-3, np.pi, -3.0, 1), (1e-4, np.pi, 0.3, 2), (-1e-4, 0.0, 3.0, 3)]


@pytest.mark.slow
@pytest.mark.parametrize(('mismatch', 'change_point', 'rate', 'link'), [
    *FOLDS, (1e-5, 0.0, 1.0, 1), (1e-6, np.pi, -1.0, 0), (1e-7, 0.0, 0.3, 2)])
def test_mismatch_folds_as_kane_equations_do(
    mismatch: float, change_point: float, rate: float, link: int,
) -> None:
    """The derivation by SymPy with adaptive steps agrees to 1e-5 deg."""
    pytest.importorskip('sympy')
    from fourbar_ros.studies.independent import kane
    case = fold(mismatch, change_point, rate, link)
    expected = kane.simulate(case).link_angles
    np.testing.assert_allclose(
        simulate(case).link_angles, expected, rtol=0.0, atol=np.deg2rad(1e-5))
    # The linkage has folded: one pair of opposite links is not parallel.
    assert np.abs(expected[-1, 2] - expected[-1, 0]) > 0.2


@pytest.mark.medium
@pytest.mark.parametrize(('mismatch', 'change_point', 'rate', 'link'), FOLDS)
def test_mismatch_folds_as_in_a_stiff_engine(
    mismatch: float, change_point: float, rate: float, link: int,
) -> None:
    """MuJoCo with RK4 at 0.1 ms and its stiffest stable closure agrees to 0.1 deg."""
    pytest.importorskip('mujoco')
    from fourbar_ros.studies.independent.mujoco_model import MujocoLinkage, State, stiff
    case = fold(mismatch, change_point, rate, link)
    start = State(case.link_angles, case.link_rates, NONE, case.link_rates, np.zeros(2),
                  np.zeros(2))
    theirs = MujocoLinkage(case.mechanism, stiff('RK4', 1e-4), [False] * 4).move(
        start, case.times, lambda t: NONE, sampled=0.5).link_angles
    np.testing.assert_allclose(
        simulate(case).link_angles, theirs, rtol=0.0, atol=np.deg2rad(0.1))


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('mismatch', [1e-15, 1e-12, 1e-10, 1e-9, -3e-9, 5e-9, -8e-9, 9.9e-9])
def test_mismatch_below_resolution_passes_and_conserves_energy(
    mismatch: float, change_point: float,
) -> None:
    """Lengths within 1e-8 count as equal."""
    for rate in (1.0, -0.1):
        case = fold(mismatch, change_point, rate, 1)
        motion = simulate(case)
        energy = [kinetic_energy(case.mechanism, *now, NONE)
                  for now in zip(motion.link_angles, motion.link_rates)]
        np.testing.assert_allclose(energy, energy[0], rtol=1e-10)
        assert np.abs(motion.link_angles[-1, 2] - motion.link_angles[-1, 0]) < 1e-7


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('mismatch', [1.1e-8, -2e-8, 1e-7])
def test_smallest_mismatch_above_resolution_folds(
    mismatch: float, change_point: float,
) -> None:
    """The largest number of divisions of a step limits the energy error to 1e-6."""
    for rate in (1.0, -0.1):
        case = fold(mismatch, change_point, rate, 1)
        motion = simulate(case)
        energy = [kinetic_energy(case.mechanism, *now, NONE)
                  for now in zip(motion.link_angles, motion.link_rates)]
        np.testing.assert_allclose(energy, energy[0], rtol=1e-6)
        assert np.abs(motion.link_angles[-1, 2] - motion.link_angles[-1, 0]) > 0.2


def test_sign_of_the_mismatch_decides_the_side() -> None:
    """The links turn about joint 3 or joint 1, depending on the longer link."""
    ends = [simulate(fold(mismatch, 0.0, 1.0, 0)).link_angles[-1] for mismatch in (1e-3, -1e-3)]
    turned = [end[2] - end[0] for end in ends]
    assert turned[0] < -0.5
    assert turned[1] > 0.5


def test_eta_at_rest_leads_to_the_folded_branch() -> None:
    """When a turns with b, and c with d, joint 4 stays on joint 2."""
    start = make_state(np.zeros(4), [1.0, 1.0, -1.0, -1.0])
    states = move_under_constant_torques(load_mechanism('paper'), start, NONE, STEP, 1000)
    assert branch_of(states[-1, LINK_ANGLES]) == 'folded'
    np.testing.assert_allclose(states[-1, 1] - states[-1, 0], 0.0, atol=ROUNDING)


# --- Change between the forms -----------------------------------------------------------------

@pytest.mark.parametrize('seed', SEEDS)
def test_change_between_the_forms_is_continuous(
    seed: int, random_parallelogram: Draw,
) -> None:
    """Second differences of the rates are no larger there than elsewhere."""
    rng = np.random.default_rng(seed)
    linkage = random_parallelogram(rng)
    start = parallel_state(rng, 0.33, np.array([0.2, -0.6]))
    states = move_under_constant_torques(linkage, start, NONE, STEP, 200)
    folds = np.abs(np.sin(states[:, 3] - states[:, 2]))
    assert folds[0] > 0.3 > folds[-1]
    jerk = np.abs(np.diff(states[:, LINK_RATES], n=2, axis=0)).max(axis=1)
    across = int(np.argmax(folds < 0.3))
    smooth = np.delete(jerk, range(across - 4, across + 3)).max()
    assert jerk.max() <= smooth + 1e-13
