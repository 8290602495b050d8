# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The metrics of a run of a campaign.

They are those of `analysis.metrics`, over all setpoints of the script instead of one.
"""

from __future__ import annotations

from typing import NamedTuple


class MetricDescription(NamedTuple):
    """Unit and definition of a metric."""

    unit: str
    definition: str


# Every metric by the name of its column.
METRICS = {
    'tracking_rms_rad': MetricDescription(
        'rad', 'true minus reference angles of links a and b since the first setpoint, rms'),
    'tracking_peak_rad': MetricDescription('rad', 'largest absolute value of the same'),
    'final_error_rad': MetricDescription(
        'rad', 'true angle minus goal of the last setpoint, mean over the last second, of the '
        'link with the largest; empty if the motion is not over by then'),
    'estimate_rms_rad': MetricDescription(
        'rad', 'estimated minus true angles of four links since the first setpoint, rms'),
    'estimate_peak_rad': MetricDescription('rad', 'largest absolute value of the same'),
    'nees_per_degree_of_freedom': MetricDescription(
        '', 'normalised estimation error squared of angles and rates of links a and b, mean over '
        '4; 1 for a consistent estimator'),
    'nis_per_degree_of_freedom': MetricDescription('', 'normalised innovation squared, likewise'),
    'peak_wheel_speed_rad_s': MetricDescription(
        'rad/s', 'largest speed of a wheel relative to its link'),
    'peak_torque_n_m': MetricDescription(
        'N m', 'largest torque of a motor, mean over a control period'),
    'work_j': MetricDescription(
        'J', 'absolute mechanical work of the motors since the first setpoint'),
    'copper_loss_j': MetricDescription('J', 'heat in the windings, likewise'),
    'eq9_j_s': MetricDescription('J s', 'actuation cost of paper eq. 9, likewise'),
    'speed_margin': MetricDescription('', 'smallest unused share of the speed limit of a wheel'),
}
