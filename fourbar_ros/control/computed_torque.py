# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Computed torque: the axes, paper eq. 6 on them, and the generalized forces of the tracking law.

The axes are links a and b; links c and d follow. Where links turn in pairs the axes are the
pairs, on the parallelogram a with c and b with d. There is then a third axis: at a change point
the links of a pair may turn apart, `eta = omega_c - omega_a` (docs/mechanics.md). No term is
divided by a quantity that vanishes there.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

from fourbar_ros.control.records import Fields, Record
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import Vector4
from fourbar_ros.mechanism.change_points import HOLD_FADES_FROM, HOLD_FADES_TO
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import directions, factored_inertia
from fourbar_ros.mechanism.dynamics import mass_matrix, reduced_terms_at
import numpy as np
from numpy.typing import NDArray

# Index of the third axis.
ETA = 2

# Fields of the record of the links and their reference; without pairs P1, Q1 are a, b.
MOTION_FIELDS: Fields = [
    ('angles', float, (4,)),                    # rad, of the links, estimated
    ('rates', float, (4,)),                     # rad/s
    ('reference_angles', float, (4,)),          # rad
    ('reference_rates', float, (4,)),           # rad/s
    ('paired', np.int64, ()),                   # 1 where links turn in pairs, else 0
    ('paired_links', np.int64, (4,)),           # P1, Q1, P2, Q2 of the pairs P and Q
]

# Fields of the record of the axes.
AXES_FIELDS: Fields = [
    ('wheel_map', float, (3, 4)),               # G, and the row of eta where links turn in pairs
    ('errors', float, (2, 2)),                  # rad, rad/s: reference minus estimate
    ('bias', float, (3,)),                      # N m, b, and that of eta
    ('a00', float, ()),                         # kg m^2, A
    ('a01', float, ()),
    ('a11', float, ()),
    ('eta_row', float, (3,)),                   # kg m^2, row of eta in the mass matrix of the axes
    ('eta', float, ()),                         # rad, beside the reference
    ('eta_rate', float, ()),                    # rad/s
    ('hold', float, ()),                        # share of the branch hold, 0 to 1
    ('condition', float, ()),                   # cond(A)
]


class Feedback(NamedTuple):
    """
    Terms of the tracking law besides the reference acceleration.

    :param errors: (2, 2) of angles [rad] and rates [rad/s].
    :param stiffness, damping: gains [1/s^2], [1/s].
    :param rest_band: dead band of the configuration at rest [rad].
    :param sticking: from 0, in motion, to 1, at rest.
    :param disturbance: (2,) estimated torques on the axes to compensate [N m].
    """

    errors: Array
    stiffness: float
    damping: float
    rest_band: float
    sticking: float
    disturbance: Array


@kernel
def pair_terms(angles: Array, rates: Vector4, paired_links: NDArray[np.int64], constants: Constants
               ) -> tuple[Array, Vector4, float, float, float, float, float]:
    """
    Evaluate paper eq. 6 on the pairs.

    `A = T^T M T` and `b = T^T h`, with `M` and `h` of the four link angles: the axes turn with
    the pairs, so T is constant.

    :param angles: (4,) of the links [rad].
    :param rates: of the four links [rad/s].
    :param paired_links: (4,) links P1, Q1, P2, Q2 of the pairs.
    :returns: M (4, 4) [kg m^2], h [N m]; A00, A01, A11 [kg m^2], b0, b1 [N m].
    """
    m = mass_matrix(angles, constants)
    cosines, sines = directions((angles[0], angles[1], angles[2], angles[3]))
    _, h = factored_inertia(cosines, sines, rates, constants)
    p1, q1, p2, q2 = paired_links[0], paired_links[1], paired_links[2], paired_links[3]
    return (m, h, m[p1, p1] + 2.0 * m[p1, p2] + m[p2, p2],
            m[p1, q1] + m[p1, q2] + m[p2, q1] + m[p2, q2],
            m[q1, q1] + 2.0 * m[q1, q2] + m[q2, q2], h[p1] + h[p2], h[q1] + h[q2])


@kernel
def hold_on_branch(theta: float) -> float:
    """Return the share of the branch hold, from 0 to 1, with a continuous slope."""
    x = (HOLD_FADES_TO - abs(sin(theta))) / (HOLD_FADES_TO - HOLD_FADES_FROM)
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@kernel
def evaluate_axes(motion: Record, constants: Constants, axes: Record) -> None:
    """
    Evaluate paper eq. 6 and the tracking errors on the axes.

    :param motion: a record with `MOTION_FIELDS`.
    :param axes: receives `AXES_FIELDS`.
    """
    if motion.paired:
        _evaluate_pairs(motion, constants, axes)
    else:
        a00, a01, a11, b0, b1, g1, g2, g3, g4, _, _ = reduced_terms_at(
            motion.angles, motion.rates, constants)
        wheel_map, bias = axes.wheel_map, axes.bias
        wheel_map[0, 0], wheel_map[0, 1], wheel_map[0, 2], wheel_map[0, 3] = 1.0, 0.0, g1, g3
        wheel_map[1, 0], wheel_map[1, 1], wheel_map[1, 2], wheel_map[1, 3] = 0.0, 1.0, g2, g4
        wheel_map[ETA] = 0.0
        bias[0], bias[1], bias[ETA] = b0, b1, 0.0
        axes.a00, axes.a01, axes.a11 = a00, a01, a11
        axes.eta_row[:] = 0.0
        axes.eta = axes.eta_rate = axes.hold = 0.0
        for axis in range(2):
            axes.errors[0, axis] = motion.reference_angles[axis] - motion.angles[axis]
            axes.errors[1, axis] = motion.reference_rates[axis] - motion.rates[axis]
    mean = 0.5 * (axes.a00 + axes.a11)
    half = 0.5 * (axes.a00 - axes.a11)
    spread = (half * half + axes.a01 * axes.a01) ** 0.5
    axes.condition = (mean + spread) / (mean - spread)


@kernel
def _evaluate_pairs(motion: Record, constants: Constants, axes: Record) -> None:
    angles, rates, links = motion.angles, motion.rates, motion.paired_links
    wheel_map, bias, eta_row = axes.wheel_map, axes.bias, axes.eta_row
    p1, q1, p2, q2 = links[0], links[1], links[2], links[3]
    theta = 0.5 * (angles[q1] + angles[q2] - angles[p1] - angles[p2])
    # Not of the mean theta: where one link is a turn ahead, the mean is half a turn off.
    sign = 1.0 if cos(angles[q1] - angles[p1]) >= 0.0 else -1.0
    # In line, the closure leaves free the motion that turns both pairs apart by inverse lengths.
    gearing = sign * constants.lengths[p1] / constants.lengths[q1]
    wheel_map[:] = 0.0
    wheel_map[0, p1] = wheel_map[0, p2] = wheel_map[1, q1] = wheel_map[1, q2] = 1.0
    wheel_map[ETA, p1], wheel_map[ETA, q1] = -0.5, -0.5 * gearing
    wheel_map[ETA, p2], wheel_map[ETA, q2] = 0.5, 0.5 * gearing
    free = wheel_map[ETA]
    matrix, h, axes.a00, axes.a01, axes.a11, bias[0], bias[1] = pair_terms(
        angles, (rates[0], rates[1], rates[2], rates[3]), links, constants)
    bias[ETA] = free[0] * h[0] + free[1] * h[1] + free[2] * h[2] + free[3] * h[3]
    for row in range(3):
        coupled = 0.0
        for i in range(4):
            for k in range(4):
                coupled += wheel_map[row, i] * matrix[i, k] * free[k]
        eta_row[row] = coupled
    axes.hold = hold_on_branch(theta)
    eta = eta_rate = 0.0
    for link in range(4):
        eta += free[link] * (angles[link] - motion.reference_angles[link])
        eta_rate += free[link] * (rates[link] - motion.reference_rates[link])
    size = 0.5 * (1.0 + gearing * gearing)
    axes.eta, axes.eta_rate = eta / size, eta_rate / size
    for axis in range(2):
        first, second = links[axis], links[axis + 2]
        axes.errors[0, axis] = 0.5 * (
            motion.reference_angles[first] - angles[first]
            + motion.reference_angles[second] - angles[second])
        axes.errors[1, axis] = 0.5 * (
            motion.reference_rates[first] - rates[first]
            + motion.reference_rates[second] - rates[second])


@kernel
def demanded(acceleration: Array, feedback: Feedback, axes: Record, demand: Array) -> None:
    """
    Evaluate the tracking law: the generalized forces `A du + b` that the wheels must apply.

    The error is split into attitude, which turns the whole linkage without turning the joints,
    and configuration. At rest dry friction in the joints holds the configuration: errors within
    the dead band are ignored, and the estimated friction is not compensated. Otherwise the
    estimator takes the reaction to the wheels for a disturbance, which then grows.

    :param acceleration: (2,) of the reference [rad/s^2].
    :param axes: a record of `AXES_FIELDS`.
    :param demand: (3,) receives the forces; that of eta keeps it from accelerating [N m].
    """
    errors, damping, stiffness = feedback.errors, feedback.damping, feedback.stiffness
    sticking, disturbance = feedback.sticking, feedback.disturbance
    a00, a01, a11 = axes.a00, axes.a01, axes.a11
    total = a00 + 2.0 * a01 + a11
    first, second = (a00 + a01) / total, (a01 + a11) / total
    attitude = first * errors[0, 0] + second * errors[0, 1]
    theta = errors[0, 1] - errors[0, 0]
    width = feedback.rest_band * sticking
    theta = max(theta - width, 0.0) + min(theta + width, 0.0)
    u0 = acceleration[0] + damping * errors[1, 0] + stiffness * (attitude - second * theta)
    u1 = acceleration[1] + damping * errors[1, 1] + stiffness * (attitude + first * theta)
    whole = disturbance[0] + disturbance[1]
    between = (disturbance[1] - second * whole) * (1.0 - sticking)
    demand[0] = a00 * u0 + a01 * u1 + axes.bias[0] - first * whole + between
    demand[1] = a01 * u0 + a11 * u1 + axes.bias[1] - second * whole - between
    demand[ETA] = axes.eta_row[0] * u0 + axes.eta_row[1] * u1 + axes.bias[ETA]
