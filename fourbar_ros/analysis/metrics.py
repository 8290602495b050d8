# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Metrics of one manoeuvre in a bag: tracking, estimate, wheels, energy, loop timing.

Samples are selected by their stamps; :mod:`fourbar_ros.analysis.manoeuvre` defines which.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
import warnings

from fourbar_ros.analysis.bag_reader import bag_error, BagError
from fourbar_ros.analysis.bags import Bag, Floats, Nanoseconds
from fourbar_ros.analysis.manoeuvre import (
    find_manoeuvre,
    Manoeuvre,
    match_stamps,
    MatchedSeries,
)
from fourbar_ros.common import names
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
import numpy as np

INDEPENDENT_LINKS = LINK_NAMES[:2]
# Averaging time of the final error [s].
FINAL_WINDOW_S = 1.0


class MetricDescription(NamedTuple):
    """
    Description of a metric.

    :param unit: also the suffix of the name.
    :param meaning: one sentence.
    """

    unit: str
    meaning: str


METRICS = {
    'tracking.rms_rad': MetricDescription(
        'rad', 'Ground truth minus reference of links a and b, root mean square over all samples '
        'of both from the setpoint to the end of the step.'),
    'tracking.peak_rad': MetricDescription(
        'rad', 'Largest absolute value of the difference in tracking.rms_rad.'),
    'tracking.final_error_rad': MetricDescription(
        'rad', 'Ground truth minus goal, averaged over the last second at the goal; the larger '
        'of links a and b.'),
    'tracking.estimated_rms_rad': MetricDescription(
        'rad', 'As tracking.rms_rad with the estimate in place of ground truth, as available on '
        'hardware.'),
    'tracking.estimated_peak_rad': MetricDescription(
        'rad', 'Largest absolute value of the difference in tracking.estimated_rms_rad.'),
    'tracking.estimated_final_error_rad': MetricDescription(
        'rad', 'As tracking.final_error_rad with the estimate in place of ground truth.'),
    'estimate.rms_error_rad': MetricDescription(
        'rad', 'Estimate minus ground truth of the angles of all four links, root mean square '
        'since the setpoint.'),
    'estimate.peak_error_rad': MetricDescription(
        'rad', 'Largest absolute value of the difference in estimate.rms_error_rad.'),
    'estimate.within_2_sigma': MetricDescription(
        '1', "Share of estimate errors within two standard deviations of the filter's "
        'covariance; 0.95 for a consistent filter.'),
    'estimate.mean_nis_per_degree_of_freedom': MetricDescription(
        '1', 'Normalized innovation squared over its degrees of freedom, mean since the '
        'setpoint; 1 for a consistent filter.'),
    'flywheel.peak_speed_rad_s': MetricDescription(
        'rad/s', 'Largest wheel speed relative to its link, ground truth.'),
    'flywheel.measured_peak_speed_rad_s': MetricDescription(
        'rad/s', 'Largest wheel speed relative to its link, as measured by the wheel encoders.'),
    'flywheel.peak_torque_n_m': MetricDescription('N m', 'Largest applied motor torque.'),
    'flywheel.peak_energy_j': MetricDescription(
        'J', 'Paper eq. 7, sum of If/2 times absolute wheel speed squared: peak, ground truth.'),
    'flywheel.final_energy_j': MetricDescription(
        'J', 'Paper eq. 7 at the end, ground truth.'),
    'energy.peak_flywheel_energy_j': MetricDescription(
        'J', "Paper eq. 7: peak of the controller's estimate."),
    'energy.eq9_j_s': MetricDescription(
        'J s', 'Paper eq. 9, accumulated by the controller since the setpoint.'),
    'energy.work_j': MetricDescription(
        'J', 'Mechanical work of the motors, the integral of |torque times relative speed|, '
        'accumulated since the setpoint.'),
    'energy.copper_loss_j': MetricDescription(
        'J', 'Heat in the motor windings, the integral of resistance times current squared as '
        'estimated by the controller, accumulated since the setpoint; 0 for motors without '
        'winding data.'),
    'loop.rate_hz': MetricDescription(
        'Hz', 'Ticks per second of stamp time since the setpoint.'),
    'loop.ticks': MetricDescription('1', 'Ticks since the setpoint.'),
    'loop.round_trip_p50_ms': MetricDescription(
        'ms', 'Time from a tick to the command that answers it, at the device, median.'),
    'loop.round_trip_p99_ms': MetricDescription('ms', 'Round trip, 99th percentile.'),
    'loop.round_trip_max_ms': MetricDescription('ms', 'Round trip, largest.'),
    'loop.lost': MetricDescription(
        '1', 'Ticks without an answering command within one control period.'),
    'loop.unrecorded_ticks': MetricDescription(
        '1', 'Ticks missing in the bag, from gaps between stamps.'),
}


def compute_metrics(bag: Bag, mechanism: Mechanism | None = None) -> dict[str, Any]:
    """
    Return every metric that the bag supports, nested, for JSON.

    :param mechanism: required for the flywheel energy of paper eq. 7.
    :returns: `motion`, the groups of `METRICS`, and `missing`: reason by name.
    :raises BagError: an essential topic is missing, or no setpoint was followed.
    """
    manoeuvre = find_manoeuvre(bag)
    values: dict[str, float] = {}
    missing: dict[str, str] = {}
    for keys, measure in _measurements(manoeuvre, mechanism):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter('ignore', RuntimeWarning)  # nanmax of NaN only
                values.update(zip(keys, measure()))
        except BagError as error:
            missing.update(dict.fromkeys(keys, str(error)))
    for name in [name for name, value in values.items() if not np.isfinite(value)]:
        del values[name]
        missing[name] = f'{bag.path}: the messages lack this value'
    result: dict[str, Any] = {'motion': _describe(manoeuvre)}
    for name in METRICS:
        group, _, key = name.partition('.')
        result.setdefault(group, {})
        if name in values:
            result[group][key] = values[name]
    result['missing'] = missing
    return result


_Measurement = tuple[tuple[str, ...], Callable[[], tuple[float, ...]]]


def _measurements(of: Manoeuvre, mechanism: Mechanism | None) -> list[_Measurement]:
    """Return the names of metrics with the functions that measure them."""
    return [
        (('tracking.rms_rad', 'tracking.peak_rad'), lambda: _tracking(of, names.SIM_LINK_STATES)),
        (('tracking.final_error_rad',), lambda: _final_error(of, names.SIM_LINK_STATES)),
        (('tracking.estimated_rms_rad', 'tracking.estimated_peak_rad'),
         lambda: _tracking(of, names.ESTIMATE_LINK_STATES)),
        (('tracking.estimated_final_error_rad',),
         lambda: _final_error(of, names.ESTIMATE_LINK_STATES)),
        (('estimate.rms_error_rad', 'estimate.peak_error_rad'),
         lambda: _rms_and_peak(_estimate_error(of).difference)),
        (('estimate.within_2_sigma',), lambda: _within_2_sigma(of)),
        (('estimate.mean_nis_per_degree_of_freedom',), lambda: _mean_nis(of)),
        (('flywheel.peak_speed_rad_s',),
         lambda: _peak(of.series(names.SIM_FLYWHEEL_STATES).velocity)),
        (('flywheel.measured_peak_speed_rad_s',),
         lambda: _peak(of.series(names.FLYWHEEL_STATES).velocity)),
        (('flywheel.peak_torque_n_m',), lambda: _peak(of.series(names.FLYWHEEL_STATES).effort)),
        (('flywheel.peak_energy_j', 'flywheel.final_energy_j'),
         lambda: _peak_and_last(flywheel_energy(of, mechanism)[1])),
        (('energy.peak_flywheel_energy_j', 'energy.eq9_j_s', 'energy.work_j',
          'energy.copper_loss_j'), lambda: _energy(of)),
        (('loop.ticks', 'loop.rate_hz', 'loop.unrecorded_ticks'), lambda: _ticks(of)),
        (('loop.round_trip_p50_ms', 'loop.round_trip_p99_ms', 'loop.round_trip_max_ms'),
         lambda: _round_trip(of)),
        (('loop.lost',), lambda: _lost(of)),
    ]


def flywheel_energy(manoeuvre: Manoeuvre, mechanism: Mechanism | None
                    ) -> tuple[Nanoseconds, Floats]:
    """
    Return stamps [ns] and energy of the wheels, paper eq. 7, from ground truth [J].

    :raises BagError: the bag has no ground truth, or no mechanism is given.
    """
    if mechanism is None:
        raise bag_error(manoeuvre.bag.path, 'no_data',
                        ': its mechanism is unknown, give --mechanism')
    links = manoeuvre.series(names.SIM_LINK_STATES).select(LINK_NAMES)
    wheels = manoeuvre.series(names.SIM_FLYWHEEL_STATES).select(FLYWHEEL_NAMES)
    matched = match_stamps(links, wheels, LINK_NAMES)
    relative = wheels.rows(np.isin(wheels.stamp_ns, matched.stamp_ns)).velocity
    absolute = matched.left.velocity + relative
    return matched.stamp_ns, 0.5 * np.sum(mechanism.flywheel_inertias * absolute ** 2, axis=1)


def _describe(manoeuvre: Manoeuvre) -> dict[str, Any]:
    return {
        'setpoint_number': manoeuvre.setpoint_number,
        'setpoint_count': manoeuvre.setpoint_count,
        'start_stamp_ns': manoeuvre.start_ns,
        'setpoint_duration_s': (manoeuvre.step_end_ns - manoeuvre.start_ns) * 1e-9,
        'duration_s': (manoeuvre.end_ns - manoeuvre.start_ns) * 1e-9,
        'complete': manoeuvre.complete,
        'initial_rad': _by_link(manoeuvre.initial),
        'goal_rad': _by_link(manoeuvre.goal),
    }


def _by_link(angles: Floats) -> dict[str, float]:
    return {name: float(angle) for name, angle in zip(LINK_NAMES, angles) if np.isfinite(angle)}


def _estimate_error(manoeuvre: Manoeuvre) -> MatchedSeries:
    return match_stamps(manoeuvre.series(names.ESTIMATE_LINK_STATES),
                        manoeuvre.series(names.SIM_LINK_STATES), LINK_NAMES)


def _tracking(manoeuvre: Manoeuvre, actual: str) -> tuple[float, ...]:
    end_ns = min(manoeuvre.step_end_ns, manoeuvre.end_ns)
    return _rms_and_peak(match_stamps(
        manoeuvre.series(actual, end_ns), manoeuvre.series(names.REFERENCE, end_ns),
        INDEPENDENT_LINKS).difference)


def _final_error(manoeuvre: Manoeuvre, actual: str) -> tuple[float, ...]:
    if not manoeuvre.complete:
        raise bag_error(manoeuvre.bag.path, 'no_data', ' ends before the step does')
    begin_ns = max(manoeuvre.step_end_ns, manoeuvre.end_ns - round(FINAL_WINDOW_S * 1e9))
    last = manoeuvre.series(actual).between(begin_ns, manoeuvre.end_ns)
    error = wrap_angles(last.select(INDEPENDENT_LINKS).position - manoeuvre.goal[:2])
    return (float(np.max(np.abs(np.nanmean(error, axis=0)))),)


def _within_2_sigma(manoeuvre: Manoeuvre) -> tuple[float, ...]:
    error = _estimate_error(manoeuvre)
    sigma = match_stamps(error.left, manoeuvre.bag.joint_states(names.ESTIMATE_SIGMA), LINK_NAMES)
    matched = np.isin(error.stamp_ns, sigma.stamp_ns)
    return (float(np.mean(np.abs(error.difference[matched]) <= 2.0 * sigma.right.position)),)


def _mean_nis(manoeuvre: Manoeuvre) -> tuple[float, ...]:
    # In order of reception: several measurements of one tick carry the same stamp.
    innovation = manoeuvre.bag.arrivals(names.ESTIMATE_INNOVATION).between(
        manoeuvre.start_ns, manoeuvre.end_ns).select(('nis', 'degrees_of_freedom')).position
    nis, degrees = np.nansum(innovation, axis=0)
    if not degrees > 0:
        raise bag_error(manoeuvre.bag.path, 'no_data', ': no innovation since the setpoint',
                        topic=names.ESTIMATE_INNOVATION)
    return (float(nis / degrees),)


def _energy(manoeuvre: Manoeuvre) -> tuple[float, ...]:
    energy, eq9, work, copper = manoeuvre.series(names.ENERGY).select(
        ('flywheel_energy_j', 'eq9_j_s', 'work_j', 'copper_loss_j')).position.T
    # Older bags have no copper loss.
    known = np.isfinite(copper).any()
    return (float(np.nanmax(energy)), _growth(eq9), _growth(work),
            _growth(copper) if known else np.nan)


def _ticks(manoeuvre: Manoeuvre) -> tuple[float, ...]:
    stamps = manoeuvre.series(names.TIMING).stamp_ns
    periods = np.diff(stamps)
    if not len(periods):
        raise bag_error(manoeuvre.bag.path, 'no_data', ': a single tick since the setpoint',
                        topic=names.TIMING)
    skipped = np.sum(np.round(periods / np.median(periods)) - 1)
    return len(stamps), float(len(periods) / (periods.sum() * 1e-9)), int(skipped)


def _timing(manoeuvre: Manoeuvre, scalar: str) -> Floats:
    values = manoeuvre.series(names.TIMING).select((scalar,)).position[:, 0]
    if np.all(np.isnan(values)):
        raise bag_error(manoeuvre.bag.path, 'no_data', f': timing has no {scalar} since the '
                        'setpoint', topic=names.TIMING, name=scalar)
    return values


def _round_trip(manoeuvre: Manoeuvre) -> tuple[float, ...]:
    p50, p99, largest = np.nanpercentile(_timing(manoeuvre, 'round_trip_s') * 1e3, [50, 99, 100])
    return float(p50), float(p99), float(largest)


def _lost(manoeuvre: Manoeuvre) -> tuple[float, ...]:
    return (int(_growth(_timing(manoeuvre, 'lost'))),)


def _growth(total: Floats) -> float:
    """Add up the increments, independent of where the sum began or was reset."""
    return float(np.sum(np.maximum(np.diff(total[np.isfinite(total)]), 0.0)))


def _peak(values: Floats) -> tuple[float, ...]:
    return (float(np.nanmax(np.abs(values))),)


def _rms_and_peak(values: Floats) -> tuple[float, ...]:
    return float(np.sqrt(np.nanmean(values ** 2))), float(np.nanmax(np.abs(values)))


def _peak_and_last(values: Floats) -> tuple[float, ...]:
    return float(np.max(values)), float(values[-1])
