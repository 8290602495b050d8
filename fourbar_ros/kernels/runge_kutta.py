# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The classical Runge-Kutta step of order four, for any equations of motion.

A form of the equations of motion brings a *stage* kernel. It places the motion at a stage, from
the start of the step and the derivatives of the stage before, and evaluates the derivatives there.
Each form keeps motion and derivatives in its own types: numba compiles the step for each of them,
with direct calls, so that the abstraction costs nothing.

The first stage is the caller's: a form that does not exist at the start is left before the other
three are paid for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from fourbar_ros.kernels.compiler import FUSED, kernel
from fourbar_ros.kernels.linear_algebra import Vector4
import numpy as np
from numpy.typing import NDArray

_Stage = TypeVar('_Stage')


class Drive(NamedTuple):
    """
    What drives the wheels during a step.

    :ivar start, middle, end: (4,) motor torques on the wheels, or, where the motion of a wheel is
        prescribed, its axial inertia times its acceleration relative to the link [N m].
    """

    start: NDArray[np.float64]
    middle: NDArray[np.float64]
    end: NDArray[np.float64]


def later_stages_of(stage: Callable[..., _Stage]
                    ) -> Callable[..., tuple[_Stage, _Stage, _Stage]]:
    """
    Make the kernel that evaluates stages 2 to 4 of a step for one form.

    It is made for each form, and not given the stage as an argument, because numba cannot keep
    the code of a kernel that passes another one on.

    :param stage: kernel `stage(number, start, previous, time, torques, system)` that evaluates a
        stage a time [s] after the start; `number` (1, 2, 3) tells a form that keeps its results in
        arrays which of them to fill.
    :returns: kernel `later_stages(start, first, drive, step, system)`. `start` is the motion at
        the start, `first` stage 1, its derivatives, and `system` all else that the form needs.
    """
    # Part of the code of its callers, which is kept.
    @kernel(fastmath=FUSED, cache=False, forceinline=True)
    def later_stages(start: Any, first: _Stage, drive: Drive, step: float, system: Any
                     ) -> tuple[_Stage, _Stage, _Stage]:
        second = stage(1, start, first, 0.5 * step, drive.middle, system)
        third = stage(2, start, second, 0.5 * step, drive.middle, system)
        return second, third, stage(3, start, third, step, drive.end, system)

    return later_stages


@kernel(fastmath=FUSED)
def weighted_sum(step: float, first: float, second: float, third: float, fourth: float) -> float:
    """Integrate one component of the derivatives over a step, from its values at the stages."""
    return step / 6.0 * (first + 2.0 * (second + third) + fourth)


@kernel
def weighted_sums(step: float, first: Vector4, second: Vector4, third: Vector4, fourth: Vector4
                  ) -> Vector4:
    """Integrate four components of the derivatives over a step, as `weighted_sum`."""
    return (weighted_sum(step, first[0], second[0], third[0], fourth[0]),
            weighted_sum(step, first[1], second[1], third[1], fourth[1]),
            weighted_sum(step, first[2], second[2], third[2], fourth[2]),
            weighted_sum(step, first[3], second[3], third[3], fourth[3]))


@kernel
def interpolate(drive: Drive, part: float, out: NDArray[np.float64]) -> None:
    """
    Evaluate the parabola through the drive of a step.

    :param part: of the step, from 0 to 1.
    :param out: (4,) receives the torques.
    """
    for j in range(4):
        out[j] = (drive.start[j] * (1.0 - part) * (1.0 - 2.0 * part)
                  + drive.middle[j] * 4.0 * part * (1.0 - part)
                  + drive.end[j] * part * (2.0 * part - 1.0))
