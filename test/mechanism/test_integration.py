# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The integrated motion: reference runs, order and conservation."""

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
from fourbar_ros.mechanism.dynamics import mass_matrix
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import move_held, move_with_cosines
from fourbar_ros.mechanism.momentum import linear_momentum
from fourbar_ros.mechanism.state import (
    CENTRE_POSITION,
    CENTRE_VELOCITY,
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

DATA = Path(__file__).parents[2] / 'config' / 'reference'
REFERENCES = ('paper_pair_ac', 'paper_all', 'asymmetric', 'parallelogram_offset_spinning')
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


def move_under_constant_torques(
    linkage: Mechanism, start: Array, torques: Array, step: float, steps: int,
) -> Array:
    """Return the states (steps + 1, STATE_SIZE) after every step."""
    return move_with_cosines(
        start, step * np.arange(steps + 1), torques, NONE, NONE, 1.5 * step, linkage.constants,
        NOTHING)


# --- Reference motions ------------------------------------------------------------------------

def reference_and_ours(name: str) -> tuple[dict, Array]:
    """Return a reference motion of a model in maximal coordinates, and ours at 1 ms."""
    case = json.loads((DATA / f'{name}.json').read_text())
    linkage = Mechanism.from_mapping(case['mechanism'], name)
    initial, torque = case['initial'], case['motor_torque']
    start = make_state(
        initial['link_angles'], initial['link_rates'], initial['flywheel_speeds_absolute'])
    ours = move_with_cosines(
        start, np.array(case['t']), np.array(torque['amplitude'], dtype=float),
        np.array(torque['frequency_hz'], dtype=float), np.array(torque['phase'], dtype=float),
        1e-3, linkage.constants, NOTHING)
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
    """The file has ten decimals and speeds up to 150 rad/s."""
    case, ours = reference_and_ours(name)
    np.testing.assert_allclose(
        ours[:, WHEEL_SPEEDS], case['flywheel_speeds_absolute'], rtol=1e-9, atol=1e-9)


def test_wheel_angles_are_relative_to_the_links() -> None:
    """A wheel with zero absolute speed turns relative to its link by minus the link angle."""
    linkage = load_mechanism('paper')
    start = make_state([0.0, 1.0, 0.0, 1.0], [0.5, -0.25, 0.5, -0.25], NONE)
    states = move_under_constant_torques(linkage, start, NONE, 1e-3, 1000)
    turned = states[-1, LINK_ANGLES] - start[LINK_ANGLES]
    np.testing.assert_allclose(states[-1, WHEEL_ANGLES], -turned, rtol=0.0, atol=1e-12)


# --- Order and conservation -------------------------------------------------------------------

@pytest.mark.parametrize('seed', range(5))
def test_integration_is_of_order_four(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """Halving the step divides the error by 16."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = random_state(rng, linkage, 0.7)
    torques, frequencies = rng.uniform(-0.2, 0.2, 4), rng.uniform(0.2, 1.0, 4)
    ends = [
        move_with_cosines(
            start, np.array([0.0, 0.32]), torques, frequencies, NONE, step, linkage.constants,
            NOTHING)[-1]
        for step in (0.01, 0.005, 0.0025)]
    first, second = (np.abs(coarse - fine)[:8].max() for coarse, fine in zip(ends, ends[1:]))
    # The next order contributes one or two tenths at these steps; rounding is smaller.
    assert np.log2(first / second) == pytest.approx(4.0, abs=0.4)


def truncation(states: Array, step: float) -> float:
    """
    Estimate the relative error of a method of order four, `10 w T (w h)^4`.

    The frequency w is the larger one of the largest rate and the square root of the largest
    acceleration. The factor is for the number of terms.
    """
    rates = states[:, LINK_RATES]
    fastest = max(np.abs(rates).max(), np.sqrt(np.abs(np.diff(rates, axis=0)).max() / step))
    rounding = 1e-15 * len(states)
    return float(10.0 * fastest * step * len(states) * (fastest * step)**4 + rounding)


@pytest.mark.parametrize('seed', SEEDS)
def test_momentum_is_conserved_in_free_motion(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    move_freely: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    states = move_freely(linkage, random_state(rng, linkage), 1e-3, 1000)
    drift = max(abs(momentum(linkage, x) - momentum(linkage, states[0])) for x in states[::50])
    assert drift < truncation(states, 1e-3) * momentum_scale(linkage, states[0])


@pytest.mark.parametrize('seed', SEEDS)
def test_energy_is_conserved_in_free_motion(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    move_freely: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    states = move_freely(linkage, random_state(rng, linkage), 1e-3, 1000)
    energies = [energy_of_links(linkage, x) for x in states[::50]]
    np.testing.assert_allclose(energies, energies[0], rtol=truncation(states, 1e-3))


@pytest.mark.parametrize('seed', SEEDS)
def test_motor_work_is_the_gain_of_energy(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The work of a constant torque is torque times relative angle of the wheel."""
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
    """Away from the change points opposite torques only load the joints."""
    rng = np.random.default_rng(seed)
    linkage = random_parallelogram(rng)
    theta, rates = rng.uniform(0.8, 2.3), rng.uniform(-0.5, 0.5, 2)
    start = make_state(np.tile([0.4, 0.4 + theta], 2), np.tile(rates, 2))
    first, second = rng.uniform(-1.0, 1.0, 2)
    loaded = move_under_constant_torques(
        linkage, start, np.array([first, second, -first, -second]), 1e-3, 500)
    free = move_freely(linkage, start, 1e-3, 500)
    # Bound: rounding of tau / I (1 N m over at least 0.006 kg m^2), integrated over half a second.
    np.testing.assert_allclose(loaded[:, :8], free[:, :8], rtol=0.0, atol=1e-12)


@pytest.mark.medium
def test_a_million_steps_lose_no_momentum(
    random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """In 1000 s of free motion (seed 3) the momenta change by less than 1e-12."""
    rng = np.random.default_rng(3)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    state[WHEEL_SPEEDS] = NONE
    state[CENTRE_VELOCITY] = [0.1, -0.2]
    angular, linear = momentum(linkage, state), linear_momentum(linkage, state)
    energy = energy_of_links(linkage, state)
    for _ in range(10):
        move_held(state, NONE, 1e-3, 100_000, linkage.constants, NOTHING)
        assert momentum(linkage, state) == pytest.approx(angular, rel=1e-12)
        np.testing.assert_allclose(linear_momentum(linkage, state), linear, rtol=1e-12)
        assert closure_error(linkage, state[LINK_ANGLES]) < 1e-12
    assert energy_of_links(linkage, state) == pytest.approx(energy, rel=1e-9)
    np.testing.assert_allclose(state[CENTRE_POSITION], [100.0, -200.0], rtol=1e-14)
