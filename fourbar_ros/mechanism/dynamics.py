# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Kane dynamics of the linkage: mass matrix, bias, closure and the reduced form of paper eq. 6.

One set of equations, written in the four link angles (docs/mechanics.md):
`M(phi) alpha + h(phi, omega) = Q + J^T lambda`, `J alpha = -dJ/dt omega`,
where Q are the generalized forces on the link angles (a motor torque tau on the wheel is -tau on
its link). Two ways to solve it:

* away from change points `omega = W (omega_a, omega_b)`, `W = [1, 0; 0, 1; Gamma]`, gives the
  paper's `A du + b = G Q` with `A = W^T M W`, `b = W^T (M sigma + h)`, `G = W^T`;
* close to a change point Gamma is 0/0, and the constraint forces come from a pseudo-inverse of
  the constraints' Schur complement, which does not mind a lost rank.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, hypot, sin, sqrt

from fourbar_ros.errors import FourbarError
from fourbar_ros.mechanism.compiled import kernel
from fourbar_ros.mechanism.parameters import Array, Constants, Mechanism
import numpy as np
from numpy.typing import ArrayLike

# Below this |sin(phi_d - phi_c)| the constrained form is solved. The reduced form loses about
# 1 / |sin|^2 in accuracy, and the stages of an integration step, which are a little off the
# closure, about as much again.
NEAR_ALIGNMENT = 0.3

# Ratio of the singular values of the constraints below which the weaker direction is at a change
# point: there it follows from the third derivative of the closure, and closure errors are left
# alone, since removing them divides the rounding of an angle by this ratio. Lengths that differ
# by less than its square (1e-8 of the length) count as equal.
AT_CHANGE_POINT = 1e-4

# The third derivative needs motion. It is weighted by the time [s] that the motion takes through
# the neighbourhood of the change point, but at most by this; so that a linkage at rest, all but
# rounding, is free to leave on either branch: below this ratio nothing constrains it.
LONGEST_PASSAGE = 1.0
LOST = 1e-9


class ChangePointError(FourbarError):
    """Gamma, and with it the reduced form, does not exist at a change point."""


@dataclass(frozen=True, eq=False)
class ReducedForm:
    """
    The terms of paper eq. 6, `A du + b = -G diag(If) s`, u = (omega_a, omega_b).

    :param mass_matrix: A (2, 2) [kg m^2].
    :param bias: b (2,) [N m].
    :param gamma: (2, 2), `(omega_c, omega_d) = gamma (omega_a, omega_b)`, rows c and d.
    """

    mass_matrix: Array
    bias: Array
    gamma: Array

    @property
    def wheel_map(self) -> Array:
        """Map link torques (a, b, c, d) to the two axes: G (2, 4)."""
        return np.hstack([np.eye(2), self.gamma.T])


def reduced_form(mechanism: Mechanism, link_angles: ArrayLike, link_rates: ArrayLike
                 ) -> ReducedForm:
    """
    Evaluate paper eq. 6 (corrected as docs/mechanics.md says) for any linkage.

    :param link_angles: (4,) on the closure [rad].
    :param link_rates: (2,) omega_a, omega_b, or (4,) of which the first two count [rad/s].
    :raises ChangePointError: links c and d lie on a line, where Gamma does not exist.
    """
    angles = np.asarray(link_angles, dtype=float)
    rates = np.asarray(link_rates, dtype=float)
    if sin(angles[3] - angles[2]) == 0.0:
        raise ChangePointError('links c and d lie on a line: Gamma does not exist here')
    a00, a01, a11, b0, b1, g1, g2, g3, g4, _, _ = reduced_terms(
        angles[0], angles[1], angles[2], angles[3], rates[0], rates[1], mechanism.constants)
    return ReducedForm(
        np.array([[a00, a01], [a01, a11]]), np.array([b0, b1]), np.array([[g1, g2], [g3, g4]]))


def angular_momentum(mechanism: Mechanism, link_angles: ArrayLike, link_rates: ArrayLike,
                     wheel_speeds: ArrayLike) -> float:
    """
    Sum up the angular momentum about the mass centre of the whole, links and wheels.

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
    Sum up the kinetic energy relative to the mass centre, links and wheels.

    Parameters as in :func:`angular_momentum`; returns [J].
    """
    rates = np.asarray(link_rates, dtype=float)
    wheels = np.asarray(wheel_speeds, dtype=float)
    matrix = mass_matrix(np.asarray(link_angles, dtype=float), mechanism.constants)
    return float(rates @ matrix @ rates
                 + mechanism.flywheel_inertias @ (wheels * wheels)) / 2.0


@kernel
def mass_matrix(angles: Array, constants: Constants) -> Array:
    """Evaluate M (4, 4) of the four link angles [kg m^2], without the wheels' axial inertia."""
    matrix = np.empty((4, 4))
    for j in range(4):
        for k in range(4):
            difference = angles[k] - angles[j]
            matrix[j, k] = (constants.cosine[j, k] * cos(difference)
                            + constants.sine[j, k] * sin(difference))
    return matrix


@kernel
def centripetal_bias(angles: Array, rates: Array, constants: Constants) -> Array:
    """Evaluate h (4,) [N m]: what the links' rates alone ask of each link angle."""
    bias = np.zeros(4)
    for j in range(4):
        for k in range(4):
            difference = angles[k] - angles[j]
            bias[j] += rates[k] * rates[k] * (
                constants.sine[j, k] * cos(difference)
                - constants.cosine[j, k] * sin(difference))
    return bias


@kernel
def gamma_matrix(angles: Array, lengths: Array) -> Array:
    """Evaluate Gamma (2, 2): (omega_c, omega_d) = Gamma (omega_a, omega_b)."""
    g1, g2, g3, g4 = dependent_rates(angles, lengths)
    return np.array([[g1, g2], [g3, g4]])


@kernel
def dependent_rates(angles: Array, lengths: Array) -> tuple[float, float, float, float]:
    """Evaluate Gamma: omega_c = g1 omega_a + g2 omega_b, omega_d = g3 omega_a + g4 omega_b."""
    phi_a, phi_b, phi_c, phi_d = angles[0], angles[1], angles[2], angles[3]
    fold = sin(phi_d - phi_c)
    over_c = 1.0 / (lengths[2] * fold)
    over_d = 1.0 / (lengths[3] * fold)
    return (lengths[0] * sin(phi_d - phi_a) * over_c,
            -lengths[1] * sin(phi_d - phi_b) * over_c,
            lengths[0] * sin(phi_c - phi_a) * over_d,
            -lengths[1] * sin(phi_c - phi_b) * over_d)


@kernel
def reduced_terms(
    phi_a: float, phi_b: float, phi_c: float, phi_d: float, rate_a: float, rate_b: float,
    constants: Constants,
) -> tuple[float, float, float, float, float, float, float, float, float, float, float]:
    """
    Evaluate A, b and Gamma of paper eq. 6 from four angles on the closure and two rates.

    :returns: A00, A01, A11, b0, b1, Gamma_1, Gamma_2, Gamma_3, Gamma_4, and what the rates alone
        give the accelerations of c and d: sigma_c, sigma_d.
    """
    lengths = constants.lengths
    cosine = constants.cosine
    sine = constants.sine
    sa, ca = sin(phi_a), cos(phi_a)
    sb, cb = sin(phi_b), cos(phi_b)
    sc, cc = sin(phi_c), cos(phi_c)
    sd, cd = sin(phi_d), cos(phi_d)
    # Sines and cosines of phi_k - phi_j, from those of the angles.
    s_ab, c_ab = sb * ca - cb * sa, cb * ca + sb * sa
    s_ac, c_ac = sc * ca - cc * sa, cc * ca + sc * sa
    s_ad, c_ad = sd * ca - cd * sa, cd * ca + sd * sa
    s_bc, c_bc = sc * cb - cc * sb, cc * cb + sc * sb
    s_bd, c_bd = sd * cb - cd * sb, cd * cb + sd * sb
    s_cd, c_cd = sd * cc - cd * sc, cd * cc + sd * sc

    m_ab = cosine[0, 1] * c_ab + sine[0, 1] * s_ab
    m_ac = cosine[0, 2] * c_ac + sine[0, 2] * s_ac
    m_ad = cosine[0, 3] * c_ad + sine[0, 3] * s_ad
    m_bc = cosine[1, 2] * c_bc + sine[1, 2] * s_bc
    m_bd = cosine[1, 3] * c_bd + sine[1, 3] * s_bd
    m_cd = cosine[2, 3] * c_cd + sine[2, 3] * s_cd
    m_aa, m_bb, m_cc, m_dd = cosine[0, 0], cosine[1, 1], cosine[2, 2], cosine[3, 3]

    over_c = 1.0 / (lengths[2] * s_cd)
    over_d = 1.0 / (lengths[3] * s_cd)
    g1 = lengths[0] * s_ad * over_c
    g2 = -lengths[1] * s_bd * over_c
    g3 = lengths[0] * s_ac * over_d
    g4 = -lengths[1] * s_bc * over_d

    # Squared rates, and the centripetal part sigma of the dependent accelerations.
    rate_c = g1 * rate_a + g2 * rate_b
    rate_d = g3 * rate_a + g4 * rate_b
    qa, qb, qc, qd = rate_a * rate_a, rate_b * rate_b, rate_c * rate_c, rate_d * rate_d
    sigma_c = (lengths[1] * qb * c_bd + lengths[2] * qc * c_cd
               - lengths[0] * qa * c_ad - lengths[3] * qd) * over_c
    sigma_d = (lengths[1] * qb * c_bc + lengths[2] * qc
               - lengths[0] * qa * c_ac - lengths[3] * qd * c_cd) * over_d

    n_ab = sine[0, 1] * c_ab - cosine[0, 1] * s_ab
    n_ac = sine[0, 2] * c_ac - cosine[0, 2] * s_ac
    n_ad = sine[0, 3] * c_ad - cosine[0, 3] * s_ad
    n_bc = sine[1, 2] * c_bc - cosine[1, 2] * s_bc
    n_bd = sine[1, 3] * c_bd - cosine[1, 3] * s_bd
    n_cd = sine[2, 3] * c_cd - cosine[2, 3] * s_cd
    # M sigma + h, link by link.
    f_a = n_ab * qb + n_ac * qc + n_ad * qd + m_ac * sigma_c + m_ad * sigma_d
    f_b = -n_ab * qa + n_bc * qc + n_bd * qd + m_bc * sigma_c + m_bd * sigma_d
    f_c = -n_ac * qa - n_bc * qb + n_cd * qd + m_cc * sigma_c + m_cd * sigma_d
    f_d = -n_ad * qa - n_bd * qb - n_cd * qc + m_cd * sigma_c + m_dd * sigma_d

    # M Gamma_columns, needed twice.
    ma_c, ma_d = m_cc * g1 + m_cd * g3, m_cd * g1 + m_dd * g3
    mb_c, mb_d = m_cc * g2 + m_cd * g4, m_cd * g2 + m_dd * g4
    a00 = m_aa + 2.0 * (m_ac * g1 + m_ad * g3) + g1 * ma_c + g3 * ma_d
    a01 = m_ab + m_ac * g2 + m_ad * g4 + m_bc * g1 + m_bd * g3 + g1 * mb_c + g3 * mb_d
    a11 = m_bb + 2.0 * (m_bc * g2 + m_bd * g4) + g2 * mb_c + g4 * mb_d
    b0 = f_a + g1 * f_c + g3 * f_d
    b1 = f_b + g2 * f_c + g4 * f_d
    return a00, a01, a11, b0, b1, g1, g2, g3, g4, sigma_c, sigma_d


@kernel
def link_accelerations(angles: Array, rates: Array, forces: Array, constants: Constants,
                       out: Array) -> None:
    """
    Solve the equations of motion for the four link angles.

    :param angles: (4,) on the closure [rad].
    :param rates: (4,) consistent with the closure [rad/s].
    :param forces: (4,) generalized forces on the link angles [N m].
    :param out: (4,) receives the angular accelerations [rad/s^2].
    """
    if abs(sin(angles[3] - angles[2])) > NEAR_ALIGNMENT:
        _reduced_accelerations(angles, rates, forces, constants, out)
    else:
        _constrained_accelerations(angles, rates, forces, constants, out)


@kernel
def _reduced_accelerations(angles: Array, rates: Array, forces: Array, constants: Constants,
                           out: Array) -> None:
    a00, a01, a11, b0, b1, g1, g2, g3, g4, sigma_c, sigma_d = reduced_terms(
        angles[0], angles[1], angles[2], angles[3], rates[0], rates[1], constants)
    f0 = forces[0] + g1 * forces[2] + g3 * forces[3] - b0
    f1 = forces[1] + g2 * forces[2] + g4 * forces[3] - b1
    determinant = a00 * a11 - a01 * a01
    out[0] = (a11 * f0 - a01 * f1) / determinant
    out[1] = (a00 * f1 - a01 * f0) / determinant
    out[2] = g1 * out[0] + g2 * out[1] + sigma_c
    out[3] = g3 * out[0] + g4 * out[1] + sigma_d


@kernel
def _constrained_accelerations(angles: Array, rates: Array, forces: Array,
                               constants: Constants, out: Array) -> None:
    factor = cholesky(mass_matrix(angles, constants))
    bias = centripetal_bias(angles, rates, constants)
    for j in range(4):
        out[j] = forces[j] - bias[j]
    solve_cholesky(factor, out)
    # A turn of the whole changes no derivative of the closure.
    turn = 0.25 * (rates[0] + rates[1] + rates[2] + rates[3])
    jacobian = closure_jacobian(angles, constants.lengths)
    jerk = np.empty((2, 4))
    need_x = need_y = jerk_x = jerk_y = 0.0
    for j in range(4):
        rate = rates[j] - turn
        # s_j l_j e_j, and J alpha = sum of it times rate^2.
        x, y = jacobian[1, j], -jacobian[0, j]
        need_x += x * rate * rate - jacobian[0, j] * out[j]
        need_y += y * rate * rate - jacobian[1, j] * out[j]
        # J d(alpha)/dt - 3 sum s l e rate alpha - sum s l E e rate^3 = 0
        jerk[0, j] = -3.0 * x * rate
        jerk[1, j] = -3.0 * y * rate
        jerk_x += -y * rate * rate * rate - jerk[0, j] * out[j]
        jerk_y += x * rate * rate * rate - jerk[1, j] * out[j]
    strong, weak, c, s = orthogonal_columns(factor, jacobian)
    size = float(strong @ strong)
    need_strong = c * need_x + s * need_y
    need_weak = c * need_y - s * need_x
    if weak @ weak < AT_CHANGE_POINT * AT_CHANGE_POINT * size:
        third = solve_lower(factor, c * jerk[1] - s * jerk[0])
        along = float(third @ strong) / size
        third -= along * strong
        need_third = c * jerk_y - s * jerk_x - along * need_strong
        length = sqrt(float(third @ third))
        if length > 0.0:
            time = min(LONGEST_PASSAGE, AT_CHANGE_POINT * sqrt(size) / length)
            # Ahead of the change point the two would cancel without this sign.
            if third @ weak < 0.0:
                time = -time
            weak += time * third
            need_weak += time * need_third
    correction = need_strong / size * strong
    if weak @ weak > LOST * LOST * size:
        correction += need_weak / (weak @ weak) * weak
    add_upper_solution(factor, correction, out)


@kernel
def closure_jacobian(angles: Array, lengths: Array) -> Array:
    """Evaluate the Jacobian J (2, 4) of the closure [m]."""
    jacobian = np.empty((2, 4))
    for j in range(4):
        arm = -lengths[j] if (j == 0 or j == 3) else lengths[j]
        jacobian[0, j] = -arm * sin(angles[j])
        jacobian[1, j] = arm * cos(angles[j])
    return jacobian


@kernel
def orthogonal_columns(factor: Array, jacobian: Array) -> tuple[Array, Array, float, float]:
    """
    Turn the columns of `L^-1 J^T` into orthogonal ones, the larger one first.

    One Jacobi rotation, so that a small singular value is known to full precision.

    :returns: the columns (4,), and cosine and sine of the rotation.
    """
    first = solve_lower(factor, jacobian[0])
    second = solve_lower(factor, jacobian[1])
    p, q, r = float(first @ first), float(first @ second), float(second @ second)
    half = 0.5 * (p - r)
    size = hypot(half, q)
    if size > 0.0:
        c = sqrt(0.5 * (1.0 + abs(half) / size))
        s = 0.5 * q / (size * c)
        if half < 0.0:
            c, s = abs(s), (c if q >= 0.0 else -c)
    else:
        c, s = 1.0, 0.0
    return c * first + s * second, c * second - s * first, c, s


@kernel
def correct_along_constraints(factor: Array, jacobian: Array, need_x: float, need_y: float,
                              vector: Array) -> None:
    """
    Add to `vector` the M^-1 J^T lambda that changes `J vector` by the need.

    `M = L L^T`. At a change point nothing is done along the weak direction.
    """
    strong, weak, c, s = orthogonal_columns(factor, jacobian)
    size = float(strong @ strong)
    correction = (c * need_x + s * need_y) / size * strong
    if weak @ weak > AT_CHANGE_POINT * AT_CHANGE_POINT * size:
        correction += (c * need_y - s * need_x) / (weak @ weak) * weak
    add_upper_solution(factor, correction, vector)


@kernel
def solve_lower(factor: Array, vector: Array) -> Array:
    """Solve L x = vector."""
    x = np.empty(4)
    for i in range(4):
        x[i] = vector[i]
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    return x


@kernel
def add_upper_solution(factor: Array, step: Array, vector: Array) -> None:
    """Add the solution x of L^T x = step to the vector; overwrites the step."""
    for i in range(3, -1, -1):
        for k in range(i + 1, 4):
            step[i] -= factor[k, i] * step[k]
        step[i] /= factor[i, i]
    for i in range(4):
        vector[i] += step[i]


@kernel
def cholesky(matrix: Array) -> Array:
    """Factor a positive definite (4, 4) matrix into L L^T, L lower triangular."""
    factor = np.zeros((4, 4))
    for i in range(4):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = sqrt(value) if i == j else value / factor[j, j]
    return factor


@kernel
def solve_cholesky(factor: Array, vector: Array) -> None:
    """Solve L L^T x = vector in place."""
    for i in range(4):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(3, -1, -1):
        for k in range(i + 1, 4):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@kernel
def project_onto_closure(angles: Array, rates: Array, constants: Constants) -> None:
    """
    Remove the closure error that integration left, in angles and rates, in place.

    Away from alignment c and d take it all; close to it all four links share it with the mass
    matrix as metric (an impulse in the joints, so momentum stays), except for the direction in
    which the constraint is being lost.
    """
    lengths = constants.lengths
    gap_x = gap_y = 0.0
    for j in range(4):
        arm = -lengths[j] if (j == 0 or j == 3) else lengths[j]
        gap_x += arm * cos(angles[j])
        gap_y += arm * sin(angles[j])
    fold = sin(angles[3] - angles[2])
    if abs(fold) > NEAR_ALIGNMENT:
        # l_c E e_c dc - l_d E e_d dd = -gap
        along_d = gap_x * cos(angles[3]) + gap_y * sin(angles[3])
        along_c = gap_x * cos(angles[2]) + gap_y * sin(angles[2])
        angles[2] -= along_d / (lengths[2] * fold)
        angles[3] -= along_c / (lengths[3] * fold)
        g1, g2, g3, g4 = dependent_rates(angles, lengths)
        rates[2] = g1 * rates[0] + g2 * rates[1]
        rates[3] = g3 * rates[0] + g4 * rates[1]
        return
    factor = cholesky(mass_matrix(angles, constants))
    jacobian = closure_jacobian(angles, lengths)
    correct_along_constraints(factor, jacobian, -gap_x, -gap_y, angles)
    slip_x = slip_y = 0.0
    for j in range(4):
        slip_x -= jacobian[0, j] * rates[j]
        slip_y -= jacobian[1, j] * rates[j]
    correct_along_constraints(factor, jacobian, slip_x, slip_y, rates)
