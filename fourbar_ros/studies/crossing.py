# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Can four wheels do at a change point what two cannot? The paper's claim for redundancy, and where.

At theta = 0 a rhombus may leave on another branch. Four wheels hold it on its branch by opposite
torques, fed back from eta = phi_c - phi_a; two wheels cannot. Three manoeuvres of the prototype on
its table, each by four wheels with that feedback, by four without, and by two, at random over
wheel inertias that the model has wrong, friction, heading and noise; and a map of a slow passage
over mismatch of the lengths, stiffness of the joints and time, where nothing may help.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import contextlib
from dataclasses import dataclass
import io
from math import inf, isfinite, radians
from typing import Any, cast

from fourbar_ros.common.checks import at_least, finite_or_none
from fourbar_ros.common.progress import Progress
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies import figures, Result, Sample
from fourbar_ros.studies.campaigns.workers import map_ordered
from fourbar_ros.studies.crossing_runs import Crossing, go, METHODS, Passage, Run
import numpy as np
from scipy.stats import binomtest

# So many of a hundred runs of four wheels with feedback must pass.
LEAST_PASSED = 99.0

# Of lengths that do not match, and of joints that give, in the slow passage [-], [N/m].
MISMATCH, STIFFNESS = 1e-3, 1e4

TITLES = {'four_held': 'four wheels, eta fed back', 'four': 'four wheels', 'two': 'two wheels'}


def _passage(half_width: float, time: float, **hard: float) -> Crossing:
    """Cross theta = 0 in a given time, from so far before it to as far behind it [rad], [s]."""
    return Crossing(((0.5, 0.0, -half_width, time),), half_width, time + 2.0, **hard)


CROSSINGS = {
    'motion': _passage(radians(40.0), 6.0),
    # Parks for 5 s and more, turns the whole by 45 deg, and leaves on the branch it came on.
    'parking': Crossing(
        ((0.5, 0.0, 0.0, 4.0), (9.5, radians(45.0), radians(45.0), 6.0),
         (17.0, radians(45.0), radians(15.0), 4.0)), radians(30.0), 22.5, stiffness=STIFFNESS),
    'mismatch': _passage(radians(20.0), 6.0, mismatch=MISMATCH, stiffness=STIFFNESS),
}
SAID = {
    'motion': 'crossing in motion, 80 deg in 6 s',
    'parking': 'parking 5 s at theta = 0, turning the whole by 45 deg there',
    'mismatch': 'slow crossing, 40 deg in 6 s, a link 1e-3 too long or short, joints of 1e4 N/m',
}

# The map.
MISMATCHES = (1e-4, 3e-4, 1e-3, 3e-3)
STIFFNESSES = (1e3, 1e4, 1e5, inf)
TIMES = (2.0, 6.0, 15.0)
# Of the map there are so many times fewer runs of each kind.
FEWER = 30


@dataclass(frozen=True, eq=False)
class Tally:
    """
    What came of runs of one kind.

    :param passages: of each run.
    """

    passages: Sequence[Passage]

    @property
    def runs(self) -> int:
        """How many there were."""
        return len(self.passages)

    @property
    def passed(self) -> int:
        """How many passed."""
        return sum(passage.passed for passage in self.passages)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the share that passes (Clopper and Pearson 1934)."""
        low, high = binomtest(self.passed, self.runs).proportion_ci()
        return float(low), float(high)

    @property
    def reasons(self) -> dict[str, int]:
        """How often what kept runs from passing."""
        reasons: dict[str, int] = {}
        for passage in self.passages:
            if passage.reason:
                reasons[passage.reason] = reasons.get(passage.reason, 0) + 1
        return reasons


def run(progress: Progress, sample: Sample) -> Result:
    """
    Make all runs and count.

    :raises FourbarError: a preset is broken, or a process died.
    """
    # Once, and not in each process.
    warm_up()
    kinds: list[tuple[Crossing, str, int]] = [
        (crossing, method, sample.runs) for crossing in CROSSINGS.values() for method in METHODS]
    cells = [(mismatch, stiffness, time) for time in TIMES for stiffness in STIFFNESSES
             for mismatch in MISMATCHES]
    fewer = max(1, sample.runs // FEWER)
    kinds += [(_passage(radians(20.0), time, mismatch=mismatch, stiffness=stiffness),
               'four_held', fewer) for mismatch, stiffness, time in cells]
    runs = [Run(crossing, method, sample.seed + number)
            for crossing, method, count in kinds for number in range(count)]
    with contextlib.closing(map_ordered(go, runs, sample.jobs)) as found:
        passages = list(cast(Iterable[Passage], progress(found, len(runs))))
    tallies, done = [], 0
    for _, _, count in kinds:
        tallies.append(Tally(passages[done:done + count]))
        done += count
    names = [(name, method) for name in CROSSINGS for method in METHODS]
    counted = dict(zip(names, tallies))
    of_map = dict(zip(cells, tallies[len(names):]))
    checks = [at_least(f'{SAID[name]}, {TITLES["four_held"]}, passed',
                       100.0 * counted[name, 'four_held'].passed / sample.runs, '%', LEAST_PASSED)
              for name in CROSSINGS]
    files: dict[str, str | bytes] = {'crossing.csv': _csv(counted, of_map)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.crossing_figure import png
        files['crossing.png'] = png(counted, of_map)
    data = {'runs': sample.runs, 'seed': sample.seed,
            'crossings': {name: {method: _data(counted[name, method]) for method in METHODS}
                          for name in CROSSINGS},
            'map': [{'mismatch': mismatch, 'stiffness_n_m': finite_or_none(stiffness),
                     'time_s': time, **_data(tally)}
                    for (mismatch, stiffness, time), tally in of_map.items()]}
    return Result(checks, data, _table(counted, of_map), files, skipped)


def success(of_map: dict[tuple[float, float, float], Tally], time: float) -> Array:
    """Return the share that passed (stiffnesses, mismatches) for one time of passage."""
    return np.array([[of_map[mismatch, stiffness, time].passed
                      / of_map[mismatch, stiffness, time].runs for mismatch in MISMATCHES]
                     for stiffness in STIFFNESSES])


def stiffness_text(stiffness: float) -> str:
    """Write a stiffness for people."""
    return f'{stiffness:.0e} N/m'.replace('e+0', 'e') if isfinite(stiffness) else 'rigid'


def _data(tally: Tally) -> dict[str, Any]:
    low, high = tally.interval
    return {
        'runs': tally.runs, 'passed': tally.passed, 'passed_low': low, 'passed_high': high,
        'largest_final_error_deg_of_passed': max(
            (float(np.degrees(passage.error)) for passage in tally.passages if passage.passed),
            default=None),
        'largest_eta_deg_of_passed': max(
            (float(np.degrees(passage.apart)) for passage in tally.passages if passage.passed),
            default=None),
        'reasons': tally.reasons}


def _table(counted: dict[tuple[str, str], Tally],
           of_map: dict[tuple[float, float, float], Tally]) -> str:
    lines = []
    for name in CROSSINGS:
        lines.append(SAID[name])
        for method in METHODS:
            tally = counted[name, method]
            low, high = (100.0 * bound for bound in tally.interval)
            lines.append(f'  {TITLES[method]:<28}{tally.passed:>5} of {tally.runs:<5}'
                         f'95 % confidence {low:5.1f} to {high:5.1f} %')
    lines.append('')
    runs = next(iter(of_map.values())).runs
    lines.append(f'slow crossing of 40 deg, {TITLES["four_held"]}: passed of {runs}')
    for time in TIMES:
        lines.append(f'  in {time:g} s' + ''.join(
            f'{f"mismatch {mismatch:g}":>18}' for mismatch in MISMATCHES))
        for stiffness in STIFFNESSES:
            lines.append(f'  {stiffness_text(stiffness):>10}' + ''.join(
                f'{of_map[mismatch, stiffness, time].passed:>15}' for mismatch in MISMATCHES))
    return '\n'.join([*lines, ''])


def _csv(counted: dict[tuple[str, str], Tally],
         of_map: dict[tuple[float, float, float], Tally]) -> str:
    """Return what the figure shows."""
    file = io.StringIO()
    file.write('kind,method,mismatch,stiffness_n_m,time_s,runs,passed,low,high\n')
    rows = [(name, method, CROSSINGS[name].mismatch, CROSSINGS[name].stiffness,
             CROSSINGS[name].duration, tally) for (name, method), tally in counted.items()]
    rows += [('map', 'four_held', *cell, tally) for cell, tally in of_map.items()]
    for kind, method, mismatch, stiffness, time, tally in rows:
        low, high = tally.interval
        file.write(f'{kind},{method},{mismatch:g},{stiffness:g},{time:g},{tally.runs},'
                   f'{tally.passed},{low:.4f},{high:.4f}\n')
    return file.getvalue()
