# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Computed torque: what the links need for an acceleration, and on which axes.

The axes are links a and b, which c and d follow. Where links turn in pairs they are the pairs, on
the parallelogram a with c and b with d, and there is a third axis: at a change point the links of
a pair may turn apart, `eta = omega_c - omega_a` (docs/mechanics.md). Nothing is divided by what
vanishes there. Which links are twins is given as (4,): P1, Q1, P2, Q2 for the pairs P and Q.
"""

from __future__ import annotations

from math import cos, sin

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import Vector4
from fourbar_ros.mechanism.change_points import HOLD_FADES_FROM, HOLD_FADES_TO
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import directions, factored_inertia
from fourbar_ros.mechanism.dynamics import mass_matrix, reduced_terms_at
import numpy as np
from numpy.typing import NDArray

# Numbers that the kernels hand over in `terms`.
(A00, A01, A11, BRANCH_A, BRANCH_B, BRANCH_INERTIA, BRANCH_ANGLE, BRANCH_RATE, HOLD,
 CONDITION) = range(10)
TERMS = 10


@kernel
def pair_terms(angles: Array, rates: Vector4, twins: NDArray[np.int64], constants: Constants
               ) -> tuple[Array, Vector4, float, float, float, float, float]:
    """
    Evaluate paper eq. 6 on the pairs, on the parallelogram a with c and b with d.

    `A = T^T M T` and `b = T^T h`, `M` and `h` those of the four link angles: the axes turn with
    the pairs, so T is constant.

    :param angles: (4,) of the links [rad].
    :param rates: of the four links [rad/s].
    :param twins: (4,) links P1, Q1, P2, Q2 of the pairs.
    :returns: M (4, 4) [kg m^2], h [N m]; A00, A01, A11 [kg m^2], b0, b1 [N m].
    """
    m = mass_matrix(angles, constants)
    cosines, sines = directions((angles[0], angles[1], angles[2], angles[3]))
    _, h = factored_inertia(cosines, sines, rates, constants)
    p1, q1, p2, q2 = twins[0], twins[1], twins[2], twins[3]
    return (m, h, m[p1, p1] + 2.0 * m[p1, p2] + m[p2, p2],
            m[p1, q1] + m[p1, q2] + m[p2, q1] + m[p2, q2],
            m[q1, q1] + 2.0 * m[q1, q2] + m[q2, q2], h[p1] + h[p2], h[q1] + h[q2])


@kernel
def hold_on_branch(theta: float) -> float:
    """Return how much of the hold on the branch there is, from 0 to 1, without a corner."""
    x = (HOLD_FADES_TO - abs(sin(theta))) / (HOLD_FADES_TO - HOLD_FADES_FROM)
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@kernel
def axes_of(angles: Array, rates: Array, reference_angles: Array, reference_rates: Array,
            paired: bool, twins: NDArray[np.int64], boxed: NDArray[np.record], rows: Array,
            errors: Array, bias: Array, terms: Array) -> None:
    """
    Evaluate paper eq. 6 and the tracking errors on the axes.

    :param angles, rates: (4,) of the links, estimated [rad], [rad/s].
    :param reference_angles, reference_rates: (4,) likewise.
    :param paired: whether links turn in pairs, or are meant to.
    :param twins: (4,) links P1, Q1, P2, Q2 of the pairs.
    :param boxed: (1,) constants of the mechanism.
    :param rows: (3, 4) receives G, and the row of eta where links turn in pairs.
    :param errors: (2, 2) receives reference minus estimate, angles [rad] and rates [rad/s].
    :param bias: (3,) receives b, and that of eta [N m].
    :param terms: (TERMS,) receives A, and what is known of eta: how its inertia is coupled to the
        axes, and that itself [kg m^2], its angle [rad] and rate [rad/s] beside the reference, how
        much it is to be held; and cond(A).
    """
    constants = boxed[0]
    if paired:
        _pair_axes(angles, rates, reference_angles, reference_rates, twins, boxed, rows, errors,
                   bias, terms)
    else:
        a00, a01, a11, b0, b1, g1, g2, g3, g4, _, _ = reduced_terms_at(angles, rates, constants)
        rows[0, 0], rows[0, 1], rows[0, 2], rows[0, 3] = 1.0, 0.0, g1, g3
        rows[1, 0], rows[1, 1], rows[1, 2], rows[1, 3] = 0.0, 1.0, g2, g4
        rows[2] = 0.0
        bias[0], bias[1], bias[2] = b0, b1, 0.0
        terms[A00], terms[A01], terms[A11] = a00, a01, a11
        terms[BRANCH_A:] = 0.0
        for axis in range(2):
            errors[0, axis] = reference_angles[axis] - angles[axis]
            errors[1, axis] = reference_rates[axis] - rates[axis]
    mean = 0.5 * (terms[A00] + terms[A11])
    half = 0.5 * (terms[A00] - terms[A11])
    spread = (half * half + terms[A01] * terms[A01]) ** 0.5
    terms[CONDITION] = (mean + spread) / (mean - spread)


@kernel
def _pair_axes(angles: Array, rates: Array, reference_angles: Array, reference_rates: Array,
               twins: NDArray[np.int64], boxed: NDArray[np.record], rows: Array, errors: Array,
               bias: Array, terms: Array) -> None:
    constants = boxed[0]
    p1, q1, p2, q2 = twins[0], twins[1], twins[2], twins[3]
    theta = 0.5 * (angles[q1] + angles[q2] - angles[p1] - angles[p2])
    # Not of the mean: where one twin is a turn ahead, that is half a turn off.
    sign = 1.0 if cos(angles[q1] - angles[p1]) >= 0.0 else -1.0
    # In line, the closure leaves free what turns twins apart, by inverse lengths.
    gearing = sign * constants.lengths[p1] / constants.lengths[q1]
    rows[:] = 0.0
    rows[0, p1] = rows[0, p2] = rows[1, q1] = rows[1, q2] = 1.0
    rows[2, p1], rows[2, q1], rows[2, p2], rows[2, q2] = -0.5, -0.5 * gearing, 0.5, 0.5 * gearing
    matrix, h, terms[A00], terms[A01], terms[A11], bias[0], bias[1] = pair_terms(
        angles, (rates[0], rates[1], rates[2], rates[3]), twins, constants)
    bias[2] = rows[2, 0] * h[0] + rows[2, 1] * h[1] + rows[2, 2] * h[2] + rows[2, 3] * h[3]
    for row in range(3):
        coupled = 0.0
        for i in range(4):
            for k in range(4):
                coupled += rows[row, i] * matrix[i, k] * rows[2, k]
        terms[BRANCH_A + row] = coupled
    terms[HOLD] = hold_on_branch(theta)
    angle = rate = 0.0
    for link in range(4):
        angle += rows[2, link] * (angles[link] - reference_angles[link])
        rate += rows[2, link] * (rates[link] - reference_rates[link])
    size = 0.5 * (1.0 + gearing * gearing)
    terms[BRANCH_ANGLE], terms[BRANCH_RATE] = angle / size, rate / size
    for axis in range(2):
        first, second = twins[axis], twins[axis + 2]
        errors[0, axis] = 0.5 * (reference_angles[first] - angles[first]
                                 + reference_angles[second] - angles[second])
        errors[1, axis] = 0.5 * (reference_rates[first] - rates[first]
                                 + reference_rates[second] - rates[second])


@kernel
def demanded(acceleration: Array, errors: Array, stiffness: float, damping: float, band: float,
             disturbance: Array, sticking: float, bias: Array, terms: Array, demand: Array
             ) -> None:
    """
    Evaluate the tracking law: the generalized forces `A du + b` that the wheels are to give.

    The error is taken apart into that of the attitude, which turns the whole without turning the
    joints, and that of the configuration. At rest dry friction in the joints holds the
    configuration by itself: there errors within `band` do nothing, and what friction was
    estimated to do is not worked against, or it would be taken for a disturbance that grows with
    what the wheels give.

    :param acceleration: (2,) of the reference [rad/s^2].
    :param errors: (2, 2) of angles [rad] and rates [rad/s].
    :param stiffness, damping: of the law [1/s^2], [1/s].
    :param band: of the configuration [rad].
    :param disturbance: (2,) estimated torques on the axes that are to be compensated [N m].
    :param sticking: from 0, in motion, to 1, at rest.
    :param demand: (3,) receives it; for eta what keeps it from accelerating.
    """
    a00, a01, a11 = terms[A00], terms[A01], terms[A11]
    total = a00 + 2.0 * a01 + a11
    first, second = (a00 + a01) / total, (a01 + a11) / total
    attitude = first * errors[0, 0] + second * errors[0, 1]
    theta = errors[0, 1] - errors[0, 0]
    width = band * sticking
    theta = max(theta - width, 0.0) + min(theta + width, 0.0)
    u0 = acceleration[0] + damping * errors[1, 0] + stiffness * (attitude - second * theta)
    u1 = acceleration[1] + damping * errors[1, 1] + stiffness * (attitude + first * theta)
    whole = disturbance[0] + disturbance[1]
    between = (disturbance[1] - second * whole) * (1.0 - sticking)
    demand[0] = a00 * u0 + a01 * u1 + bias[0] - first * whole + between
    demand[1] = a01 * u0 + a11 * u1 + bias[1] - second * whole - between
    demand[2] = terms[BRANCH_A] * u0 + terms[BRANCH_B] * u1 + bias[2]
