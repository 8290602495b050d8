# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Branches: closure, names, projection, and change points where two branches meet."""

from __future__ import annotations

from math import pi

from fourbar_ros.control.branch import (
    adjoining_branch,
    Branch,
    branch_at,
    BRANCHES,
    CROSSED,
    FOLDED,
    on_parallelogram,
    PARALLELOGRAM,
)
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.closure import branch_of, closure_error
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

SEEDS = range(10)

each_seed = pytest.mark.parametrize('seed', SEEDS)
each_branch = pytest.mark.parametrize('branch', BRANCHES, ids=lambda branch: branch.name)

# Pairs of branches that meet, each with the angle between its pairs.
MEETINGS = (
    (PARALLELOGRAM, 0.0, FOLDED, 0.0), (PARALLELOGRAM, pi, CROSSED, pi),
    (FOLDED, pi, CROSSED, 0.0),
)


def pose(branch: Branch, heading: float, theta: float) -> Array:
    return branch.to_links(np.array([heading, heading + theta]), np.full(2, branch.pair_angle))


@each_branch
@each_seed
def test_loop_closes_on_the_whole_branch(seed: int, branch: Branch, paper: Mechanism) -> None:
    """Angles and rates of the links meet the closure for any motion of the pairs."""
    rng = np.random.default_rng(seed)
    angles = pose(branch, *rng.uniform(-3.0, 3.0, 2))
    rates = branch.to_links(rng.uniform(-1.0, 1.0, 2), np.zeros(2))
    assert closure_error(paper, angles) < 1e-15, f'seed {seed}'
    arms = np.array([-1.0, 1.0, 1.0, -1.0]) * paper.link_lengths
    assert abs((arms * rates) @ np.exp(1j * angles)) < 1e-15, f'seed {seed}'


@each_branch
def test_name_agrees_with_the_closure(branch: Branch) -> None:
    names = {'parallelogram': 'open'}
    assert branch_of(pose(branch, 0.3, 0.9)) == names.get(branch.name, branch.name)


@each_branch
@each_seed
def test_branch_is_found_from_noisy_angles(seed: int, branch: Branch, paper: Mechanism) -> None:
    rng = np.random.default_rng(seed)
    exact = pose(branch, 0.4, rng.uniform(0.1, pi - 0.1)) + 2.0 * pi * rng.integers(-2, 3, 4)
    measured = exact + rng.uniform(-4e-3, 4e-3, 4)
    assert branch_at(paper, measured, any_branch=True) == branch, f'seed {seed}'
    near = branch.nearest(measured)
    # The projection is on the branch and the same turns; its error is at most that of the angles.
    assert closure_error(paper, near) < 1e-15
    assert np.abs(near - exact).max() <= 4e-3
    off = measured - near
    np.testing.assert_allclose(off[branch.axes], -off[branch.followers], atol=1e-14)


@pytest.mark.parametrize(('one', 'theta', 'other', 'theta_there'), MEETINGS)
def test_two_branches_meet_where_all_links_are_in_line(
    one: Branch, theta: float, other: Branch, theta_there: float, paper: Mechanism,
    parallelogram: Mechanism,
) -> None:
    angles = pose(one, 0.3, theta)
    assert np.abs(wrap_angles(angles - pose(other, 0.3, theta_there))).max() < 1e-14
    assert adjoining_branch(paper, one, angles) == other
    assert adjoining_branch(paper, other, angles) == one
    assert adjoining_branch(paper, one, pose(one, 0.3, theta + 2e-3)) is None
    assert adjoining_branch(parallelogram, PARALLELOGRAM, angles) is None


def test_only_a_rhombus_has_all_branches(paper: Mechanism, parallelogram: Mechanism) -> None:
    for branch in BRANCHES[1:]:
        angles = pose(branch, 0.3, 0.9)
        assert branch_at(paper, angles) is None
        assert branch_at(paper, angles, any_branch=True) == branch
        assert branch_at(parallelogram, angles, any_branch=True) is None
    assert on_parallelogram(parallelogram, pose(PARALLELOGRAM, 0.3, 0.9))
