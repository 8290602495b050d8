# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Reference of the links at each tick, and the trajectory segment that it is on."""

from __future__ import annotations

from fourbar_ros.control.branch import Branch, branch_at
from fourbar_ros.control.setpoint import follow_path, SetpointError
from fourbar_ros.control.soft_step import SoftStep, TrajectorySegment
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import Mechanism, nearest_assembly
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
import numpy as np
from numpy.typing import NDArray

# Time in which an aborted move comes to rest [s]; less near a change point.
STOPPING_TIME = 1.0

# Distance of a stop, in rate times time: the quintic that comes to rest without overshoot.
STOPPING_DISTANCE = 0.5


class ReferenceGenerator:
    """
    Generates the reference of all four links.

    :param mechanism: the model of the linkage.
    :ivar links: (3, 4) angles, continuous [rad], rates [rad/s] and accelerations [rad/s^2] of the
        links; changed in place. Accelerations of links besides the axes are without the part that
        their changing gearing adds.
    :ivar angles, rates, accelerations: (4,) the rows of `links`.
    :ivar goal: (4,) end of the last accepted move, None without one [rad].
    :ivar branch: branch on which links turn in pairs; None where they do not.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.links = np.zeros((3, 4))
        self.angles: Array = self.links[0]
        self.rates: Array = self.links[1]
        self.accelerations: Array = self.links[2]
        self.goal: Array | None = None
        self.branch: Branch | None = None
        self._mechanism = mechanism
        self._motion = np.zeros((3, 2))
        self._offsets = np.zeros(2)
        self._segment: TrajectorySegment | None = None
        self._start_ns = 0

    @property
    def motion(self) -> Array:
        """Angle, rate and acceleration of the two axes now (3, 2) [rad, rad/s, rad/s^2]."""
        return self._motion

    @property
    def axes(self) -> list[int]:
        """Links that are its axes: a and b, or the first of each pair."""
        return [0, 1] if self.branch is None else self.branch.axes

    @property
    def paired(self) -> bool:
        """Whether links turn in pairs."""
        return self.branch is not None

    @property
    def resting(self) -> bool:
        """Whether the reference is at rest."""
        return self._segment is None and not self._motion[1:].any()

    @property
    def moving(self) -> bool:
        """Whether a segment is under way."""
        return self._segment is not None

    @property
    def destination(self) -> Array:
        """Link angles at the end of the move, or now (4,) [rad]."""
        if self._segment is None or self.goal is None:
            return np.array(self.angles)
        return self.goal

    def rest_at(self, angles: Array, *, any_branch: bool = False) -> None:
        """
        Rest at the measured links, without a goal.

        :param angles: (4,) [rad].
        :param any_branch: whether branches other than the parallelogram are considered.
        """
        self._segment = self.goal = None
        self._rest_on(branch_at(self._mechanism, angles, any_branch=any_branch), angles)

    def switch_branch(self, branch: Branch) -> None:
        """Rest on another branch, where it meets the present one."""
        self._rest_on(branch, self.angles)

    def track_links(self, angles: Array) -> None:
        """Set the reference to the measured links, while nothing drives them (4,) [rad]."""
        self._segment = None
        self.angles[:] = angles
        self._set_axes(angles)

    def start(self, segment: TrajectorySegment, goal: Array, start_ns: int) -> None:
        """
        Start a segment.

        :param segment: from the present motion.
        :param goal: (4,) link angles at its end [rad].
        :param start_ns: time of its start [ns].
        """
        self._segment, self.goal, self._start_ns = segment, goal, start_ns

    def stop(self, start_ns: int) -> None:
        """Abort a move and come to rest soon; the rate stays continuous."""
        self.goal = None
        if self.resting:
            return
        time = STOPPING_TIME
        while time > 0.05:
            stop = SoftStep(
                self._motion.copy(),
                self._motion[0] + STOPPING_DISTANCE * time * self._motion[1], time)
            try:
                end = follow_path(self._mechanism, stop, self.angles, crossing=self.paired,
                                  branch=self.branch)[-1]
            except SetpointError:
                # A change point is nearer than that.
                time *= 0.5
                continue
            self.start(stop, end, start_ns)
            return
        self._segment = None
        self._set_axes()

    def stop_from(self, angles: Array, rates: Array, start_ns: int, *, any_branch: bool = False
                  ) -> None:
        """
        Start from the measured motion of the links, and bring the reference to rest.

        :param angles, rates: (4,) [rad], [rad/s].
        :param any_branch: see :meth:`rest_at`.
        """
        self.rest_at(angles, any_branch=any_branch)
        self._motion[1] = rates[self.axes]
        self.stop(start_ns)
        self.goal = None

    def advance(self, stamp_ns: int) -> bool:
        """
        Advance to a tick.

        :returns: whether a segment has just ended.
        """
        segment = self._segment
        if segment is None:
            return False
        elapsed = (stamp_ns - self._start_ns) * 1e-9
        self._motion[:] = segment.at(elapsed)
        if self.branch is None:
            self._update_links()
        else:
            set_pairs(self._motion, self.branch.paired_links, self._offsets, self.links)
        if elapsed >= segment.duration:
            self._segment = None
            return True
        return False

    def time_left(self, stamp_ns: int) -> float:
        """Return the remaining time of the segment [s]."""
        segment = self._segment
        return 0.0 if segment is None else segment.duration - (stamp_ns - self._start_ns) * 1e-9

    def _rest_on(self, branch: Branch | None, angles: Array) -> None:
        self.branch = branch
        self.angles[:] = angles
        if branch is not None:
            # Whole turns are kept.
            self.angles[:] = branch.nearest(self.angles)
            self._offsets = branch.offsets(self.angles)
        self._set_axes(self.angles)

    def _set_axes(self, angles: Array | None = None) -> None:
        """Bring the axes to rest, at link angles (4,) or where they are."""
        if angles is not None:
            self._motion[0] = angles[self.axes]
        self._motion[1:] = 0.0
        self.rates[:] = self.accelerations[:] = 0.0

    def _update_links(self) -> None:
        motion = self._motion
        self.angles[:] = nearest_assembly(
            self._mechanism, (0, 1), (motion[0, 0], motion[0, 1]), self.angles)
        # A planned move keeps its distance from change points, so Gamma exists here.
        gamma = gamma_matrix(self.angles, self._mechanism.link_lengths)
        for values, of_axes in ((self.rates, motion[1]), (self.accelerations, motion[2])):
            values[:2] = of_axes
            values[2:] = gamma @ of_axes


@kernel
def set_pairs(motion: Array, paired_links: NDArray[np.int64], offsets: Array, links: Array
              ) -> None:
    """
    Set the motion of links that turn in pairs to that of the two axes, in place.

    :param motion: (3, 2) angles, rates and accelerations of the axes [rad, rad/s, rad/s^2].
    :param paired_links: (4,) first links of both pairs, then second links.
    :param offsets: (2,) angles of second links relative to first links [rad].
    :param links: (3, 4) the same of the links.
    """
    for axis in range(2):
        first, second = paired_links[axis], paired_links[axis + 2]
        for row in range(3):
            links[row, first] = links[row, second] = motion[row, axis]
        links[0, second] += offsets[axis]
