# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Soft step of the paper as a quintic between two states.

Angles are those of two axes, links a and b or the pairs of a branch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike


@kernel
def evaluate(coefficients: Array, time: float, duration: float) -> Array:
    """
    Evaluate polynomials in time / duration, and their derivatives with respect to time.

    :param coefficients: (6, axes).
    :returns: (3, axes).
    """
    s = time / duration
    values = np.empty((3, coefficients.shape[1]))
    for axis in range(coefficients.shape[1]):
        # Horner's rule, which also gives half the second derivative.
        angle = slope = half_bend = 0.0
        for power in range(5, -1, -1):
            half_bend = half_bend * s + slope
            slope = slope * s + angle
            angle = angle * s + coefficients[power, axis]
        values[0, axis], values[1, axis] = angle, slope / duration
        values[2, axis] = half_bend * (2.0 / (duration * duration))
    return values


def evaluate_many(coefficients: Array, s: Array, duration: ArrayLike) -> Array:
    """
    Evaluate polynomials like :func:`evaluate`, at many instants.

    :param coefficients: (6, axes), or (n, 6, axes) for polynomials of their own.
    :param s: (n,) time / duration.
    :param duration: of each polynomial, (n,) or the same for all [s].
    :returns: (n, 3, axes).
    """
    s = s[:, None]
    lengths = np.asarray(duration, dtype=float)[..., None]
    values = np.zeros((s.shape[0], 3, coefficients.shape[-1]))
    angles, rates, half_bends = values[:, 0], values[:, 1], values[:, 2]
    for power in range(5, -1, -1):
        half_bends[:] = half_bends * s + rates
        rates[:] = rates * s + angles
        angles[:] = angles * s + coefficients[..., power, :]
    rates /= lengths
    half_bends *= 2.0 / (lengths * lengths)
    return values


def quintic(start: Array, end: Array, duration: float) -> Array:
    """
    Return the quintic between two states.

    :param start, end: (3, axes) angle, rate and acceleration [rad, rad/s, rad/s^2].
    :param duration: [s].
    :returns: (6, axes) coefficients in time / duration.
    """
    angle, rate, bend = start[0], start[1] * duration, start[2] * duration ** 2
    end_rate, end_bend = end[1] * duration, end[2] * duration ** 2
    rise = end[0] - angle
    return np.array([
        angle, rate, bend / 2.0,
        10.0 * rise - 6.0 * rate - 1.5 * bend - 4.0 * end_rate + 0.5 * end_bend,
        -15.0 * rise + 8.0 * rate + 1.5 * bend + 7.0 * end_rate - end_bend,
        6.0 * rise - 3.0 * rate - 0.5 * bend - 3.0 * end_rate + 0.5 * end_bend,
    ])


class TrajectorySegment(Protocol):
    """A reference motion that ends at rest."""

    @property
    def duration(self) -> float:
        """Time at which it ends, from 0 [s]."""

    def at(self, time: float) -> Array:
        """Evaluate angle, rate and acceleration (3, 2) at a time since the start [s]."""

    def instants(self, count: int) -> Array:
        """Choose instants for a check, both ends included: (n,), n >= count [s]."""

    def sample(self, times: Array) -> Array:
        """Evaluate like `at` for times (n,) within the duration [s]: (n, 3, 2)."""


@dataclass(frozen=True, eq=False)
class SoftStep:
    """
    A move between two states with continuous rate and acceleration at both ends.

    From rest it is the paper's soft step, `10 s^3 - 15 s^4 + 6 s^5`.

    :param start: (3, 2) angle, rate and acceleration at time 0 [rad, rad/s, rad/s^2].
    :param goal: (2,) angles at the end, at rest [rad].
    :param duration: [s].
    """

    start: Array
    goal: Array
    duration: float

    def at(self, time: float) -> Array:
        """
        Evaluate angle, rate and acceleration: (3, 2).

        :param time: since the start; before 0 the start, after the duration the goal at rest [s].
        """
        if time >= self.duration:
            return np.array([self.goal, np.zeros(2), np.zeros(2)])
        return evaluate(self._coefficients, max(time, 0.0), self.duration)

    def instants(self, count: int) -> Array:
        """Choose equidistant instants, both ends included: (count,) [s]."""
        return np.linspace(0.0, self.duration, count)

    def sample(self, times: Array) -> Array:
        """Evaluate like `at` for times (n,) within the duration [s]: (n, 3, 2)."""
        return evaluate_many(self._coefficients, times / self.duration, self.duration)

    def path(self, count: int) -> Array:
        """Sample the angles evenly in time, both ends included: (count, 2) [rad]."""
        powers = np.linspace(0.0, 1.0, count)[:, None] ** np.arange(6)
        angles: Array = powers @ self._coefficients
        return angles

    @cached_property
    def _coefficients(self) -> Array:
        """Return the polynomial's coefficients in time / duration: (6, 2)."""
        end = np.zeros((3, 2))
        end[0] = self.goal
        return quintic(self.start, end, self.duration)
