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

from fourbar_ros.control import Controller, ControllerSettings, SetpointError
from fourbar_ros.mechanism import assemble, kinetic_energy, Mechanism
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Drive = Callable[..., Any]

PERIOD = 4e-3
NONE = np.zeros(4)


def quarter_turn(driven: Any) -> None:
    driven.controller.setpoint(
        ['link_a', 'link_b'], [driven.angles[0] + pi / 2, driven.angles[1] + pi / 2])


# Arming

def test_until_armed_it_follows_the_estimate_without_torque(paper: Mechanism) -> None:
    controller = Controller(paper, ControllerSettings())
    for n in range(5):
        angles = assemble(paper, 0.1 * n, 1.0 + 0.2 * n)
        rates = np.array([0.1, 0.2, 0.1, 0.2])
        control = controller.tick(10 ** 9 + n * 4_000_000, angles, rates, NONE, NONE)
        assert controller.mode == 'disarmed'
        assert not control.torques.any()
        assert not control.angle_errors.any()
        assert not control.reference_rates.any()
        np.testing.assert_array_equal(control.reference_angles, angles)


def test_armed_it_holds_where_the_links_were(paper: Mechanism) -> None:
    controller = Controller(paper, ControllerSettings())
    held = assemble(paper, 0.0, 1.0)
    controller.tick(10 ** 9, assemble(paper, -1.0, 1.0), NONE, NONE, NONE)
    controller.device_armed(True)
    controller.tick(10 ** 9 + 1, held, NONE, NONE, NONE)
    moved = assemble(paper, 0.1, 1.0)
    control = controller.tick(10 ** 9 + 2, moved, NONE, NONE, NONE)
    assert controller.mode == 'hold'
    np.testing.assert_array_equal(control.reference_angles, held)
    np.testing.assert_allclose(control.angle_errors, held - moved, rtol=1e-15)
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
    driven = drive(uneven, 0.2, 1.5, setpoint_duration=2.0)
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
    driven = drive(uneven, 0.2, 1.5, setpoint_duration=2.0)
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
    controller.tick(10 ** 9, assemble(mechanism, 0.0, 1.0), NONE, NONE, NONE)
    control = controller.tick(10 ** 9 + 4_000_000, angles, rates, NONE, NONE)
    return controller, control.torques


def test_at_its_goal_it_asks_for_nothing(paper: Mechanism) -> None:
    controller, torques = pushed(paper, assemble(paper, 0.0, 1.0), NONE)
    assert not torques.any()
    assert controller.saturated == 0


def test_saturation_scales_all_wheels_together(uneven: Mechanism) -> None:
    angles, rates = assemble(uneven, 0.5, 1.2), np.array([0.3, -0.2, 0.0, 0.0])
    limits = np.array([2e-5, 3e-6, 1e-5, 5e-5])
    free, wanted = pushed(replace(uneven, motor_torque_limits=np.full(4, np.inf)), angles, rates)
    limited, torques = pushed(replace(uneven, motor_torque_limits=limits), angles, rates)
    excess = (np.abs(wanted) / limits).max()
    assert excess > 1.5
    np.testing.assert_allclose(torques, wanted / excess, rtol=1e-14)
    assert (np.abs(torques) / limits).max() == pytest.approx(1.0, rel=1e-14)
    assert (free.saturated, limited.saturated) == (0, 1)


@pytest.mark.parametrize('theta', [1e-3, -0.02, pi, pi - 0.03])
def test_at_a_change_point_the_wheels_coast(theta: float, paper: Mechanism) -> None:
    _, torques = pushed(
        paper, np.array([0.0, theta, 0.0, theta]), np.array([0.1, -0.3, 0.1, -0.3]))
    assert not torques.any()


# Accounts

def test_energy_and_the_two_accounts_of_effort(drive: Drive, paper: Mechanism) -> None:
    """Constant speeds and torques for a second: sums become products."""
    controller = Controller(paper, ControllerSettings())
    angles = assemble(paper, 0.0, 1.0)
    rates, speeds = np.array([0.5, 0.0, 0.5, 0.0]), np.array([20.0, -30.0, 40.0, 0.0])
    efforts = np.array([1e-5, 1e-5, -2e-5, 3e-5])
    controller.device_armed(True)
    for n in range(251):
        control = controller.tick(10 ** 9 + n * 4_000_000, angles, rates, speeds, efforts)
    absolute = speeds + rates
    assert control.flywheel_energy == pytest.approx(
        kinetic_energy(paper, angles, NONE, absolute), rel=1e-12)
    assert control.eq9 == pytest.approx(3.4e-7 * float(absolute @ absolute), rel=1e-12)
    assert control.work == pytest.approx(1e-5 * 20.0 + 1e-5 * 30.0 + 2e-5 * 40.0, rel=1e-12)
    controller.device_armed(False)
    controller.tick(2 * 10 ** 9, angles, rates, speeds, efforts)
    controller.device_armed(True)
    control = controller.tick(2 * 10 ** 9 + 4_000_000, angles, rates, speeds, NONE)
    assert control.work == 0.0
