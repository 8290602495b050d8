# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
A Monte Carlo campaign: random closed loops over any parameters of a scenario.

It reports the distributions of errors, wheel speeds and energy, the rate of failed runs, and the
drawn parameters that the metrics depend on. Each run can be repeated alone, and the folder keeps
finished runs (docs/campaigns.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
from functools import partial
from pathlib import Path
from typing import Any

from fourbar_ros.common.checks import finite_or_none
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.progress import Progress, resume_at
from fourbar_ros.loop.scenario import scenario_from
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies import cores, csv_text, figures, Result, Sample, StudyError
from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns.campaign import Campaign, load_campaign
from fourbar_ros.studies.campaigns.campaign_metrics import METRICS
from fourbar_ros.studies.campaigns.campaign_run import (
    compile_kernels,
    empty_row,
    execute_run,
    Row,
    WALL,
)
from fourbar_ros.studies.campaigns.campaign_summary import (
    checks_of,
    Correlation,
    correlations,
    QUANTILES,
    Statistics,
    statistics,
)
from fourbar_ros.studies.campaigns.cluster import ClusterWorkers
from fourbar_ros.studies.campaigns.parameter_names import MODEL, MODEL_NAMES
from fourbar_ros.studies.campaigns.result_folder import ResultFolder
from fourbar_ros.studies.campaigns.workers import completed, completed_locally
import numpy as np
import pyarrow as pa
from scipy.stats import binomtest
import yaml

# Work in a batch of runs, and an estimate of the work of a tick [s].
BATCH_TIME, TICK_TIME = 2.0, 3e-4
# Largest number of runs in a batch; their rows are stored together.
MOST_IN_BATCH = 32
PRINTED_CORRELATIONS = 10


def run(progress: Progress, folder: Path | None, campaign: str, runs: int | None = None,
        seed: int | None = None, jobs: int | None = None, scheduler: str | None = None,
        only: int | None = None) -> Result:
    """
    Execute the runs that are not finished, and summarise all.

    :param folder: where rows are stored.
    :param campaign: preset or path of a campaign file.
    :param runs, seed: replace those of the file.
    :param jobs: number of processes, without a scheduler.
    :param scheduler: address of a Dask scheduler, `tcp://HOST:PORT`.
    :param only: number of the one run to execute; it is not stored.
    :raises FourbarError: the campaign is refused, the folder belongs to another one, or the
        campaign ended early.
    """
    loaded = load_campaign(campaign, runs, seed)
    sample = Sample(loaded.runs, loaded.seed, cores() if jobs is None else jobs)
    loaded.check()
    if only is not None:
        return _repeat(loaded, only)
    if folder is None:
        raise StudyError('montecarlo needs a folder, where it stores finished runs')
    if scheduler is None:
        compile_kernels()
    with ResultFolder(folder, loaded) as results:
        stored = set(results.rows()['run'].to_pylist())
        if stored and max(stored) >= sample.runs:
            raise StudyError(
                f'{folder} holds finished runs up to number {max(stored)}, more than --runs '
                f'{sample.runs}: choose another --output', value=sample.runs, limit=max(stored))
        finished = len(stored)
        batches = _batches(loaded, [n for n in range(sample.runs) if n not in stored])
        execute = partial(execute_run, loaded)
        try:
            with contextlib.closing(
                    completed_locally(execute, batches, sample.jobs) if scheduler is None
                    else completed(ClusterWorkers(scheduler, loaded.versions), execute, batches,
                                   partial(_lost_row, loaded))) as batches_of_rows:
                shown = progress(_stored(batches_of_rows, results), sample.runs)
                resume_at(shown, finished)
                for _ in shown:
                    finished += 1
            rows_with_time = results.rows()
            table = results.finish()
        except FourbarError as error:
            if not finished:
                raise
            raise CampaignError(
                f'{error}; {finished} of {sample.runs} runs are finished and stored, the same '
                'command continues', finished=finished, **error.values) from None
    return _result(loaded, table, rows_with_time)


def _stored(batches_of_rows: Iterable[list[Row]], results: ResultFolder) -> Iterator[Row]:
    """Store rows before they count as finished."""
    for rows in batches_of_rows:
        results.add(rows)
        yield from rows


def _lost_row(campaign: Campaign, run: int) -> Row:
    return empty_row(campaign, run, 'every worker that executed it died, perhaps because memory '
                     'ran out')


def _batches(campaign: Campaign, runs: Sequence[int]) -> list[Sequence[int]]:
    ticks = scenario_from(campaign.description, Path()).ticks
    size = max(1, min(MOST_IN_BATCH, int(BATCH_TIME / (ticks * TICK_TIME))))
    return [runs[first:first + size] for first in range(0, len(runs), size)]


def _repeat(campaign: Campaign, run: int) -> Result:
    """Execute one run again."""
    if not 0 <= run < campaign.runs:
        raise StudyError(f'--only must be from 0 to {campaign.runs - 1}, got {run}', name='only',
                         value=run, limit=(0, campaign.runs - 1))
    row = execute_run(campaign, run)
    wall = row.pop(WALL)
    text = '\n'.join([f'{name:<44}{_cell(value)}' for name, value in row.items()])
    scenario = yaml.safe_dump({
        MODEL_NAMES[0] if key == MODEL else key: value
        for key, value in campaign.described(run).items()}, sort_keys=False)
    return Result([], {'row': row, WALL: wall}, text, {f'run_{run}.yaml': scenario},
                  document=f'run_{run}.json')


def _cell(value: Any) -> str:
    return '' if value is None else f'{value!r}' if isinstance(value, float) else f'{value}'


def _result(campaign: Campaign, table: pa.Table, table_with_time: pa.Table) -> Result:
    metrics = {name: _numbers(table, name) for name in METRICS}
    drawn = {name: _numbers(table, name) for name, kind in campaign.columns.items()
             if kind is not str}
    reasons = [reason for reason in table['failure'].to_pylist() if reason]
    summary = {name: statistics(values) for name, values in metrics.items()}
    strongest = correlations(drawn, metrics)
    rate_low, rate_high = binomtest(len(reasons), len(table)).proportion_ci()
    failures = {'runs': len(reasons), 'rate': len(reasons) / len(table),
                'rate_low': float(rate_low), 'rate_high': float(rate_high),
                'reasons': {reason: reasons.count(reason) for reason in dict.fromkeys(reasons)}}
    data = {
        'runs': len(table), 'seed': campaign.seed, 'campaign_hash': campaign.digest,
        'versions': dict(campaign.versions),
        'failures': failures,
        'metrics': {name: {'n': each.n, **{
            key: finite_or_none(value) for key, value in _columns(each).items()}}
            for name, each in summary.items()},
        'correlations': [vars(each) for each in strongest],
        'mean_wall_s_per_run': finite_or_none(statistics(_numbers(table_with_time, WALL)).mean)}
    files: dict[str, str | bytes] = {
        'summary.csv': csv_text(
            ['metric', 'unit', 'n', *_columns(next(iter(summary.values())))],
            ([name, METRICS[name].unit, each.n, *(
                f'{value:.9g}' if np.isfinite(value) else '' for value in _columns(each).values())]
             for name, each in summary.items())),
        'correlations.csv': csv_text(
            ['parameter', 'metric', 'n', 'rho', 'p_value'],
            ([each.parameter, each.metric, each.n, f'{each.rho:.6f}', f'{each.p_value:.3g}']
             for each in strongest))}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.montecarlo_figure import distributions_png, scatter_png
        files['montecarlo.png'] = distributions_png(metrics, summary, campaign.limits,
                                                    len(reasons))
        if strongest:
            files['montecarlo_parameters.png'] = scatter_png(
                campaign.parameters, drawn, metrics, strongest)
    return Result(checks_of(campaign.limits, metrics, len(reasons)), data,
                  _text(len(table), failures, summary, strongest), files, skipped)


def _numbers(table: pa.Table, name: str) -> Array:
    """Return a column as floats (runs,), NaN where it is empty."""
    values: Array = table[name].cast(pa.float64()).to_numpy(zero_copy_only=False)
    return np.array(values, dtype=float)


def _columns(each: Statistics) -> dict[str, float]:
    """Return the statistics of a metric by their names in JSON and CSV."""
    return {**{name: getattr(each, name) for name in ('mean', 'mean_low', 'mean_high', 'std')},
            **{f'quantile_{100.0 * share:02.0f}': value
               for share, value in zip(QUANTILES, each.quantiles)}}


def _text(runs: int, failures: Mapping[str, Any], summary: Mapping[str, Statistics],
          strongest: Sequence[Correlation]) -> str:
    rate, low, high = (100.0 * failures[key] for key in ('rate', 'rate_low', 'rate_high'))
    lines = [f'{runs} runs, {failures["runs"]} failed: {rate:.1f} % '
             f'(95 % confidence {low:.1f} to {high:.1f} %)']
    lines += [f'  {count} x {reason}' for reason, count in failures['reasons'].items()]
    heads = ('n', 'mean', '+-', 'std', *(f'{100.0 * share:.0f} %' for share in QUANTILES))
    lines += ['', f'{"":<32}' + ''.join(f'{head:>11}' for head in heads)]
    for name, each in summary.items():
        numbers = (each.mean, each.mean_high - each.mean, each.std, *each.quantiles)
        lines.append(f'{name:<32}{each.n:>11}' + ''.join(f'{value:>11.4g}' for value in numbers))
    if strongest:
        lines += ['', 'strongest rank correlations']
        lines += [f'  {each.rho:+.2f}  {each.metric} with {each.parameter}'
                  for each in strongest[:PRINTED_CORRELATIONS]]
    return '\n'.join([*lines, ''])
