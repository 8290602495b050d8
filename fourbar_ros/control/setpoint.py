# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Interpretation of a setpoint by link names, and checks of the path to it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from math import ceil, pi, sin

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.named_values import RejectedError, values_by_name
from fourbar_ros.control.branch import (
    Branch,
    branch_at,
    opposite_links_equal,
    PARALLELOGRAM,
)
from fourbar_ros.control.soft_step import SoftStep, TrajectorySegment
from fourbar_ros.mechanism import ClosureError, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap
from fourbar_ros.mechanism.change_points import PLANNING_MARGIN
from fourbar_ros.mechanism.closure import assemble_along, assemblies
from fourbar_ros.mechanism.constants import Array
import numpy as np

# Smallest number of instants at which a path is checked.
CHECKED_INSTANTS = 200

# Largest turn of a link between two instants [rad]: that of a soft step by half a turn.
LARGEST_TURN = 0.03

# Largest number of instants that are checked; a motion that needs more is a mistake.
MAX_INSTANTS = 40_000

# Difference of angles or of |sin| that is far above rounding errors and far below noise.
ROUNDING = 1e-9

# Largest deviation of further named links from the closure [rad].
AGREEMENT = 1e-3

# Further turns that are considered; no further turn comes first among equal travels.
TURNS = (0, 1, -1)

# Link that holds when only one link is named: one that is not parallel to it.
PARTNER = {0: 1, 1: 0, 2: 1, 3: 0}


class SetpointError(FourbarError):
    """A setpoint that is refused."""


class ContradictionError(SetpointError):
    """Named links that contradict each other, or do not determine the rest, on a branch."""


def check_names(names: Sequence[str], positions: Sequence[float]) -> dict[int, float]:
    """
    Read a setpoint by names.

    :returns: goal angle [rad] by link index.
    :raises SetpointError: empty, unknown or repeated names, wrong lengths, not finite.
    """
    try:
        return values_by_name(names, positions, LINK_NAMES, 'position')
    except RejectedError as error:
        raise SetpointError(str(error), **error.values) from None


def plan(mechanism: Mechanism, goals: dict[int, float], start: Array, present: Array,
         last_goal: Array, duration: float, *, crossing: bool = False,
         branch: Branch | None = None) -> tuple[SoftStep, Array]:
    """
    Plan the move of a setpoint.

    If one link is named, its partner holds. Two links determine the rest, on the branch on which
    the move really ends. More links must agree with the closure.

    Each named link takes the nearest turn if that path avoids change points. If not, further
    turns are considered, up to one more either way for each of the links that determine the rest,
    in the order of the sum of the squares of their travels. If no path avoids change points and
    crossing is allowed, the shortest path is taken.

    :param goals: goal angle [rad] by link index, any turn.
    :param start: (3, 2) reference angle, rate and acceleration of the axes now: (phi_a, phi_b),
        or those of the branch.
    :param present: (4,) reference of the link angles now [rad].
    :param last_goal: (4,) previous goal, which links that are not named keep [rad].
    :param duration: [s].
    :param crossing: whether the path may meet change points, see :func:`follow_path`.
    :param branch: of the move, by default the parallelogram where `present` is on it.
    :returns: the move, and the four link angles at its end [rad].
    :raises SetpointError: it cannot close, contradicts itself, or cannot be reached; the message
        is about the shortest path.
    """
    goals = nearest_turns(goals, last_goal)
    branch = branch or branch_at(mechanism, present)
    ends = _ends(mechanism, goals, present, last_goal, branch)
    axes = [0, 1] if branch is None else branch.axes
    passes = (False, True) if crossing and branch else (crossing,)
    problems = []
    for allowed in passes:
        for end in ends:
            move = SoftStep(np.array(start), end[axes], duration)
            try:
                reached: Array = follow_path(
                    mechanism, move, present, crossing=allowed, branch=branch)[-1]
                check_agreement(reached, goals)
            except SetpointError as error:
                problems.append((allowed, error))
                continue
            return move, reached
    # With crossing allowed, the reason why crossing did not help.
    raise next(error for allowed, error in problems if allowed == passes[-1])


def nearest_turns(goals: dict[int, float], last: Array) -> dict[int, float]:
    """
    Move goals to the nearest turns.

    :param goals: angle [rad] by link index, any turn.
    :param last: (4,) start of the paths [rad].
    """
    return {link: float(last[link]) + wrap(angle - last[link]) for link, angle in goals.items()}


def complete(mechanism: Mechanism, goals: dict[int, float], present: Array, last: Array,
             branch: Branch | None = None) -> list[Array]:
    """
    Complete a goal to all four link angles.

    :param goals: angle [rad] of any number of links by index, on the intended turn.
    :param present: (4,) link angles now, which determine the branch [rad].
    :param last: (4,) angles at which links that are not named hold or start [rad].
    :param branch: see :func:`plan`.
    :returns: the possible assemblies, (4,) each, the nearest first; more than two named links are
        not checked.
    :raises SetpointError: the loop cannot close, or the goal is not determined.
    """
    branch = branch or branch_at(mechanism, present)
    if branch is not None:
        return [_complete_pairs(branch, goals, last)]
    known, guess = _known(goals), np.array(last)
    for link in known:
        guess[link] = goals.get(link, float(last[link]))
    changes = guess - last
    # A dependent link turns roughly with the opposite link, or else with both its neighbours.
    for link in set(range(4)) - set(known):
        opposite = (link + 2) % 4
        guess[link] += changes[opposite] if opposite in known else changes[list(known)].mean()
    try:
        return assemblies(mechanism, known, (float(guess[known[0]]), float(guess[known[1]])),
                          guess)
    except ClosureError as error:
        raise SetpointError(str(error), **{'name': 'closure', **error.values}) from None


def follow_path(mechanism: Mechanism, move: TrajectorySegment, present: Array, *,
                crossing: bool = False,
                branch: Branch | None = None) -> Array:
    """
    Follow the path of a planned move, and check it.

    :param present: (4,) link angles at its start [rad].
    :param crossing: whether it may meet change points; that takes a branch on which links turn in
        pairs, and the move stays on it.
    :param branch: see :func:`plan`.
    :returns: (n, 4) link angles at instants of the whole path, ends included [rad]. Between two
        instants the axes turn by not much more than `LARGEST_TURN`.
    :raises SetpointError: it meets a change point, or the loop cannot close on the path.
    """
    branch = branch or branch_at(mechanism, present)
    for path in _paths(move):
        try:
            angles = angles_along(mechanism, path, present, branch)
        except ClosureError as error:
            raise SetpointError(
                f'on the path {error}', **{'name': 'closure', **error.values}) from None
        if not (crossing and branch):
            _check_distance(mechanism, angles, crossing, branch)
    return angles


def angles_along(mechanism: Mechanism, path: Array, present: Array,
                 branch: Branch | None = None) -> Array:
    """
    Complete a path of the axes to four link angles, on the branch of its start.

    :param path: (n, 2) [rad].
    :param present: (4,) link angles at its start [rad].
    :param branch: see :func:`plan`.
    :returns: (n, 4), continuous with them; links of a pair are exactly parallel [rad].
    :raises ClosureError: the loop cannot close somewhere on the path.
    """
    branch = branch or branch_at(mechanism, present)
    if branch is None:
        return assemble_along(mechanism, path[:, 0], path[:, 1], present)
    return branch.to_links(path, branch.offsets(present))


def check_agreement(reached: Array, goals: dict[int, float]) -> None:
    """
    Compare the link angles at the end of a move with the goals.

    :param reached: (4,) link angles [rad].
    :param goals: angle [rad] by link index, any turn.
    :raises ContradictionError: they differ by more than `AGREEMENT`; `values`: name, value, limit
        (the goal).
    """
    for link, angle in goals.items():
        if abs(wrap(reached[link] - angle)) > AGREEMENT:
            raise ContradictionError(
                f'{LINK_NAMES[link]} would end at {reached[link]:.4f} rad and not at '
                f'{angle:.4f} rad: the named links contradict each other on this branch',
                name=LINK_NAMES[link], value=float(reached[link]), limit=angle)


def _known(goals: dict[int, float]) -> tuple[int, int]:
    """Return the two links that determine the rest."""
    first, *others = sorted(goals)
    return first, others[0] if others else PARTNER[first]


def _turned(goals: dict[int, float], last_goal: Array, branch: Branch | None
            ) -> list[dict[int, float]]:
    """Return goals with further turns of the determining links, least travel first."""
    if branch is not None:
        # Links on one axis turn together.
        axes = [[link for link in goals if branch.axis_of(link) == axis] for axis in (0, 1)]
        groups = [axis for axis in axes if axis]
    else:
        groups = [[link] for link in _known(goals) if link in goals]
    found = []
    for turns in product(TURNS, repeat=len(groups)):
        turned, travel = dict(goals), 0.0
        for turn, group in zip(turns, groups):
            for link in group:
                turned[link] += 2.0 * pi * turn
            travel += (turned[group[0]] - float(last_goal[group[0]])) ** 2
        # Rounded: half a turn is as far either way.
        found.append((round(travel, 9), turned))
    found.sort(key=lambda item: item[0])
    return [turned for _, turned in found]


def _ends(mechanism: Mechanism, goals: dict[int, float], present: Array, last_goal: Array,
          branch: Branch | None) -> list[Array]:
    """Return possible ends of a move, (4,) each, in the order in which they are tried."""
    shortest, *further = _turned(goals, last_goal, branch)
    ends = complete(mechanism, shortest, present, last_goal, branch)
    # Joint 3 stays on its side. Both ends of the shortest path are tried, for the message.
    side = sin(present[3] - present[2]) >= 0.0
    axes = [0, 1] if branch is None else branch.axes
    for turned in further:
        for end in complete(mechanism, turned, present, last_goal, branch):
            fits = branch or (sin(end[3] - end[2]) >= 0.0) == side
            if fits and all(np.abs((end - other)[axes]).max() > ROUNDING for other in ends):
                ends.append(end)
    return ends


def _complete_pairs(branch: Branch, goals: dict[int, float], last: Array) -> Array:
    if len(goals) > 1 and len({branch.axis_of(link) for link in goals}) == 1:
        named = ' and '.join(f'{LINK_NAMES[link]} = {angle:.4f} rad'
                             for link, angle in sorted(goals.items()))
        where = '' if branch == PARALLELOGRAM else (
            f' on the {branch.name} branch, where they turn together')
        raise ContradictionError(f'{named} do not determine the configuration{where}',
                                 names=[LINK_NAMES[link] for link in sorted(goals)])
    offsets = branch.offsets(last)
    path = last[branch.axes]
    for axis, (first, second) in enumerate(branch.pairs):
        if first in goals:
            path[axis] = goals[first]
        elif second in goals:
            path[axis] = goals[second] - offsets[axis]
    return branch.to_links(path, offsets)


def _check_distance(mechanism: Mechanism, angles: Array, crossing: bool,
                    branch: Branch | None) -> None:
    c, d = (2, 3) if branch is None else branch.followers
    folds = np.abs(np.sin(angles[:, d] - angles[:, c]))
    # A path that keeps its distance or moves away is always allowed.
    limits = np.minimum(np.maximum.accumulate(folds), PLANNING_MARGIN) - ROUNDING
    if (folds < limits).any():
        reason, values = '', {}
        if crossing and opposite_links_equal(mechanism):
            reason = ', and only the parallelogram branch leads through it'
            values = {'needed': 'parallelogram_branch'}
        elif crossing:
            reason = ', and only opposite links of equal length lead through it'
            values = {'needed': 'parallelogram'}
        closest = float(folds[folds < limits].min())
        raise SetpointError(
            f'on the path {LINK_NAMES[c]} and {LINK_NAMES[d]} fold onto a line '
            f'(|sin| = {closest:.3f}, limit {PLANNING_MARGIN:g}), a change point{reason}',
            name='change_point', value=closest, limit=PLANNING_MARGIN, **values)


def _paths(move: TrajectorySegment) -> Iterator[Array]:
    """Sample the angles of the axes, and again where that is not fine enough: (n, 2)."""
    times = move.instants(CHECKED_INSTANTS)
    path = move.sample(times)[:, 0]
    step = float(np.abs(np.diff(path, axis=0)).max())
    most = LARGEST_TURN * (MAX_INSTANTS // len(times))
    if not step <= most:
        raise SetpointError(
            f'on the path a link turns by {step:.3g} rad in {move.duration / len(times):.3g} s, '
            f'at most {most:g} rad can be checked', name='turn', value=step, limit=most)
    # Most paths that are refused are refused by this coarse one.
    yield path
    if step > LARGEST_TURN:
        parts = ceil(step / LARGEST_TURN)
        index = np.arange(parts * (len(times) - 1) + 1) / parts
        yield move.sample(np.interp(index, np.arange(len(times)), times))[:, 0]
