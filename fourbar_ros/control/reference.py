# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Reference motion: the paper's soft step as a quintic with given ends."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from fourbar_ros.mechanism.compiled import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np


@kernel
def evaluate(coefficients: Array, time: float, duration: float) -> Array:
    """
    Evaluate polynomials in time / duration, and their derivatives after the time.

    :param coefficients: (6, axes).
    :returns: (3, axes).
    """
    s = time / duration
    values = np.zeros((3, coefficients.shape[1]))
    # Horner's rule, which also gives half the second derivative.
    for power in range(5, -1, -1):
        values[2] = values[2] * s + values[1]
        values[1] = values[1] * s + values[0]
        values[0] = values[0] * s + coefficients[power]
    values[1] /= duration
    values[2] *= 2.0 / (duration * duration)
    return values


@dataclass(frozen=True, eq=False)
class SoftStep:
    """
    A move between two states that starts and ends with continuous rate and acceleration.

    From rest it is the paper's soft step, `10 s^3 - 15 s^4 + 6 s^5`. Started in motion it takes
    over rate and acceleration without a jump. Axes are (phi_a, phi_b).

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

    def path(self, count: int) -> Array:
        """Sample the angles evenly in time, both ends included: (count, 2) [rad]."""
        powers = np.linspace(0.0, 1.0, count)[:, None] ** np.arange(6)
        angles: Array = powers @ self._coefficients
        return angles

    @cached_property
    def _coefficients(self) -> Array:
        """Return the polynomial's coefficients in time / duration: (6, 2)."""
        angle = self.start[0]
        rate = self.start[1] * self.duration
        bend = self.start[2] * self.duration ** 2
        rise = self.goal - angle
        return np.array([
            angle, rate, bend / 2.0,
            10.0 * rise - 6.0 * rate - 1.5 * bend,
            -15.0 * rise + 8.0 * rate + 1.5 * bend,
            6.0 * rise - 3.0 * rate - 0.5 * bend,
        ])
