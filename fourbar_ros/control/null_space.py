# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Null-space control: torques that change wheel speeds and move no link.

With two axes the null space has two dimensions, with three axes one. On a rhombus it is spanned
by (1, 0, -1, 0) and (0, 1, 0, -1): opposite torques on opposite wheels. They keep the momentum of
each pair and shift it between the two wheels, away from speed limits and from standstill.
"""

from __future__ import annotations

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control.allocation_solver import MotorState, principal_axes, ROUNDING
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np

# Targets of the wheel speeds, see :func:`target_speeds`.
TARGETS = ('balanced', 'zero', 'bias')

# Signs of the target `bias`: opposite within a pair, so that it needs no momentum.
BIAS_SIGNS = np.array([1.0, 1.0, -1.0, -1.0])


class TargetError(FourbarError):
    """A target that does not exist; `values`: name, value, limit (the known ones)."""


def target_speeds(name: str, link_rates: Array, bias: float) -> Array:
    """
    Return target speeds of the wheels, absolute; the null space leads as close as it can.

    "Close" is meant in the metric of `null_torques`, for the momentum that each pair has. With the
    inverse weights If (`min_energy`) `balanced` is the least kinetic energy: equal absolute
    speeds within the pairs of a parallelogram, also for unequal wheels.

    :param name: `balanced`, least absolute speeds; `zero`, least speeds relative to the links;
        `bias`, speeds relative to the links of (bias, bias, -bias, -bias), away from standstill.
    :param link_rates: (4,) [rad/s].
    :param bias: [rad/s].
    :returns: (4,) [rad/s].
    :raises TargetError: the name is unknown.
    """
    if name not in TARGETS:
        raise TargetError(f'wheel_target must be one of {", ".join(TARGETS)}, got {name!r}',
                          name='wheel_target', value=name, limit=TARGETS)
    if name == 'balanced':
        return np.zeros(4)
    return link_rates + (bias * BIAS_SIGNS if name == 'bias' else 0.0)


@kernel
def towards(speeds: Array, targets: Array, flywheel_inertias: Array, bandwidth: float) -> Array:
    """
    Return the torques by which free wheels approach their targets as exp(-bandwidth t).

    :param speeds, targets: (4,) absolute speeds of the wheels [rad/s].
    :param flywheel_inertias: If (4,) [kg m^2].
    :param bandwidth: [rad/s].
    :returns: (4,) torques on the wheels [N m].
    """
    return flywheel_inertias * (bandwidth * (targets - speeds))


@kernel
def null_torques(wheel_map: Array, weights_inv: Array, desired: Array, motors: MotorState,
                 allocated: Array, out: Array) -> float:
    """
    Project desired torques onto the null space, within what the motors can give besides.

    The projection minimises the sum of `(tau_i - desired_i)^2 / v_i`. Torques that do not fit
    between the bounds beside the allocated ones are scaled down together.

    :param wheel_map: (n, 4), see control.allocation_solver.
    :param weights_inv: v (4,), 0 for a wheel that is not used. With If, torques `towards` a
        target reduce the kinetic energy of the differences from it as fast as possible.
    :param desired: (4,) [N m].
    :param allocated: (4,) torques of the allocation, within the bounds [N m].
    :param out: (4,) receives the torques to add to these [N m].
    :returns: the scale, from 0 to 1.
    """
    lower, upper = motors.lower, motors.upper
    _, effectiveness, gains, roots = principal_axes(wheel_map, weights_inv)
    size = 0.0
    for wheel in range(4):
        out[wheel] = desired[wheel] / roots[wheel] if roots[wheel] > 0.0 else 0.0
        size = max(size, abs(out[wheel]))
    strongest = max(gains[0], gains[1], gains[2])
    # Twice: after the first pass torques that were mostly along the rows are rounding errors.
    for _ in range(2):
        for k in range(wheel_map.shape[0]):
            # Also a direction that the wheels cannot drive must not be disturbed.
            if gains[k] > ROUNDING * strongest:
                along = 0.0
                for wheel in range(4):
                    along += effectiveness[k, wheel] * out[wheel]
                along /= gains[k] * gains[k]
                for wheel in range(4):
                    out[wheel] -= along * effectiveness[k, wheel]
    scale = 1.0
    for wheel in range(4):
        if abs(out[wheel]) <= ROUNDING * size:
            out[wheel] = 0.0
        out[wheel] *= roots[wheel]
        if out[wheel] > upper[wheel] - allocated[wheel]:
            scale = min(scale, max(upper[wheel] - allocated[wheel], 0.0) / out[wheel])
        elif out[wheel] < lower[wheel] - allocated[wheel]:
            scale = min(scale, min(lower[wheel] - allocated[wheel], 0.0) / out[wheel])
    for wheel in range(4):
        out[wheel] *= scale
    return scale
