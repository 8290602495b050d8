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

"""Where joints and mass centres are, for drawings and for whoever needs positions."""

from __future__ import annotations

from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.parameters import Mechanism
import numpy as np
from numpy.typing import ArrayLike


def joint_positions(mechanism: Mechanism, link_angles: ArrayLike) -> Array:
    """
    Place joints 1 to 4 relative to the mass centre of the whole linkage.

    :param link_angles: (..., 4) [rad], on the closure.
    :returns: (..., 4, 2) positions in axes parallel to the table frame [m].
    """
    joints, centres = _from_joint_1(mechanism, link_angles)
    return joints - _whole(mechanism, centres)


def com_positions_in_table(mechanism: Mechanism, link_angles: ArrayLike) -> Array:
    """
    Place the mass centre of each link relative to that of the whole linkage.

    :param link_angles: (..., 4) [rad], on the closure.
    :returns: (..., 4, 2) positions in axes parallel to the table frame [m].
    """
    centres = _from_joint_1(mechanism, link_angles)[1]
    return centres - _whole(mechanism, centres)


def _from_joint_1(mechanism: Mechanism, link_angles: ArrayLike) -> tuple[Array, Array]:
    angles = np.asarray(link_angles, dtype=float)
    along = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    arms = mechanism.link_lengths[:, None] * along
    origin = np.zeros_like(arms[..., 0, :])
    joint_2, joint_4 = arms[..., 1, :], arms[..., 0, :]
    joint_3 = joint_2 + arms[..., 2, :]
    joints = np.stack([origin, joint_2, joint_3, joint_4], axis=-2)
    starts = np.stack([origin, origin, joint_2, joint_4], axis=-2)
    offsets = mechanism.com_positions
    return joints, starts + offsets[:, :1] * along + offsets[:, 1:] * across


def _whole(mechanism: Mechanism, centres: Array) -> Array:
    shares = mechanism.link_masses / mechanism.link_masses.sum()
    mean: Array = np.einsum('i,...ix->...x', shares, centres)
    return mean[..., None, :]
