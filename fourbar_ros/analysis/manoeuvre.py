# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Find one setpoint and the motion that answers it in a recording, and bring topics together.

Messages of different topics belong together when their stamps are equal to the nanosecond.
Recorder time decides one thing only: which tick came next when the setpoint arrived, since a
setpoint from the command line carries no stamp.
"""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.analysis.bags import BagError, Floats, JointSeries, Nanoseconds, Recording
from fourbar_ros.common.names import (
    CONTROLLER_STATUS,
    ESTIMATE_LINK_STATES,
    FLYWHEEL_STATES,
    REFERENCE,
    SETPOINT,
)
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.mechanism.angles import wrap_angles
import numpy as np

ESSENTIAL_TOPICS = (SETPOINT, REFERENCE, ESTIMATE_LINK_STATES, FLYWHEEL_STATES)

DEFAULT_SETPOINT_DURATION_S = 10.0
# The recorder can hear a setpoint this much earlier or later than the controller acts on it.
START_SEARCH_S = 1.0
# A reference this far from the goal after the step has left it: the device was disarmed.
AT_GOAL_RAD = 1e-3
# A reference that came this much closer to the goal did so on purpose: a disarmed controller
# shows the estimate as reference, and that wanders by its noise.
FOLLOWED_RAD = 1e-2


@dataclass(frozen=True)
class Motion:
    """
    One setpoint and what the controller made of it; times are stamps of ticks [ns].

    :param goal: (4,) rad; for a link that the setpoint does not name, where the reference ends.
    :param initial: (4,) rad, the reference at the start.
    :param start_ns: the last tick at which the reference stood still.
    :param step_end_ns: start plus the controller's setpoint_duration.
    :param end_ns: the last tick at which the reference held the goal, or the last of all.
    :param setpoint_number: of this setpoint among all in the recording, from 1.
    :param setpoint_count: how many setpoints there are.
    """

    goal: Floats
    initial: Floats
    start_ns: int
    step_end_ns: int
    end_ns: int
    setpoint_number: int
    setpoint_count: int

    @property
    def complete(self) -> bool:
        """Tell whether the recording goes on after the end of the step."""
        return self.end_ns > self.step_end_ns

    def seconds(self, stamp_ns: Nanoseconds) -> Floats:
        """Return the time since the start [s]."""
        return (stamp_ns - self.start_ns).astype(np.float64) * 1e-9


@dataclass(frozen=True)
class Paired:
    """Two series at the stamps that they share."""

    stamp_ns: Nanoseconds
    left: JointSeries
    right: JointSeries

    @property
    def difference(self) -> Floats:
        """Return left minus right position, in (-pi, pi] [rad]."""
        return wrap_angles(self.left.position - self.right.position)


def pair(left: JointSeries, right: JointSeries, names: tuple[str, ...]) -> Paired:
    """
    Bring together the messages of two topics that carry the same stamp.

    Where there are none, since nobody ticks for both (as for the truth of an emulated prototype),
    what lies between the messages on the right counts.

    :param left: in order of stamps, each once; so is right.
    :raises BagError: no stamp of left is in both, or between messages of right.
    """
    stamps, in_left, in_right = np.intersect1d(
        left.stamp_ns, right.stamp_ns, assume_unique=True, return_indices=True)
    if not len(stamps):
        between = right.select(names).at(left.stamp_ns)
        if len(between):
            known = np.isin(left.stamp_ns, between.stamp_ns)
            return Paired(between.stamp_ns, left.select(names).rows(known), between)
        raise BagError(f'{left.topic} and {right.topic} have no stamp in common')
    return Paired(stamps, left.select(names).rows(in_left), right.select(names).rows(in_right))


def find_motion(recording: Recording) -> Motion:
    """
    Find the last setpoint that the reference followed.

    :raises BagError: an essential topic is missing, or the reference followed no setpoint.
    """
    for name in ESSENTIAL_TOPICS:
        recording.arrivals(name)
    setpoints = recording.arrivals(SETPOINT).select(LINK_NAMES)
    reference = recording.joint_states(REFERENCE).select(LINK_NAMES)
    duration_ns = round(setpoint_duration_s(recording) * 1e9)
    for number in reversed(range(len(setpoints))):
        start = _start(reference, int(setpoints.received_ns[number]))
        answer = reference.rows(slice(start, None))
        goal_and_end = _follow(answer, setpoints.position[number], duration_ns)
        if goal_and_end is not None:
            goal, end_ns = goal_and_end
            start_ns = int(answer.stamp_ns[0])
            return Motion(goal, answer.position[0], start_ns, start_ns + duration_ns, end_ns,
                          number + 1, len(setpoints))
    raise BagError(f'{recording.path}: the reference followed no setpoint out of '
                   f'{len(setpoints)} (was the device armed?)')


def setpoint_duration_s(recording: Recording) -> float:
    """Return how long the controller takes for a setpoint, from its status, else 10 s."""
    if recording.has(CONTROLLER_STATUS):
        for status in reversed(recording.statuses(CONTROLLER_STATUS)):
            text = status.values.get('setpoint_duration_s', '')
            try:
                return float(text)
            except ValueError:
                continue
    return DEFAULT_SETPOINT_DURATION_S


def _start(reference: JointSeries, arrival_ns: int) -> int:
    """
    Return the index of the last reference at rest before the step.

    From the reference that was received next, search to where the reference begins to move. If
    it does not (the goal is where it is, or it was moving already), that next one is the start.
    """
    received_later = np.flatnonzero(reference.received_ns >= arrival_ns)
    following = int(received_later[0]) if len(received_later) else len(reference) - 1
    moving = np.any(np.nan_to_num(reference.velocity) != 0.0, axis=1)
    apart_ns = np.abs(reference.stamp_ns - reference.stamp_ns[following])
    near = apart_ns <= START_SEARCH_S * 1e9
    begins = np.flatnonzero(near[:-1] & ~moving[:-1] & moving[1:])
    return int(begins[np.argmin(apart_ns[begins])]) if len(begins) else following


def _follow(answer: JointSeries, asked: Floats, duration_ns: int) -> tuple[Floats, int] | None:
    """Return the goal and the last stamp at it; None if the reference did not go there."""
    if not np.any(np.isfinite(asked)):
        return None
    # One tick more, as the first reference of a step may be that of the tick after the start.
    step_end = int(np.searchsorted(answer.stamp_ns, answer.stamp_ns[0] + duration_ns)) + 1
    step_end = min(step_end, len(answer) - 1)
    goal = np.where(np.isfinite(asked), asked, answer.position[step_end])
    away = np.nanmax(np.abs(wrap_angles(answer.position - goal)), axis=1)
    arrived = away[step_end] <= AT_GOAL_RAD
    if not arrived and away[step_end] > away[0] - FOLLOWED_RAD:
        return None
    left = np.flatnonzero(away[step_end:] > AT_GOAL_RAD)
    last = step_end + int(left[0]) - 1 if arrived and len(left) else len(answer) - 1
    return goal, int(answer.stamp_ns[last])
