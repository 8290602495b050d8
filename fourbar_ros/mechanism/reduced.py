# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The reduced form, paper eq. 6: the equations of motion in (phi_a, phi_b), closure built in.

`A du + b = G Q` with u = (omega_a, omega_b), `A = W^T M W`, `b = W^T (M sigma + h)`, `G = W^T`
and `omega = W u`, `W = [1, 0; 0, 1; Gamma]`; Q are the generalized forces on the four links.

Everything is worked out in the frame of link a, from the cosine and sine of
theta = phi_b - phi_a: c and d follow from the triangle that they form with the diagonal from
joint 2 to joint 4, with no further sine or cosine. The *fold* is `l_c l_d sin(phi_d - phi_c)`. Its
sign is the side of the diagonal on which joint 3 lies, and where it vanishes this form does not
exist.
"""

from __future__ import annotations

from math import atan2, cos, pi, sin, sqrt
from typing import NamedTuple

from fourbar_ros.kernels.compiler import FUSED, kernel
from fourbar_ros.kernels.linear_algebra import Vector4
from fourbar_ros.kernels.runge_kutta import Drive, later_stages_of, weighted_sum
from fourbar_ros.mechanism.change_points import REDUCED_FORM_LIMIT
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.forces import generalized_forces, System
from fourbar_ros.mechanism.state import (
    ANGLE,
    CENTRE_X,
    COMPENSATION_X,
    LINK_MOMENTUM,
    RATE,
    VELOCITY_X,
    VELOCITY_Y,
)
import numpy as np

# Angle up to which four terms of the series of sine and cosine are exact in double [rad].
SMALL_TURN = 0.02

# Largest difference between the summed angular momentum and that of the rates, relative to a turn
# of the whole at these rates: far above rounding, far below any change of the rates from outside.
MOMENTUM_AGREEMENT = 1e-9


class LinkVectors(NamedTuple):
    """
    The links in the frame of link a.

    :ivar cosine, sine: unit vector along link b.
    :ivar cx, cy, dx, dy: vectors along links c and d, of their lengths [m].
    """

    cosine: float
    sine: float
    cx: float
    cy: float
    dx: float
    dy: float


class PairInertias(NamedTuple):
    """
    Entries of the mass matrix M above the diagonal.

    :ivar m_ab, m_ac, m_ad, m_bc, m_bd, m_cd: the entries [kg m^2].
    :ivar n_ab, n_ac, n_ad, n_bc, n_bd, n_cd: their derivatives by the angle of the second link.
    """

    m_ab: float
    m_ac: float
    m_ad: float
    m_bc: float
    m_bd: float
    m_cd: float
    n_ab: float
    n_ac: float
    n_ad: float
    n_bc: float
    n_bd: float
    n_cd: float


class ReducedTerms(NamedTuple):
    """
    The terms of paper eq. 6.

    :ivar a00, a01, a11: A [kg m^2].
    :ivar b0, b1: b [N m].
    :ivar g1, g2, g3, g4: Gamma, `omega_c = g1 omega_a + g2 omega_b`, likewise g3 and g4 for d.
    :ivar sigma_c, sigma_d: the part of the accelerations of c and d that the rates cause
        [rad/s^2].
    """

    a00: float
    a01: float
    a11: float
    b0: float
    b1: float
    g1: float
    g2: float
    g3: float
    g4: float
    sigma_c: float
    sigma_d: float


class ReducedMotion(NamedTuple):
    """
    A motion in the coordinates of the reduced form.

    :ivar angle_a: phi_a, which only the forces from outside depend on [rad].
    :ivar cosine, sine: of theta.
    :ivar side: of the diagonal on which joint 3 lies, 1 or -1.
    :ivar rate_a, rate_b: [rad/s].
    :ivar velocity: of the mass centre, x and y [m/s].
    """

    angle_a: float
    cosine: float
    sine: float
    side: float
    rate_a: float
    rate_b: float
    velocity: tuple[float, float]


class ReducedStage(NamedTuple):
    """
    The derivatives of a motion.

    :ivar rate_a, rate_b: [rad/s].
    :ivar accelerations: of the links [rad/s^2].
    :ivar centre: acceleration of the mass centre, x and y [m/s^2].
    :ivar torque: sum of the torques on the links [N m].
    :ivar momentum: angular momentum of the links about the mass centre [kg m^2/s].
    :ivar fold: its magnitude [m^2].
    """

    rate_a: float
    rate_b: float
    accelerations: Vector4
    centre: tuple[float, float]
    torque: float
    momentum: float
    fold: float


@kernel(fastmath=FUSED)
def turn(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """Return cosine and sine after a further turn by an angle [rad]."""
    if abs(angle) < SMALL_TURN:
        square = angle * angle
        s = angle * (1.0 - square * (1 / 6 - square * (1 / 120 - square * (1 / 5040))))
        less = square * (0.5 - square * (1 / 24 - square * (1 / 720 - square * (1 / 40320))))
        return cosine - (cosine * less + sine * s), sine - (sine * less - cosine * s)
    s, c = sin(angle), cos(angle)
    return cosine * c - sine * s, sine * c + cosine * s


@kernel(fastmath=FUSED)
def close_loop(cosine: float, sine: float, side: float, lengths: Array
               ) -> tuple[LinkVectors, float, float]:
    """
    Evaluate links c and d from theta.

    :param cosine, sine: of theta.
    :param side: of the diagonal on which joint 3 lies, 1 or -1.
    :returns: the links, the fold [m^2] and its inverse; NaN where the loop cannot close.
    """
    l_a, l_b, l_c, l_d = lengths[0], lengths[1], lengths[2], lengths[3]
    # From joint 2 to joint 4; c starts at one, d at the other.
    px, py = l_a - l_b * cosine, -l_b * sine
    square = px * px + py * py
    half = 0.5 * (square + (l_c - l_d) * (l_c + l_d))
    fold_squared = l_c * l_c * square - half * half
    fold = side * sqrt(fold_squared)
    inverse = 1.0 / square
    along, across = half * inverse, fold * inverse
    cx, cy = along * px - across * py, along * py + across * px
    return LinkVectors(cosine, sine, cx, cy, cx - px, cy - py), fold, fold * (1.0 / fold_squared)


@kernel(fastmath=FUSED)
def pair_inertias(links: LinkVectors, constants: Constants) -> PairInertias:
    """Evaluate the entries of M above the diagonal, and their derivatives."""
    p, q = constants.pair_cosine, constants.pair_sine
    cosine, sine, cx, cy, dx, dy = links
    bc_c, bc_s = cx * cosine + cy * sine, cy * cosine - cx * sine
    bd_c, bd_s = dx * cosine + dy * sine, dy * cosine - dx * sine
    cd_c, cd_s = cx * dx + cy * dy, cx * dy - cy * dx
    return PairInertias(
        p[0] * cosine + q[0] * sine, p[1] * cx + q[1] * cy, p[2] * dx + q[2] * dy,
        p[3] * bc_c + q[3] * bc_s, p[4] * bd_c + q[4] * bd_s, p[5] * cd_c + q[5] * cd_s,
        q[0] * cosine - p[0] * sine, q[1] * cx - p[1] * cy, q[2] * dx - p[2] * dy,
        q[3] * bc_c - p[3] * bc_s, q[4] * bd_c - p[4] * bd_s, q[5] * cd_c - p[5] * cd_s)


@kernel(fastmath=FUSED)
def gammas(links: LinkVectors, inverse_fold: float, lengths: Array) -> Vector4:
    """Evaluate Gamma: omega_c = g1 omega_a + g2 omega_b, omega_d = g3 omega_a + g4 omega_b."""
    cosine, sine, cx, cy, dx, dy = links
    a, b = lengths[0] * inverse_fold, -lengths[1] * inverse_fold
    return a * dy, b * (dy * cosine - dx * sine), a * cy, b * (cy * cosine - cx * sine)


@kernel(fastmath=FUSED)
def reduced_terms(links: LinkVectors, inverse_fold: float, rate_a: float, rate_b: float,
                  constants: Constants) -> ReducedTerms:
    """Evaluate A, b and Gamma of paper eq. 6 at the rates of links a and b [rad/s]."""
    lengths = constants.lengths
    l_a, l_b, l_c, l_d = lengths[0], lengths[1], lengths[2], lengths[3]
    g1, g2, g3, g4 = gammas(links, inverse_fold, lengths)
    m_ab, m_ac, m_ad, m_bc, m_bd, m_cd, n_ab, n_ac, n_ad, n_bc, n_bd, n_cd = pair_inertias(
        links, constants)
    m_cc, m_dd = constants.own_inertias[2], constants.own_inertias[3]
    cosine, sine, cx, cy, dx, dy = links

    # Squared rates, and the centripetal part sigma of the dependent accelerations.
    rate_c, rate_d = g1 * rate_a + g2 * rate_b, g3 * rate_a + g4 * rate_b
    qa, qb, qc, qd = rate_a * rate_a, rate_b * rate_b, rate_c * rate_c, rate_d * rate_d
    bc_c, bd_c = cx * cosine + cy * sine, dx * cosine + dy * sine
    cd_c = cx * dx + cy * dy
    sigma_c = (l_b * qb * bd_c + qc * cd_c - l_a * qa * dx - l_d * l_d * qd) * inverse_fold
    sigma_d = (l_b * qb * bc_c + l_c * l_c * qc - l_a * qa * cx - qd * cd_c) * inverse_fold
    # M sigma + h, link by link.
    f_a = n_ab * qb + n_ac * qc + n_ad * qd + m_ac * sigma_c + m_ad * sigma_d
    f_b = -n_ab * qa + n_bc * qc + n_bd * qd + m_bc * sigma_c + m_bd * sigma_d
    f_c = -n_ac * qa - n_bc * qb + n_cd * qd + m_cc * sigma_c + m_cd * sigma_d
    f_d = -n_ad * qa - n_bd * qb - n_cd * qc + m_cd * sigma_c + m_dd * sigma_d

    # Rows c and d of M W.
    ca, cb = m_ac + m_cc * g1 + m_cd * g3, m_bc + m_cc * g2 + m_cd * g4
    da, db = m_ad + m_cd * g1 + m_dd * g3, m_bd + m_cd * g2 + m_dd * g4
    a00 = constants.own_inertias[0] + g1 * (m_ac + ca) + g3 * (m_ad + da)
    a01 = m_ab + g2 * ca + g4 * da + m_bc * g1 + m_bd * g3
    a11 = constants.own_inertias[1] + g2 * (m_bc + cb) + g4 * (m_bd + db)
    return ReducedTerms(
        a00, a01, a11, f_a + g1 * f_c + g3 * f_d, f_b + g2 * f_c + g4 * f_d,
        g1, g2, g3, g4, sigma_c, sigma_d)


@kernel(fastmath=FUSED)
def link_momentum(links: LinkVectors, rates: Vector4, constants: Constants
                  ) -> tuple[float, float]:
    """
    Evaluate the links' angular momentum about the mass centre of the whole.

    :returns: it [kg m^2/s], and the inertia of the whole, which is its derivative by a common rate
        [kg m^2].
    """
    m_ab, m_ac, m_ad, m_bc, m_bd, m_cd, _, _, _, _, _, _ = pair_inertias(links, constants)
    a = constants.own_inertias[0] + m_ab + m_ac + m_ad
    b = constants.own_inertias[1] + m_ab + m_bc + m_bd
    c = constants.own_inertias[2] + m_ac + m_bc + m_cd
    d = constants.own_inertias[3] + m_ad + m_bd + m_cd
    return a * rates[0] + b * rates[1] + c * rates[2] + d * rates[3], a + b + c + d


@kernel(fastmath=FUSED)
def reduced_accelerations(motion: ReducedMotion, torques: Array, system: System) -> ReducedStage:
    """
    Solve the reduced form.

    :param torques: (4,) of the motors on the wheels [N m]; each link feels the opposite.
    """
    constants = system.constants
    cosine, sine, rate_a, rate_b = motion.cosine, motion.sine, motion.rate_a, motion.rate_b
    links, fold, inverse_fold = close_loop(cosine, sine, motion.side, constants.lengths)
    a00, a01, a11, b0, b1, g1, g2, g3, g4, sigma_c, sigma_d = reduced_terms(
        links, inverse_fold, rate_a, rate_b, constants)
    qa, qb, qc, qd = -torques[0], -torques[1], -torques[2], -torques[3]
    force_x = force_y = 0.0
    if system.around.acting:
        ca, sa = cos(motion.angle_a), sin(motion.angle_a)
        l_c, l_d = constants.lengths[2], constants.lengths[3]
        _, _, cx, cy, dx, dy = links
        (ea, eb, ec, ed), (force_x, force_y) = generalized_forces(
            (ca, cosine * ca - sine * sa, (cx * ca - cy * sa) / l_c, (dx * ca - dy * sa) / l_d),
            (sa, sine * ca + cosine * sa, (cy * ca + cx * sa) / l_c, (dy * ca + dx * sa) / l_d),
            (rate_a, rate_b, g1 * rate_a + g2 * rate_b, g3 * rate_a + g4 * rate_b),
            motion.velocity, system)
        qa, qb, qc, qd = qa + ea, qb + eb, qc + ec, qd + ed
    f0 = qa + g1 * qc + g3 * qd - b0
    f1 = qb + g2 * qc + g4 * qd - b1
    inverse = 1.0 / (a00 * a11 - a01 * a01)
    alpha_a, alpha_b = (a11 * f0 - a01 * f1) * inverse, (a00 * f1 - a01 * f0) * inverse
    # A turn of the whole is u = (1, 1), so the angular momentum is (1, 1) A u.
    momentum = (a00 + a01) * rate_a + (a01 + a11) * rate_b
    return ReducedStage(
        rate_a, rate_b,
        (alpha_a, alpha_b, g1 * alpha_a + g2 * alpha_b + sigma_c,
         g3 * alpha_a + g4 * alpha_b + sigma_d),
        (force_x / constants.total_mass, force_y / constants.total_mass), qa + qb + qc + qd,
        momentum, abs(fold))


@kernel(fastmath=FUSED, forceinline=True)
def _stage(number: int, start: ReducedMotion, previous: ReducedStage, time: float, torques: Array,
           system: System) -> ReducedStage:
    """Evaluate a stage of the Runge-Kutta step, see `later_stages_of`."""
    cosine, sine = turn(start.cosine, start.sine, time * (previous.rate_b - previous.rate_a))
    return reduced_accelerations(ReducedMotion(
        start.angle_a + time * previous.rate_a, cosine, sine, start.side,
        start.rate_a + time * previous.accelerations[0],
        start.rate_b + time * previous.accelerations[1],
        (start.velocity[0] + time * previous.centre[0],
         start.velocity[1] + time * previous.centre[1])), torques, system)


_later_stages = later_stages_of(_stage)


@kernel(fastmath=FUSED)
def advance_reduced(state: Array, drive: Drive, step: float, system: System) -> bool:
    """
    Advance links and mass centre by one Runge-Kutta step of order four, in place.

    Angular momentum is kept to rounding: its error in a step is removed by a turn of the whole,
    the least change of the rates in the metric of the mass matrix.

    :param state: (STATE_SIZE,).
    :param step: [s].
    :returns: False where a stage is below `REDUCED_FORM_LIMIT`; then nothing was changed.
    """
    constants = system.constants
    lengths = constants.lengths
    limit = REDUCED_FORM_LIMIT * lengths[2] * lengths[3]
    theta = state[ANGLE + 1] - state[ANGLE]
    motion = ReducedMotion(
        state[ANGLE], cos(theta), sin(theta), side_of_joint_3(state[ANGLE + 2], state[ANGLE + 3]),
        state[RATE], state[RATE + 1], (state[VELOCITY_X], state[VELOCITY_Y]))
    first = reduced_accelerations(motion, drive.start, system)
    if not first.fold > limit:
        return False
    second, third, fourth = _later_stages(motion, first, drive, step, system)

    turned_a = weighted_sum(step, first.rate_a, second.rate_a, third.rate_a, fourth.rate_a)
    turned_b = weighted_sum(step, first.rate_b, second.rate_b, third.rate_b, fourth.rate_b)
    cosine, sine = turn(motion.cosine, motion.sine, turned_b - turned_a)
    links, fold, inverse_fold = close_loop(cosine, sine, motion.side, lengths)
    if not min(second.fold, third.fold, fourth.fold, abs(fold)) > limit:
        return False

    rate_a = motion.rate_a + weighted_sum(
        step, first.accelerations[0], second.accelerations[0], third.accelerations[0],
        fourth.accelerations[0])
    rate_b = motion.rate_b + weighted_sum(
        step, first.accelerations[1], second.accelerations[1], third.accelerations[1],
        fourth.accelerations[1])
    g1, g2, g3, g4 = gammas(links, inverse_fold, lengths)
    rates = (rate_a, rate_b, g1 * rate_a + g2 * rate_b, g3 * rate_a + g4 * rate_b)
    present, inertia = link_momentum(links, rates, constants)
    state[LINK_MOMENTUM] = summed_momentum(state, first.momentum, inertia) + weighted_sum(
        step, first.torque, second.torque, third.torque, fourth.torque)
    missing = (state[LINK_MOMENTUM] - present) / inertia

    move_centre(state, step, first.centre, second.centre, third.centre, fourth.centre)
    state[ANGLE] += turned_a
    state[ANGLE + 1] += turned_b
    _place_followers(state, links)
    for j in range(4):
        state[RATE + j] = rates[j] + missing
    return True


@kernel
def summed_momentum(state: Array, present: float, inertia: float) -> float:
    """
    Return the links' angular momentum as it was summed over the steps.

    :param present: momentum of the rates, with their rounding [kg m^2/s]. It replaces the sum
        where the two differ by more than `MOMENTUM_AGREEMENT`: the rates were set from outside.
    :param inertia: of the whole [kg m^2].
    """
    rates = (abs(state[RATE]) + abs(state[RATE + 1]) + abs(state[RATE + 2])
             + abs(state[RATE + 3]))
    if abs(state[LINK_MOMENTUM] - present) > MOMENTUM_AGREEMENT * inertia * rates:
        return present
    return float(state[LINK_MOMENTUM])


@kernel(forceinline=True)
def move_centre(state: Array, step: float, first: tuple[float, float],
                second: tuple[float, float], third: tuple[float, float],
                fourth: tuple[float, float]) -> None:
    """
    Advance the mass centre, in place.

    :param first, second, third, fourth: its acceleration at the stages, x and y [m/s^2].
    """
    _move_along(0, state, step, first[0], second[0], third[0], fourth[0])
    _move_along(1, state, step, first[1], second[1], third[1], fourth[1])


@kernel(forceinline=True)
def _move_along(axis: int, state: Array, step: float, first: float, second: float, third: float,
                fourth: float) -> None:
    """Advance the mass centre along one axis, with Kahan's compensated sum for its position."""
    mean = step / 6.0 * (first + second + third)
    moved = step * (state[VELOCITY_X + axis] + mean) - state[COMPENSATION_X + axis]
    position = state[CENTRE_X + axis] + moved
    state[COMPENSATION_X + axis] = (position - state[CENTRE_X + axis]) - moved
    state[CENTRE_X + axis] = position
    state[VELOCITY_X + axis] += weighted_sum(step, first, second, third, fourth)


@kernel(fastmath=FUSED)
def close_reduced(state: Array, constants: Constants) -> bool:
    """
    Set angles and rates of links c and d from those of a and b, in place.

    :returns: False where the loop cannot close or is below `REDUCED_FORM_LIMIT`; then nothing was
        changed.
    """
    lengths = constants.lengths
    theta = state[ANGLE + 1] - state[ANGLE]
    links, fold, inverse_fold = close_loop(
        cos(theta), sin(theta), side_of_joint_3(state[ANGLE + 2], state[ANGLE + 3]), lengths)
    if not abs(fold) > REDUCED_FORM_LIMIT * lengths[2] * lengths[3]:
        return False
    g1, g2, g3, g4 = gammas(links, inverse_fold, lengths)
    _place_followers(state, links)
    state[RATE + 2] = g1 * state[RATE] + g2 * state[RATE + 1]
    state[RATE + 3] = g3 * state[RATE] + g4 * state[RATE + 1]
    return True


@kernel
def _place_followers(state: Array, links: LinkVectors) -> None:
    """Set the angles of links c and d, in place, continuous with the previous ones."""
    state[ANGLE + 2] = _nearest_turn(state[ANGLE] + atan2(links.cy, links.cx), state[ANGLE + 2])
    state[ANGLE + 3] = _nearest_turn(state[ANGLE] + atan2(links.dy, links.dx), state[ANGLE + 3])


@kernel
def side_of_joint_3(angle_c: float, angle_d: float) -> float:
    """Return the side of the diagonal on which joint 3 lies, 1 or -1: the sign of the fold."""
    return 1.0 if _nearest_turn(angle_d - angle_c, 0.0) > 0.0 else -1.0


@kernel
def _nearest_turn(angle: float, near: float) -> float:
    """Add whole turns to an angle [rad] until it is nearest to another."""
    return angle + 2.0 * pi * float(np.rint((near - angle) / (2.0 * pi)))
