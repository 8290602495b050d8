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

"""
The simulated testbed: linkage, flywheel motors and sensors, advanced in fixed small steps.

Motor torques are held over each control period (zero-order hold); within it the motor limits act
at every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from fourbar_ros.errors import FourbarError
from fourbar_ros.mechanism import assemble, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.compiled import kernel
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.mechanism.motion import (
    advance_state,
    LINK_ANGLES,
    LINK_RATES,
    STATE_SIZE,
    WHEEL_ANGLES,
    WHEEL_SPEEDS,
)
from fourbar_ros.mechanism.parameters import Array, Constants
from fourbar_ros.plant.table import quantum, Table
import numpy as np


class PlantError(FourbarError):
    """A plant that cannot be simulated as asked, or whose state left the finite numbers."""


@dataclass(frozen=True)
class InitialState:
    """
    Where the linkage starts, wheels at rest relative to their links.

    :param link_a, link_b: orientations [rad].
    :param branch: `open` or `crossed`.
    :param rate_a, rate_b: angular rates [rad/s].
    """

    link_a: float = 0.0
    link_b: float = np.pi / 3
    branch: str = 'open'
    rate_a: float = 0.0
    rate_b: float = 0.0


@dataclass(frozen=True, eq=False)
class Truth:
    """
    What really is, sensors apart.

    :param link_angles: (4,) continuous [rad].
    :param link_rates: (4,) [rad/s].
    :param wheel_angles: (4,) relative to the link, unwrapped [rad].
    :param wheel_speeds: (4,) relative to the link [rad/s].
    :param efforts: (4,) torque on each wheel, mean over the last control period [N m].
    """

    link_angles: Array
    link_rates: Array
    wheel_angles: Array
    wheel_speeds: Array
    efforts: Array


class Plant:
    """
    The linkage on its table.

    :param mechanism: the linkage, its wheels and motor limits.
    :param table: the table and the sensors.
    :param initial: where it starts.
    :param step_s: integration step [s].
    :param generator: source of all randomness.
    :raises PlantError: the step is not a positive number.
    :raises ClosureError: the loop cannot close at the initial angles, or unknown branch.
    """

    def __init__(self, mechanism: Mechanism, table: Table, initial: InitialState, step_s: float,
                 generator: np.random.Generator) -> None:
        if not (isfinite(step_s) and step_s > 0.0):
            raise PlantError(f'the plant step must be a positive number of seconds, got {step_s}')
        self.mechanism = mechanism
        self.step_s = step_s
        self._table = table
        self._generator = generator
        self._state = _initial_state(mechanism, initial)
        self._efforts = np.zeros(4)
        self._scratch = np.empty((6, STATE_SIZE))
        # Compile the kernels now, not while time runs.
        self.advance(1, np.zeros(4))
        self._state = _initial_state(mechanism, initial)

    def steps_in(self, duration_s: float) -> int:
        """
        Count the integration steps in a duration.

        :raises PlantError: the duration is not a whole multiple of the step, at least one.
        """
        steps = round(duration_s / self.step_s)
        if steps < 1 or abs(steps * self.step_s - duration_s) > 1e-9 * duration_s:
            raise PlantError(
                f'the control period must be a whole multiple of the plant step: '
                f'{duration_s:g} s / {self.step_s:g} s = {duration_s / self.step_s:g}')
        return steps

    def advance(self, steps: int, torques: Array) -> None:
        """
        Move on by a number of steps under constant motor commands.

        :param torques: (4,) motor torques asked for [N m].
        :raises PlantError: the state is no longer finite.
        """
        advance_plant(
            self._state, torques, self.mechanism.motor_torque_limits,
            self.mechanism.motor_speed_limits, self.step_s, steps, self.mechanism.constants,
            self._scratch, self._efforts)
        if not np.isfinite(self._state).all():
            raise PlantError('the state of the plant is no longer finite')

    def truth(self) -> Truth:
        """Return a copy of the true state."""
        state = self._state
        return Truth(
            state[LINK_ANGLES].copy(), state[LINK_RATES].copy(), state[WHEEL_ANGLES].copy(),
            state[WHEEL_SPEEDS] - state[LINK_RATES], self._efforts.copy())

    def sense_links(self) -> Array:
        """Sample the four link sensors: (4,) orientations in (-pi, pi] [rad]."""
        sensors = self._table.link_sensors
        angles = self._state[LINK_ANGLES] + sensors.noise_rms * self._generator.standard_normal(4)
        return wrap_angles(quantise(angles, quantum(sensors.counts_per_turn)))

    def sense_wheels(self) -> Array:
        """Read the four wheel encoders: (4,) unwrapped angles relative to the link [rad]."""
        return quantise(
            self._state[WHEEL_ANGLES], quantum(self._table.wheel_encoders.counts_per_turn))


def quantise(angles: Array, step: float) -> Array:
    """Round angles [rad] to multiples of a step [rad]; a step of 0 leaves them as they are."""
    return np.round(angles / step) * step if step else np.array(angles)


@kernel
def advance_plant(
    state: Array, commands: Array, torque_limits: Array, speed_limits: Array, step: float,
    steps: int, constants: Constants, scratch: Array, efforts: Array,
) -> None:
    """
    Advance the plant under constant motor commands, in place.

    A motor gives no torque beyond its limit, and none that would drive its wheel further where
    the wheel already is at the speed limit (relative to the link).

    :param state: (16,), see mechanism.motion.
    :param commands: (4,) [N m].
    :param torque_limits, speed_limits: (4,) [N m], [rad/s].
    :param scratch: (6, 16) work space.
    :param efforts: (4,) receives the mean of the torques really applied [N m].
    """
    torques = np.empty(4)
    efforts[:] = 0.0
    for _ in range(steps):
        for j in range(4):
            torque = min(max(commands[j], -torque_limits[j]), torque_limits[j])
            speed = state[12 + j] - state[4 + j]
            if abs(speed) >= speed_limits[j] and torque * speed > 0.0:
                torque = 0.0
            torques[j] = torque
            efforts[j] += torque / steps
        advance_state(state, torques, torques, torques, step, constants, scratch)


def _initial_state(mechanism: Mechanism, initial: InitialState) -> Array:
    for name in ('link_a', 'link_b', 'rate_a', 'rate_b'):
        if not isfinite(getattr(initial, name)):
            raise PlantError(f'initial {name} must be finite, got {getattr(initial, name)}')
    angles = assemble(mechanism, initial.link_a, initial.link_b, initial.branch)
    rates = np.array([initial.rate_a, initial.rate_b, 0.0, 0.0])
    if rates.any():
        if abs(np.sin(angles[3] - angles[2])) < 1e-9:
            raise PlantError(
                f'initial rates are given at a change point ({LINK_NAMES[2]} and {LINK_NAMES[3]} '
                'on a line), where they do not determine the motion')
        rates[2:] = gamma_matrix(angles, mechanism.constants.lengths) @ rates[:2]
    state = np.zeros(STATE_SIZE)
    state[LINK_ANGLES] = angles
    state[LINK_RATES] = rates
    state[WHEEL_SPEEDS] = rates
    return state
