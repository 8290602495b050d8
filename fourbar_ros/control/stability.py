# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Stability of the gains at the rate of the loop.

Each axis under computed torque is a double integrator. A command is held for a period and is
based on samples that are one period old. The torque follows with the lag of the motor, and under
speed commands with that of the motor's speed loop.
"""

from __future__ import annotations

from math import inf

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control.settings import ControllerSettings
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.motors import SPEED_BANDWIDTH
import numpy as np
from scipy.linalg import expm

# Smallest decay rate of errors, as a share of that of the ideal loop: a margin of stability.
MIN_DECAY = 0.2


class GainError(FourbarError):
    """Gains that make the loop unstable at its rate; `values`: name, value, limit, rate_hz."""


def check_gains(settings: ControllerSettings, mechanism: Mechanism, period: float) -> None:
    """
    Refuse gains that are unstable, or nearly so.

    :param period: of the loop [s].
    :raises GainError: with the largest bandwidth that is accepted at this rate.
    """
    lag = float(mechanism.motor_time_constants.max())
    by_speed = settings.command == 'velocity'
    for name, bandwidth, damping in (
            ('bandwidth', settings.bandwidth, settings.damping),
            ('branch_bandwidth', settings.branch_bandwidth, 1.0)):
        if bandwidth == 0.0:
            continue
        decay = decay_rate(bandwidth, damping, period, lag, by_speed)
        if not decay > MIN_DECAY * bandwidth * min(damping, 1.0):
            limit = largest_bandwidth(damping, period, lag, by_speed)
            raise GainError(
                f'{name} {bandwidth:g} rad/s with damping {damping:g} is not stable at '
                f'{1.0 / period:.4g} Hz: at most {limit:.3g} rad/s', name=name, value=bandwidth,
                limit=limit, rate_hz=1.0 / period)


def largest_bandwidth(damping: float, period: float, lag: float, by_speed: bool) -> float:
    """Return the largest bandwidth that is accepted [rad/s]."""
    low, high = 0.0, 1e4
    while high > low * 1.001 + 1e-6:
        middle = 0.5 * (low + high)
        if decay_rate(middle, damping, period, lag, by_speed) > (
                MIN_DECAY * middle * min(damping, 1.0)):
            low = middle
        else:
            high = middle
    return low


def decay_rate(bandwidth: float, damping: float, period: float, lag: float, by_speed: bool
               ) -> float:
    """
    Return the decay rate of tracking errors, from the eigenvalues of the sampled loop [1/s].

    :param lag: time constant of the motors [s].
    :returns: negative where errors grow.
    """
    continuous, inputs = _plant(lag, by_speed)
    states = len(continuous)
    block = np.zeros((states + 1, states + 1))
    block[:states, :states], block[:states, states] = continuous, inputs
    held = expm(block * period)
    # The acceleration that was computed at the last tick acts during this period.
    loop = np.zeros((states + 2, states + 2))
    loop[:states, :states] = held[:states, :states]
    loop[states, 0], loop[states, 1] = -bandwidth ** 2, -2.0 * damping * bandwidth
    if by_speed:
        # The commanded speed, the sum of all accelerations so far, is the last state.
        loop[states + 1, states + 1] = 1.0
        loop[states + 1, states] = period
        loop[:states, states + 1] = held[:states, states]
        loop[:states, states] = held[:states, states] * period
    else:
        loop[:states, states] = held[:states, states]
        loop = loop[:states + 1, :states + 1]
    sizes = np.sort(np.abs(np.linalg.eigvals(loop)))
    if by_speed:
        # This sum is the momentum of the wheel, which is not controlled.
        sizes = np.delete(sizes, np.argmin(np.abs(sizes - 1.0)))
    largest = float(sizes.max())
    return inf if largest <= 0.0 else -float(np.log(largest)) / period


def _plant(lag: float, by_speed: bool) -> tuple[Array, Array]:
    """Return A and B of error, its rate, motor torque, and under speed commands its loop."""
    lag = max(lag, 1e-6)
    if not by_speed:
        a = np.zeros((3, 3))
        a[0, 1] = a[1, 2] = 1.0
        a[2, 2] = -1.0 / lag
        return a, np.array([0.0, 0.0, 1.0 / lag])
    # Two more states: speed of the wheel, in units of its effect, and integral of its loop.
    gain, integral_gain = SPEED_BANDWIDTH, 0.25 * SPEED_BANDWIDTH ** 2
    a = np.zeros((5, 5))
    a[0, 1] = a[1, 2] = 1.0
    a[2] = [0.0, 0.0, -1.0 / lag, -gain / lag, 1.0 / lag]
    a[3, 2] = 1.0
    a[4, 3] = -integral_gain
    return a, np.array([0.0, 0.0, gain / lag, 0.0, integral_gain])
