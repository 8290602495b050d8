# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a setpoint by link names means, and whether it can be reached."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from math import ceil, pi, sin

from fourbar_ros.control.reference import SoftStep, Way
from fourbar_ros.errors import FourbarError
from fourbar_ros.mechanism import ClosureError, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap
from fourbar_ros.mechanism.by_name import RejectedError, values_by_name
from fourbar_ros.mechanism.closure import assemble_along, assemblies
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike

# Closest approach to a change point that a move may plan, as |sin(phi_d - phi_c)|: there the
# wheels' hold on the configuration is lost.
CHANGE_POINT_MARGIN = 0.1

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

# Lengths of opposite links that differ by less than this, relative to their mean, are equal.
EQUAL_LENGTHS = 1e-9

# Opposite links as close to parallel as this are taken to be on the parallelogram branch [rad]:
# six times what a sensor of 0.1 deg is off. Another branch comes as close only where it meets it.
PARALLEL = 0.01

# Turns about the shortest way that are considered; the shortest comes first among equals.
TURNS = (0, 1, -1)

PARTNER = {0: 1, 1: 0, 2: 1, 3: 0}
"""The link that holds still when only one is named: the one that is not parallel to it."""


class SetpointError(FourbarError):
    """A setpoint that is refused."""


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


def on_parallelogram(mechanism: Mechanism, link_angles: ArrayLike) -> bool:
    """
    Tell whether the linkage is on the parallelogram branch.

    There opposite links stay parallel, and a way leads through change points. Close to one the
    branches cannot be told apart, and the parallelogram is assumed.

    :param link_angles: (4,) any turns [rad].
    :returns: True where opposite links are equally long and parallel within `PARALLEL`.
    """
    angles = np.asarray(link_angles, dtype=float)
    return _equal_opposite_links(mechanism) and all(
        abs(wrap(angles[link + 2] - angles[link])) < PARALLEL for link in (0, 1))


def plan(mechanism: Mechanism, goals: dict[int, float], start: Array, present: Array,
         last_goal: Array, duration: float, *, crossing: bool = False
         ) -> tuple[SoftStep, Array]:
    """
    Plan the move that a setpoint asks for.

    One named link: its partner holds. Two: they determine the rest, on whichever branch the move
    really ends. More must agree with the closure.

    Each named link takes the shortest way round if that keeps away from change points. If not,
    further turns are considered, up to one more either way for each of the links that determine
    the rest, in the order of the sum of the squares of their travels. Only if no way keeps away,
    and crossing is allowed, the shortest is taken that does not.

    :param goals: goal angle [rad] by link index, any turn.
    :param start: (3, 2) reference angle, rate and acceleration of (phi_a, phi_b) now.
    :param present: (4,) reference of the link angles now [rad].
    :param last_goal: (4,) where they were going: what is not named goes there still [rad].
    :param duration: [s].
    :param crossing: whether the way may meet change points, where :func:`follow` can.
    :returns: the move, and the four link angles at its end [rad].
    :raises SetpointError: it cannot close, contradicts itself, or cannot be reached; the problem
        is that of the shortest way.
    """
    goals = shortest_ways(goals, last_goal)
    ends = _ends(mechanism, goals, present, last_goal)
    passes = (False, True) if crossing and on_parallelogram(mechanism, present) else (crossing,)
    problems = []
    for allowed in passes:
        for end in ends:
            move = SoftStep(np.array(start), end[:2], duration)
            try:
                reached: Array = follow(mechanism, move, present, crossing=allowed)[-1]
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


def complete(mechanism: Mechanism, goals: dict[int, float], present: Array, last: Array
             ) -> list[Array]:
    """
    Work out all four link angles at a goal.

    :param goals: angle [rad] of any number of links by index, on the turn that is meant.
    :param present: (4,) link angles now, which tell the branch [rad].
    :param last: (4,) where links that are not named hold or turn from [rad].
    :returns: the assemblies that fit, (4,) each, more likely first; more than two named links are
        not checked.
    :raises SetpointError: it cannot close, or is not determined.
    """
    if on_parallelogram(mechanism, present):
        return [_complete_parallelogram(goals, last)]
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


def follow(mechanism: Mechanism, move: Way, present: Array, *, crossing: bool = False) -> Array:
    """
    Follow a planned move.

    :param present: (4,) link angles at its start [rad].
    :param crossing: whether it may meet change points. It can on the parallelogram branch of a
        linkage whose opposite links are equal; then it stays on this branch.
    :returns: (n, 4) link angles at instants of the whole way, ends included, links a and b
        turning by not much more than `FINEST` between two [rad].
    :raises SetpointError: it meets a change point, or the loop cannot close on the way.
    """
    for path in _paths(move):
        try:
            angles = angles_along(mechanism, path, present)
        except ClosureError as error:
            raise SetpointError(f'on the way there {error}') from None
        if not (crossing and on_parallelogram(mechanism, present)):
            _check_distance(mechanism, angles, crossing)
    return angles


def angles_along(mechanism: Mechanism, path: Array, present: Array) -> Array:
    """
    Complete a path of (phi_a, phi_b) to four link angles, on the branch on which it begins.

    :param path: (n, 2) [rad].
    :param present: (4,) link angles where it begins [rad].
    :returns: (n, 4), continuous with them; opposite links exactly parallel on the parallelogram
        branch [rad].
    :raises ClosureError: the loop cannot close somewhere on the path.
    """
    if not on_parallelogram(mechanism, present):
        return assemble_along(mechanism, path[:, 0], path[:, 1], present)
    return np.hstack([path, path + _whole_turns(present[2:] - present[:2])])


def check_agreement(reached: Array, goals: dict[int, float]) -> None:
    """
    Compare where links end with where they were told to.

    :param reached: (4,) link angles [rad].
    :param goals: angle [rad] by link index, any turn.
    :raises SetpointError: they differ by more than `AGREEMENT`.
    """
    for link, angle in goals.items():
        if abs(wrap(reached[link] - angle)) > AGREEMENT:
            raise SetpointError(
                f'{LINK_NAMES[link]} would end at {reached[link]:.4f} rad and not at '
                f'{angle:.4f} rad: the named links do not fit together on this branch')


def _equal_opposite_links(mechanism: Mechanism) -> bool:
    lengths = mechanism.link_lengths
    limit = EQUAL_LENGTHS * float(lengths.mean())
    return bool(np.abs(lengths[:2] - lengths[2:]).max() <= limit)


def _whole_turns(angles: Array) -> Array:
    turns: Array = 2.0 * pi * np.round(angles / (2.0 * pi))
    return turns


def _known(goals: dict[int, float]) -> tuple[int, int]:
    """Return the two links that determine the rest."""
    first, *others = sorted(goals)
    return first, others[0] if others else PARTNER[first]


def _turned(mechanism: Mechanism, goals: dict[int, float], present: Array, last_goal: Array
            ) -> list[dict[int, float]]:
    """List goals with further turns of the links that determine the rest, least travel first."""
    if on_parallelogram(mechanism, present):
        # Those on one axis turn together.
        axes = [[link for link in goals if link % 2 == axis] for axis in (0, 1)]
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


def _ends(mechanism: Mechanism, goals: dict[int, float], present: Array, last_goal: Array
          ) -> list[Array]:
    """List where a move may end, (4,) each, in the order in which that is tried."""
    shortest, *further = _turned(mechanism, goals, present, last_goal)
    ends = complete(mechanism, shortest, present, last_goal)
    # Joint 3 stays on its side; of the shortest way both ends are tried, for what to say.
    side = sin(present[3] - present[2]) >= 0.0
    parallel = on_parallelogram(mechanism, present)
    for turned in further:
        for end in complete(mechanism, turned, present, last_goal):
            fits = parallel or (sin(end[3] - end[2]) >= 0.0) == side
            if fits and all(np.abs(end[:2] - other[:2]).max() > ROUNDING for other in ends):
                ends.append(end)
    return ends


def _complete_parallelogram(goals: dict[int, float], last: Array) -> Array:
    if len(goals) > 1 and len({link % 2 for link in goals}) == 1:
        named = ' and '.join(f'{LINK_NAMES[link]} = {angle:.4f} rad'
                             for link, angle in sorted(goals.items()))
        raise SetpointError(f'{named} do not determine the configuration')
    offsets = _whole_turns(last[2:] - last[:2])
    end = np.empty(4)
    for axis in (0, 1):
        angle = goals.get(axis)
        if angle is None:
            angle = (goals[axis + 2] - offsets[axis] if axis + 2 in goals else last[axis])
        end[axis], end[axis + 2] = angle, angle + offsets[axis]
    return end


def _check_distance(mechanism: Mechanism, angles: Array, crossing: bool) -> None:
    folds = np.abs(np.sin(angles[:, 3] - angles[:, 2]))
    # Keeping the distance, or moving away, is always allowed, whatever rounding says.
    limits = np.minimum(np.maximum.accumulate(folds), CHANGE_POINT_MARGIN) - ROUNDING
    if (folds < limits).any():
        reason = ''
        if crossing:
            reason = (', and only the parallelogram branch leads through it'
                      if _equal_opposite_links(mechanism) else
                      ', and only opposite links of equal length lead through it')
        raise SetpointError(
            'on the way there link_c and link_d fold onto a line '
            f'(|sin| = {float(folds[folds < limits].min()):.3f}, limit {CHANGE_POINT_MARGIN:g}), '
            f'a change point{reason}')


def _paths(move: Way) -> Iterator[Array]:
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
