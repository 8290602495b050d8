# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""How the controller behaves, as a person sets it."""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.control.null_space import TARGETS

# What the wheels are told.
COMMANDS = ('effort', 'velocity')

# What the freedom that moves no link is used for.
WHEEL_TARGETS = ('free', *TARGETS)

# What a setpoint's time is.
TIMINGS = ('duration', 'shortest')

# What becomes of moves that meet a change point.
CHANGE_POINTS = ('avoid', 'keep', 'choose')


@dataclass(frozen=True)
class ControllerSettings:
    """
    How the controller behaves.

    :param bandwidth: natural frequency of the tracking error [rad/s].
    :param damping: damping ratio of the tracking error.
    :param setpoint_duration: time in which a setpoint is reached [s].
    :param setpoint_timing: `duration`, or `shortest` for the least time that the wheels allow.
    :param command: what the wheels are told, `effort` or `velocity`.
    :param allocation: how they share, one of `allocation.ALLOCATIONS`.
    :param wheel_target: what the freedom that moves no link is used for: `free` (nothing),
        or one of `null_space.TARGETS`.
    :param wheel_bias: speed of wheels that are kept away from standstill [rad/s].
    :param wheel_bandwidth: how fast wheel speeds go to their target [rad/s].
    :param disturbance_compensation: share of the estimated disturbance that is compensated.
    :param bearing_coulomb, bearing_viscous: friction of the wheels' bearings, which `effort`
        compensates [N m], [N m s].
    :param rest_band: errors of the configuration that do nothing at rest, where friction in the
        joints holds it; 0 where there is none [rad].
    :param change_points: `avoid` refuses moves that meet one, `keep` crosses and parks on the
        parallelogram's branch, `choose` also leaves on the other branch where a setpoint names it.
    :param branch_bandwidth: natural frequency of the hold on the branch at change points [rad/s].
    """

    bandwidth: float = 4.0
    damping: float = 0.9
    setpoint_duration: float = 10.0
    setpoint_timing: str = 'duration'
    command: str = 'effort'
    allocation: str = 'min_norm'
    wheel_target: str = 'free'
    wheel_bias: float = 30.0
    wheel_bandwidth: float = 0.5
    disturbance_compensation: float = 1.0
    bearing_coulomb: float = 0.0
    bearing_viscous: float = 0.0
    rest_band: float = 0.0
    change_points: str = 'avoid'
    branch_bandwidth: float = 8.0
