# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Random linkages, free motion, and the equations of Kane's method."""

from collections.abc import Callable
from typing import Any

from fourbar_ros.mechanism import assemble, Mechanism, reduced_form
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import move_with_cosines
from fourbar_ros.mechanism.state import (
    CENTRE_POSITION,
    CENTRE_VELOCITY,
    JOINT_GAP_RATES,
    JOINT_GAPS,
    LINK_ANGLES,
    LINK_RATES,
    make_state,
    WHEEL_ANGLES,
)
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
NONE = [0.0] * 4


def _random_bodies(rng: np.random.Generator, lengths: Array) -> Mechanism:
    """Draw masses of about 1 kg with mass centres near the links, for lengths of about 1 m."""
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
    """Draw a parallelogram, in half of the cases a rhombus, with four different bodies."""
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


# Types of the fixtures, for the tests.
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


# --- The independent derivation ---------------------------------------------------------------

def _chain(linkage: Mechanism, angles: Array, gaps: Array) -> Array:
    """
    Place the mass centres along the chain a, b, c, d, from that of link a.

    :param angles: (4,), as complex numbers of size one, or their time derivatives.
    :param gaps: (3,) of joints 1 to 3, likewise.
    :returns: (4,) complex [m].
    """
    arm, rod = linkage.com_positions @ [1.0, 1j] * angles, linkage.link_lengths * angles
    joints = -arm[0] + np.cumsum([gaps[0], rod[1] + gaps[1], rod[2] + gaps[2]])
    places: Array = np.array([0.0, joints[0] + arm[1], joints[1] + arm[2],
                              joints[2] + arm[3] - rod[3]])
    return places


def _chain_motion(linkage: Mechanism, state: Array) -> tuple[Array, Array, Array, Array]:
    """Return positions, velocities (4,) of the mass centres, gaps and gap rates (3,)."""
    turn, share = np.exp(1j * state[LINK_ANGLES]), linkage.link_masses / linkage.link_masses.sum()
    parts = []
    for unit, part, centre in ((turn, JOINT_GAPS, CENTRE_POSITION),
                               (1j * state[LINK_RATES] * turn, JOINT_GAP_RATES, CENTRE_VELOCITY)):
        open_1, open_2, open_4 = state[part].view(complex)
        signed = linkage.link_lengths * unit
        # The gap of joint 3 follows from the other gaps and the links.
        open_3 = signed[0] + open_4 + signed[3] - open_1 - signed[1] - open_2 - signed[2]
        gaps = np.array([open_1, open_2, open_3])
        places = _chain(linkage, unit, gaps)
        parts.append((places + state[centre].view(complex) - share @ places, gaps))
    (places, gaps), (speeds, rates) = parts
    return places, speeds, gaps, rates


def _pairs(values: Array) -> list[float]:
    """Return complex numbers as a flat list of x and y."""
    return np.ascontiguousarray(values).view(float).tolist()


@pytest.fixture(scope='session')
def kane_accelerations() -> Callable[[Mechanism, Array, Array], Array]:
    """Return the angular accelerations (8,) of links and wheels by Kane's method."""
    pytest.importorskip('sympy')
    from fourbar_ros.studies.independent import kane

    def solve(linkage: Mechanism, state: Array, torques: Array) -> Array:
        matrix, forcing = kane.derive_equations((False,) * 4).evaluate(
            state[LINK_ANGLES], state[LINK_RATES], torques, kane.parameters_of(linkage))
        change = np.linalg.solve(np.array(matrix), np.array(forcing))
        links = np.concatenate([change[2:4], change[8:]])
        return np.concatenate([links, links + change[4:8]])

    return solve


@pytest.fixture(scope='session')
def kane_accelerations_under_loads() -> Callable[..., Array]:
    """Return the accelerations (4, 3) of the links (x, y, angle) by Kane's method, with loads."""
    pytest.importorskip('sympy')
    from fourbar_ros.studies.independent import kane

    def solve(linkage: Mechanism, state: Array, torques: Array, effects: dict[str, Any]) -> Array:
        # Motor torques act on the links with the opposite sign; there are no wheels.
        loads = {**effects, 'link_torques': effects['link_torques'] - torques}
        parameters = [*kane.parameters_of(linkage)[:20], *(0.0,) * 4]
        speeds = _chain_motion(linkage, state)[1]
        matrix, forcing = kane.derive_equations((True,) * 4, loads=True).evaluate(
            state[LINK_ANGLES], state[LINK_RATES], np.zeros(4), parameters, _pairs(speeds[:1]),
            *(np.ravel(loads[name]).tolist() for name in kane.LOADS))
        change = np.linalg.solve(np.array(matrix), np.array(forcing))
        angular = change[[2, 3, 4, 5]]
        turn = np.exp(1j * state[LINK_ANGLES])
        places = change[:2].view(complex) + _chain(
            linkage, (1j * angular - state[LINK_RATES]**2) * turn, np.zeros(3))
        return np.column_stack([places.real, places.imag, angular])

    return solve


@pytest.fixture(scope='session')
def kane_compliant_motion() -> Callable[..., Array]:
    """
    Integrate Kane's equations of a linkage with compliant joints by SciPy.

    The function returns positions and angles (12,), and speeds (12,) of the links after a time.
    """
    pytest.importorskip('sympy')
    from fourbar_ros.studies.independent import kane
    from scipy.integrate import solve_ivp

    def move(linkage: Mechanism, start: Array, time: float, amplitude: Array, frequency: Array,
             phase: Array, prescribed: Array | None = None) -> Array:
        held = np.zeros(4, dtype=bool) if prescribed is None else prescribed
        equations = kane.derive_equations((True,) * 4, loads=True, compliant=True)
        # A prescribed wheel adds its inertia to its link; a free wheel leaves its torque.
        wheels, omega = linkage.flywheel_inertias, 2.0 * np.pi * frequency
        parameters = np.array([*kane.parameters_of(linkage)[:20], *(0.0,) * 4])
        parameters[8:12] += np.where(held, wheels, 0.0)
        drive = np.where(held, -wheels * omega**2, 1.0) * amplitude
        arguments = (linkage.joint_stiffness.tolist(), linkage.joint_damping.tolist())
        nothing = {name: [0.0] * count for name, count in kane.LOADS.items()}
        nothing['smoothing'] = [1.0]

        def slope(t: float, state: Array) -> Array:
            # The state is position of A, gaps, angles, and their rates.
            loads = {**nothing, 'link_torques': (-drive * np.cos(omega * t + phase)).tolist()}
            row = state.tolist()
            matrix, forcing = equations.evaluate(
                row[8:12], row[20:24], NONE, parameters.tolist(), row[12:14], *loads.values(),
                row[2:8], row[14:20], *arguments)
            change = np.linalg.solve(np.array(matrix), np.array(forcing))
            return np.concatenate([state[12:], change[:2], change[6:], change[2:6]])

        places, speeds, gaps, rates = _chain_motion(linkage, start)
        begin = np.array([*_pairs(places[:1]), *_pairs(gaps), *start[LINK_ANGLES],
                          *_pairs(speeds[:1]), *_pairs(rates), *start[LINK_RATES]])
        end = solve_ivp(slope, (0.0, time), begin, method='DOP853', rtol=1e-12,
                        atol=1e-12).y[:, -1]
        turn = np.exp(1j * end[8:12])
        rows = []
        for part, unit in ((end[:12], turn), (end[12:], 1j * end[20:] * turn)):
            at = part[:2].view(complex) + _chain(linkage, unit, part[2:8].view(complex))
            rows.append(np.column_stack([at.real, at.imag, part[8:]]).ravel())
        return np.concatenate(rows)

    return move
