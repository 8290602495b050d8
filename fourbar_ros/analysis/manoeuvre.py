# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Find one setpoint and the response of the reference in a bag, and match messages of topics.

Messages of different topics match if their stamps are equal to the nanosecond. Recorder time
decides only which tick follows the reception of the setpoint, since a setpoint from the command
line has no stamp.
"""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.analysis.bag_reader import bag_error, BagError
from fourbar_ros.analysis.bags import Bag, Floats, JointSeries, Nanoseconds
from fourbar_ros.common import names
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.mechanism.angles import wrap_angles
import numpy as np

ESSENTIAL_TOPICS = (
    names.SETPOINT, names.REFERENCE, names.ESTIMATE_LINK_STATES, names.FLYWHEEL_STATES)

# Duration of a step where the bag has no controller status: the controller's default [s].
DEFAULT_SETPOINT_DURATION_S = 10.0
# Largest time between the recorder's and the controller's reception of a setpoint [s].
START_SEARCH_S = 1.0
# Distance from the goal beyond which the reference has left it (device disarmed) [rad].
AT_GOAL_RAD = 1e-3
# Approach to the goal that counts as following [rad]. Without arming the reference equals the
# estimate, whose noise is smaller than this.
FOLLOWED_RAD = 1e-2


@dataclass(frozen=True)
class Manoeuvre:
    """
    One setpoint and the response of the reference; times are stamps of ticks [ns].

    :param bag: the recording.
    :param goal: (4,) [rad]; final reference for a link that the setpoint does not name.
    :param initial: (4,) reference at the start [rad].
    :param start_ns: last tick at which the reference was at rest.
    :param step_end_ns: start plus the controller's setpoint_duration.
    :param end_ns: last tick at which the reference held the goal, or last tick of the bag.
    :param setpoint_number: of this setpoint in the bag, from 1.
    :param setpoint_count: number of setpoints in the bag.
    """

    bag: Bag
    goal: Floats
    initial: Floats
    start_ns: int
    step_end_ns: int
    end_ns: int
    setpoint_number: int
    setpoint_count: int

    @property
    def complete(self) -> bool:
        """Whether the bag continues after the end of the step."""
        return self.end_ns > self.step_end_ns

    def seconds(self, stamp_ns: Nanoseconds) -> Floats:
        """Return the time since the start [s]."""
        return (stamp_ns - self.start_ns).astype(np.float64) * 1e-9

    def series(self, name: str, end_ns: int | None = None, lead_s: float = 0.0) -> JointSeries:
        """
        Return the messages of a topic from the start on.

        :param end_ns: last stamp, by default the end of the manoeuvre [ns].
        :param lead_s: how long before the start the series begins [s].
        :raises BagError: no such topic, or no message in this time.
        """
        series = self.bag.joint_states(name).between(
            self.start_ns - round(lead_s * 1e9), self.end_ns if end_ns is None else end_ns)
        if not len(series):
            raise bag_error(self.bag.path, 'no_data',
                            f': no message on {series.topic} since the setpoint',
                            topic=series.topic)
        return series


@dataclass(frozen=True)
class MatchedSeries:
    """Messages of two topics at the same stamps, with the same columns."""

    stamp_ns: Nanoseconds
    left: JointSeries
    right: JointSeries

    @property
    def difference(self) -> Floats:
        """Left minus right position, in (-pi, pi] [rad]."""
        return wrap_angles(self.left.position - self.right.position)


def match_stamps(left: JointSeries, right: JointSeries, joints: tuple[str, ...]
                 ) -> MatchedSeries:
    """
    Match the messages of two topics by stamp.

    Without any common stamp (ground truth of an emulated prototype has its own stamps), values of
    the right topic are interpolated at the stamps of the left one.

    :param left, right: in order of stamps, each stamp once.
    :param joints: columns of the result.
    :raises BagError: no common stamp, and no stamp of left between messages of right.
    """
    stamps, in_left, in_right = np.intersect1d(
        left.stamp_ns, right.stamp_ns, assume_unique=True, return_indices=True)
    left, right = left.select(joints), right.select(joints)
    if len(stamps):
        return MatchedSeries(stamps, left.rows(in_left), right.rows(in_right))
    right = right.interpolated(left.stamp_ns)
    if not len(right):
        raise BagError(f'{left.topic} and {right.topic} have no stamp in common',
                       reason='no_data', topic=left.topic)
    return MatchedSeries(
        right.stamp_ns, left.rows(np.isin(left.stamp_ns, right.stamp_ns)), right)


def find_manoeuvre(bag: Bag) -> Manoeuvre:
    """
    Find the last setpoint that the reference followed.

    :raises BagError: an essential topic is missing, or the reference followed no setpoint.
    """
    for name in ESSENTIAL_TOPICS:
        bag.arrivals(name)
    setpoints = bag.arrivals(names.SETPOINT).select(LINK_NAMES)
    reference = bag.joint_states(names.REFERENCE).select(LINK_NAMES)
    duration_ns = round(setpoint_duration_s(bag) * 1e9)
    for number in reversed(range(len(setpoints))):
        start = _start(reference, int(setpoints.received_ns[number]))
        response = reference.rows(slice(start, None))
        goal_and_end = _follow(response, setpoints.position[number], duration_ns)
        if goal_and_end is not None:
            goal, end_ns = goal_and_end
            start_ns = int(response.stamp_ns[0])
            return Manoeuvre(bag, goal, response.position[0], start_ns, start_ns + duration_ns,
                             end_ns, number + 1, len(setpoints))
    raise bag_error(bag.path, 'no_data', ': the reference followed none of '
                    f'{len(setpoints)} setpoints (was the device armed?)', topic=names.SETPOINT)


def setpoint_duration_s(bag: Bag) -> float:
    """Return the duration of a step from the controller's status, else the default [s]."""
    try:
        return float(bag.last_status(names.CONTROLLER_STATUS, 'setpoint_duration_s'))
    except ValueError:
        return DEFAULT_SETPOINT_DURATION_S


def _start(reference: JointSeries, received_ns: int) -> int:
    """
    Return the index of the last reference at rest before the step.

    The search for the begin of motion is centred on the first reference that was received after
    the setpoint. Without a begin of motion (goal reached already, or in motion already) that
    reference is the start.
    """
    later = np.flatnonzero(reference.received_ns >= received_ns)
    following = int(later[0]) if len(later) else len(reference) - 1
    moving = np.any(np.nan_to_num(reference.velocity) != 0.0, axis=1)
    distance_ns = np.abs(reference.stamp_ns - reference.stamp_ns[following])
    near = distance_ns <= START_SEARCH_S * 1e9
    begins = np.flatnonzero(near[:-1] & ~moving[:-1] & moving[1:])
    return int(begins[np.argmin(distance_ns[begins])]) if len(begins) else following


def _follow(response: JointSeries, setpoint: Floats, duration_ns: int
            ) -> tuple[Floats, int] | None:
    """Return the goal and the last stamp at it; None if the reference did not approach it."""
    if not np.any(np.isfinite(setpoint)):
        return None
    # One tick more: the first reference of a step may be that of the tick after the start.
    step_end = int(np.searchsorted(response.stamp_ns, response.stamp_ns[0] + duration_ns)) + 1
    step_end = min(step_end, len(response) - 1)
    goal = np.where(np.isfinite(setpoint), setpoint, response.position[step_end])
    distance = np.nanmax(np.abs(wrap_angles(response.position - goal)), axis=1)
    arrived = distance[step_end] <= AT_GOAL_RAD
    if not arrived and distance[step_end] > distance[0] - FOLLOWED_RAD:
        return None
    left = np.flatnonzero(distance[step_end:] > AT_GOAL_RAD)
    last = step_end + int(left[0]) - 1 if arrived and len(left) else len(response) - 1
    return goal, int(response.stamp_ns[last])
