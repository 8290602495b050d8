# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Forces of the surroundings: closed forms, balances, and an independent derivation."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from math import inf, nan
from typing import Any

from fourbar_ros.common.settings import SettingError
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constrained import constrained_accelerations, directions, LinkMotion
from fourbar_ros.mechanism.forces import dry_friction, NOTHING, Surroundings, surroundings, System
from fourbar_ros.mechanism.integration import evaluate, move_with_cosines
from fourbar_ros.mechanism.momentum import (
    body_motion,
    mechanical_energy,
    total_angular_momentum,
)
from fourbar_ros.mechanism.reduced import reduced_accelerations, ReducedMotion, side_of_joint_3
from fourbar_ros.mechanism.state import (
    CENTRE_POSITION,
    CENTRE_VELOCITY,
    LINK_ANGLES,
    LINK_RATES,
    make_state,
    WHEEL_SPEEDS,
)
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Refuses = Callable[..., AbstractContextManager[None]]
Draw = Callable[[np.random.Generator], Mechanism]

SEEDS = range(20)
NONE = np.zeros(4)
STEP = 1e-3

# The two links of joints 1 to 4.
JOINTS = [(0, 1), (1, 2), (2, 3), (3, 0)]


def moved(linkage: Mechanism, start: Array, around: Surroundings, steps: int = 500,
          step: float = STEP) -> Array:
    """Return the states (steps + 1, STATE_SIZE) of a motion without motor torques."""
    return move_with_cosines(
        start, step * np.arange(steps + 1), NONE, NONE, NONE, 1.5 * step, linkage.constants,
        around)


def travelling(rng: np.random.Generator, state: Array) -> Array:
    """Return a state with a random position and velocity of the mass centre."""
    state = state.copy()
    state[CENTRE_POSITION], state[CENTRE_VELOCITY] = rng.uniform(-1.0, 1.0, (2, 2))
    return state


def everything(rng: np.random.Generator) -> dict[str, Any]:
    """Draw all effects, with unequal values of joints and links."""
    return {
        'joint_coulomb': rng.uniform(0.0, 0.1, 4), 'joint_viscous': rng.uniform(0.0, 0.1, 4),
        'smoothing': 0.1, 'link_drag': rng.uniform(0.0, 0.5, 4),
        'link_spin_drag': rng.uniform(0.0, 0.1, 4), 'gravity': rng.uniform(-1.0, 1.0, 2),
        'link_torques': rng.uniform(-0.3, 0.3, 4)}


# --- Closed forms -----------------------------------------------------------------------------

# The links of the paper in a parallelogram have A = 1.44e-4 kg m^2 for each pair in every
# configuration, and no bias. Each of the four joints is between the two pairs.
A = 1.44e-4


def two_pairs(rate_a: float, rate_b: float) -> Array:
    """Return a state of the linkage of the paper far from change points."""
    return make_state([0.3, 1.5, 0.3, 1.5], np.tile([rate_a, rate_b], 2))


def test_viscous_joints_stop_the_configuration_exponentially(paper: Mechanism) -> None:
    """The torque of four joints between the pairs is 4 c d(theta)/dt."""
    friction = 3e-6
    states = moved(paper, two_pairs(0.6, -0.2), surroundings(joint_viscous=friction))
    rate = np.exp(-8.0 * friction / A * STEP * np.arange(501))
    # The error is (8 c / A h)^4 / 120 with 1.7e-4 per step.
    np.testing.assert_allclose(states[:, 5] - states[:, 4], -0.8 * rate, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(states[:, 5] + states[:, 4], 0.4, rtol=0.0, atol=1e-13)


def test_coulomb_joints_stop_the_configuration_linearly(paper: Mechanism) -> None:
    """Far above the smoothing rate the friction does not depend on the rate."""
    friction = 2e-6
    around = surroundings(joint_coulomb=friction, smoothing=1e-6)
    states = moved(paper, two_pairs(0.6, -0.2), around)
    rate = 0.8 - 8.0 * friction / A * STEP * np.arange(501)
    # Smoothing changes the friction by (1e-6 / 0.7)^2 / 2.
    np.testing.assert_allclose(states[:, 4] - states[:, 5], rate, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_linkage_creeps_below_coulomb_friction(paper: Mechanism, sign: float) -> None:
    """
    Half of the break-away torque causes creep at the smoothing rate / sqrt(3).

    With torques -T, T, -T, T on the links each joint carries T / 2 against its friction T.
    """
    torque, smoothing = 2e-4, 1e-2
    around = surroundings(joint_coulomb=torque, smoothing=smoothing,
                          link_torques=sign * torque * np.array([-1.0, 1.0, -1.0, 1.0]))
    end = moved(paper, two_pairs(0.0, 0.0), around, 300)[-1]
    # The transient is exp(-(3/4)^1.5 8 T / (A smoothing) t) = 1e-93.
    assert end[5] - end[4] == pytest.approx(sign * smoothing / np.sqrt(3.0), rel=1e-9)


def test_friction_does_not_move_a_linkage_at_rest(paper: Mechanism) -> None:
    start = two_pairs(0.0, 0.0)
    around = surroundings(joint_coulomb=1e-3, joint_viscous=1e-3, link_drag=1.0,
                          link_spin_drag=1e-3)
    end = moved(paper, start, around, 10)[-1]
    np.testing.assert_array_equal(end[LINK_RATES], NONE)
    # Links c and d are computed from a and b.
    np.testing.assert_allclose(end, start, rtol=0.0, atol=1e-15)


def test_spin_drag_stops_each_pair_exponentially(paper: Mechanism) -> None:
    drag = 2e-5
    states = moved(paper, two_pairs(0.6, -0.2), surroundings(link_spin_drag=drag))
    rate = np.exp(-2.0 * drag / A * STEP * np.arange(501))
    np.testing.assert_allclose(states[:, 4], 0.6 * rate, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(states[:, 5], -0.2 * rate, rtol=0.0, atol=1e-13)


def test_drag_on_mass_centres_slows_a_rotation(paper: Mechanism) -> None:
    """
    When one pair turns, the two links of the other pair move at `rate l / 2`.

    The links of the turning pair do not translate, so the drag is 2 (l / 2)^2 k.
    """
    drag = 1e-2
    states = moved(paper, two_pairs(0.6, -0.2), surroundings(link_drag=drag))
    rate = np.exp(-2.0 * drag * 0.05**2 / A * STEP * np.arange(501))
    np.testing.assert_allclose(states[:, 4], 0.6 * rate, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(states[:, 5], -0.2 * rate, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize('seed', SEEDS)
def test_drag_in_proportion_to_mass_stops_the_mass_centre_exponentially(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage, 0.7))
    decay = 0.8
    states = moved(linkage, start, surroundings(link_drag=decay * linkage.link_masses))
    left = np.exp(-decay * STEP * np.arange(501))[:, np.newaxis]
    velocity, place = start[CENTRE_VELOCITY], start[CENTRE_POSITION]
    np.testing.assert_allclose(states[:, CENTRE_VELOCITY], velocity * left, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(
        states[:, CENTRE_POSITION], place + velocity * (1.0 - left) / decay, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize('seed', SEEDS)
def test_tilted_table_takes_the_mass_centre_to_its_terminal_speed(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """Drag of `k` per mass balances the slope `g` at the speed g / k."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage, 0.7))
    slope, decay = rng.uniform(-1.0, 1.0, 2), 20.0
    around = surroundings(link_drag=decay * linkage.link_masses, gravity=slope)
    end = moved(linkage, start, around, 1500)[-1]
    # The transient is exp(-20 1.5) of about 1 m/s.
    np.testing.assert_allclose(end[CENTRE_VELOCITY], slope / decay, rtol=0.0, atol=2e-13)


@pytest.mark.parametrize('seed', SEEDS)
def test_mass_centre_falls_down_a_tilted_table(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """A method of order four integrates g t^2 / 2 exactly."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage))
    slope = rng.uniform(-1.0, 1.0, 2)
    states = moved(linkage, start, surroundings(gravity=slope))
    time = STEP * np.arange(501)[:, np.newaxis]
    velocity, place = start[CENTRE_VELOCITY], start[CENTRE_POSITION]
    # Bound: 500 roundings of 1 m or 1 m/s.
    np.testing.assert_allclose(
        states[:, CENTRE_VELOCITY], velocity + slope * time, rtol=0.0, atol=5e-14)
    np.testing.assert_allclose(states[:, CENTRE_POSITION],
                               place + velocity * time + slope * time**2 / 2.0, rtol=0.0,
                               atol=5e-14)


@pytest.mark.parametrize('seed', SEEDS)
def test_tilted_table_does_not_change_the_motion_about_the_mass_centre(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage, 0.7))
    tilted = moved(linkage, start, surroundings(gravity=[0.3, -0.4]))
    level = moved(linkage, start, NOTHING)
    # The sum of the forces is zero within rounding.
    np.testing.assert_allclose(tilted[:, :8], level[:, :8], rtol=0.0, atol=1e-13)


# --- Balances ---------------------------------------------------------------------------------

def relative_rates(states: Array) -> Array:
    """Return the rates of joints 1 to 4 (n, 4) [rad/s]."""
    return np.stack([states[:, second] - states[:, first] for first, second in JOINTS], axis=1)


def power_of(linkage: Mechanism, states: Array, effects: dict[str, Any]) -> Array:
    """Return the power of the effects (n,) [W] from their definitions."""
    zero: Any = np.zeros(4)
    given = {**dict.fromkeys(
        ('joint_coulomb', 'joint_viscous', 'link_drag', 'link_spin_drag', 'link_torques'), zero),
        'gravity': np.zeros(2), 'smoothing': 1.0, **effects}
    rates = states[:, LINK_RATES]
    joints = relative_rates(rates)
    speeds = np.array([body_motion(linkage, state)[1] for state in states])
    coulomb = joints**2 / np.sqrt(joints**2 + given['smoothing']**2)
    power: Array = (
        rates @ given['link_torques'] - rates**2 @ given['link_spin_drag']
        - joints**2 @ given['joint_viscous'] - coulomb @ given['joint_coulomb']
        - (speeds**2).sum(axis=2) @ given['link_drag']
        + (speeds @ given['gravity']) @ linkage.link_masses)
    return power


@pytest.mark.parametrize('effect', ['joint_coulomb', 'joint_viscous', 'link_drag',
                                    'link_spin_drag', 'gravity', 'link_torques', 'all'])
@pytest.mark.parametrize('seed', SEEDS)
def test_energy_changes_by_the_work_of_the_effects(
    seed: int, effect: str, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The power, such as -c times rate squared, is integrated by Simpson's rule."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage, 0.7))
    start[WHEEL_SPEEDS] = 0.0
    effects = everything(rng)
    if effect != 'all':
        effects = {effect: effects[effect], 'smoothing': 0.1}
    states = moved(linkage, start, surroundings(**effects), 200)
    power = power_of(linkage, states, effects)
    work = STEP / 3.0 * (
        power[0] + 4.0 * power[1::2].sum() + 2.0 * power[2:-1:2].sum() + power[-1])
    gained = mechanical_energy(linkage, states[-1]) - mechanical_energy(linkage, states[0])
    # With rates of at most 10 rad/s the error is (w h)^4 / 180 of 1 W during 0.2 s.
    assert gained == pytest.approx(work, rel=0.0, abs=1e-11)
    assert abs(gained) > 1e-4


@pytest.mark.medium
@pytest.mark.parametrize('seed', SEEDS)
def test_friction_and_drag_never_give_energy(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The energy decreases at every step, also near rest."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage, 0.7))
    start[WHEEL_SPEEDS] = 0.0
    effects = everything(rng)
    del effects['gravity'], effects['link_torques']
    states = moved(linkage, start, surroundings(**effects), 2000, 5e-3)
    energies = [mechanical_energy(linkage, state) for state in states]
    assert np.diff(energies).max() < 0.0
    assert energies[-1] < 0.1 * energies[0]


@pytest.mark.parametrize('seed', SEEDS)
def test_joint_friction_conserves_momentum(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """Joint friction acts between links, so the mass centre does not accelerate."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage))
    around = surroundings(joint_coulomb=0.1, joint_viscous=rng.uniform(0.0, 0.1, 4))
    states = moved(linkage, start, around, 1000)
    momentum = [total_angular_momentum(linkage, state) for state in states[::50]]
    np.testing.assert_allclose(momentum, momentum[0], rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(
        states[:, CENTRE_VELOCITY], np.broadcast_to(start[CENTRE_VELOCITY], (1001, 2)),
        rtol=0.0, atol=1e-13)


@pytest.mark.parametrize('seed', SEEDS)
def test_outside_torques_give_their_impulse(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """Joint friction does not change the impulse."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = random_state(rng, linkage)
    torques = rng.uniform(-0.3, 0.3, 4)
    around = surroundings(link_torques=torques, joint_viscous=0.05)
    states = moved(linkage, start, around, 1000)
    gained = [total_angular_momentum(linkage, state)
              - total_angular_momentum(linkage, start) for state in states[::50]]
    np.testing.assert_allclose(
        gained, torques.sum() * STEP * 50 * np.arange(21), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize('seed', SEEDS)
def test_tilted_table_and_drag_change_momentum_about_the_origin_by_their_moment(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The moments of the forces at the mass centres are integrated by Simpson's rule."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage, 0.7))
    slope, drag = rng.uniform(-1.0, 1.0, 2), rng.uniform(0.0, 0.5, 4)
    states = moved(linkage, start, surroundings(gravity=slope, link_drag=drag), 200)
    moment = np.empty(201)
    for n, state in enumerate(states):
        place, speed = body_motion(linkage, state)
        force = linkage.link_masses[:, np.newaxis] * slope - drag[:, np.newaxis] * speed
        moment[n] = (place[:, 0] * force[:, 1] - place[:, 1] * force[:, 0]).sum()
    impulse = STEP / 3.0 * (
        moment[0] + 4.0 * moment[1::2].sum() + 2.0 * moment[2:-1:2].sum() + moment[-1])
    gained = total_angular_momentum(linkage, states[-1]) - total_angular_momentum(linkage, start)
    assert gained == pytest.approx(impulse, rel=0.0, abs=1e-11)


# --- Reduced, constrained and compliant form --------------------------------------------------

@pytest.mark.parametrize('fold', [0.3, 0.05])
@pytest.mark.parametrize('seed', SEEDS)
def test_reduced_and_constrained_solutions_agree(
    seed: int, fold: float, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = travelling(rng, random_state(rng, linkage, fold))
    around, torques = surroundings(**everything(rng)), rng.uniform(-1.0, 1.0, 4)
    a, b, c, d = state[LINK_ANGLES]
    rates, velocity = tuple(state[LINK_RATES]), tuple(state[CENTRE_VELOCITY])
    system = System(linkage.constants, around)
    reduced = reduced_accelerations(ReducedMotion(
        a, np.cos(b - a), np.sin(b - a), side_of_joint_3(c, d), *rates[:2], velocity),
        torques, system)
    constrained = constrained_accelerations(
        LinkMotion(a, *directions((a, b, c, d)), rates, velocity), torques, system, True)
    # The error is a few hundred roundings; the reduced form divides twice by the fold.
    largest = max(1.0, np.abs(constrained.accelerations).max())
    np.testing.assert_allclose(
        [*reduced.accelerations, *reduced.centre, reduced.torque],
        [*constrained.accelerations, *constrained.centre, constrained.torque],
        rtol=0.0, atol=1e-12 / np.sin(d - c)**2 * largest)


@pytest.mark.parametrize('seed', range(10))
def test_stiff_joints_approach_rigid_ones(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """With all effects, differences in angle and position are inverse to the stiffness."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    start = travelling(rng, random_state(rng, linkage, 0.7))
    around = surroundings(**everything(rng))
    rigid = moved(linkage, start, around, 300)[-1]
    apart = []
    for stiffness in (1e4, 1e5, 1e6):
        soft = replace(linkage, joint_stiffness=[stiffness] * 4,
                       joint_damping=[2.0 * np.sqrt(stiffness)] * 4)
        end = moved(soft, start, around, 300)[-1]
        apart.append([np.abs(end[part] - rigid[part]).max()
                      for part in (LINK_ANGLES, CENTRE_POSITION)])
    decades = np.log10(np.array(apart[:-1]) / apart[1:])
    # The next power of 1 / stiffness contributes, most to the position, which differs by um.
    np.testing.assert_allclose(decades[:, 0], 1.0, rtol=0.0, atol=0.1)
    np.testing.assert_allclose(decades[:, 1], 1.0, rtol=0.0, atol=0.3)


# --- An independent derivation ----------------------------------------------------------------

@pytest.mark.slow
@pytest.mark.parametrize('seed', range(40))
def test_accelerations_agree_with_an_independent_model(
    seed: int, random_linkage: Draw, random_state: Callable[..., Array],
    kane_accelerations_under_loads: Callable[..., Array],
) -> None:
    """Accelerations of links and mass centre agree under all effects."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = travelling(rng, random_state(rng, linkage))
    torques, effects = rng.uniform(-1.0, 1.0, 4), everything(rng)
    ours = np.empty_like(state)
    evaluate(state, torques, linkage.constants, surroundings(**effects), ours)
    expected = kane_accelerations_under_loads(linkage, state, torques, effects)
    # Rounding times the condition number of the equations in units of order one.
    size = np.abs(expected).max()
    np.testing.assert_allclose(ours[LINK_RATES], expected[:, 2], rtol=0.0, atol=1e-11 * size)
    np.testing.assert_allclose(
        ours[CENTRE_VELOCITY], linkage.link_masses @ expected[:, :2] / linkage.link_masses.sum(),
        rtol=0.0, atol=1e-11 * size)


# --- Refused values ---------------------------------------------------------------------------

@pytest.mark.parametrize(('name', 'size'), [
    ('joint_coulomb', 4), ('joint_viscous', 4), ('link_drag', 4), ('link_spin_drag', 4),
    ('gravity', 2), ('link_torques', 4)])
@pytest.mark.parametrize('count', [0, 1, 3, 5])
def test_wrong_length_is_refused(name: str, size: int, count: int, refuses: Refuses) -> None:
    values: Any = {name: np.ones(count)}
    with refuses(SettingError, name=name, value=count, limit=size):
        surroundings(**values)


@pytest.mark.parametrize('wrong', [(4, 4), (4, 1)])
def test_matrix_is_refused(wrong: tuple[int, int], refuses: Refuses) -> None:
    with refuses(SettingError, name='link_drag.link_a', limit=float):
        surroundings(link_drag=np.ones(wrong))


@pytest.mark.parametrize(('name', 'value', 'limit'), [
    ('joint_static_ratio', 0.5, (1.0, inf)), ('joint_static_ratio', nan, (1.0, inf)),
    ('stribeck_rate', 0.0, (0.0, inf)), ('stribeck_rate', inf, (0.0, inf)),
    ('smoothing', 0.0, (0.0, inf)), ('smoothing', -1e-4, (0.0, inf)),
    ('smoothing', inf, (0.0, inf)), ('smoothing', nan, (0.0, inf))])
def test_friction_law_out_of_range_is_refused(
    name: str, value: float, limit: tuple[float, float], refuses: Refuses,
) -> None:
    with refuses(SettingError, name=name, value=value, limit=limit):
        surroundings(joint_coulomb=1e-3, **{name: value})


def test_dry_friction_falls_from_static_to_coulomb() -> None:
    """Friction is static at rest, halfway at the Stribeck rate, and Coulomb far beyond."""
    for rate, expected in ((0.002, 1.5), (0.1, 1.25), (100.0, 1.0)):
        assert rate * dry_friction(rate, 1.5, 0.1, 1e-6) == pytest.approx(expected, rel=1e-3)
        assert dry_friction(-rate, 1.5, 0.1, 1e-6) == dry_friction(rate, 1.5, 0.1, 1e-6)


@pytest.mark.parametrize('wrong', ['heavy', True, None])
def test_value_that_is_no_number_is_refused(wrong: Any, refuses: Refuses) -> None:
    with refuses(SettingError, name='joint_viscous', value=wrong, limit=float):
        surroundings(joint_viscous=wrong)
    with refuses(SettingError, name='joint_viscous.joint_2', value=wrong, limit=float):
        surroundings(joint_viscous=[1.0, wrong, 1.0, 1.0])


def test_unknown_effect_is_refused(refuses: Refuses) -> None:
    with refuses(SettingError, unknown=['joint_stiction'], place='surroundings'):
        surroundings(joint_stiction=1.0)


@pytest.mark.parametrize('name', ['joint_coulomb', 'joint_viscous', 'link_drag',
                                  'link_spin_drag', 'link_torques'])
@pytest.mark.parametrize('value', [nan, inf, -inf])
def test_value_that_is_not_finite_is_refused(name: str, value: float, refuses: Refuses) -> None:
    values: Any = {name: [0.1, value, 0.1, 0.1]}
    second = 'joint_2' if name.startswith('joint') else 'link_b'
    with refuses(SettingError, name=f'{name}.{second}', value=value):
        surroundings(**values)


@pytest.mark.parametrize('name', ['joint_coulomb', 'joint_viscous', 'link_drag',
                                  'link_spin_drag'])
def test_friction_that_gives_energy_is_refused(name: str, refuses: Refuses) -> None:
    values: Any = {name: [0.1, 0.2, -0.5, 0.1]}
    third = 'joint_3' if name.startswith('joint') else 'link_c'
    with refuses(SettingError, name=f'{name}.{third}', value=-0.5, limit=(0.0, inf)):
        surroundings(**values)


def test_one_number_applies_to_all(paper: Mechanism) -> None:
    start = two_pairs(0.6, -0.2)
    one, four = (surroundings(joint_viscous=value, link_torques=value, gravity=other)
                 for value, other in ((1e-6, 0.1), ([1e-6] * 4, [0.1, 0.1])))
    np.testing.assert_array_equal(moved(paper, start, one, 10), moved(paper, start, four, 10))


def test_effects_cannot_be_changed_afterwards() -> None:
    around = surroundings(joint_viscous=1e-6)
    with pytest.raises(ValueError, match='read-only'):
        around.joint_viscous[0] = -1.0
