# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The controller: arming, moves, torques, costs, modes, commands, gains, refusals."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from math import pi
from typing import Any

from fourbar_ros.common.settings import SettingError
from fourbar_ros.control import (
    Control,
    Controller,
    ControllerSettings,
    GainError,
    Point,
    SetpointError,
)
from fourbar_ros.control.actuation_cost_sums import COPPER, EQ9, FLYWHEEL_ENERGY, WORK
from fourbar_ros.control.allocation import ALLOCATIONS
from fourbar_ros.control.controller import SLOWER_TICKS
from fourbar_ros.control.reference_generator import STOPPING_TIME
from fourbar_ros.control.tracking_law import MOTOR_SHARE
from fourbar_ros.mechanism import assemble, FLYWHEEL_NAMES, kinetic_energy, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.change_points import TORQUE_CUTOFF
from fourbar_ros.plant import InitialState
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Drive = Callable[..., Any]
Refuses = Callable[..., AbstractContextManager[None]]

PERIOD = 4e-3
PERIOD_NS = 4_000_000
NONE = np.zeros(4)
QUIET = np.zeros(2)


def quarter_turn(driven: Any) -> None:
    driven.controller.setpoint(
        ['link_a', 'link_b'], [driven.angles[0] + pi / 2, driven.angles[1] + pi / 2])


def stronger(mechanism: Mechanism) -> Mechanism:
    """Return a linkage with motors for fast moves."""
    return replace(mechanism, motor_torque_limits=np.full(4, 1e-2),
                   motor_speed_limits=np.full(4, 5e4))


# Arming

def test_disarmed_controller_follows_the_estimate_without_torque(paper: Mechanism) -> None:
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


def test_armed_controller_holds_the_present_angles(paper: Mechanism) -> None:
    controller = Controller(paper, ControllerSettings())
    held = assemble(paper, 0.0, 1.0)
    controller.tick(10 ** 9, assemble(paper, -1.0, 1.0), NONE, QUIET, NONE, NONE)
    controller.device_armed(True)
    controller.tick(10 ** 9 + PERIOD_NS, held, NONE, QUIET, NONE, NONE)
    moved = assemble(paper, 0.1, 1.0)
    control = controller.tick(10 ** 9 + 2 * PERIOD_NS, moved, NONE, QUIET, NONE, NONE)
    assert controller.mode == 'hold'
    # The reference of opposite links is their mean, within rounding.
    np.testing.assert_allclose(control.reference_angles, held, atol=1e-15)
    np.testing.assert_allclose(control.angle_errors, held - moved, atol=1e-15)
    # The torque on a link is opposite to that on its wheel.
    assert control.torques[0] > 0.0


def test_setpoint_is_refused_while_disarmed(drive: Drive, refuses: Refuses) -> None:
    driven = drive(armed=False)
    for ticks in range(3):
        with refuses(SetpointError, name='armed'):
            quarter_turn(driven)
        assert driven.controller.refused == ticks + 1
        driven.tick()
    driven.controller.device_armed(True)
    with refuses(SetpointError, name='armed'):
        quarter_turn(driven)
    driven.tick()
    quarter_turn(driven)
    assert driven.controller.accepted == 1


def test_disarming_drops_the_goal(drive: Drive, refuses: Refuses) -> None:
    driven = drive()
    quarter_turn(driven)
    for _ in range(500):
        driven.tick()
    assert driven.controller.mode == 'track'
    driven.controller.device_armed(False)
    with refuses(SetpointError, name='armed'):
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

def test_move_ends_at_its_goal_in_time_and_holds_it(drive: Drive, uneven: Mechanism) -> None:
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
    # The third derivative is at most 60 * 0.4 rad / (2 s)^3 * Gamma of 2; times (4 ms)^2 / 6.
    np.testing.assert_allclose(slopes, rates[1:-1], atol=2 * 60 * 0.4 / 8 * PERIOD ** 2 / 6 * 2)


@pytest.mark.medium
@pytest.mark.parametrize('after', [1, 300, 1250, 2400])
def test_replanning_takes_over_angle_rate_and_acceleration(after: int, drive: Drive) -> None:
    """One tick after the new setpoint the reference hardly differs from the old one."""
    old, new = drive(), drive()
    for driven in (old, new):
        quarter_turn(driven)
    for _ in range(after):
        last_old, last_new = old.tick(), new.tick()
    np.testing.assert_array_equal(last_old.reference_angles, last_new.reference_angles)
    new.controller.setpoint(['link_a', 'link_b'], [-0.5, pi / 3 - 0.5])
    next_old, next_new = old.tick(), new.tick()
    # Only the third derivative jumps. The quintics have at most 3 rad in 10 s and a jerk below
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


@pytest.mark.medium
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
    offset_s: float, accepted: bool, drive: Drive, refuses: Refuses,
) -> None:
    driven = drive()
    stamp = driven.stamp_ns + round(offset_s * 1e9)
    if accepted:
        driven.controller.setpoint(['link_a'], [0.1], stamp)
    else:
        with refuses(SetpointError, name='stamp', value=pytest.approx(-offset_s), limit=1.0):
            driven.controller.setpoint(['link_a'], [0.1], stamp)


# Torques

def pushed(mechanism: Mechanism, angles: Array, rates: Array) -> tuple[Controller, Array]:
    """Return the torques of a holding controller after a displacement of the links."""
    controller = Controller(mechanism, ControllerSettings())
    controller.device_armed(True)
    controller.tick(10 ** 9, assemble(mechanism, 0.0, 1.0), NONE, QUIET, NONE, NONE)
    control = controller.tick(10 ** 9 + 4_000_000, angles, rates, QUIET, NONE, NONE)
    return controller, control.torques


def test_torques_are_zero_at_the_goal(paper: Mechanism) -> None:
    controller, torques = pushed(paper, assemble(paper, 0.0, 1.0), NONE)
    # The tolerance is the rounding of 1 rad, times bandwidth^2 and A of 1.44e-4 kg m^2.
    assert np.abs(torques).max() < 2.2e-16 * 16.0 * 1.44e-4
    assert controller.saturated == 0


def test_saturation_scales_all_wheels_together(uneven: Mechanism) -> None:
    angles, rates = assemble(uneven, 0.5, 1.2), np.array([0.3, -0.2, 0.0, 0.0])
    limits = np.array([2e-5, 3e-6, 1e-5, 5e-5])
    free, wanted = pushed(replace(uneven, motor_torque_limits=np.full(4, np.inf)), angles, rates)
    limited, torques = pushed(replace(uneven, motor_torque_limits=limits), angles, rates)
    limits *= MOTOR_SHARE['effort']
    excess = (np.abs(wanted) / limits).max()
    assert excess > 1.5
    np.testing.assert_allclose(torques, wanted / excess, rtol=1e-14)
    assert (np.abs(torques) / limits).max() == pytest.approx(1.0, rel=1e-14)
    assert (free.saturated, limited.saturated) == (0, 1)


def near_change_point(name: str) -> tuple[Mechanism, Array]:
    """Make a linkage off the parallelogram branch with links c and d almost in line."""
    same: Any = [0.02] * 4, [2.2e-5] * 4, [[0.05, 0.0]] * 4, [3.4e-7] * 4, [1e-2] * 4, [500.0] * 4
    if name == 'antiparallelogram':
        mechanism = Mechanism([0.12, 0.08, 0.12, 0.08], *same)  # type: ignore[arg-type]
        return mechanism, assemble(mechanism, 0.2, 0.2 + pi - 0.03, 'crossed')
    mechanism = Mechanism([0.12, 0.10, 0.09, 0.10], *same)  # type: ignore[arg-type]
    # The distance of joints 2 and 4 is almost the sum of the lengths of c and d.
    gap, (a, b) = 0.19 - 1e-5, mechanism.link_lengths[:2]
    theta = np.arccos((a * a + b * b - gap * gap) / (2.0 * a * b))
    return mechanism, assemble(mechanism, 0.2, 0.2 + theta)


@pytest.mark.parametrize('name', ['antiparallelogram', 'unequal'])
def test_at_a_change_point_off_the_parallelogram_the_wheels_coast(name: str) -> None:
    mechanism, angles = near_change_point(name)
    assert abs(np.sin(angles[3] - angles[2])) < TORQUE_CUTOFF
    controller = Controller(mechanism, ControllerSettings())
    controller.device_armed(True)
    for tick in range(3):
        control = controller.tick(10 ** 9 + tick * PERIOD_NS, angles + 0.01 * tick, NONE, QUIET,
                                  NONE, NONE)
        assert not control.torques.any()
        assert not control.command.values.any()
        assert not control.command.by_speed


@pytest.mark.slow
@pytest.mark.parametrize('command', ['effort', 'velocity'])
@pytest.mark.parametrize('theta', [0.0, 1e-3, -0.02, pi, pi - 0.03])
def test_controller_holds_at_a_change_point_of_the_parallelogram(
    theta: float, command: str, steer: Drive, paper: Mechanism,
) -> None:
    """After a step of the reference the linkage returns to its branch and stays."""
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
    assert not steered.controller.wheels.faults()


# Actuation cost

def test_energy_and_the_two_sums_of_actuation_cost(drive: Drive, paper: Mechanism) -> None:
    """With constant speeds and torques for a second the sums are products."""
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
    """The motors of the file have 0.03 N m/A and 1 ohm; the duration is a second."""
    controller = Controller(prototype, ControllerSettings())
    angles = assemble(prototype, 0.0, 1.0)
    controller.device_armed(True)
    for n in range(251):
        control = controller.tick(10 ** 9 + n * PERIOD_NS, angles, NONE, QUIET, NONE,
                                  np.array([3e-3, 0.0, -6e-3, 0.0]))
    assert control.energies[COPPER] == pytest.approx(0.1 ** 2 + 0.2 ** 2, rel=1e-12)


# Modes

@pytest.fixture
def moving(steer: Drive, prototype: Mechanism) -> Any:
    """Return the bench-scale linkage in the middle of a move."""
    steered = steer(prototype, setpoint_duration=4.0)
    steered.controller.setpoint(['link_a', 'link_b'], [0.8, pi / 3 + 0.5])
    steered.ticks(500)
    assert steered.controller.mode == 'track'
    return steered


def settle(steered: Any, seconds: float = 4.0) -> None:
    """Advance by more than ten time constants of the law."""
    steered.ticks(round(seconds / PERIOD))


def rates_of(steered: Any) -> Array:
    rates: Array = steered.plant.truth().link_rates
    return rates


def test_idle_controller_gives_no_torque(moving: Any) -> None:
    moving.controller.enable(False)
    assert moving.controller.mode == 'track'
    controls = moving.ticks(50)
    assert moving.controller.mode == 'idle'
    for control in controls:
        assert not control.torques.any()
        assert not control.command.values.any()
        assert not control.command.by_speed
        assert control.command.powered.all()
        assert not control.angle_errors.any()
    assert moving.controller.goal is None
    # The linkage drifts without a driving or a braking torque.
    assert np.abs(rates_of(moving)).min() > 0.1


@pytest.mark.parametrize('act', ['setpoint', 'trajectory', 'hold', 'damp'])
@pytest.mark.parametrize(('state', 'reason'), [
    ('disarmed', 'armed'), ('idle', 'enabled')])
def test_requests_are_refused_while_disarmed_or_idle(
    act: str, state: str, reason: str, steer: Drive, prototype: Mechanism,
) -> None:
    steered = steer(prototype, armed=state != 'disarmed')
    controller = steered.controller
    controller.enable(state != 'idle')
    steered.tick()
    assert controller.mode == state
    doing: dict[str, Callable[[], None]] = {
        'setpoint': lambda: controller.setpoint(['link_a'], [0.1]),
        'trajectory': lambda: controller.trajectory(['link_a'], [Point([0.1], 5.0)]),
        'hold': controller.hold, 'damp': controller.damp}
    with pytest.raises(SetpointError) as caught:
        doing[act]()
    assert caught.value.values['name'] == reason
    counted = act in ('setpoint', 'trajectory')
    assert (controller.accepted, controller.refused) == (0, int(counted))
    assert controller.last_refusal == (str(caught.value) if counted else '')
    steered.tick()
    assert (controller.mode, controller.goal) == (state, None)


def test_controller_enabled_again_stops_moving_links_and_holds(moving: Any) -> None:
    controller = moving.controller
    controller.enable(False)
    moving.ticks(50)
    before = rates_of(moving)
    controller.enable(True)
    first = moving.tick()
    assert controller.mode == 'hold'
    # The reference begins with the angles and rates of the links. A stop from 0.5 rad/s within a
    # second changes the rates in a period by at most 60 * 0.5 T^2 / 2.
    np.testing.assert_allclose(first.reference_rates, before, atol=15.0 * PERIOD ** 2)
    np.testing.assert_allclose(first.angle_errors, 0.0, atol=1e-3)
    settle(moving)
    assert np.abs(rates_of(moving)).max() < 1e-4
    assert controller.mode == 'hold'


def test_hold_ends_the_move_and_stays(moving: Any) -> None:
    controller = moving.controller
    controller.hold()
    assert (controller.mode, controller.goal) == ('hold', None)
    moving.ticks(round(STOPPING_TIME / PERIOD) + 1)
    held = moving.tick().reference_angles
    settle(moving)
    np.testing.assert_array_equal(moving.tick().reference_angles, held)
    np.testing.assert_allclose(moving.plant.truth().link_angles, held, atol=1e-4)
    # The reference is not at the goal of the move.
    assert np.abs(held[:2] - [0.8, pi / 3 + 0.5]).max() > 0.05


def test_damp_stops_all_rates_at_any_angles(moving: Any) -> None:
    controller = moving.controller
    controller.damp()
    assert (controller.mode, controller.goal) == ('damp', None)
    last = rates_of(moving)
    for _ in range(round(3.0 / PERIOD)):
        control = moving.tick()
        assert not control.angle_errors.any()
        assert not control.reference_rates.any()
        rates = rates_of(moving)
        # A is constant for a rhombus, so every rate decays independently at 2 * 0.9 * 4 /s.
        assert (np.abs(rates) <= np.abs(last) + 1e-6).all()
        last = rates
    assert controller.mode == 'damp'
    assert np.abs(last).max() < 1e-4


STEPS: dict[str, Callable[[Any], None]] = {
    'enable': lambda steered: steered.controller.enable(True),
    'disable': lambda steered: steered.controller.enable(False),
    'hold': lambda steered: steered.controller.hold(),
    'damp': lambda steered: steered.controller.damp(),
    'track': lambda steered: steered.controller.setpoint(
        ['link_a', 'link_b'], [0.5, pi / 3 + 0.3])}


@pytest.mark.slow
@pytest.mark.parametrize('command', ['effort', 'velocity'])
@pytest.mark.parametrize('second', [*STEPS])
@pytest.mark.parametrize('first', [*STEPS])
def test_change_of_mode_causes_no_large_torque_step(
    first: str, second: str, command: str, steer: Drive, prototype: Mechanism, refuses: Refuses,
) -> None:
    """
    Steps of the torque are at most those of braking moving links, and the torque ends.

    Links turn at 0.5 rad/s at most, A is below 0.05 kg m^2, the damping is 7.2 /s, and two wheels
    share the torque. A reference at rest may be 0.05 rad away, and the plan may accelerate at
    1 rad/s^2.
    """
    steered = steer(prototype, setpoint_duration=4.0, command=command)
    STEPS['track'](steered)
    steered.ticks(400)
    most = 0.5 * 0.05 * (7.2 * 0.5 + 16.0 * 0.05 + 1.0)
    torques = [steered.tick().torques]
    for step in (first, second):
        allowed = steered.controller.mode != 'idle' or step in ('enable', 'disable')
        if allowed:
            STEPS[step](steered)
        else:
            with refuses(SetpointError, name='enabled'):
                STEPS[step](steered)
        torques += [control.torques for control in steered.ticks(60)]
    assert np.abs(np.diff(torques, axis=0)).max() < most
    steered.controller.enable(True)
    steered.tick()
    steered.controller.hold()
    settle(steered, 5.0)
    assert steered.controller.mode == 'hold'
    assert np.abs(rates_of(steered)).max() < 1e-3
    assert not steered.controller.wheels.faults()
    assert steered.controller.problem == ''


@pytest.mark.medium
@pytest.mark.parametrize('act', ['setpoint', 'trajectory'])
def test_setpoint_while_damping_starts_from_the_moving_links(act: str, moving: Any) -> None:
    controller = moving.controller
    controller.damp()
    before = moving.ticks(5)[-1]
    rates, angles = rates_of(moving), moving.plant.truth().link_angles
    assert np.abs(rates).max() > 0.1
    # The last tick before the setpoint is a period ago.
    seen = controller.rates.copy()
    goal = [0.8, pi / 3 + 0.5]
    if act == 'setpoint':
        controller.setpoint(['link_a', 'link_b'], goal)
    else:
        controller.trajectory(['link_a', 'link_b'], [Point(goal, 4.0)])
    assert controller.mode == 'track'
    control = moving.tick()
    assert not before.reference_rates.any()
    # In one period the rate of the quintic changes by at most its largest acceleration times T.
    np.testing.assert_allclose(control.reference_rates, seen, atol=PERIOD * 1.0)
    np.testing.assert_allclose(control.reference_angles, angles, atol=PERIOD * 0.5 * PERIOD + 2e-4)
    settle(moving, 6.0)
    np.testing.assert_allclose(moving.plant.truth().link_angles[:2], goal, atol=1e-4)


@pytest.mark.parametrize('act', ['setpoint', 'trajectory'])
def test_refusal_while_damping_has_no_effect(act: str, steer: Drive, prototype: Mechanism
                                             ) -> None:
    """The next commands equal those of a controller without the refused request."""
    alone, bothered = (steer(prototype, setpoint_duration=4.0) for _ in range(2))
    for steered in (alone, bothered):
        STEPS['track'](steered)
        steered.ticks(400)
        steered.controller.damp()
        steered.ticks(3)
    controller = bothered.controller
    with pytest.raises(SetpointError):
        if act == 'setpoint':
            controller.setpoint(['link_b'], [0.0])
        else:
            controller.trajectory(['link_b'], [Point([0.0], 4.0)])
    assert (controller.mode, controller.goal, controller.refused) == ('damp', None, 1)
    for first, second in zip(alone.ticks(20), bothered.ticks(20)):
        np.testing.assert_array_equal(first.command.values, second.command.values)
        np.testing.assert_array_equal(first.reference_angles, second.reference_angles)


def test_repeated_tick_has_the_same_answer(moving: Any) -> None:
    """Lock-step repeats a tick after a lost answer, perhaps with other numbers."""
    control = moving.tick()
    saturated, drift = moving.controller.saturated, moving.controller.momentum.drift.copy()
    truth = moving.plant.truth()
    for _ in range(3):
        assert moving.controller.tick(
            moving.stamp_ns, truth.link_angles, truth.link_rates, QUIET, truth.wheel_speeds,
            truth.efforts) is control
    assert moving.controller.saturated == saturated
    np.testing.assert_array_equal(moving.controller.momentum.drift, drift)
    assert moving.tick() is not control


def test_answers_are_not_overwritten(moving: Any) -> None:
    """The result of a tick does not change at later ticks."""
    control = moving.tick()
    kept = {name: np.array(getattr(control, name)) for name in (
        'torques', 'reference_angles', 'reference_rates', 'angle_errors', 'rate_errors',
        'energies')}
    values = control.command.values.copy()
    moving.ticks(20)
    for name, before in kept.items():
        np.testing.assert_array_equal(getattr(control, name), before, err_msg=name)
    np.testing.assert_array_equal(control.command.values, values)


# Commands

def test_speed_commands_move_the_links_as_torque_commands_do(steer: Drive,
                                                             prototype: Mechanism) -> None:
    """The final angles agree for both kinds of command."""
    ends = []
    for command in ('effort', 'velocity'):
        steered = steer(prototype, setpoint_duration=2.0, command=command)
        steered.controller.setpoint(['link_a', 'link_b'], [0.3, pi / 3 + 0.2])
        controls = steered.ticks(750)
        assert all(control.command.by_speed == (command == 'velocity') for control in controls)
        ends.append(steered.plant.truth().link_angles)
        np.testing.assert_allclose(ends[-1][:2], [0.3, pi / 3 + 0.2], atol=1e-4)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-4)


def test_command_can_be_changed_during_a_move(moving: Any) -> None:
    """Changes from torques to speeds and back are bumpless."""
    controller, settings = moving.controller, moving.controller.settings
    errors = []
    for command in ('velocity', 'effort'):
        controller.tune(replace(settings, command=command))
        errors += [control.angle_errors for control in moving.ticks(100)]
        assert controller.mode == 'track'
    # Without a change the error is below 2e-3 rad, due to the motor lag and the delay of a tick.
    assert np.abs(errors).max() < 4e-3
    assert not controller.wheels.faults()


# Gains and rates

UNSTABLE = {'bandwidth': 20.0, 'damping': 2.0}


def test_unstable_gains_at_the_present_rate_are_refused(
    drive: Drive, refuses: Refuses,
) -> None:
    """The stamps have 50 Hz; a refusal has no effect."""
    driven = drive(armed=False)
    controller = driven.controller
    before = controller.settings
    for tick in range(3):
        controller.tick(10 ** 10 + tick * 20_000_000, driven.angles, NONE, QUIET, NONE, NONE)
    with refuses(GainError, name='bandwidth', value=20.0, rate_hz=pytest.approx(50.0)):
        controller.tune(replace(before, **UNSTABLE))
    assert controller.settings is before
    controller.tune(replace(before, bandwidth=3.0))
    assert controller.settings.bandwidth == 3.0


def test_unknown_allocation_is_refused_and_has_no_effect(
    drive: Drive, refuses: Refuses,
) -> None:
    controller = drive().controller
    before = controller.settings
    with refuses(SettingError, name='allocation', value='least', limit=ALLOCATIONS):
        controller.tune(replace(before, allocation='least'))
    assert controller.settings is before


def test_controller_is_idle_with_gains_too_fast_for_the_rate(
    paper: Mechanism, refuses: Refuses,
) -> None:
    """The rate is known after two ticks; then the controller idles until the gains are changed."""
    settings = ControllerSettings(**UNSTABLE)  # type: ignore[arg-type]
    controller = Controller(paper, settings)
    controller.device_armed(True)
    angles, stamp = assemble(paper, 0.0, 1.0), 10 ** 9

    def tick() -> Control:
        nonlocal stamp
        stamp += 20_000_000
        return controller.tick(stamp, angles + 0.01, NONE, QUIET, NONE, NONE)
    controls = [tick() for _ in range(4)]
    assert controller.mode == 'idle'
    assert 'bandwidth 20 rad/s' in controller.problem
    assert '50 Hz' in controller.problem
    assert not controls[-1].torques.any()
    with refuses(SetpointError, name='idle'):
        controller.setpoint(['link_a'], [0.1])
    assert controller.last_refusal == controller.problem
    controller.tune(replace(settings, bandwidth=3.0))
    tick()
    assert (controller.mode, controller.problem) == ('hold', '')
    controller.setpoint(['link_a'], [0.1])
    assert controller.mode == 'track'


def test_controller_becomes_idle_when_the_rate_falls(paper: Mechanism) -> None:
    """The gains are stable at 250 Hz and unstable at 50 Hz."""
    settings = ControllerSettings(**UNSTABLE)  # type: ignore[arg-type]
    controller = Controller(paper, settings)
    controller.device_armed(True)
    angles, stamp = assemble(paper, 0.0, 1.0), 10 ** 9
    for _ in range(5):
        stamp += PERIOD_NS
        controller.tick(stamp, angles, NONE, QUIET, NONE, NONE)
    assert controller.mode == 'hold'
    # One or two lost ticks do not change the rate.
    for lost in (2, 3):
        stamp += lost * PERIOD_NS
        controller.tick(stamp, angles, NONE, QUIET, NONE, NONE)
        assert controller.mode == 'hold'
    for _ in range(2):
        stamp += 22_000_000
        controller.tick(stamp, angles, NONE, QUIET, NONE, NONE)
    assert controller.mode == 'idle'
    assert '45.45 Hz' in controller.problem
    stamp += PERIOD_NS
    controller.tick(stamp, angles, NONE, QUIET, NONE, NONE)
    assert (controller.mode, controller.problem) == ('hold', '')


@pytest.mark.parametrize('times', [5, 13])
def test_rate_that_falls_to_a_whole_fraction_is_detected(times: int, paper: Mechanism) -> None:
    """Detection takes several ticks, since single gaps may be lost ticks."""
    settings = ControllerSettings(**UNSTABLE)  # type: ignore[arg-type]
    controller = Controller(paper, settings)
    controller.device_armed(True)
    angles, stamp = assemble(paper, 0.0, 1.0), 10 ** 9

    def tick(periods: int) -> str:
        nonlocal stamp
        stamp += periods * PERIOD_NS
        controller.tick(stamp, angles, NONE, QUIET, NONE, NONE)
        return controller.mode
    for _ in range(3):
        tick(1)
    for _ in range(50):
        assert tick(1) == tick(times) == 'hold'
    modes = [tick(times) for _ in range(SLOWER_TICKS)]
    assert modes == ['hold'] * (SLOWER_TICKS - 2) + ['idle'] * 2
    assert f'{250.0 / times:.4g} Hz' in controller.problem


# Setpoints and trajectories

def test_demand_beyond_the_limits_is_refused_with_the_shortest_duration(drive: Drive) -> None:
    driven = drive(setpoint_duration=1.0)
    with pytest.raises(SetpointError) as caught:
        quarter_turn(driven)
    assert caught.value.values['value'] > caught.value.values['limit']
    assert caught.value.values['name'] in FLYWHEEL_NAMES
    controller = driven.controller
    assert (controller.accepted, controller.refused) == (0, 1)
    assert controller.last_refusal == str(caught.value)
    shortest = caught.value.values['duration']
    controller.tune(replace(controller.settings, setpoint_duration=shortest))
    quarter_turn(driven)
    assert controller.accepted == 1


@pytest.mark.parametrize('linkage', ['paper', 'prototype'])
def test_shortest_timing_has_the_shortest_feasible_duration(
    linkage: str, steer: Drive, request: pytest.FixtureRequest,
) -> None:
    """The duration of the setting has no effect; a refusal reports the shortest duration."""
    mechanism = request.getfixturevalue(linkage)
    goal = [pi / 2, pi / 3 + pi / 2]
    refused = steer(mechanism, setpoint_duration=1.0)
    with pytest.raises(SetpointError) as caught:
        refused.controller.setpoint(['link_a', 'link_b'], goal)
    shortest = caught.value.values['duration']
    steered = steer(mechanism, setpoint_duration=1.0, setpoint_timing='shortest')
    steered.controller.setpoint(['link_a', 'link_b'], goal)
    errors = []
    while steered.controller.mode == 'track':
        errors.append(steered.tick().angle_errors)
    # The message rounds the duration up to 0.01 s, and the move ends at the next tick.
    assert shortest - 0.01 - PERIOD <= len(errors) * PERIOD <= shortest + PERIOD
    # The error is the delay (motor lag of 3 ms and half a tick) times the acceleration of at most
    # 7 rad/s^2, over the stiffness of the law.
    assert np.abs(errors).max() < 3e-3
    settle(steered)
    np.testing.assert_allclose(steered.plant.truth().link_angles[:2], goal, atol=1e-5)


@pytest.mark.medium
def test_trajectory_passes_its_points_in_time(drive: Drive) -> None:
    driven = drive()
    points = [Point([0.1, pi / 3 + 0.05], 4.0), Point([0.1, pi / 3 - 0.05], 8.0),
              Point([0.3, pi / 3], 14.0)]
    driven.controller.trajectory(['link_a', 'link_b'], points)
    assert (driven.controller.mode, driven.controller.accepted) == ('track', 1)
    np.testing.assert_allclose(driven.controller.goal[:2], [0.3, pi / 3])
    for point, seconds in zip(points, (4.0, 4.0, 6.0)):
        for _ in range(round(seconds / PERIOD)):
            control = driven.tick()
        np.testing.assert_allclose(control.reference_angles[:2], point.positions, atol=1e-9)
    assert driven.controller.mode == 'hold'
    assert driven.controller.saturated == 0


@pytest.mark.parametrize(('names', 'points', 'values'), [
    ([], [Point([], 5.0)], {'kind': 'length'}),
    (['link_a'], [], {'name': 'points'}),
    (['link_x'], [Point([0.1], 5.0)], {'kind': 'names'}),
    (['link_a'], [Point([float('nan')], 5.0)], {'point': 1, 'name': 'position'}),
    (['link_a'], [Point([0.1], 5.0, effort=[1.0])], {'point': 1, 'name': 'effort'}),
    (['link_a'], [Point([0.1], 5.0), Point([0.2], 4.0)], {'point': 2, 'name': 'time'}),
    (['link_a', 'link_b'], [Point([pi / 2, pi], 0.5)], {'name': 'flywheel_b'}),
    (['link_b'], [Point([0.0], 10.0)], {'name': 'change_point'})])
def test_trajectory_is_refused_as_a_whole(
    names: list[str], points: list[Point], values: dict[str, Any], drive: Drive,
) -> None:
    driven = drive()
    with pytest.raises(SetpointError) as caught:
        driven.controller.trajectory(names, points)
    assert values.items() <= caught.value.values.items()
    controller = driven.controller
    assert (controller.accepted, controller.refused, controller.mode) == (0, 1, 'hold')
    assert controller.last_refusal == str(caught.value)
    assert '\n' not in controller.last_refusal
    assert controller.goal is None


@pytest.mark.parametrize('offset_s', [-1.1, 1.1])
def test_trajectory_with_a_foreign_stamp_is_refused(
    offset_s: float, drive: Drive, refuses: Refuses,
) -> None:
    driven = drive()
    with refuses(SetpointError, name='stamp', value=pytest.approx(-offset_s)):
        driven.controller.trajectory(
            ['link_a'], [Point([0.1], 5.0)], driven.stamp_ns + round(offset_s * 1e9))


@pytest.mark.medium
def test_change_points_need_the_setting_keep(drive: Drive, refuses: Refuses) -> None:
    """The goals are beyond theta = 0 and on it."""
    for goal in (-0.3, 0.0):
        avoiding = drive(phi_b=0.3)
        with refuses(SetpointError, name='change_point'):
            avoiding.controller.setpoint(['link_b'], [goal])
        keeping = drive(phi_b=0.3, change_points='keep')
        keeping.controller.setpoint(['link_b'], [goal])
        for _ in range(2501):
            control = keeping.tick()
        np.testing.assert_allclose(control.reference_angles, [0.0, goal, 0.0, goal], atol=1e-9)
        assert keeping.controller.mode == 'hold'


@pytest.mark.parametrize('command', ['effort', 'velocity'])
def test_move_crosses_a_change_point_on_its_branch(
    command: str, steer: Drive, prototype: Mechanism,
) -> None:
    steered = steer(prototype, InitialState(0.1, 0.5), setpoint_duration=3.0, command=command,
                    change_points='keep')
    steered.controller.setpoint(['link_a', 'link_b'], [0.2, -0.3])
    pair_angle = []
    for _ in range(1000):
        steered.tick()
        angles = steered.plant.truth().link_angles
        pair_angle.append(wrap_angles(angles[2:] - angles[:2]))
    assert np.abs(pair_angle).max() < 1e-3
    np.testing.assert_allclose(steered.plant.truth().link_angles[:2], [0.2, -0.3], atol=1e-4)
