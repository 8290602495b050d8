# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Loop closure: `l_b e(phi_b) + l_c e(phi_c) = l_a e(phi_a) + l_d e(phi_d)` and its two branches.

For given (phi_a, phi_b) joint 3 lies on either side of the diagonal from joint 2 to joint 4. The
assembly is *open* where joints 1 and 3 are on opposite sides of it, *crossed* where they are on
the same side. Along a motion the side of joint 3, `sign(sin(phi_d - phi_c))`, can change only
where c and d fold onto a line (a change point).
"""

from __future__ import annotations

from math import acos, atan2, cos, hypot, isfinite, pi, sin
from operator import itemgetter

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism.angles import wrap
from fourbar_ros.mechanism.change_points import FOLDED_SINE
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.mechanism import LINK_NAMES, Mechanism
import numpy as np
from numpy.typing import ArrayLike

BRANCHES = ('open', 'crossed')

# Sign of each link in the closure written as a sum that vanishes.
SIGNS = (-1.0, 1.0, 1.0, -1.0)

# Largest closure error of a state, relative to the longest link, and of its rate per second: far
# above rounded digits, far below any real mistake.
TOLERANCE = 1e-6


class ClosureError(FourbarError):
    """Link angles that the linkage cannot take."""


def closure_error(mechanism: Mechanism, link_angles: ArrayLike) -> float:
    """
    Evaluate the gap at joint 3.

    :param link_angles: (4,) [rad].
    :returns: distance between the two ends that joint 3 should join [m].
    """
    angles = np.asarray(link_angles, dtype=float)
    arms = np.array(SIGNS) * mechanism.link_lengths
    return hypot(float(arms @ np.cos(angles)), float(arms @ np.sin(angles)))


def branch_of(link_angles: ArrayLike) -> str:
    """
    Return the assembly of the linkage.

    A third one exists where l_a = l_b and l_c = l_d: joint 4 lies on joint 2, and the links turn
    as two pairs, a with b and c with d.

    :param link_angles: (4,) [rad].
    :returns: `open`, `crossed` or `folded`; exactly on a change point, where they meet, `open`.
    """
    a, b, c, d = np.asarray(link_angles, dtype=float)
    if abs(sin(b - a)) < FOLDED_SINE and abs(sin(d - c)) < FOLDED_SINE:
        return 'folded' if abs(sin(c - a)) > FOLDED_SINE else 'open'
    return 'crossed' if sin(b - a) * sin(d - c) < 0.0 else 'open'


def check_branch(branch: str) -> None:
    """
    Refuse an assembly that `assemble` does not know.

    :raises ClosureError: neither `open` nor `crossed`.
    """
    if branch not in BRANCHES:
        raise ClosureError(f'unknown branch {branch!r} (known are {", ".join(BRANCHES)})',
                           name='branch', value=branch, limit=BRANCHES)


def check_motion(mechanism: Mechanism, link_angles: ArrayLike, link_rates: ArrayLike) -> None:
    """
    Refuse a state that the linkage cannot be in.

    :param link_angles: (4,) [rad].
    :param link_rates: (4,) [rad/s].
    :raises ClosureError: a value is not finite, the loop is open by more than `TOLERANCE` of the
        longest link, or opens faster than that per second.
    """
    angles, rates = (np.asarray(values, dtype=float) for values in (link_angles, link_rates))
    for name, values, unit in (('angle', angles, 'rad'), ('rate', rates, 'rad/s')):
        if not np.isfinite(values).all():
            n = int(np.argmin(np.isfinite(values)))
            raise ClosureError(
                f'the {name} of {LINK_NAMES[n]} must be finite, got {values[n]} {unit}',
                name=f'link_{name}s.{LINK_NAMES[n]}', value=float(values[n]))
    limit = TOLERANCE * float(mechanism.link_lengths.max())
    gap = closure_error(mechanism, angles)
    if gap > limit:
        raise ClosureError(
            f'the link angles do not close the loop: gap {gap:.3g} m, limit {limit:.3g} m',
            name='link_angles', value=gap, limit=limit)
    arms = np.array(SIGNS) * mechanism.link_lengths * rates
    slip = hypot(float(arms @ np.sin(angles)), float(arms @ np.cos(angles)))
    if slip > limit:
        raise ClosureError(
            f'the link rates do not keep the loop closed: joint 3 would open at {slip:.3g} m/s, '
            f'limit {limit:.3g} m/s', name='link_rates', value=slip, limit=limit)


def assemble(
    mechanism: Mechanism, phi_a: float, phi_b: float, branch: str = 'open',
) -> Array:
    """
    Evaluate the four link angles from two and the branch.

    :param phi_a: orientation of link a [rad].
    :param phi_b: orientation of link b [rad].
    :param branch: `open` or `crossed`.
    :returns: (4,) link angles [rad], c and d in (-pi, pi].
    :raises ClosureError: unknown branch, or the loop cannot close at this configuration.
    """
    check_branch(branch)
    solutions = solve_pair(mechanism, (0, 1), (phi_a, phi_b))
    for solution in solutions:
        if branch_of(solution) == branch:
            return solution
    return solutions[0]     # on a change point the two are one


def nearest_assembly(
    mechanism: Mechanism, known: tuple[int, int], angles: tuple[float, float], near: ArrayLike,
) -> Array:
    """
    Complete two link angles to four, on the branch nearest to other angles.

    Returns the first result of :func:`assemblies`, with the same parameters and errors.
    """
    return assemblies(mechanism, known, angles, near)[0]


def assemblies(
    mechanism: Mechanism, known: tuple[int, int], angles: tuple[float, float], near: ArrayLike,
) -> list[Array]:
    """
    Complete two link angles to four, on both branches.

    :param known: indices of the two known links (0 for link a).
    :param angles: their orientations [rad].
    :param near: (4,) link angles [rad]. The two other angles are continuous with them, not
        wrapped.
    :returns: two arrays (4,) of link angles, the one nearer to `near` first [rad].
    :raises ClosureError: the loop cannot close, or the two links do not determine it.
    """
    # Plain numbers: arrays of four cost ten times as much, and this is called at every tick.
    reference: list[float] = np.asarray(near, dtype=float).tolist()
    completed = []
    for solution in _solve_pair(mechanism, known, angles):
        result = [begin + wrap(angle - begin) for angle, begin in zip(solution, reference)]
        for link, angle in zip(known, angles):
            result[link] = float(angle)
        a, b, c, d = (abs(angle - begin) for angle, begin in zip(result, reference))
        completed.append((a + b + c + d, result))
    completed.sort(key=itemgetter(0))
    return [np.array(result) for _, result in completed]


def assemble_along(mechanism: Mechanism, phi_a: Array, phi_b: Array, start: ArrayLike) -> Array:
    """
    Follow the linkage along a path of two link angles, joint 3 staying on its side.

    :param phi_a, phi_b: (n,) the path [rad].
    :param start: (4,) link angles where it begins [rad].
    :returns: (n, 4) link angles, continuous with the start [rad].
    :raises ClosureError: the loop cannot close somewhere on the path.
    """
    begin = np.asarray(start, dtype=float)
    l_a, l_b, l_c, l_d = mechanism.link_lengths
    # From joint 2 to joint 4: l_c e_c - l_d e_d.
    gap_x = l_a * np.cos(phi_a) - l_b * np.cos(phi_b)
    gap_y = l_a * np.sin(phi_a) - l_b * np.sin(phi_b)
    gap = np.hypot(gap_x, gap_y)
    short, long = abs(l_c - l_d), l_c + l_d
    open_loop = (gap < short * (1.0 - 1e-12)) | (gap > long * (1.0 + 1e-12)) | (gap == 0.0)
    if open_loop.any():
        n = int(np.argmax(open_loop))
        raise ClosureError(
            f'the loop cannot close at link_a = {phi_a[n]:.4f} rad and link_b = {phi_b[n]:.4f} '
            f'rad: link_c and link_d reach {short:g} to {long:g} m, needed are {gap[n]:g} m',
            value=float(gap[n]), limit=(float(short), float(long)))
    side = 1.0 if sin(begin[3] - begin[2]) >= 0.0 else -1.0
    cosine = (gap * gap + l_c * l_c - l_d * l_d) / (2.0 * gap * l_c)
    phi_c = np.arctan2(gap_y, gap_x) + side * np.arccos(np.clip(cosine, -1.0, 1.0))
    phi_d = np.arctan2(l_c * np.sin(phi_c) - gap_y, l_c * np.cos(phi_c) - gap_x)
    path = np.vstack([begin, np.column_stack([phi_a, phi_b, phi_c, phi_d])])
    followed: Array = np.unwrap(path, axis=0)[1:]
    followed[:, 0], followed[:, 1] = phi_a, phi_b
    return followed


def solve_pair(
    mechanism: Mechanism, known: tuple[int, int], angles: tuple[float, float],
) -> list[Array]:
    """
    Evaluate both solutions for the two other link angles.

    :param known: indices of the two known links (0 for link a).
    :param angles: their orientations [rad].
    :returns: two arrays (4,) of link angles [rad], those of the other links in (-pi, pi].
    :raises ClosureError: the loop cannot close, or the two links do not determine it.
    """
    return [np.array(solution) for solution in _solve_pair(mechanism, known, angles)]


def _solve_pair(
    mechanism: Mechanism, known: tuple[int, int], angles: tuple[float, float],
) -> list[list[float]]:
    i, j = known
    k, m = (index for index in range(4) if index not in known)
    lengths: list[float] = mechanism.link_lengths.tolist()
    if not (isfinite(angles[0]) and isfinite(angles[1])):
        raise ClosureError(f'link angles must be finite, got {angles[0]} and {angles[1]}',
                           name='link_angles', value=angles)
    # s_k l_k e_k + s_m l_m e_m = gap: a triangle with sides l_k, l_m and the gap.
    arm_i, arm_j = SIGNS[i] * lengths[i], SIGNS[j] * lengths[j]
    gap_x = -(arm_i * cos(angles[0]) + arm_j * cos(angles[1]))
    gap_y = -(arm_i * sin(angles[0]) + arm_j * sin(angles[1]))
    gap = hypot(gap_x, gap_y)
    side_k, side_m = lengths[k], lengths[m]
    if gap < 1e-9 * (side_k + side_m):
        raise ClosureError(f'{_named(known, angles)} do not determine the configuration',
                           undetermined=tuple(LINK_NAMES[link] for link in known))
    cosine = (gap * gap + side_k * side_k - side_m * side_m) / (2.0 * gap * side_k)
    if abs(cosine) > 1.0 + 1e-12:
        limit = abs(side_k - side_m), side_k + side_m
        raise ClosureError(
            f'the loop cannot close at {_named(known, angles)}: {LINK_NAMES[k]} and '
            f'{LINK_NAMES[m]} reach {limit[0]:g} to {limit[1]:g} m, needed are {gap:g} m',
            value=gap, limit=limit)
    spread = acos(max(-1.0, min(1.0, cosine)))
    solutions = []
    for side in (1.0, -1.0):
        direction = atan2(gap_y, gap_x) + side * spread
        # The sign of link k in the closure turns its arm around.
        phi_k = direction if SIGNS[k] > 0 else direction + pi
        rest_x = (gap_x - side_k * cos(direction)) * SIGNS[m]
        rest_y = (gap_y - side_k * sin(direction)) * SIGNS[m]
        solution = [0.0] * 4
        solution[i], solution[j] = float(angles[0]), float(angles[1])
        solution[k] = wrap(phi_k)
        solution[m] = wrap(atan2(rest_y, rest_x))
        solutions.append(solution)
    return solutions


def _named(known: tuple[int, int], angles: tuple[float, float]) -> str:
    """Return two known link angles as text."""
    return ' and '.join(f'{LINK_NAMES[link]} = {angle:.4f} rad'
                        for link, angle in zip(known, angles))
