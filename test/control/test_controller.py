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

"""What the controller does before, while and after it may drive."""

from collections.abc import Callable
from dataclasses import replace
from math import pi
from typing import Any

from fourbar_ros.control import (
    Controller,
    ControllerSettings,
    SetpointError,
)
from fourbar_ros.control.accounts import COPPER, EQ9, FLYWHEEL_ENERGY, WORK
from fourbar_ros.control.controller import NO_HOLD
from fourbar_ros.control.law import SHARED_OUT
from fourbar_ros.mechanism import assemble, kinetic_energy, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.plant import InitialState
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Drive = Callable[..., Any]

PERIOD = 4e-3
PERIOD_NS = 4_000_000
NONE = np.zeros(4)
QUIET = np.zeros(2)


def quarter_turn(driven: Any) -> None:
    driven.controller.setpoint(
        ['link_a', 'link_b'], [driven.angles[0] + pi / 2, driven.angles[1] + pi / 2])


def stronger(mechanism: Mechanism) -> Mechanism:
    """Give a linkage motors that bear fast moves."""
    return replace(mechanism, motor_torque_limits=np.full(4, 1e-2),
                   motor_speed_limits=np.full(4, 5e4))


# Arming

def test_until_armed_it_follows_the_estimate_without_torque(paper: Mechanism) -> None:
    controller = Controller(paper, ControllerSettings())
    for n in range(5):
        angles = assemble(paper, 0.1 * n, 1.0 + 0.2 * n)
        rates = np.array([0.1, 0.2, 0.1, 0.2])
        control = controller.tick(10 ** 9 + n * 4_000_000, angles, rates, QUIET, NONE, NONE)
        assert controller.mode == 'disarmed'
        assert not control.torques.any()
        assert not control.angle_errors.any()
        assert not control.reference_rates.any()
        np.testing.assert_array_equal(control.reference_angles, angles)


def test_armed_it_holds_where_the_links_were(paper: Mechanism) -> None:
    controller = Controller(paper, ControllerSettings())
    held = assemble(paper, 0.0, 1.0)
    controller.tick(10 ** 9, assemble(paper, -1.0, 1.0), NONE, QUIET, NONE, NONE)
    controller.device_armed(True)
    controller.tick(10 ** 9 + PERIOD_NS, held, NONE, QUIET, NONE, NONE)
    moved = assemble(paper, 0.1, 1.0)
    control = controller.tick(10 ** 9 + 2 * PERIOD_NS, moved, NONE, QUIET, NONE, NONE)
    assert controller.mode == 'hold'
    # Opposite links exactly parallel: their mean, but for rounding.
    np.testing.assert_allclose(control.reference_angles, held, atol=1e-15)
    np.testing.assert_allclose(control.angle_errors, held - moved, atol=1e-15)
    # The links shall turn back, so the wheels must turn on: their torque on the link is opposite.
    assert control.torques[0] > 0.0


def test_setpoint_is_refused_while_disarmed(drive: Drive) -> None:
    driven = drive(armed=False)
    for ticks in range(3):
        with pytest.raises(SetpointError, match='not armed'):
            quarter_turn(driven)
        assert driven.controller.refused == ticks + 1
        driven.tick()
    driven.controller.device_armed(True)
    with pytest.raises(SetpointError, match='not armed'):
        quarter_turn(driven)
    driven.tick()
    quarter_turn(driven)
    assert driven.controller.accepted == 1


def test_disarming_drops_the_goal(drive: Drive) -> None:
    driven = drive()
    quarter_turn(driven)
    for _ in range(500):
        driven.tick()
    assert driven.controller.mode == 'track'
    driven.controller.device_armed(False)
    with pytest.raises(SetpointError, match='not armed'):
        quarter_turn(driven)
    angles = driven.angles.copy()
    control = driven.tick()
    assert (driven.controller.mode, driven.controller.goal) == ('disarmed', None)
    assert not control.torques.any()
    np.testing.assert_array_equal(control.reference_angles, angles)
    driven.controller.device_armed(True)
    for _ in range(100):
        control = driven.tick()
    assert driven.controller.mode == 'hold'
    np.testing.assert_array_equal(control.reference_angles, angles)


# Moving

def test_move_ends_at_its_goal_in_time_and_keeps_it(drive: Drive, uneven: Mechanism) -> None:
    driven = drive(stronger(uneven), 0.2, 1.5, setpoint_duration=2.0)
    quarter_turn(driven)
    goal = driven.controller.goal.copy()
    for _ in range(499):
        driven.tick()
    assert driven.controller.mode == 'track'
    control = driven.tick()
    assert driven.controller.mode == 'hold'
    np.testing.assert_allclose(control.reference_angles, goal, atol=1e-9)
    np.testing.assert_array_equal(driven.controller.goal, goal)
    assert not control.reference_rates.any()


def test_reference_rates_are_the_derivative_on_all_four_links(
    drive: Drive, uneven: Mechanism,
) -> None:
    driven = drive(stronger(uneven), 0.2, 1.5, setpoint_duration=2.0)
    driven.controller.setpoint(['link_b'], [1.9])
    controls = [driven.tick() for _ in range(490)]
    angles = np.array([control.reference_angles for control in controls])
    rates = np.array([control.reference_rates for control in controls])
    slopes = (angles[2:] - angles[:-2]) / (2.0 * PERIOD)
    # Third derivatives up to 60 * 0.4 rad / (2 s)^3 * Gamma of 2, times (4 ms)^2 / 6.
    np.testing.assert_allclose(slopes, rates[1:-1], atol=2 * 60 * 0.4 / 8 * PERIOD ** 2 / 6 * 2)


@pytest.mark.parametrize('after', [1, 300, 1250, 2400])
def test_replanning_takes_over_angle_rate_and_acceleration(after: int, drive: Drive) -> None:
    """Up to the new setpoint and one tick beyond, the reference barely differs from the old."""
    old, new = drive(), drive()
    for driven in (old, new):
        quarter_turn(driven)
    for _ in range(after):
        last_old, last_new = old.tick(), new.tick()
    np.testing.assert_array_equal(last_old.reference_angles, last_new.reference_angles)
    new.controller.setpoint(['link_a', 'link_b'], [-0.5, pi / 3 - 0.5])
    next_old, next_new = old.tick(), new.tick()
    # Only the third derivative may jump: quintics of at most 3 rad over 10 s, jerk below
    # 60 * 3 * (rise + rate T + acceleration T^2, 6 rad) / T^3.
    jerk = 60.0 * 3.0 * 6.0 / 10.0 ** 3
    assert np.abs(next_new.reference_angles - next_old.reference_angles
                  ).max() < jerk * PERIOD ** 3 / 6.0 + 1e-14
    assert np.abs(next_new.reference_rates - next_old.reference_rates
                  ).max() < jerk * PERIOD ** 2 / 2.0 + 1e-14
    assert np.abs(next_new.reference_rates - last_new.reference_rates
                  - (next_old.reference_rates - last_old.reference_rates)
                  ).max() / PERIOD < jerk * PERIOD + 1e-11
    for _ in range(2500):
        control = new.tick()
    np.testing.assert_allclose(control.reference_angles[:2], [-0.5, pi / 3 - 0.5], atol=1e-12)


def test_refused_setpoint_does_not_disturb_the_move(drive: Drive) -> None:
    alone, bothered = drive(), drive()
    for driven in (alone, bothered):
        quarter_turn(driven)
    for n in range(1000):
        if n % 100 == 50:
            with pytest.raises(SetpointError):
                bothered.controller.setpoint(['link_b'], [0.0])
        assert (alone.tick().reference_angles.tobytes()
                == bothered.tick().reference_angles.tobytes())


@pytest.mark.parametrize(('offset_s', 'accepted'), [
    (0.0, True), (-0.9, True), (0.9, True), (-1.1, False), (1.1, False), (-1e9, False)])
def test_setpoint_with_a_foreign_stamp_is_refused(
    offset_s: float, accepted: bool, drive: Drive,
) -> None:
    driven = drive()
    stamp = driven.stamp_ns + round(offset_s * 1e9)
    if accepted:
        driven.controller.setpoint(['link_a'], [0.1], stamp)
    else:
        with pytest.raises(SetpointError, match=f'{-offset_s:.3f} s before the last tick'):
            driven.controller.setpoint(['link_a'], [0.1], stamp)


# Torques

def pushed(mechanism: Mechanism, angles: Array, rates: Array) -> tuple[Controller, Array]:
    """Return the torques of a controller that holds, after the links were pushed away."""
    controller = Controller(mechanism, ControllerSettings())
    controller.device_armed(True)
    controller.tick(10 ** 9, assemble(mechanism, 0.0, 1.0), NONE, QUIET, NONE, NONE)
    control = controller.tick(10 ** 9 + 4_000_000, angles, rates, QUIET, NONE, NONE)
    return controller, control.torques


def test_at_its_goal_it_asks_for_nothing(paper: Mechanism) -> None:
    controller, torques = pushed(paper, assemble(paper, 0.0, 1.0), NONE)
    # Rounding of an angle of 1 rad, times bandwidth^2 and A of 1.44e-4 kg m^2.
    assert np.abs(torques).max() < 2.2e-16 * 16.0 * 1.44e-4
    assert controller.saturated == 0


def test_saturation_scales_all_wheels_together(uneven: Mechanism) -> None:
    angles, rates = assemble(uneven, 0.5, 1.2), np.array([0.3, -0.2, 0.0, 0.0])
    limits = np.array([2e-5, 3e-6, 1e-5, 5e-5])
    free, wanted = pushed(replace(uneven, motor_torque_limits=np.full(4, np.inf)), angles, rates)
    limited, torques = pushed(replace(uneven, motor_torque_limits=limits), angles, rates)
    limits *= SHARED_OUT
    excess = (np.abs(wanted) / limits).max()
    assert excess > 1.5
    np.testing.assert_allclose(torques, wanted / excess, rtol=1e-14)
    assert (np.abs(torques) / limits).max() == pytest.approx(1.0, rel=1e-14)
    assert (free.saturated, limited.saturated) == (0, 1)


def near_change_point(name: str) -> tuple[Mechanism, Array]:
    """Make a linkage, not on a parallelogram's branch, whose links c and d are almost in line."""
    same: Any = [0.02] * 4, [2.2e-5] * 4, [[0.05, 0.0]] * 4, [3.4e-7] * 4, [1e-2] * 4, [500.0] * 4
    if name == 'antiparallelogram':
        mechanism = Mechanism([0.12, 0.08, 0.12, 0.08], *same)  # type: ignore[arg-type]
        return mechanism, assemble(mechanism, 0.2, 0.2 + pi - 0.03, 'crossed')
    mechanism = Mechanism([0.12, 0.10, 0.09, 0.10], *same)  # type: ignore[arg-type]
    # Links a and b span almost as much as c and d together.
    gap, (a, b) = 0.19 - 1e-5, mechanism.link_lengths[:2]
    theta = np.arccos((a * a + b * b - gap * gap) / (2.0 * a * b))
    return mechanism, assemble(mechanism, 0.2, 0.2 + theta)


@pytest.mark.parametrize('name', ['antiparallelogram', 'unequal'])
def test_at_a_change_point_off_the_parallelogram_the_wheels_coast(name: str) -> None:
    mechanism, angles = near_change_point(name)
    assert abs(np.sin(angles[3] - angles[2])) < NO_HOLD
    controller = Controller(mechanism, ControllerSettings())
    controller.device_armed(True)
    for tick in range(3):
        control = controller.tick(10 ** 9 + tick * PERIOD_NS, angles + 0.01 * tick, NONE, QUIET,
                                  NONE, NONE)
        assert not control.torques.any()
        assert not control.command.values.any()
        assert not control.command.by_speed


@pytest.mark.parametrize('command', ['effort', 'velocity'])
@pytest.mark.parametrize('theta', [0.0, 1e-3, -0.02, pi, pi - 0.03])
def test_at_a_change_point_of_the_parallelogram_it_holds(
    theta: float, command: str, steer: Drive, paper: Mechanism,
) -> None:
    """Pushed off its branch by a step of the reference, the linkage comes back and stays."""
    steered = steer(paper, InitialState(0.1, 0.1 + theta + 0.05), armed=False, command=command,
                    change_points='keep')
    steered.controller.device_armed(True)
    steered.tick()
    steered.controller.setpoint(['link_a', 'link_b'], [0.1, 0.1 + theta])
    steered.ticks(round((10.0 + 3.0) / PERIOD))
    truth = steered.plant.truth()
    # Three seconds are more than ten time constants of the law.
    assert np.abs(wrap_angles(truth.link_angles - np.array([0.1, 0.1 + theta] * 2))).max() < 1e-4
    assert np.abs(truth.link_rates).max() < 1e-4
    assert not steered.controller.wheels.findings()


# Accounts

def test_energy_and_the_two_accounts_of_effort(drive: Drive, paper: Mechanism) -> None:
    """Constant speeds and torques for a second: sums become products."""
    controller = Controller(paper, ControllerSettings())
    angles = assemble(paper, 0.0, 1.0)
    rates, speeds = np.array([0.5, 0.0, 0.5, 0.0]), np.array([20.0, -30.0, 40.0, 0.0])
    efforts = np.array([1e-5, 1e-5, -2e-5, 3e-5])
    controller.device_armed(True)
    for n in range(251):
        control = controller.tick(10 ** 9 + n * 4_000_000, angles, rates, QUIET, speeds, efforts)
    absolute = speeds + rates
    assert control.energies[FLYWHEEL_ENERGY] == pytest.approx(
        kinetic_energy(paper, angles, NONE, absolute), rel=1e-12)
    assert control.energies[COPPER] == 0.0
    assert control.energies[EQ9] == pytest.approx(3.4e-7 * float(absolute @ absolute), rel=1e-12)
    assert control.energies[WORK] == pytest.approx(
        1e-5 * 20.0 + 1e-5 * 30.0 + 2e-5 * 40.0, rel=1e-12)
    controller.device_armed(False)
    controller.tick(2 * 10 ** 9 + PERIOD_NS, angles, rates, QUIET, speeds, efforts)
    controller.device_armed(True)
    control = controller.tick(2 * 10 ** 9 + 2 * PERIOD_NS, angles, rates, QUIET, speeds, NONE)
    assert control.energies[WORK] == 0.0


def test_copper_loss_is_resistance_times_current_squared(prototype: Mechanism) -> None:
    """For a second, with what the file says: 0.03 N m/A and 1 ohm."""
    controller = Controller(prototype, ControllerSettings())
    angles = assemble(prototype, 0.0, 1.0)
    controller.device_armed(True)
    for n in range(251):
        control = controller.tick(10 ** 9 + n * PERIOD_NS, angles, NONE, QUIET, NONE,
                                  np.array([3e-3, 0.0, -6e-3, 0.0]))
    assert control.energies[COPPER] == pytest.approx(0.1 ** 2 + 0.2 ** 2, rel=1e-12)
