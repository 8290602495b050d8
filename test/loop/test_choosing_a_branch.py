# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The prototype leaves a change point on the branch that a setpoint names, and returns.

The joints are compliant. With rigid joints a linkage changes the branch only if the angle between
the pairs is exactly zero, which the wheels cannot achieve (docs/mechanics.md).
"""

from __future__ import annotations

from dataclasses import replace
from math import pi, radians

from fourbar_ros.control.branch import Branch, CROSSED, FOLDED, PARALLELOGRAM
from fourbar_ros.loop import load_scenario, make_loop, run_scenario, ScriptedSetpoint
from fourbar_ros.mechanism import LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.plant import InitialState
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

SEEDS = range(5)

# Stiffness [N/m] and damping [N s/m] of each joint, and closure tolerance of the estimator [m].
STIFFNESS, DAMPING = 1e4, 5.0
CLOSURE = 1e-4

DURATION, REST, BEGIN, RATE = 4.0, 1.5, 0.4, 250.0
OPENED = radians(30.0)
LARGEST_ERROR = 0.5


def compliant(mechanism: Mechanism) -> Mechanism:
    return replace(mechanism, joint_stiffness=np.full(4, STIFFNESS),
                   joint_damping=np.full(4, DAMPING))


def pose(branch: Branch, heading: float, theta: float) -> tuple[float, ...]:
    path = np.array([heading, heading + theta])
    return tuple(branch.to_links(path, np.full(2, branch.pair_angle)).tolist())


@pytest.mark.slow
@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize(('theta', 'other'), [(0.0, FOLDED), (pi, CROSSED)],
                         ids=['folded', 'crossed'])
def test_linkage_moves_on_the_named_branch_and_back(
    theta: float, other: Branch, seed: int,
) -> None:
    """With friction, noise, latency and dropout all links rest within 0.5 deg of each goal."""
    base = load_scenario('prototype')
    heading = float(np.random.default_rng(seed).uniform(-pi, pi))
    inside = 0.6 if theta == 0.0 else pi - 0.6
    goals = (pose(PARALLELOGRAM, heading, theta), pose(other, heading, theta + OPENED),
             pose(other, heading, theta), pose(PARALLELOGRAM, heading, inside))
    begins = [BEGIN + number * (DURATION + REST) for number in range(len(goals))]
    scenario = replace(
        base, mechanism=compliant(base.mechanism), model=compliant(base.model), seed=seed,
        initial=InitialState(heading, heading + inside),
        estimator=replace(base.estimator, closure_tolerance=CLOSURE),
        controller=replace(base.controller, change_points='choose'),
        setpoints=tuple(ScriptedSetpoint(at, LINK_NAMES, goal, DURATION)
                        for at, goal in zip(begins, goals)),
        duration=begins[-1] + DURATION + REST)
    loop = make_loop(scenario)
    angles, branches = [], []
    for step in run_scenario(scenario, loop):
        assert step.samples.truth is not None
        angles.append(step.samples.truth.link_angles)
        branches.append(loop.controller.branch)
    assert loop.supervisor.arming.armed
    ends = [round((at + DURATION + REST - 0.1) * RATE) for at in begins]
    errors = np.degrees([wrap_angles(angles[end] - np.array(goal))
                         for end, goal in zip(ends, goals)])
    assert np.abs(errors).max() < LARGEST_ERROR, f'seed {seed}: {errors}'
    assert [branches[end] for end in ends] == [
        'parallelogram', other.name, other.name, 'parallelogram'], f'seed {seed}'
