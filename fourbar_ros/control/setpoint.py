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

from collections.abc import Sequence
from math import sin

from fourbar_ros.control.reference import SoftStep
from fourbar_ros.errors import FourbarError
from fourbar_ros.mechanism import ClosureError, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap
from fourbar_ros.mechanism.by_name import RejectedError, values_by_name
from fourbar_ros.mechanism.closure import assemble_along, assemblies
from fourbar_ros.mechanism.constants import Array
import numpy as np

# Closest approach to a change point that a move may plan, as |sin(phi_d - phi_c)|: there the
# wheels' hold on the configuration is lost.
CHANGE_POINT_MARGIN = 0.1

# Instants of a planned move at which it is checked.
CHECKS = 200

# Of |sin|, far above that of an angle and far below anything that matters.
ROUNDING = 1e-9

# How far two more named links may contradict the closure [rad].
AGREEMENT = 1e-3

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


def plan(mechanism: Mechanism, goals: dict[int, float], start: Array, present: Array,
         last_goal: Array, duration: float) -> tuple[SoftStep, Array]:
    """
    Plan the move that a setpoint asks for.

    Each named link takes the shortest way round. One named link: its partner holds. Two: they
    determine the rest, on whichever branch the move really ends. More must agree with the closure.

    :param goals: goal angle [rad] by link index, any turn.
    :param start: (3, 2) reference angle, rate and acceleration of (phi_a, phi_b) now.
    :param present: (4,) reference of the link angles now [rad].
    :param last_goal: (4,) where they were going: what is not named goes there still [rad].
    :param duration: [s].
    :returns: the move, and the four link angles at its end [rad].
    :raises SetpointError: it cannot close, contradicts itself, or cannot be reached.
    """
    goals = {link: last_goal[link] + wrap(angle - last_goal[link])
             for link, angle in goals.items()}
    first, *others = sorted(goals)
    if not others:
        goals[PARTNER[first]] = float(last_goal[PARTNER[first]])
        others = [PARTNER[first]]
    known = (first, others[0])
    guess = np.array(last_goal)
    for link, angle in goals.items():
        guess[link] = angle
    # What follows turns roughly with the opposite link.
    for link in set(range(4)) - set(known):
        opposite = (link + 2) % 4
        if opposite in known:
            guess[link] += goals[opposite] - last_goal[opposite]
    try:
        ends = assemblies(mechanism, known, (goals[known[0]], goals[known[1]]), guess)
    except ClosureError as error:
        raise SetpointError(str(error)) from None
    problems = []
    for end in ends:
        move = SoftStep(np.array(start), end[:2], duration)
        try:
            reached = follow(mechanism, move, present)
            _check_end(reached, goals)
        except SetpointError as error:
            problems.append(error)
            continue
        return move, reached
    raise problems[0]


def follow(mechanism: Mechanism, move: SoftStep, present: Array) -> Array:
    """
    Follow a planned move to its end.

    :param present: (4,) link angles at its start [rad].
    :returns: (4,) link angles at its end [rad].
    :raises SetpointError: it meets a change point, or the loop cannot close on the way.
    """
    # Keeping the distance, or moving away, is always allowed, whatever rounding says.
    limit = min(CHANGE_POINT_MARGIN, abs(sin(present[3] - present[2]))) - ROUNDING
    way = move.path(CHECKS)
    try:
        angles = assemble_along(mechanism, way[:, 0], way[:, 1], present)
    except ClosureError as error:
        raise SetpointError(f'on the way there {error}') from None
    fold = float(np.abs(np.sin(angles[:, 3] - angles[:, 2])).min())
    if fold < limit:
        raise SetpointError(
            f'on the way there link_c and link_d fold onto a line (|sin| = {fold:.3f}, limit '
            f'{CHANGE_POINT_MARGIN:g}), a change point')
    end: Array = angles[-1]
    return end


def _check_end(reached: Array, goals: dict[int, float]) -> None:
    for link, angle in goals.items():
        if abs(wrap(reached[link] - angle)) > AGREEMENT:
            raise SetpointError(
                f'{LINK_NAMES[link]} would end at {reached[link]:.4f} rad and not at '
                f'{angle:.4f} rad: the named links do not fit together on this branch')
