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
Integration of the motion: one fixed Runge-Kutta step of order four, and loops around it.

The state is a vector of 16: link angles [rad] and rates [rad/s], wheel angles relative to the
link [rad] and absolute wheel speeds [rad/s], each in the order a, b, c, d. The mass centre of
the whole moves apart from these and is not in it.
"""

from __future__ import annotations

from math import ceil, cos, pi

from fourbar_ros.mechanism.compiled import kernel
from fourbar_ros.mechanism.dynamics import link_accelerations, project_onto_closure
from fourbar_ros.mechanism.parameters import Array, Constants
import numpy as np

STATE_SIZE = 16
LINK_ANGLES = slice(0, 4)
LINK_RATES = slice(4, 8)
WHEEL_ANGLES = slice(8, 12)
WHEEL_SPEEDS = slice(12, 16)


@kernel
def state_derivative(state: Array, torques: Array, constants: Constants, work: Array,
                     out: Array) -> None:
    """
    Evaluate the right-hand side.

    :param state: (16,).
    :param torques: (4,) motor torques on the wheels [N m]; each link feels the opposite.
    :param work: (4,) scratch.
    :param out: (16,) receives d(state)/dt.
    """
    for j in range(4):
        out[j] = state[4 + j]
        out[8 + j] = state[12 + j] - state[4 + j]
        out[12 + j] = torques[j] / constants.flywheel_inertias[j]
        work[j] = -torques[j]
    link_accelerations(state[0:4], state[4:8], work, constants, out[4:8])


@kernel
def advance_state(state: Array, start: Array, middle: Array, end: Array, step: float,
                  constants: Constants, scratch: Array) -> None:
    """
    Advance the state by one Runge-Kutta step of order four, in place, and close the loop again.

    :param state: (16,).
    :param start, middle, end: (4,) motor torques at the begin, middle and end of the step [N m];
        three times the same array for a zero-order hold.
    :param step: [s].
    :param scratch: (6, 16) work space, so that the hot loop allocates nothing.
    """
    k1, k2, k3, k4 = scratch[0], scratch[1], scratch[2], scratch[3]
    stage, work = scratch[4], scratch[5, 0:4]
    state_derivative(state, start, constants, work, k1)
    for i in range(STATE_SIZE):
        stage[i] = state[i] + 0.5 * step * k1[i]
    state_derivative(stage, middle, constants, work, k2)
    for i in range(STATE_SIZE):
        stage[i] = state[i] + 0.5 * step * k2[i]
    state_derivative(stage, middle, constants, work, k3)
    for i in range(STATE_SIZE):
        stage[i] = state[i] + step * k3[i]
    state_derivative(stage, end, constants, work, k4)
    for i in range(STATE_SIZE):
        state[i] += step / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
    project_onto_closure(state[0:4], state[4:8], constants)


@kernel
def move_with_cosine_torques(
    state: Array, times: Array, amplitude: Array, frequency: Array, phase: Array,
    longest_step: float, constants: Constants,
) -> Array:
    """
    Integrate under motor torques `amplitude cos(2 pi frequency t + phase)`.

    :param state: (16,) at times[0]; not changed.
    :param times: (n,) increasing [s].
    :param amplitude: (4,) [N m], with frequency (4,) [Hz] and phase (4,) [rad].
    :param longest_step: upper bound of the integration step [s]; each interval between two times
        is divided into equal steps.
    :returns: (n, 16) the state at every time.
    """
    out = np.empty((times.size, STATE_SIZE))
    now = state.copy()
    scratch = np.empty((6, STATE_SIZE))
    torques = np.empty((3, 4))
    out[0] = now
    for n in range(1, times.size):
        interval = times[n] - times[n - 1]
        steps = max(1, int(ceil(interval / longest_step - 1e-9)))
        step = interval / steps
        for i in range(steps):
            for stage in range(3):
                t = times[n - 1] + (i + 0.5 * stage) * step
                for j in range(4):
                    torques[stage, j] = amplitude[j] * cos(
                        2.0 * pi * frequency[j] * t + phase[j])
            advance_state(now, torques[0], torques[1], torques[2], step, constants, scratch)
        out[n] = now
    return out
