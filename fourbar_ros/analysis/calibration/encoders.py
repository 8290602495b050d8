# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Zeros of the link encoders, from links that rest in a jig at a known pose."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.quantity import (
    CalibrationError,
    correlation_factor,
    Quantity,
)
from fourbar_ros.analysis.calibration.signals import LinkSignal
from fourbar_ros.mechanism import closure_error, ClosureError, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.closure import assemblies
import numpy as np

# A jig is made to a tenth of a degree; worse is a slip of the pen [rad].
POSE_TOLERANCE = 2e-3
# Links that drift by more than this, or swing with more, do not rest [rad].
LARGEST_DRIFT = 1e-3
LARGEST_SPREAD = 1e-2
# A mean of fewer samples says nothing of its error.
FEWEST = 20


@dataclass(frozen=True, eq=False)
class EncoderOffsets:
    """
    What was found of the sensors of the links.

    :param pose: (4,) where the links were [rad].
    :param offsets: (4,) reading minus truth [rad].
    :param standard_errors: (4,) of the offsets [rad].
    :param peak_to_peak: (4,) of the readings [rad].
    :param counts: (4,) how many there were.
    """

    pose: Floats
    offsets: Floats
    standard_errors: Floats
    peak_to_peak: Floats
    counts: Floats

    def quantities(self, before: Floats) -> list[Quantity]:
        """
        Return what goes into the mechanism file.

        :param before: (4,) offsets that the device took out of its readings already [rad].
        """
        return [Quantity(f'link_angle_offsets {name}', 'rad', float(before[link] + offset),
                         float(self.standard_errors[link]), float(before[link]))
                for link, (name, offset) in enumerate(zip(LINK_NAMES, self.offsets))]


def jig_pose(mechanism: Mechanism, known: Mapping[str, float], readings: Floats) -> Floats:
    """
    Complete the pose of the jig to all four links.

    :param known: orientation by link, at least two [rad].
    :param readings: (4,) mean readings, which tell the branch where only two are known [rad].
    :returns: (4,) link angles [rad].
    :raises CalibrationError: unknown links, too few, or angles that do not close the loop within
        `POSE_TOLERANCE` of the longest link.
    """
    check_names(known)
    links = tuple(LINK_NAMES.index(name) for name in known)
    angles = dict(zip(links, known.values()))
    if len(known) == 4:
        pose = np.array([angles[link] for link in range(4)])
        limit = POSE_TOLERANCE * float(mechanism.link_lengths.max())
        gap = closure_error(mechanism, pose)
        if gap > limit:
            raise CalibrationError(
                f'the pose does not close the loop: gap {gap:.3g} m, limit {limit:.3g} m')
        return pose
    candidates = _poses(mechanism, angles, readings)
    if not candidates:
        raise CalibrationError(
            f'the pose does not close the loop within {POSE_TOLERANCE:g} rad')
    return candidates[0]


def check_names(known: Collection[str]) -> None:
    """
    Refuse a pose that cannot be completed, whatever its angles.

    :param known: the links that it names.
    :raises CalibrationError: unknown links, or less than two.
    """
    if unknown := [name for name in known if name not in LINK_NAMES]:
        raise CalibrationError(
            f'unknown link {unknown[0]!r} in the pose (known are {", ".join(LINK_NAMES)})')
    if len(known) < 2:
        raise CalibrationError(
            f'the pose names {len(known)} of the links, and two are needed at least')


def _poses(mechanism: Mechanism, angles: Mapping[int, float], readings: Floats) -> list[Floats]:
    """Complete two or three angles; with three, keep what agrees with the third."""
    first, second, *rest = angles
    near = np.array(readings)
    near[list(angles)] = list(angles.values())
    try:
        found = assemblies(mechanism, (first, second), (angles[first], angles[second]), near)
    except ClosureError as error:
        raise CalibrationError(f'the pose does not close the loop: {error}') from None
    return [pose for pose in found
            if all(abs(float(wrap_angles(pose[link] - angles[link]))) <= POSE_TOLERANCE
                   for link in rest)]


def mean_readings(links: LinkSignal) -> Floats:
    """Average the readings on the circle: (4,) [rad]."""
    means = []
    for column in links.angles.T:
        known = column[np.isfinite(column)]
        means.append(np.arctan2(np.sin(known).mean(), np.cos(known).mean()))
    return np.array(means)


def encoder_offsets(links: LinkSignal, pose: Floats) -> EncoderOffsets:
    """
    Compare the readings with the truth.

    :param pose: (4,) where the links are [rad].
    :raises CalibrationError: too few samples, or a link does not rest.
    """
    offsets, errors, ranges, counts = [], [], [], []
    means = mean_readings(links)
    for link, name in enumerate(LINK_NAMES):
        known = np.isfinite(links.angles[:, link])
        readings, times = links.angles[known, link], links.times[known]
        if len(readings) < FEWEST:
            raise CalibrationError(
                f'{name} gave {len(readings)} samples, and {FEWEST} are needed at least')
        deviations = wrap_angles(readings - means[link])
        _check_rest(name, times, deviations)
        offsets.append(float(wrap_angles(means[link] - pose[link])))
        errors.append(float(deviations.std(ddof=1)) * np.sqrt(
            correlation_factor([deviations]) / len(deviations)))
        ranges.append(float(np.ptp(deviations)))
        counts.append(len(deviations))
    return EncoderOffsets(np.array(pose), np.array(offsets), np.array(errors), np.array(ranges),
                          np.array(counts, dtype=float))


def _check_rest(name: str, times: Floats, deviations: Floats) -> None:
    """Refuse a link whose readings drift or spread; what noise alone can do is no drift."""
    spread = float(deviations.std(ddof=1))
    if spread > LARGEST_SPREAD:
        raise CalibrationError(
            f'{name} does not rest: its readings spread by {spread:.3g} rad rms, limit '
            f'{LARGEST_SPREAD:g} rad')
    centred = times - times.mean()
    slope = float(centred @ deviations / (centred @ centred))
    drift = slope * float(np.ptp(times))
    by_chance = 4.0 * spread * float(np.ptp(times)) / float(np.sqrt(centred @ centred))
    if abs(drift) > max(LARGEST_DRIFT, by_chance):
        raise CalibrationError(
            f'{name} does not rest: it drifts by {drift:.3g} rad in {np.ptp(times):.1f} s, limit '
            f'{max(LARGEST_DRIFT, by_chance):.2g} rad')
