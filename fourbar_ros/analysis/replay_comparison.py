# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""How far a replay is from the recorded estimates, and both from the ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from fourbar_ros.analysis.bags import Floats, JointSeries, Nanoseconds
from fourbar_ros.analysis.replay import Replay, ReplayError, Side
from fourbar_ros.estimation.estimator_settings import SETTINGS
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.mechanism.angles import wrap_angles
import numpy as np

SKIP_S = 1.0
"""A filter needs a moment to find the rates; what it says before would outweigh the rest [s]."""

DIFFERENCES = ('replayed_minus_recorded', 'recorded_minus_truth', 'replayed_minus_truth')
ROWS = (('angle_rms_rad', 'angle, rms [deg]'), ('angle_max_rad', 'angle, max [deg]'),
        ('rate_rms_rad_s', 'rate, rms [deg/s]'), ('rate_max_rad_s', 'rate, max [deg/s]'))


@dataclass(frozen=True, eq=False)
class Difference:
    """
    One series of link states minus another, where both have the same stamp.

    :param stamp_ns: (n,) [ns].
    :param angles: (n, 4) in (-pi, pi] [rad].
    :param rates: (n, 4) [rad/s].
    """

    stamp_ns: Nanoseconds
    angles: Floats
    rates: Floats

    def later(self, from_ns: int) -> Difference:
        """Leave out what is before a stamp."""
        kept = self.stamp_ns >= from_ns
        return Difference(self.stamp_ns[kept], self.angles[kept], self.rates[kept])


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    A replay beside what was recorded.

    :param from_ns: stamp from which on the numbers count.
    :param replayed_minus_recorded: None where the bag has no estimates.
    :param recorded_minus_truth: None where it has no estimates or no ground truth.
    :param replayed_minus_truth: None where it has no ground truth.
    :param identical: whether both sides have the same stamps and values to the last bit; None
        where the bag has no estimates.
    """

    replay: Replay
    from_ns: int
    replayed_minus_recorded: Difference | None
    recorded_minus_truth: Difference | None
    replayed_minus_truth: Difference | None
    identical: bool | None

    def differences(self) -> Iterator[tuple[str, Difference]]:
        """Go through those that there are, by name."""
        for name in DIFFERENCES:
            if (difference := getattr(self, name)) is not None:
                yield name, difference


def compare(replay: Replay, skip: float = SKIP_S) -> Comparison:
    """
    Bring the two sides and the ground truth together.

    :param skip: how long after the first estimates of both sides the numbers begin to count [s].
    :raises ReplayError: no estimate at all came of the replay, or none so late.
    """
    replayed = replay.replayed.states.series('replayed')
    recorded = replay.recorded.states.series('recorded')
    truth = replay.truth.series('truth')
    if not len(replayed):
        raise ReplayError('no estimate came of it: the estimator waited for samples that it '
                          'could use, or refused every tick ' + _refusals(replay.replayed))
    # Either may have begun late: a node that was started after the others.
    first_ns = max(int(each.stamp_ns[0]) for each in (replayed, recorded) if len(each))
    from_ns = first_ns + round(skip * 1e9)
    if not np.any(replayed.stamp_ns >= from_ns):
        raise ReplayError(f'the replay has no estimate {skip:g} s after both sides have begun: '
                          'skip less')
    return Comparison(
        replay, from_ns, _difference(replayed, recorded), _difference(recorded, truth),
        _difference(replayed, truth), _identical(replayed, recorded))


def _refusals(side: Side) -> str:
    rejected = side.judgements.rejected if side.judgements is not None else {}
    return f'(rejected: {_counts(rejected)})'


def _difference(left: JointSeries, right: JointSeries) -> Difference | None:
    stamps, in_left, in_right = np.intersect1d(
        left.stamp_ns, right.stamp_ns, assume_unique=True, return_indices=True)
    if not len(stamps):
        return None
    return Difference(stamps, wrap_angles(left.position[in_left] - right.position[in_right]),
                      left.velocity[in_left] - right.velocity[in_right])


def _identical(replayed: JointSeries, recorded: JointSeries) -> bool | None:
    if not len(recorded):
        return None
    return all(np.array_equal(getattr(replayed, name), getattr(recorded, name))
               for name in ('stamp_ns', 'position', 'velocity'))


def as_json(comparison: Comparison) -> dict[str, Any]:
    """Return all numbers, nested, units at the end of their names; None for what is not known."""
    replay = comparison.replay
    first_ns = replay.ticks_ns[0]
    return {
        'bag': replay.bag.absolute().name,
        'namespace': replay.namespace or '/',
        'mechanism': replay.mechanism,
        'settings': dict(replay.settings),
        'ticks': len(replay.ticks_ns),
        'ticks_without_estimate': replay.waiting,
        'duration_s': (replay.ticks_ns[-1] - first_ns) * 1e-9,
        'compared_from_s': (comparison.from_ns - first_ns) * 1e-9,
        'identical': comparison.identical,
        **dict.fromkeys(DIFFERENCES),
        **{name: _statistics(difference.later(comparison.from_ns))
           for name, difference in comparison.differences()},
        'nis_per_degree_of_freedom': {
            'recorded': mean_nis(replay.recorded, comparison.from_ns),
            'replayed': mean_nis(replay.replayed, comparison.from_ns)},
        'recorded': _judgements(replay.recorded),
        'replayed': _judgements(replay.replayed),
        'warnings': replay.warnings,
    }


def _statistics(difference: Difference) -> dict[str, Any] | None:
    """Return rms and largest of each link; NaN, which a message left out, does not count."""
    if not len(difference.stamp_ns):
        return None
    found: dict[str, Any] = {'samples': len(difference.stamp_ns)}
    for link, name in enumerate(LINK_NAMES):
        values = {}
        for kind, unit, array in (('angle', 'rad', difference.angles),
                                  ('rate', 'rad_s', difference.rates)):
            known = array[np.isfinite(array[:, link]), link]
            values[f'{kind}_rms_{unit}'] = (
                float(np.sqrt(np.mean(known ** 2))) if len(known) else None)
            values[f'{kind}_max_{unit}'] = (
                float(np.max(np.abs(known))) if len(known) else None)
        found[name] = values
    return found


def mean_nis(side: Side, from_ns: int) -> float | None:
    """Return NIS over degrees of freedom from a stamp on, None without an update."""
    rows = side.nis.rows()
    rows = rows[rows[:, 0] >= from_ns]
    return float(rows[:, 1].sum() / rows[:, 2].sum()) if len(rows) else None


def _judgements(side: Side) -> dict[str, Any] | None:
    return None if side.judgements is None else asdict(side.judgements)


COLUMN, LABEL = 12, 32


def as_text(comparison: Comparison) -> str:
    """Return the comparison as a table to be read, in degrees."""
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
    lines += ['', f'{"from " + format(data["compared_from_s"], "g") + " s on":<{LABEL}}'
              + ''.join(f'{name:>{COLUMN}}' for name in LINK_NAMES)]
    for name, _ in comparison.differences():
        lines += _rows(name, data[name])
    if comparison.identical is None:
        lines.append('no estimates in the bag to compare with')
    elif comparison.identical:
        lines.append('replayed and recorded estimates are equal to the last bit')
    lines += ['', f'{"":<{LABEL}}{"recorded":>{COLUMN}}{"replayed":>{COLUMN}}']
    nis = data['nis_per_degree_of_freedom']
    lines.append(f'{"NIS per degree of freedom":<{LABEL}}' + ''.join(
        f'{_number(nis[side]):>{COLUMN}}' for side in ('recorded', 'replayed')))
    lines += _judgement_rows(data['recorded'], data['replayed'])
    return '\n'.join(lines)


def _rows(name: str, statistics: dict[str, Any] | None) -> list[str]:
    title = name.replace('_minus_', ' - ').replace('truth', 'ground truth')
    if statistics is None:
        return [f'{title}: nothing so late']
    rows = [title]
    for key, label in ROWS:
        values = [statistics[link][key] for link in LINK_NAMES]
        rows.append(f'{"  " + label:<{LABEL}}' + ''.join(
            f'{_number(None if value is None else np.degrees(value)):>{COLUMN}}'
            for value in values))
    return rows


def _judgement_rows(recorded: dict[str, Any] | None, replayed: dict[str, Any]) -> list[str]:
    """Return a row for all that one of the sides counts; `-` where the bag does not tell."""
    rows = []

    def add(label: str, left: Any, right: Any) -> None:
        known = '-' if recorded is None else left
        rows.append(f'{label:<{LABEL}}{known:>{COLUMN}}{right:>{COLUMN}}')

    other = recorded or {'starts': 0, 'rejected': {}, 'gated': {}, 'faults': {}}
    add('starts of the filter', other['starts'], replayed['starts'])
    for kind, label in (('rejected', 'rejected messages'), ('gated', 'gated samples')):
        add(label, sum(other[kind].values()), sum(replayed[kind].values()))
        for name in sorted({*other[kind], *replayed[kind]}):
            add(f'  {name}', other[kind].get(name, 0), replayed[kind].get(name, 0))
    faults = sorted({*other['faults'], *replayed['faults']})
    if not faults:
        add('sensor faults', 'none', 'none')
    else:
        rows.append('sensor faults')
    for fault in faults:
        seconds = replayed['faults'].get(fault)
        add(f'  {fault}', 'named' if fault in other['faults'] else 'no',
            'no' if seconds is None else f'{seconds:.3g} s')
    return rows


def _number(value: float | None) -> str:
    return '-' if value is None else f'{value:.4g}'


def _counts(counts: dict[str, int]) -> str:
    return ', '.join(f'{name} {count}' for name, count in sorted(counts.items())) or 'none'
