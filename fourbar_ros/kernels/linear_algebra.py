# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Algebra of four-vectors and triangular (4, 4) matrices, as tuples.

Numba keeps tuples in registers; arrays of four would be allocated on the heap.
"""

from __future__ import annotations

from math import hypot, sqrt

from fourbar_ros.kernels.compiler import kernel

# One component for each of the links a, b, c and d.
Vector4 = tuple[float, float, float, float]

# A lower triangular (4, 4) matrix, row by row. Functions of this module take and return Cholesky
# factors with the inverses of the diagonal.
Triangle = tuple[float, float, float, float, float, float, float, float, float, float]

ZERO: Vector4 = (0.0, 0.0, 0.0, 0.0)


@kernel
def combine(p: float, u: Vector4, q: float, v: Vector4) -> Vector4:
    """Return p u + q v."""
    return (p * u[0] + q * v[0], p * u[1] + q * v[1], p * u[2] + q * v[2], p * u[3] + q * v[3])


@kernel
def multiply(u: Vector4, v: Vector4) -> Vector4:
    """Return the products of the components."""
    return (u[0] * v[0], u[1] * v[1], u[2] * v[2], u[3] * v[3])


@kernel
def dot(u: Vector4, v: Vector4) -> float:
    """Return the scalar product."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2] + u[3] * v[3]


@kernel
def total(v: Vector4) -> float:
    """Return the sum of the components."""
    return v[0] + v[1] + v[2] + v[3]


@kernel
def cholesky(diagonal: Vector4, ab: float, ac: float, ad: float, bc: float, bd: float, cd: float
             ) -> Triangle:
    """
    Factor a symmetric positive definite matrix into L L^T.

    :param diagonal: of the matrix.
    :param ab, ac, ad, bc, bd, cd: its entries above the diagonal.
    :returns: L, the inverse of the diagonal in its place.
    """
    l_aa = 1.0 / sqrt(diagonal[0])
    l_ba, l_ca, l_da = ab * l_aa, ac * l_aa, ad * l_aa
    l_bb = 1.0 / sqrt(diagonal[1] - l_ba * l_ba)
    l_cb, l_db = (bc - l_ba * l_ca) * l_bb, (bd - l_ba * l_da) * l_bb
    l_cc = 1.0 / sqrt(diagonal[2] - l_ca * l_ca - l_cb * l_cb)
    l_dc = (cd - l_ca * l_da - l_cb * l_db) * l_cc
    l_dd = 1.0 / sqrt(diagonal[3] - l_da * l_da - l_db * l_db - l_dc * l_dc)
    return l_aa, l_ba, l_bb, l_ca, l_cb, l_cc, l_da, l_db, l_dc, l_dd


@kernel
def solve_lower(factor: Triangle, v: Vector4) -> Vector4:
    """Solve L x = v."""
    aa, ba, bb, ca, cb, cc, da, db, dc, dd = factor
    a = v[0] * aa
    b = (v[1] - ba * a) * bb
    c = (v[2] - ca * a - cb * b) * cc
    return a, b, c, (v[3] - da * a - db * b - dc * c) * dd


@kernel
def solve_upper(factor: Triangle, v: Vector4) -> Vector4:
    """Solve L^T x = v."""
    aa, ba, bb, ca, cb, cc, da, db, dc, dd = factor
    d = v[3] * dd
    c = (v[2] - dc * d) * cc
    b = (v[1] - cb * c - db * d) * bb
    return (v[0] - ba * b - ca * c - da * d) * aa, b, c, d


@kernel
def jacobi_rotation(first: Vector4, second: Vector4
                    ) -> tuple[Vector4, Vector4, float, float]:
    """
    Rotate two vectors into orthogonal ones, the larger one first.

    One Jacobi rotation, so that a small singular value is known to full precision.

    :returns: the vectors, and cosine and sine of the rotation.
    """
    p, q, r = dot(first, first), dot(first, second), dot(second, second)
    half = 0.5 * (p - r)
    size = hypot(half, q)
    c, s = 1.0, 0.0
    if size > 0.0:
        c = sqrt(0.5 * (1.0 + abs(half) / size))
        s = 0.5 * q / (size * c)
        if half < 0.0:
            c, s = abs(s), (c if q >= 0.0 else -c)
    return combine(c, first, s, second), combine(c, second, -s, first), c, s
