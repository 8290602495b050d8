# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The constrained form: the equations of motion in all four link angles, for change points.

`M alpha + h = Q + J^T lambda` with `J alpha = sum s_i l_i omega_i^2 e_i`. With `M = L L^T` the two
columns of `L^-1 J^T` are rotated until they are orthogonal: where the links line up one of them,
the *weak* one, vanishes with the constraint that is being lost, and does no harm to the *strong*
one (docs/mechanics.md, change points). Vectors are in the frame of link a.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import NamedTuple

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import (
    cholesky,
    combine,
    dot,
    jacobi_rotation,
    multiply,
    solve_lower,
    solve_upper,
    total,
    Triangle,
    Vector4,
)
from fourbar_ros.kernels.runge_kutta import (
    Drive,
    interpolate,
    later_stages_of,
    weighted_sum,
    weighted_sums,
)
from fourbar_ros.mechanism.change_points import (
    FREE_CONSTRAINT_RATIO,
    LONGEST_PASSAGE,
    WEAK_CONSTRAINT_RATIO,
)
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.forces import generalized_forces, System
from fourbar_ros.mechanism.reduced import (
    link_momentum,
    LinkVectors,
    move_centre,
    pair_inertias,
    summed_momentum,
    turn,
)
from fourbar_ros.mechanism.state import (
    ANGLE,
    angles_of,
    LINK_MOMENTUM,
    RATE,
    rates_of,
    VELOCITY_X,
    VELOCITY_Y,
)
import numpy as np

# A step that is too long for the motion is divided into parts. It is too long where the
# acceleration changes between its two middle stages by more than this, times the step and relative
# to the rates; MOST_PARTS bounds the time of a step.
RESOLUTION = 1e-4
MOST_PARTS = 256


class LinkMotion(NamedTuple):
    """
    A motion of all four links and the mass centre.

    :ivar angle_a: phi_a, which only the forces from outside depend on [rad].
    :ivar cosines, sines: of the link angles less that of link a.
    :ivar rates: of the links [rad/s].
    :ivar velocity: of the mass centre, x and y [m/s].
    """

    angle_a: float
    cosines: Vector4
    sines: Vector4
    rates: Vector4
    velocity: tuple[float, float]


class ConstrainedStage(NamedTuple):
    """
    The derivatives of a motion.

    :ivar rates: of the links [rad/s].
    :ivar accelerations: of the links [rad/s^2].
    :ivar centre: acceleration of the mass centre, x and y [m/s^2].
    :ivar torque: sum of the torques on the links [N m].
    """

    rates: Vector4
    accelerations: Vector4
    centre: tuple[float, float]
    torque: float


@kernel
def directions(angles: Vector4) -> tuple[Vector4, Vector4]:
    """Return cosines and sines of the link angles less that of link a."""
    b, c, d = angles[1] - angles[0], angles[2] - angles[0], angles[3] - angles[0]
    return (1.0, cos(b), cos(c), cos(d)), (0.0, sin(b), sin(c), sin(d))


@kernel
def constrained_accelerations(motion: LinkMotion, torques: Array, system: System, weak_held: bool
                              ) -> ConstrainedStage:
    """
    Solve the constrained form.

    :param torques: (4,) of the motors on the wheels [N m]; each link feels the opposite.
    :param weak_held: False where the weak direction is as free as it is at a change point, for an
        estimator whose angles are too uncertain to tell the side of the change point.
    """
    constants = system.constants
    cosines, sines, rates = motion.cosines, motion.sines, motion.rates
    factor, bias = factored_inertia(cosines, sines, rates, constants)
    forces = (-torques[0], -torques[1], -torques[2], -torques[3])
    on_centre = (0.0, 0.0)
    if system.around.acting:
        ca, sa = cos(motion.angle_a), sin(motion.angle_a)
        effects, on_centre = generalized_forces(
            combine(ca, cosines, -sa, sines), combine(ca, sines, sa, cosines), rates,
            motion.velocity, system)
        forces = combine(1.0, forces, 1.0, effects)
    free = solve_upper(factor, solve_lower(factor, combine(1.0, forces, -1.0, bias)))
    # A turn of the whole changes no derivative of the closure.
    mean = 0.25 * total(rates)
    w = (rates[0] - mean, rates[1] - mean, rates[2] - mean, rates[3] - mean)
    # s_i l_i e_i: J alpha is its sum with the squared rates; J is it, turned by a quarter.
    x, y = signed_links(cosines, sines, constants.lengths)
    square = multiply(w, w)
    need_x, need_y = dot(x, square) + dot(y, free), dot(y, square) - dot(x, free)
    strong, weak, c, s = orthogonal_columns(factor, x, y)
    size, remains = dot(strong, strong), dot(weak, weak)
    need_strong, need_weak = c * need_x + s * need_y, c * need_y - s * need_x
    if weak_held and remains < WEAK_CONSTRAINT_RATIO * WEAK_CONSTRAINT_RATIO * size:
        # Third derivative: J d(alpha)/dt - 3 sum s l e rate alpha - sum s l E e rate^3 = 0.
        cube = multiply(w, square)
        slope_x, slope_y = multiply(x, w), multiply(y, w)
        third_x, third_y = 3.0 * dot(slope_x, free) - dot(y, cube), 3.0 * dot(
            slope_y, free) + dot(x, cube)
        third = solve_lower(factor, combine(-3.0 * c, slope_y, 3.0 * s, slope_x))
        along = dot(third, strong) / size
        third = combine(1.0, third, -along, strong)
        need_third = c * third_y - s * third_x - along * need_strong
        length = sqrt(dot(third, third))
        if length > 0.0:
            time = min(LONGEST_PASSAGE, WEAK_CONSTRAINT_RATIO * sqrt(size) / length)
            # Ahead of the change point the two would cancel without this sign.
            if dot(third, weak) < 0.0:
                time = -time
            weak = combine(1.0, weak, time, third)
            need_weak += time * need_third
            remains = dot(weak, weak)
    constrained = remains > FREE_CONSTRAINT_RATIO * FREE_CONSTRAINT_RATIO * size
    share = need_weak / remains if weak_held and constrained else 0.0
    correction = combine(need_strong / size, strong, share, weak)
    accelerations = combine(1.0, free, 1.0, solve_upper(factor, correction))
    mass = constants.total_mass
    return ConstrainedStage(
        rates, accelerations, (on_centre[0] / mass, on_centre[1] / mass), total(forces))


@kernel(forceinline=True)
def _stage(number: int, start: LinkMotion, previous: ConstrainedStage, time: float,
           torques: Array, held_system: tuple[System, bool]) -> ConstrainedStage:
    """Evaluate a stage of the Runge-Kutta step, see `later_stages_of`."""
    system, weak_held = held_system
    rates = previous.rates
    cb, sb = turn(start.cosines[1], start.sines[1], time * (rates[1] - rates[0]))
    cc, sc = turn(start.cosines[2], start.sines[2], time * (rates[2] - rates[0]))
    cd, sd = turn(start.cosines[3], start.sines[3], time * (rates[3] - rates[0]))
    return constrained_accelerations(LinkMotion(
        start.angle_a + time * rates[0], (1.0, cb, cc, cd), (0.0, sb, sc, sd),
        combine(1.0, start.rates, time, previous.accelerations),
        (start.velocity[0] + time * previous.centre[0],
         start.velocity[1] + time * previous.centre[1])), torques, system, weak_held)


_later_stages = later_stages_of(_stage)


@kernel
def advance_constrained(state: Array, drive: Drive, step: float, system: System, weak_held: bool
                        ) -> None:
    """
    Advance links and mass centre by one Runge-Kutta step of order four, in place.

    Where lengths that almost match let the links turn over faster than the step can follow, it is
    divided. Parameters as of `advance_reduced` and `constrained_accelerations`.
    """
    if _advance_once(state, drive, step, system, weak_held, False):
        return
    parts, before = 2, state.copy()
    while not _advance_in_parts(state, drive, step, parts, system, weak_held):
        state[:] = before
        parts *= 2


@kernel
def _advance_in_parts(state: Array, drive: Drive, step: float, parts: int, system: System,
                      weak_held: bool) -> bool:
    """Return whether the number of parts resolves the motion."""
    torques = np.empty((3, 4))
    for part in range(parts):
        for stage in range(3):
            interpolate(drive, (part + 0.5 * stage) / parts, torques[stage])
        if not _advance_once(state, Drive(torques[0], torques[1], torques[2]), step / parts,
                             system, weak_held, parts >= MOST_PARTS):
            return False
    return True


@kernel
def _advance_once(state: Array, drive: Drive, step: float, system: System, weak_held: bool,
                  unresolved: bool) -> bool:
    """
    Take one step, then restore the closure, and angular momentum as in `advance_reduced`.

    :param unresolved: take the step even if it is too long to follow the motion.
    :returns: whether the step was taken; otherwise nothing was changed.
    """
    angles, rates, constants = angles_of(state), rates_of(state), system.constants
    cosines, sines = directions(angles)
    motion = LinkMotion(
        angles[0], cosines, sines, rates, (state[VELOCITY_X], state[VELOCITY_Y]))
    first = constrained_accelerations(motion, drive.start, system, weak_held)
    second, third, fourth = _later_stages(
        motion, first, drive, step, (system, weak_held))

    before, _ = _momentum(cosines, sines, rates, constants)
    angles = combine(1.0, angles, 1.0, weighted_sums(
        step, first.rates, second.rates, third.rates, fourth.rates))
    rates = combine(1.0, rates, 1.0, weighted_sums(
        step, first.accelerations, second.accelerations, third.accelerations,
        fourth.accelerations))
    angles, rates = project_onto_closure(angles, rates, constants, weak_held)
    change = combine(1.0, third.accelerations, -1.0, second.accelerations)
    resolved = step * sqrt(dot(change, change)) <= RESOLUTION * sqrt(dot(rates, rates))
    if not (resolved or unresolved):
        return False
    cosines, sines = directions(angles)
    present, inertia = _momentum(cosines, sines, rates, constants)
    state[LINK_MOMENTUM] = summed_momentum(state, before, inertia) + weighted_sum(
        step, first.torque, second.torque, third.torque, fourth.torque)
    missing = (state[LINK_MOMENTUM] - present) / inertia
    for j in range(4):
        state[ANGLE + j] = angles[j]
        state[RATE + j] = rates[j] + missing
    move_centre(state, step, first.centre, second.centre, third.centre, fourth.centre)
    return True


@kernel
def project_onto_closure(angles: Vector4, rates: Vector4, constants: Constants, weak_held: bool
                         ) -> tuple[Vector4, Vector4]:
    """
    Remove the closure error from angles and rates.

    With the mass matrix as metric, that is, by an impulse in the joints, so that momentum stays;
    except for the direction in which the constraint is being lost.

    :param angles: of the links, close to the closure [rad].
    :param rates: of the links [rad/s].
    :param weak_held: as of :func:`constrained_accelerations`.
    :returns: both.
    """
    cosines, sines = directions(angles)
    factor, _ = factored_inertia(cosines, sines, rates, constants)
    x, y = signed_links(cosines, sines, constants.lengths)
    strong, weak, c, s = orthogonal_columns(factor, x, y)
    size, remains = dot(strong, strong), dot(weak, weak)
    held = weak_held and remains > WEAK_CONSTRAINT_RATIO * WEAK_CONSTRAINT_RATIO * size
    # J = (-y; x): the gap is (sum x, sum y) and opens at (-y . rates, x . rates).
    gap_x, gap_y = total(x), total(y)
    slip_x, slip_y = -dot(y, rates), dot(x, rates)
    closing = combine(-(c * gap_x + s * gap_y) / size, strong,
                      -(c * gap_y - s * gap_x) / remains if held else 0.0, weak)
    stopping = combine(-(c * slip_x + s * slip_y) / size, strong,
                       -(c * slip_y - s * slip_x) / remains if held else 0.0, weak)
    return (combine(1.0, angles, 1.0, solve_upper(factor, closing)),
            combine(1.0, rates, 1.0, solve_upper(factor, stopping)))


@kernel
def rates_of_impulse(angles: Vector4, impulse: Vector4, constants: Constants) -> Vector4:
    """
    Return how an impulse changes the rates of the links, the loop staying closed [rad/s].

    :param impulse: generalized, on the link angles [N m s].
    """
    cosines, sines = directions(angles)
    factor, _ = factored_inertia(cosines, sines, impulse, constants)
    free = solve_upper(factor, solve_lower(factor, impulse))
    return project_onto_closure(angles, free, constants, True)[1]


@kernel
def _momentum(cosines: Vector4, sines: Vector4, rates: Vector4, constants: Constants
              ) -> tuple[float, float]:
    return link_momentum(_vectors(cosines, sines, constants), rates, constants)


@kernel
def _vectors(cosines: Vector4, sines: Vector4, constants: Constants) -> LinkVectors:
    l_c, l_d = constants.lengths[2], constants.lengths[3]
    return LinkVectors(cosines[1], sines[1], l_c * cosines[2], l_c * sines[2],
                       l_d * cosines[3], l_d * sines[3])


@kernel
def signed_links(cosines: Vector4, sines: Vector4, lengths: Array) -> tuple[Vector4, Vector4]:
    """Return x and y of the links [m], with their signs in the closure."""
    signed = (-lengths[0], lengths[1], lengths[2], -lengths[3])
    return multiply(signed, cosines), multiply(signed, sines)


@kernel
def factored_inertia(cosines: Vector4, sines: Vector4, rates: Vector4, constants: Constants
                     ) -> tuple[Triangle, Vector4]:
    """Factor M into L L^T, and evaluate the bias h."""
    m_ab, m_ac, m_ad, m_bc, m_bd, m_cd, n_ab, n_ac, n_ad, n_bc, n_bd, n_cd = pair_inertias(
        _vectors(cosines, sines, constants), constants)
    qa, qb, qc, qd = multiply(rates, rates)
    bias = (n_ab * qb + n_ac * qc + n_ad * qd, -n_ab * qa + n_bc * qc + n_bd * qd,
            -n_ac * qa - n_bc * qb + n_cd * qd, -n_ad * qa - n_bd * qb - n_cd * qc)
    own = constants.own_inertias
    return cholesky((own[0], own[1], own[2], own[3]), m_ab, m_ac, m_ad, m_bc, m_bd, m_cd), bias


@kernel
def orthogonal_columns(factor: Triangle, x: Vector4, y: Vector4
                       ) -> tuple[Vector4, Vector4, float, float]:
    """
    Rotate the columns of `L^-1 J^T` into orthogonal ones, the larger one first.

    :param x, y: the links with their signs [m]; J = (-y; x).
    :returns: the columns, and cosine and sine of the rotation.
    """
    first = solve_lower(factor, (-y[0], -y[1], -y[2], -y[3]))
    second = solve_lower(factor, x)
    return jacobi_rotation(first, second)
