# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Feasibility of a planned motion: the speeds, torques and voltages that it needs, and the limits.

Along the path the wheels must meet `A du + b` (paper eq. 6). The rule of the allocation shares
this demand without bounds; speeds follow from `If (d omega/dt + d Omega/dt) = tau`. On the
parallelogram branch `omega_c = omega_a` and `omega_d = omega_b` also at change points, where A
and b are evaluated on the pairs; likewise on other branches where links turn in pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import ceil, inf
from typing import NamedTuple

from fourbar_ros.control.allocation import Allocation
from fourbar_ros.control.allocation_solver import allocate, MotorState
from fourbar_ros.control.branch import Branch, branch_at, UNPAIRED_AXES
from fourbar_ros.control.computed_torque import pair_terms
from fourbar_ros.control.setpoint import angles_along, follow_path, SetpointError
from fourbar_ros.control.soft_step import SoftStep, TrajectorySegment
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import ClosureError, FLYWHEEL_NAMES, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import reduced_terms_at
import numpy as np
from numpy.typing import NDArray

# Share of the motor limits that a plan may use; the rest is for feedback.
SHARE = 0.95

# Smallest number of instants at which a path is evaluated; odd, to include its middle.
SAMPLES = 201

# Share of the largest demand that usable wheels may leave unmet: far above rounding errors.
UNMET = 1e-6

# Share of a limit that is far above rounding errors and far below what can be measured.
ROUNDING = 1e-9

# Range in which the shortest duration is searched [s], that of `setpoint_duration`.
LEAST_DURATION = 0.1
LONGEST_DURATION = 3600.0

# Ratio of two durations of the scan, and relative resolution of the bisection after it.
SCAN_RATIO = 1.25
RESOLUTION = 1e-3


@dataclass(frozen=True, eq=False)
class Wheels:
    """
    State of the wheels at the start of a motion.

    :param speeds: (4,) relative to the links [rad/s].
    :param allocation: the rule that shares the demand, with the wheels that it may use.
    :param extra_torque: (4,) friction that the motor of a turning wheel must overcome [N m].
    :param torque_share: share of the torque and voltage limits that a plan may use, None for the
        same share as of the speed limits.
    """

    speeds: Array
    allocation: Allocation
    extra_torque: Array = field(default_factory=lambda: np.zeros(4))
    torque_share: float | None = None


@dataclass(frozen=True, eq=False)
class Needs:
    """
    Needs of a motion: largest magnitudes along the path.

    :param peak_speeds: (4,) relative to the links [rad/s].
    :param peak_torques: (4,) of the motors, friction included [N m].
    :param peak_voltages: (4,) at the windings, 0 where the mechanism file does not describe them
        [V].
    :param end_speeds: (4,) with sign, at the end [rad/s].
    :param unmet: share of the largest demand that the usable wheels leave unmet.
    """

    peak_speeds: Array
    peak_torques: Array
    peak_voltages: Array
    end_speeds: Array
    unmet: float


class Path(NamedTuple):
    """
    A planned motion at n instants.

    :param times: (n,) [s].
    :param angles: (n, 4) of the links [rad].
    :param motion: (n, 2, 2) rates and accelerations of the axes [rad/s], [rad/s^2].
    :param paired: whether links turn in pairs.
    :param paired_links: (4,) see `Branch`; without pairs the first two are the axes.
    """

    times: Array
    angles: Array
    motion: Array
    paired: bool
    paired_links: NDArray[np.int64]


def path_of(mechanism: Mechanism, segment: TrajectorySegment, present: Array,
            branch: Branch | None = None, samples: int = SAMPLES) -> Path:
    """
    Sample a planned motion.

    :param present: (4,) link angles at its start, which determine the branch [rad].
    :param branch: of the motion, by default that of `present`, see `setpoint.plan`.
    :param samples: smallest number of instants.
    :raises ClosureError: the loop cannot close on the path.
    """
    times = segment.instants(samples)
    states = segment.sample(times)
    branch = branch or branch_at(mechanism, present)
    angles = angles_along(mechanism, states[:, 0], present, branch)
    return Path(times, angles, states[:, 1:], branch is not None,
                UNPAIRED_AXES if branch is None else branch.paired_links)


def loads_along(mechanism: Mechanism, path: Path, allocation: Allocation, speeds: Array
                ) -> tuple[Array, Array, float]:
    """
    Share the demand along a path among the wheels, without bounds.

    :param speeds: (4,) of the wheels at its start, relative to the links [rad/s].
    :returns: torques on the wheels (n, 4) [N m]; gain of their speed relative to the links (n, 4)
        [rad/s]; the share of the largest demand that is not met.
    """
    rule = allocation.for_plan(float(np.diff(path.times).max()), mechanism.motor_torque_limits)
    torques, gained, unmet = _loads_along(
        path, rule.rule, np.asarray(speeds, dtype=float), np.array([mechanism.constants]))
    return torques, gained, unmet


def needs_of(mechanism: Mechanism, segment: TrajectorySegment, present: Array, wheels: Wheels,
             branch: Branch | None = None) -> Needs:
    """
    Evaluate the needs of a motion.

    :param present, branch: see :func:`path_of`.
    :raises SetpointError: the loop cannot close on the path.
    """
    try:
        path = path_of(mechanism, segment, present, branch)
    except ClosureError as error:
        raise SetpointError(
            f'on the path {error}', **{'name': 'closure', **error.values}) from None
    torques, gained, unmet = loads_along(mechanism, path, wheels.allocation, wheels.speeds)
    speeds = wheels.speeds + gained
    # Friction acts against the speed; at rest, against the motion that is about to start.
    direction = np.where(speeds == 0.0, np.sign(torques), np.sign(speeds))
    torques += np.where(
        wheels.allocation.weights_inv > 0.0, wheels.extra_torque, 0.0) * direction
    return Needs(np.abs(speeds).max(axis=0), np.abs(torques).max(axis=0),
                 np.abs(_voltages(mechanism, speeds, torques)).max(axis=0), speeds[-1], unmet)


def check_needs(mechanism: Mechanism, segment: TrajectorySegment, present: Array, wheels: Wheels,
                *, share: float = SHARE, crossing: bool = False, branch: Branch | None = None
                ) -> Needs:
    """
    Refuse a motion that needs more than the motors can give.

    A wheel that is faster now than its share of the limit may stay as fast, but get no faster.

    :param present, branch: see :func:`path_of`.
    :param share: share of the motor limits that the motion may use.
    :param crossing: see `setpoint.follow_path`; for the shortest duration in the message.
    :raises SetpointError: it needs too much. `values`: `name` of the wheel that lacks most, its
        `value` and `limit`, and for a soft step the shortest `duration` [s].
    """
    needs = needs_of(mechanism, segment, present, wheels, branch)
    excess, problem, values = _worst(mechanism, needs, wheels, share)
    if excess <= 1.0 + ROUNDING:
        return needs
    if isinstance(segment, SoftStep) and needs.unmet <= UNMET:
        try:
            shortest = shortest_duration(mechanism, segment, present, wheels, share=share,
                                         crossing=crossing, branch=branch)
        except SetpointError as error:
            problem += f'; {error}'
        else:
            # Rounded up, so that the setpoint with this duration is accepted.
            values['duration'] = ceil(shortest * 100.0) / 100.0
            problem += f'; shortest duration is {values["duration"]:g} s'
    raise SetpointError(problem, **values)


def shortest_duration(mechanism: Mechanism, step: SoftStep, present: Array, wheels: Wheels, *,
                      share: float = SHARE, crossing: bool = False, branch: Branch | None = None
                      ) -> float:
    """
    Find the least duration for which a soft step keeps the limits of the motors.

    From rest the needs fall as the duration grows, and the result is the least. From motion they
    need not fall, since a slow step swings far out: the result is the first that a scan upwards
    by `SCAN_RATIO` meets, refined, and a narrow window below it may be missed. From motion the
    path depends on the duration and is followed for each; from rest it does not.

    :param step: start and goal; its duration is ignored.
    :param present, branch: see :func:`path_of`.
    :param share: share of the motor limits that the motion may use.
    :param crossing: whether the path may meet change points, see `setpoint.follow_path`.
    :returns: at least `LEAST_DURATION`, at most `RESOLUTION` of it too long [s].
    :raises SetpointError: no duration up to `LONGEST_DURATION` is enough.
    """
    moving = bool(step.start[1:].any())

    def excess(duration: float) -> float:
        timed = SoftStep(step.start, step.goal, duration)
        try:
            if moving:
                follow_path(mechanism, timed, present, crossing=crossing, branch=branch)
            needs = needs_of(mechanism, timed, present, wheels, branch)
        except SetpointError:
            return inf
        return _worst(mechanism, needs, wheels, share)[0]

    shortest = _first_below(excess, LEAST_DURATION, LONGEST_DURATION)
    if shortest is not None:
        return shortest
    speeds, limits = np.abs(wheels.speeds), mechanism.motor_speed_limits
    wheel = int(np.argmax(speeds / limits))
    if speeds[wheel] >= share * limits[wheel]:
        name = FLYWHEEL_NAMES[wheel]
        raise SetpointError(
            f'no duration is long enough: {name} is near its speed limit ({speeds[wheel]:.4g} of '
            f'{limits[wheel]:.4g} rad/s); reverse the manoeuvre to unload it',
            name=name, value=float(speeds[wheel]), limit=float(limits[wheel]))
    raise SetpointError(f'no duration up to {LONGEST_DURATION:g} s is long enough',
                        limit=LONGEST_DURATION)


def _first_below(excess: Callable[[float], float], least: float, longest: float) -> float | None:
    """Scan upwards for an excess of at most 1, then bisect; return None without one."""
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
           ) -> tuple[float, str, dict[str, object]]:
    """Return the largest ratio of a need to its limit (inf for NaN), its message and values."""
    if not needs.unmet <= UNMET:
        usable = [name for name, weight in zip(FLYWHEEL_NAMES, wheels.allocation.weights_inv)
                  if weight]
        return inf, (f'{", ".join(usable) or "no flywheel"} can be used, which leaves '
                     f'{100.0 * needs.unmet:.3g} % of the torque needed unmet'), {
                         'usable': usable, 'value': needs.unmet, 'limit': UNMET}
    worst, problem, values = 0.0, '', {}
    of_torque = share if wheels.torque_share is None else wheels.torque_share
    for needed, limits, part, now, unit, source in (
            (needs.peak_speeds, mechanism.motor_speed_limits, share, np.abs(wheels.speeds),
             'rad/s', 'motor'),
            (needs.peak_torques, mechanism.motor_torque_limits, of_torque, np.zeros(4), 'N m',
             'motor'),
            (needs.peak_voltages, mechanism.motor_voltages, of_torque,
             _voltages(mechanism, np.abs(wheels.speeds), wheels.extra_torque), 'V', 'supply')):
        ratios = np.nan_to_num(needed / np.maximum(part * limits, now), nan=inf)
        wheel = int(np.argmax(ratios))
        if ratios[wheel] > worst:
            worst, name = float(ratios[wheel]), FLYWHEEL_NAMES[wheel]
            limit = part * limits[wheel]
            origin = f"{100.0 * part:g} % of the {source}'s {limits[wheel]:.4g} {unit}"
            if now[wheel] > limit:
                limit, origin = now[wheel], f'its present value, above {origin}'
            problem = (f'needs {needed[wheel]:.4g} {unit} on {name}, limit {limit:.4g} {unit} '
                       f'({origin})')
            values = {'name': name, 'value': float(needed[wheel]), 'limit': float(limit)}
    return worst, problem, values


def _voltages(mechanism: Mechanism, speeds: Array, torques: Array) -> Array:
    """
    Evaluate the voltages at the windings: (..., 4) [V].

    `U = R tau / k + k Omega`; a motor gives the torque while the supply covers this voltage.
    """
    described = (mechanism.motor_resistances > 0.0) & (mechanism.motor_voltages < inf)
    constants = np.where(described, mechanism.motor_torque_constants, 1.0)
    return np.where(
        described, mechanism.motor_resistances * torques / constants + constants * speeds, 0.0)


@kernel
def _loads_along(path: Path, rule: NDArray[np.record], start_speeds: Array,
                 constants: NDArray[np.record]) -> tuple[Array, Array, float]:
    """See :func:`loads_along`."""
    times, angles, motion, links = path.times, path.angles, path.motion, path.paired_links
    count = times.size
    inertias = constants[0].flywheel_inertias
    torques, gained = np.zeros((count, 4)), np.zeros((count, 4))
    link_rates, driven = np.empty((count, 4)), np.zeros(4)
    demand, wheel_map = np.empty(2), np.zeros((2, 4))
    motors = MotorState(np.full(4, -inf), np.full(4, inf), start_speeds.copy())
    largest = unmet = 0.0
    for axis in range(2):
        wheel_map[axis, links[axis]] = wheel_map[axis, links[axis + 2]] = 1.0
    for n in range(count):
        if not path.paired:
            a00, a01, a11, b0, b1, g1, g2, g3, g4, _, _ = reduced_terms_at(
                angles[n], motion[n, 0], constants[0])
            wheel_map[0, 2], wheel_map[1, 2], wheel_map[0, 3], wheel_map[1, 3] = g1, g2, g3, g4
        for wheel in range(4):
            link_rates[n, wheel] = (wheel_map[0, wheel] * motion[n, 0, 0]
                                    + wheel_map[1, wheel] * motion[n, 0, 1])
        if path.paired:
            _, _, a00, a01, a11, b0, b1 = pair_terms(
                angles[n], (link_rates[n, 0], link_rates[n, 1], link_rates[n, 2],
                            link_rates[n, 3]), links, constants[0])
        demand[0] = a00 * motion[n, 1, 0] + a01 * motion[n, 1, 1] + b0
        demand[1] = a01 * motion[n, 1, 0] + a11 * motion[n, 1, 1] + b1
        if n > 0:
            step = times[n] - times[n - 1]
            # Predicted with the last torque, for rules that depend on the speeds.
            for wheel in range(4):
                motors.speeds[wheel] = (
                    start_speeds[wheel]
                    + driven[wheel] + step * torques[n - 1, wheel] / inertias[wheel]
                    - link_rates[n, wheel] + link_rates[0, wheel])
        allocate(rule[0], wheel_map, demand, motors, torques[n])
        left_a, left_b = demand[0], demand[1]
        for wheel in range(4):
            torque = torques[n, wheel]
            left_a += wheel_map[0, wheel] * torque
            left_b += wheel_map[1, wheel] * torque
            if n > 0:
                # The trapezoid for a smooth torque; the change of the link's rate is exact.
                driven[wheel] += 0.5 * (times[n] - times[n - 1]) * (
                    torques[n - 1, wheel] + torque) / inertias[wheel]
                gained[n, wheel] = driven[wheel] - link_rates[n, wheel] + link_rates[0, wheel]
        largest = max(largest, abs(demand[0]), abs(demand[1]))
        unmet = max(unmet, abs(left_a), abs(left_b))
    return torques, gained, unmet / largest if largest > 0.0 else 0.0
