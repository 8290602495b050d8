# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters of the controller: for its node and for scenarios."""

from __future__ import annotations

from fourbar_ros.common.settings import Parameter
from fourbar_ros.control.allocation import ALLOCATIONS
from fourbar_ros.control.settings import (
    CHANGE_POINTS,
    COMMANDS,
    ControllerSettings,
    TIMINGS,
    WHEEL_TARGETS,
)

_DEFAULTS = ControllerSettings()

SETTINGS = (
    Parameter('bandwidth', _DEFAULTS.bandwidth, 'rad/s', 'natural frequency of tracking errors',
              limits=(0.1, 20.0), live=True),
    Parameter('damping', _DEFAULTS.damping, '', 'damping ratio of tracking errors',
              limits=(0.1, 2.0), live=True),
    Parameter('setpoint_duration', _DEFAULTS.setpoint_duration, 's',
              'time in which a setpoint is reached', limits=(0.1, 3600.0), live=True),
    Parameter('setpoint_timing', _DEFAULTS.setpoint_timing, '',
              'that time, or the shortest that the wheels allow', choices=TIMINGS, live=True),
    Parameter('command', _DEFAULTS.command, '', 'what the wheels are told', choices=COMMANDS,
              live=True),
    Parameter('allocation', _DEFAULTS.allocation, '', 'how the wheels share', choices=ALLOCATIONS,
              live=True),
    Parameter('wheel_target', _DEFAULTS.wheel_target, '',
              'where the freedom that moves no link leads the speeds of the wheels',
              choices=WHEEL_TARGETS, live=True),
    Parameter('wheel_bias', _DEFAULTS.wheel_bias, 'rad/s', 'speed for the target `bias`',
              limits=(-1000.0, 1000.0), live=True),
    Parameter('wheel_bandwidth', _DEFAULTS.wheel_bandwidth, 'rad/s',
              'how fast wheel speeds go to their target', limits=(0.0, 10.0), live=True),
    Parameter('disturbance_compensation', _DEFAULTS.disturbance_compensation, '',
              'share of the estimated disturbance that is compensated', limits=(0.0, 1.0),
              live=True),
    Parameter('bearing_coulomb', _DEFAULTS.bearing_coulomb, 'N m',
              'Coulomb friction of the bearings of the wheels', limits=(0.0, 10.0), live=True),
    Parameter('bearing_viscous', _DEFAULTS.bearing_viscous, 'N m s',
              'viscous friction of the same', limits=(0.0, 10.0), live=True),
    Parameter('rest_band', _DEFAULTS.rest_band, 'rad',
              'errors of the configuration that do nothing at rest, where joints stick',
              limits=(0.0, 0.1), live=True),
    Parameter('change_points', _DEFAULTS.change_points, '',
              'refuse moves that meet a change point, keep to the branch there, or choose it',
              choices=CHANGE_POINTS, live=True),
    Parameter('branch_bandwidth', _DEFAULTS.branch_bandwidth, 'rad/s',
              'natural frequency of the hold on the branch at change points',
              limits=(0.0, 20.0), live=True),
)
"""The fields of `ControllerSettings`."""

PARAMETERS = (
    Parameter('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    *SETTINGS,
)
"""All parameters of the node."""
