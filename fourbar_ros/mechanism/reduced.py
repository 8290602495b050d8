# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The reduced form, paper eq. 6: the equations of motion in (phi_a, phi_b), closure built in.

`A du + b = G Q` with u = (omega_a, omega_b), `A = W^T M W`, `b = W^T (M sigma + h)`, `G = W^T`
and `omega = W u`, `W = [1, 0; 0, 1; Gamma]`; Q are the generalized forces on the four links.

Everything is worked out in the frame of link a, from the cosine and sine of
theta = phi_b - phi_a: c and d follow from the triangle that they form with the diagonal from
joint 2 to joint 4, with no further sine or cosine. A *fold* is
`l_c l_d sin(phi_d - phi_c)`; its sign is the side of the diagonal on which joint 3 lies, and where
it vanishes this form does not exist.
"""

from __future__ import annotations

from math import atan2, cos, pi, sin, sqrt

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.change_points import REDUCED_FORM_LIMIT
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.forces import generalized_forces, Surroundings
from fourbar_ros.mechanism.state import (
    CENTRE_X,
    CENTRE_Y,
    REST_X,
    REST_Y,
    SPIN,
    VELOCITY_X,
    VELOCITY_Y,
)
import numpy as np

# Up to this angle [rad] the first four terms of the series of sine and cosine are exact.
SMALL_TURN = 0.02

# How far the momentum that was added up may be from that of the rates, relative to a turn of the
# whole at these rates: far above rounding, far below what anybody would change on purpose.
SPIN_FITS = 1e-9

# A fused product and sum is rounded once instead of twice.
_FUSED = {'contract'}


@kernel(fastmath=_FUSED)
def turn(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """Return cosine and sine after a further turn by an angle [rad]."""
    if abs(angle) < SMALL_TURN:
        square = angle * angle
        s = angle * (1.0 - square * (1 / 6 - square * (1 / 120 - square * (1 / 5040))))
        less = square * (0.5 - square * (1 / 24 - square * (1 / 720 - square * (1 / 40320))))
        return cosine - (cosine * less + sine * s), sine - (sine * less - cosine * s)
    s, c = sin(angle), cos(angle)
    return cosine * c - sine * s, sine * c + cosine * s


@kernel(fastmath=_FUSED)
def close_loop(cosine: float, sine: float, side: float, lengths: Array
               ) -> tuple[float, float, float, float, float, float]:
    """
    Work out links c and d from theta.

    :param cosine, sine: of theta.
    :param side: of the diagonal on which joint 3 lies, 1 or -1.
    :returns: vectors along c and d, of their lengths, in the frame of link a: c_x, c_y, d_x, d_y
        [m]; the fold [m^2] and its inverse. Not numbers where the loop cannot close.
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
    return cx, cy, cx - px, cy - py, fold, fold * (1.0 / fold_squared)


@kernel(fastmath=_FUSED)
def pair_inertias(
    cosine: float, sine: float, cx: float, cy: float, dx: float, dy: float, constants: Constants,
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float]:
    """
    Evaluate the entries of M above the diagonal, and their derivatives.

    :param cosine, sine, cx, cy, dx, dy: vectors along b (unit) and c and d (of their lengths).
    :returns: M_ab, M_ac, M_ad, M_bc, M_bd, M_cd [kg m^2], then of each its derivative after the
        angle of its second link.
    """
    p, q = constants.pair_cosine, constants.pair_sine
    bc_c, bc_s = cx * cosine + cy * sine, cy * cosine - cx * sine
    bd_c, bd_s = dx * cosine + dy * sine, dy * cosine - dx * sine
    cd_c, cd_s = cx * dx + cy * dy, cx * dy - cy * dx
    return (p[0] * cosine + q[0] * sine, p[1] * cx + q[1] * cy, p[2] * dx + q[2] * dy,
            p[3] * bc_c + q[3] * bc_s, p[4] * bd_c + q[4] * bd_s, p[5] * cd_c + q[5] * cd_s,
            q[0] * cosine - p[0] * sine, q[1] * cx - p[1] * cy, q[2] * dx - p[2] * dy,
            q[3] * bc_c - p[3] * bc_s, q[4] * bd_c - p[4] * bd_s, q[5] * cd_c - p[5] * cd_s)


@kernel(fastmath=_FUSED)
def gammas(cosine: float, sine: float, cx: float, cy: float, dx: float, dy: float,
           inverse_fold: float, lengths: Array) -> tuple[float, float, float, float]:
    """Evaluate Gamma: omega_c = g1 omega_a + g2 omega_b, omega_d = g3 omega_a + g4 omega_b."""
    a, b = lengths[0] * inverse_fold, -lengths[1] * inverse_fold
    return (a * dy, b * (dy * cosine - dx * sine), a * cy, b * (cy * cosine - cx * sine))


@kernel(fastmath=_FUSED)
def reduced_terms(
    cosine: float, sine: float, cx: float, cy: float, dx: float, dy: float, inverse_fold: float,
    rate_a: float, rate_b: float, constants: Constants,
) -> tuple[float, float, float, float, float, float, float, float, float, float, float]:
    """
    Evaluate A, b and Gamma of paper eq. 6.

    :returns: A00, A01, A11, b0, b1, Gamma_1, Gamma_2, Gamma_3, Gamma_4, and what the rates alone
        give the accelerations of c and d: sigma_c, sigma_d.
    """
    lengths = constants.lengths
    l_a, l_b, l_c, l_d = lengths[0], lengths[1], lengths[2], lengths[3]
    g1, g2, g3, g4 = gammas(cosine, sine, cx, cy, dx, dy, inverse_fold, lengths)
    m_ab, m_ac, m_ad, m_bc, m_bd, m_cd, n_ab, n_ac, n_ad, n_bc, n_bd, n_cd = pair_inertias(
        cosine, sine, cx, cy, dx, dy, constants)
    m_cc, m_dd = constants.own_inertias[2], constants.own_inertias[3]

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
    return (a00, a01, a11, f_a + g1 * f_c + g3 * f_d, f_b + g2 * f_c + g4 * f_d,
            g1, g2, g3, g4, sigma_c, sigma_d)


@kernel(fastmath=_FUSED)
def spin(
    cosine: float, sine: float, cx: float, cy: float, dx: float, dy: float,
    rate_a: float, rate_b: float, rate_c: float, rate_d: float, constants: Constants,
) -> tuple[float, float]:
    """
    Sum up the links' angular momentum about the mass centre of the whole.

    :returns: it [kg m^2/s], and what one rad/s of all four adds to it [kg m^2].
    """
    m_ab, m_ac, m_ad, m_bc, m_bd, m_cd, _, _, _, _, _, _ = pair_inertias(
        cosine, sine, cx, cy, dx, dy, constants)
    a = constants.own_inertias[0] + m_ab + m_ac + m_ad
    b = constants.own_inertias[1] + m_ab + m_bc + m_bd
    c = constants.own_inertias[2] + m_ac + m_bc + m_cd
    d = constants.own_inertias[3] + m_ad + m_bd + m_cd
    return a * rate_a + b * rate_b + c * rate_c + d * rate_d, a + b + c + d


@kernel(fastmath=_FUSED)
def reduced_accelerations(
    angle_a: float, cosine: float, sine: float, side: float, rate_a: float, rate_b: float,
    velocity_x: float, velocity_y: float, torques: Array, constants: Constants,
    around: Surroundings,
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """
    Solve the reduced form.

    :param angle_a: phi_a, of which only the surroundings know [rad].
    :param cosine, sine: of theta.
    :param velocity_x, velocity_y: of the mass centre [m/s].
    :param torques: (4,) of the motors on the wheels [N m]; each link feels the opposite.
    :returns: accelerations of the links [rad/s^2] and of the mass centre in x and y [m/s^2], the
        sum of the torques on the links [N m], their angular momentum about the mass centre
        [kg m^2/s], and the size of the fold [m^2].
    """
    cx, cy, dx, dy, fold, inverse_fold = close_loop(cosine, sine, side, constants.lengths)
    a00, a01, a11, b0, b1, g1, g2, g3, g4, sigma_c, sigma_d = reduced_terms(
        cosine, sine, cx, cy, dx, dy, inverse_fold, rate_a, rate_b, constants)
    qa, qb, qc, qd = -torques[0], -torques[1], -torques[2], -torques[3]
    push_x = push_y = 0.0
    if around.acting:
        ca, sa = cos(angle_a), sin(angle_a)
        l_c, l_d = constants.lengths[2], constants.lengths[3]
        (ea, eb, ec, ed), (push_x, push_y) = generalized_forces(
            (ca, cosine * ca - sine * sa, (cx * ca - cy * sa) / l_c, (dx * ca - dy * sa) / l_d),
            (sa, sine * ca + cosine * sa, (cy * ca + cx * sa) / l_c, (dy * ca + dx * sa) / l_d),
            (rate_a, rate_b, g1 * rate_a + g2 * rate_b, g3 * rate_a + g4 * rate_b),
            (velocity_x, velocity_y), constants, around)
        qa, qb, qc, qd = qa + ea, qb + eb, qc + ec, qd + ed
    f0 = qa + g1 * qc + g3 * qd - b0
    f1 = qb + g2 * qc + g4 * qd - b1
    inverse = 1.0 / (a00 * a11 - a01 * a01)
    alpha_a, alpha_b = (a11 * f0 - a01 * f1) * inverse, (a00 * f1 - a01 * f0) * inverse
    # A turn of the whole is u = (1, 1), so the angular momentum is (1, 1) A u.
    momentum = (a00 + a01) * rate_a + (a01 + a11) * rate_b
    return (alpha_a, alpha_b, g1 * alpha_a + g2 * alpha_b + sigma_c,
            g3 * alpha_a + g4 * alpha_b + sigma_d, push_x / constants.total_mass,
            push_y / constants.total_mass, qa + qb + qc + qd, momentum, abs(fold))


@kernel(fastmath=_FUSED)
def advance_reduced(state: Array, start: Array, middle: Array, end: Array, step: float,
                    constants: Constants, around: Surroundings) -> bool:
    """
    Advance links and mass centre by one Runge-Kutta step of order four, in place.

    Angular momentum is kept to rounding: what the step misses of it is made up by a turn of the
    whole, the least change of the rates in the metric of the mass matrix.

    :param state: see mechanism.layout.
    :param start, middle, end: (4,) motor torques at the begin, middle and end of the step [N m].
    :returns: False where the step comes near alignment; then nothing was changed.
    """
    lengths = constants.lengths
    limit = REDUCED_FORM_LIMIT * lengths[2] * lengths[3]
    angle_a, angle_b, rate_a, rate_b = state[0], state[1], state[4], state[5]
    vx, vy = state[VELOCITY_X], state[VELOCITY_Y]
    theta = angle_b - angle_a
    c, s = cos(theta), sin(theta)
    side = side_of_joint_3(state[2], state[3])
    half, sixth = 0.5 * step, step / 6.0

    a1, b1, _, _, x1, y1, sum1, before, fold = reduced_accelerations(
        angle_a, c, s, side, rate_a, rate_b, vx, vy, start, constants, around)
    if not fold > limit:
        return False
    rate_a2, rate_b2 = rate_a + half * a1, rate_b + half * b1
    c2, s2 = turn(c, s, half * (rate_b - rate_a))
    a2, b2, _, _, x2, y2, sum2, _, fold2 = reduced_accelerations(
        angle_a + half * rate_a, c2, s2, side, rate_a2, rate_b2,
        vx + half * x1, vy + half * y1, middle, constants, around)
    rate_a3, rate_b3 = rate_a + half * a2, rate_b + half * b2
    c3, s3 = turn(c, s, half * (rate_b2 - rate_a2))
    a3, b3, _, _, x3, y3, sum3, _, fold3 = reduced_accelerations(
        angle_a + half * rate_a2, c3, s3, side, rate_a3, rate_b3,
        vx + half * x2, vy + half * y2, middle, constants, around)
    rate_a4, rate_b4 = rate_a + step * a3, rate_b + step * b3
    c4, s4 = turn(c, s, step * (rate_b3 - rate_a3))
    a4, b4, _, _, x4, y4, sum4, _, fold4 = reduced_accelerations(
        angle_a + step * rate_a3, c4, s4, side, rate_a4, rate_b4,
        vx + step * x3, vy + step * y3, end, constants, around)

    turned_a = sixth * (rate_a + 2.0 * (rate_a2 + rate_a3) + rate_a4)
    turned_b = sixth * (rate_b + 2.0 * (rate_b2 + rate_b3) + rate_b4)
    end_c, end_s = turn(c, s, turned_b - turned_a)
    cx, cy, dx, dy, last_fold, inverse_fold = close_loop(end_c, end_s, side, lengths)
    if not min(fold2, fold3, fold4, abs(last_fold)) > limit:
        return False

    rate_a += sixth * (a1 + 2.0 * (a2 + a3) + a4)
    rate_b += sixth * (b1 + 2.0 * (b2 + b3) + b4)
    g1, g2, g3, g4 = gammas(end_c, end_s, cx, cy, dx, dy, inverse_fold, lengths)
    rate_c, rate_d = g1 * rate_a + g2 * rate_b, g3 * rate_a + g4 * rate_b
    after, inertia = spin(end_c, end_s, cx, cy, dx, dy, rate_a, rate_b, rate_c, rate_d, constants)
    before = remembered_spin(state, before, inertia)
    state[SPIN] = before + sixth * (sum1 + 2.0 * (sum2 + sum3) + sum4)
    missing = (state[SPIN] - after) / inertia

    move_centre(state, step, vx, vy, sixth * (x1 + x2 + x3), sixth * (y1 + y2 + y3),
                sixth * (x1 + 2.0 * (x2 + x3) + x4), sixth * (y1 + 2.0 * (y2 + y3) + y4))
    angle_a += turned_a
    state[0], state[1] = angle_a, angle_b + turned_b
    state[2] = _nearest_turn(angle_a + atan2(cy, cx), state[2])
    state[3] = _nearest_turn(angle_a + atan2(dy, dx), state[3])
    state[4], state[5] = rate_a + missing, rate_b + missing
    state[6], state[7] = rate_c + missing, rate_d + missing
    return True


@kernel
def remembered_spin(state: Array, present: float, inertia: float) -> float:
    """
    Return the links' angular momentum as it was added up over the steps.

    :param present: as the rates have it, with their rounding [kg m^2/s].
    :param inertia: of the whole [kg m^2].
    """
    rates = abs(state[4]) + abs(state[5]) + abs(state[6]) + abs(state[7])
    if abs(state[SPIN] - present) > SPIN_FITS * inertia * rates:
        return present      # somebody has set the rates
    return float(state[SPIN])


@kernel
def move_centre(state: Array, step: float, vx: float, vy: float, mean_x: float, mean_y: float,
                gain_x: float, gain_y: float) -> None:
    """
    Move the mass centre on, in place, without losing what a large sum rounds off (Kahan).

    :param mean_x, mean_y: mean of what its velocity vx, vy gains during the step [m/s].
    :param gain_x, gain_y: what it has gained at the end [m/s].
    """
    way_x, way_y = step * (vx + mean_x) - state[REST_X], step * (vy + mean_y) - state[REST_Y]
    x, y = state[CENTRE_X] + way_x, state[CENTRE_Y] + way_y
    state[REST_X], state[REST_Y] = (x - state[CENTRE_X]) - way_x, (y - state[CENTRE_Y]) - way_y
    state[CENTRE_X], state[CENTRE_Y] = x, y
    state[VELOCITY_X], state[VELOCITY_Y] = vx + gain_x, vy + gain_y


@kernel(fastmath=_FUSED)
def close_reduced(state: Array, constants: Constants) -> bool:
    """
    Let links c and d follow a and b, in angles and rates, in place.

    :returns: False where they cannot, or are near alignment; then nothing was changed.
    """
    lengths = constants.lengths
    c, s = cos(state[1] - state[0]), sin(state[1] - state[0])
    side = side_of_joint_3(state[2], state[3])
    cx, cy, dx, dy, fold, inverse_fold = close_loop(c, s, side, lengths)
    if not abs(fold) > REDUCED_FORM_LIMIT * lengths[2] * lengths[3]:
        return False
    g1, g2, g3, g4 = gammas(c, s, cx, cy, dx, dy, inverse_fold, lengths)
    state[2] = _nearest_turn(state[0] + atan2(cy, cx), state[2])
    state[3] = _nearest_turn(state[0] + atan2(dy, dx), state[3])
    state[6] = g1 * state[4] + g2 * state[5]
    state[7] = g3 * state[4] + g4 * state[5]
    return True


@kernel
def side_of_joint_3(angle_c: float, angle_d: float) -> float:
    """Tell on which side of the diagonal joint 3 lies, 1 or -1: the sign of the fold."""
    return 1.0 if _nearest_turn(angle_d - angle_c, 0.0) > 0.0 else -1.0


@kernel
def _nearest_turn(angle: float, near: float) -> float:
    """Add whole turns to an angle [rad] until it is nearest to another."""
    return angle + 2.0 * pi * float(np.rint((near - angle) / (2.0 * pi)))
