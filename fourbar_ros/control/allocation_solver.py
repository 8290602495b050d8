# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The compiled solver of the control allocation.

Every rule starts from the least norm, the sum of `tau_i^2 / v_i` with the inverse weights `v`. The
rules differ in how they treat bounds: `PROPORTIONAL` scales all torques down together,
`CONSTRAINED` solves for the least norm within the bounds, and `MIN_MAX_SPEED` first tightens the
bounds to the smallest admissible cap on the wheel speeds.

A wheel map has one row per axis and one column per wheel: G of paper eq. 6, and near a change
point the opposite torques as a third row. A wheel that acts on its own axis only has the entry 1.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

from fourbar_ros.control.records import Fields, Record
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

PROPORTIONAL, CONSTRAINED, MIN_MAX_SPEED = range(3)

# Fields of the record that describes a rule to the kernels.
RULE_FIELDS: Fields = [
    ('kind', np.int64, ()),             # PROPORTIONAL, CONSTRAINED or MIN_MAX_SPEED
    ('weights_inv', float, (4,)),       # v, 0 for a wheel that must not be used
    # Of MIN_MAX_SPEED only:
    ('inertias', float, (4,)),          # kg m^2, of the wheels
    ('horizon', float, ()),             # s, time for which the torques are assumed to be held
    ('soft_limits', float, (4,)),       # N m, exceeded only as far as the least norm exceeds them
]

# Singular values of the wheel map between which a demand fades out.
#
# They are relative to a wheel of the largest inverse weight on its own axis. A demand is met in
# full from WEAK on, where torques are up to ten times the demand, and not at all up to LOST. They
# are not relative to the largest singular value, which grows without limit near a change point
# while the other direction stays as good as ever.
WEAK = 0.1
LOST = 0.05

# Wheels with less leverage on a bound than this share of the strongest wheel are ignored.
#
# Otherwise length errors of 1e-6 saturate opposite wheels against each other.
MARGIN = 0.01

# Inverse weights below this share of the largest count as 0: the wheel is not used.
NEGLIGIBLE = 1e-12

# Quantities below this share of their neighbours are rounding errors.
ROUNDING = 1e-12

# Free wheels are linearly dependent when their independent part is below this share.
DEPENDENT = 1e-9

# Excess of a bound, as a share of the norm of all torques, that counts as rounding error.
WITHIN = 1e-10


class MotorState(NamedTuple):
    """
    What the motors can give now.

    :param lower, upper: (4,) bounds of the torques, `lower <= 0 <= upper` [N m].
    :param speeds: (4,) of the wheels, relative to the links [rad/s].
    """

    lower: Array
    upper: Array
    speeds: Array


class Problem(NamedTuple):
    """
    An allocation problem on the principal axes, in units in which the norm is Euclidean.

    :param effectiveness: (3, 4) effect of each wheel on each principal axis; rows are orthogonal.
    :param gains: (3,) norms of these rows, the singular values.
    :param goal: (3,) demand with the sign of the torques.
    :param rank: number of principal axes that count; the rest is undefined.
    :param low, high: (4,) bounds of the torques.
    :param roots: (4,) units of the torques, `(v / max v)^(1/2)`, 0 for a wheel that is not used.
    """

    effectiveness: Array
    gains: Array
    goal: Array
    rank: int
    low: Array
    high: Array
    roots: Array


@kernel
def allocate(rule: Record, wheel_map: Array, demand: Array, motors: MotorState,
             torques_out: Array) -> float:
    """
    Share a demand among the wheels, `wheel_map tau = -scale demand`.

    Demand along a direction that the wheels cannot drive is dropped, see :func:`controllable`.

    :param rule: a record of `RULE_FIELDS`.
    :param wheel_map: (n, 4), n up to 3.
    :param demand: (n,) A du + b of paper eq. 6 [N m].
    :param motors: bounds must be finite for `CONSTRAINED`.
    :param torques_out: (4,) receives the torques on the wheels [N m].
    :returns: the scale, from 0 to 1. It is below 1 where the bounds do not admit the demand; 0
        where no wheel can push an axis any further that way.
    """
    directions, effects, sizes, roots = principal_axes(wheel_map, rule.weights_inv)
    goal, effectiveness, gains = np.zeros(3), np.zeros((3, 4)), np.zeros(3)
    x, low, high = np.zeros(4), np.zeros(4), np.zeros(4)
    strongest = max(sizes[0], sizes[1], sizes[2])
    count = rank = 0
    for lost in (False, True):
        for k in range(demand.size):
            share = _controllability(sizes[k], sizes)
            if lost == (share <= 0.0) and sizes[k] > ROUNDING * strongest:
                for n in range(demand.size):
                    goal[count] -= share * directions[k, n] * demand[n]
                effectiveness[count], gains[count] = effects[k], sizes[k]
                count += 1
        if not lost:
            rank = count
    for wheel in range(4):
        if roots[wheel] > 0.0:
            low[wheel] = motors.lower[wheel] / roots[wheel]
            high[wheel] = motors.upper[wheel] / roots[wheel]
    problem = Problem(effectiveness, gains, goal, rank, low, high, roots)
    _solve_free(problem, np.zeros(4, np.bool_), x, np.empty((3, 4)))
    slack = WITHIN * sqrt(_square(x))
    scale = 1.0
    if rule.kind == PROPORTIONAL:
        for wheel in range(4):
            bound = high[wheel] if x[wheel] > 0.0 else low[wheel]
            if abs(x[wheel]) > abs(bound) + slack:
                scale = min(scale, bound / x[wheel])
        x *= scale
    else:
        exceeded = _excess(x, low, high) > slack
        if exceeded:
            scale = min(largest_scale(problem, MARGIN), 1.0)
            goal *= scale
        if rule.kind == MIN_MAX_SPEED:
            # A null motion of the wheels must not disturb a direction that they cannot drive.
            undisturbed = Problem(
                effectiveness, gains, goal, count, low.copy(), high.copy(), roots)
            _balance(undisturbed, rule, motors.speeds, scale, x)
            _correct(problem, slack * scale, x)
        elif exceeded:
            _solve_within(problem, slack * scale, x)
    for wheel in range(4):
        torques_out[wheel] = min(
            max(roots[wheel] * x[wheel], motors.lower[wheel]), motors.upper[wheel])
    return scale


@kernel
def controllable(wheel_map: Array, weights_inv: Array) -> tuple[Array, Array]:
    """
    Return the directions of the axes along which the wheels can push.

    The gains of the directions are the singular values of `wheel_map diag(v / max v)^(1/2)`.

    :param wheel_map: (n, 4), n up to 3.
    :param weights_inv: v (4,), 0 for a wheel that is not used.
    :returns: directions (n, n), one a row, orthonormal; and the share of a demand along each that
        is met (n,): 1 from a gain of WEAK on, 0 up to LOST, linear between.
    """
    directions, _, gains, _ = principal_axes(wheel_map, weights_inv)
    shares = np.empty(wheel_map.shape[0])
    for k in range(shares.size):
        shares[k] = _controllability(gains[k], gains)
    return directions, shares


@kernel
def principal_axes(wheel_map: Array, weights_inv: Array) -> tuple[Array, Array, Array, Array]:
    """
    Rotate the axes until the effects of the wheels on them are orthogonal.

    One-sided Jacobi rotations (M. R. Hestenes, Inversion of matrices by biorthogonalization,
    J. SIAM 6, 1958, p. 51) give singular values with small relative errors.

    :param wheel_map: (n, 4), n up to 3.
    :param weights_inv: v (4,).
    :returns: directions U^T (n, n), one a row; `U^T wheel_map diag(roots)` (3, 4), whose rows are
        orthogonal, zeros below n; its singular values (3,); and roots (4,), `(v / max v)^(1/2)`.
    """
    count = wheel_map.shape[0]
    largest = 0.0
    for wheel in range(4):
        largest = max(largest, weights_inv[wheel])
    roots, effectiveness = np.zeros(4), np.zeros((3, 4))
    for wheel in range(4):
        if weights_inv[wheel] > NEGLIGIBLE * largest:
            roots[wheel] = sqrt(weights_inv[wheel] / largest)
        for k in range(count):
            effectiveness[k, wheel] = wheel_map[k, wheel] * roots[wheel]
    directions, gains = np.eye(count), np.zeros(3)
    # Convergence is quadratic: three or four sweeps are enough.
    for _ in range(30):
        rotated = False
        for p in range(count - 1):
            for q in range(p + 1, count):
                rotated |= _rotate(effectiveness, directions, p, q)
        if not rotated:
            break
    for k in range(count):
        gains[k] = sqrt(_square(effectiveness[k]))
    return directions, effectiveness, gains, roots


@kernel
def _rotate(effectiveness: Array, directions: Array, p: int, q: int) -> bool:
    """Rotate two rows until they are orthogonal; return whether they were not."""
    pp = pq = qq = 0.0
    for wheel in range(4):
        first, second = effectiveness[p, wheel], effectiveness[q, wheel]
        pp += first * first
        pq += first * second
        qq += second * second
    if abs(pq) <= 1e-15 * sqrt(pp) * sqrt(qq):
        return False
    zeta = (qq - pp) / (2.0 * pq)
    tangent = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + sqrt(1.0 + zeta * zeta))
    cosine = 1.0 / sqrt(1.0 + tangent * tangent)
    sine = cosine * tangent
    for matrix in (effectiveness, directions):
        for column in range(matrix.shape[1]):
            first, second = matrix[p, column], matrix[q, column]
            matrix[p, column] = cosine * first - sine * second
            matrix[q, column] = sine * first + cosine * second
    return True


@kernel
def _controllability(gain: float, gains: Array) -> float:
    """Return the share of a demand along a direction of this gain that is met."""
    if gain <= ROUNDING * max(gains[0], gains[1], gains[2]):
        return 0.0
    return min(max((gain - LOST) / (WEAK - LOST), 0.0), 1.0)


@kernel
def _solve_free(problem: Problem, pinned: NDArray[np.bool_], x: Array, orthogonal: Array) -> bool:
    """
    Solve for the wheels that are not pinned, in place: `effectiveness x = goal`, least norm.

    Modified Gram-Schmidt, and back substitution in the order that keeps the residual small even
    where the rows are almost dependent (A. Bjorck, Numerical methods for least squares problems,
    SIAM 1996, section 2.4).

    :param orthogonal: (3, 4) workspace.
    :returns: False where the free wheels cannot meet every goal.
    """
    effectiveness, rank = problem.effectiveness, problem.rank
    z = np.zeros(3)
    for k in range(rank):
        rest = problem.goal[k]
        for wheel in range(4):
            if pinned[wheel]:
                rest -= effectiveness[k, wheel] * x[wheel]
                orthogonal[k, wheel] = 0.0
            else:
                orthogonal[k, wheel] = effectiveness[k, wheel]
        for n in range(k):
            along = _dot(orthogonal[k], orthogonal[n])
            for wheel in range(4):
                orthogonal[k, wheel] -= along * orthogonal[n, wheel]
            rest -= along * z[n]
        size = sqrt(_square(orthogonal[k]))
        if size <= DEPENDENT * problem.gains[k]:
            return False
        for wheel in range(4):
            orthogonal[k, wheel] /= size
        z[k] = rest / size
    for wheel in range(4):
        if not pinned[wheel]:
            x[wheel] = 0.0
    for k in range(rank - 1, -1, -1):
        missing = z[k] - _dot(orthogonal[k], x)
        for wheel in range(4):
            x[wheel] += missing * orthogonal[k, wheel]
    return True


@kernel
def _solve_within(problem: Problem, slack: float, x: Array) -> None:
    """
    Solve for the least norm within bounds that admit the goal, in place.

    At the optimum some wheels are at a bound, and the others have the least norm for the rest of
    the goal. The optimum is therefore the least of all candidates of that kind that are within
    the bounds. Four wheels have at most 81 candidates, and nothing can cycle.

    :param slack: excess of a bound that counts as rounding error.
    """
    low, high, roots = problem.low, problem.high, problem.roots
    candidate, pinned, orthogonal = np.zeros(4), np.zeros(4, np.bool_), np.empty((3, 4))
    best_excess = best_square = inf
    # One digit to the base of three for each wheel: free, at its lower, at its upper bound.
    for code in range(81):
        rest, free, possible = code, 0, True
        for wheel in range(4):
            digit = rest % 3
            rest //= 3
            pinned[wheel] = digit > 0
            if digit == 0:
                free += 1
                possible &= roots[wheel] > 0.0
            else:
                candidate[wheel] = low[wheel] if digit == 1 else high[wheel]
                # An unused wheel has the same bound twice.
                possible &= abs(candidate[wheel]) < inf and (digit == 1 or roots[wheel] > 0.0)
        if free < problem.rank or not possible:
            continue
        if not _solve_free(problem, pinned, candidate, orthogonal):
            continue
        excess = max(_excess(candidate, low, high) - slack, 0.0)
        square = _square(candidate)
        if excess < best_excess or (excess == best_excess and square < best_square):
            best_excess, best_square = excess, square
            for wheel in range(4):
                x[wheel] = candidate[wheel]


# The set of what bounded wheels can do: facets of a zonotope

@kernel
def _facet_normals(problem: Problem) -> Array:
    """
    Return normals of all facets of the set that bounded wheels reach (m, 3).

    The set is a zonotope; each of its facets is spanned by the effects of `rank - 1` wheels. A
    normal that belongs to no facet does no harm: it is a weaker condition.
    """
    effectiveness, rank = problem.effectiveness, problem.rank
    normals = np.zeros((6, 3))
    if rank == 0:
        return normals[:0]
    if rank == 1:
        normals[0, 0] = 1.0
        return normals[:1]
    count = 0
    for i in range(4):
        a0, a1, a2 = effectiveness[0, i], effectiveness[1, i], effectiveness[2, i]
        if rank == 2:
            normals[count, 0], normals[count, 1] = a1, -a0
            count += 1
            continue
        for k in range(i + 1, 4):
            b0, b1, b2 = effectiveness[0, k], effectiveness[1, k], effectiveness[2, k]
            normals[count, 0] = a1 * b2 - a2 * b1
            normals[count, 1] = a2 * b0 - a0 * b2
            normals[count, 2] = a0 * b1 - a1 * b0
            count += 1
    return normals[:count]


@kernel
def _leverage(normal: Array, problem: Problem, wheel: int) -> float:
    """Return the effect of a wheel along a normal."""
    effectiveness = problem.effectiveness
    return float(normal[0] * effectiveness[0, wheel] + normal[1] * effectiveness[1, wheel]
                 + normal[2] * effectiveness[2, wheel])


@kernel
def largest_scale(problem: Problem, margin: float) -> float:
    """
    Return the largest scale of the goal that the bounds admit, `low <= 0 <= high`.

    :param margin: share of the strongest leverage on a facet that is taken off each wheel's.
    :returns: for a margin of zero, `s` of the largest `effectiveness x = s goal`.
    """
    goal, scale = problem.goal, inf
    for normal in _facet_normals(problem):
        toward = normal[0] * goal[0] + normal[1] * goal[1] + normal[2] * goal[2]
        size = sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
        if abs(toward) <= ROUNDING * size * sqrt(_square(goal)):
            continue
        strongest = 0.0
        for wheel in range(4):
            strongest = max(strongest, abs(_leverage(normal, problem, wheel)))
        reach = 0.0
        for wheel in range(4):
            leverage = _leverage(normal, problem, wheel)
            counted = abs(leverage) - max(margin, ROUNDING) * strongest
            if counted > 0.0:
                reach += counted * (problem.high[wheel] if (leverage > 0.0) == (toward > 0.0)
                                    else -problem.low[wheel])
        scale = min(scale, reach / abs(toward))
    return float(scale)


@kernel
def _balance(problem: Problem, rule: Record, speeds: Array, scale: float, x: Array) -> None:
    """
    Solve within the smallest cap on the wheel speeds, see `MinMaxSpeed`, and tighten the bounds.

    :param scale: of the goal; the least norm is scaled by it.
    :param x: (4,) least norm for the unscaled goal, receives the balanced torques.
    """
    low, high, roots = problem.low, problem.high, problem.roots
    stiffness = np.zeros(4)
    x *= scale
    slack = WITHIN * sqrt(_square(x))
    for wheel in range(4):
        if roots[wheel] > 0.0:
            stiffness[wheel] = rule.inertias[wheel] / (rule.horizon * roots[wheel])
            soft = rule.soft_limits[wheel] / roots[wheel]
            low[wheel] = max(low[wheel], min(-soft, x[wheel]))
            high[wheel] = min(high[wheel], max(soft, x[wheel]))
    cap = smallest_cap(problem, stiffness, speeds)
    for wheel in range(4):
        if roots[wheel] > 0.0:
            rounding = ROUNDING * (cap + abs(speeds[wheel]))
            low[wheel] = max(low[wheel], stiffness[wheel] * (-cap - speeds[wheel] - rounding))
            high[wheel] = min(high[wheel], stiffness[wheel] * (cap - speeds[wheel] + rounding))
    if scale < 1.0 or _excess(x, low, high) > slack:
        _solve_within(problem, slack, x)


@kernel
def _correct(problem: Problem, slack: float, x: Array) -> None:
    """
    Move x in place by the least norm to where it meets the goal within the bounds.

    The speed cap makes a problem whose only solution is a corner, and wheels of very unequal
    weights make it ill-conditioned. The demand comes before the wheel speeds.

    :param slack: distance from the goal that counts as rounding error.
    """
    goal, low, high = problem.goal.copy(), np.empty(4), np.empty(4)
    for wheel in range(4):
        x[wheel] = min(max(x[wheel], problem.low[wheel]), problem.high[wheel])
        low[wheel], high[wheel] = problem.low[wheel] - x[wheel], problem.high[wheel] - x[wheel]
    largest = 0.0
    for k in range(problem.rank):
        goal[k] -= _dot(problem.effectiveness[k], x)
        largest = max(largest, abs(goal[k]) / problem.gains[k])
    if largest > max(slack, ROUNDING * sqrt(_square(x))):
        move = np.zeros(4)
        _solve_within(Problem(problem.effectiveness, problem.gains, goal, problem.rank, low, high,
                              problem.roots), WITHIN * largest, move)
        x += move


@kernel
def smallest_cap(problem: Problem, stiffness: Array, speeds: Array) -> float:
    """
    Return the smallest cap on |speeds| at which the bounds still admit the goal.

    After the horizon wheel i has the speed `speeds_i + x_i / stiffness_i`. A cap bounds x from
    both sides, and the goal is admitted while the support function of the bounds exceeds it along
    every facet normal. Along one normal the support function is piecewise linear, concave and not
    decreasing in the cap, so that Newton's method from below ends at its root after at most
    eight corners.

    :param stiffness: (4,) torque per speed after the horizon.
    :param speeds: (4,) [rad/s].
    :returns: [rad/s].
    """
    cap = 0.0
    for wheel in range(4):
        if problem.roots[wheel] > 0.0:
            cap = max(cap, speeds[wheel] + problem.low[wheel] / stiffness[wheel],
                      -speeds[wheel] - problem.high[wheel] / stiffness[wheel])
    for normal in _facet_normals(problem):
        for side in (1.0, -1.0):
            for _ in range(16):
                lacking, slope = _support(side * normal, problem, stiffness, speeds, cap)
                if slope == 0.0 or lacking <= 1e-13 * cap * slope:
                    break
                cap += lacking / slope
    return cap


@kernel
def _support(normal: Array, problem: Problem, stiffness: Array, speeds: Array, cap: float
             ) -> tuple[float, float]:
    """Return what the goal exceeds the capped support function by, and the slope of that."""
    strongest = 0.0
    for wheel in range(4):
        strongest = max(strongest, abs(_leverage(normal, problem, wheel)))
    lacking, slope, margin = 0.0, 0.0, MARGIN * strongest
    for k in range(problem.rank):
        lacking += normal[k] * problem.goal[k]
    for wheel in range(4):
        if problem.roots[wheel] == 0.0:
            continue
        leverage = _leverage(normal, problem, wheel)
        bound, speed = problem.high[wheel], speeds[wheel]
        if leverage < 0.0:
            bound, speed = -problem.low[wheel], -speed
        capped, counted = stiffness[wheel] * (cap - speed), abs(leverage)
        reached = min(bound, capped)
        if reached >= 0.0 and counted < 2.0 * margin:
            # Little leverage is ignored, without a jump.
            counted = max(2.0 * (counted - margin), 0.0)
        if counted > 0.0:
            lacking -= counted * reached
            if capped < bound:
                slope += counted * stiffness[wheel]
    return lacking, slope


@kernel
def _excess(x: Array, low: Array, high: Array) -> float:
    """Return the largest excess of a bound, 0 or more."""
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
