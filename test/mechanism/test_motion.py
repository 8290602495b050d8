# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The integrated motion: reference runs, order, conservation, and the way past change points."""

from collections.abc import Callable
import json
from pathlib import Path

from fourbar_ros.mechanism import (
    angular_momentum,
    closure_error,
    kinetic_energy,
    load_mechanism,
    Mechanism,
)
from fourbar_ros.mechanism.dynamics import centripetal_bias, mass_matrix
from fourbar_ros.mechanism.motion import (
    LINK_ANGLES,
    LINK_RATES,
    move_with_cosine_torques,
    WHEEL_ANGLES,
    WHEEL_SPEEDS,
)
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]

DATA = Path(__file__).parent.parent / 'data'
REFERENCES = ('paper_pair_ac', 'paper_all', 'asymmetric', 'parallelogram_offset_spinning')
SEEDS = range(20)
NONE = np.zeros(4)


def momentum(linkage: Mechanism, state: Array) -> float:
    """Return the angular momentum of links and wheels."""
    return angular_momentum(
        linkage, state[LINK_ANGLES], state[LINK_RATES], state[WHEEL_SPEEDS])


def momentum_scale(linkage: Mechanism, state: Array) -> float:
    """Return the size of what adds up to the momentum, which itself may be near zero."""
    matrix = np.abs(mass_matrix(state[LINK_ANGLES], linkage.constants))
    return float(matrix.sum(axis=0) @ np.abs(state[LINK_RATES])
                 + linkage.flywheel_inertias @ np.abs(state[WHEEL_SPEEDS]))


def energy_of_links(linkage: Mechanism, state: Array) -> float:
    """Return the links' share: the wheels' is much larger, and constant without torque."""
    return kinetic_energy(linkage, state[LINK_ANGLES], state[LINK_RATES], NONE)


def move_under_constant_torques(
    linkage: Mechanism, start: Array, torques: Array, step: float, steps: int,
) -> Array:
    """Return the states (steps + 1, 16) after every step."""
    return move_with_cosine_torques(
        start, step * np.arange(steps + 1), torques, NONE, NONE, 1.5 * step, linkage.constants)


# --- Reference motions ------------------------------------------------------------------------

def reference_and_ours(name: str) -> tuple[dict, Array]:
    """Read a reference motion from a model in maximal coordinates, and repeat it at 1 ms."""
    case = json.loads((DATA / f'{name}.json').read_text())
    linkage = Mechanism.from_mapping(case['mechanism'], name)
    initial, torque = case['initial'], case['motor_torque']
    start = np.concatenate([
        initial['link_angles'], initial['link_rates'], NONE,
        initial['flywheel_speeds_absolute']])
    ours = move_with_cosine_torques(
        start, np.array(case['t']), np.array(torque['amplitude'], dtype=float),
        np.array(torque['frequency_hz'], dtype=float), np.array(torque['phase'], dtype=float),
        1e-3, linkage.constants)
    return case, ours


@pytest.mark.parametrize('name', REFERENCES)
def test_link_angles_follow_the_reference(name: str) -> None:
    case, ours = reference_and_ours(name)
    np.testing.assert_allclose(ours[:, LINK_ANGLES], case['link_angles'], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize('name', REFERENCES)
def test_link_rates_follow_the_reference(name: str) -> None:
    case, ours = reference_and_ours(name)
    np.testing.assert_allclose(ours[:, LINK_RATES], case['link_rates'], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize('name', REFERENCES)
def test_wheel_speeds_follow_the_reference(name: str) -> None:
    """Written with ten decimals, and up to 150 rad/s."""
    case, ours = reference_and_ours(name)
    np.testing.assert_allclose(
        ours[:, WHEEL_SPEEDS], case['flywheel_speeds_absolute'], rtol=1e-9, atol=1e-9)


def test_wheel_angles_are_relative_to_the_links() -> None:
    """Wheels that keep an absolute speed of zero turn back by what their links turn."""
    linkage = load_mechanism('paper')
    start = np.concatenate([[0.0, 1.0, 0.0, 1.0], [0.5, -0.25, 0.5, -0.25], NONE, NONE])
    states = move_under_constant_torques(linkage, start, NONE, 1e-3, 1000)
    turned = states[-1, LINK_ANGLES] - start[LINK_ANGLES]
    np.testing.assert_allclose(states[-1, WHEEL_ANGLES], -turned, rtol=0.0, atol=1e-12)


# --- Order and conservation -------------------------------------------------------------------

@pytest.mark.parametrize('seed', range(5))
def test_integration_is_of_order_four(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """Halving the step divides the error by 16, which leaves 15/16 of it as the difference."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = random_state(rng, linkage, 0.7)
    torques, frequencies = rng.uniform(-0.2, 0.2, 4), rng.uniform(0.2, 1.0, 4)
    ends = [
        move_with_cosine_torques(
            start, np.array([0.0, 0.32]), torques, frequencies, NONE, step, linkage.constants)[-1]
        for step in (0.01, 0.005, 0.0025)]
    first, second = (np.abs(coarse - fine)[:8].max() for coarse, fine in zip(ends, ends[1:]))
    # The next order shows as a tenth or two at these steps, rounding not yet.
    assert np.log2(first / second) == pytest.approx(4.0, abs=0.4)


def truncation(states: Array, step: float) -> float:
    """
    Estimate the relative error that a method of order four leaves, `10 w T (w h)^4`.

    The frequency w is that of the fastest change: the largest rate, or the root of the largest
    acceleration where a fold makes the links turn over. The factor is for the number of terms.
    """
    rates = states[:, LINK_RATES]
    fastest = max(np.abs(rates).max(), np.sqrt(np.abs(np.diff(rates, axis=0)).max() / step))
    rounding = 1e-15 * len(states)
    return float(10.0 * fastest * step * len(states) * (fastest * step)**4 + rounding)


@pytest.mark.parametrize('seed', SEEDS)
def test_momentum_is_kept_in_free_motion(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    move_freely: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    states = move_freely(linkage, random_state(rng, linkage), 1e-3, 1000)
    drift = max(abs(momentum(linkage, x) - momentum(linkage, states[0])) for x in states[::50])
    assert drift < truncation(states, 1e-3) * momentum_scale(linkage, states[0])


@pytest.mark.parametrize('seed', SEEDS)
def test_energy_is_kept_in_free_motion(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    move_freely: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    states = move_freely(linkage, random_state(rng, linkage), 1e-3, 1000)
    energies = [energy_of_links(linkage, x) for x in states[::50]]
    np.testing.assert_allclose(energies, energies[0], rtol=truncation(states, 1e-3))


@pytest.mark.parametrize('seed', SEEDS)
def test_motor_work_is_what_the_energy_gains(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The work of a constant torque is torque times turn of the wheel relative to its link."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    torques = rng.uniform(-0.1, 0.1, 4)
    states = move_under_constant_torques(
        linkage, random_state(rng, linkage), torques, 1e-3, 500)
    energies = [
        kinetic_energy(linkage, x[LINK_ANGLES], x[LINK_RATES], x[WHEEL_SPEEDS])
        for x in (states[0], states[-1])]
    work = torques @ (states[-1, WHEEL_ANGLES] - states[0, WHEEL_ANGLES])
    bound = truncation(states, 1e-3) * max(energies)
    assert energies[1] - energies[0] == pytest.approx(work, rel=0.0, abs=bound)


@pytest.mark.parametrize('seed', SEEDS)
def test_loop_stays_closed(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    states = move_under_constant_torques(
        linkage, random_state(rng, linkage), rng.uniform(-0.1, 0.1, 4), 1e-3, 1000)
    assert max(closure_error(linkage, x[LINK_ANGLES]) for x in states) < 1e-12


@pytest.mark.parametrize('seed', SEEDS)
def test_opposite_torques_do_not_move_a_parallelogram(
    seed: int, random_parallelogram: Draw, move_freely: Callable[..., Array],
) -> None:
    """Away from the change points they only load the joints."""
    rng = np.random.default_rng(seed)
    linkage = random_parallelogram(rng)
    start = parallel_state(rng, rng.uniform(0.8, 2.3), rng.uniform(-0.5, 0.5, 2))
    first, second = rng.uniform(-1.0, 1.0, 2)
    loaded = move_under_constant_torques(
        linkage, start, np.array([first, second, -first, -second]), 1e-3, 500)
    free = move_freely(linkage, start, 1e-3, 500)
    # Rounding of tau / I (1 N m over at least 0.006 kg m^2), added up over half a second.
    np.testing.assert_allclose(loaded[:, :8], free[:, :8], rtol=0.0, atol=1e-12)


# --- Change points ----------------------------------------------------------------------------

CHANGE_POINTS = (0.0, np.pi)
STEP = 5e-4
# Within 1e-4 rad of the change point an angle's rounding of 4e-16 rad shows as 4e-12 of the
# rates, once per step that ends there: at 0.01 rad/s some forty of them.
ROUNDING = 1e-9


def parallel_state(rng: np.random.Generator, theta: float, rates: Array) -> Array:
    """Make a state of a parallelogram, wheels turning."""
    phi_a = rng.uniform(-3.0, 3.0)
    return np.concatenate([
        np.tile([phi_a, phi_a + theta], 2), np.tile(rates, 2), NONE, rng.uniform(-9.0, 9.0, 4)])


def passage(
    seed: int, change_point: float, random_parallelogram: Draw,
    torques: Array = NONE, before: float = 1.0,
) -> tuple[Mechanism, Array]:
    """
    Move an ideal parallelogram of four different bodies past a change point.

    From theta 0.03 rad before it (times `before`: 0 starts on it), for about 0.06 rad, with theta
    changing at 0.01 to 1 rad/s in either direction and the whole turning about as fast.
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
    Return (phi_a, phi_b, omega_a, omega_b) of a parallelogram that cannot be anything else.

    Its A and b, from c = a and d = b throughout, are regular at the change points.
    """
    def slope(y: Array) -> Array:
        angles, rates = np.tile(y[:2], 2), np.tile(y[2:], 2)
        matrix = mass_matrix(angles, linkage.constants)
        force = -torques - centripetal_bias(angles, rates, linkage.constants)
        pairs = matrix.reshape(2, 2, 2, 2).sum(axis=(0, 2))
        return np.concatenate([y[2:], np.linalg.solve(pairs, force.reshape(2, 2).sum(axis=0))])

    # Steps of 3e-4 rad: an error of order four is below rounding.
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
    """Compare the end of a motion with that of the parallelogram that has no change points."""
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
def test_passage_keeps_opposite_links_parallel(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    _, states = passage(seed, change_point, random_parallelogram)
    apart = np.abs(states[:, 2:4] - states[:, 0:2])
    assert apart.max() < ROUNDING


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_keeps_momentum(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    linkage, states = passage(seed, change_point, random_parallelogram)
    links_alone = states.copy()
    links_alone[:, WHEEL_SPEEDS] = 0.0
    drift = [abs(momentum(linkage, x) - momentum(linkage, links_alone[0])) for x in links_alone]
    assert max(drift) < ROUNDING * momentum_scale(linkage, links_alone[0])


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_keeps_energy(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    linkage, states = passage(seed, change_point, random_parallelogram)
    energies = [energy_of_links(linkage, x) for x in states]
    np.testing.assert_allclose(energies, energies[0], rtol=ROUNDING)


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_has_no_jump(seed: int, change_point: float, random_parallelogram: Draw) -> None:
    """Within one step nothing moves faster than at the fastest end of the passage, nearly."""
    _, states = passage(seed, change_point, random_parallelogram)
    fastest = 1.5 * np.abs(states[[0, -1], LINK_RATES]).max()
    assert np.abs(np.diff(states[:, LINK_ANGLES], axis=0)).max() < STEP * fastest


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_passage_is_that_of_a_linkage_without_change_points(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    linkage, states = passage(seed, change_point, random_parallelogram)
    assert_moves_like_two_angles(linkage, states, NONE)


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
@pytest.mark.parametrize('seed', SEEDS)
def test_motion_may_start_on_a_change_point(
    seed: int, change_point: float, random_parallelogram: Draw,
) -> None:
    linkage, states = passage(seed, change_point, random_parallelogram, before=0.0)
    assert_moves_like_two_angles(linkage, states, NONE)


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
def test_step_that_ends_on_a_change_point_is_no_obstacle(
    change_point: float, direction: float,
) -> None:
    """Uniform links turn at constant rates: binary fractions bring them onto it."""
    step, steps, rate = 2.0**-11, 128, 0.25 * direction
    start = np.concatenate([
        np.tile([0.5, 0.5 + change_point - rate * step * steps / 2], 2),
        np.tile([0.0, rate], 2), NONE, NONE])
    linkage = load_mechanism('paper')
    states = move_under_constant_torques(linkage, start, NONE, step, steps)
    hit = states[steps // 2]
    assert abs(np.sin(hit[1] - hit[0])) < 1e-10
    expected = start[LINK_ANGLES] + step * steps * start[LINK_RATES]
    np.testing.assert_allclose(states[-1, LINK_ANGLES], expected, rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize('change_point', CHANGE_POINTS)
def test_linkage_at_rest_on_a_change_point_stays(change_point: float) -> None:
    start = np.concatenate([np.tile([0.5, 0.5 + change_point], 2), NONE, NONE, NONE])
    states = move_under_constant_torques(load_mechanism('paper'), start, NONE, STEP, 1000)
    np.testing.assert_array_equal(states[-1], start)


@pytest.mark.parametrize(('change_point', 'sign'), [(0.0, 1.0), (np.pi, -1.0)])
def test_opposite_torques_choose_the_other_branch_from_rest(
    change_point: float, sign: float,
) -> None:
    """
    On the change point they drive `eta = omega_c - omega_a`, with `omega_d - omega_b = +-eta`.

    The generalized force on eta is `((tau_a - tau_c) +- (tau_b - tau_d)) / 2`.
    """
    torque = 1e-5
    start = np.concatenate([np.tile([0.5, 0.5 + change_point], 2), NONE, NONE, NONE])
    torques = torque * np.array([1.0, sign, -1.0, -sign])
    states = move_under_constant_torques(load_mechanism('paper'), start, torques, STEP, 400)
    turned = states[-1, LINK_ANGLES] - start[LINK_ANGLES]
    assert turned[2] - turned[0] > 1e-3
    assert turned[3] - turned[1] == pytest.approx(sign * (turned[2] - turned[0]), rel=1e-6)
