# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters of the controller: for its node and for scenarios."""

from __future__ import annotations

from fourbar_ros.common.settings import Setting
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
    Setting('bandwidth', _DEFAULTS.bandwidth, 'rad/s', 'natural frequency of tracking errors',
              low=0.1, high=20.0, live=True),
    Setting('damping', _DEFAULTS.damping, '', 'damping ratio of tracking errors',
              low=0.1, high=2.0, live=True),
    Setting('setpoint_duration', _DEFAULTS.setpoint_duration, 's',
              'time in which a setpoint is reached', low=0.1, high=3600.0, live=True),
    Setting('setpoint_timing', _DEFAULTS.setpoint_timing, '',
              'that time, or the shortest that the wheels allow', choices=TIMINGS, live=True),
    Setting('command', _DEFAULTS.command, '', 'what the wheels are told', choices=COMMANDS,
              live=True),
    Setting('allocation', _DEFAULTS.allocation, '', 'how the wheels share', choices=ALLOCATIONS,
              live=True),
    Setting('wheel_target', _DEFAULTS.wheel_target, '',
              'where the freedom that moves no link leads the speeds of the wheels',
              choices=WHEEL_TARGETS, live=True),
    Setting('wheel_bias', _DEFAULTS.wheel_bias, 'rad/s', 'speed for the target `bias`',
              low=-1000.0, high=1000.0, live=True),
    Setting('wheel_bandwidth', _DEFAULTS.wheel_bandwidth, 'rad/s',
              'how fast wheel speeds go to their target', low=0.0, high=10.0, live=True),
    Setting('disturbance_compensation', _DEFAULTS.disturbance_compensation, '',
              'share of the estimated disturbance that is compensated', low=0.0, high=1.0,
              live=True),
    Setting('bearing_coulomb', _DEFAULTS.bearing_coulomb, 'N m',
              'Coulomb friction of the bearings of the wheels', low=0.0, high=10.0, live=True),
    Setting('bearing_viscous', _DEFAULTS.bearing_viscous, 'N m s',
              'viscous friction of the same', low=0.0, high=10.0, live=True),
    Setting('rest_band', _DEFAULTS.rest_band, 'rad',
              'errors of the configuration that do nothing at rest, where joints stick',
              low=0.0, high=0.1, live=True),
    Setting('change_points', _DEFAULTS.change_points, '',
              'refuse moves that meet a change point, keep to the branch there, or choose it',
              choices=CHANGE_POINTS, live=True),
    Setting('branch_bandwidth', _DEFAULTS.branch_bandwidth, 'rad/s',
              'natural frequency of the hold on the branch at change points',
              low=0.0, high=20.0, live=True),
)
"""The fields of `ControllerSettings`."""

PARAMETERS = (
    Setting('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    *SETTINGS,
)
"""All parameters of the node."""
