# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What a setpoint by link names means, and whether it can be reached."""

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

# Instants of a planned move at which it is checked, at least.
CHECKS = 200

# Largest turn of a link between two of them [rad]: a soft step by half a turn just keeps it.
FINEST = 0.03

# What needs more instants is no sensible motion.
MOST_CHECKS = 40_000

# Of |sin|, far above that of an angle and far below anything that matters.
ROUNDING = 1e-9

# How far two more named links may contradict the closure [rad].
AGREEMENT = 1e-3

# Turns about the shortest way that are considered; the shortest comes first among equals.
TURNS = (0, 1, -1)

PARTNER = {0: 1, 1: 0, 2: 1, 3: 0}
"""The link that holds still when only one is named: the one that is not parallel to it."""


class SetpointError(FourbarError):
    """A setpoint that is refused."""


class ContradictionError(SetpointError):
    """Named links that do not fit together, or do not determine the rest, on a branch."""


def check_names(names: Sequence[str], positions: Sequence[float]) -> dict[int, float]:
    """
    Read a setpoint by names.

    :returns: goal angle [rad] by link index.
    :raises SetpointError: empty, unknown or repeated names, wrong lengths, not finite.
    """
    try:
        return values_by_name(names, positions, LINK_NAMES, 'position')
    except RejectedError as error:
        raise SetpointError(str(error)) from None


def plan(mechanism: Mechanism, goals: dict[int, float], start: Array, present: Array,
         last_goal: Array, duration: float, *, crossing: bool = False,
         branch: Branch | None = None) -> tuple[SoftStep, Array]:
    """
    Plan the move that a setpoint asks for.

    One named link: its partner holds. Two: they determine the rest, on whichever branch the move
    really ends. More must agree with the closure.

    Each named link takes the shortest way round if that keeps away from change points. If not,
    further turns are considered, up to one more either way for each of the links that determine
    the rest, in the order of the sum of the squares of their travels. Only if no way keeps away,
    and crossing is allowed, the shortest is taken that does not.

    :param goals: goal angle [rad] by link index, any turn.
    :param start: (3, 2) reference angle, rate and acceleration of the axes now: (phi_a, phi_b),
        or those of the branch.
    :param present: (4,) reference of the link angles now [rad].
    :param last_goal: (4,) where they were going: what is not named goes there still [rad].
    :param duration: [s].
    :param crossing: whether the way may meet change points, where :func:`follow` can.
    :param branch: on which it goes, by default the parallelogram where `present` is on it.
    :returns: the move, and the four link angles at its end [rad].
    :raises SetpointError: it cannot close, contradicts itself, or cannot be reached; the problem
        is that of the shortest way.
    """
    goals = shortest_ways(goals, last_goal)
    branch = branch or branch_at(mechanism, present)
    ends = _ends(mechanism, goals, present, last_goal, branch)
    axes = [0, 1] if branch is None else branch.axes
    passes = (False, True) if crossing and branch else (crossing,)
    problems = []
    for allowed in passes:
        for end in ends:
            move = SoftStep(np.array(start), end[axes], duration)
            try:
                reached: Array = follow(
                    mechanism, move, present, crossing=allowed, branch=branch)[-1]
                check_agreement(reached, goals)
            except SetpointError as error:
                problems.append((allowed, error))
                continue
            return move, reached
    # Where crossing was allowed, and did not help, that is what is said.
    raise next(error for allowed, error in problems if allowed == passes[-1])


def shortest_ways(goals: dict[int, float], last: Array) -> dict[int, float]:
    """
    Put goals on the turns that are nearest.

    :param goals: angle [rad] by link index, any turn.
    :param last: (4,) where the ways begin [rad].
    """
    return {link: float(last[link]) + wrap(angle - last[link]) for link, angle in goals.items()}


def complete(mechanism: Mechanism, goals: dict[int, float], present: Array, last: Array,
             branch: Branch | None = None) -> list[Array]:
    """
    Work out all four link angles at a goal.

    :param goals: angle [rad] of any number of links by index, on the turn that is meant.
    :param present: (4,) link angles now, which tell the branch [rad].
    :param last: (4,) where links that are not named hold or turn from [rad].
    :param branch: as of :func:`plan`.
    :returns: the assemblies that fit, (4,) each, more likely first; more than two named links are
        not checked.
    :raises SetpointError: it cannot close, or is not determined.
    """
    branch = branch or branch_at(mechanism, present)
    if branch is not None:
        return [_complete_pairs(branch, goals, last)]
    known, guess = _known(goals), np.array(last)
    for link in known:
        guess[link] = goals.get(link, float(last[link]))
    changes = guess - last
    # What follows turns roughly with the opposite link, or else with both its neighbours.
    for link in set(range(4)) - set(known):
        opposite = (link + 2) % 4
        guess[link] += changes[opposite] if opposite in known else changes[list(known)].mean()
    try:
        return assemblies(mechanism, known, (float(guess[known[0]]), float(guess[known[1]])),
                          guess)
    except ClosureError as error:
        raise SetpointError(str(error)) from None


def follow(mechanism: Mechanism, move: TrajectorySegment, present: Array, *,
           crossing: bool = False,
           branch: Branch | None = None) -> Array:
    """
    Follow a planned move.

    :param present: (4,) link angles at its start [rad].
    :param crossing: whether it may meet change points. It can on a branch where links turn in
        pairs, as on the parallelogram branch; then it stays on this branch.
    :param branch: as of :func:`plan`.
    :returns: (n, 4) link angles at instants of the whole way, ends included, the axes turning by
        not much more than `FINEST` between two [rad].
    :raises SetpointError: it meets a change point, or the loop cannot close on the way.
    """
    branch = branch or branch_at(mechanism, present)
    for path in _paths(move):
        try:
            angles = angles_along(mechanism, path, present, branch)
        except ClosureError as error:
            raise SetpointError(f'on the way there {error}') from None
        if not (crossing and branch):
            _check_distance(mechanism, angles, crossing, branch)
    return angles


def angles_along(mechanism: Mechanism, path: Array, present: Array,
                 branch: Branch | None = None) -> Array:
    """
    Complete a path of the axes to four link angles, on the branch on which it begins.

    :param path: (n, 2) [rad].
    :param present: (4,) link angles where it begins [rad].
    :param branch: as of :func:`plan`.
    :returns: (n, 4), continuous with them; twins exactly parallel where links turn in pairs
        [rad].
    :raises ClosureError: the loop cannot close somewhere on the path.
    """
    branch = branch or branch_at(mechanism, present)
    if branch is None:
        return assemble_along(mechanism, path[:, 0], path[:, 1], present)
    return branch.spread(path, branch.offsets(present))


def check_agreement(reached: Array, goals: dict[int, float]) -> None:
    """
    Compare where links end with where they were told to.

    :param reached: (4,) link angles [rad].
    :param goals: angle [rad] by link index, any turn.
    :raises ContradictionError: they differ by more than `AGREEMENT`.
    """
    for link, angle in goals.items():
        if abs(wrap(reached[link] - angle)) > AGREEMENT:
            raise ContradictionError(
                f'{LINK_NAMES[link]} would end at {reached[link]:.4f} rad and not at '
                f'{angle:.4f} rad: the named links do not fit together on this branch')


def _known(goals: dict[int, float]) -> tuple[int, int]:
    """Return the two links that determine the rest."""
    first, *others = sorted(goals)
    return first, others[0] if others else PARTNER[first]


def _turned(goals: dict[int, float], last_goal: Array, branch: Branch | None
            ) -> list[dict[int, float]]:
    """List goals with further turns of the links that determine the rest, least travel first."""
    if branch is not None:
        # Those on one axis turn together.
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
        # Rounded, since half a turn is as far either way.
        found.append((round(travel, 9), turned))
    found.sort(key=lambda item: item[0])
    return [turned for _, turned in found]


def _ends(mechanism: Mechanism, goals: dict[int, float], present: Array, last_goal: Array,
          branch: Branch | None) -> list[Array]:
    """List where a move may end, (4,) each, in the order in which that is tried."""
    shortest, *further = _turned(goals, last_goal, branch)
    ends = complete(mechanism, shortest, present, last_goal, branch)
    # Joint 3 stays on its side; of the shortest way both ends are tried, for what to say.
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
        raise ContradictionError(f'{named} do not determine the configuration{where}')
    offsets = branch.offsets(last)
    path = last[branch.axes]
    for axis, (first, second) in enumerate(branch.pairs):
        if first in goals:
            path[axis] = goals[first]
        elif second in goals:
            path[axis] = goals[second] - offsets[axis]
    return branch.spread(path, offsets)


def _check_distance(mechanism: Mechanism, angles: Array, crossing: bool,
                    branch: Branch | None) -> None:
    c, d = (2, 3) if branch is None else branch.followers
    folds = np.abs(np.sin(angles[:, d] - angles[:, c]))
    # Keeping the distance, or moving away, is always allowed, whatever rounding says.
    limits = np.minimum(np.maximum.accumulate(folds), PLANNING_MARGIN) - ROUNDING
    if (folds < limits).any():
        reason = ''
        if crossing:
            reason = (', and only the parallelogram branch leads through it'
                      if opposite_links_equal(mechanism) else
                      ', and only opposite links of equal length lead through it')
        raise SetpointError(
            f'on the way there {LINK_NAMES[c]} and {LINK_NAMES[d]} fold onto a line '
            f'(|sin| = {float(folds[folds < limits].min()):.3f}, limit {PLANNING_MARGIN:g}), '
            f'a change point{reason}')


def _paths(move: TrajectorySegment) -> Iterator[Array]:
    """Sample the angles of links a and b, and again where that is not fine enough: (n, 2)."""
    times = move.instants(CHECKS)
    path = move.sample(times)[:, 0]
    step = float(np.abs(np.diff(path, axis=0)).max())
    most = FINEST * (MOST_CHECKS // len(times))
    if not step <= most:
        raise SetpointError(
            f'on the way there a link turns by {step:.3g} rad in {move.duration / len(times):.3g} '
            f's, at most {most:g} rad can be checked')
    # Most ways that are refused are refused by this look already.
    yield path
    if step > FINEST:
        parts = ceil(step / FINEST)
        index = np.arange(parts * (len(times) - 1) + 1) / parts
        yield move.sample(np.interp(index, np.arange(len(times)), times))[:, 0]
