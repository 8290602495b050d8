# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What a recording says about one setpoint: tracking, estimate, wheels, energy, loop timing.

All samples count by their stamps; see :mod:`fourbar_ros.analysis.manoeuvre` for which.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
import warnings

from fourbar_ros.analysis.bags import BagError, Floats, JointSeries, Nanoseconds, Recording
from fourbar_ros.analysis.manoeuvre import find_motion, Motion, pair, Paired
from fourbar_ros.common import names
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
import numpy as np

INDEPENDENT_LINKS = LINK_NAMES[:2]
FINAL_WINDOW_S = 1.0


class Meaning(NamedTuple):
    """What a metric measures; the unit is at the end of its name."""

    unit: str
    sentence: str


MEANINGS = {
    'tracking.rms_rad': Meaning(
        'rad', 'Ground truth minus reference of links a and b, from the setpoint to the end of '
        'the step, root mean square over all samples of both.'),
    'tracking.peak_rad': Meaning('rad', 'The largest of the same differences.'),
    'tracking.final_error_rad': Meaning(
        'rad', 'Ground truth minus goal, averaged over the last second at the goal; the larger '
        'of links a and b.'),
    'tracking.estimated_rms_rad': Meaning(
        'rad', 'As tracking.rms_rad with the estimate for the truth: all that hardware can know.'),
    'tracking.estimated_peak_rad': Meaning('rad', 'The largest of the same differences.'),
    'tracking.estimated_final_error_rad': Meaning(
        'rad', 'As tracking.final_error_rad with the estimate for the truth.'),
    'estimate.rms_error_rad': Meaning(
        'rad', 'Estimate minus ground truth of the angles of all four links, root mean square '
        'since the setpoint.'),
    'estimate.peak_error_rad': Meaning('rad', 'The largest of the same differences.'),
    'estimate.within_2_sigma': Meaning(
        '1', 'Share of these differences within two standard deviations as the filter states '
        'them; 0.95 if it knows its own accuracy.'),
    'estimate.mean_nis_per_degree_of_freedom': Meaning(
        '1', 'Normalized innovation squared over its degrees of freedom, mean since the '
        'setpoint; 1 for a consistent filter.'),
    'flywheel.peak_speed_rad_s': Meaning(
        'rad/s', 'Largest wheel speed relative to its link, ground truth.'),
    'flywheel.measured_peak_speed_rad_s': Meaning(
        'rad/s', 'The same as the wheel encoders saw it.'),
    'flywheel.peak_torque_n_m': Meaning('N m', 'Largest motor torque that was applied.'),
    'flywheel.peak_energy_j': Meaning(
        'J', 'Paper eq. 7, the sum of If/2 times absolute wheel speed squared: its peak, ground '
        'truth.'),
    'flywheel.final_energy_j': Meaning('J', 'The same at the end.'),
    'energy.peak_flywheel_energy_j': Meaning(
        'J', 'Peak of eq. 7 as the controller estimates it.'),
    'energy.eq9_j_s': Meaning(
        'J s', 'Paper eq. 9, accumulated by the controller since the setpoint.'),
    'energy.work_j': Meaning(
        'J', 'Mechanical work of the motors, the integral of |torque times relative speed|, '
        'accumulated since the setpoint.'),
    'energy.copper_loss_j': Meaning(
        'J', 'Heat in the windings of the motors, the integral of resistance times current '
        'squared as the controller works it out, accumulated since the setpoint; 0 for motors '
        'whose windings are not described.'),
    'loop.rate_hz': Meaning('Hz', 'Ticks per second of stamp time since the setpoint.'),
    'loop.ticks': Meaning('1', 'Ticks since the setpoint.'),
    'loop.round_trip_p50_ms': Meaning(
        'ms', 'From a tick to the command that answers it, at the device, median.'),
    'loop.round_trip_p99_ms': Meaning('ms', 'The same, 99th percentile.'),
    'loop.round_trip_max_ms': Meaning('ms', 'The same, worst.'),
    'loop.lost': Meaning('1', 'Ticks that no command answered within one control period.'),
    'loop.unrecorded_ticks': Meaning(
        '1', 'Ticks that the stamps show to be missing in the recording.'),
}


def metrics(recording: Recording, mechanism: Mechanism | None = None) -> dict[str, Any]:
    """
    Return every number that the recording supports, nested, ready for JSON.

    :param mechanism: for the flywheel energy of paper eq. 7.
    :returns: `motion`, the groups of MEANINGS, and `missing`: name to reason.
    :raises BagError: an essential topic is missing or no setpoint was followed.
    """
    motion = find_motion(recording)
    found: dict[str, float] = {}
    missing: dict[str, str] = {}
    for keys, measure in _measurements(recording, motion, mechanism):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter('ignore', RuntimeWarning)  # nanmax of nothing but NaN
                values = dict(zip(keys, measure()))
        except BagError as error:
            missing.update(dict.fromkeys(keys, str(error)))
            continue
        for name, value in values.items():
            if np.isfinite(value):
                found[name] = value
            else:
                missing[name] = f'{recording.path}: the messages leave it out'
    result: dict[str, Any] = {'motion': _describe(motion)}
    for name in MEANINGS:
        group, _, key = name.partition('.')
        result.setdefault(group, {})
        if name in found:
            result[group][key] = found[name]
    result['missing'] = missing
    return result


_Measurement = tuple[tuple[str, ...], Callable[[], tuple[float, ...]]]


def _measurements(recording: Recording, motion: Motion,
                  mechanism: Mechanism | None) -> list[_Measurement]:
    truth, estimate = names.SIM_LINK_STATES, names.ESTIMATE_LINK_STATES
    return [
        (('tracking.rms_rad', 'tracking.peak_rad'),
         lambda: _tracking(recording, motion, truth)),
        (('tracking.final_error_rad',), lambda: _final_error(recording, motion, truth)),
        (('tracking.estimated_rms_rad', 'tracking.estimated_peak_rad'),
         lambda: _tracking(recording, motion, estimate)),
        (('tracking.estimated_final_error_rad',),
         lambda: _final_error(recording, motion, estimate)),
        (('estimate.rms_error_rad', 'estimate.peak_error_rad'),
         lambda: _rms_and_peak(estimate_error(recording, motion).difference)),
        (('estimate.within_2_sigma',), lambda: _within_2_sigma(recording, motion)),
        (('estimate.mean_nis_per_degree_of_freedom',), lambda: _mean_nis(recording, motion)),
        (('flywheel.peak_speed_rad_s',),
         lambda: _peak_speed(recording, motion, names.SIM_FLYWHEEL_STATES)),
        (('flywheel.measured_peak_speed_rad_s',),
         lambda: _peak_speed(recording, motion, names.FLYWHEEL_STATES)),
        (('flywheel.peak_torque_n_m',), lambda: _peak_torque(recording, motion)),
        (('flywheel.peak_energy_j', 'flywheel.final_energy_j'),
         lambda: _peak_and_last(flywheel_energy(recording, motion, mechanism)[1])),
        (('energy.peak_flywheel_energy_j', 'energy.eq9_j_s', 'energy.work_j',
          'energy.copper_loss_j'), lambda: _energy(recording, motion)),
        (('loop.ticks', 'loop.rate_hz', 'loop.unrecorded_ticks'),
         lambda: _ticks(recording, motion)),
        (('loop.round_trip_p50_ms', 'loop.round_trip_p99_ms', 'loop.round_trip_max_ms'),
         lambda: _round_trip(recording, motion)),
        (('loop.lost',), lambda: _lost(recording, motion)),
    ]


def estimate_error(recording: Recording, motion: Motion) -> Paired:
    """
    Pair estimate and ground truth of all four links since the setpoint.

    :raises BagError: one of the two is not in the recording.
    """
    return pair(_within(recording, motion, names.ESTIMATE_LINK_STATES),
                _within(recording, motion, names.SIM_LINK_STATES), LINK_NAMES)


def flywheel_energy(recording: Recording, motion: Motion,
                    mechanism: Mechanism | None) -> tuple[Nanoseconds, Floats]:
    """
    Return stamps [ns] and the energy of the wheels there, paper eq. 7, from ground truth [J].

    :raises BagError: no ground truth in the recording, or no mechanism given.
    """
    if mechanism is None:
        raise BagError(f'the mechanism of {recording.path} is unknown: give --mechanism')
    links = _within(recording, motion, names.SIM_LINK_STATES).select(LINK_NAMES)
    wheels = _within(recording, motion, names.SIM_FLYWHEEL_STATES).select(FLYWHEEL_NAMES)
    both = pair(links, wheels, LINK_NAMES)
    relative = wheels.rows(np.isin(wheels.stamp_ns, both.stamp_ns)).velocity
    absolute = both.left.velocity + relative
    return both.stamp_ns, 0.5 * np.sum(mechanism.flywheel_inertias * absolute ** 2, axis=1)


def _within(recording: Recording, motion: Motion, name: str,
            end_ns: int | None = None) -> JointSeries:
    series = recording.joint_states(name).between(motion.start_ns, end_ns or motion.end_ns)
    if not len(series):
        raise BagError(f'{recording.path}: no message on {series.topic} since the setpoint')
    return series


def _describe(motion: Motion) -> dict[str, Any]:
    return {
        'setpoint_number': motion.setpoint_number,
        'setpoint_count': motion.setpoint_count,
        'start_stamp_ns': motion.start_ns,
        'setpoint_duration_s': (motion.step_end_ns - motion.start_ns) * 1e-9,
        'duration_s': (motion.end_ns - motion.start_ns) * 1e-9,
        'complete': motion.complete,
        'initial_rad': _by_link(motion.initial),
        'goal_rad': _by_link(motion.goal),
    }


def _by_link(angles: Floats) -> dict[str, float]:
    return {name: float(angle) for name, angle in zip(LINK_NAMES, angles) if np.isfinite(angle)}


def _tracking(recording: Recording, motion: Motion, actual: str) -> tuple[float, ...]:
    end_ns = min(motion.step_end_ns, motion.end_ns)
    return _rms_and_peak(pair(
        _within(recording, motion, actual, end_ns),
        _within(recording, motion, names.REFERENCE, end_ns), INDEPENDENT_LINKS).difference)


def _final_error(recording: Recording, motion: Motion, actual: str) -> tuple[float, ...]:
    if not motion.complete:
        raise BagError(f'{recording.path} ends before the step does')
    begin_ns = max(motion.step_end_ns, motion.end_ns - round(FINAL_WINDOW_S * 1e9))
    last = _within(recording, motion, actual).between(begin_ns, motion.end_ns)
    error = wrap_angles(last.select(INDEPENDENT_LINKS).position - motion.goal[:2])
    return (float(np.max(np.abs(np.nanmean(error, axis=0)))),)


def _within_2_sigma(recording: Recording, motion: Motion) -> tuple[float, ...]:
    error = estimate_error(recording, motion)
    both = pair(error.left, recording.joint_states(names.ESTIMATE_SIGMA), LINK_NAMES)
    known = np.isin(error.stamp_ns, both.stamp_ns)
    return (float(np.mean(np.abs(error.difference[known]) <= 2.0 * both.right.position)),)


def _mean_nis(recording: Recording, motion: Motion) -> tuple[float, ...]:
    # As received: one tick may bring several measurements, all with the stamp of the tick.
    innovation = recording.arrivals(names.ESTIMATE_INNOVATION).between(
        motion.start_ns, motion.end_ns).select(('nis', 'degrees_of_freedom')).position
    nis, degrees = np.nansum(innovation, axis=0)
    if not degrees > 0:
        raise BagError(f'{recording.path}: no innovation since the setpoint')
    return (float(nis / degrees),)


def _peak_speed(recording: Recording, motion: Motion, name: str) -> tuple[float, ...]:
    return (float(np.nanmax(np.abs(_within(recording, motion, name).velocity))),)


def _peak_torque(recording: Recording, motion: Motion) -> tuple[float, ...]:
    return (float(np.nanmax(np.abs(_within(recording, motion, names.FLYWHEEL_STATES).effort))),)


def _energy(recording: Recording, motion: Motion) -> tuple[float, ...]:
    energy, eq9, work, copper = _within(recording, motion, names.ENERGY).select(
        ('flywheel_energy_j', 'eq9_j_s', 'work_j', 'copper_loss_j')).position.T
    # Recordings from before it was told have none.
    told = np.isfinite(copper).any()
    return (float(np.nanmax(energy)), _growth(eq9), _growth(work),
            _growth(copper) if told else np.nan)


def _ticks(recording: Recording, motion: Motion) -> tuple[float, ...]:
    stamps = _within(recording, motion, names.TIMING).stamp_ns
    periods = np.diff(stamps)
    if not len(periods):
        raise BagError(f'{recording.path}: a single tick since the setpoint')
    skipped = np.sum(np.round(periods / np.median(periods)) - 1)
    return len(stamps), float(len(periods) / (periods.sum() * 1e-9)), int(skipped)


def _round_trip(recording: Recording, motion: Motion) -> tuple[float, ...]:
    trips = _within(recording, motion, names.TIMING).select(('round_trip_s',)).position * 1e3
    if np.all(np.isnan(trips)):
        raise BagError(f'{recording.path}: no tick was answered since the setpoint')
    p50, p99, worst = np.nanpercentile(trips, [50, 99, 100])
    return float(p50), float(p99), float(worst)


def _lost(recording: Recording, motion: Motion) -> tuple[float, ...]:
    lost = _within(recording, motion, names.TIMING).select(('lost',)).position[:, 0]
    if np.all(np.isnan(lost)):
        raise BagError(f'{recording.path}: timing does not count lost ticks')
    return (int(_growth(lost)),)


def _growth(total: Floats) -> float:
    """Add up the increments: a sum that began before the setpoint, or anew at it, is the same."""
    return float(np.sum(np.maximum(np.diff(total[np.isfinite(total)]), 0.0)))


def _rms_and_peak(values: Floats) -> tuple[float, ...]:
    return float(np.sqrt(np.nanmean(values ** 2))), float(np.nanmax(np.abs(values)))


def _peak_and_last(values: Floats) -> tuple[float, ...]:
    return float(np.max(values)), float(values[-1])
