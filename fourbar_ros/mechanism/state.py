# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of the linkage as one vector, order a, b, c, d throughout.

Link angles [rad] and rates [rad/s], wheel angles relative to the link [rad] and absolute wheel
speeds [rad/s], position [m] and velocity [m/s] of the mass centre of the whole in the table
frame; for joints that give, also how far and how fast [m, m/s] joints 1, 2 and 4 are open, x and y
each in the table frame. Joint 3 is open by what the link angles and these leave.

Then comes the energy that the dampers in such joints have taken so far [J].

The last three carry what rounding would lose in a million steps: the angular momentum of the
links about the mass centre [kg m^2/s], which is taken from the rates where it does not fit them,
and the rest of the last sums for the position of the mass centre [m]. Zero is a good start.
"""

from __future__ import annotations

from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike

LINK_ANGLES = slice(0, 4)
LINK_RATES = slice(4, 8)
WHEEL_ANGLES = slice(8, 12)
WHEEL_SPEEDS = slice(12, 16)
CENTRE_POSITION = slice(16, 18)
CENTRE_VELOCITY = slice(18, 20)
JOINT_GAPS = slice(20, 26)
JOINT_GAP_RATES = slice(26, 32)
JOINT_LOSS = 32
SPIN = 33
CENTRE_REST = slice(34, 36)
STATE_SIZE = 36

# The same as single numbers, for the kernels.
CENTRE_X, CENTRE_Y, VELOCITY_X, VELOCITY_Y = range(16, 20)
REST_X, REST_Y = 34, 35


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
