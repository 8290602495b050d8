# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What the filter assumes of the sensors and of the world."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from fourbar_ros.estimation.filter import GYROS, ProcessNoise
from fourbar_ros.mechanism.constants import Array
import numpy as np
from scipy.special import ndtri


@dataclass(frozen=True)
class EstimatorSettings:
    """
    What the filter assumes.

    :param angle_noise: standard deviation of a link-angle sample [rad].
    :param counts_per_turn: resolution of the link-angle sensors, 0 for none.
    :param gyro_noise: standard deviation of a gyro's sample [rad/s].
    :param gyro_walk: density of the random walk of a gyro's bias [rad/s/sqrt(s)].
    :param disturbance_torque: density of unknown torques on each link [N m/sqrt(Hz)].
    :param disturbance_walk: density of the random walk of the torques on links a and b that stand
        for friction and drag [N m/sqrt(s)].
    :param closure_tolerance: how far the loop fails to close with the lengths that are given, as
        a standard deviation [m]; 0 where these are exact.
    :param gate_probability: share of the samples of a healthy sensor that are used; the rest lies
        farther off than noise should have it.
    """

    angle_noise: float = 1.7453e-3
    counts_per_turn: int = 16384
    gyro_noise: float = 5e-3
    gyro_walk: float = 1e-4
    disturbance_torque: float = 1e-7
    disturbance_walk: float = 1e-7
    closure_tolerance: float = 0.0
    gate_probability: float = 0.9999

    @property
    def gate(self) -> float:
        """Largest NIS of one sensor that is used: chi-square of one degree of freedom."""
        return float(ndtri(0.5 + 0.5 * self.gate_probability) ** 2)

    @property
    def angle_variance(self) -> float:
        """Variance of one sample of an angle, rounding included [rad^2]."""
        step = 2.0 * pi / self.counts_per_turn if self.counts_per_turn else 0.0
        return self.angle_noise ** 2 + step ** 2 / 12.0

    @property
    def variances(self) -> Array:
        """Variance of a sample of every sensor (GYROS,) [rad^2], then of its gyro [rad^2/s^2]."""
        return np.repeat([self.angle_variance, self.gyro_noise ** 2], GYROS)

    @property
    def randomness(self) -> ProcessNoise:
        """What acts on the linkage at random."""
        return ProcessNoise(self.disturbance_torque, self.disturbance_walk, self.gyro_walk,
                          self.closure_tolerance)
