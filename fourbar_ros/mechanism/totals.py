# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Momentum and energy of the whole, body by body, for rigid joints and for joints that give.

All motion counts, that of the mass centre included; compare `dynamics.angular_momentum` and
`dynamics.kinetic_energy`, which take link angles and rates alone.
"""

from __future__ import annotations

from fourbar_ros.mechanism.compliant import BODIES, to_bodies
from fourbar_ros.mechanism.constants import Array, JOINTS
from fourbar_ros.mechanism.mechanism import Mechanism
from fourbar_ros.mechanism.state import LINK_RATES, WHEEL_SPEEDS
import numpy as np


def body_motion(mechanism: Mechanism, state: Array) -> tuple[Array, Array]:
    """
    Place the mass centres of the links.

    :param state: (STATE_SIZE,), see mechanism.layout.
    :returns: positions (4, 2) [m] and velocities (4, 2) [m/s] in the table frame.
    """
    q, v = np.empty(BODIES), np.empty(BODIES)
    to_bodies(state, q, v, mechanism.constants)
    return q.reshape(4, 3)[:, :2], v.reshape(4, 3)[:, :2]


def linear_momentum(mechanism: Mechanism, state: Array) -> Array:
    """Sum up the linear momentum of a state: (2,) in the table frame [kg m/s]."""
    momentum: Array = mechanism.link_masses @ body_motion(mechanism, state)[1]
    return momentum


def total_angular_momentum(mechanism: Mechanism, state: Array) -> float:
    """Sum up the angular momentum of a state about the table's origin [kg m^2/s]."""
    place, speed = body_motion(mechanism, state)
    orbital = mechanism.link_masses @ (place[:, 0] * speed[:, 1] - place[:, 1] * speed[:, 0])
    return float(orbital + mechanism.link_inertias @ state[LINK_RATES]
                 + mechanism.flywheel_inertias @ state[WHEEL_SPEEDS])


def joint_gaps(mechanism: Mechanism, state: Array) -> Array:
    """
    Measure how far the joints are open.

    :returns: (4, 2) from the first to the second link of joints 1 to 4, in the table frame [m].
    """
    place, _ = body_motion(mechanism, state)
    gaps = np.empty((4, 2))
    for joint, ends in enumerate(JOINTS):
        at = []
        for link, far in ends:
            c, s = np.cos(state[link]), np.sin(state[link])
            x = (mechanism.link_lengths[link] if far else 0.0) - mechanism.com_positions[link, 0]
            y = -mechanism.com_positions[link, 1]
            at.append(place[link] + [c * x - s * y, s * x + c * y])
        gaps[joint] = at[1] - at[0]
    return gaps


def mechanical_energy(mechanism: Mechanism, state: Array) -> float:
    """Sum up the kinetic energy of links and wheels, and that in the joints' springs [J]."""
    _, speed = body_motion(mechanism, state)
    energy = 0.5 * float(
        mechanism.link_masses @ (speed * speed).sum(axis=1)
        + mechanism.link_inertias @ state[LINK_RATES]**2
        + mechanism.flywheel_inertias @ state[WHEEL_SPEEDS]**2)
    if mechanism.constants.compliant:
        stretch = (joint_gaps(mechanism, state)**2).sum(axis=1)
        energy += 0.5 * float(mechanism.joint_stiffness @ stretch)
    return energy
