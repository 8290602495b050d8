# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""From where the links are and should be to the torques of the wheels, in one kernel."""

from __future__ import annotations

from dataclasses import dataclass, field

from fourbar_ros.control.allocation import allocate, controllable, mobilities
from fourbar_ros.control.branch import LINKS_ALONE
from fourbar_ros.control.computed_torque import (
    axes_of,
    BRANCH_A,
    BRANCH_ANGLE,
    BRANCH_B,
    BRANCH_INERTIA,
    BRANCH_RATE,
    demanded,
    HOLD,
    TERMS,
)
from fourbar_ros.control.null_space import null_torques, target_speeds, towards
from fourbar_ros.control.reference_generator import ReferenceGenerator
from fourbar_ros.control.settings import ControllerSettings
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.motors import available_torque, motors_of
import numpy as np
from numpy.typing import NDArray

AXES = ('a', 'b', 'c', 'd')
"""
Axes by the links that they are named after: a and b; where links turn in pairs, the first of each.
"""

# Of what a motor can give, so much is shared out. The loop that follows speeds needs room: in the
# limit it forgets what it has learnt.
SHARED_OUT = {'effort': 0.98, 'velocity': 0.85}

# A wheel is not driven so that it would reach its speed limit sooner than this [s].
HORIZON = 0.1

# Numbers of the law as the kernel takes them.
(STIFFNESS, DAMPING, BAND, COMPENSATED, BRANCH_STIFFNESS, BRANCH_DAMPING, WHEEL_BANDWIDTH,
 STICKING) = range(8)


@dataclass(eq=False)
class Decision:
    """
    What the law decided last; the arrays are written anew at each tick.

    :param torques: (4,) that act on wheels and links alike, bearings apart [N m].
    :param planned: (4,) of these, what the reference alone asks for [N m].
    :param rows: (3, 4) G and, where links turn in pairs, the row of eta.
    :param terms: see axes.
    :param scale: share of what was asked for that the motors can give.
    :param lower, upper: (4,) what they could give [N m].
    """

    torques: Array = field(default_factory=lambda: np.zeros(4))
    planned: Array = field(default_factory=lambda: np.zeros(4))
    rows: Array = field(default_factory=lambda: np.zeros((3, 4)))
    terms: Array = field(default_factory=lambda: np.zeros(TERMS))
    lower: Array = field(default_factory=lambda: np.zeros(4))
    upper: Array = field(default_factory=lambda: np.zeros(4))
    scale: float = 1.0

    @property
    def hold(self) -> float:
        """How much of the hold on the branch there is."""
        return float(self.terms[HOLD])


@kernel
def motor_bounds(speeds: Array, friction: Array, share: float, boxed: NDArray[np.record],
                 lower: Array, upper: Array) -> None:
    """
    Evaluate what the motors can give now, friction of the bearings deducted.

    :param speeds: (4,) relative to the links [rad/s].
    :param friction: (4,) what the bearings take, against the speed [N m].
    :param share: of it that is shared out.
    :param lower, upper: (4,) receive it; zero is always between them [N m].
    """
    motors = boxed[0]
    for j in range(4):
        limit = motors.torque_limit[j]
        low = share * available_torque(j, -limit, speeds[j], motors) - friction[j]
        high = share * available_torque(j, limit, speeds[j], motors) - friction[j]
        gain = motors.inertia[j] / HORIZON
        lower[j] = min(max(low, gain * (-motors.speed_limit[j] - speeds[j])), 0.0)
        upper[j] = max(min(high, gain * (motors.speed_limit[j] - speeds[j])), 0.0)


@kernel
def decide(angles: Array, rates: Array, reference_angles: Array, reference_rates: Array,
           accelerations: Array, disturbance: Array, wanted_speeds: Array, speeds: Array,
           numbers: Array, paired: bool, twins: NDArray[np.int64], boxed: NDArray[np.record],
           mobilities: Array, free_mobilities: Array, bounded: bool, lower: Array, upper: Array,
           rows: Array, terms: Array, torques: Array, planned: Array) -> float:
    """
    Decide on the torques of the wheels.

    :param angles, rates: (4,) of the links, estimated [rad], [rad/s].
    :param reference_angles, reference_rates: (4,) [rad], [rad/s].
    :param accelerations: (4,) of the reference [rad/s^2]; those of the axes count.
    :param disturbance: (2,) torques on links a and b besides those of the wheels [N m].
    :param paired, twins: see axes.axes_of; of links alone, the axes come first in twins.
    :param wanted_speeds: (4,) where the freedom that moves no link leads the wheels [rad/s].
    :param speeds: (4,) of the wheels, absolute [rad/s].
    :param mobilities: (4,) see allocation.
    :param free_mobilities: (4,) likewise, for the freedom that moves no link.
    :param lower, upper: (4,) of the torques [N m].
    :returns: share of what was asked for that the motors can give.
    """
    errors, bias, demand = np.empty((2, 2)), np.empty(3), np.empty(3)
    axes_of(angles, rates, reference_angles, reference_rates, paired, twins, boxed, rows, errors,
            bias, terms)
    acceleration, pushed = np.empty(2), np.zeros(2)
    for axis in range(2):
        acceleration[axis] = accelerations[twins[axis]]
        # Links a and b are on axes of their own, or twins.
        pushed[0 if twins[2] == axis else axis] += numbers[COMPENSATED] * disturbance[axis]
    plain = np.zeros((2, 2))
    demanded(acceleration, plain, 0.0, 0.0, 0.0, np.zeros(2), 0.0, bias, terms, demand)
    allocate(rows[:2], demand[:2], mobilities, lower, upper, False, planned)
    demanded(acceleration, errors, numbers[STIFFNESS], numbers[DAMPING], numbers[BAND],
             pushed, numbers[STICKING], bias, terms, demand)
    usable = 0
    for j in range(4):
        usable += mobilities[j] > 0.0
    hold = terms[HOLD] if usable > 2 else 0.0
    scale = allocate(rows[:2], demand[:2], mobilities, lower, upper, bounded, torques)
    if hold > 0.0:
        present = 0.0
        for j in range(4):
            present += rows[2, j] * torques[j]
        eta = -(numbers[BRANCH_STIFFNESS] * terms[BRANCH_ANGLE]
                + numbers[BRANCH_DAMPING] * terms[BRANCH_RATE])
        asked = demand[2] + terms[BRANCH_INERTIA] * eta
        demand[0] += hold * terms[BRANCH_A] * eta
        demand[1] += hold * terms[BRANCH_B] * eta
        demand[2] = hold * asked - (1.0 - hold) * present
        scale = allocate(rows, demand, mobilities, lower, upper, bounded, torques)
    if numbers[WHEEL_BANDWIDTH] > 0.0:
        free, held = np.zeros(4), np.zeros(4)
        wanted = towards(
            speeds, wanted_speeds, boxed[0].flywheel_inertias, numbers[WHEEL_BANDWIDTH])
        null_torques(rows[:2], free_mobilities, wanted, lower, upper, torques, free)
        if hold > 0.0:
            null_torques(rows, free_mobilities, wanted, lower, upper, torques, held)
        for j in range(4):
            torques[j] += (1.0 - hold) * free[j] + hold * held[j]
    return scale


class TrackingLaw:
    """
    The law with its room to work in.

    :param mechanism: the linkage that the controller believes in.
    :ivar decision: what was decided last.
    :ivar usable: (4,) bool, wheels that may be used; see :meth:`tune`.
    :ivar mobilities: (4,) metric of the allocation, 0 for a wheel that is not used.
    :ivar share: of what the motors can give, that is shared out.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.decision = Decision()
        self.usable = np.ones(4, dtype=bool)
        self.mobilities = np.zeros(4)
        self.share = 1.0
        self._mechanism = mechanism
        self._constants = np.array([mechanism.with_rigid_joints().constants])
        self._motors = np.array([motors_of(mechanism)])
        self._numbers = np.zeros(8)
        self._free_mobilities = np.zeros(4)
        self._bounded = False
        self._twins = LINKS_ALONE
        self._target = 'free'
        self._bias = 0.0
        self._wanted_speeds = np.zeros(4)

    def tune(self, settings: ControllerSettings, usable: NDArray[np.bool_]) -> None:
        """
        Take over gains and the wheels that may be used (4,).

        :raises AllocationError: there is no such allocation.
        """
        inertias = self._mechanism.flywheel_inertias
        self.mobilities = mobilities(settings.allocation, inertias, usable)
        self._free_mobilities = mobilities('min_energy', inertias, usable)
        self._bounded = settings.allocation == 'bounded'
        self.share = SHARED_OUT[settings.command]
        self.usable = usable
        numbers = self._numbers
        numbers[STIFFNESS] = settings.bandwidth ** 2
        numbers[DAMPING] = 2.0 * settings.damping * settings.bandwidth
        numbers[BAND] = settings.rest_band
        numbers[COMPENSATED] = settings.disturbance_compensation
        numbers[BRANCH_STIFFNESS] = settings.branch_bandwidth ** 2
        numbers[BRANCH_DAMPING] = 2.0 * settings.branch_bandwidth
        self._target, self._bias = settings.wheel_target, settings.wheel_bias
        numbers[WHEEL_BANDWIDTH] = settings.wheel_bandwidth if self._target != 'free' else 0.0

    def decide(self, guide: ReferenceGenerator, angles: Array, rates: Array, disturbance: Array,
               wheel_speeds: Array, friction: Array, sticking: float) -> Decision:
        """
        Decide on the torques.

        :param guide: where the links should be.
        :param angles, rates: (4,) of the links, estimated [rad], [rad/s].
        :param disturbance: (2,) torques on links a and b besides those of the wheels [N m].
        :param wheel_speeds: (4,) relative to the links [rad/s].
        :param friction: (4,) that the bearings take [N m].
        :param sticking: from 0, in motion, to 1, at rest; see axes.demanded.
        :returns: the decision, whose arrays are written anew at the next one.
        """
        found, numbers = self.decision, self._numbers
        numbers[STICKING] = sticking
        self._twins = LINKS_ALONE if guide.branch is None else guide.branch.twins
        wanted = self._wanted_speeds
        if self._target in ('zero', 'bias'):
            wanted = target_speeds(self._target, rates, self._bias)
        motor_bounds(
            wheel_speeds, friction, self.share, self._motors, found.lower, found.upper)
        found.scale = decide(
            angles, rates, guide.angles, guide.rates, guide.accelerations, disturbance, wanted,
            wheel_speeds + rates, numbers, guide.paired, self._twins, self._constants,
            self.mobilities, self._free_mobilities, self._bounded, found.lower, found.upper,
            found.rows, found.terms, found.torques, found.planned)
        return found

    @property
    def axes(self) -> NDArray[np.int64]:
        """Return the links after which the axes of the last decision are named (2,)."""
        axes: NDArray[np.int64] = self._twins[:2]
        return axes

    def lost_axes(self) -> list[str]:
        """Name the axes that the wheels can not drive."""
        rows = self.decision.rows[:2]
        directions, shares = controllable(rows, self.mobilities)
        return [AXES[self._twins[int(np.argmax(np.abs(direction)))]]
                for direction, share in zip(directions, shares) if share < 1.0]
