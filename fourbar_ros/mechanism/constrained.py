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

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import (
    cholesky,
    combine,
    dot,
    jacobi_rotation,
    multiply,
    solve_lower,
    solve_upper,
    Triangle,
    Vector4,
)
from fourbar_ros.mechanism.change_points import (
    FREE_CONSTRAINT_RATIO,
    LONGEST_PASSAGE,
    WEAK_CONSTRAINT_RATIO,
)
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.forces import generalized_forces, Surroundings
from fourbar_ros.mechanism.reduced import (
    move_centre,
    pair_inertias,
    remembered_spin,
    spin,
    turn,
)
from fourbar_ros.mechanism.state import SPIN, VELOCITY_X, VELOCITY_Y
import numpy as np

# Largest change of the acceleration between the two middle stages of a step, times the step and
# relative to the rates; and the largest number of parts that a step is divided into to keep it.
RESOLUTION = 1e-4
MOST_PARTS = 256


@kernel
def directions(angles: Vector4) -> tuple[Vector4, Vector4]:
    """Return cosines and sines of the link angles less that of link a."""
    b, c, d = angles[1] - angles[0], angles[2] - angles[0], angles[3] - angles[0]
    return (1.0, cos(b), cos(c), cos(d)), (0.0, sin(b), sin(c), sin(d))


@kernel
def constrained_accelerations(
    angle_a: float, cosines: Vector4, sines: Vector4, rates: Vector4,
    velocity: tuple[float, float], torques: Array, constants: Constants, around: Surroundings,
    weak_held: bool,
) -> tuple[Vector4, tuple[float, float], float]:
    """
    Solve the constrained form.

    :param angle_a: phi_a, of which only the surroundings know [rad].
    :param cosines, sines: of the link angles less that of link a.
    :param rates: of the links [rad/s].
    :param velocity: of the mass centre [m/s].
    :param torques: (4,) of the motors on the wheels [N m]; each link feels the opposite.
    :param weak_held: False where the weak direction is as free as it is at a change point; for
        who does not know the angles well enough to tell which way the linkage is off it.
    :returns: accelerations of the links [rad/s^2] and of the mass centre [m/s^2], and the sum of
        the torques on the links [N m].
    """
    factor, bias = factored_inertia(cosines, sines, rates, constants)
    forces = (-torques[0], -torques[1], -torques[2], -torques[3])
    push = (0.0, 0.0)
    if around.acting:
        ca, sa = cos(angle_a), sin(angle_a)
        effects, push = generalized_forces(
            combine(ca, cosines, -sa, sines), combine(ca, sines, sa, cosines), rates, velocity,
            constants, around)
        forces = combine(1.0, forces, 1.0, effects)
    total = forces[0] + forces[1] + forces[2] + forces[3]
    free = solve_upper(factor, solve_lower(factor, combine(1.0, forces, -1.0, bias)))
    # A turn of the whole changes no derivative of the closure.
    mean = 0.25 * (rates[0] + rates[1] + rates[2] + rates[3])
    w = (rates[0] - mean, rates[1] - mean, rates[2] - mean, rates[3] - mean)
    # s_i l_i e_i: J alpha is the sum of it times rate^2; J is it, turned by a quarter.
    x, y = signed_links(cosines, sines, constants.lengths)
    square = multiply(w, w)
    need_x, need_y = dot(x, square) + dot(y, free), dot(y, square) - dot(x, free)
    strong, weak, c, s = orthogonal_columns(factor, x, y)
    size, remains = dot(strong, strong), dot(weak, weak)
    need_strong, need_weak = c * need_x + s * need_y, c * need_y - s * need_x
    if weak_held and remains < WEAK_CONSTRAINT_RATIO * WEAK_CONSTRAINT_RATIO * size:
        # Third derivative: J d(alpha)/dt - 3 sum s l e rate alpha - sum s l E e rate^3 = 0.
        cube = multiply(w, square)
        pull_x, pull_y = multiply(x, w), multiply(y, w)
        third_x, third_y = 3.0 * dot(pull_x, free) - dot(y, cube), 3.0 * dot(
            pull_y, free) + dot(x, cube)
        third = solve_lower(factor, combine(-3.0 * c, pull_y, 3.0 * s, pull_x))
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
    return accelerations, (push[0] / mass, push[1] / mass), total


@kernel
def advance_constrained(state: Array, start: Array, middle: Array, end: Array, step: float,
                        constants: Constants, around: Surroundings, weak_held: bool
                        ) -> None:
    """
    Advance links and mass centre by one Runge-Kutta step of order four, in place.

    Where lengths that almost match let the links turn over faster than the step can follow, it is
    divided. Parameters as of `advance_reduced` and `constrained_accelerations`.
    """
    if _advance_once(state, start, middle, end, step, False, constants, around, weak_held):
        return
    parts, before = 2, state.copy()
    while not _advance_in_parts(state, start, middle, end, step, parts, constants, around,
                                weak_held):
        state[:] = before
        parts *= 2


@kernel
def _advance_in_parts(state: Array, start: Array, middle: Array, end: Array, step: float,
                      parts: int, constants: Constants, around: Surroundings, weak_held: bool
                      ) -> bool:
    """Tell whether that many parts were enough."""
    torques = np.empty((3, 4))
    for part in range(parts):
        for stage in range(3):
            interpolate(start, middle, end, (part + 0.5 * stage) / parts, torques[stage])
        if not _advance_once(state, torques[0], torques[1], torques[2], step / parts,
                             parts >= MOST_PARTS, constants, around, weak_held):
            return False
    return True


@kernel
def interpolate(start: Array, middle: Array, end: Array, part: float, out: Array) -> None:
    """Put a parabola through what drives the wheels in a step, at a part of it (0 to 1)."""
    for j in range(4):
        out[j] = (start[j] * (1.0 - part) * (1.0 - 2.0 * part) + middle[j] * 4.0 * part * (
            1.0 - part) + end[j] * part * (2.0 * part - 1.0))


@kernel
def _advance_once(state: Array, start: Array, middle: Array, end: Array, step: float,
                  at_any_length: bool, constants: Constants, around: Surroundings,
                  weak_held: bool) -> bool:
    """
    Take one step, then meet the closure again, and angular momentum as in `advance_reduced`.

    :param at_any_length: take the step even if it is too long to follow the motion.
    :returns: whether it was taken; otherwise nothing was changed.
    """
    a0, b0, c0, d0 = state[0], state[1], state[2], state[3]
    angles, rates = (a0, b0, c0, d0), (state[4], state[5], state[6], state[7])
    velocity = (state[VELOCITY_X], state[VELOCITY_Y])
    half, sixth = 0.5 * step, step / 6.0
    cosines, sines = directions(angles)
    alpha1, pull1, sum1 = constrained_accelerations(
        a0, cosines, sines, rates, velocity, start, constants, around, weak_held)
    rates2 = combine(1.0, rates, half, alpha1)
    cosines2, sines2 = _turned(cosines, sines, rates, half)
    alpha2, pull2, sum2 = constrained_accelerations(
        a0 + half * rates[0], cosines2, sines2, rates2,
        (velocity[0] + half * pull1[0], velocity[1] + half * pull1[1]), middle, constants, around,
        weak_held)
    rates3 = combine(1.0, rates, half, alpha2)
    cosines3, sines3 = _turned(cosines, sines, rates2, half)
    alpha3, pull3, sum3 = constrained_accelerations(
        a0 + half * rates2[0], cosines3, sines3, rates3,
        (velocity[0] + half * pull2[0], velocity[1] + half * pull2[1]), middle, constants, around,
        weak_held)
    rates4 = combine(1.0, rates, step, alpha3)
    cosines4, sines4 = _turned(cosines, sines, rates3, step)
    alpha4, pull4, sum4 = constrained_accelerations(
        a0 + step * rates3[0], cosines4, sines4, rates4,
        (velocity[0] + step * pull3[0], velocity[1] + step * pull3[1]), end, constants, around,
        weak_held)

    mean_rates = _weighted_mean(rates, rates2, rates3, rates4)
    before, _ = _spin(cosines, sines, rates, constants)
    angles = combine(1.0, angles, step, mean_rates)
    rates = combine(1.0, rates, step, _weighted_mean(alpha1, alpha2, alpha3, alpha4))
    angles, rates = project_onto_closure(angles, rates, constants, weak_held)
    change = combine(1.0, alpha3, -1.0, alpha2)
    followed = step * sqrt(dot(change, change)) <= RESOLUTION * sqrt(dot(rates, rates))
    if not (followed or at_any_length):
        return False
    cosines, sines = directions(angles)
    after, inertia = _spin(cosines, sines, rates, constants)
    before = remembered_spin(state, before, inertia)
    state[SPIN] = before + sixth * (sum1 + 2.0 * (sum2 + sum3) + sum4)
    missing = (state[SPIN] - after) / inertia
    for j in range(4):
        state[j] = angles[j]
        state[4 + j] = rates[j] + missing
    move_centre(state, step, velocity[0], velocity[1],
                sixth * (pull1[0] + pull2[0] + pull3[0]), sixth * (pull1[1] + pull2[1] + pull3[1]),
                sixth * (pull1[0] + 2.0 * (pull2[0] + pull3[0]) + pull4[0]),
                sixth * (pull1[1] + 2.0 * (pull2[1] + pull3[1]) + pull4[1]))
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
    gap_x, gap_y = x[0] + x[1] + x[2] + x[3], y[0] + y[1] + y[2] + y[3]
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
def _turned(cosines: Vector4, sines: Vector4, rates: Vector4, time: float
            ) -> tuple[Vector4, Vector4]:
    """Turn the directions on, at rates [rad/s] for a time [s]."""
    cb, sb = turn(cosines[1], sines[1], time * (rates[1] - rates[0]))
    cc, sc = turn(cosines[2], sines[2], time * (rates[2] - rates[0]))
    cd, sd = turn(cosines[3], sines[3], time * (rates[3] - rates[0]))
    return (1.0, cb, cc, cd), (0.0, sb, sc, sd)


@kernel
def _weighted_mean(first: Vector4, second: Vector4, third: Vector4, fourth: Vector4) -> Vector4:
    """Return the Runge-Kutta mean of order four."""
    return combine(1 / 6, combine(1.0, first, 1.0, fourth), 1 / 3, combine(
        1.0, second, 1.0, third))


@kernel
def _spin(cosines: Vector4, sines: Vector4, rates: Vector4, constants: Constants
          ) -> tuple[float, float]:
    l_c, l_d = constants.lengths[2], constants.lengths[3]
    return spin(cosines[1], sines[1], l_c * cosines[2], l_c * sines[2], l_d * cosines[3],
                l_d * sines[3], rates[0], rates[1], rates[2], rates[3], constants)


@kernel
def signed_links(cosines: Vector4, sines: Vector4, lengths: Array) -> tuple[Vector4, Vector4]:
    """Return x and y of the links [m], with their signs in the closure."""
    signed = (-lengths[0], lengths[1], lengths[2], -lengths[3])
    return multiply(signed, cosines), multiply(signed, sines)


@kernel
def factored_inertia(cosines: Vector4, sines: Vector4, rates: Vector4, constants: Constants
             ) -> tuple[Triangle, Vector4]:
    """Factor M into L L^T, and evaluate the bias h."""
    l_c, l_d = constants.lengths[2], constants.lengths[3]
    m_ab, m_ac, m_ad, m_bc, m_bd, m_cd, n_ab, n_ac, n_ad, n_bc, n_bd, n_cd = pair_inertias(
        cosines[1], sines[1], l_c * cosines[2], l_c * sines[2], l_d * cosines[3],
        l_d * sines[3], constants)
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
