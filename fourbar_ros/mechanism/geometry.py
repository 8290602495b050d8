# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Positions of joints and mass centres."""

from __future__ import annotations

from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.mechanism import Mechanism
import numpy as np
from numpy.typing import ArrayLike


def joint_positions(mechanism: Mechanism, link_angles: ArrayLike) -> Array:
    """
    Evaluate the positions of joints 1 to 4 relative to the mass centre of the whole linkage.

    :param link_angles: (..., 4) [rad], on the closure.
    :returns: (..., 4, 2) positions in axes parallel to the table frame [m].
    """
    joints, centres = _from_joint_1(mechanism, link_angles)
    return joints - _whole(mechanism, centres)


def com_positions_in_table(mechanism: Mechanism, link_angles: ArrayLike) -> Array:
    """
    Evaluate the mass centre of each link relative to that of the whole linkage.

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
