# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Momentum and energy of links and wheels.

`angular_momentum` and `kinetic_energy` take link angles and rates, for rigid joints, relative to
the mass centre. The other functions sum over the bodies of a state, with rigid or compliant joints
and the motion of the mass centre.
"""

from __future__ import annotations

from fourbar_ros.mechanism.compliant import BODIES, BODY, to_bodies, TURN, V
from fourbar_ros.mechanism.constants import Array, JOINTS
from fourbar_ros.mechanism.dynamics import mass_matrix
from fourbar_ros.mechanism.mechanism import Mechanism
from fourbar_ros.mechanism.state import LINK_RATES, WHEEL_SPEEDS
import numpy as np
from numpy.typing import ArrayLike


def angular_momentum(mechanism: Mechanism, link_angles: ArrayLike, link_rates: ArrayLike,
                     wheel_speeds: ArrayLike) -> float:
    """
    Evaluate the angular momentum about the mass centre of the whole, links and wheels.

    :param link_angles: (4,) [rad].
    :param link_rates: (4,) [rad/s].
    :param wheel_speeds: (4,) absolute speeds, link rate plus speed relative to the link [rad/s].
    :returns: [kg m^2/s].
    """
    rates = np.asarray(link_rates, dtype=float)
    matrix = mass_matrix(np.asarray(link_angles, dtype=float), mechanism.constants)
    return float((matrix @ rates).sum()
                 + mechanism.flywheel_inertias @ np.asarray(wheel_speeds, dtype=float))


def kinetic_energy(mechanism: Mechanism, link_angles: ArrayLike, link_rates: ArrayLike,
                   wheel_speeds: ArrayLike) -> float:
    """
    Evaluate the kinetic energy relative to the mass centre, links and wheels.

    Parameters as in :func:`angular_momentum`; returns [J].
    """
    rates = np.asarray(link_rates, dtype=float)
    wheels = np.asarray(wheel_speeds, dtype=float)
    matrix = mass_matrix(np.asarray(link_angles, dtype=float), mechanism.constants)
    return float(rates @ matrix @ rates
                 + mechanism.flywheel_inertias @ (wheels * wheels)) / 2.0


def body_motion(mechanism: Mechanism, state: Array) -> tuple[Array, Array]:
    """
    Evaluate the mass centres of the links.

    :param state: (STATE_SIZE,), see `mechanism.state`.
    :returns: positions (4, 2) [m] and velocities (4, 2) [m/s] in the table frame.
    """
    bodies = np.empty(2 * BODIES)
    to_bodies(state, bodies, mechanism.constants)
    return bodies[:V].reshape(4, BODY)[:, :TURN], bodies[V:].reshape(4, BODY)[:, :TURN]


def linear_momentum(mechanism: Mechanism, state: Array) -> Array:
    """Evaluate the linear momentum of a state: (2,) in the table frame [kg m/s]."""
    momentum: Array = mechanism.link_masses @ body_motion(mechanism, state)[1]
    return momentum


def total_angular_momentum(mechanism: Mechanism, state: Array) -> float:
    """Evaluate the angular momentum of a state about the table's origin [kg m^2/s]."""
    place, speed = body_motion(mechanism, state)
    orbital = mechanism.link_masses @ (place[:, 0] * speed[:, 1] - place[:, 1] * speed[:, 0])
    return float(orbital + mechanism.link_inertias @ state[LINK_RATES]
                 + mechanism.flywheel_inertias @ state[WHEEL_SPEEDS])


def joint_gaps(mechanism: Mechanism, state: Array) -> Array:
    """
    Evaluate the gaps of the joints.

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
    """Evaluate the kinetic energy of links and wheels and the energy of joint springs [J]."""
    _, speed = body_motion(mechanism, state)
    energy = 0.5 * float(
        mechanism.link_masses @ (speed * speed).sum(axis=1)
        + mechanism.link_inertias @ state[LINK_RATES]**2
        + mechanism.flywheel_inertias @ state[WHEEL_SPEEDS]**2)
    if mechanism.constants.compliant:
        stretch = (joint_gaps(mechanism, state)**2).sum(axis=1)
        energy += 0.5 * float(mechanism.joint_stiffness @ stretch)
    return energy
