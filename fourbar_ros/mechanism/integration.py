# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Integration of the motion: one fixed Runge-Kutta step of order four, and loops around it.

The state is a vector as mechanism.layout describes it.
"""

from __future__ import annotations

from math import ceil, cos, pi, sin
from threading import Lock
from typing import Any

from fourbar_ros.kernels.compiler import kernel, prange
from fourbar_ros.mechanism.change_points import REDUCED_FORM_LIMIT
from fourbar_ros.mechanism.compliant import advance_compliant
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import (
    advance_constrained,
    constrained_accelerations,
    directions,
)
from fourbar_ros.mechanism.forces import Surroundings
from fourbar_ros.mechanism.reduced import (
    advance_reduced,
    reduced_accelerations,
    side_of_joint_3,
)
from fourbar_ros.mechanism.state import (
    CENTRE_X,
    CENTRE_Y,
    STATE_SIZE,
    VELOCITY_X,
    VELOCITY_Y,
)
import numpy as np
from numpy.typing import NDArray


@kernel
def advance_state(state: Array, start: Array, middle: Array, end: Array, step: float,
                  constants: Constants, around: Surroundings) -> None:
    """
    Advance the state by one Runge-Kutta step of order four, in place, the loop staying closed.

    :param state: (STATE_SIZE,).
    :param start, middle, end: (4,) what drives the wheels at the begin, middle and end of the
        step; three times the same array for a zero-order hold. The motor torque on the wheel, or
        its axial inertia times its acceleration relative to the link where that is prescribed
        [N m].
    :param step: [s].
    """
    a, b, c, d = state[0], state[1], state[2], state[3]
    rate_a, rate_b, rate_c, rate_d = state[4], state[5], state[6], state[7]
    if constants.compliant:
        advance_compliant(state, start, middle, end, step, constants, around)
    elif not advance_reduced(state, start, middle, end, step, constants, around):
        advance_constrained(state, start, middle, end, step, constants, around, True)
    turned = (state[0] - a, state[1] - b, state[2] - c, state[3] - d)
    rates = (rate_a, rate_b, rate_c, rate_d)
    for j in range(4):
        inertia, prescribed = constants.flywheel_inertias[j], constants.prescribed[j]
        # The wheel's own motion: seen from the link if prescribed, from the table if not.
        speed = state[12 + j] - prescribed * rates[j]
        state[8 + j] += (step * (speed + step / 6.0 * (start[j] + 2.0 * middle[j]) / inertia)
                         - (1.0 - prescribed) * turned[j])
        state[12 + j] = (
            speed + step / 6.0 * (start[j] + 4.0 * middle[j] + end[j]) / inertia
            + prescribed * state[4 + j])


@kernel
def evaluate(state: Array, torques: Array, constants: Constants, around: Surroundings, out: Array
             ) -> None:
    """
    Evaluate the right-hand side for rigid joints.

    :param state: (STATE_SIZE,), the loop closed.
    :param torques: (4,) as in :func:`advance_state`.
    :param out: (STATE_SIZE,) receives d(state)/dt.
    """
    theta, vx, vy = state[1] - state[0], state[VELOCITY_X], state[VELOCITY_Y]
    a, b, c, d, ax, ay, _, _, fold = reduced_accelerations(
        state[0], cos(theta), sin(theta), side_of_joint_3(state[2], state[3]),
        state[4], state[5], vx, vy, torques, constants, around)
    if not fold > REDUCED_FORM_LIMIT * constants.lengths[2] * constants.lengths[3]:
        cosines, sines = directions((state[0], state[1], state[2], state[3]))
        (a, b, c, d), (ax, ay), _ = constrained_accelerations(
            state[0], cosines, sines, (state[4], state[5], state[6], state[7]), (vx, vy),
            torques, constants, around, True)
    out[4], out[5], out[6], out[7] = a, b, c, d
    for j in range(4):
        out[j] = state[4 + j]
        out[8 + j] = state[12 + j] - state[4 + j]
        out[12 + j] = (torques[j] / constants.flywheel_inertias[j]
                       + constants.prescribed[j] * out[4 + j])
    out[CENTRE_X], out[CENTRE_Y], out[VELOCITY_X], out[VELOCITY_Y] = vx, vy, ax, ay
    out[20:] = 0.0


@kernel
def move_held(state: Array, torques: Array, step: float, steps: int, constants: Constants,
              around: Surroundings) -> None:
    """
    Advance the state in place under motor torques (4,) that are held [N m].

    Parameters as of :func:`advance_state`.
    """
    for _ in range(steps):
        advance_state(state, torques, torques, torques, step, constants, around)


@kernel
def move_with_cosines(
    state: Array, times: Array, amplitude: Array, frequency: Array, phase: Array,
    longest_step: float, constants: Constants, around: Surroundings,
) -> Array:
    """
    Integrate under motor torques `amplitude cos(2 pi frequency t + phase)`.

    A wheel whose motion is prescribed has that for its angle relative to the link instead, up to
    a constant; its speed in the state must fit.

    :param state: (STATE_SIZE,) at times[0]; not changed.
    :param times: (n,) increasing [s].
    :param amplitude: (4,) [N m] or [rad], with frequency (4,) [Hz] and phase (4,) [rad].
    :param longest_step: upper bound of the integration step [s]; each interval between two times
        is divided into equal steps.
    :returns: (n, STATE_SIZE) the state at every time.
    """
    out = np.empty((times.size, STATE_SIZE))
    now = state.copy()
    drive = np.empty((3, 4))
    size, omega = np.empty(4), 2.0 * pi * frequency
    for j in range(4):
        size[j] = amplitude[j]
        if constants.prescribed[j] > 0.0:
            size[j] *= -constants.flywheel_inertias[j] * omega[j] * omega[j]
    out[0] = now
    for n in range(1, times.size):
        interval = times[n] - times[n - 1]
        steps = max(1, int(ceil(interval / longest_step - 1e-9)))
        step = interval / steps
        for i in range(steps):
            for stage in range(3):
                t = times[n - 1] + (i + 0.5 * stage) * step
                for j in range(4):
                    drive[stage, j] = size[j] * cos(omega[j] * t + phase[j])
            advance_state(now, drive[0], drive[1], drive[2], step, constants, around)
        out[n] = now
    return out


def move_batch(states: Array, torques: Array, step: float, steps: int,
               constants: Constants | NDArray[Any], around: Surroundings | NDArray[Any]) -> None:
    """
    Advance many states in place on all cores, each under torques of its own that are held.

    Calls from several threads wait for each other.

    :param states: (n, STATE_SIZE), contiguous and writeable, of float64.
    :param torques: (n, 4) [N m].
    :param step: [s].
    :param constants, around: one for all states, or arrays of n of them.
    :raises ValueError: the numbers of states, torques, constants and surroundings do not fit, or
        the states lie in memory in another way, for which all would be compiled anew.
    """
    if states.dtype != np.float64 or not (states.flags.c_contiguous and states.flags.writeable):
        raise ValueError(
            f'states must be contiguous, writeable and of float64, got {states.dtype}, '
            f'contiguous: {states.flags.c_contiguous}, writeable: {states.flags.writeable}')
    torques = np.ascontiguousarray(torques, dtype=float)
    count = len(states)
    each, surrounding = (np.ascontiguousarray(np.atleast_1d(given))
                         for given in (constants, around))
    if (states.shape != (count, STATE_SIZE) or torques.shape != (count, 4)
            or len(each) not in (1, count) or len(surrounding) not in (1, count)):
        raise ValueError(
            f'{states.shape} states need (n, {STATE_SIZE}); (n, 4) torques, got {torques.shape}; '
            f'1 or n constants and surroundings, got {len(each)} and {len(surrounding)}')
    with _one_batch:
        _move_batch(states, torques, step, steps, each, surrounding)


# Numba's threads end the process where two threads start a parallel loop at once.
_one_batch = Lock()


@kernel(parallel=True)
def _move_batch(states: Array, torques: Array, step: float, steps: int,
                constants: NDArray[Any], around: NDArray[Any]) -> None:
    last_constants, last_around = len(constants) - 1, len(around) - 1
    for index in prange(states.shape[0]):
        n = np.int64(index)
        move_held(states[n], torques[n], step, steps, constants[min(n, last_constants)],
                  around[min(n, last_around)])
