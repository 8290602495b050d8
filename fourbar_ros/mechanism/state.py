# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of the linkage as one vector, in the order a, b, c, d throughout.

* `LINK_ANGLES` [rad] and `LINK_RATES` [rad/s] in the table frame.
* `WHEEL_ANGLES` relative to the link [rad] and absolute `WHEEL_SPEEDS` [rad/s].
* `CENTRE_POSITION` [m] and `CENTRE_VELOCITY` [m/s] of the mass centre of the whole, in the table
  frame.
* `JOINT_GAPS` [m] and `JOINT_GAP_RATES` [m/s] of the compliant joints 1, 2 and 4, x and y of each
  in the table frame.
* `JOINT_LOSS`: energy that the dampers of compliant joints have taken [J].
* `LINK_MOMENTUM`: angular momentum of the links about the mass centre, summed over the steps
  [kg m^2/s].
* `CENTRE_COMPENSATION`: rounding error of the last sums for the position of the mass centre [m].

The gap of joint 3 follows from the link angles and the other gaps. The last two keep what rounding
would lose in a million steps; zero is a valid start, since the momentum is taken from the rates
where it does not fit them.
"""

from __future__ import annotations

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import Vector4
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike

# Indices for kernels; of a quantity that each link has, the column of link a.
ANGLE, RATE, WHEEL_ANGLE, WHEEL_SPEED = 0, 4, 8, 12
CENTRE_X, CENTRE_Y, VELOCITY_X, VELOCITY_Y = range(16, 20)
GAP, GAP_RATE = 20, 26
JOINT_LOSS, LINK_MOMENTUM, COMPENSATION_X, COMPENSATION_Y = range(32, 36)
STATE_SIZE = 36

LINK_ANGLES = slice(ANGLE, RATE)
LINK_RATES = slice(RATE, WHEEL_ANGLE)
WHEEL_ANGLES = slice(WHEEL_ANGLE, WHEEL_SPEED)
WHEEL_SPEEDS = slice(WHEEL_SPEED, CENTRE_X)
CENTRE_POSITION = slice(CENTRE_X, VELOCITY_X)
CENTRE_VELOCITY = slice(VELOCITY_X, GAP)
JOINT_GAPS = slice(GAP, GAP_RATE)
JOINT_GAP_RATES = slice(GAP_RATE, JOINT_LOSS)
CENTRE_COMPENSATION = slice(COMPENSATION_X, STATE_SIZE)


def make_state(link_angles: ArrayLike, link_rates: ArrayLike = 0.0,
               wheel_speeds: ArrayLike | None = None) -> Array:
    """
    Make a state of a linkage whose mass centre rests at the origin, joints closed.

    :param link_angles: (4,) [rad].
    :param link_rates: (4,) [rad/s].
    :param wheel_speeds: (4,) absolute [rad/s], by default those of the links.
    :returns: (STATE_SIZE,).
    """
    state = np.zeros(STATE_SIZE)
    state[LINK_ANGLES] = link_angles
    state[LINK_RATES] = link_rates
    state[WHEEL_SPEEDS] = link_rates if wheel_speeds is None else wheel_speeds
    return state


@kernel
def angles_of(state: Array) -> Vector4:
    """Return the link angles of a state [rad]."""
    return state[ANGLE], state[ANGLE + 1], state[ANGLE + 2], state[ANGLE + 3]


@kernel
def rates_of(state: Array) -> Vector4:
    """Return the link rates of a state [rad/s]."""
    return state[RATE], state[RATE + 1], state[RATE + 2], state[RATE + 3]
