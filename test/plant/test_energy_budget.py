# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Energy budget and momentum of the plant, and the edge of the table."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

from fourbar_ros.mechanism import load_mechanism, Mechanism
from fourbar_ros.mechanism.momentum import joint_gaps, linear_momentum, total_angular_momentum
from fourbar_ros.mechanism.state import LINK_RATES
from fourbar_ros.plant import InitialState, load_table, Plant, PlantError, Table
from fourbar_ros.plant.edge import joint_levers
from fourbar_ros.plant.plant import TORQUE_WALK_AGE
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import (
    Disturbance,
    Joints,
    Links,
    Surface,
    WheelBearings,
    WheelEncoders,
)
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
MakePlant = Callable[..., Plant]
Refuses = Callable[..., AbstractContextManager[None]]

MOVING = InitialState(0.3, 1.6, 'open', 1.0, -0.5)
SENSORS = {'link_sensors': LinkSensorSettings(), 'wheel_encoders': WheelEncoders(0)}
# Each effect alone, and all effects together.
EFFECTS = {
    'none': {},
    'bearings': {'wheel_bearings': WheelBearings(2e-6, 1e-3, 1.3)},
    'joints': {'joints': Joints(1e-5, 2e-4, 1.3)},
    'drag': {'links': Links(0.01, 1.25e-4)},
    'tilt': {'surface': Surface(tilt_x=1e-3, tilt_y=-2e-3)},
    'edge': {'surface': Surface(size_x=0.5, size_y=0.45, restitution=0.6)},
    'disturbance': {'disturbance': Disturbance(1e-4, 2e-4)},
}
EFFECTS['all'] = {
    **{name: section for effect in EFFECTS.values() for name, section in effect.items()},
    'surface': Surface(1e-3, -2e-3, 0.5, 0.45, 0.6)}


@pytest.fixture(scope='module')
def prototype() -> Mechanism:
    return load_mechanism('prototype')


def with_effect(name: str) -> Table:
    return Table(**SENSORS, **EFFECTS[name])


def driven(plant: Plant, seconds: float) -> Plant:
    """Drive the wheels with sinusoidal torques of random phases, seed 4."""
    rng = np.random.default_rng(4)
    phase = rng.uniform(0.0, 6.0, 4)
    for n in range(round(seconds / 4e-3)):
        plant.disturb(4e-3)
        plant.advance(8, 8e-3 * np.sin(4e-3 * n * np.array([1.0, 2.0, 3.0, 0.7]) + phase))
    return plant


@pytest.mark.medium
@pytest.mark.parametrize('compliant', [False, True], ids=['rigid', 'compliant'])
@pytest.mark.parametrize('effect', list(EFFECTS))
def test_energy_and_momentum_budgets_balance(
    effect: str, compliant: bool, prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """The error is below 1e-6 of the exchanged energy and 1e-8 of the angular momenta."""
    linkage = prototype if not compliant else replace(
        prototype, joint_stiffness=np.full(4, 1e4), joint_damping=np.full(4, 2.0))
    plant = driven(make_plant(linkage, table=with_effect(effect), initial=MOVING), 4.0)
    ledger = plant.ledger()
    assert abs(ledger.unaccounted) <= 1e-6 * ledger.turnover
    handled = abs(ledger.links_spin) + abs(ledger.wheels_spin)
    assert abs(ledger.unaccounted_spin) <= 1e-8 * handled
    for name, entry in (('bearings', 'bearings'), ('joints', 'joints'), ('drag', 'drag'),
                        ('edge', 'edge'), ('tilt', 'tilt'), ('disturbance', 'disturbance')):
        booked = getattr(ledger, entry)
        if effect in (name, 'all'):
            assert booked > 0.0 or name in ('tilt', 'disturbance')
            assert booked != 0.0
        elif not (compliant and name == 'joints'):
            assert booked == 0.0


def test_motor_work_becomes_energy_and_heat(
    prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """The energy of the supply is the copper loss plus the energy of links and wheels."""
    plant = make_plant(prototype, table=with_effect('none'))
    plant.advance(1000, np.array([2e-3, -1e-3, 1e-3, 3e-3]))
    ledger = plant.ledger()
    assert ledger.supplied - ledger.copper == pytest.approx(
        ledger.links + ledger.wheels, rel=1e-9)
    assert ledger.links_spin == pytest.approx(-ledger.wheels_spin, rel=1e-9)


def test_linkage_slides_on_a_tilted_table(prototype: Mechanism, make_plant: MakePlant) -> None:
    """The acceleration is g sin(tilt), and the lost potential energy is kinetic energy."""
    plant = make_plant(prototype, table=with_effect('tilt'))
    plant.advance(4000, np.zeros(4))
    truth, pull = plant.truth(), 9.80665 * np.sin([1e-3, -2e-3])
    np.testing.assert_allclose(truth.centre_velocity, 2.0 * pull, rtol=1e-12)
    np.testing.assert_allclose(truth.centre_position, 2.0 * pull, rtol=1e-12)
    assert plant.ledger().tilt == pytest.approx(
        0.5 * 2.4 * (truth.centre_velocity**2).sum(), rel=1e-12)


def test_joint_friction_moves_momentum_between_the_pairs_only(
    prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """Friction stops the change of configuration, and the whole keeps turning."""
    plant = make_plant(prototype, table=with_effect('joints'),
                       initial=InitialState(0.3, 1.6, 'open', 0.3, 0.0))
    spin = plant.ledger().links_spin
    plant.advance(20_000, np.zeros(4))
    truth = plant.truth()
    assert np.ptp(truth.link_rates) < 1e-6
    assert abs(truth.link_rates[0]) > 0.01
    assert plant.ledger().links_spin == pytest.approx(spin, rel=1e-12)


def test_disturbances_are_white_torques_of_the_density_asked_for(
    prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """The variance of the angular momentum is 4 density^2 time, within four standard errors."""
    density, runs = 1e-4, 400
    plant = make_plant(prototype, table=Table(**SENSORS, disturbance=Disturbance(density)))
    gained = []
    for _ in range(runs):
        before = plant.ledger().disturbance_spin
        for _ in range(5):
            plant.disturb(4e-3)
            plant.advance(8, np.zeros(4))
        gained.append(plant.ledger().disturbance_spin - before)
    variance = np.mean(np.square(gained)) / (4.0 * density**2 * 5 * 8 * 5e-4)
    assert abs(variance - 1.0) < 4.0 * np.sqrt(2.0 / runs)


def test_disturbances_walk_with_the_density_asked_for(
    prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """
    Increments (seed 0) and begin (seeds 0 to 199) agree within four standard errors.

    The impulse on the links is that of the reported torques.
    """
    density, draws, period = 2e-4, 1000, 4e-3
    table = Table(**SENSORS, disturbance=Disturbance(torque_walk=density))
    plant = make_plant(prototype, table=table)
    torques, spin = [], []
    for _ in range(draws):
        plant.disturb(period)
        plant.advance(8, np.zeros(4))
        torques.append(plant.truth().random_walk_torques)
        spin.append(plant.ledger().disturbance_spin)
    np.testing.assert_allclose(spin, period * np.cumsum(np.sum(torques, axis=1)), rtol=1e-9)
    steps = np.diff(torques, axis=0) / (density * np.sqrt(period))
    assert np.abs((steps ** 2).mean(axis=0) - 1.0).max() < 4.0 * np.sqrt(2.0 / draws)
    assert abs((steps[:, 0] * steps[:, 1]).mean()) < 4.0 / np.sqrt(draws)

    begins = []
    for seed in range(200):
        plant = make_plant(prototype, table=table, seed=seed)
        plant.disturb(period)
        begins.append(plant.truth().random_walk_torques / (density * np.sqrt(TORQUE_WALK_AGE)))
    assert abs(np.square(begins).mean() - 1.0) < 4.0 * np.sqrt(2.0 / 400)


def test_walk_is_drawn_after_the_white_torques_and_continues_after_a_reset(
    prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """The walk does not change the white torques, and a reset does not restart it."""
    white, both = (make_plant(prototype, table=Table(**SENSORS, disturbance=made)) for made in (
        Disturbance(1e-4), Disturbance(1e-4, 2e-4)))
    for plant in (white, both):
        plant.disturb(4e-3)
        plant.advance(8, np.zeros(4))
    assert white.truth().random_walk_torques.tolist() == [0.0, 0.0]
    walked = both.truth().random_walk_torques
    assert both.ledger().disturbance_spin - white.ledger().disturbance_spin == pytest.approx(
        4e-3 * walked.sum(), rel=1e-9)
    both.reset(MOVING)
    assert both.truth().random_walk_torques.tolist() == walked.tolist()


@pytest.mark.parametrize('restitution', [0.0, 0.5, 1.0])
def test_contact_with_the_edge_has_the_restitution(
    restitution: float, prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """The impulse is normal to the edge, and the budget contains the lost energy."""
    surface = Surface(size_x=0.5, restitution=restitution)
    plant = make_plant(prototype, table=Table(**SENSORS, surface=surface), initial=MOVING)
    plant._state[18:20] = [0.3, 0.1]
    lever, speed = np.empty((4, 2)), np.zeros(4)

    def outward() -> Array:
        for joint in range(4):
            joint_levers(joint, plant._state, prototype.constants, lever)
            speed[joint] = plant._state[18] - lever[:, 1] @ plant._state[LINK_RATES]
        return speed.copy()
    while not plant.ledger().contacts:
        before, before_momentum = outward(), linear_momentum(prototype, plant._state)
        spin = total_angular_momentum(prototype, plant._state)
        energy = plant.ledger()
        plant.advance(1, np.zeros(4))
    after, ledger = outward(), plant.ledger()
    hit = int(np.argmax(before - after))
    # One step lies between the two states: 5e-4 s times an acceleration of order one.
    assert after[hit] == pytest.approx(-restitution * before[hit], abs=2e-3)
    momentum = linear_momentum(prototype, plant._state)
    assert momentum[1] == pytest.approx(before_momentum[1], rel=1e-12)
    assert momentum[0] < before_momentum[0]
    # The moment of the impulse about the origin is the change of the angular momentum.
    joint_levers(hit, plant._state, prototype.constants, lever)
    place = plant._state[16:18] + lever.sum(axis=0)
    assert place[0] == pytest.approx(0.25, abs=1e-3)
    assert total_angular_momentum(prototype, plant._state) - spin == pytest.approx(
        -place[1] * (momentum[0] - before_momentum[0]), rel=1e-9)
    assert energy.links - ledger.links == pytest.approx(ledger.edge, abs=1e-12)
    assert np.abs(joint_gaps(prototype, plant._state)).max() < 1e-12


def test_edge_holds_a_linkage_at_rest(prototype: Mechanism, make_plant: MakePlant) -> None:
    """On a tilted table with a soft edge the linkage comes to rest on the table."""
    table = Table(**SENSORS, links=Links(0.5, 1e-2),
                  surface=Surface(tilt_x=0.02, size_x=0.8, size_y=0.8))
    plant = make_plant(prototype, table=table)
    lever = np.empty((4, 2))
    for _ in range(200):
        plant.advance(100, np.zeros(4))
        for joint in range(4):
            joint_levers(joint, plant._state, prototype.constants, lever)
            assert np.abs(plant._state[16:18] + lever.sum(axis=0)).max() < 0.4 + 1e-3
    assert plant.ledger().contacts > 10
    assert np.abs(plant.truth().centre_velocity).max() < 0.02


def test_reset_restarts_the_budget(prototype: Mechanism, make_plant: MakePlant) -> None:
    plant = driven(make_plant(prototype, table=with_effect('all')), 0.2)
    plant.reset(MOVING)
    ledger = plant.ledger()
    assert (ledger.supplied, ledger.bearings, ledger.unaccounted, ledger.contacts) == (0, 0, 0, 0)
    assert plant.truth().link_rates[:2].tolist() == [1.0, -0.5]
    with pytest.raises(PlantError):
        plant.reset(InitialState(0.0, np.pi, rate_a=1.0))   # a change point
    assert plant.truth().link_rates[:2].tolist() == [1.0, -0.5]


def test_friction_too_stiff_for_the_step_is_refused(
    paper: Mechanism, make_plant: MakePlant, refuses: Refuses,
) -> None:
    """The links of the paper are too light for the joints of the prototype."""
    with refuses(PlantError, name='joints', value=5e-4, limit=pytest.approx(4.5e-6, rel=0.12)):
        make_plant(paper, table=load_table('prototype'))


@pytest.mark.parametrize('drag', [Links(1e4, 0.0), Links(0.0, 1e3)])
def test_drag_too_stiff_for_the_step_is_refused(
    drag: Links, prototype: Mechanism, make_plant: MakePlant, refuses: Refuses,
) -> None:
    with refuses(PlantError, name='links', value=5e-4):
        make_plant(prototype, table=Table(**SENSORS, links=drag))


def test_start_beyond_the_edge_is_refused(prototype: Mechanism, make_plant: MakePlant) -> None:
    """The error names the joint and the distance; a refused reset has no effect."""
    small = Table(**SENSORS, surface=Surface(size_x=0.55))
    with pytest.raises(PlantError) as refusal:
        make_plant(prototype, table=small, initial=InitialState(0.0, 0.3))
    values = refusal.value.values
    assert values['joint'] in range(1, 5) and 0.0 < values['value'] < 1.0
    plant = make_plant(prototype, table=small, initial=InitialState(0.0, np.pi / 2))
    with pytest.raises(PlantError):
        plant.reset(InitialState(0.0, 0.3))
    assert plant.truth().link_angles[1] == pytest.approx(np.pi / 2)


def test_shorter_steps_change_little(prototype: Mechanism, make_plant: MakePlant) -> None:
    """The step of 0.5 ms suffices for torques held over 4 ms and all deterministic effects."""
    still = replace(with_effect('all'), disturbance=Disturbance(), surface=Surface())
    ends = []
    for step in (5e-4, 1.25e-4):
        plant = make_plant(prototype, table=still, step_s=step)
        for n in range(500):
            plant.advance(round(4e-3 / step), 4e-3 * np.sin(4e-3 * n * np.array([1, 2, 3, 0.7])))
        ends.append(plant.truth())
    assert np.abs(ends[0].link_angles - ends[1].link_angles).max() < 1e-5
    # Each of at most two reversals of a wheel is late by up to a step of static friction.
    late = 2 * 5e-4 * 1.3e-3 / 1.2e-4
    assert np.abs(ends[0].wheel_speeds - ends[1].wheel_speeds).max() < late
