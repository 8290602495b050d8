# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Plant: conservation laws, motor limits, sensors, and refused settings."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from math import inf, nan, pi

from fourbar_ros.common.settings import SettingError
from fourbar_ros.mechanism import (
    angular_momentum,
    closure_error,
    ClosureError,
    kinetic_energy,
    Mechanism,
)
from fourbar_ros.mechanism.change_points import RATES_UNDETERMINED
from fourbar_ros.mechanism.closure import BRANCHES
from fourbar_ros.mechanism.samples import TrueState
from fourbar_ros.plant import InitialState, Plant, PlantError, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
MakePlant = Callable[..., Plant]
Refuses = Callable[..., AbstractContextManager[None]]

STEP = 5e-4
# 4000 steps (2 s) with ten roundings of 1.1e-16 of one sign are 4.4e-12. The truncation error
# of a step, (3 rad/s * 5e-4 s)^5 / 120 = 6e-17, is less than one rounding.
LONG = 4000
DRIFT = 1e-11
# Two-sided confidence of every statistical bound below.
CONFIDENCE = 0.999
MOVING = InitialState(0.3, 1.6, 'open', 2.0, -1.0)
TORQUES = np.array([3e-5, -2e-5, 4e-5, 1e-5])


def absolute_speeds(truth: TrueState) -> Array:
    return truth.wheel_speeds + truth.link_rates


def momentum(plant: Plant) -> float:
    truth = plant.truth()
    return angular_momentum(
        plant.mechanism, truth.link_angles, truth.link_rates, absolute_speeds(truth))


def energy(plant: Plant) -> float:
    truth = plant.truth()
    return kinetic_energy(
        plant.mechanism, truth.link_angles, truth.link_rates, absolute_speeds(truth))


@pytest.fixture(params=['paper', 'uneven'])
def mechanism(request: pytest.FixtureRequest) -> Mechanism:
    """Return the linkage of the paper, then one without any symmetry."""
    linkage: Mechanism = request.getfixturevalue(request.param)
    return linkage


@pytest.mark.parametrize('branch', ['open', 'crossed'])
def test_without_torque_momentum_and_energy_are_constant(
    mechanism: Mechanism, branch: str, make_plant: MakePlant,
) -> None:
    plant = make_plant(mechanism, initial=replace(MOVING, branch=branch))
    before = momentum(plant), energy(plant)
    plant.advance(LONG, np.zeros(4))
    assert (momentum(plant), energy(plant)) == pytest.approx(before, rel=DRIFT)
    assert closure_error(mechanism, plant.truth().link_angles) < 1e-15


def test_torques_only_move_momentum_between_wheels_and_links(
    mechanism: Mechanism, make_plant: MakePlant,
) -> None:
    plant = make_plant(mechanism)
    for torques in (TORQUES, -2.0 * TORQUES, TORQUES[::-1]):
        plant.advance(400, torques)
    truth = plant.truth()
    moved = float(mechanism.flywheel_inertias @ np.abs(absolute_speeds(truth)))
    assert moved > 1e-6
    assert abs(momentum(plant)) < DRIFT * moved


def test_work_of_the_motors_becomes_energy(mechanism: Mechanism, make_plant: MakePlant) -> None:
    plant = make_plant(mechanism)
    # Simpson's rule over the power tau Omega, constant torques: its error is (h w)^4 / 180 of the
    # total, with h w < 0.04 for the few rad/s and rad/s^2 of this motion.
    samples = 101
    power = np.empty(samples)
    for n in range(samples):
        power[n] = TORQUES @ plant.truth().wheel_speeds
        if n < samples - 1:
            plant.advance(10, TORQUES)
    weights = np.where(np.arange(samples) % 2, 4.0, 2.0)
    weights[[0, -1]] = 1.0
    work = 10 * STEP / 3.0 * float(weights @ power)
    assert energy(plant) == pytest.approx(work, rel=0.04 ** 4 / 180.0 + DRIFT)


def test_motor_limits_do_not_change_momentum(mechanism: Mechanism, make_plant: MakePlant) -> None:
    weak = replace(mechanism, motor_torque_limits=np.full(4, 2e-5),
                   motor_speed_limits=np.array([4.0, 2.0, 6.0, 500.0]))
    plant = make_plant(weak)
    plant.advance(1000, np.array([1.0, -1.0, 1e-5, 1e-3]))
    truth = plant.truth()
    assert (np.abs(truth.wheel_speeds[:2]) > [3.9, 1.9]).all()
    moved = float(weak.flywheel_inertias @ np.abs(absolute_speeds(truth)))
    assert abs(momentum(plant)) < DRIFT * moved


def test_efforts_are_changes_of_momentum(mechanism: Mechanism, make_plant: MakePlant) -> None:
    """The mean torque times the time is the change of momentum, for every kind of command."""
    limited = replace(mechanism, motor_speed_limits=np.array([3.0, 3.0, 500.0, 500.0]))
    plant = make_plant(limited)
    rng = np.random.default_rng(1)
    speeds = absolute_speeds(plant.truth())
    for _ in range(50):
        commands = rng.uniform(-3e-4, 3e-4, 4)
        plant.advance(8, commands)
        truth = plant.truth()
        gained = limited.flywheel_inertias * (absolute_speeds(truth) - speeds)
        # Eight roundings of a wheel's momentum, at most a hundred rad/s.
        np.testing.assert_allclose(
            truth.efforts * 8 * STEP, gained, rtol=0.0, atol=8 * 2.2e-16 * 100 * 5e-7 * 10)
        assert (np.abs(truth.efforts) <= limited.motor_torque_limits * (1 + 1e-15)).all()
        speeds = absolute_speeds(truth)


def test_torque_beyond_the_limit_acts_as_the_limit(
    paper: Mechanism, make_plant: MakePlant,
) -> None:
    plant, same = make_plant(), make_plant()
    plant.advance(8, np.array([1.0, -1.0, 0.0, 2e-4]))
    same.advance(8, np.array([1e-4, -1e-4, 0.0, 1e-4]))
    assert plant.truth().efforts == pytest.approx([1e-4, -1e-4, 0.0, 1e-4], rel=1e-14)
    assert plant.truth().link_angles.tobytes() == same.truth().link_angles.tobytes()


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_speed_limit_blocks_torque_only_into_the_stop(
    sign: float, paper: Mechanism, make_plant: MakePlant,
) -> None:
    limit = 20.0
    plant = make_plant(replace(paper, motor_speed_limits=np.full(4, limit)))
    drive = sign * np.array([1e-4, 0.0, 0.0, 0.0])
    # With 1e-4 N m and 3.4e-7 kg m^2 a wheel reaches 20 rad/s in 68 ms.
    plant.advance(200, drive)
    speed = sign * plant.truth().wheel_speeds[0]
    # The speed may pass the limit by that of one step (the recoil is less than 1 % of it).
    assert limit <= speed <= limit + 1.01 * 1e-4 / 3.4e-7 * STEP
    plant.advance(8, drive)
    assert plant.truth().efforts[0] == 0.0
    plant.advance(8, -drive)
    assert plant.truth().efforts[0] == pytest.approx(-drive[0], rel=1e-14)
    assert sign * plant.truth().wheel_speeds[0] < limit
    plant.advance(1, drive)
    assert plant.truth().efforts[0] == drive[0]


def test_wheels_start_at_rest_on_moving_links(mechanism: Mechanism, make_plant: MakePlant) -> None:
    truth = make_plant(mechanism, initial=MOVING).truth()
    assert truth.link_rates[:2].tolist() == [MOVING.rate_a, MOVING.rate_b]
    assert not truth.wheel_speeds.any()
    assert not truth.wheel_angles.any()
    assert not truth.efforts.any()


def test_truth_is_a_copy(make_plant: MakePlant) -> None:
    plant = make_plant()
    truth = plant.truth()
    for name in ('link_angles', 'link_rates', 'wheel_angles', 'wheel_speeds', 'efforts'):
        getattr(truth, name)[:] = 9.0
    assert 9.0 not in plant.truth().link_angles
    plant.advance(1, np.zeros(4))
    assert not plant.truth().efforts.any()


@pytest.mark.parametrize('counts', [4, 1000, 16384])
def test_samples_are_on_the_grid_of_the_resolution(counts: int, make_plant: MakePlant) -> None:
    step = 2.0 * pi / counts
    plant = make_plant(table=Table(LinkSensorSettings(), WheelEncoders(counts)),
                       initial=InitialState(0.7, 2.0, 'open', 1.0, 0.3))
    plant.advance(321, TORQUES)
    samples, errors = plant.sense_wheels(), plant.sense_wheels() - plant.truth().wheel_angles
    np.testing.assert_allclose(samples / step, np.round(samples / step), atol=1e-9)
    assert (np.abs(errors) <= step / 2.0 * (1 + 1e-9)).all()


def test_link_sensors_measure_the_links(make_plant: MakePlant) -> None:
    """Sensors without errors measure orientations, wrapped to one turn, and rates."""
    gyros = LinkSensorSettings(gyro=True)
    plant = make_plant(table=Table(gyros, WheelEncoders(0)),
                       initial=InitialState(9.7, 11.0, 'open', 1.0, 0.3))
    plant.advance(321, TORQUES)
    plant.measure_links(5)
    reading, = plant.link_sensors.due(5)
    truth = plant.truth()
    np.testing.assert_allclose(
        reading.angles, np.angle(np.exp(1j * truth.link_angles)), rtol=0.0, atol=1e-12)
    assert reading.rates.tolist() == truth.link_rates.tolist()
    assert reading.names == ('link_a', 'link_b', 'link_c', 'link_d')


def test_wheel_encoders_count_turns(make_plant: MakePlant) -> None:
    plant = make_plant()
    plant.advance(4000, np.array([2e-5, 0.0, 0.0, 0.0]))
    assert plant.sense_wheels()[0] > 4.0 * pi
    assert plant.sense_wheels().tolist() == plant.truth().wheel_angles.tolist()


def record(plant: Plant) -> bytes:
    samples = []
    for stamp_ns in range(20):
        plant.advance(8, TORQUES)
        plant.measure_links(stamp_ns)
        reading, = plant.link_sensors.due(stamp_ns)
        samples += [reading.angles, plant.sense_wheels(), plant.truth().link_rates]
    return np.array(samples).tobytes()


def test_same_seed_same_bytes(make_plant: MakePlant) -> None:
    table = Table(LinkSensorSettings(noise_rms=1e-3, counts_per_turn=16384), WheelEncoders(16384))
    assert record(make_plant(table=table, seed=7)) == record(make_plant(table=table, seed=7))
    assert record(make_plant(table=table, seed=7)) != record(make_plant(table=table, seed=8))


@pytest.mark.medium
@settings(deadline=None, max_examples=200, derandomize=True)
@given(count=st.integers(1, 100_000), step=st.floats(1e-6, 0.1))
def test_whole_multiples_are_counted(count: int, step: float, make_plant: MakePlant) -> None:
    plant = make_plant()
    plant.step_s = step
    assert plant.steps_in(count * step) == count


@pytest.mark.parametrize('period', [0.0041, 1e-4, 1e-9])
def test_period_that_is_no_multiple_is_refused(
    period: float, make_plant: MakePlant, refuses: Refuses,
) -> None:
    with refuses(PlantError, value=period, limit=5e-4):
        make_plant().steps_in(period)


@pytest.mark.parametrize('step', [0.0, -1e-3, nan, inf])
def test_step_that_is_no_positive_number_is_refused(
    step: float, make_plant: MakePlant, refuses: Refuses,
) -> None:
    with refuses(PlantError, name='step', value=pytest.approx(step, nan_ok=True)):
        make_plant(step_s=step)


@pytest.mark.parametrize('name', ['link_a', 'link_b', 'rate_a', 'rate_b'])
@pytest.mark.parametrize('value', [nan, inf, -inf])
def test_initial_state_must_be_finite(
    name: str, value: float, refuses: Refuses,
) -> None:
    with refuses(SettingError, name=f'initial.{name}', value=value):
        replace(InitialState(), **{name: value})


@pytest.mark.parametrize('theta', [0.0, pi])
def test_rates_at_a_change_point_are_refused(
    theta: float, paper: Mechanism, make_plant: MakePlant, refuses: Refuses,
) -> None:
    """A start at rest is possible; with motion, two rates do not determine the other two."""
    rectangle = replace(paper, link_lengths=np.array([0.1, 0.05, 0.1, 0.05]))
    make_plant(rectangle, initial=InitialState(0.2, 0.2 + theta))
    with refuses(PlantError, limit=RATES_UNDETERMINED):
        make_plant(rectangle, initial=InitialState(0.2, 0.2 + theta, rate_b=0.1))


def test_initial_angles_that_cannot_close_are_refused(
    uneven: Mechanism, make_plant: MakePlant,
) -> None:
    long = replace(uneven, link_lengths=np.array([0.3, 0.3, 0.2, 0.2]))
    with pytest.raises(ClosureError):
        make_plant(long, initial=InitialState(0.0, 3.0))


def test_initial_branch_must_be_an_assembly(
    refuses: Refuses,
) -> None:
    with refuses(SettingError, name='initial.branch', value='folded', limit=BRANCHES):
        InitialState(branch='folded')


def test_state_that_is_not_finite_is_an_error(
    paper: Mechanism, make_plant: MakePlant,
) -> None:
    plant = make_plant(replace(paper, motor_torque_limits=np.full(4, inf)))
    with pytest.raises(PlantError):
        plant.advance(10, np.full(4, 1e300))
