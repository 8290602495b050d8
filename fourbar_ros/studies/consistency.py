# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Consistency of the estimator in random closed loops: NEES, NIS, whiteness, Cramer-Rao bound.

Matched cases have a table whose random torques follow the process noise model of the filter: there
the filter must be consistent, and a deviation is an error in the code. The prototype's table has
friction, drag, tilt, and late sensors that lose samples: there consistency depends on the tuning,
which has limits in the motion of the scenario and in one where the joints slide.
"""

from __future__ import annotations

from collections.abc import Iterable
import contextlib
from dataclasses import replace
from math import pi
from typing import Any, cast

from fourbar_ros.common.checks import at_least, at_most, Check, finite_or_none, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.estimation import STATE_NAMES
from fourbar_ros.loop import load_scenario, Scenario
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import assemble, LINK_NAMES
from fourbar_ros.plant.table import Disturbance, Table, WheelEncoders
from fourbar_ros.studies import csv_text, figures, Result, Sample
from fourbar_ros.studies.campaigns.workers import map_ordered
from fourbar_ros.studies.consistency_results import (
    CaseResult,
    ConsistencyCase,
    FREE,
    LAGS,
    RunSums,
)
from fourbar_ros.studies.consistency_runs import bound_of, execute
from fourbar_ros.studies.estimator_statistics import share_inside
import numpy as np

# Counts per turn of the wheel encoders of the prototype.
ENCODER_COUNTS = 16384

# Rotation of link b alone in the case where joints slide [rad].
RESHAPED_BY = pi / 4.0

# NEES of a consistent estimator: mean of chi-square with four degrees of freedom.
CONSISTENT = 4.0

TORQUE_NAMES = ('torque_a', 'torque_b')


def run(progress: Progress, sample: Sample) -> Result:
    """
    Run all cases and check them.

    :raises FourbarError: a scenario cannot be run, or a process died repeatedly.
    """
    # Once, and not in each process.
    warm_up()
    chosen = cases()
    scenarios = [replace(case.scenario, seed=sample.seed + number)
                 for case in chosen for number in range(sample.runs)]
    sums: list[RunSums] = []
    with contextlib.closing(map_ordered(execute, scenarios, sample.jobs)) as runs:
        done = cast(Iterable[RunSums], progress(runs, len(scenarios)))
        for number, each in enumerate(done):
            if number % sample.runs:
                sums[-1] += each
            else:
                sums.append(each)
    results = [CaseResult(case, each, bound_of(case.scenario, each))
               for case, each in zip(chosen, sums)]
    files: dict[str, str | bytes] = {'consistency.csv': _csv(results)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.consistency_figure import png
        files['consistency.png'] = png(results)
    data = {'runs': sample.runs, 'seed': sample.seed,
            'cases': {result.case.name: _data(result) for result in results}}
    return Result(checks(results), data, _table(results), files, skipped)


def cases() -> list[ConsistencyCase]:
    """
    Return the cases: the prototype's scenario on matched tables, on its own, and reshaping.

    :raises ConfigurationError, ScenarioError: the scenario is missing or broken.
    """
    scenario = load_scenario('prototype')
    return [
        ConsistencyCase('matched', 'matched', matched(scenario, 0)),
        ConsistencyCase('matched_encoders', 'matched, 14-bit', matched(scenario, ENCODER_COUNTS)),
        ConsistencyCase('prototype', 'prototype', scenario),
        ConsistencyCase('reshaping', 'reshaping', reshaping(scenario)),
    ]


def matched(scenario: Scenario, encoder_counts: int) -> Scenario:
    """
    Return a scenario on a table that follows the process noise model of its filter.

    The innovation gate is open, since it would cut off the tails of the distributions.

    :param encoder_counts: of the wheel encoders, which the filter assumes exact; 0 for exact ones.
    """
    settings = replace(scenario.estimator, gate_probability=1.0)
    sensors = replace(
        scenario.table.link_sensors, noise_rms=settings.angle_noise,
        counts_per_turn=settings.counts_per_turn, latency=0.0, dropout=0.0)
    table = Table(sensors, WheelEncoders(encoder_counts), disturbance=Disturbance(
        settings.disturbance_torque, settings.disturbance_walk))
    return replace(scenario, table=table, estimator=settings)


def reshaping(scenario: Scenario) -> Scenario:
    """Return a scenario that rotates link b alone, so that all joints slide."""
    initial, first = scenario.initial, scenario.setpoints[0]
    start = assemble(scenario.mechanism, initial.link_a, initial.link_b, initial.branch)
    setpoint = replace(first, names=LINK_NAMES[:2],
                       positions=(float(start[0]), float(start[1]) + RESHAPED_BY))
    return replace(scenario, setpoints=(setpoint,))


def checks(results: list[CaseResult]) -> list[Check]:
    """Return the checks of all cases; their limits are for 100 runs."""
    found = []
    for result in results:
        title, exact = result.case.title, result.case.name == 'matched'
        if exact:
            found += [
                at_least(f'{title}, steps with NEES in its 95 % bounds',
                         100.0 * share_inside(*result.nees), '%', 90.0),
                at_least(f'{title}, steps with NIS in its 95 % bounds',
                         100.0 * share_inside(*result.nis), '%', 90.0),
                at_least(f'{title}, autocorrelations in their 95 % bounds',
                         100.0 * result.white_share, '%', 90.0)]
        if result.case.matched:
            low, high = (0.95, 1.05) if exact else (0.9, 1.1)
            found += [within(f'{title}, rms error / bound, {name}', float(ratio), '', low, high)
                      for name, ratio in zip(STATE_NAMES, result.ratios)]
        elif result.case.tuned:
            found += [
                within(f'{title}, mean NEES', result.mean_nees, '', 2.0, 5.0),
                at_most(f'{title}, steps with NEES above its bound, outside reversals',
                        100.0 * result.above_when_calm, '%', 5.0),
                within(f'{title}, NIS per degree of freedom', result.nis_per_degree, '',
                       0.97, 1.03)]
            for place, moving in (('in motion', True), ('at rest', False)):
                angle, rate = np.degrees(result.rms(moving))
                found += [at_most(f'{title}, rms error of angles {place}', angle, 'deg', 0.025),
                          at_most(f'{title}, rms error of rates {place}', rate, 'deg/s', 0.2)]
        found.append(at_most(f'{title}, runs in which a sensor was named faulty',
                             result.sums.named, '', 0.0))
    return found


def _numbers(result: CaseResult) -> list[tuple[str, str, float]]:
    """Return the numbers of a case: key in JSON, text, value."""
    names = [*STATE_NAMES, *(TORQUE_NAMES if result.case.matched else ())]
    found = [
        ('mean_nees', f'NEES, mean ({CONSISTENT:g} if consistent)', result.mean_nees),
        ('nees_inside_percent', 'NEES, steps in its bounds [%]',
         100.0 * share_inside(*result.nees)),
        ('outside_reversals_percent', 'outside reversals, of all [%]',
         100.0 * result.calm_share),
        ('nees_above_outside_reversals_percent', 'NEES, above its bound there [%]',
         100.0 * result.above_when_calm),
        ('nis_per_degree', 'NIS per degree of freedom', result.nis_per_degree),
        ('nis_inside_percent', 'NIS, steps in its bounds [%]', 100.0 * share_inside(*result.nis)),
        ('autocorrelations_inside_percent', 'autocorrelations in bounds [%]',
         100.0 * result.white_share),
        *((f'rms_over_bound_{name}', f'rms error / bound, {name}', float(ratio))
          for name, ratio in zip(names, result.ratios))]
    for place, moving in (('in motion', True), ('at rest', False)):
        angle, rate = np.degrees(result.rms(moving))
        key = place.replace(' ', '_')
        found += [(f'angle_rms_{key}_deg', f'angles {place}, rms error [deg]', float(angle)),
                  (f'rate_rms_{key}_deg_s', f'rates {place}, rms error [deg/s]', float(rate))]
    found.append(('runs_with_a_sensor_named', 'runs with a sensor named faulty',
                  float(result.sums.named)))
    return found


def _data(result: CaseResult) -> dict[str, Any]:
    found, bounds = result.whiteness
    return {
        **{key: finite_or_none(value) for key, _, value in _numbers(result)},
        'autocorrelation': [[finite_or_none(value) for value in row] for row in found.tolist()],
        'autocorrelation_bounds': [finite_or_none(value) for value in bounds[:, 0].tolist()]}


def _table(results: list[CaseResult]) -> str:
    columns = [{text: value for _, text, value in _numbers(result)} for result in results]
    texts = list(dict.fromkeys(text for numbers in columns for text in numbers))
    titles = [result.case.title for result in results]
    runs = results[0].sums.runs
    lines = [f'{f"{runs} runs each" if runs > 1 else "one run each":<38}'
             + ''.join(f'{title:>17}' for title in titles)]
    lines += [f'{text:<38}' + ''.join(
        f'{numbers[text]:>17.4g}' if text in numbers else f'{"":>17}' for numbers in columns)
        for text in texts]
    lines.append(f'autocorrelations of four sensors at lags 1 to {LAGS}')
    return '\n'.join([*(line.rstrip() for line in lines), ''])


def _csv(results: list[CaseResult]) -> str:
    """Return the data of the figure, step by step."""
    columns = ['case', 't_s']
    columns += [f'{name}{end}' for name in ('nees', 'nis') for end in ('', '_low', '_high')]
    columns += [f'{kind}_{name}_{unit}' for kind in ('rms', 'bound')
                for name, unit in zip(STATE_NAMES, ('deg', 'deg', 'deg_s', 'deg_s'))]
    return csv_text(columns, (
        [result.case.name, *('' if value != value else f'{value:.5g}' for value in row)]
        for result in results for row in np.column_stack([
            result.times, *result.nees, *result.nis,
            *np.degrees(np.sqrt(result.mean_squares[:, :FREE])).T,
            *np.degrees(np.sqrt(result.bound[:, :FREE])).T]).tolist()))
