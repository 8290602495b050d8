# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Wheel commands: wheels gain the demanded momentum despite bearing friction."""

from __future__ import annotations

from dataclasses import replace

from fourbar_ros.control import ControllerSettings, WheelCommand
from fourbar_ros.control.wheel_command import by_name, FRICTION_SPEED, SPEED_REACH, WheelCommander
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.motors import SPEED_BANDWIDTH
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelBearings, WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

PERIOD, STEP = 4e-3, 5e-4
STEPS = 8
ALL = np.ones(4, dtype=bool)
NONE = np.zeros(4)
RUBBING = WheelBearings(viscous=2e-6, coulomb=1e-3, static_ratio=1.3)


def plant_with(mechanism: Mechanism, bearings: WheelBearings) -> Plant:
    table = Table(LinkSensorSettings(), WheelEncoders(0), wheel_bearings=bearings)
    return Plant(mechanism, table, InitialState(), STEP, np.random.default_rng(0))


def momenta(mechanism: Mechanism, plant: Plant) -> Array:
    """Return the absolute momentum of the wheels (4,) [N m s]."""
    truth = plant.truth()
    return mechanism.flywheel_inertias * (truth.wheel_speeds + truth.link_rates)


def drive_for(plant: Plant, drive: WheelCommander, torques: Array, seconds: float, by_speed: bool,
              settings: ControllerSettings) -> list[WheelCommand]:
    """Command torques that shall act, as the controller does, telling it how links accelerate."""
    commands, rates = [], plant.truth().link_rates
    for _ in range(round(seconds / PERIOD)):
        truth = plant.truth()
        # The acceleration of the free links in the last period is accurate enough.
        acceleration, rates = (truth.link_rates - rates) / PERIOD, truth.link_rates
        drive.update_friction(
            truth.wheel_speeds, settings.bearing_coulomb, settings.bearing_viscous)
        command = drive.command(torques, acceleration, truth.wheel_speeds, ALL, PERIOD, by_speed)
        plant.advance(STEPS, command.values, command.by_speed, command.powered)
        commands.append(command)
    return commands


TORQUES = np.array([2e-3, -1.5e-3, 1e-3, -3e-3])


@pytest.mark.parametrize('bearings', [WheelBearings(), RUBBING], ids=['smooth', 'rubbing'])
def test_commanded_speeds_give_the_demanded_momentum(
    bearings: WheelBearings, prototype: Mechanism,
) -> None:
    """From standstill, the speed loop of the motors compensates the friction."""
    plant, drive = plant_with(prototype, bearings), WheelCommander(prototype)
    drive.reset(np.zeros(4))
    drive_for(plant, drive, TORQUES, 2.0, True, ControllerSettings())
    gained = momenta(prototype, plant)
    # The speed lags a ramp by at most 4 a / bandwidth^2 times the initial friction transient,
    # which is less than 2 periods of the torque.
    np.testing.assert_allclose(gained, TORQUES * 2.0, atol=2.0 * PERIOD * np.abs(TORQUES).max())


def test_commanded_torques_have_the_friction_added(prototype: Mechanism) -> None:
    """Turning wheels gain the demanded momentum only with known bearings."""
    bearings = replace(RUBBING, static_ratio=1.0)
    known = ControllerSettings(bearing_coulomb=bearings.coulomb, bearing_viscous=bearings.viscous)
    for settings, gained_share in ((known, 1.0), (ControllerSettings(), 0.5)):
        plant, drive = plant_with(prototype, bearings), WheelCommander(prototype)
        plant.advance(1000, 2.0 * TORQUES + np.copysign(2e-3, TORQUES))
        assert np.abs(plant.truth().wheel_speeds).min() > 10.0 * FRICTION_SPEED
        # The transient of the motor lag ends.
        drive_for(plant, drive, TORQUES, 0.1, False, settings)
        before = momenta(prototype, plant)
        commands = drive_for(plant, drive, TORQUES, 1.0, False, settings)
        gained = (momenta(prototype, plant) - before) / TORQUES
        assert not any(command.by_speed for command in commands)
        if gained_share == 1.0:
            # Viscous friction grows by 2e-6 * 25 rad/s a second; its compensation is late by T.
            np.testing.assert_allclose(gained, 1.0, atol=1e-3)
        else:
            assert (gained < 0.7).all()


def test_friction_has_the_sign_of_the_speed_above_a_small_speed(prototype: Mechanism) -> None:
    drive = WheelCommander(prototype)
    speeds = np.array([0.0, 0.25 * FRICTION_SPEED, -FRICTION_SPEED, 100.0])
    np.testing.assert_allclose(
        drive.update_friction(speeds, 1e-3, 2e-6),
        [0.0, 2.5e-4 + 2e-6 * 0.25 * FRICTION_SPEED, -1e-3 - 2e-6 * FRICTION_SPEED,
         1e-3 + 2e-4], rtol=1e-12)
    # The friction is dissipative, odd and continuous.
    sweep = np.linspace(-2.0, 2.0, 4001)
    friction = np.array([
        drive.update_friction(np.full(4, speed), 1e-3, 2e-6)[0] for speed in sweep])
    assert (friction * sweep >= 0.0).all()
    np.testing.assert_allclose(friction, -friction[::-1], atol=1e-18)
    assert np.abs(np.diff(friction)).max() <= (1e-3 / FRICTION_SPEED + 2e-6) * 1.001e-3


def test_commanded_torques_are_within_the_motor_limits(prototype: Mechanism) -> None:
    drive = WheelCommander(prototype)
    drive.update_friction(np.full(4, 100.0), 1e-3, 0.0)
    command = drive.command(np.array([0.05, -0.05, 0.02, 0.0]), NONE, NONE, ALL, PERIOD, False)
    np.testing.assert_allclose(command.values, [0.05, -0.049, 0.021, 0.001])


@pytest.mark.parametrize('speed', [0.0, 120.0, -40.0])
def test_speed_commands_start_at_the_wheel_speeds(speed: float, prototype: Mechanism) -> None:
    """A zero demand causes no torque at any speed."""
    plant, drive = plant_with(prototype, WheelBearings()), WheelCommander(prototype)
    plant.advance(1000, np.full(4, speed), True)
    # The time is more than 30 time constants of the motors.
    plant.advance(200, np.zeros(4))
    before = momenta(prototype, plant)
    truth = plant.truth()
    drive.reset(truth.wheel_speeds)
    command = drive.command(NONE, NONE, truth.wheel_speeds, ALL, PERIOD, True)
    np.testing.assert_array_equal(command.values, truth.wheel_speeds)
    plant.advance(STEPS, command.values, True)
    np.testing.assert_allclose(momenta(prototype, plant), before, rtol=1e-9, atol=1e-12)


def test_change_from_torques_to_speeds_starts_at_the_measured_speeds(prototype: Mechanism
                                                                     ) -> None:
    drive = WheelCommander(prototype)
    drive.reset(np.full(4, 500.0))
    speeds = np.array([10.0, -20.0, 30.0, 0.0])
    drive.command(NONE, NONE, speeds, ALL, PERIOD, False)
    np.testing.assert_array_equal(
        drive.command(NONE, NONE, speeds, ALL, PERIOD, True).values, speeds)


def test_speed_commands_lead_by_no_more_than_the_motor_can_follow(prototype: Mechanism) -> None:
    """The command of a blocked wheel demands most of its torque and does not wind up."""
    drive, speeds = WheelCommander(prototype), np.full(4, 20.0)
    drive.reset(speeds)
    for _ in range(1000):
        command = drive.command(TORQUES, NONE, speeds, ALL, PERIOD, True)
    asked = SPEED_BANDWIDTH * prototype.flywheel_inertias * (command.values - speeds)
    np.testing.assert_allclose(
        asked, SPEED_REACH * prototype.motor_torque_limits * np.sign(TORQUES), rtol=1e-12)
    back = drive.command(-TORQUES, NONE, speeds, ALL, PERIOD, True)
    assert (np.sign(back.values - command.values) == -np.sign(TORQUES)).all()


def test_speed_commands_include_the_acceleration_of_the_links(prototype: Mechanism) -> None:
    """A wheel without torque keeps its absolute speed, so its relative speed changes."""
    drive, acceleration = WheelCommander(prototype), np.array([1.0, -2.0, 0.5, 0.0])
    drive.reset(NONE)
    for _ in range(5):
        command = drive.command(NONE, acceleration, NONE, ALL, PERIOD, True)
    np.testing.assert_allclose(command.values, -5.0 * PERIOD * acceleration, rtol=1e-12)


# Without power

def test_wheel_without_power_is_missing_and_does_not_wind_up(prototype: Mechanism) -> None:
    drive, powered = WheelCommander(prototype), np.array([True, False, True, True])
    drive.reset(NONE)
    for speed in (10.0, 8.0, 6.0):
        command = drive.command(TORQUES, NONE, np.full(4, speed), powered, PERIOD, True)
    names, velocities, efforts = by_name(command)
    assert names == ('flywheel_a', 'flywheel_c', 'flywheel_d')
    assert velocities == command.values[[0, 2, 3]].tolist()
    assert efforts == []
    assert command.values[1] == 6.0


@pytest.mark.parametrize('by_speed', [False, True])
def test_message_has_either_velocities_or_efforts(by_speed: bool) -> None:
    values = np.array([1.0, 2.0, 3.0, 4.0])
    names, velocities, efforts = by_name(WheelCommand(values, by_speed, ALL))
    assert names == ('flywheel_a', 'flywheel_b', 'flywheel_c', 'flywheel_d')
    assert (velocities, efforts) == (([1.0, 2.0, 3.0, 4.0], []) if by_speed
                                     else ([], [1.0, 2.0, 3.0, 4.0]))
    assert by_name(WheelCommand(values, by_speed, ~ALL)) == ((), [], [])
