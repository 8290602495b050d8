# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Settings of the controller and the parameters of its node."""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.common.settings import Setting, setting, Settings, settings_of
from fourbar_ros.control.allocation import ALLOCATIONS
from fourbar_ros.control.null_space import TARGETS

# Kinds of wheel command: motor torque or wheel speed.
COMMANDS = ('effort', 'velocity')

# Targets of the null-space control of the wheel speeds; `free` applies none.
WHEEL_TARGETS = ('free', *TARGETS)

# Duration of a setpoint's move: `setpoint_duration`, or the shortest that the wheels allow.
TIMINGS = ('duration', 'shortest')

# Treatment of moves that meet a change point.
CHANGE_POINTS = ('avoid', 'keep', 'choose')


@dataclass(frozen=True)
class ControllerSettings(Settings):
    """
    Settings of the controller; all of them may be changed at run time.

    `change_points`: `avoid` refuses moves that meet a change point, `keep` crosses it and parks
    there on the parallelogram branch, `choose` also leaves it on the other branch where a
    setpoint names it.
    """

    bandwidth: float = setting(4.0, 'rad/s', 'natural frequency of tracking errors',
                               low=0.1, high=20.0, live=True)
    damping: float = setting(0.9, '', 'damping ratio of tracking errors',
                             low=0.1, high=2.0, live=True)
    setpoint_duration: float = setting(10.0, 's', 'time in which a setpoint is reached',
                                       low=0.1, high=3600.0, live=True)
    setpoint_timing: str = setting('duration', '', 'duration of a setpoint: setpoint_duration, or '
                                   'the shortest that the wheels allow',
                                   choices=TIMINGS, live=True)
    command: str = setting('effort', '', 'kind of wheel command: motor torque or wheel speed',
                           choices=COMMANDS, live=True)
    allocation: str = setting('min_norm', '', 'rule that shares the demand among the wheels',
                              choices=ALLOCATIONS, live=True)
    wheel_target: str = setting('free', '', 'target of the wheel speeds in the null space, which '
                                'moves no link', choices=WHEEL_TARGETS, live=True)
    wheel_bias: float = setting(30.0, 'rad/s', 'wheel speed of the target `bias`',
                                low=-1000.0, high=1000.0, live=True)
    wheel_bandwidth: float = setting(0.5, 'rad/s', 'bandwidth of the wheel speeds towards their '
                                     'target', low=0.0, high=10.0, live=True)
    disturbance_compensation: float = setting(
        1.0, '', 'share of the estimated disturbance that is compensated', low=0.0, high=1.0,
        live=True)
    bearing_coulomb: float = setting(0.0, 'N m', 'Coulomb friction of the wheel bearings',
                                     low=0.0, high=10.0, live=True)
    bearing_viscous: float = setting(0.0, 'N m s', 'viscous friction of the wheel bearings',
                                     low=0.0, high=10.0, live=True)
    rest_band: float = setting(0.0, 'rad', 'dead band of configuration errors at rest, where the '
                               'joints stick', low=0.0, high=0.1, live=True)
    change_points: str = setting('avoid', '', 'refuse moves that meet a change point, keep the '
                                 'branch there, or choose it', choices=CHANGE_POINTS, live=True)
    branch_bandwidth: float = setting(8.0, 'rad/s', 'natural frequency of the branch hold at '
                                      'change points', low=0.0, high=20.0, live=True)


# Declarations of the fields of `ControllerSettings`.
SETTINGS = settings_of(ControllerSettings)

# All parameters of the node.
PARAMETERS = (
    Setting('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    *SETTINGS,
)
