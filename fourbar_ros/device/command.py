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

"""Wheel commands as they come in: taken whole or rejected whole."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_ros.mechanism import FLYWHEEL_NAMES
from fourbar_ros.mechanism.by_name import RejectedError, values_by_name
from fourbar_ros.mechanism.parameters import Array
import numpy as np


def torques_by_name(names: Sequence[str], positions: Sequence[float],
                    velocities: Sequence[float], efforts: Sequence[float]) -> Array:
    """
    Turn a command by wheel names into torques.

    :param names: wheels in any order; one that is not named gets no torque.
    :param positions, velocities: must be empty, wheels are commanded by effort.
    :param efforts: torque for each name [N m].
    :returns: (4,) torques in the order a, b, c, d [N m].
    :raises RejectedError: anything else; kinds `fields`, `names`, `length`, `finite`.
    """
    if len(positions) or len(velocities):
        raise RejectedError('fields', 'position and velocity must be empty, only effort is taken')
    torques = np.zeros(4)
    for wheel, effort in values_by_name(names, efforts, FLYWHEEL_NAMES, 'effort').items():
        torques[wheel] = effort
    return torques
