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

"""How the four wheels share what two axes need."""

from __future__ import annotations

from fourbar_ros.mechanism.compiled import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np


@kernel
def minimum_norm(wheel_map: Array, flywheel_inertias: Array, demand: Array) -> Array:
    """
    Find the torques with the smallest norm of wheel accelerations (paper eq. 8, corrected).

    With `I_f = -G diag(If)` of eq. 6, `s = I_f^T (I_f I_f^T)^-1 (A du + b)` and `tau = If s`.

    :param wheel_map: G (2, 4).
    :param flywheel_inertias: If (4,) [kg m^2].
    :param demand: A du + b (2,) [N m].
    :returns: (4,) torques on the wheels [N m].
    """
    n00 = n01 = n11 = 0.0
    for wheel in range(flywheel_inertias.size):
        first, second = wheel_map[0, wheel], wheel_map[1, wheel]
        weight = flywheel_inertias[wheel] ** 2
        n00 += weight * first * first
        n01 += weight * first * second
        n11 += weight * second * second
    # The identity in G keeps this matrix of two by two far from singular.
    inverse = 1.0 / (n00 * n11 - n01 * n01)
    first_share = (n11 * demand[0] - n01 * demand[1]) * inverse
    second_share = (n00 * demand[1] - n01 * demand[0]) * inverse
    torques = np.empty(flywheel_inertias.size)
    for wheel in range(flywheel_inertias.size):
        torques[wheel] = -flywheel_inertias[wheel] ** 2 * (
            wheel_map[0, wheel] * first_share + wheel_map[1, wheel] * second_share)
    return torques
