# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Integration of the motion: one step of the state, in the form that fits it, and loops around it.

The state is the vector of `mechanism.state`.
"""

from __future__ import annotations

from math import ceil, cos, pi, sin
from threading import Lock
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.kernels.compiler import kernel, prange
from fourbar_ros.kernels.runge_kutta import Drive
from fourbar_ros.mechanism.change_points import REDUCED_FORM_LIMIT
from fourbar_ros.mechanism.compliant import advance_compliant
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import (
    advance_constrained,
    constrained_accelerations,
    directions,
    LinkMotion,
)
from fourbar_ros.mechanism.forces import Surroundings, System
from fourbar_ros.mechanism.reduced import (
    advance_reduced,
    reduced_accelerations,
    ReducedMotion,
    side_of_joint_3,
)
from fourbar_ros.mechanism.state import (
    ANGLE,
    angles_of,
    CENTRE_X,
    CENTRE_Y,
    GAP,
    RATE,
    rates_of,
    STATE_SIZE,
    VELOCITY_X,
    VELOCITY_Y,
    WHEEL_ANGLE,
    WHEEL_SPEED,
)
import numpy as np
from numpy.typing import NDArray


class BatchError(FourbarError):
    """Arrays of a batch that do not fit together."""


@kernel
def advance_state(state: Array, drive: Drive, step: float, system: System) -> None:
    """
    Advance the state by one Runge-Kutta step of order four, in place, the loop staying closed.

    :param state: (STATE_SIZE,).
    :param drive: of the wheels; three times the same torques for a zero-order hold.
    :param step: [s].
    """
    constants = system.constants
    angles, rates = angles_of(state), rates_of(state)
    if constants.compliant:
        advance_compliant(state, drive, step, system)
    elif not advance_reduced(state, drive, step, system):
        advance_constrained(state, drive, step, system, True)
    start, middle, end = drive
    for j in range(4):
        inertia, prescribed = constants.flywheel_inertias[j], constants.prescribed[j]
        # The wheel's own motion: relative to the link if prescribed, to the table if not.
        speed = state[WHEEL_SPEED + j] - prescribed * rates[j]
        state[WHEEL_ANGLE + j] += (
            step * (speed + step / 6.0 * (start[j] + 2.0 * middle[j]) / inertia)
            - (1.0 - prescribed) * (state[ANGLE + j] - angles[j]))
        state[WHEEL_SPEED + j] = (
            speed + step / 6.0 * (start[j] + 4.0 * middle[j] + end[j]) / inertia
            + prescribed * state[RATE + j])


@kernel
def evaluate(state: Array, torques: Array, constants: Constants, around: Surroundings, out: Array
             ) -> None:
    """
    Evaluate the right-hand side for rigid joints.

    :param state: (STATE_SIZE,), the loop closed.
    :param torques: (4,) as in :func:`advance_state`.
    :param out: (STATE_SIZE,) receives d(state)/dt.
    """
    system = System(constants, around)
    theta, velocity = state[ANGLE + 1] - state[ANGLE], (state[VELOCITY_X], state[VELOCITY_Y])
    reduced = reduced_accelerations(ReducedMotion(
        state[ANGLE], cos(theta), sin(theta), side_of_joint_3(state[ANGLE + 2], state[ANGLE + 3]),
        state[RATE], state[RATE + 1], velocity), torques, system)
    accelerations, centre = reduced.accelerations, reduced.centre
    if not reduced.fold > REDUCED_FORM_LIMIT * constants.lengths[2] * constants.lengths[3]:
        cosines, sines = directions(angles_of(state))
        constrained = constrained_accelerations(LinkMotion(
            state[ANGLE], cosines, sines, rates_of(state), velocity), torques, system, True)
        accelerations, centre = constrained.accelerations, constrained.centre
    for j in range(4):
        out[ANGLE + j] = state[RATE + j]
        out[RATE + j] = accelerations[j]
        out[WHEEL_ANGLE + j] = state[WHEEL_SPEED + j] - state[RATE + j]
        out[WHEEL_SPEED + j] = (torques[j] / constants.flywheel_inertias[j]
                                + constants.prescribed[j] * out[RATE + j])
    out[CENTRE_X], out[CENTRE_Y] = velocity
    out[VELOCITY_X], out[VELOCITY_Y] = centre
    out[GAP:] = 0.0


@kernel
def move_held(state: Array, torques: Array, step: float, steps: int, constants: Constants,
              around: Surroundings) -> None:
    """
    Advance the state in place under motor torques (4,) that are held [N m].

    Parameters as of :func:`advance_state`.
    """
    drive, system = Drive(torques, torques, torques), System(constants, around)
    for _ in range(steps):
        advance_state(state, drive, step, system)


@kernel
def move_with_cosines(
    state: Array, times: Array, amplitude: Array, frequency: Array, phase: Array,
    longest_step: float, constants: Constants, around: Surroundings,
) -> Array:
    """
    Integrate under motor torques `amplitude cos(2 pi frequency t + phase)`.

    For a wheel whose motion is prescribed this is its angle relative to the link instead, up to a
    constant; its speed in the state must agree.

    :param state: (STATE_SIZE,) at times[0]; not changed.
    :param times: (n,) increasing [s].
    :param amplitude: (4,) [N m] or [rad], with frequency (4,) [Hz] and phase (4,) [rad].
    :param longest_step: upper bound of the integration step [s]; each interval between two times
        is divided into equal steps.
    :returns: (n, STATE_SIZE) the state at every time.
    """
    out, system = np.empty((times.size, STATE_SIZE)), System(constants, around)
    now = state.copy()
    torques = np.empty((3, 4))
    drive = Drive(torques[0], torques[1], torques[2])
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
                    torques[stage, j] = size[j] * cos(omega[j] * t + phase[j])
            advance_state(now, drive, step, system)
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
    :raises BatchError: the counts of states, torques, constants and surroundings do not agree, or
        states of another memory layout, for which all would be compiled anew.
    """
    if states.dtype != np.float64 or not (states.flags.c_contiguous and states.flags.writeable):
        raise BatchError(
            f'states must be contiguous, writeable and of float64, got {states.dtype}, '
            f'contiguous: {states.flags.c_contiguous}, writeable: {states.flags.writeable}',
            name='states', value=states.dtype)
    torques = np.ascontiguousarray(torques, dtype=float)
    count = len(states)
    each, surrounding = (np.ascontiguousarray(np.atleast_1d(records))
                         for records in (constants, around))
    if (states.shape != (count, STATE_SIZE) or torques.shape != (count, 4)
            or len(each) not in (1, count) or len(surrounding) not in (1, count)):
        raise BatchError(
            f'{states.shape} states need (n, {STATE_SIZE}); (n, 4) torques, got {torques.shape}; '
            f'1 or n constants and surroundings, got {len(each)} and {len(surrounding)}',
            value=(states.shape, torques.shape, len(each), len(surrounding)))
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


@kernel(parallel=True)
def link_trajectories(states: Array, torques: Array, sequence: NDArray[np.int64], factors: Array,
                      step: float, steps: int, constants: NDArray[Any], around: NDArray[Any]
                      ) -> Array:
    """
    Integrate many motions on all cores, and return their links at every tick.

    Not for two threads at once.

    :param states: (n, STATE_SIZE) at the start; changed in place.
    :param torques: (k, m, 4) k sequences of motor torques, held for a tick each, over the factors.
    :param sequence: (n,) index of the sequence of each motion.
    :param factors: (n, 4) of the torques of each motion.
    :param step: [s].
    :param steps: in a tick.
    :param constants, around: (n,) of each motion.
    :returns: (m + 1, n, 8) link angles [rad] and rates [rad/s].
    """
    trajectories = np.empty((torques.shape[1] + 1, len(states), WHEEL_ANGLE))
    for index in prange(states.shape[0]):
        n = np.int64(index)
        state, held = states[n], np.empty(4)
        trajectories[0, n] = state[:WHEEL_ANGLE]
        for tick in range(torques.shape[1]):
            for wheel in range(4):
                held[wheel] = factors[n, wheel] * torques[sequence[n], tick, wheel]
            move_held(state, held, step, steps, constants[n], around[n])
            trajectories[tick + 1, n] = state[:WHEEL_ANGLE]
    return trajectories
