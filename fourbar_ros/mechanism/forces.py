# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What acts on the linkage besides its motors, as generalized forces.

A new effect is one more term in `force_on_link` or `torques_on_links`: every way to solve the
equations of motion takes its forces from these two.
"""

from __future__ import annotations

from math import cos, sin, sqrt

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import Vector4
from fourbar_ros.mechanism.constants import Array, Constants, record
from fourbar_ros.mechanism.mechanism import numbers
import numpy as np
from numpy.typing import ArrayLike, NDArray


class ForceError(FourbarError):
    """An effect that is not described by finite numbers, or that would feed energy in."""


FIELDS: list[tuple[str, type, tuple[int, ...]]] = [
    ('joint_coulomb', float, (4,)),     # N m
    ('joint_viscous', float, (4,)),     # N m s
    ('joint_static_ratio', float, ()),  # static over Coulomb friction
    ('stribeck_rate', float, ()),       # rad/s
    ('smoothing', float, ()),           # rad/s
    ('link_drag', float, (4,)),         # N s/m
    ('link_spin_drag', float, (4,)),    # N m s
    ('gravity', float, (2,)),           # m/s^2
    ('link_torques', float, (4,)),      # N m
    ('acting', bool, ()),               # False: everything above is without effect
]

Surroundings = np.record
"""Parameters of the effects, made by :func:`surroundings`; `NOTHING` where none acts."""


def surroundings(
    *, joint_coulomb: ArrayLike = 0.0, joint_viscous: ArrayLike = 0.0,
    joint_static_ratio: float = 1.0, stribeck_rate: float = 0.1, smoothing: float = 1e-4,
    link_drag: ArrayLike = 0.0, link_spin_drag: ArrayLike = 0.0, gravity: ArrayLike = 0.0,
    link_torques: ArrayLike = 0.0,
) -> Surroundings:
    """
    Describe what acts besides the motors; what is left out does not act.

    A single number stands for all four joints or links.

    :param joint_coulomb: (4,) friction torque between the two links of joints 1 to 4 [N m].
    :param joint_viscous: (4,) friction torque per relative rate in the joints [N m s].
    :param joint_static_ratio: how much more than Coulomb friction it takes to break away.
    :param stribeck_rate: relative rate at which half of that is left [rad/s].
    :param smoothing: relative rate [rad/s] around which Coulomb friction builds up, as
        `rate / sqrt(rate^2 + smoothing^2)`.
    :param link_drag: (4,) force against the speed of each link's mass centre [N s/m].
    :param link_spin_drag: (4,) torque against the rate of each link [N m s].
    :param gravity: (2,) acceleration along the table, as by its tilt, x and y [m/s^2].
    :param link_torques: (4,) constant torques on the links from outside [N m].
    :raises ForceError: wrong shape, not finite, or a negative friction or drag.
    """
    given = {
        'joint_coulomb': (joint_coulomb, 4), 'joint_viscous': (joint_viscous, 4),
        'link_drag': (link_drag, 4), 'link_spin_drag': (link_spin_drag, 4),
        'gravity': (gravity, 2), 'link_torques': (link_torques, 4)}
    values = {}
    for name, (value, size) in given.items():
        array = numbers(name, value, ForceError)
        if array.shape not in ((), (size,)):
            raise ForceError(f'{name} must be one number or {size}, got shape {array.shape}')
        values[name] = array = np.broadcast_to(array, (size,)).copy()
        if not np.isfinite(array).all():
            raise ForceError(f'{name} must be finite, got {array[~np.isfinite(array)][0]}')
        if name not in ('gravity', 'link_torques') and (array < 0.0).any():
            raise ForceError(f'{name} must not be negative, got {array.min():g}')
    for name, rate in (('smoothing', smoothing), ('stribeck_rate', stribeck_rate)):
        if not 0.0 < rate < np.inf:
            raise ForceError(f'{name} must be a positive rate in rad/s, got {rate:g}')
    if not 1.0 <= joint_static_ratio < np.inf:
        raise ForceError(f'joint_static_ratio must be at least 1, got {joint_static_ratio:g}')
    acting = any(array.any() for array in values.values())
    return record(FIELDS, acting=acting, smoothing=smoothing, stribeck_rate=stribeck_rate,
                  joint_static_ratio=joint_static_ratio, **values)


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
    return float(-rate * (around.joint_viscous[joint] + around.joint_coulomb[joint] * grip(
        rate, around.joint_static_ratio, around.stribeck_rate, around.smoothing)))


@kernel
def grip(rate: float, static_ratio: float, stribeck_rate: float, smoothing: float) -> float:
    """
    Evaluate dry friction over Coulomb friction and rate, a function of the rate alone [s/rad].

    It falls from static to Coulomb friction as Hess and Soom have it (J. Tribology 112, 1990,
    p. 147), and rises from rest over `smoothing`, so that there is nothing to jump about.
    """
    ratio = rate / stribeck_rate
    return float((1.0 + (static_ratio - 1.0) / (1.0 + ratio * ratio))
                 / sqrt(rate * rate + smoothing * smoothing))


@kernel
def generalized_forces(
    cosines: Vector4, sines: Vector4, rates: Vector4, velocity: tuple[float, float],
    constants: Constants, around: Surroundings,
) -> tuple[Vector4, tuple[float, float]]:
    """
    Sum up all effects as generalized forces on the four link angles and the mass centre.

    :param cosines, sines: of the four link angles.
    :param rates: of the links [rad/s].
    :param velocity: of the mass centre of the whole [m/s].
    :returns: on the link angles [N m], the mass centre staying where it is; and the force on the
        mass centre, in the table frame [N].
    """
    rate_a, rate_b, rate_c, rate_d = rates
    qa, qb, qc, qd = torques_on_links(rates, around)
    total_x = total_y = 0.0
    for i in range(4):
        # Where the mass centre of link i goes when one link turns: E R(phi_j) arms[i, j].
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
    :param constants, around: (1,) of the mechanism, and of what surrounds it.
    :returns: (n, 4) [N m].
    """
    found = np.empty((len(angles), 4))
    for n in range(len(angles)):
        a, b, c, d = angles[n]
        on_links, _ = generalized_forces(
            (cos(a), cos(b), cos(c), cos(d)), (sin(a), sin(b), sin(c), sin(d)),
            (rates[n, 0], rates[n, 1], rates[n, 2], rates[n, 3]), (0.0, 0.0), constants[0],
            around[0])
        for link in range(4):
            found[n, link] = on_links[link]
    return found


@kernel
def _lever(cosine: float, sine: float, arm: Array) -> tuple[float, float]:
    return -sine * arm[0] - cosine * arm[1], cosine * arm[0] - sine * arm[1]


@kernel
def losses(cosines: Vector4, sines: Vector4, rates: Vector4, velocity: tuple[float, float],
           constants: Constants, around: Surroundings
           ) -> tuple[float, float, float]:
    """
    Evaluate what friction and drag take from the links.

    Parameters as of :func:`generalized_forces`.

    :returns: power lost in the joints and to drag [W], and torque of the drag about the mass
        centre [N m].
    """
    in_joints = lost_in_joints(rates, around)
    to_drag = torque = 0.0
    for i in range(4):
        to_drag += around.link_spin_drag[i] * rates[i] * rates[i]
        torque -= around.link_spin_drag[i] * rates[i]
        drag = around.link_drag[i]
        if drag > 0.0:
            x, y, speed_x, speed_y = _place(i, cosines, sines, rates, constants)
            speed_x, speed_y = speed_x + velocity[0], speed_y + velocity[1]
            to_drag += drag * (speed_x * speed_x + speed_y * speed_y)
            torque -= drag * (x * speed_y - y * speed_x)
    return in_joints, to_drag, torque


@kernel
def lost_in_joints(rates: Vector4, around: Surroundings) -> float:
    """Evaluate the power that friction in the joints takes at the links' rates [W]."""
    rate_a, rate_b, rate_c, rate_d = rates
    relative = (rate_b - rate_a, rate_c - rate_b, rate_c - rate_d, rate_d - rate_a)
    lost = 0.0
    for joint in range(4):
        lost -= _joint_torque(joint, relative[joint], around) * relative[joint]
    return lost


@kernel
def _place(link: int, cosines: Vector4, sines: Vector4, rates: Vector4, constants: Constants
           ) -> tuple[float, float, float, float]:
    """Return where the mass centre of a link is [m], and its velocity [m/s], from the whole's."""
    x = y = speed_x = speed_y = 0.0
    for j in range(4):
        arm = constants.arms[link, j]
        dx, dy = cosines[j] * arm[0] - sines[j] * arm[1], sines[j] * arm[0] + cosines[j] * arm[1]
        x, y = x + dx, y + dy
        speed_x, speed_y = speed_x - rates[j] * dy, speed_y + rates[j] * dx
    return x, y, speed_x, speed_y
