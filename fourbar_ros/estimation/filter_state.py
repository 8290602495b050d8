# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The state of the filter as one vector.

Angles and rates of the four links, of which two each are free, except at a change point, where it
is three; the disturbance torques on links a and b, which stand for all that pushes the linkage
besides its wheels; where the loop may fail to close, the lengths of links b, c and d [m]; then one
bias [rad/s] for each gyro that was ever heard of.
"""

from __future__ import annotations

import numpy as np

ANGLES = slice(0, 4)
RATES = slice(4, 8)
TORQUES = slice(8, 10)
BIASES = 10
"""Where biases begin, if the loop closes exactly."""

LENGTHS = slice(10, 13)
LOOSE_BIASES = 13
"""Where biases begin, if it may fail to."""

FREE = np.array([0, 1, 4, 5])
"""phi_a, phi_b, omega_a, omega_b: away from change points all links follow these."""
