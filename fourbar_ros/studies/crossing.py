# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What four wheels can do at a change point that two wheels cannot: the paper's claim of redundancy.

At theta = 0 a rhombus may leave on another branch. Four wheels hold it on its branch by opposite
torques with feedback of eta = phi_c - phi_a; two wheels cannot. Three manoeuvres of the prototype
on its table are executed by four wheels with that feedback, by four without, and by two, with
random wheel inertias, friction, heading and noise. A map shows a slow crossing over mismatch of
the lengths, stiffness of the joints and time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import contextlib
from math import radians
from typing import Any, cast

from fourbar_ros.common.checks import at_least, finite_or_none
from fourbar_ros.common.progress import Progress
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.studies import csv_text, figures, Result, Sample
from fourbar_ros.studies.campaigns.workers import map_ordered
from fourbar_ros.studies.crossing_runs import (
    crossing,
    CrossingOutcome,
    CrossingRun,
    CrossingStatistics,
    execute,
    MANOEUVRES,
    Map,
    METHODS,
    MISMATCHES,
    stiffness_text,
    STIFFNESSES,
    TIMES,
)
import numpy as np

# Smallest share of runs of four wheels with feedback that must pass [%].
LEAST_PASSED = 99.0
DESCRIPTIONS = {
    'motion': 'crossing in motion, 80 deg in 6 s',
    'parking': 'parking 5 s at theta = 0, turning the whole by 45 deg there',
    'mismatch': 'slow crossing, 40 deg in 6 s, a link 1e-3 too long or short, joints of 1e4 N/m',
}
# Number of runs of a manoeuvre per run of a cell of the map.
MAP_DIVISOR = 30

# Statistics by manoeuvre and method.
Kinds = Mapping[tuple[str, str], CrossingStatistics]


def run(progress: Progress, sample: Sample) -> Result:
    """
    Execute all runs and count those that pass.

    :raises FourbarError: a preset is broken, or a process died repeatedly.
    """
    # Once, and not in each process.
    warm_up()
    names = [(name, method) for name in MANOEUVRES for method in METHODS]
    cells = [(mismatch, stiffness, time) for time in TIMES for stiffness in STIFFNESSES
             for mismatch in MISMATCHES]
    kinds = [(MANOEUVRES[name], method, sample.runs) for name, method in names]
    kinds += [(crossing(radians(20.0), time, mismatch, stiffness), 'four_held',
               max(1, sample.runs // MAP_DIVISOR)) for mismatch, stiffness, time in cells]
    runs = [CrossingRun(manoeuvre, method, sample.seed + number)
            for manoeuvre, method, count in kinds for number in range(count)]
    with contextlib.closing(map_ordered(execute, runs, sample.jobs)) as results:
        outcomes = list(cast(Iterable[CrossingOutcome], progress(results, len(runs))))
    statistics, first = [], 0
    for _, _, count in kinds:
        statistics.append(CrossingStatistics(outcomes[first:first + count]))
        first += count
    by_kind = dict(zip(names, statistics))
    of_map = dict(zip(cells, statistics[len(names):]))
    checks = [at_least(f'{DESCRIPTIONS[name]}, {METHODS["four_held"]}, passed',
                       100.0 * by_kind[name, 'four_held'].passed / sample.runs, '%', LEAST_PASSED)
              for name in MANOEUVRES]
    files: dict[str, str | bytes] = {'crossing.csv': _csv(by_kind, of_map)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.crossing_figure import png
        files['crossing.png'] = png(by_kind, of_map)
    data = {'runs': sample.runs, 'seed': sample.seed,
            'crossings': {name: {method: _data(by_kind[name, method]) for method in METHODS}
                          for name in MANOEUVRES},
            'map': [{'mismatch': mismatch, 'stiffness_n_m': finite_or_none(stiffness),
                     'time_s': time, **_data(each)}
                    for (mismatch, stiffness, time), each in of_map.items()]}
    return Result(checks, data, _table(by_kind, of_map), files, skipped)


def _data(statistics: CrossingStatistics) -> dict[str, Any]:
    low, high = statistics.interval
    passed = [outcome for outcome in statistics.outcomes if outcome.passed]
    return {
        'runs': statistics.runs, 'passed': len(passed), 'passed_low': low, 'passed_high': high,
        'largest_final_error_deg_of_passed': max(
            (float(np.degrees(outcome.error)) for outcome in passed), default=None),
        'largest_eta_deg_of_passed': max(
            (float(np.degrees(outcome.largest_eta)) for outcome in passed), default=None),
        'reasons': statistics.reasons}


def _table(by_kind: Kinds, of_map: Map) -> str:
    lines = []
    for name in MANOEUVRES:
        lines.append(DESCRIPTIONS[name])
        for method, title in METHODS.items():
            each = by_kind[name, method]
            low, high = (100.0 * bound for bound in each.interval)
            lines.append(f'  {title:<28}{each.passed:>5} of {each.runs:<5}'
                         f'95 % confidence {low:5.1f} to {high:5.1f} %')
    runs = next(iter(of_map.values())).runs
    lines += ['', f'slow crossing of 40 deg, {METHODS["four_held"]}: passed of {runs}']
    for time in TIMES:
        lines.append(f'  in {time:g} s' + ''.join(
            f'{f"mismatch {mismatch:g}":>18}' for mismatch in MISMATCHES))
        for stiffness in STIFFNESSES:
            lines.append(f'  {stiffness_text(stiffness):>10}' + ''.join(
                f'{of_map[mismatch, stiffness, time].passed:>15}' for mismatch in MISMATCHES))
    return '\n'.join([*lines, ''])


def _csv(by_kind: Kinds, of_map: Map) -> str:
    """Return the data of the figure."""
    rows = [(name, method, MANOEUVRES[name].mismatch, MANOEUVRES[name].stiffness,
             MANOEUVRES[name].duration, each) for (name, method), each in by_kind.items()]
    rows += [('map', 'four_held', *cell, each) for cell, each in of_map.items()]
    return csv_text(
        ['kind', 'method', 'mismatch', 'stiffness_n_m', 'time_s', 'runs', 'passed', 'low', 'high'],
        ([kind, method, f'{mismatch:g}', f'{stiffness:g}', f'{time:g}', each.runs, each.passed,
          *(f'{bound:.4f}' for bound in each.interval)]
         for kind, method, mismatch, stiffness, time, each in rows))
