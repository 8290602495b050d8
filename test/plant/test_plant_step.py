# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Loss and return of power of single motors."""

from collections.abc import Callable
from dataclasses import replace

from fourbar_ros.mechanism import load_mechanism, Mechanism
from fourbar_ros.plant import load_table, parse_fault, Plant, Table
from fourbar_ros.plant.bearings import bearing_torque, drives_of
from fourbar_ros.plant.faults import wheel_faults
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.step import conditions_of, Packed, SOUND
from fourbar_ros.plant.table import WheelBearings, WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
MakePlant = Callable[..., Plant]

STEP = 5e-4
LAG = 3e-3
WITHOUT_B = np.array([True, False, True, True])


@pytest.fixture(scope='module')
def prototype() -> Mechanism:
    """Load the linkage whose motors lag."""
    mechanism = load_mechanism('prototype')
    assert mechanism.motor_time_constants.tolist() == [LAG] * 4
    return mechanism


def broken_b(text: str) -> Packed:
    """Return conditions with a fault of wheel b only."""
    fault = parse_fault('flywheel_b', text)
    return conditions_of(wheel_faults([fault] if fault else []))


def wheel_momenta(plant: Plant) -> Array:
    """Return the momentum of each wheel (4,) [N m s]."""
    truth = plant.truth()
    return plant.mechanism.flywheel_inertias * (truth.wheel_speeds + truth.link_rates)


def after(plant: Plant) -> tuple[bytes, bytes]:
    """Return the bytes of the state and of the efforts."""
    return plant._state.tobytes(), plant.efforts.tobytes()


@pytest.mark.parametrize('steps', [1, 6, 40])
@pytest.mark.parametrize(('asked', 'by_speed', 'text', 'torque'), [
    (0.01, False, 'none', 0.01),
    # Far from the commanded speed the loop is at the torque limit.
    (1000.0, True, 'none', 0.05),
    (0.0, False, 'runaway 0.02', 0.02),
    (1000.0, True, 'runaway -10', -0.05)])
def test_torque_of_a_motor_without_power_decays_with_its_lag(
    asked: float, by_speed: bool, text: str, torque: float, steps: int, prototype: Mechanism,
    make_plant: MakePlant,
) -> None:
    """The impulse after the cut is the integral of T exp(-t / tau), for any command."""
    plant, conditions = make_plant(prototype), broken_b(text)
    commands, follows = np.array([0.0, asked, 0.0, 0.0]), np.array([False, by_speed, False, False])
    plant.advance(200, commands, follows, conditions=conditions)
    before = wheel_momenta(plant)
    plant.advance(steps, commands, follows, WITHOUT_B, conditions)
    impulse = wheel_momenta(plant) - before
    expected = torque * LAG * (1.0 - np.exp(-steps * STEP / LAG))
    # The transient of the lag is exp(-33) = 3e-15 after 0.1 s; 240 roundings of 5e-3 N m s.
    assert impulse[1] == pytest.approx(expected, rel=1e-14, abs=240 * 2.2e-16 * 5e-3)
    assert plant.efforts[1] * steps * STEP == pytest.approx(expected, rel=1e-13)
    assert not plant.efforts[[0, 2, 3]].any()


@pytest.mark.parametrize(('value', 'torque'), [('0.02', 0.02), ('-10', -0.05), ('0', 0.0)])
def test_torque_of_a_shorted_motor_does_not_depend_on_power(
    value: str, torque: float, prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """The bits are equal for any command."""
    conditions, found = broken_b(f'shorted {value}'), set()
    for asked, by_speed, powered in ((0.01, False, True), (0.01, False, False),
                                     (100.0, True, True), (100.0, True, False)):
        plant = make_plant(prototype)
        plant.advance(200, np.array([0.0, asked, 0.0, 0.0]),
                      np.array([False, by_speed, False, False]),
                      np.array([True, powered, True, True]), conditions)
        found.add(after(plant))
    assert len(found) == 1
    plant.advance(1, np.zeros(4), powered=False, conditions=conditions)
    # The transient of the lag is exp(-33) = 3e-15 after 0.1 s.
    assert plant.efforts.tolist() == pytest.approx([0.0, torque, 0.0, 0.0], rel=1e-14)


@pytest.mark.parametrize('seed', range(4))
def test_motor_without_power_equals_one_with_zero_command(
    seed: int, prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """The bits are equal, with friction, lag, and a wheel that runs away under power."""
    rng, table = np.random.default_rng(seed), load_table('prototype')
    cut, zero = make_plant(prototype, table=table), make_plant(prototype, table=table)
    runaway = broken_b('runaway -4e-3')
    for period in range(100):
        by_speed, powered = rng.random((2, 4)) < 0.5
        commands = rng.uniform(-1.0, 1.0, 4) * np.where(by_speed, 50.0, 0.02)
        cut.advance(8, commands, by_speed, powered, runaway)
        zero.advance(8, np.where(powered, commands, 0.0), by_speed & powered,
                     conditions=runaway if powered[1] else SOUND)
        assert after(cut) == after(zero), f'seed {seed}, period {period}'
        for name in ('torque', 'integral'):
            np.testing.assert_array_equal(cut.motor_states[name], zero.motor_states[name],
                                          f'seed {seed}, period {period}')


def test_integral_of_the_speed_loop_restarts_after_a_cut(
    prototype: Mechanism, make_plant: MakePlant,
) -> None:
    """
    At the commanded speed a new loop gives no torque; an old loop gives its friction estimate.

    The other wheels follow their commands throughout.
    """
    bearings = WheelBearings(viscous=2e-6, coulomb=1e-3)
    quick = replace(prototype, motor_time_constants=np.zeros(4))
    plant = make_plant(quick, table=Table(LinkSensorSettings(), WheelEncoders(0), bearings))
    wanted = np.array([20.0, 50.0, -50.0, -20.0])
    plant.advance(4000, wanted, by_speed=True)
    motors = drives_of(quick, bearings)
    friction = np.array([bearing_torque(speed, 0.0, motors) for speed in wanted])
    plant.advance(1, plant.truth().wheel_speeds, by_speed=True)
    np.testing.assert_allclose(plant.efforts, friction, rtol=1e-6)

    plant.advance(400, wanted, True, WITHOUT_B)
    assert plant.efforts[1] == 0.0
    coasting = plant.truth().wheel_speeds
    # Friction of 1.1e-3 N m (4e-6 less at the end) slows 1.2e-4 kg m^2 by 1.8 rad/s in 0.2 s. It
    # accelerates the pair of links, 0.039 kg m^2, at 0.028 rad/s^2. The loops of the other wheels
    # then have errors of at most 0.028 / 30 / e rad/s and 1.2e-4 kg m^2 * 0.028 rad/s^2.
    turn = 1.1e-3 / 0.039
    assert coasting[1] == pytest.approx(50.0 - 0.2 * (1.1e-3 / 1.2e-4 + turn), abs=7e-3)
    np.testing.assert_allclose(
        coasting[WITHOUT_B], wanted[WITHOUT_B], rtol=0.0, atol=turn / 30.0 / np.e)
    plant.advance(1, np.where(WITHOUT_B, wanted, coasting), by_speed=True)
    assert plant.efforts[1] == 0.0
    np.testing.assert_allclose(
        plant.efforts[WITHOUT_B], friction[WITHOUT_B], rtol=0.0, atol=1.05 * turn * 1.2e-4)
    plant.advance(2000, wanted, by_speed=True)
    np.testing.assert_allclose(plant.truth().wheel_speeds, wanted, rtol=1e-9)
