# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Conversion of wheel commands by name; a command is accepted or rejected as a whole."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_ros.common.named_values import RejectedError, values_by_name
from fourbar_ros.device.interface import Drive, no_torque
from fourbar_ros.mechanism import FLYWHEEL_NAMES


def drive_by_name(names: Sequence[str], positions: Sequence[float],
                  velocities: Sequence[float], efforts: Sequence[float]) -> Drive:
    """
    Convert a command by wheel names to a drive.

    One of `velocities` and `efforts` must be empty.

    :param names: wheels in any order; only these have power.
    :param positions: must be empty.
    :param velocities: speed relative to the link for each name [rad/s].
    :param efforts: torque for each name [N m].
    :raises RejectedError: of kind `fields`, `names`, `length` or `finite`.
    """
    if len(positions) or (len(velocities) and len(efforts)):
        raise RejectedError(
            'fields', 'position must be empty, and so must be one of velocity and effort')
    drive = no_torque()
    values, field = (velocities, 'velocity') if len(velocities) else (efforts, 'effort')
    for wheel, value in values_by_name(names, values, FLYWHEEL_NAMES, field).items():
        drive.values[wheel] = value
        drive.by_speed[wheel] = field == 'velocity'
        drive.powered[wheel] = True
    return drive
