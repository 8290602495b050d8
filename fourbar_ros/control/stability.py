# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether gains are stable at the rate at which the loop runs.

Each axis with computed torque is a double integrator. A command is held for a period and answers
samples of a period ago; the torque follows with the motor's lag, and where speeds are commanded
with that of the loop that follows them.
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

# Errors must fall at least at this share of the speed that the gains are meant to give.
LEAST_DECAY = 0.2


class GainError(FourbarError):
    """Gains that make the loop unstable at its rate."""


def check_gains(settings: ControllerSettings, mechanism: Mechanism, period: float) -> None:
    """
    Refuse gains that are unstable, or nearly so.

    :param period: of the loop [s].
    :raises GainError: tells which, and how fast the loop would have to be.
    """
    lag = float(mechanism.motor_time_constants.max())
    by_speed = settings.command == 'velocity'
    for name, bandwidth, damping in (
            ('bandwidth', settings.bandwidth, settings.damping),
            ('branch_bandwidth', settings.branch_bandwidth, 1.0)):
        if bandwidth == 0.0:
            continue
        decay = decay_rate(bandwidth, damping, period, lag, by_speed)
        if not decay > LEAST_DECAY * bandwidth * min(damping, 1.0):
            raise GainError(
                f'{name} {bandwidth:g} rad/s with damping {damping:g} is not stable at '
                f'{1.0 / period:.4g} Hz, at most '
                f'{largest_bandwidth(damping, period, lag, by_speed):.3g} rad/s is')


def largest_bandwidth(damping: float, period: float, lag: float, by_speed: bool) -> float:
    """Return the largest bandwidth that is accepted [rad/s]."""
    low, high = 0.0, 1e4
    while high > low * 1.001 + 1e-6:
        middle = 0.5 * (low + high)
        if decay_rate(middle, damping, period, lag, by_speed) > (
                LEAST_DECAY * middle * min(damping, 1.0)):
            low = middle
        else:
            high = middle
    return low


def decay_rate(bandwidth: float, damping: float, period: float, lag: float, by_speed: bool
               ) -> float:
    """
    Return how fast tracking errors fall off, from the eigenvalues of the sampled loop [1/s].

    :param lag: time constant of the motors [s].
    :returns: below zero where they grow.
    """
    continuous, inputs = _plant(lag, by_speed)
    states = len(continuous)
    block = np.zeros((states + 1, states + 1))
    block[:states, :states], block[:states, states] = continuous, inputs
    held = expm(block * period)
    # The acceleration that was decided on at the last tick acts during this period.
    loop = np.zeros((states + 2, states + 2))
    loop[:states, :states] = held[:states, :states]
    loop[states, 0], loop[states, 1] = -bandwidth ** 2, -2.0 * damping * bandwidth
    if by_speed:
        # Speeds are commanded: the sum of what was decided on so far, in the last state.
        loop[states + 1, states + 1] = 1.0
        loop[states + 1, states] = period
        loop[:states, states + 1] = held[:states, states]
        loop[:states, states] = held[:states, states] * period
    else:
        loop[:states, states] = held[:states, states]
        loop = loop[:states + 1, :states + 1]
    sizes = np.sort(np.abs(np.linalg.eigvals(loop)))
    if by_speed:
        # That sum itself, which is the wheel's momentum and nobody controls.
        sizes = np.delete(sizes, np.argmin(np.abs(sizes - 1.0)))
    largest = float(sizes.max())
    return inf if largest <= 0.0 else -float(np.log(largest)) / period


def _plant(lag: float, by_speed: bool) -> tuple[Array, Array]:
    """Return A and B of error, its rate, torque of the motor, and where it follows speeds."""
    lag = max(lag, 1e-6)
    if not by_speed:
        a = np.zeros((3, 3))
        a[0, 1] = a[1, 2] = 1.0
        a[2, 2] = -1.0 / lag
        return a, np.array([0.0, 0.0, 1.0 / lag])
    # Speed of the wheel, in units of its effect, and what its loop has learnt.
    gain, learning = SPEED_BANDWIDTH, 0.25 * SPEED_BANDWIDTH ** 2
    a = np.zeros((5, 5))
    a[0, 1] = a[1, 2] = 1.0
    a[2] = [0.0, 0.0, -1.0 / lag, -gain / lag, 1.0 / lag]
    a[3, 2] = 1.0
    a[4, 3] = -learning
    return a, np.array([0.0, 0.0, gain / lag, 0.0, learning])
