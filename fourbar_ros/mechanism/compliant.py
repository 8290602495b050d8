# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Compliant joints: four free bodies, held together by a spring and a damper in each joint.

Each body has its mass centre and its angle for coordinates, so no constraint can lose rank. The
force in joint k is `stiffness gap + damping slip`. The gap reaches from the first link of the
joint to the second (`JOINTS`); the slip is the velocity of the second relative to the first in
the middle of the gap.
"""

from __future__ import annotations

from math import ceil, cos, sin
from typing import NamedTuple

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.runge_kutta import Drive, interpolate, later_stages_of, weighted_sum
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.forces import (
    force_on_link,
    joint_power,
    Losses,
    System,
    torques_on_links,
)
from fourbar_ros.mechanism.state import (
    ANGLE,
    CENTRE_X,
    CENTRE_Y,
    GAP,
    GAP_RATE,
    JOINT_LOSS,
    RATE,
    rates_of,
    VELOCITY_X,
    VELOCITY_Y,
)
import numpy as np

# Largest phase of the fastest motion of the joints in one step [rad].
RESOLUTION = 0.4

# The motion of the bodies is one vector: coordinates x, y [m] and angle [rad] of each body, a to
# d, from Q on, then their rates from V on.
X, Y, TURN = 0, 1, 2
BODY = 3
BODIES = 4 * BODY
Q, V = 0, BODIES

# The Runge-Kutta step works in one vector, since numba counts references to each array: first the
# motion, then the coordinates at a stage, then accelerations and rates of the stages.
STAGE_Q, FIRST_ACCELERATIONS, WORK = 2 * BODIES, 3 * BODIES, 10 * BODIES

# Joints 1, 2 and 4, by which the bodies form a tree: b and d on a, and c on b.
TREE = (0, 1, 3)


class BodyStage(NamedTuple):
    """
    The derivatives of a motion.

    :ivar rates, accelerations: index of the first of each in the working vector.
    :ivar torque: on the whole about its mass centre [N m].
    :ivar damper_power: taken by the dampers of the joints [W].
    """

    rates: int
    accelerations: int
    torque: float
    damper_power: float


class Joint(NamedTuple):
    """The two links of a joint, and its place along each of them [m]."""

    first: int
    first_x: float
    second: int
    second_x: float


@kernel(forceinline=True)
def _stage(number: int, work: Array, previous: BodyStage, time: float, torques: Array,
           system: System) -> BodyStage:
    """Evaluate a stage of the Runge-Kutta step, see `later_stages_of`."""
    rates = FIRST_ACCELERATIONS + (2 * number - 1) * BODIES
    accelerations = rates + BODIES
    for i in range(BODIES):
        work[STAGE_Q + i] = work[Q + i] + time * work[previous.rates + i]
        work[rates + i] = work[V + i] + time * work[previous.accelerations + i]
    torque, power = body_accelerations(work, STAGE_Q, rates, torques, system, accelerations)
    return BodyStage(rates, accelerations, torque, power)


_later_stages = later_stages_of(_stage)


@kernel
def advance_compliant(state: Array, drive: Drive, step: float, system: System) -> None:
    """
    Advance links, joints and mass centre in place, in as many Runge-Kutta steps as they need.

    Parameters as of `advance_reduced`; the torques follow the parabola through the drive.
    """
    parts = max(1, int(ceil(system.constants.fastest_joint_mode * step / RESOLUTION)))
    work, torques = np.empty(WORK), np.empty((3, 4))
    to_bodies(state, work, system.constants)
    for part in range(parts):
        for stage in range(3):
            interpolate(drive, (part + 0.5 * stage) / parts, torques[stage])
        state[JOINT_LOSS] += _advance_bodies(
            work, Drive(torques[0], torques[1], torques[2]), step / parts, system)
    _from_bodies(state, work, system.constants)


@kernel
def _advance_bodies(work: Array, drive: Drive, step: float, system: System) -> float:
    """Take one step in place, and return the energy that the dampers took [J]."""
    constants = system.constants
    before, _ = _momentum(work, constants)
    torque, power = body_accelerations(work, Q, V, drive.start, system, FIRST_ACCELERATIONS)
    first = BodyStage(V, FIRST_ACCELERATIONS, torque, power)
    second, third, fourth = _later_stages(work, first, drive, step, system)
    for i in range(BODIES):
        work[Q + i] += weighted_sum(step, work[V + i], work[second.rates + i],
                                    work[third.rates + i], work[fourth.rates + i])
        work[V + i] += weighted_sum(
            step, work[first.accelerations + i], work[second.accelerations + i],
            work[third.accelerations + i], work[fourth.accelerations + i])
    present, inertia = _momentum(work, constants)
    gained = weighted_sum(step, first.torque, second.torque, third.torque, fourth.torque)
    rate = (before + gained - present) / inertia
    centre_x, centre_y = _centre(work, Q, constants)
    for i in range(0, BODIES, BODY):
        work[V + i + X] -= rate * (work[Q + i + Y] - centre_y)
        work[V + i + Y] += rate * (work[Q + i + X] - centre_x)
        work[V + i + TURN] += rate
    return weighted_sum(step, first.damper_power, second.damper_power, third.damper_power,
                        fourth.damper_power)


@kernel
def _centre(work: Array, q: int, constants: Constants) -> tuple[float, float]:
    """Return the mass centre of the bodies [m], or its velocity from their rates."""
    x = y = 0.0
    for i in range(4):
        x += constants.masses[i] * work[q + BODY * i + X]
        y += constants.masses[i] * work[q + BODY * i + Y]
    return x / constants.total_mass, y / constants.total_mass


@kernel
def _momentum(work: Array, constants: Constants) -> tuple[float, float]:
    """Return angular momentum [kg m^2/s] and inertia [kg m^2] about the mass centre."""
    centre_x, centre_y = _centre(work, Q, constants)
    momentum = inertia = 0.0
    for i in range(4):
        q, v, mass = Q + BODY * i, V + BODY * i, constants.masses[i]
        x, y = work[q + X] - centre_x, work[q + Y] - centre_y
        momentum += (mass * (x * work[v + Y] - y * work[v + X])
                     + constants.inertias[i] * work[v + TURN])
        inertia += mass * (x * x + y * y) + constants.inertias[i]
    return momentum, inertia


@kernel
def body_accelerations(work: Array, q: int, v: int, torques: Array, system: System, out: int
                       ) -> tuple[float, float]:
    """
    Solve the equations of motion of the four bodies.

    :param work: vector with the motion.
    :param q, v, out: index of the first coordinate, of the first rate, and of the first
        acceleration, which is set.
    :param torques: (4,) of the motors on the wheels [N m].
    :returns: the torque on the whole about its mass centre [N m], and the power that the dampers
        of the joints take [W].
    """
    constants, around = system.constants, system.around
    for i in range(4):
        work[out + BODY * i + X] = work[out + BODY * i + Y] = 0.0
        work[out + BODY * i + TURN] = -torques[i]
    power = (_add_joint_force(0, work, q, v, constants, out)
             + _add_joint_force(1, work, q, v, constants, out)
             + _add_joint_force(2, work, q, v, constants, out)
             + _add_joint_force(3, work, q, v, constants, out))
    if around.acting:
        effects = torques_on_links((work[v + TURN], work[v + BODY + TURN],
                                    work[v + 2 * BODY + TURN], work[v + 3 * BODY + TURN]), around)
        for i in range(4):
            k = BODY * i
            force_x, force_y = force_on_link(
                i, work[v + k + X], work[v + k + Y], constants, around)
            work[out + k + X] += force_x
            work[out + k + Y] += force_y
            work[out + k + TURN] += effects[i]
    centre_x, centre_y = _centre(work, q, constants)
    torque = 0.0
    for i in range(4):
        k = BODY * i
        torque += (work[out + k + TURN] + (work[q + k + X] - centre_x) * work[out + k + Y]
                   - (work[q + k + Y] - centre_y) * work[out + k + X])
        work[out + k + X] /= constants.masses[i]
        work[out + k + Y] /= constants.masses[i]
        work[out + k + TURN] /= constants.inertias[i]
    return torque, power


@kernel(forceinline=True)
def _joint(number: int, lengths: Array) -> Joint:
    """Return joint 1 to 4 by its number, 0 to 3."""
    if number == 0:
        return Joint(0, 0.0, 1, 0.0)
    if number == 1:
        return Joint(1, lengths[1], 2, 0.0)
    if number == 2:
        return Joint(3, lengths[3], 2, lengths[2])
    return Joint(0, lengths[0], 3, 0.0)


@kernel(forceinline=True)
def _add_joint_force(number: int, work: Array, q: int, v: int, constants: Constants, out: int
                     ) -> float:
    """
    Add the forces and torques of one joint, and return the power that its damper takes [W].

    The forces act on both links in the middle of the gap, and damping on the relative velocity
    there: anywhere else the pair would turn the whole.

    :param number: 0 to 3 for joints 1 to 4.
    """
    joint = _joint(number, constants.lengths)
    i, k = BODY * joint.first, BODY * joint.second
    ax, ay = _arm(joint.first, joint.first_x, work[q + i + TURN], constants)
    bx, by = _arm(joint.second, joint.second_x, work[q + k + TURN], constants)
    gap_x = work[q + k + X] + bx - work[q + i + X] - ax
    gap_y = work[q + k + Y] + by - work[q + i + Y] - ay
    ax, ay = ax + 0.5 * gap_x, ay + 0.5 * gap_y
    bx, by = bx - 0.5 * gap_x, by - 0.5 * gap_y
    stiffness, damping = constants.joint_stiffness[number], constants.joint_damping[number]
    slip_x, slip_y = _slip(work, v + i, v + k, (ax, ay), (bx, by))
    fx, fy = stiffness * gap_x + damping * slip_x, stiffness * gap_y + damping * slip_y
    work[out + i + X] += fx
    work[out + i + Y] += fy
    work[out + i + TURN] += ax * fy - ay * fx
    work[out + k + X] -= fx
    work[out + k + Y] -= fy
    work[out + k + TURN] -= bx * fy - by * fx
    return float(damping * (slip_x * slip_x + slip_y * slip_y))


@kernel(forceinline=True)
def _slip(work: Array, v: int, w: int, a: tuple[float, float], b: tuple[float, float]
          ) -> tuple[float, float]:
    """
    Return the velocity of a point of a second body relative to that of a first [m/s].

    :param v, w: index of the first rate of both bodies.
    :param a, b: vectors from their mass centres to the points [m].
    """
    return (work[w + X] - b[1] * work[w + TURN] - work[v + X] + a[1] * work[v + TURN],
            work[w + Y] + b[0] * work[w + TURN] - work[v + Y] - a[0] * work[v + TURN])


@kernel
def _arm(link: int, along: float, angle: float, constants: Constants) -> tuple[float, float]:
    """Return the vector from the mass centre of a link to a joint on it [m]."""
    c, s = cos(angle), sin(angle)
    x = along - constants.com_positions[link, 0]
    y = -constants.com_positions[link, 1]
    return c * x - s * y, s * x + c * y


@kernel
def to_bodies(state: Array, work: Array, constants: Constants) -> None:
    """Set the motion of the bodies, (2 BODIES,) or more, from a state."""
    for i in range(4):
        work[Q + BODY * i + TURN] = state[ANGLE + i]
        work[V + BODY * i + TURN] = state[RATE + i]
    work[Q + X] = work[Q + Y] = work[V + X] = work[V + Y] = 0.0
    for place in range(3):
        joint = _joint(TREE[place], constants.lengths)
        gap, gap_rate = GAP + 2 * place, GAP_RATE + 2 * place
        i, k = BODY * joint.first, BODY * joint.second
        ax, ay = _arm(joint.first, joint.first_x, work[Q + i + TURN], constants)
        bx, by = _arm(joint.second, 0.0, work[Q + k + TURN], constants)
        work[Q + k + X] = work[Q + i + X] + ax + state[gap + X] - bx
        work[Q + k + Y] = work[Q + i + Y] + ay + state[gap + Y] - by
        rate, turning = work[V + i + TURN], work[V + k + TURN]
        work[V + k + X] = work[V + i + X] - ay * rate + state[gap_rate + X] + by * turning
        work[V + k + Y] = work[V + i + Y] + ax * rate + state[gap_rate + Y] - bx * turning
    position, velocity = _centre(work, Q, constants), _centre(work, V, constants)
    for axis in range(2):
        for i in range(4):
            work[Q + BODY * i + axis] += state[CENTRE_X + axis] - position[axis]
            work[V + BODY * i + axis] += state[VELOCITY_X + axis] - velocity[axis]


@kernel
def _from_bodies(state: Array, work: Array, constants: Constants) -> None:
    """Set links, mass centre and gaps of a state from the motion of the bodies, in place."""
    for i in range(4):
        state[ANGLE + i] = work[Q + BODY * i + TURN]
        state[RATE + i] = work[V + BODY * i + TURN]
    state[CENTRE_X], state[CENTRE_Y] = _centre(work, Q, constants)
    state[VELOCITY_X], state[VELOCITY_Y] = _centre(work, V, constants)
    for place in range(3):
        joint = _joint(TREE[place], constants.lengths)
        gap, gap_rate = GAP + 2 * place, GAP_RATE + 2 * place
        i, k = BODY * joint.first, BODY * joint.second
        ax, ay = _arm(joint.first, joint.first_x, work[Q + i + TURN], constants)
        bx, by = _arm(joint.second, 0.0, work[Q + k + TURN], constants)
        state[gap + X] = work[Q + k + X] + bx - work[Q + i + X] - ax
        state[gap + Y] = work[Q + k + Y] + by - work[Q + i + Y] - ay
        state[gap_rate + X], state[gap_rate + Y] = _slip(work, V + i, V + k, (ax, ay), (bx, by))


@kernel
def compliant_losses(state: Array, system: System) -> Losses:
    """Evaluate for compliant joints what `forces.losses` does for rigid ones."""
    around, work = system.around, np.empty(2 * BODIES)
    to_bodies(state, work, system.constants)
    drag_power = drag_torque = 0.0
    for i in range(4):
        q, v = Q + BODY * i, V + BODY * i
        drag, spin_drag, rate = around.link_drag[i], around.link_spin_drag[i], work[v + TURN]
        speed_x, speed_y = work[v + X], work[v + Y]
        drag_power += drag * (speed_x * speed_x + speed_y * speed_y) + spin_drag * rate * rate
        drag_torque -= spin_drag * rate + drag * (
            (work[q + X] - state[CENTRE_X]) * speed_y - (work[q + Y] - state[CENTRE_Y]) * speed_x)
    return Losses(joint_power(rates_of(state), around), drag_power, drag_torque)


@kernel
def link_energy_and_momentum(state: Array, constants: Constants) -> tuple[float, float]:
    """
    Evaluate the links, with rigid or compliant joints.

    :returns: kinetic energy [J], and angular momentum about the mass centre [kg m^2/s].
    """
    work, energy = np.empty(2 * BODIES), 0.0
    to_bodies(state, work, constants)
    for i in range(4):
        v = V + BODY * i
        energy += 0.5 * (
            constants.masses[i] * (work[v + X] * work[v + X] + work[v + Y] * work[v + Y])
            + constants.inertias[i] * work[v + TURN] * work[v + TURN])
    return energy, _momentum(work, constants)[0]
