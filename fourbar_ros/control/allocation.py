# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Control allocation: rules that share the demand of the axes among the four wheels.

The tracking law, the feasibility check and the studies use one protocol, :class:`Allocation`, and
one compiled solver, :func:`~fourbar_ros.control.allocation_solver.allocate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from typing import ClassVar, Protocol

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control.allocation_solver import (
    allocate,
    CONSTRAINED,
    MIN_MAX_SPEED,
    MotorState,
    PROPORTIONAL,
    RULE_FIELDS,
)
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array, record
import numpy as np
from numpy.typing import NDArray

# Names of the rules: values of the parameter `allocation`.
ALLOCATIONS = ('two_wheels', 'min_norm', 'min_energy', 'bounded', 'min_max_speed')

# Time for which `min_max_speed` extrapolates the wheel speeds [s].
#
# Torques in the null space are proportional to its inverse. The rounding of a 14-bit encoder at
# 250 Hz, 0.1 rad/s, makes 0.3 % of the torque limit of the prototype of it. A manoeuvre of seconds
# is still followed closely.
SPEED_HORIZON = 0.1

# Share of the torque limit that a plan grants `min_max_speed` for balancing wheel speeds.
#
# The law balances with the torque that is left over, so balancing never makes a manoeuvre
# infeasible.
PLANNED_BALANCING = 0.5


class AllocationError(FourbarError):
    """An allocation rule that does not exist; `values`: name, value, limit (the known ones)."""


class Allocation(Protocol):
    """
    A rule with the wheels that it may use.

    A rule needs not be a weighted norm. It must meet the demand exactly where the bounds admit
    that, and else reduce the whole demand by one scale.
    """

    @property
    def weights_inv(self) -> Array:
        """
        Inverse weights v (4,), 0 for a wheel that must not be used; only their ratios matter.

        Among the torques that a rule has to choose from, it takes the least sum of
        `tau_i^2 / v_i`.
        """

    @property
    def rule(self) -> NDArray[np.record]:
        """The rule as kernels take it: one record (1,) of `allocation_solver.RULE_FIELDS`."""

    def solve(self, wheel_map: Array, demand: Array, motors: MotorState) -> tuple[Array, float]:
        """
        Share a demand, see `allocation_solver.allocate`.

        :param wheel_map: (n, 4), n up to 3.
        :param demand: (n,) [N m].
        :returns: torques on the wheels (4,) [N m], and the scale from 0 to 1.
        """

    def for_plan(self, step: float, torque_limits: Array) -> Allocation:
        """
        Return the rule for a plan: without bounds, so that it shows what the motors would need.

        :param step: longest time between two instants of the plan [s].
        :param torque_limits: (4,) of the motors [N m].
        """


@dataclass(frozen=True, eq=False)
class WeightedNorm:
    """
    The least sum of `tau_i^2 / v_i`; torques beyond a bound scale all torques down together.

    The direction of the motion stays. A wheel that is needed and at its speed limit stops all.

    :param weights_inv: v (4,), 0 for a wheel that must not be used.
    """

    kind: ClassVar[int] = PROPORTIONAL

    weights_inv: Array

    @cached_property
    def rule(self) -> NDArray[np.record]:
        """See :class:`Allocation`."""
        return np.array([record(RULE_FIELDS, kind=self.kind, weights_inv=self.weights_inv,
                                soft_limits=inf)])

    def solve(self, wheel_map: Array, demand: Array, motors: MotorState) -> tuple[Array, float]:
        """See :class:`Allocation`."""
        torques = np.zeros(4)
        scale = solve(self.rule, wheel_map, demand, motors, torques)
        return torques, scale

    def for_plan(self, step: float, torque_limits: Array) -> Allocation:
        """See :class:`Allocation`."""
        return WeightedNorm(self.weights_inv)


@dataclass(frozen=True, eq=False)
class ConstrainedNorm(WeightedNorm):
    """
    The least sum of `tau_i^2 / v_i` within the bounds.

    Other wheels stand in for a wheel at its bound. Where that is not enough, the scale is the
    largest that the bounds admit, less a margin, see `allocation_solver.MARGIN`.
    """

    kind: ClassVar[int] = CONSTRAINED


@dataclass(frozen=True, eq=False)
class MinMaxSpeed(WeightedNorm):
    """
    The smallest largest |wheel speed| that the torques lead to, within the bounds.

    With the torques held for the horizon h, and the links at their rate, wheel i comes to
    `s_i = speed_i + h tau_i / inertia_i`. Of all torques within the bounds that meet the demand,
    the rule takes those with the smallest `max |s_i|`, and of these the least sum of
    `tau_i^2 / v_i`. The scale is that of :class:`ConstrainedNorm`. Derivation in docs/control.md.

    :param inertias: (4,) of the wheels [kg m^2].
    :param horizon: h [s].
    :param soft_limits: (4,) bounds that give way where the least norm exceeds them [N m].
    """

    kind: ClassVar[int] = MIN_MAX_SPEED

    inertias: Array
    horizon: float = SPEED_HORIZON
    soft_limits: Array = field(default_factory=lambda: np.full(4, inf))

    @cached_property
    def rule(self) -> NDArray[np.record]:
        """See :class:`Allocation`."""
        return np.array([record(
            RULE_FIELDS, kind=self.kind, weights_inv=self.weights_inv, inertias=self.inertias,
            horizon=self.horizon, soft_limits=self.soft_limits)])

    def for_plan(self, step: float, torque_limits: Array) -> Allocation:
        """See :class:`Allocation`; a horizon of two steps keeps the integration stable."""
        return replace(self, horizon=max(self.horizon, 2.0 * step),
                       soft_limits=PLANNED_BALANCING * torque_limits)


def make_allocation(name: str, flywheel_inertias: Array,
                    usable: Sequence[bool] | NDArray[np.bool_]) -> Allocation:
    """
    Return the rule of a name.

    `two_wheels` drives with one wheel of each pair of links, a and b if possible. `min_norm` has
    the least norm of wheel accelerations (paper eq. 8). `min_energy` weights it with the wheel
    inertias: a pair that starts at equal speeds keeps equal speeds, which is the least kinetic
    energy for its momentum. `bounded` is the same as a constrained optimum. `min_max_speed` keeps
    the fastest wheel as slow as possible.

    :param name: one of `ALLOCATIONS`.
    :param flywheel_inertias: If (4,) [kg m^2].
    :param usable: (4,) whether each wheel may be used.
    :raises AllocationError: the name is unknown.
    """
    if name not in ALLOCATIONS:
        raise AllocationError(
            f'allocation must be one of {", ".join(ALLOCATIONS)}, got {name!r}',
            name='allocation', value=name, limit=ALLOCATIONS)
    used = np.array(usable, dtype=bool)
    if name == 'two_wheels':
        used[2:] &= ~used[:2]
    inertias = np.asarray(flywheel_inertias, dtype=float)
    power = 2 if name in ('two_wheels', 'min_norm') else 1
    weights_inv = np.where(used, inertias ** power, 0.0)
    if name == 'min_max_speed':
        return MinMaxSpeed(weights_inv, inertias)
    return (ConstrainedNorm if name == 'bounded' else WeightedNorm)(weights_inv)


@kernel
def solve(rule: NDArray[np.record], wheel_map: Array, demand: Array, motors: MotorState,
          torques_out: Array) -> float:
    """Call the solver from Python, see `allocation_solver.allocate`."""
    return allocate(rule[0], wheel_map, demand, motors, torques_out)
