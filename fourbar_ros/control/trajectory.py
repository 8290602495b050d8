# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Trajectories: several goals with times, as in trajectory_msgs/JointTrajectory.

Between two points the reference is a quintic; angle, rate and acceleration are continuous. Rates
that no point specifies are those of the cubic spline through the points, which of all curves
through them has the least mean square acceleration.
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
    follow_path,
    nearest_turns,
    PARTNER,
    SetpointError,
)
from fourbar_ros.control.soft_step import evaluate, evaluate_many, quintic
from fourbar_ros.mechanism import LINK_NAMES, Mechanism
from fourbar_ros.mechanism.closure import SIGNS
from fourbar_ros.mechanism.constants import Array
import numpy as np
from scipy.interpolate import CubicSpline

# Largest number of points: a trajectory is planned between two ticks of the controller.
MAX_POINTS = 1000

# Smallest time between two points [s]; closer points are a mistake.
MIN_INTERVAL = 1e-3

# Smallest number of instants in each piece at which it is checked.
INSTANTS_PER_PIECE = 8


@dataclass(frozen=True)
class Point:
    """
    A point of a trajectory message: one number for each named link, or none.

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
    A point in terms of links and axes.

    :param time: [s].
    :param angles: (4,) continuous [rad].
    :param rates: (2,) of the axes, NaN where not specified [rad/s].
    :param accelerations: (2,) likewise [rad/s^2].
    """

    time: float
    angles: Array
    rates: Array
    accelerations: Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """
    A motion through states by quintics. Axes are (phi_a, phi_b), or those of a branch.

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
        Choose instants for a check, ends of pieces included: (n,) [s].

        :param count: smallest number, and at least `INSTANTS_PER_PIECE` in each piece.
        """
        density = count / self.duration
        return np.concatenate([
            *(np.linspace(begin, end, max(INSTANTS_PER_PIECE, ceil(density * (end - begin))),
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
        """Return the times as plain numbers, which are faster to search."""
        times: list[float] = self.times.tolist()
        return times

    @cached_property
    def _coefficients(self) -> Array:
        """Return each piece's coefficients in time / duration: (n - 1, 6, 2)."""
        return np.array([quintic(start, end, duration) for start, end, duration in zip(
            self.states, self.states[1:], np.diff(self.times))])


def interpolate(times: Array, angles: Array, rates: Array, accelerations: Array) -> Trajectory:
    """
    Interpolate points whose rates and accelerations are partly unspecified.

    Missing rates are those of the cubic spline through the points, between the specified rates. A
    missing acceleration is that of the spline. Where that jumps, at a specified rate, it is the
    smaller of both, or 0 if they differ in sign: the acceleration of a short piece would make a
    long one swing out.

    :param times: (n,) increasing from 0, at least two [s].
    :param angles: (n, 2) [rad].
    :param rates: (n, 2), NaN where not specified; the first and the last are [rad/s].
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
    Plan the motion through points with times.

    Two named links determine the configuration. If one link is named, its partner holds. More
    links must agree with the closure. From point to point each named link takes the nearest turn.
    The motion starts with angle, rate and acceleration of the present reference, and ends at
    rest. A first point at time 0 must agree with the reference; its rates are ignored.

    :param names: of links, each once.
    :param points: with a number for each name, times increasing from 0.
    :param start: (3, 2) reference angle, rate and acceleration of the axes now, (phi_a, phi_b)
        or those of the branch.
    :param present: (4,) reference of the link angles now [rad].
    :param last_goal: (4,) previous goal, which links that are not named keep [rad].
    :param crossing: whether the path may meet change points, see `setpoint.follow_path`.
    :param branch: see `setpoint.plan`.
    :returns: the motion, and the four link angles at its end [rad].
    :raises SetpointError: a point is refused or cannot be reached; `values`: `point`, its number
        from 1, and `name`, `value`, `limit` of the error.
    """
    _check_points(names, points)
    branch = branch or branch_at(mechanism, present)
    axes = [0, 1] if branch is None else branch.axes
    knots = [Knot(0.0, present, start[1], start[2])]
    for number, point in enumerate(points, 1):
        try:
            goals = nearest_turns(check_names(names, point.positions), knots[-1].angles)
            if point.time_s == 0.0:
                _check_beginning(goals, present)
                continue
            if len(goals) == 1:
                partner = _partner(next(iter(goals)), branch)
                goals[partner] = float(last_goal[partner])
            knots.append(_knot(mechanism, names, point, goals, knots[-1].angles, present,
                               branch))
        except SetpointError as error:
            raise SetpointError(f'point {number} of {len(points)}: {error}',
                                **{**error.values, 'point': number}) from None
    rest = np.zeros(2)
    trajectory = interpolate(
        np.array([knot.time for knot in knots]),
        np.array([start[0], *(knot.angles[axes] for knot in knots[1:])]),
        np.array([*(knot.rates for knot in knots[:-1]), rest]),
        np.array([*(knot.accelerations for knot in knots[:-1]), rest]))
    return trajectory, follow_path(
        mechanism, trajectory, present, crossing=crossing, branch=branch)[-1]


def _partner(link: int, branch: Branch | None) -> int:
    """Return the link that holds when only one link is named: one on the other axis."""
    return PARTNER[link] if branch is None else branch.axes[1 - branch.axis_of(link)]


def _check_points(names: Sequence[str], points: Sequence[Point]) -> None:
    check_names(names, [0.0] * len(names))
    count = len(points)
    if not 0 < count <= MAX_POINTS:
        raise SetpointError(f'{count} points, at least 1 and at most {MAX_POINTS}',
                            name='points', value=count, limit=(1, MAX_POINTS))
    before = None
    for number, point in enumerate(points, 1):
        _check_numbers(number, count, names, point)
        time = point.time_s
        if not isfinite(time) or time < 0.0:
            raise _refused(number, count, f'time is {time} s, must not be negative', 'time', time)
        if before is not None and time <= before:
            raise _refused(number, count, f'time is {time:g} s, not after {before:g} s of the '
                           'point before', 'time', time)
        if (before is not None or time > 0.0) and time - (before or 0.0) < MIN_INTERVAL:
            raise _refused(number, count, f'time is {time:g} s, less than {MIN_INTERVAL:g} s '
                           'after the point before or the start', 'time', time)
        before = time
    last = points[-1]
    if not last.time_s > 0.0:
        raise _refused(count, count, 'the last time is 0, so there is no time to move', 'time',
                       last.time_s)
    for quantity, values in (('velocity', last.velocities), ('acceleration', last.accelerations)):
        for name, value in zip(names, values):
            if value != 0.0:
                raise _refused(count, count, f'{quantity} of {name} is {value:g}, must be 0 in '
                               'the last point', quantity, value)


def _check_numbers(number: int, count: int, names: Sequence[str], point: Point) -> None:
    if len(point.effort):
        raise _refused(number, count, 'effort must be empty', 'effort', point.effort)
    if not len(point.positions):
        raise _refused(number, count, 'no positions', 'position', point.positions)
    for quantity, values in (('position', point.positions), ('velocity', point.velocities),
                             ('acceleration', point.accelerations)):
        if len(values) and len(values) != len(names):
            raise _refused(number, count, f'{len(names)} names but {len(values)} of {quantity}',
                           quantity, values)
        for name, value in zip(names, values):
            if not isfinite(value):
                raise _refused(number, count, f'{quantity} of {name} is {value}', quantity, value)


def _refused(number: int, count: int, problem: str, name: str, value: object) -> SetpointError:
    return SetpointError(f'point {number} of {count}: {problem}', point=number, name=name,
                         value=value)


def _check_beginning(goals: dict[int, float], present: Array) -> None:
    for link, angle in goals.items():
        if abs(angle - present[link]) > AGREEMENT:
            raise SetpointError(
                f'{LINK_NAMES[link]} at time 0 is {angle:.4f} rad and the reference '
                f'{present[link]:.4f} rad, at most {AGREEMENT:g} rad apart',
                name=LINK_NAMES[link], value=angle, limit=float(present[link]))


def _knot(mechanism: Mechanism, names: Sequence[str], point: Point, goals: dict[int, float],
          last: Array, present: Array, branch: Branch | None) -> Knot:
    """
    Convert a point to angles of the links and rates of the axes.

    :param goals: angles of the links that are named or hold, on their turns [rad].
    :param last: (4,) link angles at the point before [rad].
    :param present: (4,) link angles now, which determine the branch [rad].
    """
    ends = complete(mechanism, goals, present, last, branch)
    if branch is None:
        # Joint 3 stays on its side: only a change point leads across.
        side = np.sin(present[3] - present[2])
        ends = [end for end in ends if np.sin(end[3] - end[2]) * side > 0.0]
        if not ends:
            raise SetpointError('the named links contradict each other on this branch',
                                names=list(names))
    angles = ends[0]
    check_agreement(angles, goals)
    rates, accelerations = np.full(4, np.nan), np.full(4, np.nan)
    links = [LINK_NAMES.index(name) for name in names]
    if len(point.velocities):
        given = {**dict.fromkeys(goals, 0.0), **dict(zip(links, point.velocities))}
        rates = _dependent(mechanism, angles, given, np.zeros(4), branch, 'velocity')
    if len(point.accelerations):
        if not len(point.velocities):
            raise SetpointError('accelerations without velocities', name='velocity')
        given = {**dict.fromkeys(goals, 0.0), **dict(zip(links, point.accelerations))}
        accelerations = _dependent(mechanism, angles, given, rates, branch, 'acceleration')
    axes = [0, 1] if branch is None else branch.axes
    return Knot(point.time_s, angles, rates[axes], accelerations[axes])


def _dependent(mechanism: Mechanism, angles: Array, given: dict[int, float], rates: Array,
               branch: Branch | None, quantity: str) -> Array:
    """
    Complete rates or accelerations of some links to all four, by the differentiated closure.

    :param angles: (4,) [rad].
    :param given: rate or acceleration by link, of at least two links.
    :param rates: (4,) for the centripetal part of accelerations, 0 for rates [rad/s].
    :param branch: branch on which links turn in pairs; None where they do not.
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
            raise SetpointError(f'{quantity} of the named links does not determine that of the '
                                'rest at this point', name=quantity) from None
    for link, value in given.items():
        if abs(result[link] - value) > AGREEMENT * max(1.0, abs(value)):
            raise SetpointError(
                f'{quantity} of {LINK_NAMES[link]} would be {result[link]:.4f} and not '
                f'{value:.4f}: those of the named links contradict each other',
                name=quantity, link=LINK_NAMES[link], value=float(result[link]), limit=value)
    return result
