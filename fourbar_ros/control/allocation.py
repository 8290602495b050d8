# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
How the four wheels share what the axes need.

Every way to share is the least norm, sum of `tau_i^2 / v_i`, in a metric of its own: `v` are the
mobilities of the wheels, zero for one that shall not be used. They differ in how they keep the
bounds of the motors: all torques scaled together, or the best within the bounds.

Rows map the torques of the links to the axes and count a wheel that sits on its axis as 1: G of
paper eq. 6, and near a change point the opposite torques as a third.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, sqrt

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

ALLOCATIONS = ('two_wheels', 'min_norm', 'min_energy', 'bounded')

# The gain of a direction of the axes is what a unit of torque of the wheels does along it, next
# to a wheel of the largest mobility that sits on its axis. From WEAK on a demand along it is met.
# Below, it would take more than ten times its own size in torque, so less and less of it is, and
# none from LOST on. Not relative to the largest gain: near a change point that grows without
# limit, and the other direction is as good as ever.
WEAK = 0.1
LOST = 0.05

# On wheels that push less than this share of the strongest towards a limit of what all can do
# together nobody counts, and on the others for so much less. Else the least mismatch of opposite
# links made wheels work against each other with all that they have: those of a pair with little
# to do when the other is at its limit, or a and c for a thousandth of what b and d cannot give.
MARGIN = 0.01

# A wheel whose mobility is so much less than the largest is of no use.
USELESS = 1e-12

# What is smaller than its neighbours by this much is rounding.
ROUNDING = 1e-12

# Wheels that are left to move depend on each other when their push across is so small.
DEPENDENT = 1e-9

# A torque is within its bounds when it exceeds them by so little of what is asked.
WITHIN = 1e-10


class AllocationError(FourbarError):
    """A way to share torques that does not exist."""


def mobilities(name: str, flywheel_inertias: Array, available: Sequence[bool] | NDArray[np.bool_]
               ) -> Array:
    """
    Return the metric of an allocation.

    `two_wheels` drives with one wheel of each pair, a and b if it can; `min_norm` makes the norm
    of wheel accelerations least (paper eq. 8); `min_energy` and `bounded` weigh it with the wheel
    inertias: a pair that starts at equal speeds keeps them equal, which is the least kinetic
    energy for its momentum.

    :param name: one of ALLOCATIONS.
    :param flywheel_inertias: If (4,) [kg m^2].
    :param available: (4,) whether each wheel may be used.
    :returns: v (4,), 0 for a wheel that is not used; only ratios matter.
    :raises AllocationError: there is none of that name.
    """
    if name not in ALLOCATIONS:
        raise AllocationError(
            f'allocation {name!r} is unknown (known are {", ".join(ALLOCATIONS)})')
    used = np.array(available, dtype=bool)
    if name == 'two_wheels':
        used[2:] &= ~used[:2]
    inertias = np.asarray(flywheel_inertias, dtype=float)
    power = 1 if name in ('min_energy', 'bounded') else 2
    return np.where(used, inertias ** power, 0.0)


@kernel
def allocate(rows: Array, demand: Array, mobilities: Array, lower: Array, upper: Array,
             bounded: bool, torques_out: Array) -> float:
    """
    Share a demand, `rows tau = -scale demand`, with the least sum of `tau_i^2 / v_i`.

    Demand along a direction that the wheels cannot drive is dropped, see :func:`controllable`.

    Unless `bounded`, what exceeds a bound is scaled down with all the rest, so that the direction
    of the motion stays. A wheel that is needed and cannot turn any faster then stops them all.
    With `bounded` the others stand in for it as far as they can: the scale is the largest that
    the bounds admit (less a MARGIN), and the norm the least at that scale. It is 0 where no wheel
    can push an axis any further that way, however little is asked of it.

    :param rows: (n, 4), n up to 3.
    :param demand: (n,) A du + b of paper eq. 6 [N m].
    :param mobilities: v (4,), 0 for a wheel that is not used.
    :param lower, upper: (4,) torques that each motor can give now, `lower <= 0 <= upper`, finite
        if `bounded` [N m].
    :param bounded: see above.
    :param torques_out: (4,) torques on the wheels, to be filled in [N m].
    :returns: the scale, from 0 to 1.
    """
    directions, spread, gains, roots = principal_axes(rows, mobilities)
    goal = np.zeros(3)
    rank = 0
    for k in range(demand.size):
        share = _share(gains[k], gains)
        if share > 0.0:
            for n in range(demand.size):
                goal[rank] -= share * directions[k, n] * demand[n]
            spread[rank], gains[rank] = spread[k], gains[k]
            rank += 1
    # From here on in units of the metric, in which the norm is Euclid's.
    x, low, high = np.zeros(4), np.zeros(4), np.zeros(4)
    pinned = np.zeros(4, np.bool_)
    orthogonal = np.empty((3, 4))
    for wheel in range(4):
        if roots[wheel] > 0.0:
            low[wheel], high[wheel] = lower[wheel] / roots[wheel], upper[wheel] / roots[wheel]
    _complete(spread, gains, goal, rank, pinned, x, orthogonal)
    slack = WITHIN * sqrt(_square(x))
    scale = 1.0
    if bounded:
        if _excess(x, low, high) > slack:
            scale = min(largest_scale(spread, goal, rank, low, high, MARGIN), 1.0)
            goal *= scale
            _least_within(spread, gains, goal, rank, low, high, roots, slack * scale, x,
                          orthogonal)
    else:
        for wheel in range(4):
            bound = high[wheel] if x[wheel] > 0.0 else low[wheel]
            if abs(x[wheel]) > abs(bound) + slack:
                scale = min(scale, bound / x[wheel])
        x *= scale
    for wheel in range(4):
        torques_out[wheel] = min(max(roots[wheel] * x[wheel], lower[wheel]), upper[wheel])
    return scale


@kernel
def controllable(rows: Array, mobilities: Array) -> tuple[Array, Array]:
    """
    Tell along which directions of the axes the wheels can push.

    The gains of the directions are the singular values of `rows diag(v / max v)^(1/2)`.

    :param rows: (n, 4), n up to 3.
    :param mobilities: v (4,), 0 for a wheel that is not used.
    :returns: directions (n, n), one a row, orthonormal; and how much of a demand along each is
        met (n,): 1 from a gain of WEAK on, 0 up to LOST, in proportion between.
    """
    directions, _, gains, _ = principal_axes(rows, mobilities)
    shares = np.empty(rows.shape[0])
    for k in range(shares.size):
        shares[k] = _share(gains[k], gains)
    return directions, shares


@kernel
def principal_axes(rows: Array, mobilities: Array) -> tuple[Array, Array, Array, Array]:
    """
    Turn the axes until what the wheels do along one has nothing to do with the others.

    By one-sided Jacobi rotations (M. R. Hestenes, Inversion of matrices by biorthogonalization,
    J. SIAM 6, 1958, p. 51): singular values come out with small relative errors.

    :param rows: (n, 4), n up to 3.
    :param mobilities: v (4,).
    :returns: directions U^T (n, n), one a row; `U^T rows diag(roots)` (3, 4), whose rows are
        orthogonal, zeros below n; its singular values (3,); and roots (4,), `(v / max v)^(1/2)`.
    """
    count = rows.shape[0]
    largest = 0.0
    for wheel in range(4):
        largest = max(largest, mobilities[wheel])
    roots, spread = np.zeros(4), np.zeros((3, 4))
    for wheel in range(4):
        if mobilities[wheel] > USELESS * largest:
            roots[wheel] = sqrt(mobilities[wheel] / largest)
        for k in range(count):
            spread[k, wheel] = rows[k, wheel] * roots[wheel]
    directions, gains = np.eye(count), np.zeros(3)
    # It converges quadratically; three or four sweeps do.
    for _ in range(30):
        turned = False
        for p in range(count - 1):
            for q in range(p + 1, count):
                turned |= _make_orthogonal(spread, directions, p, q)
        if not turned:
            break
    for k in range(count):
        gains[k] = sqrt(_square(spread[k]))
    return directions, spread, gains, roots


@kernel
def _make_orthogonal(spread: Array, directions: Array, p: int, q: int) -> bool:
    """Turn two rows into each other until they are orthogonal; tell whether they were not."""
    pp = pq = qq = 0.0
    for wheel in range(4):
        first, second = spread[p, wheel], spread[q, wheel]
        pp += first * first
        pq += first * second
        qq += second * second
    if abs(pq) <= 1e-15 * sqrt(pp) * sqrt(qq):
        return False
    zeta = (qq - pp) / (2.0 * pq)
    tangent = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + sqrt(1.0 + zeta * zeta))
    cosine = 1.0 / sqrt(1.0 + tangent * tangent)
    sine = cosine * tangent
    for matrix in (spread, directions):
        for column in range(matrix.shape[1]):
            first, second = matrix[p, column], matrix[q, column]
            matrix[p, column] = cosine * first - sine * second
            matrix[q, column] = sine * first + cosine * second
    return True


@kernel
def _share(gain: float, gains: Array) -> float:
    """Return how much of a demand along a direction of this gain is met."""
    if gain <= ROUNDING * max(gains[0], gains[1], gains[2]):
        return 0.0
    return min(max((gain - LOST) / (WEAK - LOST), 0.0), 1.0)


@kernel
def _complete(spread: Array, gains: Array, goal: Array, rank: int, pinned: NDArray[np.bool_],
              x: Array, orthogonal: Array) -> bool:
    """
    Find the torques of the wheels that are not pinned, in place: `spread x = goal`, least norm.

    By modified Gram-Schmidt, and the steps back in the order that keeps the residual small even
    where the rows are almost dependent (A. Bjorck, Numerical methods for least squares problems,
    SIAM 1996, section 2.4).

    :param orthogonal: (3, 4) to work in.
    :returns: False where they cannot meet every goal.
    """
    z0 = z1 = z2 = 0.0
    for k in range(rank):
        rest = goal[k]
        for wheel in range(4):
            if pinned[wheel]:
                rest -= spread[k, wheel] * x[wheel]
                orthogonal[k, wheel] = 0.0
            else:
                orthogonal[k, wheel] = spread[k, wheel]
        for n in range(k):
            along = _dot(orthogonal[k], orthogonal[n])
            for wheel in range(4):
                orthogonal[k, wheel] -= along * orthogonal[n, wheel]
            rest -= along * (z0 if n == 0 else z1)
        size = sqrt(_square(orthogonal[k]))
        if size <= DEPENDENT * gains[k]:
            return False
        for wheel in range(4):
            orthogonal[k, wheel] /= size
        rest /= size
        if k == 0:
            z0 = rest
        elif k == 1:
            z1 = rest
        else:
            z2 = rest
    for wheel in range(4):
        if not pinned[wheel]:
            x[wheel] = 0.0
    for k in range(rank - 1, -1, -1):
        missing = (z0 if k == 0 else z1 if k == 1 else z2) - _dot(orthogonal[k], x)
        for wheel in range(4):
            x[wheel] += missing * orthogonal[k, wheel]
    return True


@kernel
def largest_scale(spread: Array, goal: Array, rank: int, low: Array, high: Array, margin: float
                  ) -> float:
    """
    Return the largest scale at which the bounds admit a goal.

    What wheels within bounds can do to the axes is a zonotope. Each of its facets is spanned by
    the pushes of wheels, and the scale is where the goal leaves through the first of them.

    :param spread: (3, 4) what each wheel does along each direction, of which `rank` count.
    :param goal: (3,), not all zero.
    :param low, high: (4,) bounds, `low <= 0 <= high`.
    :param margin: what is taken off each wheel's push towards a facet, as a share of the
        strongest.
    :returns: `s` of the largest `spread x = s goal`, for a margin of zero.
    """
    if rank == 1:
        return _until_facet(1.0, 0.0, 0.0, spread, goal, low, high, margin)
    scale = inf
    for i in range(4):
        a0, a1, a2 = spread[0, i], spread[1, i], spread[2, i]
        if rank == 2:
            scale = min(scale, _until_facet(a1, -a0, 0.0, spread, goal, low, high, margin))
            continue
        for k in range(i + 1, 4):
            b0, b1, b2 = spread[0, k], spread[1, k], spread[2, k]
            scale = min(scale, _until_facet(
                a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0,
                spread, goal, low, high, margin))
    return scale


@kernel
def _until_facet(n0: float, n1: float, n2: float, spread: Array, goal: Array, low: Array,
                 high: Array, margin: float) -> float:
    """
    Return the scale at which the goal passes the facet with a normal, on the side of the goal.

    :param n0, n1, n2: the normal. One that is of no facet does no harm, it only limits less.
    """
    toward = n0 * goal[0] + n1 * goal[1] + n2 * goal[2]
    size = sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if abs(toward) <= ROUNDING * size * sqrt(_square(goal)):
        return inf
    strongest = 0.0
    for wheel in range(4):
        push = n0 * spread[0, wheel] + n1 * spread[1, wheel] + n2 * spread[2, wheel]
        strongest = max(strongest, abs(push))
    reach = 0.0
    for wheel in range(4):
        push = n0 * spread[0, wheel] + n1 * spread[1, wheel] + n2 * spread[2, wheel]
        counted = abs(push) - max(margin, ROUNDING) * strongest
        if counted > 0.0:
            reach += counted * (high[wheel] if (push > 0.0) == (toward > 0.0) else -low[wheel])
    return float(reach / abs(toward))


@kernel
def _least_within(spread: Array, gains: Array, goal: Array, rank: int, low: Array, high: Array,
                  roots: Array, slack: float, x: Array, orthogonal: Array) -> None:
    """
    Find the torques of least norm within bounds that meet a goal which the bounds admit, in place.

    At the optimum some wheels are at a bound, and the rest is the least norm for what these
    leave over. So it is the least of all torques of that kind that are within the bounds; four
    wheels have few, and nothing can cycle.

    :param slack: by which torques may exceed their bounds through rounding.
    :param orthogonal: (3, 4) to work in.
    """
    trial, pinned = np.zeros(4), np.zeros(4, np.bool_)
    best_excess = best_square = inf
    # One digit to the base of three for each wheel: free, at its lower, at its upper bound.
    for code in range(81):
        rest, left, possible = code, 0, True
        for wheel in range(4):
            digit = rest % 3
            rest //= 3
            pinned[wheel] = digit > 0
            if digit == 0:
                left += 1
                possible &= roots[wheel] > 0.0
            else:
                trial[wheel] = low[wheel] if digit == 1 else high[wheel]
                # A wheel that stands at zero either way is tried once.
                possible &= abs(trial[wheel]) < inf and (digit == 1 or roots[wheel] > 0.0)
        if left < rank or not possible:
            continue
        if not _complete(spread, gains, goal, rank, pinned, trial, orthogonal):
            continue
        excess = max(_excess(trial, low, high) - slack, 0.0)
        square = _square(trial)
        if excess < best_excess or (excess == best_excess and square < best_square):
            best_excess, best_square = excess, square
            for wheel in range(4):
                x[wheel] = trial[wheel]


@kernel
def _excess(x: Array, low: Array, high: Array) -> float:
    """Return by how much torques exceed their bounds at most, 0 or more."""
    excess = 0.0
    for wheel in range(4):
        excess = max(excess, x[wheel] - high[wheel], low[wheel] - x[wheel])
    return excess


@kernel
def _square(vector: Array) -> float:
    return _dot(vector, vector)


@kernel
def _dot(first: Array, second: Array) -> float:
    total = 0.0
    for n in range(first.size):
        total += first[n] * second[n]
    return total
