# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Trajectories: several goals with times, as of trajectory_msgs/JointTrajectory.

Between two points the reference is a quintic, so that angle, rate and acceleration are continuous
everywhere. Rates that no point gives are those of the cubic spline through the points: of all
curves through them it bends least.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, isfinite

from fourbar_ros.control.branch import Branch, branch_at
from fourbar_ros.control.setpoint import (
    AGREEMENT,
    check_agreement,
    check_names,
    complete,
    follow,
    PARTNER,
    SetpointError,
    shortest_ways,
)
from fourbar_ros.control.soft_step import evaluate, evaluate_many, quintic
from fourbar_ros.mechanism import LINK_NAMES, Mechanism
from fourbar_ros.mechanism.closure import SIGNS
from fourbar_ros.mechanism.constants import Array
import numpy as np
from scipy.interpolate import CubicSpline

# A trajectory is worked out between two ticks of the controller.
MOST_POINTS = 1000

# Points closer in time than this are a mistake [s].
LEAST_INTERVAL = 1e-3

# Instants at which each piece is looked at, at least.
PER_PIECE = 8


@dataclass(frozen=True)
class Point:
    """
    A point of a trajectory, as it is given: one number for each named link, or none.

    :param positions: orientations of the links [rad].
    :param time_s: from the start of the trajectory [s].
    :param velocities: their rates, or empty [rad/s].
    :param accelerations: or empty [rad/s^2].
    :param effort: must be empty: torques come from the tracking law.
    """

    positions: Sequence[float]
    time_s: float
    velocities: Sequence[float] = ()
    accelerations: Sequence[float] = ()
    effort: Sequence[float] = ()


@dataclass(frozen=True, eq=False)
class Knot:
    """
    What a point means.

    :param time: [s].
    :param angles: (4,) continuous [rad].
    :param rates: (2,) of the axes, NaN where not given [rad/s].
    :param accelerations: (2,) likewise [rad/s^2].
    """

    time: float
    angles: Array
    rates: Array
    accelerations: Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """
    A motion through given states, by quintics. Axes are (phi_a, phi_b), or those of a branch.

    :param times: (n,) increasing from 0, at least two [s].
    :param states: (n, 3, 2) angle, rate and acceleration at these times, at rest in the last one
        [rad, rad/s, rad/s^2].
    """

    times: Array
    states: Array

    @property
    def duration(self) -> float:
        """Time at which it ends [s]."""
        return float(self.times[-1])

    def at(self, time: float) -> Array:
        """
        Evaluate angle, rate and acceleration: (3, 2).

        :param time: since the start; before 0 the start, after the duration the end at rest [s].
        """
        if time >= self.times[-1]:
            return np.array(self.states[-1])
        time = max(time, 0.0)
        piece = bisect_right(self._starts, time) - 1
        begin = self._starts[piece]
        return evaluate(self._coefficients[piece], time - begin,
                        self._starts[piece + 1] - begin)

    def instants(self, count: int) -> Array:
        """
        Choose times at which to look at it, ends of pieces included: (n,) [s].

        :param count: at least so many, and `PER_PIECE` in each piece.
        """
        density = count / self.duration
        return np.concatenate([
            *(np.linspace(begin, end, max(PER_PIECE, ceil(density * (end - begin))),
                          endpoint=False)
              for begin, end in zip(self._starts, self._starts[1:])), self.times[-1:]])

    def sample(self, times: Array) -> Array:
        """Evaluate like `at` for times (n,) within the duration [s]: (n, 3, 2)."""
        pieces = np.searchsorted(self.times, times, side='right') - 1
        pieces = np.clip(pieces, 0, len(self.times) - 2)
        begin, end = self.times[pieces], self.times[pieces + 1]
        return evaluate_many(
            self._coefficients[pieces], (times - begin) / (end - begin), end - begin)

    @cached_property
    def _starts(self) -> list[float]:
        """Return the times as plain numbers: faster for one look at a time."""
        times: list[float] = self.times.tolist()
        return times

    @cached_property
    def _coefficients(self) -> Array:
        """Return each piece's coefficients in its share of time: (n - 1, 6, 2)."""
        return np.array([quintic(start, end, duration) for start, end, duration in zip(
            self.states, self.states[1:], np.diff(self.times))])


def through(times: Array, angles: Array, rates: Array, accelerations: Array) -> Trajectory:
    """
    Make a trajectory through points of which not everything is given.

    Missing rates are those of the cubic spline through the points, between the given rates. A
    missing acceleration is that of the spline. Where that jumps, since a rate was given, it is the
    smaller of both, or 0 if they differ in sign: what suits a short piece would make a long one
    swing out.

    :param times: (n,) increasing from 0, at least two [s].
    :param angles: (n, 2) [rad].
    :param rates: (n, 2), NaN where not given; the first and the last are [rad/s].
    :param accelerations: (n, 2), likewise [rad/s^2].
    """
    rates = np.array(rates)
    bends = np.zeros((2, *rates.shape))
    given = np.flatnonzero(~np.isnan(rates).any(axis=1))
    for first, last in zip(given, given[1:]):
        run = slice(first, last + 1)
        spline = CubicSpline(times[run], angles[run],
                             bc_type=((1, rates[first]), (1, rates[last])))
        rates[first + 1:last] = spline(times[first + 1:last], 1)
        bend = spline(times[run], 2)
        bends[0, first + 1:last + 1] = bend[1:]
        bends[1, first:last] = bend[:-1]
    signs = np.sign(bends)
    smaller = np.where(signs[0] == signs[1], signs[0] * np.abs(bends).min(axis=0), 0.0)
    accelerations = np.where(np.isnan(accelerations), smaller, accelerations)
    return Trajectory(np.array(times), np.stack([angles, rates, accelerations], axis=1))


def read_trajectory(mechanism: Mechanism, names: Sequence[str], points: Sequence[Point],
                    start: Array, present: Array, last_goal: Array, *, crossing: bool = False,
                    branch: Branch | None = None) -> tuple[Trajectory, Array]:
    """
    Plan the motion that points with times ask for.

    Two named links determine the configuration. One: its partner holds. More must agree with the
    closure. From point to point each named link takes the shortest way. The motion begins at the
    present reference, whose rate and acceleration it takes over, and ends at rest. A first point
    at time 0 must agree with the reference; its rates do not count.

    :param names: of links, each once.
    :param points: with a number for each name, times increasing from 0.
    :param start: (3, 2) reference angle, rate and acceleration of the axes now, (phi_a, phi_b)
        or those of the branch.
    :param present: (4,) reference of the link angles now [rad].
    :param last_goal: (4,) where they were going: what is not named goes there still [rad].
    :param crossing: whether the way may meet change points, where `setpoint.follow` can.
    :param branch: as of `setpoint.plan`.
    :returns: the motion, and the four link angles at its end [rad].
    :raises SetpointError: anything else, with the number of the point from 1; or a point cannot
        be reached.
    """
    _check_points(names, points)
    branch = branch or branch_at(mechanism, present)
    axes = [0, 1] if branch is None else branch.axes
    knots = [Knot(0.0, present, start[1], start[2])]
    for number, point in enumerate(points, 1):
        try:
            goals = shortest_ways(check_names(names, point.positions), knots[-1].angles)
            if point.time_s == 0.0:
                _check_beginning(goals, present)
                continue
            if len(goals) == 1:
                partner = _partner(next(iter(goals)), branch)
                goals[partner] = float(last_goal[partner])
            knots.append(_knot(mechanism, names, point, goals, knots[-1].angles, present,
                               branch))
        except SetpointError as error:
            raise SetpointError(f'point {number} of {len(points)}: {error}') from None
    rest = np.zeros(2)
    trajectory = through(
        np.array([knot.time for knot in knots]),
        np.array([start[0], *(knot.angles[axes] for knot in knots[1:])]),
        np.array([*(knot.rates for knot in knots[:-1]), rest]),
        np.array([*(knot.accelerations for knot in knots[:-1]), rest]))
    return trajectory, follow(
        mechanism, trajectory, present, crossing=crossing, branch=branch)[-1]


def _partner(link: int, branch: Branch | None) -> int:
    """Return the link that holds still when only one is named: not on the same axis."""
    return PARTNER[link] if branch is None else branch.axes[1 - branch.axis_of(link)]


def _check_points(names: Sequence[str], points: Sequence[Point]) -> None:
    check_names(names, [0.0] * len(names))
    if not 0 < len(points) <= MOST_POINTS:
        raise SetpointError(f'{len(points)} points, at least 1 and at most {MOST_POINTS}')
    before = None
    for number, point in enumerate(points, 1):
        where = f'point {number} of {len(points)}: '
        _check_numbers(where, names, point)
        if not isfinite(point.time_s) or point.time_s < 0.0:
            raise SetpointError(f'{where}time is {point.time_s} s, must not be negative')
        if before is not None and point.time_s <= before:
            raise SetpointError(f'{where}time is {point.time_s:g} s, not after {before:g} s of '
                                'the point before')
        if (before is not None or point.time_s > 0.0) and (
                point.time_s - (before or 0.0) < LEAST_INTERVAL):
            raise SetpointError(f'{where}time is {point.time_s:g} s, less than '
                                f'{LEAST_INTERVAL:g} s after what comes before')
        before = point.time_s
    last = points[-1]
    where = f'point {len(points)} of {len(points)}: '
    if not last.time_s > 0.0:
        raise SetpointError(f'{where}it ends at time 0: there is no time to move')
    for quantity, values in (('velocity', last.velocities), ('acceleration', last.accelerations)):
        for name, value in zip(names, values):
            if value != 0.0:
                raise SetpointError(
                    f'{where}{quantity} of {name} is {value:g}, must be 0 in the last point')


def _check_numbers(where: str, names: Sequence[str], point: Point) -> None:
    if len(point.effort):
        raise SetpointError(f'{where}effort is given, and must be empty')
    if not len(point.positions):
        raise SetpointError(f'{where}no positions')
    for quantity, values in (('position', point.positions), ('velocity', point.velocities),
                             ('acceleration', point.accelerations)):
        if len(values) and len(values) != len(names):
            raise SetpointError(f'{where}{len(names)} names but {len(values)} of {quantity}')
        for name, value in zip(names, values):
            if not isfinite(value):
                raise SetpointError(f'{where}{quantity} of {name} is {value}')


def _check_beginning(goals: dict[int, float], present: Array) -> None:
    for link, angle in goals.items():
        if abs(angle - present[link]) > AGREEMENT:
            raise SetpointError(
                f'{LINK_NAMES[link]} at time 0 is {angle:.4f} rad and the reference '
                f'{present[link]:.4f} rad, limit {AGREEMENT:g} rad apart')


def _knot(mechanism: Mechanism, names: Sequence[str], point: Point, goals: dict[int, float],
          last: Array, present: Array, branch: Branch | None) -> Knot:
    """
    Work out what a point says of the axes.

    :param goals: angles of the links that are named or hold, on their turns [rad].
    :param last: (4,) link angles at the point before [rad].
    :param present: (4,) link angles now, which tell the branch [rad].
    """
    ends = complete(mechanism, goals, present, last, branch)
    if branch is None:
        # Joint 3 stays on its side: only a change point leads across.
        side = np.sin(present[3] - present[2])
        ends = [end for end in ends if np.sin(end[3] - end[2]) * side > 0.0]
        if not ends:
            raise SetpointError('the named links do not fit together on this branch')
    angles = ends[0]
    check_agreement(angles, goals)
    rates, accelerations = np.full(4, np.nan), np.full(4, np.nan)
    links = [LINK_NAMES.index(name) for name in names]
    if len(point.velocities):
        given = {**dict.fromkeys(goals, 0.0), **dict(zip(links, point.velocities))}
        rates = _dependent(mechanism, angles, given, np.zeros(4), branch, 'velocity')
    if len(point.accelerations):
        if not len(point.velocities):
            raise SetpointError('accelerations are given, but no velocities')
        given = {**dict.fromkeys(goals, 0.0), **dict(zip(links, point.accelerations))}
        accelerations = _dependent(mechanism, angles, given, rates, branch, 'acceleration')
    axes = [0, 1] if branch is None else branch.axes
    return Knot(point.time_s, angles, rates[axes], accelerations[axes])


def _dependent(mechanism: Mechanism, angles: Array, given: dict[int, float], rates: Array,
               branch: Branch | None, quantity: str) -> Array:
    """
    Complete rates or accelerations of some links to all four, by the closure differentiated.

    :param angles: (4,) [rad].
    :param given: rate or acceleration by link, of two links at least.
    :param rates: (4,) of which accelerations come by themselves, 0 for rates [rad/s].
    :param branch: on which links turn in pairs, at change points too; None where they do not.
    """
    result = np.zeros(4)
    if branch is not None:
        for first, second in branch.pairs:
            result[[first, second]] = given[first] if first in given else given[second]
    else:
        known = sorted(given)[:2]
        rest = [link for link in range(4) if link not in known]
        arms = np.array(SIGNS) * mechanism.link_lengths
        jacobian = arms * np.array([-np.sin(angles), np.cos(angles)])
        centripetal = (arms * np.array([np.cos(angles), np.sin(angles)])) @ (rates * rates)
        result[known] = [given[link] for link in known]
        try:
            result[rest] = np.linalg.solve(
                jacobian[:, rest], centripetal - jacobian[:, known] @ result[known])
        except np.linalg.LinAlgError:
            raise SetpointError(
                f'{quantity} is given where it does not determine that of the rest') from None
    for link, value in given.items():
        if abs(result[link] - value) > AGREEMENT * max(1.0, abs(value)):
            raise SetpointError(
                f'{quantity} of {LINK_NAMES[link]} would be {result[link]:.4f} and not '
                f'{value:.4f}: what is given for the named links does not fit together')
    return result
