# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Where the links should be: the reference and the move that it is on."""

from __future__ import annotations

from fourbar_ros.control.branch import Branch, branch_at
from fourbar_ros.control.setpoint import follow, SetpointError
from fourbar_ros.control.soft_step import SoftStep, TrajectorySegment
from fourbar_ros.mechanism import Mechanism, nearest_assembly
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
import numpy as np

# A move that is given up comes to rest in this time, and so does one that begins in motion [s].
STOPPING_TIME = 1.0
# The distance that it takes, in rate times time: of a quintic that ends at rest and overshoots
# nowhere.
STOPPING_SHARE = 0.5


class ReferenceGenerator:
    """
    The reference of all four links.

    :param mechanism: the linkage that the controller believes in.
    :ivar angles: (4,) continuous [rad].
    :ivar rates: (4,) [rad/s].
    :ivar accelerations: (4,) of the axes; the others follow but for what their change of gearing
        adds [rad/s^2].
    :ivar goal: (4,) where the last accepted move ends, None without one [rad].
    :ivar branch: on which links turn in pairs; None where they do not.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.angles = np.zeros(4)
        self.rates = np.zeros(4)
        self.accelerations = np.zeros(4)
        self.goal: Array | None = None
        self.branch: Branch | None = None
        self._mechanism = mechanism
        self._motion = np.zeros((3, 2))
        self._offsets = np.zeros(2)
        self._way: TrajectorySegment | None = None
        self._start_ns = 0

    @property
    def motion(self) -> Array:
        """Angle, rate and acceleration of the two axes now (3, 2) [rad, rad/s, rad/s^2]."""
        return self._motion

    @property
    def axes(self) -> list[int]:
        """The links that are its axes: a and b, or the first of each pair."""
        return [0, 1] if self.branch is None else self.branch.axes

    @property
    def paired(self) -> bool:
        """Whether links turn in pairs."""
        return self.branch is not None

    @property
    def resting(self) -> bool:
        """Whether nothing of it moves."""
        return self._way is None and not self._motion[1:].any()

    @property
    def moving(self) -> bool:
        """Whether a move is under way."""
        return self._way is not None

    @property
    def destination(self) -> Array:
        """Where the links are going, or are (4,) [rad]."""
        return self.angles if self._way is None or self.goal is None else self.goal

    def begin(self, angles: Array, *, choosing: bool = False) -> None:
        """
        Stand where the links are, without a goal.

        :param angles: (4,) [rad].
        :param choosing: whether branches other than the parallelogram come into question.
        """
        self._way = self.goal = None
        self._stand_on(branch_at(self._mechanism, angles, choosing=choosing), angles)

    def change_to(self, branch: Branch) -> None:
        """Rest on another branch, where it meets the present one."""
        self._stand_on(branch, self.angles)

    def stand_at(self, angles: Array) -> None:
        """Be where the links are, as long as nothing drives them (4,) [rad]."""
        self._way = None
        self.angles[:] = angles
        self._motion[0], self._motion[1:] = angles[self.axes], 0.0
        self.rates[:] = self.accelerations[:] = 0.0

    def go(self, way: TrajectorySegment, goal: Array, start_ns: int) -> None:
        """
        Begin a move.

        :param way: from the present motion.
        :param goal: (4,) where it ends [rad].
        :param start_ns: when [ns].
        """
        self._way, self.goal, self._start_ns = way, goal, start_ns

    def halt(self, start_ns: int) -> None:
        """Give up a move and come to rest soon, without a jump of the reference."""
        self.goal = None
        if self._way is None and not self._motion[1:].any():
            return
        time = STOPPING_TIME
        while time > 0.05:
            stop = SoftStep(
                self._motion.copy(), self._motion[0] + STOPPING_SHARE * time * self._motion[1],
                time)
            try:
                end = follow(self._mechanism, stop, self.angles, crossing=self.paired,
                             branch=self.branch)[-1]
            except SetpointError:
                # A change point is nearer than that.
                time *= 0.5
                continue
            self.go(stop, end, start_ns)
            return
        self._way = None
        self._motion[1:] = 0.0
        self.rates[:] = self.accelerations[:] = 0.0

    def move_from(self, angles: Array, rates: Array, start_ns: int, *, choosing: bool = False
                  ) -> None:
        """
        Take over the links as they move, and bring them to rest.

        :param angles, rates: (4,) [rad], [rad/s].
        :param choosing: as of :meth:`begin`.
        """
        self.begin(angles, choosing=choosing)
        self._motion[1] = rates[self.axes]
        self.halt(start_ns)
        self.goal = None

    def follow(self, stamp_ns: int) -> bool:
        """
        Go on to a tick.

        :returns: whether a move has just ended.
        """
        way = self._way
        if way is None:
            return False
        elapsed = (stamp_ns - self._start_ns) * 1e-9
        self._motion[:] = way.at(elapsed)
        if self.branch is None:
            self._close()
        else:
            self._spread(self.branch)
        if elapsed >= way.duration:
            self._way = None
            return True
        return False

    def time_left(self, stamp_ns: int) -> float:
        """Return how long the move still takes [s]."""
        way = self._way
        return 0.0 if way is None else way.duration - (stamp_ns - self._start_ns) * 1e-9

    def _stand_on(self, branch: Branch | None, angles: Array) -> None:
        self.branch = branch
        self.angles = np.array(angles)
        if branch is not None:
            # On whatever turns they are.
            self.angles = branch.nearest(self.angles)
            self._offsets = branch.offsets(self.angles)
        self._motion[0], self._motion[1:] = self.angles[self.axes], 0.0
        self.rates[:] = self.accelerations[:] = 0.0

    def _spread(self, branch: Branch) -> None:
        for axis, (first, second) in enumerate(branch.pairs):
            for row, values in enumerate((self.angles, self.rates, self.accelerations)):
                values[first] = values[second] = self._motion[row, axis]
            self.angles[second] += self._offsets[axis]

    def _close(self) -> None:
        motion = self._motion
        self.angles = nearest_assembly(
            self._mechanism, (0, 1), (motion[0, 0], motion[0, 1]), self.angles)
        # A planned move keeps its distance from change points, so Gamma exists here.
        gamma = gamma_matrix(self.angles, self._mechanism.link_lengths)
        for values, given in ((self.rates, motion[1]), (self.accelerations, motion[2])):
            values[:2] = given
            values[2:] = gamma @ given
