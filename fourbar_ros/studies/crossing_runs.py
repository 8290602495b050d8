# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Runs of the crossing study: one closed loop each, and whether it got where it was sent.

A run passes when the linkage ends within `NEAR_GOAL` of its goal with opposite links parallel, the
device still armed and nothing refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, pi, radians

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop import load_scenario, Scenario, ScriptedSetpoint
from fourbar_ros.loop.run import make_loop, run_scenario
from fourbar_ros.mechanism import LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant import InitialState
import numpy as np

# How far from its goal a link may end [rad].
NEAR_GOAL = radians(1.0)

# Of what is drawn for a run: wheel inertias are as wrong as this, friction differs so much from
# that of the table, both as shares, evenly distributed.
INERTIA_SPREAD = 0.05
FRICTION_SPREAD = 0.2

# Damping of joints that give [N s/m]: a twentieth of critical for a link of the prototype.
JOINT_DAMPING = 5.0

# By how much the loop may fail to close for joints that give, as the estimator is told [m].
GIVES = 1e-4

# The path of a run is kept at every so many ticks.
PATH_EVERY = 25

METHODS = ('four_held', 'four', 'two')
"""Four wheels with feedback on eta, four without, two wheels."""


@dataclass(frozen=True)
class Crossing:
    """
    A manoeuvre at theta = 0 and what makes it hard.

    :param script: (at [s], link a, link b [rad], duration [s]) of each setpoint.
    :param theta: initial angle between links a and b [rad].
    :param duration: of the run [s].
    :param mismatch: by how much a link is too long or too short, as a share of its length.
    :param stiffness: of the joints, inf where they are rigid [N/m].
    """

    script: tuple[tuple[float, float, float, float], ...]
    theta: float
    duration: float
    mismatch: float = 0.0
    stiffness: float = float('inf')


@dataclass(frozen=True)
class Run:
    """
    What is run.

    :param crossing: the manoeuvre.
    :param method: one of `METHODS`.
    :param seed: of everything that is drawn.
    """

    crossing: Crossing
    method: str
    seed: int


@dataclass(frozen=True, eq=False)
class Passage:
    """
    What came of a run.

    :param passed: whether it got there on the parallelogram branch.
    :param error: largest distance from the goal at the end [rad], inf if it never came there.
    :param apart: largest |phi_c - phi_a| on the way [rad].
    :param torque: largest torque of a motor on the way [N m].
    :param reason: why it failed, or ''.
    :param path: (n, 2) theta and eta on the way, a few times a second [rad].
    """

    passed: bool
    error: float
    apart: float
    torque: float
    reason: str
    path: Array


def go(run: Run) -> Passage:
    """Make a run; whatever goes wrong is a failure of it."""
    scenario = scenario_of(run)
    angles, torque = [], 0.0
    reason = ''
    try:
        loop = make_loop(scenario)
        for step in run_scenario(scenario, loop):
            truth = step.samples.truth
            assert truth is not None
            angles.append(truth.link_angles)
            torque = max(torque, float(np.abs(truth.efforts).max()))
        if not loop.supervisor.arming.armed:
            reason = loop.supervisor.arming.reason
    except FourbarError as failure:
        reason = str(failure)
    way = np.reshape(angles, (-1, 4))
    eta = wrap_angles(way[:, 2] - way[:, 0])
    goal = np.array([scenario.setpoints[-1].positions] * 2).ravel()
    error = float(np.abs(wrap_angles(way[-1] - goal)).max()) if len(way) else inf
    # Written so that NaN fails.
    if not reason and not error <= NEAR_GOAL:
        reason = 'elsewhere'
    path = np.column_stack([way[:, 1] - way[:, 0], eta])[::PATH_EVERY]
    return Passage(
        not reason, error, float(np.abs(eta).max(initial=0.0)), torque, reason, path)


def scenario_of(run: Run) -> Scenario:
    """Draw what a run needs, the same for every method."""
    crossing = run.crossing
    rng = np.random.default_rng(run.seed)
    base = load_scenario('prototype')
    believed = base.model
    inertias = believed.flywheel_inertias * (
        1.0 + rng.uniform(-INERTIA_SPREAD, INERTIA_SPREAD, 4))
    lengths = believed.link_lengths.copy()
    lengths[int(rng.integers(4))] *= 1.0 + crossing.mismatch * float(rng.choice([-1.0, 1.0]))
    joints, bearings = 1.0 + rng.uniform(-FRICTION_SPREAD, FRICTION_SPREAD, 2)
    table = replace(
        base.table,
        joints=replace(base.table.joints, coulomb=base.table.joints.coulomb * joints),
        wheel_bearings=replace(
            base.table.wheel_bearings, coulomb=base.table.wheel_bearings.coulomb * bearings))
    mechanism = replace(believed, flywheel_inertias=inertias, link_lengths=lengths)
    if np.isfinite(crossing.stiffness):
        mechanism = _giving(mechanism, crossing.stiffness)
        believed = _giving(believed, crossing.stiffness)
    tolerance = crossing.mismatch * float(believed.link_lengths.mean())
    if np.isfinite(crossing.stiffness):
        tolerance = max(tolerance, GIVES)
    controller = replace(
        base.controller, change_points='keep',
        allocation='two_wheels' if run.method == 'two' else base.controller.allocation,
        branch_bandwidth=base.controller.branch_bandwidth if run.method == 'four_held' else 0.0)
    heading = float(rng.uniform(-pi, pi))
    setpoints = tuple(
        ScriptedSetpoint(at, LINK_NAMES[:2], (heading + phi_a, heading + phi_b), duration)
        for at, phi_a, phi_b, duration in crossing.script)
    return replace(
        base, mechanism=mechanism, model=believed, table=table,
        initial=InitialState(heading, heading + crossing.theta), controller=controller,
        estimator=replace(base.estimator, closure_tolerance=tolerance), setpoints=setpoints,
        duration=crossing.duration, seed=run.seed)


def _giving(mechanism: Mechanism, stiffness: float) -> Mechanism:
    return replace(mechanism, joint_stiffness=np.full(4, stiffness),
                   joint_damping=np.full(4, JOINT_DAMPING))
