# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Results of the estimator at a tick."""

from __future__ import annotations

from typing import NamedTuple

from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

SAMPLE_STATUSES = ('accepted', 'gated', 'late', 'not finite', 'no data', 'repeats', 'faulty')
"""Status of the newest sample of a sensor at a tick; messages carry the index."""

ACCEPTED, GATED, LATE, NOT_FINITE, NO_DATA, STUCK, EXCLUDED = range(len(SAMPLE_STATUSES))


class SampleStatus(NamedTuple):
    """
    Status of the newest sample of a sensor.

    :param sensor: index of `SENSOR_NAMES`.
    :param status: index of `SAMPLE_STATUSES`.
    :param nis: normalised innovation squared of the angle, chi-square of one degree of freedom
        for a consistent filter; 0 without innovation.
    """

    sensor: int
    status: int
    nis: float = 0.0


class Innovation(NamedTuple):
    """
    Innovation of one measurement update.

    :param sensors: of the m samples, indices of `SENSOR_NAMES`, from `GYROS` on of their gyros.
    :param values: (m,) measured minus predicted [rad], of gyros [rad/s].
    :param sample_nis: (m,) NIS of each sample.
    :param statuses: (m,) status of each sample: ACCEPTED, GATED or EXCLUDED.
    :param nis: NIS of the accepted samples together, chi-square of as many degrees of freedom for
        a consistent filter.
    :param degrees_of_freedom: number of accepted samples.
    """

    sensors: tuple[int, ...]
    values: Array
    sample_nis: Array
    statuses: NDArray[np.int64]
    nis: float
    degrees_of_freedom: int

    @property
    def used(self) -> NDArray[np.bool_]:
        """Whether each sample was accepted (m,)."""
        used: NDArray[np.bool_] = self.statuses == ACCEPTED
        return used


class Estimate(NamedTuple):
    """
    Estimate of the state of the links at a tick, with its uncertainty.

    :param stamp_ns: the tick [ns].
    :param link_angles: (4,) continuous [rad].
    :param link_rates: (4,) [rad/s].
    :param angle_sigmas: (4,) standard deviations [rad].
    :param rate_sigmas: (4,) standard deviations [rad/s].
    :param covariance: (4, 4) of the free state, in the order of `STATE_NAMES`.
    :param disturbance: (2,) disturbance torques on links a and b [N m].
    :param disturbance_sigmas: (2,) standard deviations [N m].
    :param gyro_biases: [rad/s] by index of `SENSOR_NAMES`, of the gyros that have sent a sample.
    :param innovation: of the newest measurement that arrived since the last tick and updated the
        filter, None without one.
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
        """Disturbance torques on the four links (4,) [N m]."""
        torques = np.zeros(4)
        torques[:2] = self.disturbance
        return torques
