# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters of the estimator: for its node, for scenarios and for the replay of a bag."""

from __future__ import annotations

from fourbar_ros.common.settings import Setting
from fourbar_ros.estimation.settings import EstimatorSettings

_DEFAULTS = EstimatorSettings()

SETTINGS = (
    Setting('angle_noise', _DEFAULTS.angle_noise, 'rad',
              'standard deviation of a link-angle sample', low=1e-9, high=1.0),
    Setting('counts_per_turn', _DEFAULTS.counts_per_turn, '',
              'resolution of the link-angle sensors, 0 for none', low=0, high=2 ** 31),
    Setting('gyro_noise', _DEFAULTS.gyro_noise, 'rad/s',
              'standard deviation of a gyro sample, where gyros are fitted', low=1e-9, high=100.0),
    Setting('gyro_walk', _DEFAULTS.gyro_walk, 'rad/s/sqrt(s)',
              'density of the random walk of the bias of a gyro', low=0.0, high=10.0),
    Setting('disturbance_torque', _DEFAULTS.disturbance_torque, 'N m/sqrt(Hz)',
              'density of unknown torques on each link', low=0.0, high=10.0),
    Setting('disturbance_walk', _DEFAULTS.disturbance_walk, 'N m/sqrt(s)',
              'density of the random walk of the torques that stand for friction and drag',
              low=0.0, high=10.0),
    Setting('closure_tolerance', _DEFAULTS.closure_tolerance, 'm',
              'how far the loop fails to close with the lengths given, as a standard deviation',
              low=0.0, high=0.1),
    Setting('gate_probability', _DEFAULTS.gate_probability, '',
              'share of the samples of a healthy sensor that is used, 1 for no gate',
              low=0.9, high=1.0),
)
"""The fields of `EstimatorSettings`."""

PARAMETERS = (
    Setting('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    *SETTINGS,
)
"""All parameters of the node."""
