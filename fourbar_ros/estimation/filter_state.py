# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Layout of the state of the filter.

The state is one vector x: angles [rad] and rates [rad/s] of the four links, as in
:mod:`fourbar_ros.mechanism.state`; disturbance torques on links a and b [N m], which stand for all
forces except those of the wheels; with uncertain link lengths, the lengths of links b, c and d
[m]; then one bias [rad/s] for each gyro that has sent a sample.
"""

from __future__ import annotations

from fourbar_ros.mechanism import JOINT_LINKS, SENSOR_NAMES
import numpy as np

ANGLES = slice(0, 4)
RATES = slice(4, 8)
MOTION = slice(0, 8)
"""Angles and rates."""

TORQUES = slice(8, 10)
SIZE_EXACT = 10
"""Size of the state without gyros for exact link lengths."""

LENGTHS = slice(10, 13)
SIZE_WITH_LENGTHS = 13
"""Size of the state without gyros for uncertain link lengths."""

MAX_SIZE = SIZE_WITH_LENGTHS + len(SENSOR_NAMES)
"""Size of the state for uncertain link lengths and a gyro at every sensor."""

FREE = np.array([0, 1, 4, 5])
"""Indices of phi_a, phi_b, omega_a, omega_b: these determine all links off change points."""

GYROS = len(SENSOR_NAMES)
"""Index of the gyro of the first of SENSOR_NAMES; the other gyros follow."""

SENSOR_ROWS = np.vstack([np.eye(4), np.zeros((4, 4))])
"""Row n maps the angles of the links to the angle that sensor n measures."""
for _row, (_first, _second) in enumerate(JOINT_LINKS, 4):
    SENSOR_ROWS[_row, [_first, _second]] = -1.0, 1.0
