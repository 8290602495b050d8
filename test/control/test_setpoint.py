# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Setpoints: goals of named links, refusals with name or value, paths, and change points."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from itertools import combinations
from math import inf, nan, pi
from typing import Any

from fourbar_ros.control import SetpointError
from fourbar_ros.control.branch import on_parallelogram
from fourbar_ros.control.setpoint import (
    check_names,
    ContradictionError,
    follow_path,
    plan,
)
from fourbar_ros.control.soft_step import SoftStep
from fourbar_ros.mechanism import (
    assemble,
    closure_error,
    ClosureError,
    LINK_NAMES,
    Mechanism,
)
from fourbar_ros.mechanism.change_points import PLANNING_MARGIN
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Drive = Callable[..., Any]
Refuses = Callable[..., AbstractContextManager[None]]
PAIRS = list(combinations(range(4), 2))


def names_of(*links: int) -> list[str]:
    return [LINK_NAMES[link] for link in links]


def refusal(driven: Any, goals: dict[str, float]) -> SetpointError:
    """Send a setpoint that must be refused, and return the error."""
    controller = driven.controller
    before = controller.mode, controller.goal, controller.accepted, controller.refused
    with pytest.raises(SetpointError) as caught:
        controller.setpoint(list(goals), list(goals.values()))
    assert (controller.mode, controller.goal, controller.accepted) == before[:3]
    assert controller.refused == before[3] + 1
    assert controller.last_refusal == str(caught.value)
    assert '\n' not in str(caught.value)
    return caught.value


def goal_of(driven: Any, goals: dict[str, float]) -> Array:
    driven.controller.setpoint(list(goals), list(goals.values()))
    goal: Array = driven.controller.goal
    return goal


# Names

@pytest.mark.parametrize(('names', 'positions', 'kind', 'part'), [
    ([], [], 'length', ''),
    (['link_a'], [], 'length', '0'),
    (['link_a'], [1.0, 2.0], 'length', '2'),
    (['link_a', 'link_x'], [1.0, 2.0], 'names', "'link_x'"),
    (['flywheel_a'], [1.0], 'names', "'flywheel_a'"),
    (['link_b', 'link_a', 'link_b'], [1.0, 2.0, 3.0], 'names', 'link_b'),
    (['link_a', 'link_c'], [0.0, nan], 'finite', 'link_c is nan'),
    (['link_d'], [-inf], 'finite', 'link_d is -inf'),
])
def test_invalid_names_are_refused(
    names: list[str], positions: list[float], kind: str, part: str,
) -> None:
    with pytest.raises(SetpointError) as caught:
        check_names(names, positions)
    assert caught.value.values['kind'] == kind
    assert part in str(caught.value)


def test_names_may_come_in_any_order() -> None:
    assert check_names(['link_d', 'link_a'], [1.0, 2.0]) == {3: 1.0, 0: 2.0}


# Goals

@pytest.mark.parametrize(('link', 'holds'), [(0, 1), (1, 0), (2, 1), (3, 0)])
@pytest.mark.parametrize('linkage', ['paper', 'uneven'])
def test_one_link_moves_and_its_neighbour_holds(
    link: int, holds: int, linkage: str, request: pytest.FixtureRequest, drive: Drive,
) -> None:
    mechanism = request.getfixturevalue(linkage)
    driven = drive(mechanism, 0.2, 1.5)
    present = driven.angles.copy()
    goal = goal_of(driven, {LINK_NAMES[link]: present[link] + 0.3})
    assert goal[link] == pytest.approx(present[link] + 0.3, abs=1e-9)
    assert goal[holds] == pytest.approx(present[holds], abs=1e-9)
    assert closure_error(mechanism, goal) < 1e-15


@pytest.mark.parametrize('pair', [pair for pair in PAIRS if pair not in ((0, 2), (1, 3))])
def test_neighbours_determine_the_rhombus(
    pair: tuple[int, int], drive: Drive, paper: Mechanism,
) -> None:
    driven = drive(paper, 0.2, 1.5)
    wanted = assemble(paper, 0.9, 1.8)
    goal = goal_of(driven, {LINK_NAMES[link]: float(wanted[link]) for link in pair})
    np.testing.assert_allclose(goal, wanted, atol=1e-9)


@pytest.mark.parametrize('pair', [(0, 2), (1, 3)])
def test_parallel_links_do_not_determine_the_rhombus(pair: tuple[int, int], drive: Drive) -> None:
    first, second = names_of(*pair)
    error = refusal(drive(), {first: 0.7, second: 0.7})
    assert isinstance(error, ContradictionError)
    assert error.values['names'] == [first, second]
    assert f'{first} = 0.7' in str(error)


@pytest.mark.parametrize('count', [3, 4])
def test_more_links_than_needed_must_agree(count: int, drive: Drive, uneven: Mechanism) -> None:
    driven = drive(uneven, 0.2, 1.5)
    wanted = assemble(uneven, 0.4, 1.8)
    goals = {LINK_NAMES[link]: float(wanted[link]) for link in range(count)}
    np.testing.assert_allclose(goal_of(driven, goals), wanted, atol=1e-9)
    last = LINK_NAMES[count - 1]
    goals[last] += 0.01
    error = refusal(driven, goals)
    assert isinstance(error, ContradictionError)
    assert error.values['name'] == last
    assert error.values['value'] == pytest.approx(wanted[count - 1], abs=1e-9)
    assert error.values['limit'] == pytest.approx(goals[last], abs=1e-9)


@pytest.mark.parametrize('turns', [-7, 0, 1, 3])
@pytest.mark.parametrize('start', [-20.0, 0.0, 3.0])
@pytest.mark.parametrize('turn', [0.1, 3.1, -3.1])
def test_links_take_the_shortest_path(
    turns: int, start: float, turn: float, drive: Drive, paper: Mechanism,
) -> None:
    """The whole turns by `turn`, for present and named angles on any turns."""
    driven = drive(paper, start, start + 1.2)
    present = driven.angles.copy()
    goal = goal_of(driven, {
        'link_a': start + turn + 2 * pi * turns, 'link_b': start + 1.2 + turn - 2 * pi * turns})
    np.testing.assert_allclose(goal, present + turn, atol=1e-9)


def test_moving_links_take_the_shortest_path_from_the_reference(drive: Drive) -> None:
    """A second setpoint during a move starts from the reference."""
    driven = drive(phi_a=0.0, phi_b=1.2)
    goal_of(driven, {'link_a': 2.0, 'link_b': 3.2})
    for _ in range(10):
        driven.tick()
    goal = goal_of(driven, {'link_a': 4.0, 'link_b': 5.2})
    np.testing.assert_allclose(goal[:2], [4.0, 5.2], atol=1e-9)


# Refusals

def test_angles_that_cannot_close_are_refused(drive: Drive) -> None:
    long = Mechanism(  # type: ignore[arg-type]
        [0.3, 0.3, 0.2, 0.2], [0.02] * 4, [2e-5] * 4, [[0.05, 0.0]] * 4, [3e-7] * 4)
    error = refusal(drive(long, 0.0, 1.0), {'link_a': 0.0, 'link_b': 2.5})
    assert error.values['name'] == 'closure'
    # Links of 0.2 m reach 0.4 m; links of 0.3 m at 2.5 rad need 0.6 sin(1.25).
    for part in ('link_b = 2.5000 rad', '0.4 m', '0.569'):
        assert part in str(error)


@pytest.mark.parametrize('goal', [0.05, 0.0, -0.5, pi + 0.5, pi - 0.05])
def test_change_point_on_the_path_is_refused(goal: float, drive: Drive) -> None:
    values = refusal(drive(phi_b=0.8), {'link_a': 0.0, 'link_b': goal}).values
    if goal != 0.0:
        assert (values['name'], values['limit']) == ('change_point', PLANNING_MARGIN)
        assert values['value'] < PLANNING_MARGIN


@pytest.mark.parametrize('theta', [0.02, 0.05, 0.09, -0.03, pi - 0.05])
def test_move_away_from_a_change_point_is_allowed(theta: float, drive: Drive) -> None:
    """A linkage too close to a change point can leave it."""
    driven = drive(phi_a=0.3, phi_b=0.3 + theta)
    outward = np.sign(np.sin(theta)) * np.sign(np.cos(theta)) * 0.5
    goal = goal_of(driven, {'link_b': 0.3 + theta + outward})
    assert goal[1] == pytest.approx(0.3 + theta + outward, abs=1e-9)


@pytest.mark.parametrize('theta', [0.02, 0.05, 0.09])
@pytest.mark.parametrize('turn', [0.0, 1.0])
def test_move_at_a_constant_distance_to_a_change_point_is_allowed(
    theta: float, turn: float, drive: Drive,
) -> None:
    """A turn of the whole, or no motion, is accepted in spite of rounding."""
    driven = drive(phi_a=0.3, phi_b=0.3 + theta)
    np.testing.assert_allclose(
        goal_of(driven, {'link_a': 0.3 + turn, 'link_b': 0.3 + turn + theta}),
        driven.angles + turn, atol=1e-9)


def test_move_closer_to_a_change_point_is_refused(drive: Drive) -> None:
    driven = drive(phi_a=0.3, phi_b=0.3 + 0.05)
    assert refusal(driven, {'link_b': 0.3 + 0.04}).values['name'] == 'change_point'


def test_other_branch_is_refused(drive: Drive, uneven: Mechanism) -> None:
    """The angle of link c exists only on the other branch, and the goal is not changed."""
    driven = drive(uneven, 0.2, 1.5)
    other = assemble(uneven, 0.2, 1.5, 'crossed')
    error = refusal(driven, {LINK_NAMES[link]: float(other[link]) for link in range(3)})
    assert error.values['name'] == 'link_c'


# Accepted goals

def random_linkage(rng: np.random.Generator) -> Mechanism:
    while True:
        lengths = rng.uniform(0.05, 0.15, 4)
        if 2.0 * lengths.max() < 0.95 * lengths.sum():
            return Mechanism(  # type: ignore[arg-type]
                lengths, [0.02] * 4, [2e-5] * 4, [[0.05, 0.0]] * 4, [3e-7] * 4)


def random_pose(rng: np.random.Generator, mechanism: Mechanism) -> tuple[float, float, str]:
    while True:
        phi_a, theta = rng.uniform(-pi, pi), rng.uniform(-pi, pi)
        branch = str(rng.choice(['open', 'crossed']))
        try:
            angles = assemble(mechanism, phi_a, phi_a + theta, branch)
        except ClosureError:
            continue
        if abs(np.sin(angles[3] - angles[2])) > 0.15:
            return phi_a, phi_a + theta, branch


def side_of_joint_3(angles: Array) -> float:
    return float(np.sign(np.sin(angles[3] - angles[2])))


@pytest.mark.medium
@pytest.mark.parametrize('pair', PAIRS, ids=lambda pair: '-'.join(names_of(*pair)))
def test_accepted_goal_has_the_named_angles(pair: tuple[int, int], drive: Drive) -> None:
    """For any linkage and pose the goal has both named angles, and the loop closes."""
    accepted = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        mechanism = random_linkage(rng)
        driven = drive(mechanism, *random_pose(rng, mechanism))
        present = driven.angles.copy()
        named = {link: float(present[link] + rng.uniform(-0.8, 0.8)) for link in pair}
        try:
            goal = goal_of(driven, {LINK_NAMES[link]: angle for link, angle in named.items()})
        except SetpointError:
            continue
        accepted += 1
        assert closure_error(mechanism, goal) < 1e-14, f'seed {seed}'
        # Joint 3 stays on its side of the diagonal, since there is no change point.
        assert side_of_joint_3(goal) == side_of_joint_3(present), f'seed {seed}'
        for link, angle in named.items():
            off = (goal[link] - angle + pi) % (2.0 * pi) - pi
            assert abs(off) < 1e-9, f'seed {seed}, {LINK_NAMES[link]}'
    assert accepted > 20


# Paths

def from_rest(mechanism: Mechanism, angles: Array, goals: dict[int, float], **options: bool
              ) -> tuple[SoftStep, Array]:
    start = np.array([angles[:2], [0.0, 0.0], [0.0, 0.0]])
    return plan(mechanism, goals, start, angles, angles, 10.0, **options)


def rhombus(phi_a: float, theta: float) -> Array:
    return np.array([phi_a, phi_a + theta, phi_a, phi_a + theta])


def degrees(*angles: float) -> Any:
    return pytest.approx(np.radians(angles), abs=1e-9)


@pytest.mark.parametrize(('theta', 'goal', 'end'), [
    (60.0, (100.0, -90.0), (100.0, 270.0)),     # not by -150, which moves theta through 0
    (60.0, (-170.0, -30.0), (-170.0, -30.0)),   # the shortest path has no change point
    (60.0, (170.0, -70.0), (-190.0, -70.0)),    # a by -190 and b by -130, not a by 170
])
def test_configuration_takes_the_path_without_change_points(
    theta: float, goal: tuple[float, float], end: tuple[float, float], paper: Mechanism,
) -> None:
    start = rhombus(0.0, np.radians(theta))
    _, reached = from_rest(paper, start, dict(enumerate(np.radians(goal).tolist())))
    assert reached == degrees(*end, *end)


@pytest.mark.parametrize(('pair', 'goals'), [
    ((0, 1), (100.0, -90.0)), ((2, 1), (100.0, -90.0)), ((0, 3), (100.0, -90.0)),
    ((2, 3), (100.0, -90.0))])
def test_opposite_links_are_equivalent(
    pair: tuple[int, int], goals: tuple[float, float], paper: Mechanism,
) -> None:
    _, reached = from_rest(
        paper, rhombus(0.0, pi / 3), dict(zip(pair, np.radians(goals).tolist())))
    assert reached == degrees(100.0, 270.0, 100.0, 270.0)


def passes_change_point(begin: float, end: float) -> bool:
    """Return whether theta comes closer to a change point than the margin between two values."""
    low, high = min(begin, end), max(begin, end)
    multiple = np.ceil((low - np.arcsin(PLANNING_MARGIN)) / pi) * pi
    return bool(multiple - np.arcsin(PLANNING_MARGIN) < high)


@pytest.mark.parametrize('seed', range(300))
def test_accepted_path_is_the_shortest_without_change_points(
    seed: int, paper: Mechanism, refuses: Refuses,
) -> None:
    """The test covers any start and goal on a rhombus; theta is monotonic."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.15, pi - 0.15) + pi * rng.integers(-2, 3)
    angles = rhombus(rng.uniform(-10.0, 10.0), theta)
    goals = rng.uniform(-pi, pi, 2)
    shortest = (goals - angles[:2] + pi) % (2.0 * pi) - pi
    ways = sorted(((shortest[0] + 2 * pi * i, shortest[1] + 2 * pi * j)
                   for i in (-1, 0, 1) for j in (-1, 0, 1)), key=lambda way: np.hypot(*way))
    kept = [way for way in ways if not passes_change_point(theta, theta + way[1] - way[0])]
    for crossing in (False, True):
        if not kept and not crossing:
            with refuses(SetpointError, name='change_point', limit=PLANNING_MARGIN):
                from_rest(paper, angles, dict(enumerate(goals.tolist())))
            continue
        _, reached = from_rest(
            paper, angles, dict(enumerate(goals.tolist())), crossing=crossing)
        np.testing.assert_allclose(
            reached[:2] - angles[:2], (kept or ways)[0], atol=1e-9, err_msg=f'seed {seed}')


def test_no_path_skips_a_change_point_between_two_samples(
    paper: Mechanism, refuses: Refuses,
) -> None:
    """At 0.02 rad from a change point the margin is small at the start, and large at the next."""
    angles = rhombus(0.0, 0.02)
    for turn in (pi + 0.5, 2 * pi + 0.5, 4 * pi + 0.5):
        move = SoftStep(np.array([angles[:2], [0.0] * 2, [0.0] * 2]),
                        np.array([0.0, turn]), 10.0)
        with refuses(SetpointError, name='change_point', limit=PLANNING_MARGIN):
            follow_path(paper, move, angles)


# Change points

@pytest.fixture(scope='module')
def parallelogram() -> Mechanism:
    """Make a parallelogram whose only equal parameters are opposite lengths."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.12, 0.08], [0.02, 0.03, 0.025, 0.018], [2.2e-5, 1.5e-5, 3e-5, 1.8e-5],
        [[0.05, 0.01], [0.04, -0.01], [0.06, 0.005], [0.05, 0.0]], [3e-7, 4e-7, 5e-7, 2e-7])


@pytest.mark.parametrize('theta', [0.0, pi, 0.4, -2.0, 1e-3, pi - 1e-3])
@pytest.mark.parametrize('turns', [0, 2])
def test_parallelogram_is_recognised(
    theta: float, turns: int, paper: Mechanism, parallelogram: Mechanism, uneven: Mechanism,
) -> None:
    angles = rhombus(0.3, theta) + 2.0 * pi * turns * np.array([0, 0, 1, -1])
    assert on_parallelogram(paper, angles)
    assert on_parallelogram(parallelogram, angles)
    assert not on_parallelogram(uneven, angles)
    assert not on_parallelogram(paper, angles + [0.0, 0.0, 0.02, 0.0])


@pytest.mark.parametrize('theta', [0.4, -2.0])
def test_other_branch_is_no_parallelogram(theta: float, parallelogram: Mechanism) -> None:
    assert on_parallelogram(parallelogram, assemble(parallelogram, 0.3, 0.3 + theta, 'open'))
    assert not on_parallelogram(
        parallelogram, assemble(parallelogram, 0.3, 0.3 + theta, 'crossed'))


@pytest.mark.parametrize('goal', [0.0, -0.5, pi, pi + 0.6, 0.01])
@pytest.mark.parametrize('start', [0.8, 0.0, pi, -0.02])
@pytest.mark.parametrize('names', [(1,), (3,), (0, 1), (2, 3), (1, 2), (0, 3), (0, 1, 2),
                                   (0, 2, 3), (0, 1, 2, 3)], ids=lambda links: str(links))
def test_path_crosses_and_ends_at_change_points_where_allowed(
    goal: float, start: float, names: tuple[int, ...], paper: Mechanism,
    parallelogram: Mechanism,
) -> None:
    """Opposite links stay parallel for any start and goal, also at a change point."""
    for mechanism in (paper, parallelogram):
        angles, wanted = rhombus(0.3, start), rhombus(0.3, goal)
        move, reached = from_rest(
            mechanism, angles, {link: float(wanted[link]) for link in names}, crossing=True)
        assert np.abs(np.exp(1j * reached) - np.exp(1j * wanted)).max() < 1e-9
        segment = follow_path(mechanism, move, angles, crossing=True)
        np.testing.assert_array_equal(segment[:, 2:], segment[:, :2])
        np.testing.assert_allclose(segment[[0, -1]], [angles, reached], atol=1e-12)
        assert max(closure_error(mechanism, pose) for pose in segment) < 1e-16
        # Steps of the path are small enough for the closure to follow.
        assert np.abs(np.diff(segment, axis=0)).max() < 0.035


@pytest.mark.parametrize('theta', [0.0, pi])
@pytest.mark.parametrize('crossing', [False, True])
def test_whole_may_turn_at_a_change_point_and_leave_it(
    theta: float, crossing: bool, paper: Mechanism,
) -> None:
    angles = rhombus(0.3, theta)
    for goals in ({0: 1.0, 1: 1.0 + theta}, {0: 0.3, 1: 0.3 + theta + 0.7},
                  {2: 0.3, 3: 0.3 + theta - 0.7}):
        _, reached = from_rest(paper, angles, dict(goals), crossing=crossing)
        for link, angle in goals.items():
            assert np.exp(1j * reached[link]) == pytest.approx(np.exp(1j * angle), abs=1e-9)
        np.testing.assert_array_equal(reached[2:], reached[:2])


def test_crossing_is_refused_where_no_branch_leads_through(
    paper: Mechanism, parallelogram: Mechanism, refuses: Refuses,
) -> None:
    kite = Mechanism(  # type: ignore[arg-type]
        [0.1, 0.1, 0.1 + 1e-4, 0.1 + 1e-4], [0.02] * 4, [2e-5] * 4, [[0.05, 0.0]] * 4, [3e-7] * 4)
    goals = {0: 0.0, 1: -0.5}
    with refuses(SetpointError, needed='parallelogram'):
        from_rest(kite, assemble(kite, 0.0, 0.8), dict(goals), crossing=True)
    crossed = assemble(parallelogram, 0.0, 0.8, 'crossed')
    with refuses(SetpointError, needed='parallelogram_branch'):
        from_rest(parallelogram, crossed, dict(goals), crossing=True)
    with refuses(SetpointError, name='change_point', needed=None):
        from_rest(paper, rhombus(0.0, 0.8), dict(goals))


def test_named_links_that_contradict_each_other_are_refused_when_crossing(
    paper: Mechanism, refuses: Refuses,
) -> None:
    with refuses(ContradictionError, name='link_c', value=pytest.approx(0.7), limit=0.9):
        from_rest(paper, rhombus(0.0, 0.8), {0: 0.7, 1: 0.2, 2: 0.9}, crossing=True)
    with refuses(ContradictionError, names=['link_b', 'link_d']):
        from_rest(paper, rhombus(0.0, 0.0), {1: 0.7, 3: 0.7}, crossing=True)


def test_motion_too_large_to_check_is_refused(
    paper: Mechanism, refuses: Refuses,
) -> None:
    angles = rhombus(0.0, 1.0)
    wild = SoftStep(np.array([angles[:2], [1e6, 1e6], [0.0, 0.0]]), angles[:2], 10.0)
    with refuses(SetpointError, name='turn'):
        follow_path(paper, wild, angles)
