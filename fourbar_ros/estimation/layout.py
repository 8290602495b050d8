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
