# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What a device recorded, as plain arrays in seconds."""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.analysis.bags import Floats, JointSeries, Nanoseconds, Recording
from fourbar_ros.analysis.calibration.quantity import CalibrationError
from fourbar_ros.common import names
from fourbar_ros.mechanism import FLYWHEEL_NAMES, JOINT_NAMES, LINK_NAMES
import numpy as np


@dataclass(frozen=True, eq=False)
class LinkSignal:
    """
    The link angles.

    :param times: (n,) of measurement, ascending [s].
    :param angles: (n, 4) in frame `table`, continuous; NaN where a sample is missing [rad].
    """

    times: Floats
    angles: Floats


@dataclass(frozen=True, eq=False)
class WheelSignal:
    """
    The wheels at every tick, relative to their links.

    :param times: (m,) ascending [s].
    :param angles: (m, 4) unwrapped [rad].
    :param speeds: (m, 4) [rad/s].
    :param efforts: (m, 4) of the motors, mean since the tick before [N m].
    """

    times: Floats
    angles: Floats
    speeds: Floats
    efforts: Floats


def link_signal(stamps_ns: Nanoseconds, angles: Floats, origin_ns: int) -> LinkSignal:
    """
    Make link angles continuous.

    :param stamps_ns: (n,) of measurement [ns].
    :param angles: (n, 4) in (-pi, pi], NaN where a sample is missing [rad].
    :param origin_ns: where time begins [ns].
    """
    continuous = np.array(angles, dtype=float)
    for link in range(4):
        known = np.isfinite(continuous[:, link])
        continuous[known, link] = np.unwrap(continuous[known, link])
    return LinkSignal(_seconds(stamps_ns, origin_ns), continuous)


def links_in(recording: Recording, origin_ns: int | None = None) -> LinkSignal:
    """
    Take the link angles from a bag.

    :param origin_ns: where time begins, by default at the first of them [ns].
    :raises BagError: there are none.
    :raises CalibrationError: a link has no absolute sensor, or never gave a sample.
    """
    series = recording.joint_states(names.LINK_ANGLES)
    joints = [name for name in series.names if name in JOINT_NAMES]
    if joints:
        raise CalibrationError(
            f'{series.topic} holds {", ".join(joints)}: only a device with an absolute sensor on '
            'each link can be calibrated')
    series = series.select(LINK_NAMES)
    missing = [name for name, column in zip(LINK_NAMES, series.position.T)
               if np.isfinite(column).sum() < 2]
    if missing:
        raise CalibrationError(f'{series.topic} has no sample of {", ".join(missing)}')
    return link_signal(
        series.stamp_ns, series.position,
        int(series.stamp_ns[0]) if origin_ns is None else origin_ns)


def signals_in(recording: Recording) -> tuple[LinkSignal, WheelSignal]:
    """
    Take links and wheels from a bag, on one scale of time.

    :raises BagError: a topic is missing.
    :raises CalibrationError: a link or a wheel is missing.
    """
    wheels: JointSeries = recording.joint_states(names.FLYWHEEL_STATES).select(FLYWHEEL_NAMES)
    for field in ('position', 'velocity', 'effort'):
        if not np.isfinite(getattr(wheels, field)).all():
            raise CalibrationError(f'{wheels.topic} leaves out a {field}')
    origin_ns = int(wheels.stamp_ns[0])
    return links_in(recording, origin_ns), WheelSignal(
        _seconds(wheels.stamp_ns, origin_ns), wheels.position, wheels.velocity, wheels.effort)


def _seconds(stamps_ns: Nanoseconds, origin_ns: int) -> Floats:
    # Exact as whole numbers first: a stamp since 1970 has no room for nanoseconds as a float.
    return np.asarray((stamps_ns - origin_ns) * 1e-9, dtype=np.float64)
