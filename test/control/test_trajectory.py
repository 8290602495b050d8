# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Trajectories: smooth motions through points with times, and refusals with the number."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from itertools import combinations
from math import inf, nan, pi
from typing import Any

from fourbar_ros.control.setpoint import SetpointError
from fourbar_ros.control.soft_step import SoftStep
from fourbar_ros.control.trajectory import MAX_POINTS, Point, read_trajectory, Trajectory
from fourbar_ros.mechanism import assemble, closure_error, LINK_NAMES, Mechanism
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Refuses = Callable[..., AbstractContextManager[None]]
A_AND_B = LINK_NAMES[:2]
MOVING = np.array([[0.2, 1.5], [0.05, -0.08], [0.02, 0.03]])


def read(mechanism: Mechanism, names: Sequence[str], points: Sequence[Point],
         start: Array = MOVING, branch: str = 'open', **options: bool
         ) -> tuple[Trajectory, Array]:
    present = assemble(mechanism, *start[0], branch)
    return read_trajectory(mechanism, names, points, start, present, present, **options)


def draw(seed: int, count: int) -> tuple[Array, Array]:
    """Draw times, and positions of a and b away from change points."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.5, 3.0, count))
    phi_a = 0.2 + np.cumsum(rng.uniform(-0.5, 0.5, count))
    return times, np.column_stack([phi_a, phi_a + rng.uniform(1.2, 1.7, count)])


def assert_smooth(trajectory: Trajectory) -> None:
    """Check that angle, rate and acceleration are continuous derivatives of each other."""
    duration, width = trajectory.duration, 1e-5
    times = trajectory.instants(5000)
    motion = trajectory.sample(times)
    # Largest derivatives; the jerk is a fine difference of the acceleration with a margin.
    steepest = max(1.0, 1.5 * (np.abs(np.diff(motion[:, 2], axis=0)).max(axis=1)
                               / np.diff(times)).max(), np.abs(motion[:, 1:]).max())
    for time in [*trajectory.times[1:-1], *np.linspace(width, duration - width, 101)]:
        before, now, after = (trajectory.at(time + shift) for shift in (-width, 0.0, width))
        assert np.abs(after - before).max() < 2.0 * width * steepest
        # The jerk may jump at a point, so the error of a slope is jerk times width, and rounding.
        np.testing.assert_allclose(
            ((after - before) / (2.0 * width))[:2], now[1:], atol=steepest * width + 1e-9)
    np.testing.assert_array_equal(trajectory.at(duration)[1:], 0.0)
    np.testing.assert_array_equal(trajectory.at(duration + 1.0), trajectory.at(duration))
    assert np.abs(trajectory.at(duration - width) - trajectory.at(duration)
                  ).max() < width * steepest


# Given points

@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('given', ['positions', 'velocities', 'accelerations'])
def test_motion_passes_the_points_as_given(seed: int, given: str, paper: Mechanism) -> None:
    times, positions = draw(seed, 6)
    rng = np.random.default_rng(seed)
    rates, bends = rng.uniform(-0.1, 0.1, (2, 6, 2))
    rates[-1] = bends[-1] = 0.0
    count = ['positions', 'velocities', 'accelerations'].index(given)
    points = [Point(position.tolist(), float(time), *[
        values.tolist() for values in (rate, bend)[:count]])
        for position, time, rate, bend in zip(positions, times, rates, bends)]
    trajectory, end = read(paper, A_AND_B, points)
    np.testing.assert_allclose(trajectory.at(0.0), MOVING, rtol=0.0, atol=1e-15)
    assert trajectory.duration == times[-1]
    for n, time in enumerate(times):
        state = trajectory.at(float(time))
        np.testing.assert_allclose(state[0], positions[n], rtol=0.0, atol=1e-13)
        if given != 'positions':
            np.testing.assert_allclose(state[1], rates[n], rtol=0.0, atol=1e-13)
        if given == 'accelerations':
            np.testing.assert_allclose(state[2], bends[n], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(end[:2], positions[-1], rtol=0.0, atol=1e-12)
    assert_smooth(trajectory)


@pytest.mark.parametrize('velocities', [(), (0.0, 0.0)])
def test_one_point_is_a_setpoint(velocities: tuple[float, ...], paper: Mechanism) -> None:
    trajectory, _ = read(paper, A_AND_B, [Point((0.9, 2.0), 4.0, velocities)])
    step = SoftStep(MOVING, np.array([0.9, 2.0]), 4.0)
    for time in np.linspace(-0.5, 4.5, 51):
        np.testing.assert_allclose(trajectory.at(time), step.at(time), rtol=0.0, atol=1e-13)


def test_points_with_and_without_rates_may_be_mixed(paper: Mechanism) -> None:
    times, positions = draw(3, 5)
    points = [Point(position.tolist(), float(time)) for position, time in zip(positions, times)]
    points[2] = Point(points[2].positions, points[2].time_s, (0.0, 0.1))
    trajectory, _ = read(paper, A_AND_B, points)
    np.testing.assert_allclose(trajectory.at(float(times[2]))[1], [0.0, 0.1], atol=1e-13)
    assert_smooth(trajectory)


def test_motion_through_points_on_a_cubic_is_the_cubic(paper: Mechanism) -> None:
    """The cubic has the same rates and accelerations at begin and end."""
    times = np.arange(0.0, 6.5, 1.0)
    cubic = (0.5 * (times / 6.0) ** 2 * (3.0 - 2.0 * times / 6.0))[:, None] + MOVING[0]
    start = np.array([MOVING[0], np.zeros(2), np.full(2, 3.0 / 36.0)])
    trajectory, _ = read(paper, A_AND_B, [
        Point(position.tolist(), float(time)) for position, time in zip(cubic[1:], times[1:])],
        start)
    # The last piece differs, since the acceleration ends at zero.
    for time in np.linspace(0.0, 5.0, 41):
        s = time / 6.0
        np.testing.assert_allclose(
            trajectory.at(time)[0], MOVING[0] + 0.5 * s * s * (3.0 - 2.0 * s), atol=1e-13)


def test_replanning_takes_over_angle_rate_and_acceleration(paper: Mechanism) -> None:
    times, positions = draw(5, 6)
    points = [Point(position.tolist(), float(time)) for position, time in zip(positions, times)]
    old, _ = read(paper, A_AND_B, points)
    for time in np.linspace(0.1, old.duration - 0.1, 7):
        now = old.at(time)
        new, _ = read(paper, A_AND_B, [
            Point((now[0] + 0.1).tolist(), 3.0), Point((now[0] - 0.1).tolist(), 7.0)], now)
        np.testing.assert_allclose(new.at(0.0), now, rtol=0.0, atol=1e-15)


def test_samples_agree_with_the_motion_in_every_piece(paper: Mechanism) -> None:
    points = [Point((0.3, 1.6), 1.0, (0.0, 0.0)), Point((0.31, 1.6), 1.01, (0.0, 0.0)),
              Point((0.4, 1.7), 50.0)]
    trajectory, _ = read(paper, A_AND_B, points)
    times = trajectory.instants(100)
    assert len(times) >= 100
    assert (np.diff(times) > 0.0).all()
    assert set(trajectory.times) <= set(times)
    assert ((times > 1.0) & (times < 1.01)).sum() >= 7
    np.testing.assert_allclose(
        trajectory.sample(times), [trajectory.at(time) for time in times], rtol=0.0, atol=1e-12)


def test_short_piece_causes_no_overshoot_of_a_long_one(paper: Mechanism) -> None:
    """The short piece needs 100 times the acceleration of the long one."""
    trajectory, _ = read(paper, A_AND_B, [
        Point((0.3, 1.6), 1.0, (0.0, 0.0)), Point((0.31, 1.6), 1.1, (0.0, 0.0)),
        Point((0.4, 1.7), 50.0)])
    path = trajectory.sample(np.linspace(1.0, 50.0, 2000))[:, 0]
    assert (path.min(axis=0) > [0.29, 1.59]).all()
    assert (path.max(axis=0) < [0.41, 1.71]).all()


# Named links

def motion(time: float) -> Array:
    """Return smooth angles (phi_a, phi_b)."""
    return np.array([0.2 + 0.3 * np.sin(0.5 * time), 1.5 + 0.2 * np.sin(0.7 * time)])


LINKS = [*combinations(range(4), 2), (0, 1, 2), (3, 1, 0), (0, 2, 3), (0, 1, 2, 3)]


@pytest.mark.parametrize(('linkage', 'branch', 'links'), [
    *(('uneven', branch, links) for branch in ('open', 'crossed') for links in LINKS),
    # Parallel links alone do not determine a rhombus.
    *(('paper', 'open', links) for links in LINKS if links not in ((0, 2), (1, 3)))], ids=str)
def test_any_determining_links_give_the_same_motion(
    linkage: str, branch: str, links: tuple[int, ...], request: pytest.FixtureRequest,
) -> None:
    """The reference for angles, rates and accelerations is differences of the closure."""
    mechanism = request.getfixturevalue(linkage)
    width = 1e-4

    def pose(time: float) -> Array:
        return assemble(mechanism, *motion(time), branch)

    points, states = [], []
    for time in (0.5, 1.3, 2.0):
        before, now, after = (pose(time + shift) for shift in (-width, 0.0, width))
        values = now, (after - before) / (2 * width), (after - 2 * now + before) / width ** 2
        points.append(Point(now[list(links)].tolist(), time, *[
            value[list(links)].tolist() for value in values[1:]]))
        states.append(np.array([value[:2] for value in values]))
    points.append(Point(pose(3.0)[list(links)].tolist(), 3.0))
    start = np.array([motion(0.0), np.zeros(2), np.zeros(2)])
    trajectory, end = read(mechanism, [LINK_NAMES[link] for link in links], points, start, branch)
    for time, state in zip((0.5, 1.3, 2.0), states):
        # The errors of differences are width^2 times derivatives, and rounding over width^2, times
        # a Gamma of up to 10.
        np.testing.assert_allclose(trajectory.at(time)[0], state[0], atol=1e-9)
        np.testing.assert_allclose(trajectory.at(time)[1], state[1], atol=1e-6)
        np.testing.assert_allclose(trajectory.at(time)[2], state[2], atol=3e-6)
    np.testing.assert_allclose(end, pose(3.0), atol=1e-9)
    assert closure_error(mechanism, end) < 1e-15


@pytest.mark.parametrize(('link', 'holds'), [(0, 1), (1, 0), (2, 1), (3, 0)])
def test_one_link_moves_and_its_neighbour_holds(
    link: int, holds: int, uneven: Mechanism,
) -> None:
    present = assemble(uneven, *MOVING[0])
    name = LINK_NAMES[link]
    points = [Point([present[link] + 0.2], 2.0, [0.05]), Point([present[link] + 0.3], 4.0)]
    trajectory, end = read(uneven, [name], points)
    pose = assemble(uneven, *trajectory.at(2.0)[0])
    assert pose[link] == pytest.approx(present[link] + 0.2, abs=1e-9)
    assert pose[holds] == pytest.approx(present[holds], abs=1e-9)
    assert end[link] == pytest.approx(present[link] + 0.3, abs=1e-9)
    assert end[holds] == pytest.approx(present[holds], abs=1e-9)
    before, after = (assemble(uneven, *trajectory.at(2.0 + shift)[0])
                     for shift in (-1e-5, 1e-5))
    rates = (after - before) / 2e-5
    assert rates[link] == pytest.approx(0.05, abs=1e-8)
    assert rates[holds] == pytest.approx(0.0, abs=1e-8)


def test_links_take_the_shortest_path_between_points(paper: Mechanism) -> None:
    start = np.array([[2.9, 4.2], [0.0, 0.0], [0.0, 0.0]])
    angles = np.array([3.1, -3.0, -2.5, 3.0 + 4 * pi])
    points = [Point((angle, angle + 1.3), float(n + 1)) for n, angle in enumerate(angles)]
    _, end = read(paper, A_AND_B, points, start)
    # The steps of link b are 0.2, 0.183, 0.5 and -0.783.
    np.testing.assert_allclose(end, [3.0, 4.3, 3.0, 4.3 - 2 * pi], atol=1e-9)
    trajectory, _ = read(paper, A_AND_B, points[:3], start)
    np.testing.assert_allclose(trajectory.at(3.0)[0, 0], 2 * pi - 2.5, atol=1e-9)


def test_first_point_at_time_0_is_the_reference(paper: Mechanism, refuses: Refuses) -> None:
    there = Point((0.2005 + 2 * pi, 1.5), 0.0)
    rest = [Point((0.3, 1.6), 2.0), Point((0.4, 1.6), 4.0)]
    with_it, _ = read(paper, A_AND_B, [there, *rest])
    without, _ = read(paper, A_AND_B, rest)
    np.testing.assert_array_equal(with_it.states, without.states)
    with refuses(SetpointError, point=1, name='link_a', value=pytest.approx(0.202), limit=0.2):
        read(paper, A_AND_B, [Point((0.202, 1.5), 0.0), *rest])


# Change points

@pytest.mark.parametrize('names', [('link_a', 'link_b'), ('link_d', 'link_c'), ('link_b',)])
def test_trajectory_crosses_change_points_where_allowed(
    names: Sequence[str], paper: Mechanism, refuses: Refuses,
) -> None:
    """The trajectory passes theta = 0 twice, once at a point with a given rate."""
    start = np.array([[0.2, 0.8], [0.0, 0.0], [0.0, 0.0]])
    axes = [LINK_NAMES.index(name) % 2 for name in names]
    points = [Point([(0.2, angle)[axis] for axis in axes], time,
                    [(0.0, rate)[axis] for axis in axes])
              for angle, rate, time in ((0.2, -0.3, 2.0), (-0.4, 0.0, 4.0), (0.2, 0.0, 6.0))]
    trajectory, end = read(paper, names, points, start, crossing=True)
    np.testing.assert_allclose(trajectory.at(2.0)[:2], [[0.2, 0.2], [0.0, -0.3]], atol=1e-12)
    np.testing.assert_allclose(end, 0.2, atol=1e-12)
    with refuses(SetpointError, name='change_point'):
        read(paper, names, points, start)


# Refusals

GOOD = Point((0.3, 1.6), 1.0)


@pytest.mark.parametrize(('names', 'points', 'values'), [
    ([], [GOOD], {'kind': 'length'}),
    (['link_a', 'link_x'], [GOOD], {'kind': 'names'}),
    (['link_a', 'link_a'], [GOOD], {'kind': 'names'}),
    (A_AND_B, [], {'name': 'points', 'value': 0}),
    (A_AND_B, [GOOD] * (MAX_POINTS + 1), {'name': 'points', 'limit': (1, MAX_POINTS)}),
    (A_AND_B, [GOOD, Point((), 2.0)], {'point': 2, 'name': 'position', 'value': ()}),
    (A_AND_B, [GOOD, Point((0.3,), 2.0)], {'point': 2, 'name': 'position', 'value': (0.3,)}),
    (A_AND_B, [GOOD, Point((0.3, 1.6), 2.0, (0.0,))],
     {'point': 2, 'name': 'velocity', 'value': (0.0,)}),
    (A_AND_B, [Point((0.3, 1.6), 1.0, (0.0,) * 2, (0.0,) * 3)],
     {'point': 1, 'name': 'acceleration', 'value': (0.0,) * 3}),
    (A_AND_B, [Point((0.3, nan), 1.0)],
     {'point': 1, 'name': 'position', 'value': pytest.approx(nan, nan_ok=True)}),
    (A_AND_B, [Point((0.3, 1.6), 1.0, (inf, 0.0)), Point((0.3, 1.6), 2.0)],
     {'point': 1, 'name': 'velocity', 'value': inf}),
    (A_AND_B, [Point((0.3, 1.6), 1.0, (0.0, 0.0), (0.0, -inf)), Point((0.3, 1.6), 2.0)],
     {'point': 1, 'name': 'acceleration', 'value': -inf}),
    (A_AND_B, [Point((0.3, 1.6), nan)],
     {'point': 1, 'name': 'time', 'value': pytest.approx(nan, nan_ok=True)}),
    (A_AND_B, [Point((0.3, 1.6), -0.5)], {'point': 1, 'name': 'time', 'value': -0.5}),
    (A_AND_B, [GOOD, GOOD], {'point': 2, 'name': 'time', 'value': 1.0}),
    (A_AND_B, [GOOD, Point((0.3, 1.6), 0.5)], {'point': 2, 'name': 'time', 'value': 0.5}),
    (A_AND_B, [Point((0.3, 1.6), 1e-6)], {'point': 1, 'name': 'time', 'value': 1e-6}),
    (A_AND_B, [GOOD, Point((0.3, 1.6), 1.0 + 1e-6)], {'point': 2, 'name': 'time'}),
    (A_AND_B, [Point((0.2, 1.5), 0.0)], {'point': 1, 'name': 'time', 'value': 0.0}),
    (A_AND_B, [Point((0.3, 1.6), 1.0, (0.0, 0.1))],
     {'point': 1, 'name': 'velocity', 'value': 0.1}),
    (A_AND_B, [Point((0.3, 1.6), 1.0, (0.0, 0.0), (0.2, 0.0))],
     {'point': 1, 'name': 'acceleration', 'value': 0.2}),
    (A_AND_B, [Point((0.3, 1.6), 1.0, (), (0.0, 0.0))], {'point': 1, 'name': 'velocity'}),
    (A_AND_B, [GOOD, Point((0.3, 1.6), 2.0, effort=(0.0, 0.0))],
     {'point': 2, 'name': 'effort', 'value': (0.0, 0.0)}),
    (A_AND_B, [Point((0.3, 1.6), 1.0, (1e300, 0.0)), Point((0.3, 1.6), 2.0)], {'name': 'turn'}),
    (('link_a', 'link_b', 'link_c'), [Point((0.3, 1.6, 1.0), 1.0)],
     {'point': 1, 'name': 'link_c', 'limit': 1.0}),
    (('link_a', 'link_c'), [Point((0.3, 0.3), 1.0)],
     {'point': 1, 'names': ['link_a', 'link_c']}),
    (('link_a', 'link_b', 'link_c'),
     [Point((0.3, 1.6, 0.3), 1.0, (0.1, 0.0, 0.2)), Point((0.3, 1.6, 0.3), 2.0)],
     {'point': 1, 'name': 'velocity', 'link': 'link_c', 'value': pytest.approx(0.1),
      'limit': 0.2}),
])
def test_invalid_trajectory_is_refused_with_its_values(
    names: Sequence[str], points: Sequence[Any], values: dict[str, Any], paper: Mechanism,
    refuses: Refuses,
) -> None:
    with refuses(SetpointError, **values):
        read(paper, names, points)


def test_impossible_motion_is_refused(uneven: Mechanism, refuses: Refuses) -> None:
    other = assemble(uneven, 0.2, 1.5, 'crossed')
    with refuses(SetpointError, point=1):
        read(uneven, LINK_NAMES[:3], [Point(other[:3].tolist(), 1.0)])
    long = Mechanism(  # type: ignore[arg-type]
        [0.3, 0.3, 0.2, 0.2], [0.02] * 4, [2e-5] * 4, [[0.05, 0.0]] * 4, [3e-7] * 4)
    start = np.array([[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    with refuses(SetpointError, point=2):
        read(long, A_AND_B, [Point((0.0, 1.1), 1.0), Point((0.0, 2.5), 2.0)], start)
