# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What a planned motion needs of the wheels, and whether the motors can give it.

Along the way, `A du + b` is what the wheels must meet (paper eq. 6). They share it by

    tau = -V G^T (G V G^T)^-1 (A du + b),

the smallest sum of `tau_i^2 / V_i`; mobilities `V = diag(If)^2` make it paper eq. 8, and 0 leaves
a wheel out. Speeds follow from `If (d omega/dt + d Omega/dt) = tau`. On the parallelogram branch
`omega_c = omega_a` and `omega_d = omega_b` at change points too, and so A and b are taken; on
other branches where links turn in pairs likewise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import ceil, inf

from fourbar_ros.control.branch import Branch, branch_at, LINKS_ALONE
from fourbar_ros.control.computed_torque import pair_terms
from fourbar_ros.control.setpoint import (
    angles_along,
    follow,
    SetpointError,
)
from fourbar_ros.control.soft_step import SoftStep, TrajectorySegment
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import ClosureError, FLYWHEEL_NAMES, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import reduced_terms_at
import numpy as np
from numpy.typing import NDArray

# Share of what the motors can give that a plan may use; the rest is for feedback.
SHARE = 0.95

# Instants at which a way is looked at, at least; odd, so that the middle of a step is one.
SAMPLES = 201

# Of the largest demand, what usable wheels may leave unmet: far above rounding.
UNMET = 1e-6

# Of the square of its trace, the determinant of G V G^T below which it counts as singular.
SINGULAR = 1e-12

# Of a limit, far above rounding and far below what anybody would notice.
ROUNDING = 1e-9

# Between these durations the shortest is sought [s].
LEAST_DURATION = 0.1
LONGEST_DURATION = 3600.0

# Step of the scan for it, and how exactly it is found.
SCAN_RATIO = 1.25
RESOLUTION = 1e-3


@dataclass(frozen=True, eq=False)
class Wheels:
    """
    The wheels as they are at the beginning.

    :param speeds: (4,) relative to the links [rad/s].
    :param mobilities: (4,) V: they share for the smallest sum of torque^2 / V, and 0 is a wheel
        that cannot be used. Flywheel inertias squared make it the least wheel accelerations.
    :param extra_torque: (4,) friction that the motor of a wheel that turns has to overcome besides
        [N m].
    :param torque_share: of torques and voltages that a plan may use, None for as much as of the
        speeds.
    """

    speeds: Array
    mobilities: Array
    extra_torque: Array = field(default_factory=lambda: np.zeros(4))
    torque_share: float | None = None


@dataclass(frozen=True, eq=False)
class Needs:
    """
    What a motion needs of the wheels, largest sizes along the way.

    :param peak_speeds: (4,) relative to the links [rad/s].
    :param peak_torques: (4,) of the motors, friction included [N m].
    :param peak_voltages: (4,) at the windings, 0 where these are not described [V].
    :param end_speeds: (4,) with sign, at the end [rad/s].
    :param unmet: share of the largest demand that the usable wheels leave unmet.
    """

    peak_speeds: Array
    peak_torques: Array
    peak_voltages: Array
    end_speeds: Array
    unmet: float


def needs_of(mechanism: Mechanism, way: TrajectorySegment, present: Array, wheels: Wheels,
             branch: Branch | None = None) -> Needs:
    """
    Work out what a motion needs of the wheels.

    :param present: (4,) link angles where it begins, which tell the branch [rad].
    :param branch: as of `setpoint.plan`.
    :raises SetpointError: the loop cannot close on the way.
    """
    times = way.instants(SAMPLES)
    states = way.sample(times)
    branch = branch or branch_at(mechanism, present)
    try:
        angles = angles_along(mechanism, states[:, 0], present, branch)
    except ClosureError as error:
        raise SetpointError(f'on the way there {error}') from None
    torques, gained, unmet = wheel_loads(
        times, angles, states[:, 1:], branch is not None,
        LINKS_ALONE if branch is None else branch.twins,
        np.asarray(wheels.mobilities, dtype=float), np.array([mechanism.constants]))
    speeds = wheels.speeds + gained
    # Friction acts against the wheel; at rest, against where it is about to go.
    direction = np.where(speeds == 0.0, np.sign(torques), np.sign(speeds))
    torques += np.where(wheels.mobilities > 0.0, wheels.extra_torque, 0.0) * direction
    return Needs(np.abs(speeds).max(axis=0), np.abs(torques).max(axis=0),
                 np.abs(_voltages(mechanism, speeds, torques)).max(axis=0), speeds[-1], unmet)


def check_needs(mechanism: Mechanism, way: TrajectorySegment, present: Array, wheels: Wheels, *,
                share: float = SHARE, crossing: bool = False, branch: Branch | None = None
                ) -> Needs:
    """
    Refuse a motion for which the wheels are too weak.

    A wheel that is faster now than its share of the limit may stay as fast, but get no faster.

    :param present: (4,) link angles where it begins [rad].
    :param share: of the limits of the motors that it may use.
    :param crossing: as of `setpoint.follow`, for the shortest duration that is told.
    :param branch: as of `setpoint.plan`.
    :returns: what it needs.
    :raises SetpointError: it needs too much; tells the wheel that lacks most, what it needs, the
        limit and, for a soft step, the shortest duration.
    """
    needs = needs_of(mechanism, way, present, wheels, branch)
    excess, problem = _worst(mechanism, needs, wheels, share)
    if excess <= 1.0 + ROUNDING:
        return needs
    if isinstance(way, SoftStep) and needs.unmet <= UNMET:
        try:
            shortest = shortest_duration(mechanism, way.start, way.goal, present, wheels,
                                         share=share, crossing=crossing, branch=branch)
        except SetpointError as error:
            problem += f'; {error}'
        else:
            # Rounded up, so that it is enough.
            problem += f'; shortest duration is {ceil(shortest * 100.0) / 100.0:g} s'
    raise SetpointError(problem)


def shortest_duration(mechanism: Mechanism, start: Array, goal: Array, present: Array,
                      wheels: Wheels, *, share: float = SHARE, crossing: bool = False,
                      branch: Branch | None = None) -> float:
    """
    Find the least duration for which a soft step keeps the limits of the motors.

    From rest the needs fall as the duration grows, and the answer is the least. From motion they
    need not, since a slow step swings far out: the answer is the first that a scan upwards by
    `SCAN_RATIO` meets, refined, and a narrow window below it may be missed. From motion the way
    depends on the duration, too, and is followed; from rest it does not, and is not.

    :param start: (3, 2) reference angle, rate and acceleration of the axes now, (phi_a, phi_b)
        or those of the branch.
    :param goal: (2,) of the axes [rad].
    :param present: (4,) reference of the link angles now [rad].
    :param share: of the limits of the motors that it may use.
    :param crossing: whether the way may meet change points, as of `setpoint.follow`.
    :param branch: as of `setpoint.plan`.
    :returns: at least `LEAST_DURATION`, not more than `RESOLUTION` of it too long [s].
    :raises SetpointError: no duration up to `LONGEST_DURATION` is enough.
    """
    moving = bool(start[1:].any())

    def excess(duration: float) -> float:
        step = SoftStep(start, goal, duration)
        try:
            if moving:
                follow(mechanism, step, present, crossing=crossing, branch=branch)
            needs = needs_of(mechanism, step, present, wheels, branch)
        except SetpointError:
            return inf
        return _worst(mechanism, needs, wheels, share)[0]

    found = _first_below(excess, LEAST_DURATION, LONGEST_DURATION)
    if found is not None:
        return found
    stored = np.abs(wheels.speeds)
    wheel = int(np.argmax(stored / mechanism.motor_speed_limits))
    if stored[wheel] >= share * mechanism.motor_speed_limits[wheel]:
        raise SetpointError(
            f'more time does not help: {FLYWHEEL_NAMES[wheel]} turns at {stored[wheel]:.4g} rad/s '
            'already, and momentum is not lost')
    raise SetpointError(f'no duration up to {LONGEST_DURATION:g} s is long enough')


def _first_below(excess: Callable[[float], float], least: float, longest: float) -> float | None:
    """Scan upwards for an excess of at most 1, then bisect; None if there is none."""
    low, high = None, least
    while not excess(high) <= 1.0 + ROUNDING:
        if high >= longest:
            return None
        low, high = high, min(high * SCAN_RATIO, longest)
    while low is not None and high > low * (1.0 + RESOLUTION):
        middle = 0.5 * (low + high)
        if excess(middle) <= 1.0 + ROUNDING:
            high = middle
        else:
            low = middle
    return high


def _worst(mechanism: Mechanism, needs: Needs, wheels: Wheels, share: float
           ) -> tuple[float, str]:
    """Return the largest need over its limit, and what to say of it; of no number, infinity."""
    if not needs.unmet <= UNMET:
        usable = [name for name, mobility in zip(FLYWHEEL_NAMES, wheels.mobilities) if mobility]
        return inf, (f'{", ".join(usable) or "no flywheel"} can be used, which leaves '
                     f'{100.0 * needs.unmet:.3g} % of the torque needed unmet')
    worst, problem = 0.0, ''
    of_torque = share if wheels.torque_share is None else wheels.torque_share
    for needed, limits, part, now, unit, word in (
            (needs.peak_speeds, mechanism.motor_speed_limits, share, np.abs(wheels.speeds),
             'rad/s', 'motor'),
            (needs.peak_torques, mechanism.motor_torque_limits, of_torque, np.zeros(4), 'N m',
             'motor'),
            (needs.peak_voltages, mechanism.motor_voltages, of_torque,
             _holding_voltages(mechanism, wheels), 'V', 'supply')):
        ratios = np.nan_to_num(needed / np.maximum(part * limits, now), nan=inf)
        wheel = int(np.argmax(ratios))
        if ratios[wheel] > worst:
            worst = float(ratios[wheel])
            limit = part * limits[wheel]
            of_what = f"{100.0 * part:g} % of the {word}'s {limits[wheel]:.4g} {unit}"
            if now[wheel] > limit:
                limit, of_what = now[wheel], f'what it is now, above {of_what}'
            problem = (f'needs {needed[wheel]:.4g} {unit} on {FLYWHEEL_NAMES[wheel]}, limit '
                       f'{limit:.4g} {unit} ({of_what})')
    return worst, problem


def _voltages(mechanism: Mechanism, speeds: Array, torques: Array) -> Array:
    """
    Evaluate the voltages at the windings: (..., 4) [V].

    `U = R tau / k + k Omega`; a motor gives the torque as long as the supply covers it.
    """
    described = (mechanism.motor_resistances > 0.0) & (mechanism.motor_voltages < inf)
    constants = np.where(described, mechanism.motor_torque_constants, 1.0)
    return np.where(
        described, mechanism.motor_resistances * torques / constants + constants * speeds, 0.0)


def _holding_voltages(mechanism: Mechanism, wheels: Wheels) -> Array:
    return _voltages(mechanism, np.abs(wheels.speeds), wheels.extra_torque)


@kernel
def wheel_loads(times: Array, angles: Array, motion: Array, paired: bool,
                twins: NDArray[np.int64], mobilities: Array, constants: NDArray[np.record]
                ) -> tuple[Array, Array, float]:
    """
    Share the demand along a way among the wheels.

    :param times: (n,) [s].
    :param angles: (n, 4) of the links [rad].
    :param motion: (n, 2, 2) rates and accelerations of the axes [rad/s], [rad/s^2].
    :param paired, twins: see axes.axes_of; of links alone, the axes come first in twins.
    :param mobilities: (4,), 0 where a wheel cannot be used.
    :param constants: (1,) of the mechanism.
    :returns: (n, 4) torques [N m]; (n, 4) what the wheels gain in speed relative to their links
        [rad/s]; the share of the largest demand that is not met.
    """
    count = times.size
    inertias = constants[0].flywheel_inertias
    torques, gained = np.zeros((count, 4)), np.zeros((count, 4))
    link_rates = np.empty((count, 4))
    share = np.empty(2)
    largest = unmet = 0.0
    wheel_map = np.zeros((4, 2))
    for axis in range(2):
        wheel_map[twins[axis], axis] = wheel_map[twins[axis + 2], axis] = 1.0
    for n in range(count):
        if not paired:
            a00, a01, a11, b0, b1, g1, g2, g3, g4, _, _ = reduced_terms_at(
                angles[n], motion[n, 0], constants[0])
            wheel_map[2, 0], wheel_map[2, 1], wheel_map[3, 0], wheel_map[3, 1] = g1, g2, g3, g4
        for wheel in range(4):
            link_rates[n, wheel] = (wheel_map[wheel, 0] * motion[n, 0, 0]
                                    + wheel_map[wheel, 1] * motion[n, 0, 1])
        if paired:
            _, _, a00, a01, a11, b0, b1 = pair_terms(
                angles[n], (link_rates[n, 0], link_rates[n, 1], link_rates[n, 2],
                            link_rates[n, 3]), twins, constants[0])
        demand_a = a00 * motion[n, 1, 0] + a01 * motion[n, 1, 1] + b0
        demand_b = a01 * motion[n, 1, 0] + a11 * motion[n, 1, 1] + b1
        _solve_shares(wheel_map, mobilities, demand_a, demand_b, share)
        left_a, left_b = demand_a, demand_b
        for wheel in range(4):
            first, second = wheel_map[wheel, 0], wheel_map[wheel, 1]
            torque = -mobilities[wheel] * (first * share[0] + second * share[1])
            torques[n, wheel] = torque
            left_a += first * torque
            left_b += second * torque
        largest = max(largest, abs(demand_a), abs(demand_b))
        unmet = max(unmet, abs(left_a), abs(left_b))
    for wheel in range(4):
        driven = 0.0
        for n in range(1, count):
            # The trapezoid for a smooth torque; what the link turns is exact.
            driven += 0.5 * (times[n] - times[n - 1]) * (
                torques[n - 1, wheel] + torques[n, wheel]) / inertias[wheel]
            gained[n, wheel] = driven - link_rates[n, wheel] + link_rates[0, wheel]
    return torques, gained, unmet / largest if largest > 0.0 else 0.0


@kernel
def _solve_shares(wheel_map: Array, mobilities: Array, demand_a: float, demand_b: float,
                  share: Array) -> None:
    """Solve G V G^T share = demand; by the pseudo-inverse where wheels do not reach both axes."""
    n00 = n01 = n11 = 0.0
    for wheel in range(4):
        first, second = wheel_map[wheel, 0], wheel_map[wheel, 1]
        n00 += mobilities[wheel] * first * first
        n01 += mobilities[wheel] * first * second
        n11 += mobilities[wheel] * second * second
    determinant, trace = n00 * n11 - n01 * n01, n00 + n11
    if determinant > SINGULAR * trace * trace:
        share[0] = (n11 * demand_a - n01 * demand_b) / determinant
        share[1] = (n00 * demand_b - n01 * demand_a) / determinant
    elif trace > 0.0:
        # Of rank one, N = trace w w^T.
        share[0] = (n00 * demand_a + n01 * demand_b) / (trace * trace)
        share[1] = (n01 * demand_a + n11 * demand_b) / (trace * trace)
    else:
        share[0] = share[1] = 0.0
