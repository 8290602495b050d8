# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Differences between replayed estimates, recorded estimates and ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from fourbar_ros.analysis.bags import Floats, JointSeries, Nanoseconds
from fourbar_ros.analysis.replay import (
    EstimatorCounters,
    EstimatorRecord,
    ReplayError,
    ReplayResult,
)
from fourbar_ros.estimation.estimator_settings import SETTINGS
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.mechanism.angles import wrap_angles
import numpy as np

# Default of the time without statistics after the start of both filters, whose rates have not
# converged yet [s].
SKIP_S = 1.0

DIFFERENCES = ('replayed_minus_recorded', 'recorded_minus_truth', 'replayed_minus_truth')
ROWS = (('angle_rms_rad', 'angle, rms [deg]'), ('angle_max_rad', 'angle, max [deg]'),
        ('rate_rms_rad_s', 'rate, rms [deg/s]'), ('rate_max_rad_s', 'rate, max [deg/s]'))
SOURCES = ('recorded', 'replayed')


@dataclass(frozen=True, eq=False)
class StateDifference:
    """
    Difference of two series of link states at their common stamps.

    :param stamp_ns: (n,) [ns].
    :param angles: (n, 4) in (-pi, pi] [rad].
    :param rates: (n, 4) [rad/s].
    """

    stamp_ns: Nanoseconds
    angles: Floats
    rates: Floats

    def since(self, from_ns: int) -> StateDifference:
        """Return the part from a stamp on."""
        kept = self.stamp_ns >= from_ns
        return StateDifference(self.stamp_ns[kept], self.angles[kept], self.rates[kept])


@dataclass(frozen=True, eq=False)
class ReplayComparison:
    """
    Comparison of a replay with the recorded estimates and ground truth.

    :param from_ns: first stamp of the statistics [ns].
    :param replayed_minus_recorded: None without estimates in the bag.
    :param recorded_minus_truth: None without estimates or ground truth in the bag.
    :param replayed_minus_truth: None without ground truth in the bag.
    :param identical: whether stamps and values of both estimates are equal bit for bit; None
        without estimates in the bag.
    """

    replay: ReplayResult
    from_ns: int
    replayed_minus_recorded: StateDifference | None
    recorded_minus_truth: StateDifference | None
    replayed_minus_truth: StateDifference | None
    identical: bool | None

    def differences(self) -> Iterator[tuple[str, StateDifference]]:
        """Iterate over the available differences by name."""
        for name in DIFFERENCES:
            if (difference := getattr(self, name)) is not None:
                yield name, difference

    def seconds(self, stamp_ns: Nanoseconds | list[int]) -> Floats:
        """Return the time since the first tick [s]."""
        return (np.array(stamp_ns) - self.replay.ticks_ns[0]).astype(np.float64) * 1e-9


def compare(replay: ReplayResult, skip: float = SKIP_S) -> ReplayComparison:
    """
    Compare replayed estimates, recorded estimates and ground truth.

    :param skip: time after the first estimates of both filters without statistics [s].
    :raises ReplayError: the replay has no estimate, or none after this time.
    """
    replayed, recorded, truth = (log.series(name).by_stamp() for name, log in (
        ('replayed', replay.replayed.states), ('recorded', replay.recorded.states),
        ('truth', replay.truth)))
    if not len(replayed):
        rejected = replay.replayed.counters.rejected if replay.replayed.counters else {}
        counts = ', '.join(f'{name} {count}' for name, count in sorted(rejected.items()))
        raise ReplayError('the replay has no estimate: the estimator received no usable samples '
                          f'or rejected every tick (rejected: {counts or "none"})',
                          reason='no_estimate', rejected=rejected)
    # The later of both starts: nodes start one after the other.
    first_ns = max(int(series.stamp_ns[0]) for series in (replayed, recorded) if len(series))
    from_ns = first_ns + round(skip * 1e9)
    if not np.any(replayed.stamp_ns >= from_ns):
        raise ReplayError(f'the replay has no estimate {skip:g} s after the start of both '
                          'filters: reduce --skip', reason='skip', name='skip', value=skip)
    return ReplayComparison(
        replay, from_ns, _difference(replayed, recorded), _difference(recorded, truth),
        _difference(replayed, truth), _identical(replayed, recorded))


def _difference(left: JointSeries, right: JointSeries) -> StateDifference | None:
    stamps, in_left, in_right = np.intersect1d(
        left.stamp_ns, right.stamp_ns, assume_unique=True, return_indices=True)
    if not len(stamps):
        return None
    return StateDifference(stamps, wrap_angles(left.position[in_left] - right.position[in_right]),
                           left.velocity[in_left] - right.velocity[in_right])


def _identical(replayed: JointSeries, recorded: JointSeries) -> bool | None:
    if not len(recorded):
        return None
    return all(np.array_equal(getattr(replayed, name), getattr(recorded, name))
               for name in ('stamp_ns', 'position', 'velocity'))


def as_json(comparison: ReplayComparison) -> dict[str, Any]:
    """Return all numbers, nested, with units as suffixes of their names; None for unknown."""
    replay = comparison.replay
    duration_s, from_s = comparison.seconds([replay.ticks_ns[-1], comparison.from_ns]).tolist()
    counters = {source: getattr(replay, source).counters for source in SOURCES}
    return {
        'bag': replay.bag.absolute().name,
        'namespace': replay.namespace or '/',
        'mechanism': replay.mechanism,
        'settings': dict(replay.settings),
        'ticks': len(replay.ticks_ns),
        'ticks_without_estimate': replay.waiting,
        'duration_s': duration_s,
        'compared_from_s': from_s,
        'identical': comparison.identical,
        **dict.fromkeys(DIFFERENCES),
        **{name: _statistics(difference.since(comparison.from_ns))
           for name, difference in comparison.differences()},
        'nis_per_degree_of_freedom': {
            source: mean_nis(getattr(replay, source), comparison.from_ns) for source in SOURCES},
        **{source: asdict(of_one) if of_one else None for source, of_one in counters.items()},
        'warnings': replay.warnings,
    }


def _statistics(difference: StateDifference) -> dict[str, Any] | None:
    """Return rms and largest absolute difference of each link; NaN is left out."""
    if not len(difference.stamp_ns):
        return None
    statistics: dict[str, Any] = {'samples': len(difference.stamp_ns)}
    for link, name in enumerate(LINK_NAMES):
        statistics[name] = {}
        for kind, unit, array in (('angle', 'rad', difference.angles),
                                  ('rate', 'rad_s', difference.rates)):
            known = array[np.isfinite(array[:, link]), link]
            statistics[name][f'{kind}_rms_{unit}'] = (
                float(np.sqrt(np.mean(known ** 2))) if len(known) else None)
            statistics[name][f'{kind}_max_{unit}'] = (
                float(np.max(np.abs(known))) if len(known) else None)
    return statistics


def mean_nis(record: EstimatorRecord, from_ns: int) -> float | None:
    """Return NIS over degrees of freedom from a stamp on, None without an update."""
    stamps, nis, degrees = record.nis()
    kept = stamps >= from_ns
    return float(nis[kept].sum() / degrees[kept].sum()) if kept.any() else None


COLUMN, LABEL = 12, 32


def as_text(comparison: ReplayComparison) -> str:
    """Return the comparison as a table for the terminal, in degrees."""
    data = as_json(comparison)
    without = data['ticks_without_estimate']
    lines = [
        f'{data["bag"]}, namespace {data["namespace"]}: {data["ticks"]} ticks in '
        f'{data["duration_s"]:.1f} s' + (f', {without} without estimate' if without else ''),
        f'  {"mechanism":<20} {data["mechanism"]}']
    for row in SETTINGS:
        value, unit = data['settings'][row.name], f' {row.unit}' if row.unit else ''
        lines.append(f'  {row.name:<20} {value:g}{unit}' if isinstance(value, float)
                     else f'  {row.name:<20} {value}{unit}')
    lines += ['', _row(f'from {data["compared_from_s"]:g} s on', *LINK_NAMES)]
    for name, _ in comparison.differences():
        title = name.replace('_minus_', ' - ').replace('truth', 'ground truth')
        statistics = data[name]
        lines.append(title if statistics else f'{title}: no sample in this time')
        for key, label in ROWS if statistics else ():
            values = [statistics[link][key] for link in LINK_NAMES]
            lines.append(_row(f'  {label}', *(
                None if value is None else float(np.degrees(value)) for value in values)))
    if comparison.identical is None:
        lines.append('the bag has no estimates for a comparison')
    elif comparison.identical:
        lines.append('replayed and recorded estimates are equal bit for bit')
    lines += ['', _row('', *SOURCES), _row('NIS per degree of freedom', *(
        data['nis_per_degree_of_freedom'][source] for source in SOURCES))]
    return '\n'.join([*lines, *_counter_rows(data['recorded'], data['replayed'])])


def _row(label: str, *values: Any) -> str:
    """Return a line of the table: label and columns."""
    texts = ('-' if value is None else f'{value:.4g}' if isinstance(value, float) else f'{value}'
             for value in values)
    return f'{label:<{LABEL}}' + ''.join(f'{text:>{COLUMN}}' for text in texts)


def _counter_rows(recorded: dict[str, Any] | None, replayed: dict[str, Any]) -> list[str]:
    """Return a line for each counter of either filter; `-` where the bag has none."""
    known = recorded or asdict(EstimatorCounters())

    def row(label: str, left: Any, right: Any) -> str:
        return _row(label, left if recorded else None, right)

    rows = [row('starts of the filter', known['starts'], replayed['starts'])]
    for kind, label in (('rejected', 'rejected messages'), ('gated', 'gated samples')):
        left, right = known[kind], replayed[kind]
        rows.append(row(label, sum(left.values()), sum(right.values())))
        rows += [row(f'  {name}', left.get(name, 0), right.get(name, 0))
                 for name in sorted({*left, *right})]
    faults = sorted({*known['faults'], *replayed['faults']})
    rows.append('sensor faults' if faults else row('sensor faults', 'none', 'none'))
    for fault in faults:
        seconds = replayed['faults'].get(fault)
        rows.append(row(f'  {fault}', 'reported' if fault in known['faults'] else 'no',
                        'no' if seconds is None else f'{seconds:.3g} s'))
    return rows
