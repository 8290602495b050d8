# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What wheels can do to each other without moving a link.

Two axes leave two ways, three leave one. Of a rhombus they are (1, 0, -1, 0) and (0, 1, 0, -1):
opposite torques on opposite wheels. They keep the momentum of each pair and shift it between the
two, which is what keeps wheels off their speed limits and away from standstill.
"""

from __future__ import annotations

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control.allocation import principal_axes, ROUNDING
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np

TARGETS = ('balanced', 'zero', 'bias')

# Opposite within each pair, so that equal wheels need no momentum for it.
BIAS_SIGNS = np.array([1.0, 1.0, -1.0, -1.0])


class TargetError(FourbarError):
    """A target of the wheel speeds that does not exist."""


def target_speeds(name: str, link_rates: Array, bias: float) -> Array:
    """
    Return the absolute speeds that wheels shall have as far as the null space lets them.

    What they come to is nearest to the target in the metric of `null_torques`, for the momentum
    that each pair has. With the mobilities If (`min_energy`) `balanced` is the least kinetic
    energy: equal absolute speeds within the pairs of a parallelogram, of unequal wheels too.

    :param name: `balanced`, least absolute speeds; `zero`, least speeds relative to the links;
        `bias`, speeds relative to the links of (bias, bias, -bias, -bias), away from standstill.
    :param link_rates: (4,) [rad/s].
    :param bias: [rad/s].
    :returns: (4,) [rad/s].
    :raises TargetError: there is none of that name.
    """
    if name not in TARGETS:
        raise TargetError(f'target {name!r} is unknown (known are {", ".join(TARGETS)})')
    if name == 'balanced':
        return np.zeros(4)
    return link_rates + (bias * BIAS_SIGNS if name == 'bias' else 0.0)


@kernel
def towards(speeds: Array, targets: Array, flywheel_inertias: Array, bandwidth: float) -> Array:
    """
    Return torques that bring wheels to their targets as exp(-bandwidth t), if nothing holds them.

    :param speeds, targets: (4,) absolute speeds of the wheels [rad/s].
    :param flywheel_inertias: If (4,) [kg m^2].
    :param bandwidth: [rad/s].
    :returns: (4,) torques on the wheels [N m].
    """
    return flywheel_inertias * (bandwidth * (targets - speeds))


@kernel
def null_torques(rows: Array, mobilities: Array, wanted: Array, lower: Array, upper: Array,
                 given: Array, out: Array) -> float:
    """
    Take of wanted torques what moves no axis, and leave to the motors what they give already.

    The nearest such torques, by the sum of `(tau_i - wanted_i)^2 / v_i`. Where they do not fit
    between the bounds beside what is given, all are scaled down by one factor.

    :param rows: (n, 4), see control.allocation.
    :param mobilities: v (4,), 0 for a wheel that is not used. With If, torques `towards` a target
        lower the kinetic energy of the differences from it as fast as they can.
    :param wanted: (4,) [N m].
    :param lower, upper: (4,) torques that each motor can give now [N m].
    :param given: (4,) torques of the allocation, within the bounds [N m].
    :param out: (4,) torques to add to those, to be filled in [N m].
    :returns: the factor, from 0 to 1.
    """
    _, spread, gains, roots = principal_axes(rows, mobilities)
    size = 0.0
    for wheel in range(4):
        out[wheel] = wanted[wheel] / roots[wheel] if roots[wheel] > 0.0 else 0.0
        size = max(size, abs(out[wheel]))
    strongest = max(gains[0], gains[1], gains[2])
    # Twice, since what the first leaves of torques that were mostly along the rows is rounding.
    for _ in range(2):
        for k in range(rows.shape[0]):
            # A direction that is lost to the allocation is still not to be disturbed.
            if gains[k] > ROUNDING * strongest:
                along = 0.0
                for wheel in range(4):
                    along += spread[k, wheel] * out[wheel]
                along /= gains[k] * gains[k]
                for wheel in range(4):
                    out[wheel] -= along * spread[k, wheel]
    scale = 1.0
    for wheel in range(4):
        if abs(out[wheel]) <= ROUNDING * size:
            out[wheel] = 0.0
        out[wheel] *= roots[wheel]
        if out[wheel] > upper[wheel] - given[wheel]:
            scale = min(scale, max(upper[wheel] - given[wheel], 0.0) / out[wheel])
        elif out[wheel] < lower[wheel] - given[wheel]:
            scale = min(scale, min(lower[wheel] - given[wheel], 0.0) / out[wheel])
    for wheel in range(4):
        out[wheel] *= scale
    return scale
