# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Settings of the estimator: for its node, for scenarios and for the replay of a bag."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from fourbar_ros.common.settings import Setting, setting, Settings, settings_of
from fourbar_ros.estimation.filter_model import ProcessNoise
from fourbar_ros.estimation.filter_state import GYROS
from fourbar_ros.mechanism.constants import Array
import numpy as np
from scipy.special import ndtri


@dataclass(frozen=True)
class EstimatorSettings(Settings):
    """Noise of the sensors and of the process; docs/estimation.md tells how to choose it."""

    angle_noise: float = setting(
        1.7453e-3, 'rad', 'standard deviation of a link-angle sample', low=1e-9, high=1.0)
    counts_per_turn: int = setting(
        16384, '', 'resolution of the link-angle sensors, 0 for none', low=0, high=2 ** 31)
    gyro_noise: float = setting(
        5e-3, 'rad/s', 'standard deviation of a gyro sample, where gyros are fitted', low=1e-9,
        high=100.0)
    gyro_walk: float = setting(
        1e-4, 'rad/s/sqrt(s)', 'density of the random walk of the bias of a gyro', low=0.0,
        high=10.0)
    disturbance_torque: float = setting(
        1e-7, 'N m/sqrt(Hz)', 'density of unknown torques on each link', low=0.0, high=10.0)
    disturbance_walk: float = setting(
        1e-7, 'N m/sqrt(s)', 'density of the random walk of the disturbance torques on links a '
        'and b (friction, drag)', low=0.0, high=10.0)
    closure_tolerance: float = setting(
        0.0, 'm', 'standard deviation of the closure error with the nominal link lengths, 0 for '
        'exact lengths', low=0.0, high=0.1)
    gate_probability: float = setting(
        0.9999, '', 'fraction of the samples of a healthy sensor that the gate accepts, 1 for no '
        'gate', low=0.9, high=1.0)

    @property
    def gate(self) -> float:
        """Largest NIS of an accepted sample: chi-square quantile of one degree of freedom."""
        return float(ndtri(0.5 + 0.5 * self.gate_probability) ** 2)

    @property
    def angle_variance(self) -> float:
        """Variance of an angle sample, rounding included [rad^2]."""
        step = 2.0 * pi / self.counts_per_turn if self.counts_per_turn else 0.0
        return self.angle_noise ** 2 + step ** 2 / 12.0

    @property
    def variances(self) -> Array:
        """Variance of a sample of each sensor [rad^2], then of each gyro [rad^2/s^2]."""
        return np.repeat([self.angle_variance, self.gyro_noise ** 2], GYROS)

    @property
    def process_noise(self) -> ProcessNoise:
        """Densities of the process noise."""
        return ProcessNoise(self.disturbance_torque, self.disturbance_walk, self.gyro_walk,
                            self.closure_tolerance)


SETTINGS = settings_of(EstimatorSettings)

PARAMETERS = (
    Setting('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    *SETTINGS,
)
"""All parameters of the node."""
