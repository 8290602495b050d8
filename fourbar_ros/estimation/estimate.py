# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What the estimator tells at a tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

DECISIONS = ('accepted', 'gated', 'late', 'not finite', 'no data', 'repeats', 'faulty')
"""What became of a sensor's sample at a tick; the number in messages is the index."""

ACCEPTED, GATED, LATE, NOT_FINITE, NO_DATA, REPEATS, FAULTY = range(len(DECISIONS))


@dataclass(frozen=True, eq=False)
class Innovation:
    """
    What one update of the filter saw.

    :param sensors: which measured, as indices of `SENSOR_NAMES`, from `GYROS` on their gyros.
    :param values: (m,) measured minus predicted [rad], of gyros [rad/s].
    :param squares: (m,) square of each over its variance.
    :param used: (m,) bool, False where the sample was refused.
    :param nis: normalised square of the used ones, chi-square of as many degrees of freedom if
        all is well.
    """

    sensors: tuple[int, ...]
    values: Array
    squares: Array
    used: NDArray[np.bool_]
    nis: float

    @property
    def degrees_of_freedom(self) -> int:
        """How many samples were used."""
        return int(self.used.sum())


class Decision(NamedTuple):
    """
    What became of the newest sample of a sensor.

    :param sensor: index of `SENSOR_NAMES`.
    :param reason: index of `DECISIONS`.
    :param square: normalised square of the angle's innovation, chi-square of one degree of
        freedom if all is well; 0 where none was worked out.
    """

    sensor: int
    reason: int
    square: float = 0.0


@dataclass(frozen=True, eq=False)
class Estimate:
    """
    The state of the links at a tick, and how well it is known.

    :param stamp_ns: the tick [ns].
    :param link_angles: (4,) continuous [rad].
    :param link_rates: (4,) [rad/s].
    :param angle_sigmas: (4,) one standard deviation [rad].
    :param rate_sigmas: (4,) one standard deviation [rad/s].
    :param covariance: (4, 4) of the free state, see `STATE_NAMES`.
    :param disturbance: (2,) torques on links a and b besides those of the wheels [N m].
    :param disturbance_sigmas: (2,) one standard deviation [N m].
    :param gyro_biases: [rad/s] by index of `SENSOR_NAMES`, of the gyros that were heard of.
    :param innovation: of the newest measurement that arrived since the last tick and corrected
        the filter, None without one.
    """

    stamp_ns: int
    link_angles: Array
    link_rates: Array
    angle_sigmas: Array
    rate_sigmas: Array
    covariance: Array
    disturbance: Array
    disturbance_sigmas: Array
    gyro_biases: dict[int, float]
    innovation: Innovation | None

    @property
    def link_torques(self) -> Array:
        """Return the disturbance as torques on the four links (4,) [N m]."""
        torques = np.zeros(4)
        torques[:2] = self.disturbance
        return torques
