# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Measurements of a device as arrays, with time in seconds."""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.analysis.bags import Bag, Floats, Nanoseconds
from fourbar_ros.analysis.calibration.parameter_estimates import CalibrationError
from fourbar_ros.common.names import FLYWHEEL_STATES, LINK_ANGLES
from fourbar_ros.mechanism import FLYWHEEL_NAMES, JOINT_NAMES, LINK_NAMES
import numpy as np


@dataclass(frozen=True, eq=False)
class LinkMeasurements:
    """
    Measured link angles.

    :param times: (n,) of measurement, ascending [s].
    :param angles: (n, 4) in frame `table`, continuous; NaN for a missing sample [rad].
    """

    times: Floats
    angles: Floats


@dataclass(frozen=True, eq=False)
class WheelMeasurements:
    """
    Measured motion of the wheels relative to their links, one row per tick.

    :param times: (m,) ascending [s].
    :param angles: (m, 4) continuous [rad].
    :param speeds: (m, 4) [rad/s].
    :param efforts: (m, 4) motor torques, mean since the previous tick [N m].
    """

    times: Floats
    angles: Floats
    speeds: Floats
    efforts: Floats


def link_measurements(stamps_ns: Nanoseconds, angles: Floats, origin_ns: int) -> LinkMeasurements:
    """
    Return link measurements with continuous angles.

    :param stamps_ns: (n,) of measurement [ns].
    :param angles: (n, 4) in (-pi, pi]; NaN for a missing sample [rad].
    :param origin_ns: origin of time [ns].
    """
    continuous = np.array(angles, dtype=float)
    for link in range(4):
        known = np.isfinite(continuous[:, link])
        continuous[known, link] = np.unwrap(continuous[known, link])
    return LinkMeasurements(_seconds(stamps_ns, origin_ns), continuous)


def read_links(bag: Bag, origin_ns: int | None = None) -> LinkMeasurements:
    """
    Read the link angles of a bag.

    :param origin_ns: origin of time, by default the first stamp [ns].
    :raises BagError: the bag has none.
    :raises CalibrationError: a link has no absolute sensor, or fewer than two samples.
    """
    series = bag.joint_states(LINK_ANGLES)
    if joints := [name for name in series.names if name in JOINT_NAMES]:
        raise CalibrationError(
            f'{series.topic} contains {", ".join(joints)}: calibration requires an absolute '
            'sensor on each link', reason='joint_encoders', name=joints)
    series = series.select(LINK_NAMES)
    if missing := [name for name, column in zip(LINK_NAMES, series.position.T)
                   if np.isfinite(column).sum() < 2]:
        raise CalibrationError(f'{series.topic} has no sample of {", ".join(missing)}',
                               reason='no_samples', name=missing)
    return link_measurements(
        series.stamp_ns, series.position,
        int(series.stamp_ns[0]) if origin_ns is None else origin_ns)


def read_measurements(bag: Bag) -> tuple[LinkMeasurements, WheelMeasurements]:
    """
    Read links and wheels of a bag, with a common origin of time.

    :raises BagError: a topic is missing.
    :raises CalibrationError: a link or a wheel is missing.
    """
    wheels = bag.joint_states(FLYWHEEL_STATES).select(FLYWHEEL_NAMES)
    for field in ('position', 'velocity', 'effort'):
        if not np.isfinite(getattr(wheels, field)).all():
            raise CalibrationError(f'{wheels.topic} lacks a value of {field}',
                                   reason='no_samples', name=field)
    origin_ns = int(wheels.stamp_ns[0])
    return read_links(bag, origin_ns), WheelMeasurements(
        _seconds(wheels.stamp_ns, origin_ns), wheels.position, wheels.velocity, wheels.effort)


def _seconds(stamps_ns: Nanoseconds, origin_ns: int) -> Floats:
    # Integer difference first: a double cannot hold nanoseconds since 1970.
    return np.asarray((stamps_ns - origin_ns) * 1e-9, dtype=np.float64)
