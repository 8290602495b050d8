# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Demands of a motion on the wheels: agreement with the plant, and errors with the limits."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from math import pi

from fourbar_ros.control.allocation import Allocation, make_allocation, WeightedNorm
from fourbar_ros.control.branch import on_parallelogram, UNPAIRED_AXES
from fourbar_ros.control.feasibility import (
    check_needs,
    LEAST_DURATION,
    loads_along,
    LONGEST_DURATION,
    Needs,
    needs_of,
    Path,
    SHARE,
    shortest_duration,
    Wheels,
)
from fourbar_ros.control.setpoint import angles_along, SetpointError
from fourbar_ros.control.soft_step import SoftStep, TrajectorySegment
from fourbar_ros.control.trajectory import Point, read_trajectory
from fourbar_ros.mechanism import (
    angular_momentum,
    assemble,
    load_mechanism,
    Mechanism,
    reduced_form,
)
from fourbar_ros.mechanism.motors import available_torque, motors_of
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.linalg import null_space

Array = NDArray[np.float64]
Refuses = Callable[..., AbstractContextManager[None]]

IDEAL = Table(LinkSensorSettings(), WheelEncoders(0))
UNLIMITED = np.full(4, np.inf)
STEP = 1e-3
PEAK_RATE = 15.0 / 8.0


@pytest.fixture(scope='module')
def prototype() -> Mechanism:
    return load_mechanism('prototype')


@pytest.fixture(scope='module')
def parallelogram() -> Mechanism:
    """Make a parallelogram whose only equal parameters are opposite lengths."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.12, 0.08], [0.02, 0.03, 0.025, 0.018], [2.2e-5, 1.5e-5, 3e-5, 1.8e-5],
        [[0.05, 0.01], [0.04, -0.01], [0.06, 0.005], [0.05, 0.0]], [3e-7, 4e-7, 5e-7, 2e-7])


def squares(mechanism: Mechanism, *usable: int) -> Allocation:
    """Return the allocation of paper eq. 8 with the usable wheels."""
    return make_allocation('min_norm', mechanism.flywheel_inertias, np.isin(range(4), usable))


def fresh(mechanism: Mechanism, *usable: int, speeds: float | Array = 0.0) -> Wheels:
    return Wheels(np.zeros(4) + speeds, squares(mechanism, *(usable or range(4))))


def step(phi_a: float, phi_b: float, by_a: float, by_b: float, duration: float) -> SoftStep:
    start = np.array([[phi_a, phi_b], [0.0, 0.0], [0.0, 0.0]])
    return SoftStep(start, start[0] + [by_a, by_b], duration)


def quarter_turn(duration: float) -> SoftStep:
    return step(0.0, pi / 3, pi / 2, pi / 2, duration)


def present_at(mechanism: Mechanism, segment: TrajectorySegment) -> Array:
    return assemble(mechanism, *segment.at(0.0)[0])


def loads(mechanism: Mechanism, segment: TrajectorySegment, wheels: Wheels, times: Array
          ) -> tuple[Array, Array, Array]:
    """Return link angles, torques and speeds along a path."""
    motion = segment.sample(times)
    present = present_at(mechanism, segment)
    path = Path(times, angles_along(mechanism, motion[:, 0], present), motion[:, 1:],
                on_parallelogram(mechanism, present), UNPAIRED_AXES)
    torques, gained, _ = loads_along(mechanism, path, wheels.allocation, wheels.speeds)
    return path.angles, torques, wheels.speeds + gained


# Values of the paper

@pytest.mark.parametrize(('usable', 'absolute'), [((0, 1, 2, 3), 62.37), ((0, 1), 124.74)])
def test_quarter_turn_of_the_paper(
    usable: tuple[int, ...], absolute: float, paper: Mechanism,
) -> None:
    """Values are absolute; relative to the link the speed is larger by the rate of the link."""
    segment = quarter_turn(10.0)
    needs = needs_of(paper, segment, present_at(paper, segment), fresh(paper, *usable))
    relative = absolute + PEAK_RATE * pi / 2 / 10.0
    # The error of the trapezoidal rule with 200 intervals is (2 pi / 200)^2 / 12 = 8e-5; the
    # expected values have two decimals.
    np.testing.assert_allclose(
        needs.peak_speeds[list(usable)], relative, rtol=1.5e-4, atol=0.005)
    # A wheel without torque keeps its absolute speed of zero.
    np.testing.assert_allclose(
        np.delete(needs.peak_speeds, usable), PEAK_RATE * pi / 2 / 10.0, rtol=1e-3)
    assert not np.delete(needs.peak_torques, usable).any()


# Agreement with the plant

WAYS = [
    ('paper', step(0.0, pi / 3, 1.0, 0.2, 4.0)),
    ('uneven', step(0.2, 1.5, 0.9, 1.2, 3.0)),
    ('parallelogram', step(0.1, 1.3, -0.5, 0.6, 3.0)),
    ('parallelogram', step(0.1, 0.7, 0.3, -0.9, 3.0)),     # through theta = 0
    ('paper', step(0.1, 0.7, 0.3, -0.9, 3.0)),
    ('paper', step(0.1, 2.9, 0.3, 0.9, 3.0)),              # through theta = pi
]


@pytest.mark.medium
@pytest.mark.parametrize(('linkage', 'segment'), WAYS)
@pytest.mark.parametrize('usable', [(0, 1, 2, 3), (0, 1), (0, 1, 3), (1, 2)])
def test_motion_and_wheel_speeds_of_the_plant_under_the_torques(
    linkage: str, segment: SoftStep, usable: tuple[int, ...], request: pytest.FixtureRequest,
) -> None:
    mechanism = replace(request.getfixturevalue(linkage), motor_torque_limits=UNLIMITED,
                        motor_speed_limits=UNLIMITED)
    wheels = fresh(mechanism, *usable)
    steps = round(segment.duration / STEP)
    times = (np.arange(steps) + 0.5) * STEP
    _, torques, _ = loads(mechanism, segment, wheels, times)
    plant = Plant(
        mechanism, IDEAL, InitialState(*segment.start[0]), STEP, np.random.default_rng(0))
    peaks = np.zeros(4)
    for torque in torques:
        plant.advance(1, torque)
        peaks = np.maximum(peaks, np.abs(plant.truth().wheel_speeds))
    # There is no feedback; torques at midpoints cause errors of about (STEP / duration)^2.
    np.testing.assert_allclose(plant.truth().link_angles[:2], segment.goal, atol=1e-4)
    needs = needs_of(mechanism, segment, present_at(mechanism, segment), wheels)
    np.testing.assert_allclose(needs.peak_speeds, peaks, rtol=5e-3, atol=1e-3)
    np.testing.assert_allclose(needs.end_speeds, plant.truth().wheel_speeds,
                               atol=5e-3 * peaks.max())
    np.testing.assert_allclose(
        needs.peak_torques, np.abs(torques).max(axis=0), rtol=5e-3, atol=1e-12)


@pytest.mark.parametrize('seed', range(10))
def test_momentum_of_links_moves_to_the_wheels(
    seed: int, uneven: Mechanism, parallelogram: Mechanism,
) -> None:
    """At rest the wheels have all initial momentum of the links."""
    rng = np.random.default_rng(seed)
    for mechanism in (uneven, parallelogram):
        start = np.array([[0.2, 1.5], rng.uniform(-0.2, 0.2, 2), rng.uniform(-0.1, 0.1, 2)])
        segment = SoftStep(start, np.array([0.5, 1.9]), 4.0)
        present = present_at(mechanism, segment)
        wheels = fresh(mechanism, speeds=rng.uniform(-50.0, 50.0, 4))
        rates = start[1].tolist()
        rates += (reduced_form(mechanism, present, rates).gamma @ rates).tolist()
        before = angular_momentum(mechanism, present, rates, wheels.speeds + rates)
        needs = needs_of(mechanism, segment, present, wheels)
        after = float(mechanism.flywheel_inertias @ needs.end_speeds)
        # The trapezoidal rule with 200 instants has an error of 1e-4 of the exchanged momentum.
        passed = float(mechanism.flywheel_inertias @ needs.peak_speeds)
        assert abs(after - before) < 1e-4 * passed, f'seed {seed}'


# Allocation

@pytest.mark.parametrize('seed', range(20))
@pytest.mark.parametrize('linkage', ['uneven', 'parallelogram'])
def test_torques_meet_the_demand_with_the_smallest_weighted_norm(
    seed: int, linkage: str, request: pytest.FixtureRequest,
) -> None:
    """Torques meet paper eq. 6 at every instant, and the gradient of the norm is zero."""
    mechanism = request.getfixturevalue(linkage)
    rng = np.random.default_rng(seed)
    wheels = Wheels(np.zeros(4), WeightedNorm(rng.uniform(0.1, 2.0, 4)))
    segment = step(0.2, 1.5, *rng.uniform(-0.5, 0.5, 2), 3.0)
    times = np.linspace(0.0, 3.0, 21)
    angles, torques, _ = loads(mechanism, segment, wheels, times)
    for pose, torque, (_, rate, acceleration) in zip(angles, torques, segment.sample(times)):
        form = reduced_form(mechanism, pose, rate)
        demand = form.mass_matrix @ acceleration + form.bias
        # The tolerance is the condition of G and A times some roundings.
        np.testing.assert_allclose(
            -form.wheel_map @ torque, demand, atol=1e-12 * np.abs(demand).max() + 1e-20,
            err_msg=f'seed {seed}')
        # At the optimum the gradient tau / V is orthogonal to the null space.
        slope = null_space(form.wheel_map).T @ (torque / wheels.allocation.weights_inv)
        assert np.abs(slope).max() <= 1e-11 * np.abs(torque / wheels.allocation.weights_inv).max()


def test_wheels_of_one_pair_turn_only_this_pair(
    paper: Mechanism, refuses: Refuses,
) -> None:
    """The pairs of a rhombus are independent: A is diagonal and b is 0."""
    turn_a, turn_b = step(0.0, 1.2, 0.4, 0.0, 4.0), step(0.0, 1.2, 0.0, 0.4, 4.0)
    present, wheels = present_at(paper, turn_a), fresh(paper, 0, 2)
    needs = check_needs(paper, turn_a, present, wheels)
    assert needs.peak_torques[[0, 2]] == pytest.approx(
        needs_of(paper, turn_a, present, fresh(paper)).peak_torques[[0, 2]], rel=1e-12)
    with refuses(SetpointError, usable=['flywheel_a', 'flywheel_c'], value=1.0):
        check_needs(paper, turn_b, present, wheels)
    nothing = Wheels(np.zeros(4), WeightedNorm(np.zeros(4)))
    with refuses(SetpointError, usable=[]):
        check_needs(paper, turn_a, present, nothing)
    check_needs(paper, step(0.0, 1.2, 0.0, 0.0, 4.0), present, nothing)


# Limits

def refusal(mechanism: Mechanism, segment: TrajectorySegment, wheels: Wheels) -> SetpointError:
    with pytest.raises(SetpointError) as caught:
        check_needs(mechanism, segment, present_at(mechanism, segment), wheels)
    assert '\n' not in str(caught.value)
    return caught.value


@pytest.mark.parametrize(('quantity', 'given', 'value', 'unit'), [
    ('motor_speed_limits', 40.0, 48.15, 'rad/s'), ('motor_torque_limits', 1e-3, 0.001768, 'N m'),
    ('motor_voltages', 1.0, 1.446, 'V')])
def test_refused_with_wheel_numbers_and_shortest_duration(
    quantity: str, given: float, value: float, unit: str, prototype: Mechanism,
) -> None:
    limits = np.array(getattr(prototype, quantity))
    limits[1] = given
    weak = replace(prototype, **{quantity: limits})
    error = refusal(weak, quarter_turn(10.0), fresh(weak))
    assert error.values['name'] == 'flywheel_b'
    assert error.values['value'] == pytest.approx(value, rel=4e-4)
    assert error.values['limit'] == pytest.approx(0.95 * given)
    shortest = error.values['duration']
    for part in ('flywheel_b', f'{value:g} {unit}', f'{0.95 * given:g} {unit}', f'{shortest:g} s'):
        assert part in str(error)
    enough = quarter_turn(shortest)
    check_needs(weak, enough, present_at(weak, enough), fresh(weak))
    refusal(weak, quarter_turn(shortest - 0.03), fresh(weak))


def fullness(mechanism: Mechanism, needs: Needs) -> float:
    """Return the largest ratio of a demand to its limit."""
    return float(max((needs.peak_speeds / mechanism.motor_speed_limits).max(),
                     (needs.peak_torques / mechanism.motor_torque_limits).max(),
                     (needs.peak_voltages / mechanism.motor_voltages).max()))


CASES: list[tuple[str, float, tuple[float, float]]] = [
    ('paper', 0.0, (0.0, 0.0)), ('prototype', 0.0, (0.0, 0.0)), ('prototype', 240.0, (0.0, 0.0)),
    ('prototype', -200.0, (0.0, 0.0)), ('uneven', 0.0, (0.0, 0.0)), ('uneven', 300.0, (0.0, 0.0)),
    ('paper', 0.0, (0.3, 0.2)), ('prototype', 100.0, (-0.2, 0.3)), ('uneven', 0.0, (-0.1, 0.1))]


@pytest.mark.parametrize(('linkage', 'speed', 'rates'), CASES)
@pytest.mark.parametrize('share', [SHARE, 0.5])
def test_shortest_duration_meets_a_limit_and_a_shorter_one_exceeds_it(
    linkage: str, speed: float, rates: tuple[float, float], share: float,
    request: pytest.FixtureRequest,
) -> None:
    mechanism = request.getfixturevalue(linkage)
    if abs(speed) > share * mechanism.motor_speed_limits.min():
        speed *= 0.5
    start = np.array([[0.0, pi / 3], rates, [0.0, 0.0]])
    goal = start[0] + [1.0, 1.3]
    present = assemble(mechanism, *start[0])
    wheels = fresh(mechanism, speeds=speed * np.array([1.0, -1.0, 0.5, 0.2]))
    shortest = shortest_duration(
        mechanism, SoftStep(start, goal, 1.0), present, wheels, share=share)
    at, below = (fullness(mechanism, needs_of(
        mechanism, SoftStep(start, goal, shortest * factor), present, wheels))
        for factor in (1.0, 0.98))
    assert 0.99 * share <= at <= share * (1.0 + 1e-6)
    assert below > share


def test_supply_limit_agrees_with_that_of_the_plant(prototype: Mechanism) -> None:
    """The plant reduces no torque at the shortest duration, and does so 2 % below it."""
    weak = replace(prototype, motor_voltages=np.full(4, 3.0))
    motors = motors_of(weak)
    wheels = fresh(weak)
    segment = quarter_turn(1.0)
    shortest = shortest_duration(
        weak, segment, present_at(weak, segment), wheels, share=1.0)
    for factor, cut in ((1.0, False), (0.98, True)):
        segment = quarter_turn(factor * shortest)
        _, torques, speeds = loads(weak, segment, wheels, np.linspace(0.0, segment.duration, 200))
        given = np.array([[available_torque(wheel, torque[wheel], speed[wheel], motors)
                           for wheel in range(4)] for torque, speed in zip(torques, speeds)])
        assert bool((np.abs(given - torques) > 1e-9).any()) == cut


def test_stored_momentum_is_reported(prototype: Mechanism) -> None:
    speeds = np.array([0.0, 284.9, 0.0, 0.0])
    move = step(0.0, 1.2, 0.0, -0.8, 10.0)
    error = refusal(prototype, move, fresh(prototype, speeds=speeds))
    assert (error.values['name'], error.values['limit']) == ('flywheel_b', pytest.approx(285.0))
    assert error.values['value'] > 300.0
    assert error.values['duration'] > 1000.0
    speeds[1] = 290.0
    wheels = fresh(prototype, speeds=speeds)
    error = refusal(prototype, move, wheels)
    assert (error.values['name'], error.values['limit']) == ('flywheel_b', 290.0)
    assert 'duration' not in error.values
    with pytest.raises(SetpointError) as caught:
        shortest_duration(prototype, move, present_at(prototype, move), wheels)
    assert caught.value.values == {'name': 'flywheel_b', 'value': 290.0, 'limit': 300.0}
    assert str(caught.value) in str(error)


def test_wheel_above_its_limit_share_may_hold_or_slow_down(prototype: Mechanism) -> None:
    wheels = fresh(prototype, speeds=np.array([0.0, 290.0, 0.0, 0.0]))
    for segment in (step(0.0, 1.2, 0.0, 0.0, 5.0), step(0.0, 1.2, 0.0, 0.5, 10.0)):
        check_needs(prototype, segment, present_at(prototype, segment), wheels)


def test_friction_is_added_to_the_torques(prototype: Mechanism, refuses: Refuses) -> None:
    friction = np.array([1e-3, 2e-3, 3e-3, 4e-3])
    turning = replace(fresh(prototype, speeds=np.array([50.0, -50.0, 50.0, -50.0])),
                      extra_torque=friction)
    hold, turn = step(0.0, 1.2, 0.0, 0.0, 5.0), quarter_turn(10.0)
    needs = needs_of(prototype, hold, present_at(prototype, hold), turning)
    np.testing.assert_allclose(needs.peak_torques, friction, rtol=1e-12)
    # An accelerating wheel needs the sum of both.
    bare = needs_of(prototype, turn, present_at(prototype, turn), fresh(prototype))
    rubbing = needs_of(prototype, turn, present_at(prototype, turn),
                       replace(fresh(prototype), extra_torque=friction))
    np.testing.assert_allclose(
        rubbing.peak_torques, bare.peak_torques + friction, rtol=1e-12)
    # An unusable wheel has no motor torque against the friction.
    three = replace(turning, allocation=squares(prototype, 0, 1))
    needs = needs_of(prototype, hold, present_at(prototype, hold), three)
    assert not needs.peak_torques[2:].any()
    strong = replace(turning, extra_torque=np.full(4, 0.06))
    assert 'duration' not in refusal(prototype, turn, strong).values
    with refuses(SetpointError, limit=LONGEST_DURATION):
        shortest_duration(prototype, turn, present_at(prototype, turn), strong)


def test_segment_without_motion_has_the_least_duration(paper: Mechanism) -> None:
    segment = step(0.0, 1.2, 0.0, 0.0, 1.0)
    assert shortest_duration(
        paper, segment, present_at(paper, segment), fresh(paper)) == LEAST_DURATION


def test_trajectory_is_checked_like_a_step(paper: Mechanism) -> None:
    """Points on a soft step give the same quintic; the error has no shortest duration."""
    segment = quarter_turn(10.0)
    present = present_at(paper, segment)
    trajectory, _ = read_trajectory(
        paper, ['link_a', 'link_b'],
        [Point(*segment.at(time)[:1].tolist(), time, *segment.at(time)[1:].tolist())
         for time in (2.0, 5.0, 9.0, 10.0)], segment.start, present, present)
    expected = needs_of(paper, segment, present, fresh(paper))
    needs = check_needs(paper, trajectory, present, fresh(paper))
    np.testing.assert_allclose(needs.peak_speeds, expected.peak_speeds, rtol=1e-4)
    fast, _ = read_trajectory(
        paper, ['link_a', 'link_b'], [Point(segment.goal.tolist(), 1.0)], segment.start,
        present, present)
    error = refusal(paper, fast, fresh(paper))
    assert error.values['value'] > error.values['limit']
    assert 'duration' not in error.values


def test_path_that_cannot_close_is_refused(refuses: Refuses) -> None:
    long = Mechanism(  # type: ignore[arg-type]
        [0.3, 0.3, 0.2, 0.2], [0.02] * 4, [2e-5] * 4, [[0.05, 0.0]] * 4, [3e-7] * 4)
    segment = step(0.0, 1.0, 0.0, 1.5, 10.0)
    with refuses(SetpointError, name='closure'):
        needs_of(long, segment, present_at(long, segment), fresh(long))
