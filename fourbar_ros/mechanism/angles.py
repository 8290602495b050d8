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
    """Bring angles [rad] of any shape into (-pi, pi]; what is there already stays bit for bit."""
    given = np.asarray(angles, dtype=float)
    if (np.abs(given) < pi).all():
        return given
    wrapped = pi - (pi - given) % (2.0 * pi)
    inside = (given > -pi) & (given <= pi)
    return np.where(inside, given, np.where(wrapped <= -pi, pi, wrapped))
