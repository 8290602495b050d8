# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Runs of the crossing study: manoeuvres at a change point, one closed loop each, and their outcome.

A run passes when all links end within `GOAL_TOLERANCE` of their goal, so that opposite links are
parallel, the device is still armed and the controller refused nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, pi, radians

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop import load_scenario, Scenario, ScriptedSetpoint
from fourbar_ros.loop.run import make_loop, run_scenario
from fourbar_ros.mechanism import LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant import InitialState
import numpy as np
from scipy.stats import binomtest

# Largest distance of a link from its goal at the end of a run that passes [rad].
GOAL_TOLERANCE = radians(1.0)
# Half width of the uniform distribution of wheel inertias, relative to the model's.
INERTIA_SPREAD = 0.05
# Half width of the uniform distribution of Coulomb friction, relative to the table's.
FRICTION_SPREAD = 0.2
# Damping of compliant joints, a twentieth of critical for a link of the prototype [N s/m].
JOINT_DAMPING = 5.0
# Closure tolerance of the estimator for compliant joints [m].
COMPLIANCE_TOLERANCE = 1e-4
# Number of ticks between two stored points of a path.
PATH_PERIOD = 25

# Relative error of a link length in the slow crossing.
MISMATCH = 1e-3
# Stiffness of compliant joints [N/m].
STIFFNESS = 1e4

# Titles of the methods: four wheels with feedback of eta, four without, two wheels.
METHODS = {'four_held': 'four wheels, eta fed back', 'four': 'four wheels', 'two': 'two wheels'}


@dataclass(frozen=True)
class Manoeuvre:
    """
    A manoeuvre at theta = 0 and its difficulties.

    :param script: (at [s], link a, link b [rad], duration [s]) of each setpoint.
    :param theta: initial angle between links a and b [rad].
    :param duration: of the run [s].
    :param mismatch: error of a link's length, relative to the length.
    :param stiffness: of the joints, inf for rigid ones [N/m].
    """

    script: tuple[tuple[float, float, float, float], ...]
    theta: float
    duration: float
    mismatch: float = 0.0
    stiffness: float = inf


def crossing(half_width: float, time: float, mismatch: float = 0.0, stiffness: float = inf
             ) -> Manoeuvre:
    """Return a crossing from theta = half_width to -half_width [rad] in a given time [s]."""
    return Manoeuvre(((0.5, 0.0, -half_width, time),), half_width, time + 2.0, mismatch, stiffness)


MANOEUVRES = {
    'motion': crossing(radians(40.0), 6.0),
    # Parks for 5 s, turns the whole linkage by 45 deg, and leaves on the branch it came on.
    'parking': Manoeuvre(
        ((0.5, 0.0, 0.0, 4.0), (9.5, radians(45.0), radians(45.0), 6.0),
         (17.0, radians(45.0), radians(15.0), 4.0)), radians(30.0), 22.5, stiffness=STIFFNESS),
    'mismatch': crossing(radians(20.0), 6.0, MISMATCH, STIFFNESS),
}

MISMATCHES = (1e-4, 3e-4, 1e-3, 3e-3)
STIFFNESSES = (1e3, 1e4, 1e5, inf)
# Axes of the map of slow crossings: relative mismatch, stiffness [N/m], time [s].
TIMES = (2.0, 6.0, 15.0)


@dataclass(frozen=True)
class CrossingRun:
    """
    A run of the study.

    :param manoeuvre: of the linkage.
    :param method: one of `METHODS`.
    :param seed: of all random numbers.
    """

    manoeuvre: Manoeuvre
    method: str
    seed: int


@dataclass(frozen=True, eq=False)
class CrossingOutcome:
    """
    Outcome of a run.

    :param passed: whether the linkage reached its goal on the parallelogram branch.
    :param error: largest distance of a link from its goal at the end [rad], inf without an end.
    :param largest_eta: largest |phi_c - phi_a| [rad].
    :param torque: largest torque of a motor [N m].
    :param reason: of the failure, '' if passed.
    :param path: (n, 2) theta and eta, ten times a second [rad].
    """

    passed: bool
    error: float
    largest_eta: float
    torque: float
    reason: str
    path: Array


@dataclass(frozen=True, eq=False)
class CrossingStatistics:
    """
    Statistics of the runs of one kind.

    :param outcomes: of each run.
    """

    outcomes: Sequence[CrossingOutcome]

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.outcomes)

    @property
    def passed(self) -> int:
        """Number of runs that passed."""
        return sum(outcome.passed for outcome in self.outcomes)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the share that passes (Clopper and Pearson 1934)."""
        low, high = binomtest(self.passed, self.runs).proportion_ci()
        return float(low), float(high)

    @property
    def reasons(self) -> dict[str, int]:
        """Number of failures by their reason."""
        return dict(Counter(outcome.reason for outcome in self.outcomes if outcome.reason))


# Statistics by mismatch, stiffness and time.
Map = Mapping[tuple[float, float, float], CrossingStatistics]


def success(crossings: Map, time: float) -> Array:
    """Return the share that passed (stiffnesses, mismatches) for one time of the crossing."""
    return np.array([[crossings[mismatch, stiffness, time].passed
                      / crossings[mismatch, stiffness, time].runs for mismatch in MISMATCHES]
                     for stiffness in STIFFNESSES])


def stiffness_text(stiffness: float) -> str:
    """Return a stiffness as text."""
    return f'{stiffness:.0e} N/m'.replace('e+0', 'e') if isfinite(stiffness) else 'rigid'


def execute(run: CrossingRun) -> CrossingOutcome:
    """Execute a run; an error of the loop is a failure of the run."""
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
    path = np.reshape(angles, (-1, 4))
    eta = wrap_angles(path[:, 2] - path[:, 0])
    goal = np.array([scenario.setpoints[-1].positions] * 2).ravel()
    error = float(np.abs(wrap_angles(path[-1] - goal)).max()) if len(path) else inf
    # Written so that NaN fails.
    if not reason and not error <= GOAL_TOLERANCE:
        reason = 'elsewhere'
    return CrossingOutcome(
        not reason, error, float(np.abs(eta).max(initial=0.0)), torque, reason,
        np.column_stack([path[:, 1] - path[:, 0], eta])[::PATH_PERIOD])


def scenario_of(run: CrossingRun) -> Scenario:
    """Return the scenario of a run; its random numbers are the same for every method."""
    manoeuvre = run.manoeuvre
    rng = np.random.default_rng(run.seed)
    base = load_scenario('prototype')
    model = base.model
    inertias = model.flywheel_inertias * (
        1.0 + rng.uniform(-INERTIA_SPREAD, INERTIA_SPREAD, 4))
    lengths = model.link_lengths.copy()
    lengths[int(rng.integers(4))] *= 1.0 + manoeuvre.mismatch * float(rng.choice([-1.0, 1.0]))
    joints, bearings = 1.0 + rng.uniform(-FRICTION_SPREAD, FRICTION_SPREAD, 2)
    table = replace(
        base.table,
        joints=replace(base.table.joints, coulomb=base.table.joints.coulomb * joints),
        wheel_bearings=replace(
            base.table.wheel_bearings, coulomb=base.table.wheel_bearings.coulomb * bearings))
    mechanism = replace(model, flywheel_inertias=inertias, link_lengths=lengths)
    if np.isfinite(manoeuvre.stiffness):
        mechanism = _compliant(mechanism, manoeuvre.stiffness)
        model = _compliant(model, manoeuvre.stiffness)
    tolerance = manoeuvre.mismatch * float(model.link_lengths.mean())
    if np.isfinite(manoeuvre.stiffness):
        tolerance = max(tolerance, COMPLIANCE_TOLERANCE)
    controller = replace(
        base.controller, change_points='keep',
        allocation='two_wheels' if run.method == 'two' else base.controller.allocation,
        branch_bandwidth=base.controller.branch_bandwidth if run.method == 'four_held' else 0.0)
    heading = float(rng.uniform(-pi, pi))
    setpoints = tuple(
        ScriptedSetpoint(at, LINK_NAMES[:2], (heading + phi_a, heading + phi_b), duration)
        for at, phi_a, phi_b, duration in manoeuvre.script)
    return replace(
        base, mechanism=mechanism, model=model, table=table,
        initial=InitialState(heading, heading + manoeuvre.theta), controller=controller,
        estimator=replace(base.estimator, closure_tolerance=tolerance), setpoints=setpoints,
        duration=manoeuvre.duration, seed=run.seed)


def _compliant(mechanism: Mechanism, stiffness: float) -> Mechanism:
    return replace(mechanism, joint_stiffness=np.full(4, stiffness),
                   joint_damping=np.full(4, JOINT_DAMPING))
