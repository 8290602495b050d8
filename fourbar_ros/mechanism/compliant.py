# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Joints that give: four free bodies, held together by a spring and a damper in each joint.

Each body has its mass centre and its angle for coordinates, so no constraint can lose rank. The
pull in joint k is `stiffness gap + damping slip`: the gap reaches from the first link of the joint
to the second (`JOINTS`), and the slip is the velocity of the second relative to the first in the
middle of the gap.
"""

from __future__ import annotations

from math import ceil, cos, sin

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import interpolate
from fourbar_ros.mechanism.forces import (
    force_on_link,
    lost_in_joints,
    Surroundings,
    torques_on_links,
)
from fourbar_ros.mechanism.state import (
    CENTRE_X,
    CENTRE_Y,
    JOINT_LOSS,
    VELOCITY_X,
    VELOCITY_Y,
)
import numpy as np

# The fastest motion of the joints turns at most this far in one step [rad].
RESOLUTION = 0.4

# Three coordinates for each body, x, y [m] and angle [rad], in the order a, b, c, d.
BODIES = 12


@kernel
def advance_compliant(state: Array, start: Array, middle: Array, end: Array, step: float,
                      constants: Constants, around: Surroundings) -> None:
    """
    Advance links, joints and mass centre in place, in as many Runge-Kutta steps as they need.

    Parameters as of `advance_reduced`; the torques are taken as a parabola through the three.
    """
    parts = max(1, int(ceil(constants.fastest_joint_mode * step / RESOLUTION)))
    h = step / parts
    work = np.empty((10, BODIES))
    q, v = work[0], work[1]
    to_bodies(state, q, v, constants)
    torques = np.empty((3, 4))
    for part in range(parts):
        for stage in range(3):
            interpolate(start, middle, end, (part + 0.5 * stage) / parts, torques[stage])
        state[JOINT_LOSS] += _advance_bodies(q, v, torques, h, constants, around, work)
    _from_bodies(state, q, v, constants)


@kernel
def _advance_bodies(q: Array, v: Array, torques: Array, h: float, constants: Constants,
                    around: Surroundings, work: Array) -> float:
    """Take one step, and return the energy that the dampers took [J]."""
    stage_q, v2, v3, v4 = work[2], work[3], work[4], work[5]
    a1, a2, a3, a4 = work[6], work[7], work[8], work[9]
    before, _ = _spin(q, v, constants)
    turning1, heat1 = body_accelerations(q, v, torques[0], constants, around, a1)
    for i in range(BODIES):
        stage_q[i], v2[i] = q[i] + 0.5 * h * v[i], v[i] + 0.5 * h * a1[i]
    turning2, heat2 = body_accelerations(stage_q, v2, torques[1], constants, around, a2)
    for i in range(BODIES):
        stage_q[i], v3[i] = q[i] + 0.5 * h * v2[i], v[i] + 0.5 * h * a2[i]
    turning3, heat3 = body_accelerations(stage_q, v3, torques[1], constants, around, a3)
    for i in range(BODIES):
        stage_q[i], v4[i] = q[i] + h * v3[i], v[i] + h * a3[i]
    turning4, heat4 = body_accelerations(stage_q, v4, torques[2], constants, around, a4)
    for i in range(BODIES):
        q[i] += h / 6.0 * (v[i] + 2.0 * (v2[i] + v3[i]) + v4[i])
        v[i] += h / 6.0 * (a1[i] + 2.0 * (a2[i] + a3[i]) + a4[i])
    after, inertia = _spin(q, v, constants)
    gained = h / 6.0 * (turning1 + 2.0 * (turning2 + turning3) + turning4)
    rate = (before + gained - after) / inertia
    centre_x, centre_y = _centre(q, constants)
    for i in range(4):
        v[3 * i] -= rate * (q[3 * i + 1] - centre_y)
        v[3 * i + 1] += rate * (q[3 * i] - centre_x)
        v[3 * i + 2] += rate
    return h / 6.0 * (heat1 + 2.0 * (heat2 + heat3) + heat4)


@kernel
def _centre(q: Array, constants: Constants) -> tuple[float, float]:
    """Return the mass centre of the bodies [m], or its velocity from their speeds."""
    x = y = 0.0
    for i in range(4):
        x += constants.masses[i] * q[3 * i]
        y += constants.masses[i] * q[3 * i + 1]
    return x / constants.total_mass, y / constants.total_mass


@kernel
def _spin(q: Array, v: Array, constants: Constants) -> tuple[float, float]:
    """Return angular momentum [kg m^2/s] and inertia [kg m^2] about the mass centre."""
    centre_x, centre_y = _centre(q, constants)
    momentum = inertia = 0.0
    for i in range(4):
        x, y, mass = q[3 * i] - centre_x, q[3 * i + 1] - centre_y, constants.masses[i]
        momentum += (mass * (x * v[3 * i + 1] - y * v[3 * i])
                     + constants.inertias[i] * v[3 * i + 2])
        inertia += mass * (x * x + y * y) + constants.inertias[i]
    return momentum, inertia


@kernel
def body_accelerations(q: Array, v: Array, torques: Array, constants: Constants,
                       around: Surroundings, out: Array) -> tuple[float, float]:
    """
    Solve the equations of motion of the four bodies.

    :param q, v: (12,) coordinates and speeds, see `BODIES`.
    :param torques: (4,) of the motors on the wheels [N m].
    :param out: (12,) receives the accelerations.
    :returns: the torque on the whole about its mass centre [N m], and the power that the joints'
        dampers take [W].
    """
    for i in range(4):
        out[3 * i] = out[3 * i + 1] = 0.0
        out[3 * i + 2] = -torques[i]
    lengths = constants.lengths
    heat = (_pull(0, 0, 0.0, 1, 0.0, q, v, constants, out)
            + _pull(1, 1, lengths[1], 2, 0.0, q, v, constants, out)
            + _pull(2, 3, lengths[3], 2, lengths[2], q, v, constants, out)
            + _pull(3, 0, lengths[0], 3, 0.0, q, v, constants, out))
    if around.acting:
        effects = torques_on_links((v[2], v[5], v[8], v[11]), around)
        for i in range(4):
            force_x, force_y = force_on_link(i, v[3 * i], v[3 * i + 1], constants, around)
            out[3 * i] += force_x
            out[3 * i + 1] += force_y
            out[3 * i + 2] += effects[i]
    centre_x, centre_y = _centre(q, constants)
    turning = 0.0
    for i in range(4):
        turning += (out[3 * i + 2] + (q[3 * i] - centre_x) * out[3 * i + 1]
                    - (q[3 * i + 1] - centre_y) * out[3 * i])
        out[3 * i] /= constants.masses[i]
        out[3 * i + 1] /= constants.masses[i]
        out[3 * i + 2] /= constants.inertias[i]
    return turning, heat


@kernel
def _pull(joint: int, first: int, first_x: float, second: int, second_x: float, q: Array,
          v: Array, constants: Constants, out: Array) -> float:
    """
    Add the forces and torques of one joint, at first_x and second_x along its links [m].

    Returns the power that its damper takes [W].

    They act, on both links, in the middle of the gap, and damping on the relative velocity there:
    anywhere else the pair would turn the whole.
    """
    ax, ay = _arm(first, first_x, q, constants)
    bx, by = _arm(second, second_x, q, constants)
    i, k = 3 * first, 3 * second
    gap_x, gap_y = q[k] + bx - q[i] - ax, q[k + 1] + by - q[i + 1] - ay
    ax, ay = ax + 0.5 * gap_x, ay + 0.5 * gap_y
    bx, by = bx - 0.5 * gap_x, by - 0.5 * gap_y
    stiffness, damping = constants.joint_stiffness[joint], constants.joint_damping[joint]
    slip_x = v[k] - by * v[k + 2] - v[i] + ay * v[i + 2]
    slip_y = v[k + 1] + bx * v[k + 2] - v[i + 1] - ax * v[i + 2]
    fx, fy = stiffness * gap_x + damping * slip_x, stiffness * gap_y + damping * slip_y
    out[i] += fx
    out[i + 1] += fy
    out[i + 2] += ax * fy - ay * fx
    out[k] -= fx
    out[k + 1] -= fy
    out[k + 2] -= bx * fy - by * fx
    return float(damping * (slip_x * slip_x + slip_y * slip_y))


@kernel
def _arm(link: int, along: float, q: Array, constants: Constants) -> tuple[float, float]:
    """Return the way from the mass centre of a link to a joint on it [m]."""
    c, s = cos(q[3 * link + 2]), sin(q[3 * link + 2])
    x = along - constants.com_positions[link, 0]
    y = -constants.com_positions[link, 1]
    return c * x - s * y, s * x + c * y


@kernel
def to_bodies(state: Array, q: Array, v: Array, constants: Constants) -> None:
    """Place the bodies: b and d hang on a by joints 1 and 4, c on b by joint 2."""
    for i in range(4):
        q[3 * i + 2], v[3 * i + 2] = state[i], state[4 + i]
    gaps, rates = state[20:26], state[26:32]
    q[0] = q[1] = v[0] = v[1] = 0.0
    _hang(0, 0.0, 1, gaps[0:2], rates[0:2], q, v, constants)
    _hang(1, constants.lengths[1], 2, gaps[2:4], rates[2:4], q, v, constants)
    _hang(0, constants.lengths[0], 3, gaps[4:6], rates[4:6], q, v, constants)
    place, speed = _centre(q, constants), _centre(v, constants)
    for axis in range(2):
        for i in range(4):
            q[3 * i + axis] += state[CENTRE_X + axis] - place[axis]
            v[3 * i + axis] += state[VELOCITY_X + axis] - speed[axis]


@kernel
def _hang(first: int, first_x: float, second: int, gap: Array, gap_rate: Array, q: Array,
          v: Array, constants: Constants) -> None:
    """Place the second link of a joint by the first and the gap between them."""
    ax, ay = _arm(first, first_x, q, constants)
    bx, by = _arm(second, 0.0, q, constants)
    i, k = 3 * first, 3 * second
    q[k] = q[i] + ax + gap[0] - bx
    q[k + 1] = q[i + 1] + ay + gap[1] - by
    v[k] = v[i] - ay * v[i + 2] + gap_rate[0] + by * v[k + 2]
    v[k + 1] = v[i + 1] + ax * v[i + 2] + gap_rate[1] - bx * v[k + 2]


@kernel
def _from_bodies(state: Array, q: Array, v: Array, constants: Constants) -> None:
    for i in range(4):
        state[i], state[4 + i] = q[3 * i + 2], v[3 * i + 2]
    state[CENTRE_X], state[CENTRE_Y] = _centre(q, constants)
    state[VELOCITY_X], state[VELOCITY_Y] = _centre(v, constants)
    _measure_gap(0, 0.0, 1, q, v, constants, state[20:22], state[26:28])
    _measure_gap(1, constants.lengths[1], 2, q, v, constants, state[22:24], state[28:30])
    _measure_gap(0, constants.lengths[0], 3, q, v, constants, state[24:26], state[30:32])


@kernel
def _measure_gap(first: int, first_x: float, second: int, q: Array, v: Array,
                 constants: Constants, gap: Array, gap_rate: Array) -> None:
    ax, ay = _arm(first, first_x, q, constants)
    bx, by = _arm(second, 0.0, q, constants)
    i, k = 3 * first, 3 * second
    gap[0], gap[1] = q[k] + bx - q[i] - ax, q[k + 1] + by - q[i + 1] - ay
    gap_rate[0] = v[k] - by * v[k + 2] - v[i] + ay * v[i + 2]
    gap_rate[1] = v[k + 1] + bx * v[k + 2] - v[i + 1] - ax * v[i + 2]


@kernel
def body_losses(state: Array, constants: Constants, around: Surroundings
                ) -> tuple[float, float, float]:
    """Evaluate for joints that give what `forces.losses` does for rigid ones."""
    q, v = np.empty(BODIES), np.empty(BODIES)
    to_bodies(state, q, v, constants)
    to_drag = torque = 0.0
    for i in range(4):
        drag, spin_drag, rate = around.link_drag[i], around.link_spin_drag[i], v[3 * i + 2]
        x, y, speed_x, speed_y = q[3 * i], q[3 * i + 1], v[3 * i], v[3 * i + 1]
        to_drag += drag * (speed_x * speed_x + speed_y * speed_y) + spin_drag * rate * rate
        torque -= spin_drag * rate + drag * (
            (x - state[CENTRE_X]) * speed_y - (y - state[CENTRE_Y]) * speed_x)
    rates = (state[4], state[5], state[6], state[7])
    return lost_in_joints(rates, around), to_drag, torque


@kernel
def links_energy_and_spin(state: Array, constants: Constants) -> tuple[float, float]:
    """Return kinetic energy [J] and spin about the mass centre [N m s] of the links."""
    q, v = np.empty(BODIES), np.empty(BODIES)
    to_bodies(state, q, v, constants)
    energy = 0.0
    for i in range(4):
        energy += 0.5 * (
            constants.masses[i] * (v[3 * i] * v[3 * i] + v[3 * i + 1] * v[3 * i + 1])
            + constants.inertias[i] * v[3 * i + 2] * v[3 * i + 2])
    return energy, _spin(q, v, constants)[0]
