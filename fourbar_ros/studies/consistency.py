# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Does the estimator know how well it knows? Closed loops at random, many, and what they say.

Matched cases have a table whose random torques are those that the filter believes in: there it
has to be right, and what is not is an error in the code. The prototype's table has friction, drag,
tilt, and late sensors that lose samples: how right it is there is a matter of its tuning, which
has its limits in the motion that the scenario tells, where joints hardly slide. What becomes of it
where they do is reported.
"""

from __future__ import annotations

from collections.abc import Iterable
import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
import io
from math import nan, pi
from typing import Any, cast

from fourbar_ros.common.checks import at_least, at_most, Check, finite_or_none, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.estimation import STATE_NAMES
from fourbar_ros.loop import load_scenario, Scenario
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import assemble, LINK_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant.table import Disturbance, Table, WheelEncoders
from fourbar_ros.studies import figures, Result, Sample
from fourbar_ros.studies.campaigns.workers import map_ordered
from fourbar_ros.studies.consistency_runs import bound_of, follow, FREE, LAGS, Tally
from fourbar_ros.studies.estimator_statistics import (
    autocorrelation,
    chi_square_bounds,
    share_inside,
)
import numpy as np
from numpy.typing import NDArray

ENCODER_COUNTS = 16384

# The configuration changes by so much, link b alone, where joints are to slide [rad].
RESHAPED_BY = pi / 4.0

# Errors in motion and at rest are looked at when the start has been forgotten [s].
SETTLED_AT = 1.0

# A chi-square of four degrees of freedom has this mean.
CONSISTENT = 4.0

TORQUE_NAMES = ('torque_a', 'torque_b')


@dataclass(frozen=True)
class Case:
    """
    Runs of one kind.

    :param name: in JSON and tables.
    :param title: for people.
    :param scenario: what is run, but for the seed.
    """

    name: str
    title: str
    scenario: Scenario

    @property
    def matched(self) -> bool:
        """Whether the torques that act are those that the filter believes in."""
        return self.scenario.table.disturbance.torque_walk > 0.0

    @property
    def tuned(self) -> bool:
        """Whether it is what the prototype's tuning is held to."""
        return self.name in ('prototype', 'reshaping')


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    What the runs of a case say.

    :param case: of what.
    :param tally: sums over the runs.
    """

    case: Case
    tally: Tally

    @cached_property
    def times(self) -> Array:
        """Time of each step since the first tick (steps,) [s]."""
        times: Array = np.arange(len(self.tally.estimates)) / self.case.scenario.plant.rate
        return times

    @cached_property
    def bound(self) -> Array:
        """Posterior Cramer-Rao bound of each number of the state (steps, 6), squared."""
        bounds: Array = np.diagonal(bound_of(self.case.scenario, self.tally), axis1=1, axis2=2)
        return bounds

    @cached_property
    def mean_squares(self) -> Array:
        """Mean square error of each number of the state (steps, 6)."""
        return _per(self.tally.squares, self.tally.estimates[:, np.newaxis])

    @cached_property
    def ratios(self) -> Array:
        """Rms error over its bound (6,), every step counting alike."""
        shares = self.mean_squares / self.bound
        known = np.isfinite(shares).all(axis=1)
        ratios: Array = np.sqrt(np.mean(shares[known], axis=0)) if known.any() else np.full(6, nan)
        return ratios

    @cached_property
    def nees(self) -> tuple[Array, Array, Array]:
        """NEES, mean over the runs at each step, and its bounds, each (steps,)."""
        estimates = self.tally.estimates
        low, high = chi_square_bounds(FREE * estimates)
        return _per(self.tally.nees, estimates), _per(low, estimates), _per(high, estimates)

    @cached_property
    def nis(self) -> tuple[Array, Array, Array]:
        """NIS per degree of freedom, likewise."""
        degrees = self.tally.degrees
        low, high = chi_square_bounds(degrees)
        return _per(self.tally.nis, degrees), _per(low, degrees), _per(high, degrees)

    @cached_property
    def whiteness(self) -> tuple[Array, Array]:
        """Autocorrelation of the innovations at lags 1 to LAGS, and its bounds, (lags, links)."""
        return autocorrelation(self.tally.products, self.tally.pairs)

    @property
    def mean_nees(self) -> float:
        """NEES, mean over runs and steps."""
        return _mean(self.tally.nees, self.tally.estimates)

    @property
    def nis_per_degree(self) -> float:
        """NIS per degree of freedom, over runs and steps."""
        return _mean(self.tally.nis, self.tally.degrees)

    @property
    def calm_share(self) -> float:
        """Share of the steps, of all runs, that are outside friction reversals."""
        return _mean(self.tally.calm, self.tally.estimates)

    @property
    def above_when_calm(self) -> float:
        """
        Share of the steps at which NEES is above its upper bound, outside friction reversals.

        At each step the mean over the runs that are outside one counts.
        """
        known = self.tally.calm > 0
        if not known.any():
            return nan
        _, high = chi_square_bounds(FREE * self.tally.calm[known])
        return float(np.mean(self.tally.calm_nees[known] > high))

    @property
    def white_share(self) -> float:
        """Share of the autocorrelations, over lags and sensors, inside their bounds."""
        found, bounds = self.whiteness
        return share_inside(found, -bounds, bounds)

    def rms(self, moving: bool) -> tuple[float, float]:
        """Return the rms errors of the worst link in motion, or at rest [rad], [rad/s]."""
        scenario, times = self.case.scenario, self.times
        in_motion = np.zeros(len(times), dtype=bool)
        for setpoint in scenario.setpoints:
            duration = setpoint.duration or scenario.controller.setpoint_duration
            in_motion |= (times >= setpoint.at) & (times <= setpoint.at + duration)
        chosen: NDArray[np.bool_] = (in_motion == moving) & (times >= SETTLED_AT)
        squares = self.tally.link_squares[chosen].sum(axis=0)
        count = self.tally.estimates[chosen].sum()
        if not count:
            return nan, nan
        links = np.sqrt(squares / count)
        return float(links[:4].max()), float(links[4:].max())


def run(progress: Progress, sample: Sample) -> Result:
    """
    Run all cases and weigh them.

    :raises FourbarError: a scenario cannot be run, or a process died.
    """
    # Once, and not in each process.
    warm_up()
    chosen = cases()
    scenarios = [replace(case.scenario, seed=sample.seed + number)
                 for case in chosen for number in range(sample.runs)]
    tallies: list[Tally] = []
    with contextlib.closing(map_ordered(follow, scenarios, sample.jobs)) as runs:
        done = cast(Iterable[Tally], progress(runs, len(scenarios)))
        for number, tally in enumerate(done):
            if number % sample.runs:
                tallies[-1] += tally
            else:
                tallies.append(tally)
    outcomes = [Outcome(case, tally) for case, tally in zip(chosen, tallies)]
    files: dict[str, str | bytes] = {'consistency.csv': _csv(outcomes)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.consistency_figure import png
        files['consistency.png'] = png(outcomes)
    data = {'runs': sample.runs, 'seed': sample.seed,
            'cases': {outcome.case.name: _data(outcome) for outcome in outcomes}}
    return Result(checks(outcomes), data, _table(outcomes), files, skipped)


def cases() -> list[Case]:
    """
    Return what is run: the prototype's scenario on matched tables, on its own, and reshaping.

    :raises ConfigurationError, ScenarioError: the scenario is missing or broken.
    """
    scenario = load_scenario('prototype')
    return [
        Case('matched', 'matched', matched(scenario, 0)),
        Case('matched_encoders', 'matched, 14-bit', matched(scenario, ENCODER_COUNTS)),
        Case('prototype', 'prototype', scenario),
        Case('reshaping', 'reshaping', reshaping(scenario)),
    ]


def matched(scenario: Scenario, encoder_counts: int) -> Scenario:
    """
    Return a scenario on a table where nothing acts but what its filter believes in.

    The gate would cut off the tails of the distributions that are to be looked at: it is open.

    :param encoder_counts: of the wheel encoders, which the filter takes as exact, 0 for none.
    """
    settings = replace(scenario.estimator, gate_probability=1.0)
    sensors = replace(
        scenario.table.link_sensors, noise_rms=settings.angle_noise,
        counts_per_turn=settings.counts_per_turn, latency=0.0, dropout=0.0)
    table = Table(sensors, WheelEncoders(encoder_counts), disturbance=Disturbance(
        settings.disturbance_torque, settings.disturbance_walk))
    return replace(scenario, table=table, estimator=settings)


def reshaping(scenario: Scenario) -> Scenario:
    """Return a scenario in which link b alone is turned, so that all joints slide."""
    initial, first = scenario.initial, scenario.setpoints[0]
    start = assemble(scenario.mechanism, initial.link_a, initial.link_b, initial.branch)
    setpoint = replace(first, names=LINK_NAMES[:2],
                       positions=(float(start[0]), float(start[1]) + RESHAPED_BY))
    return replace(scenario, setpoints=(setpoint,))


def checks(outcomes: list[Outcome]) -> list[Check]:
    """Return the checks on all cases; their limits are those of 100 runs."""
    found = []
    for outcome in outcomes:
        title, exact = outcome.case.title, outcome.case.name == 'matched'
        if exact:
            found += [
                at_least(f'{title}, steps with NEES in its 95 % bounds',
                         100.0 * share_inside(*outcome.nees), '%', 90.0),
                at_least(f'{title}, steps with NIS in its 95 % bounds',
                         100.0 * share_inside(*outcome.nis), '%', 90.0),
                at_least(f'{title}, autocorrelations in their 95 % bounds',
                         100.0 * outcome.white_share, '%', 90.0)]
        if outcome.case.matched:
            low, high = (0.95, 1.05) if exact else (0.9, 1.1)
            found += [within(f'{title}, rms error / bound, {name}', float(ratio), '', low, high)
                      for name, ratio in zip(STATE_NAMES, outcome.ratios)]
        elif outcome.case.tuned:
            found += [
                within(f'{title}, mean NEES', outcome.mean_nees, '', 2.0, 5.0),
                at_most(f'{title}, steps with NEES above its bound, outside reversals',
                        100.0 * outcome.above_when_calm, '%', 5.0),
                within(f'{title}, NIS per degree of freedom', outcome.nis_per_degree, '',
                       0.97, 1.03)]
            for place, moving in (('in motion', True), ('at rest', False)):
                angle, rate = np.degrees(outcome.rms(moving))
                found += [at_most(f'{title}, rms error of angles {place}', angle, 'deg', 0.025),
                          at_most(f'{title}, rms error of rates {place}', rate, 'deg/s', 0.2)]
        found.append(at_most(f'{title}, runs in which a sensor was named faulty',
                             outcome.tally.named, '', 0.0))
    return found


def _numbers(outcome: Outcome) -> list[tuple[str, str, float]]:
    """Return what is told of a case: name in JSON, text, value."""
    names = [*STATE_NAMES, *(TORQUE_NAMES if outcome.case.matched else ())]
    found = [
        ('mean_nees', f'NEES, mean ({CONSISTENT:g} if consistent)', outcome.mean_nees),
        ('nees_inside_percent', 'NEES, steps in its bounds [%]',
         100.0 * share_inside(*outcome.nees)),
        ('outside_reversals_percent', 'outside reversals, of all [%]',
         100.0 * outcome.calm_share),
        ('nees_above_outside_reversals_percent', 'NEES, above its bound there [%]',
         100.0 * outcome.above_when_calm),
        ('nis_per_degree', 'NIS per degree of freedom', outcome.nis_per_degree),
        ('nis_inside_percent', 'NIS, steps in its bounds [%]', 100.0 * share_inside(*outcome.nis)),
        ('autocorrelations_inside_percent', 'autocorrelations in bounds [%]',
         100.0 * outcome.white_share),
        *((f'rms_over_bound_{name}', f'rms error / bound, {name}', float(ratio))
          for name, ratio in zip(names, outcome.ratios))]
    for place, moving in (('in motion', True), ('at rest', False)):
        angle, rate = np.degrees(outcome.rms(moving))
        key = place.replace(' ', '_')
        found += [(f'angle_rms_{key}_deg', f'angles {place}, rms error [deg]', float(angle)),
                  (f'rate_rms_{key}_deg_s', f'rates {place}, rms error [deg/s]', float(rate))]
    found.append(('runs_with_a_sensor_named', 'runs with a sensor named faulty',
                  float(outcome.tally.named)))
    return found


def _data(outcome: Outcome) -> dict[str, Any]:
    found, bounds = outcome.whiteness
    return {
        **{key: finite_or_none(value) for key, _, value in _numbers(outcome)},
        'autocorrelation': [[finite_or_none(value) for value in row] for row in found.tolist()],
        'autocorrelation_bounds': [finite_or_none(value) for value in bounds[:, 0].tolist()]}


def _table(outcomes: list[Outcome]) -> str:
    told = [{text: value for _, text, value in _numbers(outcome)} for outcome in outcomes]
    texts = list(dict.fromkeys(text for numbers in told for text in numbers))
    titles = [outcome.case.title for outcome in outcomes]
    runs = outcomes[0].tally.runs
    lines = [f'{f"{runs} runs each" if runs > 1 else "one run each":<38}'
             + ''.join(f'{title:>17}' for title in titles)]
    lines += [f'{text:<38}' + ''.join(
        f'{numbers[text]:>17.4g}' if text in numbers else f'{"":>17}' for numbers in told)
        for text in texts]
    lines.append(f'autocorrelations of four sensors at lags 1 to {LAGS}')
    return '\n'.join([*(line.rstrip() for line in lines), ''])


def _csv(outcomes: list[Outcome]) -> str:
    """Return what the figure shows of each step."""
    file = io.StringIO()
    columns = ['case', 't_s']
    columns += [f'{name}{end}' for name in ('nees', 'nis') for end in ('', '_low', '_high')]
    columns += [f'{kind}_{name}_{unit}' for kind in ('rms', 'bound')
                for name, unit in zip(STATE_NAMES, ('deg', 'deg', 'deg_s', 'deg_s'))]
    file.write(','.join(columns) + '\n')
    for outcome in outcomes:
        numbers = np.column_stack([
            outcome.times, *outcome.nees, *outcome.nis,
            *np.degrees(np.sqrt(outcome.mean_squares[:, :FREE])).T,
            *np.degrees(np.sqrt(outcome.bound[:, :FREE])).T])
        for row in numbers.tolist():
            cells = ['' if value != value else f'{value:.5g}' for value in row]
            file.write(','.join([outcome.case.name, *cells]) + '\n')
    return file.getvalue()


def _per(sums: NDArray[Any], counts: NDArray[np.int64]) -> Array:
    """Divide, NaN where nothing was counted."""
    means: Array = np.where(counts > 0, sums / np.maximum(counts, 1), nan)
    return means


def _mean(sums: NDArray[Any], counts: NDArray[np.int64]) -> float:
    count = int(counts.sum())
    return float(sums.sum()) / count if count else nan
