# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Contacts of the joints with the edge of the table: the linkage stops or bounces."""

from __future__ import annotations

from math import cos, inf, sin
from typing import Any

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import dot
from fourbar_ros.mechanism.compliant import link_energy_and_momentum
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import rates_of_impulse
from fourbar_ros.mechanism.state import (
    ANGLE,
    angles_of,
    CENTRE_X,
    CENTRE_Y,
    LINK_MOMENTUM,
    RATE,
    VELOCITY_X,
    VELOCITY_Y,
)
import numpy as np
from numpy.typing import NDArray

# Joint 1 to 4: the links of the chain from joint 1 to it.
CHAINS = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0],
                   [0.0, 1.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0]])


@kernel
def joint_levers(joint: int, state: Array, constants: Constants, lever: Array) -> None:
    """
    Evaluate the place of a joint relative to the mass centre of the whole, link by link.

    :param joint: 0 to 3 for joints 1 to 4.
    :param lever: (4, 2) receives each link's share, which turns with it [m].
    """
    for j in range(4):
        # Joint 1 is where link a begins: its mass centre less the vector to it.
        x = constants.arms[0, j, 0] + CHAINS[joint, j] * constants.lengths[j]
        y = constants.arms[0, j, 1]
        if j == 0:
            x -= constants.com_positions[0, 0]
            y -= constants.com_positions[0, 1]
        c, s = cos(state[ANGLE + j]), sin(state[ANGLE + j])
        lever[j, 0], lever[j, 1] = c * x - s * y, s * x + c * y


@kernel
def joint_motion(joint: int, state: Array, packed: NDArray[Any]
                 ) -> tuple[float, float, float, float]:
    """
    Return position x, y [m] and velocity x, y [m/s] of a joint in the table frame.

    :param joint: 0 to 3 for joints 1 to 4.
    :param packed: (1,) constants of the mechanism.
    """
    lever = np.empty((4, 2))
    joint_levers(joint, state, packed[0], lever)
    x, y = state[CENTRE_X], state[CENTRE_Y]
    speed_x, speed_y = state[VELOCITY_X], state[VELOCITY_Y]
    for j in range(4):
        x, y = x + lever[j, 0], y + lever[j, 1]
        speed_x -= state[RATE + j] * lever[j, 1]
        speed_y += state[RATE + j] * lever[j, 0]
    return x, y, speed_x, speed_y


@kernel
def meet_edges(state: Array, half_x: float, half_y: float, restitution: float,
               constants: Constants, lever: Array) -> tuple[int, float, float]:
    """
    Apply an impulse across the edge to every joint that moves out over it, in place.

    Compliant joints are rigid for that instant; the changes of energy and momentum are then those
    of the state.

    :param state: changed in place: rates of the links, velocity of the mass centre.
    :param half_x, half_y: from the middle of the table to its edges [m].
    :param lever: (4, 2) to work in.
    :returns: number of contacts, energy lost [J], and angular impulse about the mass centre
        [N m s].
    """
    count, lost, turn = 0, 0.0, 0.0
    angles = angles_of(state)
    energy = momentum = 0.0
    if constants.compliant:
        energy, momentum = link_energy_and_momentum(state, constants)
    for joint in range(4):
        joint_levers(joint, state, constants, lever)
        for axis in range(2):
            half = half_x if axis == 0 else half_y
            if half == inf:
                continue
            place, speed = state[CENTRE_X + axis], state[VELOCITY_X + axis]
            across = 1 - axis
            sign = -1.0 if axis == 0 else 1.0
            for j in range(4):
                place += lever[j, axis]
                speed += sign * state[RATE + j] * lever[j, across]
            if not (abs(place) > half and place * speed > 0.0):
                continue
            direction = (sign * lever[0, across], sign * lever[1, across],
                         sign * lever[2, across], sign * lever[3, across])
            gain = rates_of_impulse(angles, direction, constants)
            impulse = -(1.0 + restitution) * speed / (
                1.0 / constants.total_mass + dot(direction, gain))
            for j in range(4):
                state[RATE + j] += impulse * gain[j]
            state[VELOCITY_X + axis] += impulse / constants.total_mass
            count += 1
            # Work of an impulse: half of it times the speeds before and after.
            lost -= 0.5 * impulse * (1.0 - restitution) * speed
            turn += impulse * (direction[0] + direction[1] + direction[2] + direction[3])
    if count and constants.compliant:
        energy_after, momentum_after = link_energy_and_momentum(state, constants)
        lost, turn = energy - energy_after, momentum_after - momentum
    state[LINK_MOMENTUM] += turn
    return count, lost, turn
