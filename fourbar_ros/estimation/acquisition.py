# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Acquisition: the configuration of the linkage from measured link angles alone."""

from __future__ import annotations

from itertools import combinations
from math import sin

from fourbar_ros.estimation.measurement import Measurement
from fourbar_ros.mechanism import ClosureError, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.change_points import ASSEMBLY_DISTANCE, REDUCED_FORM_LIMIT
from fourbar_ros.mechanism.closure import assemblies
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.constrained import project_onto_closure
import numpy as np

# Samples whose stamps differ by less count as simultaneous for the acquisition [ns]: the links of
# the prototype send one after the other.
SIMULTANEOUS_NS = 20_000_000

# Newton steps that bring measured link angles near alignment onto the closure.
NEWTON_STEPS = 5


class RecentAngles:
    """The newest angle of each sensor while there is no estimate."""

    def __init__(self) -> None:
        self._newest: dict[int, tuple[int, float]] = {}

    def combine(self, measurement: Measurement) -> Measurement:
        """Complete a measurement of fewer than three links with samples just before it."""
        stamp_ns = measurement.stamp_ns
        for sensor, value in measurement.angles().items():
            self._newest[sensor] = stamp_ns, value
        if np.isfinite(measurement.link_angles()).sum() >= 3:
            return measurement
        recent = {sensor: value for sensor, (then_ns, value) in sorted(self._newest.items())
                  if 0 <= stamp_ns - then_ns <= SIMULTANEOUS_NS}
        return Measurement(stamp_ns, tuple(recent), np.array(list(recent.values())))


def acquire_angles(mechanism: Mechanism, measured: Array, angle_noise: float,
                   exact_lengths: bool) -> Array:
    """
    Return link angles on the closure near measured ones (4,) [rad].

    :param measured: (4,), one of them NaN where it is unknown [rad].
    :param angle_noise: standard deviation of a sample [rad].
    :param exact_lengths: whether the closure constrains its weak direction near alignment.
    :raises ClosureError: no assembly is near.
    """
    if abs(sin(measured[3] - measured[2])) < REDUCED_FORM_LIMIT:
        # Two angles do not determine the others here, but all four are measured.
        near, rates = tuple(measured.tolist()), (0.0, 0.0, 0.0, 0.0)
        constants = mechanism.with_rigid_joints().constants
        for _ in range(NEWTON_STEPS):
            near, _ = project_onto_closure(near, rates, constants, exact_lengths)
        if np.abs(near - measured).max() < ASSEMBLY_DISTANCE:
            return np.array(near)
    known = np.flatnonzero(np.isfinite(measured)).tolist()
    candidates: list[Array] = []
    failure = None
    # All pairs: opposite links of a parallelogram are parallel, and folded ones leave the other
    # pair free.
    for first, second in combinations(known, 2):
        try:
            candidates += assemblies(mechanism, (first, second),
                                     (measured[first], measured[second]), np.nan_to_num(measured))
        except ClosureError as error:
            failure = failure or error
    best, nearest = None, max(ASSEMBLY_DISTANCE, 10.0 * angle_noise)
    for angles in candidates:
        distance = float(np.abs(wrap_angles(angles - measured)[known]).max())
        if distance < nearest:
            best, nearest = angles, distance
    if best is None:
        raise failure or ClosureError(
            f'no assembly is within {nearest:.2g} rad of the measured angles')
    return best
