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

"""Computed torque: what the wheels must give for an acceleration, shared by minimum norm."""

from __future__ import annotations

from fourbar_ros.control.allocation import minimum_norm
from fourbar_ros.mechanism.compiled import kernel
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import reduced_terms_at
import numpy as np
from numpy.typing import NDArray


@kernel
def computed_torques(link_angles: Array, link_rates: Array, acceleration: Array,
                     constants: NDArray[np.record]) -> Array:
    """
    Evaluate paper eq. 6 for the demand `A du + b`, and eq. 8 for the torques.

    :param link_angles: (4,) away from change points [rad].
    :param link_rates: (4,) of which the first two count [rad/s].
    :param acceleration: (2,) wanted of links a and b [rad/s^2].
    :param constants: (1,) of the mechanism. A record by itself takes longer to hand over than
        this takes to compute.
    :returns: (4,) torques on the wheels [N m].
    """
    a00, a01, a11, b0, b1, g1, g2, g3, g4, _, _ = reduced_terms_at(
        link_angles, link_rates, constants[0])
    wheel_map = np.array([[1.0, 0.0, g1, g3], [0.0, 1.0, g2, g4]])
    demand = np.array([a00 * acceleration[0] + a01 * acceleration[1] + b0,
                       a01 * acceleration[0] + a11 * acceleration[1] + b1])
    return minimum_norm(wheel_map, constants[0].flywheel_inertias, demand)
