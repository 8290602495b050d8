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

from fourbar_ros.device.protocol import Drive, no_torque
from fourbar_ros.mechanism import FLYWHEEL_NAMES
from fourbar_ros.mechanism.by_name import RejectedError, values_by_name


def drive_by_name(names: Sequence[str], positions: Sequence[float],
                    velocities: Sequence[float], efforts: Sequence[float]) -> Drive:
    """
    Turn a command by wheel names into a drive.

    :param names: wheels in any order, which are powered; one that is not named is not.
    :param positions: must be empty.
    :param velocities: speed relative to the link for each name [rad/s], or
    :param efforts: torque for each name [N m]: one of both, the other must be empty.
    :raises RejectedError: anything else; kinds `fields`, `names`, `length`, `finite`.
    """
    if len(positions) or (len(velocities) and len(efforts)):
        raise RejectedError(
            'fields', 'position must be empty, and so must be one of velocity and effort')
    drive = no_torque()
    given, field = (velocities, 'velocity') if len(velocities) else (efforts, 'effort')
    for wheel, value in values_by_name(names, given, FLYWHEEL_NAMES, field).items():
        drive.values[wheel] = value
        drive.by_speed[wheel] = field == 'velocity'
        drive.powered[wheel] = True
    return drive
