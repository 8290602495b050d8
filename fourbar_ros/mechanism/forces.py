# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Forces on the linkage besides those of its motors, as generalized forces.

A new effect is one more term in `force_on_link` or `torques_on_links`: all forms of the equations
of motion take their forces from these two.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Any, NamedTuple

from fourbar_ros.common.settings import check_keys, Setting, SettingError
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import Vector4
from fourbar_ros.mechanism.constants import Array, Constants, Fields, record
from fourbar_ros.mechanism.mechanism import checked_array, JOINT_NAMES, LINK_NAMES
import numpy as np
from numpy.typing import ArrayLike, NDArray

# The effects, and the names of their elements where there are several.
_EFFECTS = (
    (Setting('joint_coulomb', 0.0, 'N m', 'Coulomb friction torque between the links of a joint',
             low=0.0), JOINT_NAMES),
    (Setting('joint_viscous', 0.0, 'N m s', 'viscous friction torque per relative rate',
             low=0.0), JOINT_NAMES),
    (Setting('joint_static_ratio', 1.0, '', 'static over Coulomb friction', low=1.0), ()),
    (Setting('stribeck_rate', 0.1, 'rad/s',
             'relative rate at which half of the excess of static friction is left', above=0.0),
     ()),
    (Setting('smoothing', 1e-4, 'rad/s', 'relative rate over which Coulomb friction builds up, '
             'as rate / sqrt(rate^2 + smoothing^2)', above=0.0), ()),
    (Setting('link_drag', 0.0, 'N s/m', 'force against the speed of the mass centre of a link',
             low=0.0), LINK_NAMES),
    (Setting('link_spin_drag', 0.0, 'N m s', 'torque against the rate of a link', low=0.0),
     LINK_NAMES),
    (Setting('gravity', 0.0, 'm/s^2', 'acceleration along the table, by its tilt'), ('x', 'y')),
    (Setting('link_torques', 0.0, 'N m', 'constant torque on a link from outside'), LINK_NAMES),
)

# The record of the effects; where `acting` is False they are all without effect.
FIELDS: Fields = [
    *((row.name, float, (len(elements),) if elements else ()) for row, elements in _EFFECTS),
    ('acting', bool, ())]

# A scalar of `FIELDS`, made by :func:`surroundings`; `NOTHING` where none acts.
Surroundings = np.record


class System(NamedTuple):
    """The linkage and its surroundings, for kernels."""

    constants: Constants
    around: Surroundings


class Losses(NamedTuple):
    """
    The losses of the links.

    :ivar joint_power: lost in the joints [W].
    :ivar drag_power: lost to drag [W].
    :ivar drag_torque: torque of the drag about the mass centre [N m].
    """

    joint_power: float
    drag_power: float
    drag_torque: float


def surroundings(**effects: ArrayLike) -> Surroundings:
    """
    Describe the forces besides those of the motors; an effect that is not named does not act.

    :param effects: by the names in `FIELDS`. A single number stands for all joints or links.
    :raises SettingError: unknown name, wrong shape, not finite, or a negative friction or drag.
    """
    check_keys(effects, (), 'surroundings', SettingError, [row.name for row, _ in _EFFECTS])
    values: dict[str, Any] = {}
    for row, elements in _EFFECTS:
        value = effects.get(row.name, row.default)
        values[row.name] = (checked_array(row, value, elements) if np.ndim(value)
                            else row.check(value))
    acting = any(np.any(values[row.name]) for row, elements in _EFFECTS if elements)
    return record(FIELDS, acting=acting, **values)


NOTHING = surroundings()


@kernel
def force_on_link(link: int, velocity_x: float, velocity_y: float, constants: Constants,
                  around: Surroundings) -> tuple[float, float]:
    """
    Evaluate the force at the mass centre of a link.

    :param link: its index.
    :param velocity_x, velocity_y: of its mass centre, in the table frame [m/s].
    :returns: x and y, in the table frame [N].
    """
    mass, drag = constants.masses[link], around.link_drag[link]
    return (mass * around.gravity[0] - drag * velocity_x,
            mass * around.gravity[1] - drag * velocity_y)


@kernel
def torques_on_links(rates: Vector4, around: Surroundings) -> Vector4:
    """Evaluate the torques on the four links [N m] at their rates [rad/s]."""
    rate_a, rate_b, rate_c, rate_d = rates
    first = _joint_torque(0, rate_b - rate_a, around)
    second = _joint_torque(1, rate_c - rate_b, around)
    third = _joint_torque(2, rate_c - rate_d, around)
    fourth = _joint_torque(3, rate_d - rate_a, around)
    outside, drag = around.link_torques, around.link_spin_drag
    return (outside[0] - drag[0] * rate_a - first - fourth,
            outside[1] - drag[1] * rate_b + first - second,
            outside[2] - drag[2] * rate_c + second + third,
            outside[3] - drag[3] * rate_d + fourth - third)


@kernel
def _joint_torque(joint: int, rate: float, around: Surroundings) -> float:
    """Evaluate the friction on the link whose rate counts as positive."""
    return float(-rate * (around.joint_viscous[joint] + around.joint_coulomb[joint] * dry_friction(
        rate, around.joint_static_ratio, around.stribeck_rate, around.smoothing)))


@kernel
def dry_friction(rate: float, static_ratio: float, stribeck_rate: float, smoothing: float
                 ) -> float:
    """
    Evaluate dry friction divided by Coulomb friction and rate, a function of the rate [s/rad].

    The friction falls from static to Coulomb friction by the law of Hess and Soom (J. Tribology
    112, 1990, p. 147). It rises from rest over the rate `smoothing`, without a jump.
    """
    ratio = rate / stribeck_rate
    return float((1.0 + (static_ratio - 1.0) / (1.0 + ratio * ratio))
                 / sqrt(rate * rate + smoothing * smoothing))


@kernel
def generalized_forces(
    cosines: Vector4, sines: Vector4, rates: Vector4, velocity: tuple[float, float],
    system: System,
) -> tuple[Vector4, tuple[float, float]]:
    """
    Sum all effects as generalized forces on the four link angles and the mass centre.

    :param cosines, sines: of the four link angles.
    :param rates: of the links [rad/s].
    :param velocity: of the mass centre of the whole [m/s].
    :returns: on the link angles with the mass centre fixed [N m], and the force on the mass
        centre, in the table frame [N].
    """
    constants, around = system.constants, system.around
    rate_a, rate_b, rate_c, rate_d = rates
    qa, qb, qc, qd = torques_on_links(rates, around)
    total_x = total_y = 0.0
    for i in range(4):
        # Velocity of the mass centre of link i per rate of each link: E R(phi_j) arms[i, j].
        ax, ay = _lever(cosines[0], sines[0], constants.arms[i, 0])
        bx, by = _lever(cosines[1], sines[1], constants.arms[i, 1])
        cx, cy = _lever(cosines[2], sines[2], constants.arms[i, 2])
        dx, dy = _lever(cosines[3], sines[3], constants.arms[i, 3])
        fx, fy = force_on_link(
            i, velocity[0] + rate_a * ax + rate_b * bx + rate_c * cx + rate_d * dx,
            velocity[1] + rate_a * ay + rate_b * by + rate_c * cy + rate_d * dy,
            constants, around)
        qa += ax * fx + ay * fy
        qb += bx * fx + by * fy
        qc += cx * fx + cy * fy
        qd += dx * fx + dy * fy
        total_x += fx
        total_y += fy
    return (qa, qb, qc, qd), (total_x, total_y)


@kernel
def forces_along(angles: Array, rates: Array, constants: NDArray[np.record],
                 around: NDArray[np.record]) -> Array:
    """
    Evaluate the generalized forces on the link angles along a motion, the mass centre at rest.

    :param angles, rates: (n, 4) of the links [rad], [rad/s].
    :param constants, around: (1,) of the mechanism and of its surroundings.
    :returns: (n, 4) [N m].
    """
    forces, system = np.empty((len(angles), 4)), System(constants[0], around[0])
    for n in range(len(angles)):
        a, b, c, d = angles[n]
        on_links, _ = generalized_forces(
            (cos(a), cos(b), cos(c), cos(d)), (sin(a), sin(b), sin(c), sin(d)),
            (rates[n, 0], rates[n, 1], rates[n, 2], rates[n, 3]), (0.0, 0.0), system)
        for link in range(4):
            forces[n, link] = on_links[link]
    return forces


@kernel
def _lever(cosine: float, sine: float, arm: Array) -> tuple[float, float]:
    return -sine * arm[0] - cosine * arm[1], cosine * arm[0] - sine * arm[1]


@kernel
def losses(cosines: Vector4, sines: Vector4, rates: Vector4, velocity: tuple[float, float],
           system: System) -> Losses:
    """
    Evaluate the losses of rigid links.

    Parameters as of :func:`generalized_forces`.
    """
    constants, around = system.constants, system.around
    drag_power = drag_torque = 0.0
    for i in range(4):
        drag_power += around.link_spin_drag[i] * rates[i] * rates[i]
        drag_torque -= around.link_spin_drag[i] * rates[i]
        drag = around.link_drag[i]
        if drag > 0.0:
            x = y = speed_x = speed_y = 0.0
            for j in range(4):
                dx, dy = rotated(cosines[j], sines[j], constants.arms[i, j])
                x, y = x + dx, y + dy
                speed_x, speed_y = speed_x - rates[j] * dy, speed_y + rates[j] * dx
            speed_x, speed_y = speed_x + velocity[0], speed_y + velocity[1]
            drag_power += drag * (speed_x * speed_x + speed_y * speed_y)
            drag_torque -= drag * (x * speed_y - y * speed_x)
    return Losses(joint_power(rates, around), drag_power, drag_torque)


@kernel
def rotated(cosine: float, sine: float, vector: Array) -> tuple[float, float]:
    """Return x and y of a vector (2,) after a rotation."""
    return cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]


@kernel
def joint_power(rates: Vector4, around: Surroundings) -> float:
    """Evaluate the power that friction in the joints takes at the rates of the links [W]."""
    rate_a, rate_b, rate_c, rate_d = rates
    relative = (rate_b - rate_a, rate_c - rate_b, rate_c - rate_d, rate_d - rate_a)
    lost = 0.0
    for joint in range(4):
        lost -= _joint_torque(joint, relative[joint], around) * relative[joint]
    return lost
