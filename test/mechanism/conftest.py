# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Random linkages, and motion without torque, for every test of the mechanism."""

from collections.abc import Callable

from fourbar_ros.mechanism import assemble, Mechanism, reduced_form
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import move_with_cosines
from fourbar_ros.mechanism.state import make_state, WHEEL_ANGLES
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]


def _random_bodies(rng: np.random.Generator, lengths: Array) -> Mechanism:
    """Hang masses of about 1 kg, anywhere near the links, on lengths of about 1 m."""
    masses = rng.uniform(0.5, 2.0, 4)
    inertias = masses * lengths**2 * rng.uniform(0.05, 0.3, 4)
    along = rng.uniform(0.2, 0.8, 4) * lengths
    across = rng.uniform(-0.3, 0.3, 4) * lengths
    return Mechanism(
        lengths, masses, inertias, np.column_stack([along, across]),
        inertias * rng.uniform(0.01, 0.1, 4))


def _random_linkage(rng: np.random.Generator) -> Mechanism:
    """Draw four unequal links of 0.5 to 1.5 m that close (sums of the two others exceed one)."""
    while True:
        lengths = rng.uniform(0.5, 1.5, 4)
        if 2.0 * lengths.max() < 0.95 * lengths.sum():
            return _random_bodies(rng, lengths)


def _random_parallelogram(rng: np.random.Generator) -> Mechanism:
    """Draw a parallelogram, every other time a rhombus, with four different bodies."""
    length_a = rng.uniform(0.5, 1.5)
    length_b = length_a if rng.random() < 0.5 else rng.uniform(0.5, 1.5)
    return _random_bodies(rng, np.array([length_a, length_b, length_a, length_b]))


def _random_state(rng: np.random.Generator, linkage: Mechanism, fold: float = 0.3) -> Array:
    """Draw a moving state whose c and d are at least `fold` (a sine) from a line."""
    lengths = linkage.link_lengths
    while True:
        # The diagonal between joints 2 and 4 is a side of two triangles.
        low = max(abs(lengths[0] - lengths[1]), abs(lengths[2] - lengths[3]))
        high = min(lengths[0] + lengths[1], lengths[2] + lengths[3])
        diagonal = rng.uniform(low, high)
        cosine = (lengths[0]**2 + lengths[1]**2 - diagonal**2) / (2 * lengths[0] * lengths[1])
        theta = float(np.arccos(cosine)) * rng.choice([-1.0, 1.0])
        phi_a = rng.uniform(-np.pi, np.pi)
        branch = str(rng.choice(['open', 'crossed']))
        angles = assemble(linkage, phi_a, phi_a + theta, branch)
        if abs(np.sin(angles[3] - angles[2])) >= fold:
            break
    rates = rng.uniform(-1.0, 1.0, 2)
    dependent = reduced_form(linkage, angles, rates).gamma @ rates
    state = make_state(angles, np.concatenate([rates, dependent]), rng.uniform(-9.0, 9.0, 4))
    state[WHEEL_ANGLES] = rng.uniform(-np.pi, np.pi, 4)
    return state


def _move_freely(linkage: Mechanism, start: Array, step: float, steps: int) -> Array:
    """Return the states (steps + 1, STATE_SIZE) after every step of motion without torque."""
    return move_with_cosines(
        start, step * np.arange(steps + 1), np.zeros(4), np.zeros(4), np.zeros(4),
        1.5 * step, linkage.constants, NOTHING)


# For the tests: what they may ask of the fixtures.
Draw = Callable[[np.random.Generator], Mechanism]


@pytest.fixture(scope='session')
def random_linkage() -> Draw:
    """Draw any linkage that closes."""
    return _random_linkage


@pytest.fixture(scope='session')
def random_parallelogram() -> Draw:
    """Draw an ideal parallelogram or rhombus whose four bodies differ."""
    return _random_parallelogram


@pytest.fixture(scope='session')
def random_state() -> Callable[..., Array]:
    """Draw a state (STATE_SIZE,) of a linkage that meets its closure, in angles and rates."""
    return _random_state


@pytest.fixture(scope='session')
def move_freely() -> Callable[..., Array]:
    """Integrate without torque."""
    return _move_freely
