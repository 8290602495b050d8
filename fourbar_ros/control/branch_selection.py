# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""On which branch a setpoint is meant: the present one, or the other that a change point meets."""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.control.branch import at_change_point, Branch, is_rhombus, met_at
from fourbar_ros.control.reference_generator import ReferenceGenerator
from fourbar_ros.control.setpoint import ContradictionError, plan
from fourbar_ros.control.soft_step import SoftStep
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.change_points import IN_LINE_ANGLE
from fourbar_ros.mechanism.constants import Array
import numpy as np


@dataclass(frozen=True, eq=False)
class BranchSelection:
    """
    A planned move and the branch on which it goes.

    :param step: the move of the axes of the branch.
    :param present: (4,) link angles where it begins [rad].
    :param goal: (4,) link angles where it ends [rad].
    :param branch: on which links turn in pairs; None where they do not.
    """

    step: SoftStep
    present: Array
    goal: Array
    branch: Branch | None


def choose(mechanism: Mechanism, goals: dict[int, float], guide: ReferenceGenerator,
           duration: float,
           change_points: str) -> BranchSelection:
    """
    Plan the move that a setpoint asks for, see `setpoint.plan`, on the branch that it means.

    That is the present one if the named links fit together there. If they do not, while the
    reference rests at a change point, and they do on the other branch that it meets, and lead away
    from the change point, it is that.

    :param goals: goal angle [rad] by link index, any turn.
    :param guide: the present reference; it is not changed.
    :param duration: [s].
    :param change_points: one of `settings.CHANGE_POINTS`; only `choose` changes the branch.
    :raises SetpointError: as of `setpoint.plan`, and what keeps it from changing the branch.
    """
    branch, crossing = guide.branch, change_points != 'avoid'
    try:
        step, goal = plan(mechanism, goals, guide.motion.copy(), guide.angles, guide.destination,
                          duration, crossing=crossing, branch=branch)
    except ContradictionError as error:
        found = _on_the_other(mechanism, goals, guide, duration, crossing)
        if found is None:
            hint = _why_no_other(mechanism, guide) if change_points == 'choose' else ''
            raise ContradictionError(f'{error}{hint}') from None
        assert found.branch is not None
        if change_points != 'choose':
            raise ContradictionError(f'{error}; they do on the {found.branch.name} branch, which '
                                     'change_points: choose would allow') from None
        return found
    return BranchSelection(step, guide.angles, goal, branch)


def _on_the_other(mechanism: Mechanism, goals: dict[int, float], guide: ReferenceGenerator,
                  duration: float,
                  crossing: bool) -> BranchSelection | None:
    """Plan on the branch that meets the present one; None if that is not what is meant."""
    if guide.branch is None or not guide.resting:
        return None
    other = met_at(mechanism, guide.branch, guide.angles)
    if other is None:
        return None
    present, start = other.nearest(guide.angles), np.zeros((3, 2))
    start[0] = present[other.axes]
    try:
        step, goal = plan(mechanism, goals, start, present, present, duration, crossing=crossing,
                          branch=other)
    except ContradictionError:
        return None
    opened = np.diff(step.goal - start[0])
    if abs(float(opened[0])) <= IN_LINE_ANGLE:
        return None
    return BranchSelection(step, present, goal, other)


def _why_no_other(mechanism: Mechanism, guide: ReferenceGenerator) -> str:
    """Say why no other branch comes into question, as far as that has a reason."""
    if guide.branch is None:
        return ''
    if not is_rhombus(mechanism):
        lengths = mechanism.link_lengths
        return (f'; another branch can be chosen only with links of one length, here '
                f'{lengths.min():.6g} to {lengths.max():.6g} m')
    if not guide.resting or not at_change_point(guide.branch, guide.angles):
        return ('; another branch can be chosen only where the reference rests at a change point, '
                f'within {IN_LINE_ANGLE:g} rad')
    return ''
