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
from math import isfinite, sin

from fourbar_ros.control.reference import SoftStep
from fourbar_ros.errors import FourbarError
from fourbar_ros.mechanism import branch_of, ClosureError, LINK_NAMES, Mechanism, nearest_assembly
from fourbar_ros.mechanism.angles import wrap
from fourbar_ros.mechanism.parameters import Array
import numpy as np

# Closest approach to a change point that a move may plan, as |sin(phi_d - phi_c)|: there the
# wheels' hold on the configuration is lost.
CHANGE_POINT_MARGIN = 0.1

# Instants of a planned move at which it is checked.
CHECKS = 200

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
    if not len(names):
        raise SetpointError('no link is named')
    if len(names) != len(positions):
        raise SetpointError(f'{len(names)} names but {len(positions)} positions')
    goals: dict[int, float] = {}
    for name, position in zip(names, positions):
        if name not in LINK_NAMES:
            raise SetpointError(f'unknown link {name!r} (known are {", ".join(LINK_NAMES)})')
        if not isfinite(position):
            raise SetpointError(f'position of {name} is {position}')
        link = LINK_NAMES.index(name)
        if link in goals:
            raise SetpointError(f'{name} is named twice')
        goals[link] = float(position)
    return goals


def resolve(mechanism: Mechanism, goals: dict[int, float], present: Array) -> Array:
    """
    Work out where all four links go.

    Each named link takes the shortest way round. One named link: its partner holds. Two:
    they determine the rest. More must agree with the closure.

    :param goals: goal angle [rad] by link index, any turn.
    :param present: (4,) where the links are now, or are told to be [rad].
    :returns: (4,) goal angles, continuous with the present ones [rad].
    :raises SetpointError: it cannot close, or the named links contradict each other.
    """
    near = {link: present[link] + wrap(angle - present[link]) for link, angle in goals.items()}
    first, *others = sorted(near)
    if not others:
        others = [PARTNER[first]]
        near[others[0]] = float(present[others[0]])
    known = (first, others[0])
    guess = np.array(present)
    guess[list(known)] = [near[link] for link in known]
    # The two that follow turn roughly with their partners.
    for link in set(range(4)) - set(known):
        opposite = (link + 2) % 4
        if opposite in known:
            guess[link] += near[opposite] - present[opposite]
    try:
        angles = nearest_assembly(mechanism, known, (near[known[0]], near[known[1]]), guess)
    except ClosureError as error:
        raise SetpointError(str(error)) from None
    for link in others[1:]:
        if abs(wrap(angles[link] - near[link])) > AGREEMENT:
            raise SetpointError(
                f'{LINK_NAMES[link]} would be at {angles[link]:.4f} rad, not at '
                f'{near[link]:.4f} rad: more than two links must agree with the closure')
    return angles


def check_move(mechanism: Mechanism, move: SoftStep, present: Array) -> Array:
    """
    Follow a planned move to its end.

    :param present: (4,) link angles at its start [rad].
    :returns: (4,) link angles at its end [rad].
    :raises SetpointError: it meets a change point, or the loop cannot close on the way.
    """
    angles = present
    for time in np.linspace(0.0, move.duration, CHECKS):
        phi_a, phi_b = move.at(float(time))[0]
        try:
            angles = nearest_assembly(mechanism, (0, 1), (phi_a, phi_b), angles)
        except ClosureError as error:
            raise SetpointError(f'on the way there {error}') from None
        fold = abs(sin(angles[3] - angles[2]))
        # A move away from the change point is always allowed.
        if fold < min(CHANGE_POINT_MARGIN, abs(sin(present[3] - present[2]))):
            raise SetpointError(
                f'on the way there link_c and link_d fold onto a line (|sin| = {fold:.3f}, limit '
                f'{CHANGE_POINT_MARGIN:g}), a change point')
    if branch_of(angles) != branch_of(present):
        raise SetpointError(f'it lies on the {branch_of(angles)} branch')
    return angles
