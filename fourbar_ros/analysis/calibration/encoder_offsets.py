# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Offsets of the link encoders, from links at rest in a jig at a known pose."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.measurements import LinkMeasurements
from fourbar_ros.analysis.calibration.parameter_estimates import (
    CalibrationError,
    ParameterEstimate,
    variance_inflation,
)
from fourbar_ros.mechanism import closure_error, ClosureError, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.closure import assemblies
import numpy as np

# Largest closure error of a pose [rad]; jigs are accurate to 0.1 deg, typing errors are not.
POSE_TOLERANCE = 2e-3
# Largest drift of a link at rest over the recording [rad].
MAX_DRIFT = 1e-3
# Largest standard deviation of the readings of a link at rest [rad].
MAX_DEVIATION = 1e-2
# Least samples of a link: fewer give no useful standard error.
MIN_SAMPLES = 20


@dataclass(frozen=True, eq=False)
class EncoderOffsets:
    """
    Estimated offsets of the link encoders.

    :param pose: (4,) true link angles [rad].
    :param offsets: (4,) mean reading minus true angle [rad].
    :param standard_errors: (4,) of the offsets [rad].
    :param peak_to_peak: (4,) range of the readings [rad].
    :param counts: (4,) number of readings.
    """

    pose: Floats
    offsets: Floats
    standard_errors: Floats
    peak_to_peak: Floats
    counts: Floats

    def estimates(self, before: Floats) -> list[ParameterEstimate]:
        """
        Return the offsets for the mechanism file.

        :param before: (4,) offsets that the device subtracted from its readings [rad].
        """
        return [ParameterEstimate(
            f'link_angle_offsets {name}', 'rad', float(before[link] + self.offsets[link]),
            float(self.standard_errors[link]), float(before[link]))
            for link, name in enumerate(LINK_NAMES)]


def jig_pose(mechanism: Mechanism, known: Mapping[str, float], readings: Floats) -> Floats:
    """
    Return all four link angles of the jig.

    :param known: orientation by link, at least two [rad].
    :param readings: (4,) mean readings; they select the branch if two links are known [rad].
    :returns: (4,) link angles [rad].
    :raises CalibrationError: unknown links, too few, or angles that do not close the loop within
        `POSE_TOLERANCE` of the longest link.
    """
    check_links(known)
    angles = {LINK_NAMES.index(name): angle for name, angle in known.items()}
    if len(known) == 4:
        pose = np.array([angles[link] for link in range(4)])
        limit = POSE_TOLERANCE * float(mechanism.link_lengths.max())
        gap = closure_error(mechanism, pose)
        if gap > limit:
            raise CalibrationError(
                f'the pose does not close the loop: gap {gap:.3g} m, limit {limit:.3g} m',
                reason='closure', value=gap, limit=limit)
        return pose
    first, second, *rest = angles
    near = np.array(readings)
    near[list(angles)] = list(angles.values())
    try:
        candidates = assemblies(mechanism, (first, second), (angles[first], angles[second]), near)
    except ClosureError as error:
        raise CalibrationError(f'the pose does not close the loop: {error}',
                               reason='closure') from None
    for pose in candidates:
        if all(abs(float(wrap_angles(pose[link] - angles[link]))) <= POSE_TOLERANCE
               for link in rest):
            return pose
    raise CalibrationError(f'the pose does not close the loop within {POSE_TOLERANCE:g} rad',
                           reason='closure', limit=POSE_TOLERANCE)


def check_links(names: Collection[str]) -> None:
    """
    Check the links of a pose, without their angles.

    :raises CalibrationError: unknown links, or fewer than two.
    """
    if unknown := [name for name in names if name not in LINK_NAMES]:
        raise CalibrationError(
            f'unknown link {unknown[0]!r} in the pose (known are {", ".join(LINK_NAMES)})',
            reason='unknown', name=unknown[0], limit=LINK_NAMES)
    if len(names) < 2:
        raise CalibrationError(f'the pose names {len(names)} link, at least 2 are required',
                               reason='too_few', value=len(names), limit=2)


def mean_readings(links: LinkMeasurements) -> Floats:
    """Return the circular mean of the readings: (4,) [rad]."""
    means = []
    for column in links.angles.T:
        known = column[np.isfinite(column)]
        means.append(np.arctan2(np.sin(known).mean(), np.cos(known).mean()))
    return np.array(means)


def encoder_offsets(links: LinkMeasurements, pose: Floats) -> EncoderOffsets:
    """
    Estimate the encoder offsets as mean reading minus true angle.

    :param pose: (4,) true link angles [rad].
    :raises CalibrationError: too few samples, or a link is not at rest.
    """
    offsets, errors, ranges, counts = [], [], [], []
    means = mean_readings(links)
    for link, name in enumerate(LINK_NAMES):
        known = np.isfinite(links.angles[:, link])
        readings, times = links.angles[known, link], links.times[known]
        if len(readings) < MIN_SAMPLES:
            raise CalibrationError(
                f'{name} has {len(readings)} samples, at least {MIN_SAMPLES} are required',
                reason='too_few', name=name, value=len(readings), limit=MIN_SAMPLES)
        deviations = wrap_angles(readings - means[link])
        _check_rest(name, times, deviations)
        offsets.append(float(wrap_angles(means[link] - pose[link])))
        errors.append(float(deviations.std(ddof=1)) * np.sqrt(
            variance_inflation([deviations]) / len(deviations)))
        ranges.append(float(np.ptp(deviations)))
        counts.append(len(deviations))
    return EncoderOffsets(np.array(pose), np.array(offsets), np.array(errors), np.array(ranges),
                          np.array(counts, dtype=float))


def _check_rest(name: str, times: Floats, deviations: Floats) -> None:
    """Refuse a link whose readings vary, or drift by more than four standard errors of a fit."""
    deviation = float(deviations.std(ddof=1))
    if deviation > MAX_DEVIATION:
        raise CalibrationError(
            f'{name} is not at rest: standard deviation of its readings {deviation:.3g} rad, '
            f'limit {MAX_DEVIATION:g} rad',
            reason='deviation', name=name, value=deviation, limit=MAX_DEVIATION)
    centred = times - times.mean()
    slope = float(centred @ deviations / (centred @ centred))
    drift = slope * float(np.ptp(times))
    by_chance = 4.0 * deviation * float(np.ptp(times)) / float(np.sqrt(centred @ centred))
    limit = max(MAX_DRIFT, by_chance)
    if abs(drift) > limit:
        raise CalibrationError(
            f'{name} is not at rest: it drifts by {drift:.3g} rad in {np.ptp(times):.1f} s, '
            f'limit {limit:.2g} rad', reason='drift', name=name, value=drift, limit=limit)
