# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Selection of the branch of a setpoint: the present one, or the adjoining one."""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.control.branch import (
    adjoining_branch,
    at_change_point,
    Branch,
    is_rhombus,
)
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
    A planned move and its branch.

    :param step: the move of the axes of the branch.
    :param present: (4,) link angles at its start [rad].
    :param goal: (4,) link angles at its end [rad].
    :param branch: branch on which links turn in pairs; None where they do not.
    """

    step: SoftStep
    present: Array
    goal: Array
    branch: Branch | None


def select_branch(mechanism: Mechanism, goals: dict[int, float], reference: ReferenceGenerator,
                  duration: float, change_points: str) -> BranchSelection:
    """
    Plan the move of a setpoint, see `setpoint.plan`, on the branch that it determines.

    That is the present branch if the named links fit together there. It is the other branch at a
    change point if they do not, the reference rests there, and they fit together on the other
    branch and lead away from the change point.

    :param goals: goal angle [rad] by link index, any turn.
    :param reference: not changed.
    :param duration: [s].
    :param change_points: one of `settings.CHANGE_POINTS`; only `choose` changes the branch.
    :raises SetpointError: see `setpoint.plan`; also tells why the branch cannot be changed.
    """
    branch, crossing = reference.branch, change_points != 'avoid'
    try:
        step, goal = plan(mechanism, goals, reference.motion.copy(), reference.angles,
                          reference.destination, duration, crossing=crossing, branch=branch)
    except ContradictionError as error:
        selection = _plan_on_adjoining(mechanism, goals, reference, duration, crossing)
        if selection is None:
            hint, condition = '', ''
            if change_points == 'choose':
                hint, condition = _missing_condition(mechanism, reference)
            raise ContradictionError(
                f'{error}{hint}', **{**error.values, 'condition': condition}) from None
        assert selection.branch is not None
        if change_points != 'choose':
            name = selection.branch.name
            raise ContradictionError(
                f'{error}; they do on the {name} branch, which change_points: choose allows',
                **{**error.values, 'branch': name}) from None
        return selection
    return BranchSelection(step, reference.angles, goal, branch)


def _plan_on_adjoining(mechanism: Mechanism, goals: dict[int, float],
                       reference: ReferenceGenerator, duration: float, crossing: bool
                       ) -> BranchSelection | None:
    """Plan on the branch that meets the present one; None if the setpoint does not fit it."""
    if reference.branch is None or not reference.resting:
        return None
    other = adjoining_branch(mechanism, reference.branch, reference.angles)
    if other is None:
        return None
    present, start = other.nearest(reference.angles), np.zeros((3, 2))
    start[0] = present[other.axes]
    try:
        step, goal = plan(mechanism, goals, start, present, present, duration, crossing=crossing,
                          branch=other)
    except ContradictionError:
        return None
    opened = float(np.diff(step.goal - start[0])[0])
    if abs(opened) <= IN_LINE_ANGLE:
        return None
    return BranchSelection(step, present, goal, other)


def _missing_condition(mechanism: Mechanism, reference: ReferenceGenerator) -> tuple[str, str]:
    """Return why no other branch can be selected, as text and as one word, or ''."""
    if reference.branch is None:
        return '', ''
    if not is_rhombus(mechanism):
        lengths = mechanism.link_lengths
        return (f'; another branch can be selected only with links of one length, here '
                f'{lengths.min():.6g} to {lengths.max():.6g} m'), 'rhombus'
    if not reference.resting or not at_change_point(reference.branch, reference.angles):
        return ('; another branch can be selected only where the reference rests at a change '
                f'point, within {IN_LINE_ANGLE:g} rad'), 'rest_at_change_point'
    return '', ''
