# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Conditioning of linkages over their configurations, for many linkages at once.

cond(A) of paper eq. 6 depends on the choice of the two axes. The distance of a change point, the
inertia of the motions and the effect of the wheels do not. These use the motions that the closure
admits, `J omega = 0`, by the rates of all four links, in an orthonormal basis N
(docs/studies/conditioning.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, hypot, nan, sin, sqrt

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import Vector4
from fourbar_ros.mechanism.closure import check_branch
from fourbar_ros.mechanism.constants import Array, Constants, PAIRS
from fourbar_ros.mechanism.mechanism import Mechanism
from fourbar_ros.mechanism.reduced import close_loop, pair_inertias, reduced_terms
import numpy as np
from numpy.typing import ArrayLike, NDArray

# Sets of working wheels (11, 4): all, all but a, b, c or d, then pairs ab, ac, ad, bc, bd, cd.
WHEELS: NDArray[np.bool_] = np.array(
    [[True] * 4, *(np.arange(4) != lost for lost in range(4)),
     *([wheel in pair for wheel in range(4)] for pair in PAIRS)])

COLUMNS = 4 + len(WHEELS)


@dataclass(frozen=True, eq=False)
class Conditioning:
    """
    Conditioning of m linkages in n configurations; arrays (m, n).

    All are NaN where the loop cannot close, and at a change point itself.

    :param condition: cond(A) of paper eq. 6, in the axes a and b. Grows without limit where links
        c and d fold onto a line, where Gamma does not exist.
    :param condition_of_motions: cond of the inertia of the motions, per rates of all four links.
        It does not depend on the choice of the axes.
    :param alignment: `|sin(phi_d - phi_c)|`, which vanishes where Gamma does not exist.
    :param closure_ratio: smallest over largest singular value of the closure Jacobian J. It
        vanishes at change points and nowhere else.
    :param gains: (m, n, 11) for each set of `WHEELS`, the gain of their torques along the motion
        that they drive least, per link rate and in the metric of `min_energy`: the smallest
        singular value of `N^T diag(If / max If)^(1/2)`, N an orthonormal basis of the motions.
        From 0 (a motion that they do not drive) to 1.
    """

    condition: Array
    condition_of_motions: Array
    alignment: Array
    closure_ratio: Array
    gains: Array


def conditioning_grid(mechanisms: Sequence[Mechanism], thetas: ArrayLike, branch: str = 'open'
                      ) -> Conditioning:
    """
    Evaluate linkages over configurations.

    :param mechanisms: (m,) any lengths.
    :param thetas: (n,) `phi_b - phi_a` [rad]. At 0, where branches have no names, the side of
        small positive angles applies.
    :param branch: `open` or `crossed`.
    :raises ClosureError: there is no such branch.
    """
    check_branch(branch)
    constants = np.array([mechanism.constants for mechanism in mechanisms])
    columns = _grid(constants, np.ascontiguousarray(thetas, dtype=float),
                    1.0 if branch == 'open' else -1.0, WHEELS.astype(float))
    return Conditioning(columns[..., 0], columns[..., 1], columns[..., 2], columns[..., 3],
                        columns[..., 4:])


@kernel
def _grid(constants: NDArray[np.record], thetas: Array, branch: float, wheels: Array) -> Array:
    out = np.empty((constants.size, thetas.size, COLUMNS))
    for m in range(constants.size):
        for n in range(thetas.size):
            _evaluate(constants[m], cos(thetas[n]), sin(thetas[n]), branch, wheels, out[m, n])
    return out


@kernel
def _evaluate(constants: Constants, cosine: float, sine: float, branch: float, wheels: Array,
              out: Array) -> None:
    """Set the columns (COLUMNS,) of one linkage in one configuration."""
    l_a, l_b, l_c, l_d = (constants.lengths[0], constants.lengths[1], constants.lengths[2],
                          constants.lengths[3])
    out[:] = nan
    side = branch if sine >= 0.0 else -branch
    links, fold, inverse_fold = close_loop(cosine, sine, side, constants.lengths)
    # Links with their signs in the closure; J = (-y; x).
    x = (-l_a, l_b * cosine, links.cx, -links.dx)
    y = (0.0, l_b * sine, links.cy, -links.dy)
    first, second, determinant = motions(x, y)
    # Written so that NaN, a loop that cannot close, returns here.
    if not determinant > 0.0:
        return
    xx = xy = yy = 0.0
    for i in range(4):
        xx += x[i] * x[i]
        xy += x[i] * y[i]
        yy += y[i] * y[i]
    largest = 0.5 * (xx + yy) + hypot(0.5 * (xx - yy), xy)
    terms = reduced_terms(links, inverse_fold, 0.0, 0.0, constants)
    out[0] = _condition(terms.a00, terms.a01, terms.a11)
    pairs = pair_inertias(links, constants)
    inertia = np.diag(constants.own_inertias)
    inertia[0, 1] = inertia[1, 0] = pairs.m_ab
    inertia[0, 2] = inertia[2, 0] = pairs.m_ac
    inertia[0, 3] = inertia[3, 0] = pairs.m_ad
    inertia[1, 2] = inertia[2, 1] = pairs.m_bc
    inertia[1, 3] = inertia[3, 1] = pairs.m_bd
    inertia[2, 3] = inertia[3, 2] = pairs.m_cd
    of_first, of_second = inertia @ first, inertia @ second
    out[1] = _condition((first * of_first).sum(), (first * of_second).sum(),
                        (second * of_second).sum())
    out[2] = abs(fold) / (l_c * l_d)
    out[3] = sqrt(determinant) / largest

    strongest = constants.flywheel_inertias.max()
    for row in range(wheels.shape[0]):
        g00 = g01 = g11 = determinant = 0.0
        for i in range(4):
            weight = wheels[row, i] * constants.flywheel_inertias[i] / strongest
            g00 += weight * first[i] * first[i]
            g01 += weight * first[i] * second[i]
            g11 += weight * second[i] * second[i]
            for k in range(i):
                determinant += (
                    weight * wheels[row, k] * constants.flywheel_inertias[k] / strongest
                    * (first[i] * second[k] - first[k] * second[i]) ** 2)
        out[4 + row] = sqrt(determinant / (0.5 * (g00 + g11) + hypot(0.5 * (g00 - g11), g01)))


@kernel
def motions(x: Vector4, y: Vector4) -> tuple[Array, Array, float]:
    """
    Evaluate an orthonormal basis of the link rates that the closure admits.

    The minors of J, in dual order, form an antisymmetric Q with J Q = 0. Q rotates the plane of
    the motions by a quarter turn, times the root of det(J J^T). So a small determinant costs few
    digits.

    :param x, y: the links with their signs [m]; J = (-y; x).
    :returns: two vectors (4,), and det(J J^T) [m^4]; NaN where that vanishes.
    """
    dual = np.zeros((4, 4))
    for i, k, m, n, sign in ((0, 1, 2, 3, 1.0), (0, 2, 1, 3, -1.0), (0, 3, 1, 2, 1.0),
                             (1, 2, 0, 3, 1.0), (1, 3, 0, 2, -1.0), (2, 3, 0, 1, 1.0)):
        minor = sign * (x[m] * y[n] - x[n] * y[m])
        dual[i, k], dual[k, i] = minor, -minor
    squares = (dual * dual).sum(axis=0)
    determinant = 0.5 * squares.sum()
    column = np.argmax(squares)
    first = dual[:, column] / sqrt(squares[column])
    return first, dual @ first / sqrt(determinant), determinant


@kernel
def _condition(a00: float, a01: float, a11: float) -> float:
    """Return the condition number of a symmetric positive definite matrix."""
    half = 0.5 * (a00 + a11)
    spread = hypot(0.5 * (a00 - a11), a01)
    return (half + spread) / (half - spread)
