# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Branches on which the links turn in two pairs, and the change points where two branches meet.

If opposite links are equally long, a turns with c and b with d: the parallelogram. If all four
links are equally long, there are two more branches. On the folded branch joint 4 lies on joint 2,
and a turns with b and c with d; on the crossed branch joint 3 lies on joint 1, and a turns with d
and b with c. Two branches meet where all links are in line: the change points
(docs/mechanics.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi, sin

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.angles import wrap
from fourbar_ros.mechanism.change_points import (
    BRANCH_TOLERANCE,
    EQUAL_LENGTHS,
    IN_LINE_ANGLE,
)
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Branch:
    """
    A branch on which the links turn in two pairs.

    :param name: of the branch.
    :param pairs: of link indices; link a is the first of the first pair.
    :param pair_angle: of the second link of each pair, relative to the first [rad].
    :ivar paired_links: (4,) for kernels: first links of both pairs, then second links.
    """

    name: str
    pairs: tuple[tuple[int, int], tuple[int, int]]
    pair_angle: float
    paired_links: NDArray[np.int64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        (p1, p2), (q1, q2) = self.pairs
        object.__setattr__(self, 'paired_links', np.array([p1, q1, p2, q2], dtype=np.int64))

    @property
    def axes(self) -> list[int]:
        """First links of both pairs, which the axes are named after."""
        return [self.pairs[0][0], self.pairs[1][0]]

    @property
    def followers(self) -> list[int]:
        """Second links of both pairs."""
        return [self.pairs[0][1], self.pairs[1][1]]

    def axis_of(self, link: int) -> int:
        """Return the pair to which a link belongs, 0 or 1."""
        return int(link in self.pairs[1])

    def offsets(self, angles: Array) -> Array:
        """
        Return the angles of second links relative to first links, whole turns included.

        :param angles: (4,) of the links, on the branch or close to it [rad].
        :returns: (2,) [rad].
        """
        ahead = angles[self.followers] - angles[self.axes]
        turns: Array = np.round((ahead - self.pair_angle) / (2.0 * pi))
        return self.pair_angle + 2.0 * pi * turns

    def to_links(self, path: Array, offsets: Array) -> Array:
        """
        Complete angles of the two axes to those of the links: (..., 2) to (..., 4) [rad].

        :param offsets: (2,) see :meth:`offsets`.
        """
        angles = np.empty((*path.shape[:-1], 4))
        angles[..., self.axes] = path
        angles[..., self.followers] = path + offsets
        return angles

    def nearest(self, angles: Array) -> Array:
        """Return the nearest link angles on the branch to measured ones (4,) [rad]."""
        offsets = self.offsets(angles)
        ahead = angles[self.followers] - angles[self.axes]
        return self.to_links(angles[self.axes] + 0.5 * (ahead - offsets), offsets)

    def contains(self, mechanism: Mechanism, angles: Array) -> bool:
        """Return whether link angles (4,) are on this branch, and the linkage has it."""
        ahead = (angles[self.followers] - angles[self.axes]).tolist()
        return (all(abs(wrap(angle - self.pair_angle)) < BRANCH_TOLERANCE for angle in ahead)
                and (opposite_links_equal(mechanism) if self == PARALLELOGRAM
                     else is_rhombus(mechanism)))


PARALLELOGRAM = Branch('parallelogram', ((0, 2), (1, 3)), 0.0)
FOLDED = Branch('folded', ((0, 1), (2, 3)), 0.0)
CROSSED = Branch('crossed', ((0, 3), (1, 2)), pi)

# All branches; where two meet, the first is assumed.
BRANCHES = (PARALLELOGRAM, FOLDED, CROSSED)

# Stands for `paired_links` where links do not turn in pairs: links a and b are the axes.
UNPAIRED_AXES: NDArray[np.int64] = PARALLELOGRAM.paired_links


def opposite_links_equal(mechanism: Mechanism) -> bool:
    """Return whether opposite links are equally long, so that there is a parallelogram."""
    lengths = mechanism.link_lengths
    limit = EQUAL_LENGTHS * float(lengths.mean())
    return bool(np.abs(lengths[:2] - lengths[2:]).max() <= limit)


def is_rhombus(mechanism: Mechanism) -> bool:
    """Return whether all links are equally long, so that there are all branches."""
    lengths = mechanism.link_lengths
    return bool(np.ptp(lengths) <= EQUAL_LENGTHS * float(lengths.mean()))


def on_parallelogram(mechanism: Mechanism, link_angles: ArrayLike) -> bool:
    """
    Return whether the linkage is on the parallelogram branch.

    There opposite links stay parallel, and paths lead through change points. Close to a change
    point the branches cannot be distinguished, and the parallelogram is assumed.

    :param link_angles: (4,) any turns [rad].
    :returns: True where opposite links are equally long and parallel within `BRANCH_TOLERANCE`.
    """
    return PARALLELOGRAM.contains(mechanism, np.asarray(link_angles, dtype=float))


def branch_at(mechanism: Mechanism, link_angles: ArrayLike, *, any_branch: bool = False
              ) -> Branch | None:
    """
    Return the branch that the linkage is on.

    :param link_angles: (4,) any turns [rad].
    :param any_branch: whether branches other than the parallelogram are considered.
    :returns: None where links do not turn in pairs.
    """
    angles = np.asarray(link_angles, dtype=float)
    for branch in BRANCHES if any_branch else BRANCHES[:1]:
        if branch.contains(mechanism, angles):
            return branch
    return None


def at_change_point(branch: Branch, angles: Array) -> bool:
    """Return whether all links (4,) of a linkage on a branch are in line."""
    first, second = branch.axes
    return abs(sin(angles[second] - angles[first])) < IN_LINE_ANGLE


def adjoining_branch(mechanism: Mechanism, branch: Branch, angles: Array) -> Branch | None:
    """
    Return the branch that meets another at a change point.

    :param branch: that the linkage is on.
    :param angles: (4,) of the links [rad].
    :returns: None away from change points, and where links are not equally long.
    """
    if not at_change_point(branch, angles):
        return None
    for other in BRANCHES:
        if other != branch and other.contains(mechanism, angles):
            return other
    return None
