# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Angles on the circle."""

from __future__ import annotations

from math import pi

from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike


def wrap(angle: float) -> float:
    """Bring an angle [rad] into (-pi, pi]."""
    if -pi < angle <= pi:
        return float(angle)
    wrapped = pi - (pi - angle) % (2.0 * pi)
    return float(pi if wrapped <= -pi else wrapped)


def wrap_angles(angles: ArrayLike) -> Array:
    """Bring angles [rad] of any shape into (-pi, pi]; those inside keep all bits."""
    values = np.asarray(angles, dtype=float)
    if (np.abs(values) < pi).all():
        return values
    wrapped = pi - (pi - values) % (2.0 * pi)
    inside = (values > -pi) & (values <= pi)
    return np.where(inside, values, np.where(wrapped <= -pi, pi, wrapped))
