# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Setpoints on another branch are accepted at a change point, and nowhere else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from math import pi
from typing import Any

from fourbar_ros.control import SetpointError
from fourbar_ros.control.setpoint import ContradictionError
from fourbar_ros.control.trajectory import Point
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.closure import closure_error
import numpy as np
import pytest

Drive = Callable[..., Any]
Refuses = Callable[..., AbstractContextManager[None]]

ALL = ('link_a', 'link_b', 'link_c', 'link_d')
PERIOD = 4e-3


def standing(drive: Drive, theta: float = 0.0, **settings: Any) -> Any:
    """Make a controller at rest on the parallelogram branch."""
    driven = drive(armed=False, **settings)
    driven.angles = np.array([0.0, theta, 0.0, theta])
    driven.controller.device_armed(True)
    driven.tick()
    return driven


def go(driven: Any, names: Sequence[str], positions: Sequence[float]) -> None:
    """Run a move to its end; check closure and continuity of the reference."""
    driven.controller.setpoint(names, positions)
    before = driven.angles
    for _ in range(round(driven.controller.settings.setpoint_duration / PERIOD) + 2):
        angles = driven.tick().reference_angles
        # The bound is the peak rate of half a turn in 2 s, and the step at the change of branch.
        assert np.abs(angles - before).max() < 1e-3 + 1.875 * pi / 2.0 * PERIOD
        assert closure_error(driven.controller.mechanism, angles) < 1e-14
        before = angles
    assert driven.controller.mode == 'hold'


@pytest.mark.medium
@pytest.mark.parametrize('names', [ALL, ('link_a', 'link_c'), ('link_b', 'link_d')])
def test_out_on_the_folded_branch_and_back(names: Sequence[str], drive: Drive) -> None:
    """Two named links suffice if they determine the branch."""
    driven = standing(drive, 0.0, change_points='choose', setpoint_duration=2.0)
    assert driven.controller.branch == 'parallelogram'
    goal = dict(zip(ALL, (0.1, 0.1, 0.6, 0.6)))
    go(driven, names, [goal[name] for name in names])
    assert driven.controller.branch == 'folded'
    np.testing.assert_allclose(driven.angles, [0.1, 0.1, 0.6, 0.6], atol=1e-12)
    # On the branch, one named link turns its pair.
    go(driven, ['link_d'], [0.4])
    np.testing.assert_allclose(driven.angles, [0.1, 0.1, 0.4, 0.4], atol=1e-12)
    go(driven, ['link_c', 'link_b'], [0.2, 0.2])
    np.testing.assert_allclose(driven.angles, np.full(4, 0.2), atol=1e-12)
    go(driven, ALL, (0.2, 0.5, 0.2, 0.5))
    assert driven.controller.branch == 'parallelogram'
    np.testing.assert_allclose(driven.angles, [0.2, 0.5, 0.2, 0.5], atol=1e-12)


@pytest.mark.medium
def test_round_through_all_three_branches(drive: Drive) -> None:
    """The way is parallelogram, folded, crossed and back through the change points."""
    driven = standing(drive, 0.0, change_points='choose', setpoint_duration=4.0)
    go(driven, ALL, (0.0, 0.0, 1.0, 1.0))
    go(driven, ALL, (0.0, 0.0, pi, pi))
    assert driven.controller.branch == 'folded'
    go(driven, ALL, (0.0, 1.0, 1.0 + pi, pi))
    assert driven.controller.branch == 'crossed'
    go(driven, ALL, (0.0, pi, 2.0 * pi, pi))
    go(driven, ALL, (0.0, 2.0, 0.0, 2.0))
    assert driven.controller.branch == 'parallelogram'
    np.testing.assert_allclose(wrap_angles(driven.angles - np.array([0, 2, 0, 2])), 0.0,
                               atol=1e-9)


def test_setpoint_on_the_present_branch_stays_on_it(drive: Drive) -> None:
    """The setpoints name a single link, or two links with equal angles on both branches."""
    for names, positions in ((['link_c'], [0.5]), (['link_a', 'link_d'], [0.0, 0.5])):
        driven = standing(drive, 0.0, change_points='choose', setpoint_duration=2.0)
        go(driven, names, positions)
        assert driven.controller.branch == 'parallelogram'


@pytest.mark.parametrize(('change_points', 'theta', 'names', 'positions', 'values'), [
    ('keep', 0.0, ('link_a', 'link_c'), (0.0, 0.5), {'branch': 'folded'}),
    ('keep', pi, ALL, (0.0, pi + 0.5, 0.5, pi), {'branch': 'crossed'}),
    ('choose', 0.0, ALL, (0.0, 0.2, 0.5, 0.5), {'condition': '', 'limit': 0.5}),
    ('choose', 0.0, ('link_a', 'link_c'), (0.3, 0.3),
     {'condition': '', 'names': ['link_a', 'link_c']}),
    ('choose', 0.5, ('link_a', 'link_c'), (0.0, 0.5), {'condition': 'rest_at_change_point'}),
    ('choose', 2e-3, ('link_a', 'link_c'), (0.0, 0.5), {'condition': 'rest_at_change_point'}),
], ids=range(6))
def test_other_branch_is_refused_with_the_reason(
    change_points: str, theta: float, names: Sequence[str], positions: Sequence[float],
    values: dict[str, Any], drive: Drive, refuses: Refuses,
) -> None:
    driven = standing(drive, theta, change_points=change_points)
    before = driven.tick().reference_angles
    with refuses(ContradictionError, **values):
        driven.controller.setpoint(names, positions)
    assert driven.controller.branch == 'parallelogram'
    assert driven.controller.last_refusal
    np.testing.assert_array_equal(driven.tick().reference_angles, before)


def test_other_branch_is_refused_during_a_move(drive: Drive, refuses: Refuses) -> None:
    driven = standing(drive, -0.5, change_points='choose', setpoint_duration=4.0)
    driven.controller.setpoint(['link_b'], [0.5])
    for _ in range(500):
        control = driven.tick()
    assert abs(control.reference_angles[1]) < 1e-2
    with refuses(ContradictionError, condition='rest_at_change_point'):
        driven.controller.setpoint(['link_a', 'link_c'], [0.0, 0.5])


def test_on_the_folded_branch_links_of_a_pair_do_not_come_apart(
    drive: Drive, refuses: Refuses,
) -> None:
    driven = standing(drive, 0.0, change_points='choose', setpoint_duration=2.0)
    go(driven, ALL, (0.0, 0.0, 0.5, 0.5))
    with refuses(ContradictionError, names=['link_a', 'link_b']):
        driven.controller.setpoint(['link_a', 'link_b'], [0.0, 0.5])


def test_links_of_two_lengths_have_no_other_branch(
    drive: Drive, parallelogram: Mechanism, refuses: Refuses,
) -> None:
    driven = standing(drive, mechanism=parallelogram, change_points='choose')
    with refuses(ContradictionError, condition='rhombus'):
        driven.controller.setpoint(['link_a', 'link_c'], [0.0, 0.5])


def test_demand_beyond_the_limits_is_refused_on_a_branch(drive: Drive) -> None:
    driven = standing(drive, 0.0, change_points='choose', setpoint_duration=0.1)
    with pytest.raises(SetpointError) as caught:
        driven.controller.setpoint(['link_a', 'link_c'], [0.0, 1.0])
    assert caught.value.values['value'] > caught.value.values['limit']
    assert driven.controller.branch == 'parallelogram'
    driven = standing(drive, 0.0, change_points='choose', setpoint_timing='shortest')
    driven.controller.setpoint(['link_a', 'link_c'], [0.0, 1.0])
    assert driven.controller.branch == 'folded'


def test_trajectories_follow_the_branch(drive: Drive) -> None:
    """Named rates are those of the pair; the pair without a named link holds."""
    driven = standing(drive, 0.0, change_points='choose', setpoint_duration=2.0)
    go(driven, ALL, (0.0, 0.0, 0.5, 0.5))
    driven.controller.trajectory(
        ['link_d'], [Point([0.7], 2.0, [0.1]), Point([0.9], 4.0)])
    for tick in range(1002):
        control = driven.tick()
        assert closure_error(driven.controller.mechanism, control.reference_angles) < 1e-14
        if abs(tick - 500) <= 1:
            # The tick may be off by one; the acceleration is 1 rad/s^2.
            np.testing.assert_allclose(control.reference_rates, [0.0, 0.0, 0.1, 0.1], atol=PERIOD)
    np.testing.assert_allclose(driven.angles, [0.0, 0.0, 0.9, 0.9], atol=1e-12)


def test_controller_armed_on_another_branch_holds_there(drive: Drive) -> None:
    """It holds by the branch with `select_branch`, and by the reduced form otherwise."""
    for change_points, branch in (('choose', 'crossed'), ('keep', 'crossed')):
        driven = drive(phi_b=1.0, branch='crossed', change_points=change_points)
        assert driven.controller.branch == branch
        before = driven.angles
        np.testing.assert_allclose(driven.tick().reference_angles, before, atol=1e-12)
