# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What a motion needs of the wheels is what the plant takes, and limits are told with numbers."""

from dataclasses import replace
from math import pi
import re

from fourbar_ros.control.branch import LINKS_ALONE, on_parallelogram
from fourbar_ros.control.feasibility import (
    check_needs,
    LEAST_DURATION,
    Needs,
    needs_of,
    SHARE,
    shortest_duration,
    wheel_loads,
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

IDEAL = Table(LinkSensorSettings(), WheelEncoders(0))
UNLIMITED = np.full(4, np.inf)
STEP = 1e-3
PEAK_RATE = 15.0 / 8.0


@pytest.fixture(scope='module')
def prototype() -> Mechanism:
    return load_mechanism('prototype')


@pytest.fixture(scope='module')
def parallelogram() -> Mechanism:
    """Make a parallelogram with nothing equal but opposite lengths."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.12, 0.08], [0.02, 0.03, 0.025, 0.018], [2.2e-5, 1.5e-5, 3e-5, 1.8e-5],
        [[0.05, 0.01], [0.04, -0.01], [0.06, 0.005], [0.05, 0.0]], [3e-7, 4e-7, 5e-7, 2e-7])


def squares(mechanism: Mechanism, *usable: int) -> Array:
    """Weigh as paper eq. 8 does, with some wheels only."""
    mobilities = np.zeros(4)
    mobilities[list(usable)] = mechanism.flywheel_inertias[list(usable)] ** 2
    return mobilities


def fresh(mechanism: Mechanism, *usable: int, speeds: float | Array = 0.0) -> Wheels:
    return Wheels(np.zeros(4) + speeds, squares(mechanism, *(usable or range(4))))


def step(phi_a: float, phi_b: float, by_a: float, by_b: float, duration: float) -> SoftStep:
    start = np.array([[phi_a, phi_b], [0.0, 0.0], [0.0, 0.0]])
    return SoftStep(start, start[0] + [by_a, by_b], duration)


def quarter_turn(duration: float) -> SoftStep:
    return step(0.0, pi / 3, pi / 2, pi / 2, duration)


def present_at(mechanism: Mechanism, way: TrajectorySegment) -> Array:
    return assemble(mechanism, *way.at(0.0)[0])


def loads(mechanism: Mechanism, way: TrajectorySegment, wheels: Wheels, times: Array
          ) -> tuple[Array, Array, Array]:
    """Return link angles, torques and speeds along a way."""
    motion = way.sample(times)
    present = present_at(mechanism, way)
    angles = angles_along(mechanism, motion[:, 0], present)
    torques, gained, _ = wheel_loads(
        times, angles, motion[:, 1:], on_parallelogram(mechanism, present), LINKS_ALONE,
        wheels.mobilities, np.array([mechanism.constants]))
    return angles, torques, wheels.speeds + gained


# What the paper says

@pytest.mark.parametrize(('usable', 'absolute'), [((0, 1, 2, 3), 62.37), ((0, 1), 124.74)])
def test_quarter_turn_of_the_paper(
    usable: tuple[int, ...], absolute: float, paper: Mechanism,
) -> None:
    """Absolute speeds; a wheel runs against its link, so relative to it the peak rate more."""
    way = quarter_turn(10.0)
    needs = needs_of(paper, way, present_at(paper, way), fresh(paper, *usable))
    relative = absolute + PEAK_RATE * pi / 2 / 10.0
    # The trapezoid in 200 parts of a sine, almost: (2 pi / 200)^2 / 12 = 8e-5; and two digits.
    np.testing.assert_allclose(
        needs.peak_speeds[list(usable)], relative, rtol=1.5e-4, atol=0.005)
    # What is not used is carried along by its link.
    np.testing.assert_allclose(
        np.delete(needs.peak_speeds, usable), PEAK_RATE * pi / 2 / 10.0, rtol=1e-3)
    assert not np.delete(needs.peak_torques, usable).any()


# What the plant says

WAYS = [
    ('paper', step(0.0, pi / 3, 1.0, 0.2, 4.0)),
    ('uneven', step(0.2, 1.5, 0.9, 1.2, 3.0)),
    ('parallelogram', step(0.1, 1.3, -0.5, 0.6, 3.0)),
    ('parallelogram', step(0.1, 0.7, 0.3, -0.9, 3.0)),     # through theta = 0
    ('paper', step(0.1, 0.7, 0.3, -0.9, 3.0)),
    ('paper', step(0.1, 2.9, 0.3, 0.9, 3.0)),              # through theta = pi
]


@pytest.mark.parametrize(('linkage', 'way'), WAYS)
@pytest.mark.parametrize('usable', [(0, 1, 2, 3), (0, 1), (0, 1, 3), (1, 2)])
def test_plant_given_the_torques_moves_so_and_its_wheels_reach_these_speeds(
    linkage: str, way: SoftStep, usable: tuple[int, ...], request: pytest.FixtureRequest,
) -> None:
    mechanism = replace(request.getfixturevalue(linkage), motor_torque_limits=UNLIMITED,
                        motor_speed_limits=UNLIMITED)
    wheels = fresh(mechanism, *usable)
    steps = round(way.duration / STEP)
    times = (np.arange(steps) + 0.5) * STEP
    _, torques, _ = loads(mechanism, way, wheels, times)
    plant = Plant(mechanism, IDEAL, InitialState(*way.start[0]), STEP, np.random.default_rng(0))
    peaks = np.zeros(4)
    for torque in torques:
        plant.advance(1, torque)
        peaks = np.maximum(peaks, np.abs(plant.truth().wheel_speeds))
    # Without feedback: torques at midpoints leave some (STEP / duration)^2 of the way.
    np.testing.assert_allclose(plant.truth().link_angles[:2], way.goal, atol=1e-4)
    needs = needs_of(mechanism, way, present_at(mechanism, way), wheels)
    np.testing.assert_allclose(needs.peak_speeds, peaks, rtol=5e-3, atol=1e-3)
    np.testing.assert_allclose(needs.end_speeds, plant.truth().wheel_speeds,
                               atol=5e-3 * peaks.max())
    np.testing.assert_allclose(
        needs.peak_torques, np.abs(torques).max(axis=0), rtol=5e-3, atol=1e-12)


@pytest.mark.parametrize('seed', range(10))
def test_momentum_is_only_moved(
    seed: int, uneven: Mechanism, parallelogram: Mechanism,
) -> None:
    """From motion to rest all that the links had is in the wheels."""
    rng = np.random.default_rng(seed)
    for mechanism in (uneven, parallelogram):
        start = np.array([[0.2, 1.5], rng.uniform(-0.2, 0.2, 2), rng.uniform(-0.1, 0.1, 2)])
        way = SoftStep(start, np.array([0.5, 1.9]), 4.0)
        present = present_at(mechanism, way)
        wheels = fresh(mechanism, speeds=rng.uniform(-50.0, 50.0, 4))
        rates = start[1].tolist()
        rates += (reduced_form(mechanism, present, rates).gamma @ rates).tolist()
        before = angular_momentum(mechanism, present, rates, wheels.speeds + rates)
        needs = needs_of(mechanism, way, present, wheels)
        after = float(mechanism.flywheel_inertias @ needs.end_speeds)
        # The trapezoid at 200 instants is good to 1e-4 of what passes through the wheels.
        passed = float(mechanism.flywheel_inertias @ needs.peak_speeds)
        assert abs(after - before) < 1e-4 * passed, f'seed {seed}'


# Sharing

@pytest.mark.parametrize('seed', range(20))
@pytest.mark.parametrize('linkage', ['uneven', 'parallelogram'])
def test_shares_meet_the_demand_with_the_smallest_weighted_norm(
    seed: int, linkage: str, request: pytest.FixtureRequest,
) -> None:
    """Paper eq. 6 holds at every instant, and no other torques that meet it are smaller."""
    mechanism = request.getfixturevalue(linkage)
    rng = np.random.default_rng(seed)
    wheels = Wheels(np.zeros(4), rng.uniform(0.1, 2.0, 4))
    way = step(0.2, 1.5, *rng.uniform(-0.5, 0.5, 2), 3.0)
    times = np.linspace(0.0, 3.0, 21)
    angles, torques, _ = loads(mechanism, way, wheels, times)
    for pose, torque, (_, rate, acceleration) in zip(angles, torques, way.sample(times)):
        form = reduced_form(mechanism, pose, rate)
        demand = form.mass_matrix @ acceleration + form.bias
        # The condition of G and A times some roundings.
        np.testing.assert_allclose(
            -form.wheel_map @ torque, demand, atol=1e-12 * np.abs(demand).max() + 1e-20,
            err_msg=f'seed {seed}')
        # At the optimum the gradient tau / V is perpendicular to all that changes nothing.
        slope = null_space(form.wheel_map).T @ (torque / wheels.mobilities)
        assert np.abs(slope).max() <= 1e-11 * np.abs(torque / wheels.mobilities).max()


def test_wheels_of_one_pair_can_turn_this_pair_only(paper: Mechanism) -> None:
    """On the rhombus links a and c are on their own: A is diagonal and b is 0."""
    turn_a, turn_b = step(0.0, 1.2, 0.4, 0.0, 4.0), step(0.0, 1.2, 0.0, 0.4, 4.0)
    present, wheels = present_at(paper, turn_a), fresh(paper, 0, 2)
    needs = check_needs(paper, turn_a, present, wheels)
    assert needs.peak_torques[[0, 2]] == pytest.approx(
        needs_of(paper, turn_a, present, fresh(paper)).peak_torques[[0, 2]], rel=1e-12)
    with pytest.raises(SetpointError, match='flywheel_a, flywheel_c can be used, which leaves '
                                            '100 % of the torque needed unmet'):
        check_needs(paper, turn_b, present, wheels)
    nothing = Wheels(np.zeros(4), np.zeros(4))
    with pytest.raises(SetpointError, match='no flywheel can be used'):
        check_needs(paper, turn_a, present, nothing)
    check_needs(paper, step(0.0, 1.2, 0.0, 0.0, 4.0), present, nothing)


# Limits

def refusal(mechanism: Mechanism, way: TrajectorySegment, wheels: Wheels) -> str:
    with pytest.raises(SetpointError) as caught:
        check_needs(mechanism, way, present_at(mechanism, way), wheels)
    assert '\n' not in str(caught.value)
    return str(caught.value)


def told_duration(message: str) -> float:
    found = re.search(r'shortest duration is ([\d.]+) s$', message)
    assert found, message
    return float(found[1])


@pytest.mark.parametrize(('quantity', 'limits', 'needle'), [
    ('motor_speed_limits', 40.0,
     r'needs 48.15 rad/s on flywheel_b, limit 38 rad/s \(95 % of the motor\'s 40 rad/s\)'),
    ('motor_torque_limits', 1e-3,
     r'needs 0.001768 N m on flywheel_b, limit 0.00095 N m \(95 % of the motor\'s 0.001 N m\)'),
    ('motor_voltages', 1.0,
     r'needs 1.446 V on flywheel_b, limit 0.95 V \(95 % of the supply\'s 1 V\)'),
])
def test_refused_with_wheel_numbers_and_shortest_duration(
    quantity: str, limits: float, needle: str, prototype: Mechanism,
) -> None:
    values = np.array(getattr(prototype, quantity))
    values[1] = limits
    weak = replace(prototype, **{quantity: values})
    message = refusal(weak, quarter_turn(10.0), fresh(weak))
    assert re.match(needle, message)
    enough = quarter_turn(told_duration(message))
    check_needs(weak, enough, present_at(weak, enough), fresh(weak))
    short = quarter_turn(told_duration(message) - 0.03)
    refusal(weak, short, fresh(weak))


def fullness(mechanism: Mechanism, needs: Needs) -> float:
    """Return the largest share of a limit that is needed."""
    return float(max((needs.peak_speeds / mechanism.motor_speed_limits).max(),
                     (needs.peak_torques / mechanism.motor_torque_limits).max(),
                     (needs.peak_voltages / mechanism.motor_voltages).max()))


CASES: list[tuple[str, float, tuple[float, float]]] = [
    ('paper', 0.0, (0.0, 0.0)), ('prototype', 0.0, (0.0, 0.0)), ('prototype', 240.0, (0.0, 0.0)),
    ('prototype', -200.0, (0.0, 0.0)), ('uneven', 0.0, (0.0, 0.0)), ('uneven', 300.0, (0.0, 0.0)),
    ('paper', 0.0, (0.3, 0.2)), ('prototype', 100.0, (-0.2, 0.3)), ('uneven', 0.0, (-0.1, 0.1))]


@pytest.mark.parametrize(('linkage', 'speed', 'rates'), CASES)
@pytest.mark.parametrize('share', [SHARE, 0.5])
def test_at_the_shortest_duration_a_limit_is_met_and_below_it_is_broken(
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
    shortest = shortest_duration(mechanism, start, goal, present, wheels, share=share)
    at, below = (fullness(mechanism, needs_of(
        mechanism, SoftStep(start, goal, shortest * factor), present, wheels))
        for factor in (1.0, 0.98))
    assert 0.99 * share <= at <= share * (1.0 + 1e-6)
    assert below > share


def test_supply_covers_what_the_motors_of_the_plant_are_asked_for(prototype: Mechanism) -> None:
    """The law of the plant: at the shortest duration it cuts nothing off, 2 % below it does."""
    weak = replace(prototype, motor_voltages=np.full(4, 3.0))
    motors = motors_of(weak)
    wheels = fresh(weak)
    way = quarter_turn(1.0)
    shortest = shortest_duration(
        weak, way.start, way.goal, present_at(weak, way), wheels, share=1.0)
    for factor, cut in ((1.0, False), (0.98, True)):
        way = quarter_turn(factor * shortest)
        _, torques, speeds = loads(weak, way, wheels, np.linspace(0.0, way.duration, 200))
        given = np.array([[available_torque(wheel, torque[wheel], speed[wheel], motors)
                           for wheel in range(4)] for torque, speed in zip(torques, speeds)])
        assert bool((np.abs(given - torques) > 1e-9).any()) == cut


def test_stored_momentum_is_told(prototype: Mechanism) -> None:
    speeds = np.array([0.0, 284.9, 0.0, 0.0])
    message = refusal(prototype, step(0.0, 1.2, 0.0, -0.8, 10.0), fresh(prototype, speeds=speeds))
    assert re.match(r'needs 3\d\d(\.\d)? rad/s on flywheel_b, limit 285 rad/s', message)
    shortest = told_duration(message)
    assert shortest > 1000.0
    speeds[1] = 290.0
    message = refusal(prototype, step(0.0, 1.2, 0.0, -0.8, 10.0), fresh(prototype, speeds=speeds))
    assert "limit 290 rad/s (what it is now, above 95 % of the motor's 300 rad/s)" in message
    assert message.endswith('more time does not help: flywheel_b turns at 290 rad/s already, and '
                            'momentum is not lost')


def test_wheel_above_its_share_may_stay_and_slow_down(prototype: Mechanism) -> None:
    wheels = fresh(prototype, speeds=np.array([0.0, 290.0, 0.0, 0.0]))
    for way in (step(0.0, 1.2, 0.0, 0.0, 5.0), step(0.0, 1.2, 0.0, 0.5, 10.0)):
        check_needs(prototype, way, present_at(prototype, way), wheels)


def test_friction_comes_on_top(prototype: Mechanism) -> None:
    friction = np.array([1e-3, 2e-3, 3e-3, 4e-3])
    turning = replace(fresh(prototype, speeds=np.array([50.0, -50.0, 50.0, -50.0])),
                      extra_torque=friction)
    hold, turn = step(0.0, 1.2, 0.0, 0.0, 5.0), quarter_turn(10.0)
    needs = needs_of(prototype, hold, present_at(prototype, hold), turning)
    np.testing.assert_allclose(needs.peak_torques, friction, rtol=1e-12)
    # A wheel that turns faster and faster needs both in full.
    bare = needs_of(prototype, turn, present_at(prototype, turn), fresh(prototype))
    rubbing = needs_of(prototype, turn, present_at(prototype, turn),
                       replace(fresh(prototype), extra_torque=friction))
    np.testing.assert_allclose(
        rubbing.peak_torques, bare.peak_torques + friction, rtol=1e-12)
    # An unusable wheel has no motor that could.
    lame = replace(turning, mobilities=squares(prototype, 0, 1))
    needs = needs_of(prototype, hold, present_at(prototype, hold), lame)
    assert not needs.peak_torques[2:].any()
    strong = replace(turning, extra_torque=np.full(4, 0.06))
    assert 'no duration up to 3600 s is long enough' in refusal(prototype, turn, strong)


def test_nothing_to_do_takes_the_least_duration(paper: Mechanism) -> None:
    way = step(0.0, 1.2, 0.0, 0.0, 1.0)
    assert shortest_duration(
        paper, way.start, way.goal, present_at(paper, way), fresh(paper)) == LEAST_DURATION


def test_trajectory_is_checked_like_a_step(paper: Mechanism) -> None:
    """A trajectory of one point is that step; of several, only what it needs is told."""
    way = quarter_turn(10.0)
    present = present_at(paper, way)
    trajectory, _ = read_trajectory(
        paper, ['link_a', 'link_b'], [Point(way.goal.tolist(), 10.0)], way.start, present, present)
    expected = needs_of(paper, way, present, fresh(paper))
    needs = check_needs(paper, trajectory, present, fresh(paper))
    np.testing.assert_allclose(needs.peak_speeds, expected.peak_speeds, rtol=1e-4)
    fast, _ = read_trajectory(
        paper, ['link_a', 'link_b'], [Point(way.goal.tolist(), 1.0)], way.start, present, present)
    message = refusal(paper, fast, fresh(paper))
    assert message.startswith('needs ')
    assert 'duration' not in message


def test_way_that_cannot_close_is_refused() -> None:
    long = Mechanism(  # type: ignore[arg-type]
        [0.3, 0.3, 0.2, 0.2], [0.02] * 4, [2e-5] * 4, [[0.05, 0.0]] * 4, [3e-7] * 4)
    way = step(0.0, 1.0, 0.0, 1.5, 10.0)
    with pytest.raises(SetpointError, match='on the way there the loop cannot close'):
        needs_of(long, way, present_at(long, way), fresh(long))
