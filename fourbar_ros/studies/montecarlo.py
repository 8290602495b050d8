# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Closed loops at random over anything that a scenario says: a campaign, as its file describes it.

How errors, wheels and energy spread, how often a run fails, and which of the drawn parameters
that depends on. Each run can be made again alone; runs that are finished are kept in the folder
(docs/campaigns.md).
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
import contextlib
from functools import partial
import io
from pathlib import Path
from typing import Any

from fourbar_ros.common.checks import finite_or_none
from fourbar_ros.common.progress import Progress, resume_at
from fourbar_ros.loop.scenario import scenario_from
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies import cores, figures, Result, Sample, StudyError
from fourbar_ros.studies.campaigns.cluster import on_cluster
from fourbar_ros.studies.campaigns.file import Campaign, load_campaign
from fourbar_ros.studies.campaigns.folder import CampaignFolder
from fourbar_ros.studies.campaigns.processes import as_ready, CampaignError
from fourbar_ros.studies.campaigns.run import do_batch, do_run, METRICS, prepared, Row, WALL
from fourbar_ros.studies.campaigns.summary import (
    checks_of,
    Correlation,
    correlations,
    numeric_columns,
    QUANTILES,
    Statistics,
    statistics,
)
from fourbar_ros.studies.proportions import share_interval
import numpy as np
import pyarrow as pa
import yaml

# Runs are given away in batches of about so much work [s], guessed from what a tick takes [s].
BATCH, TICK = 2.0, 3e-4
MOST_IN_BATCH = 32
# So many of the strongest correlations are printed.
PRINTED = 10


def run(progress: Progress, folder: Path | None, campaign: str, runs: int | None = None,
        seed: int | None = None, jobs: int | None = None, scheduler: str | None = None,
        only: int | None = None) -> Result:
    """
    Make the runs that are not finished, and sum up.

    :param folder: where rows are kept.
    :param campaign: preset or path of a campaign file.
    :param runs, seed: instead of those of the file.
    :param jobs: processes, where there is no scheduler.
    :param scheduler: of a Dask cluster, `tcp://HOST:PORT`.
    :param only: the one run to make, which is not kept.
    :raises FourbarError: the campaign is refused, the folder is not its own, or it was cut short.
    """
    described = load_campaign(campaign, runs, seed)
    sample = Sample(described.runs, described.seed, cores() if jobs is None else jobs)
    described.check()
    if only is not None:
        return _one(described, only)
    if folder is None:
        raise StudyError('montecarlo needs a folder, where it keeps finished runs')
    if scheduler is None:
        prepared()
    with CampaignFolder(folder, described) as kept:
        done = set(kept.rows()['run'].to_pylist())
        if done and max(done) >= sample.runs:
            raise StudyError(f'{folder} holds finished runs up to number {max(done)}, more than '
                             f'--runs {sample.runs}: choose another --output')
        batches = _batches(described, [n for n in range(sample.runs) if n not in done])
        found = (as_ready(partial(do_batch, described), batches, sample.jobs)
                 if scheduler is None else on_cluster(described, batches, scheduler))
        finished = len(done)
        try:
            with contextlib.closing(found), contextlib.closing(_kept(found, kept)) as rows:
                shown = progress(rows, sample.runs)
                resume_at(shown, finished)
                for _ in shown:
                    finished += 1
            rows_with_time = kept.rows()
            table = kept.finish()
        except CampaignError as error:
            if not finished:
                raise
            raise CampaignError(f'{error}; {finished} of {sample.runs} runs are finished and '
                                'kept, the same command goes on') from None
    return _result(described, table, rows_with_time)


def _kept(found: Generator[list[Row], None, None], folder: CampaignFolder
          ) -> Generator[Row, None, None]:
    """Keep rows before they count as finished."""
    for rows in found:
        folder.add(rows)
        yield from rows


def _batches(campaign: Campaign, runs: Sequence[int]) -> list[Sequence[int]]:
    ticks = scenario_from(campaign.description, Path()).ticks
    size = max(1, min(MOST_IN_BATCH, int(BATCH / (ticks * TICK))))
    return [runs[first:first + size] for first in range(0, len(runs), size)]


def _one(campaign: Campaign, number: int) -> Result:
    """Make one run again."""
    if not 0 <= number < campaign.runs:
        raise StudyError(f'--only must be from 0 to {campaign.runs - 1}, got {number}')
    prepared()
    row = do_run(campaign, number)
    wall = row.pop(WALL)
    text = '\n'.join([f'{name:<44}{_text(value)}' for name, value in row.items()])
    scenario = yaml.safe_dump(campaign.described(number), sort_keys=False)
    return Result([], {'row': row, WALL: wall}, text, {f'run_{number}.yaml': scenario},
                  document=f'run_{number}.json')


def _result(campaign: Campaign, table: pa.Table, with_time: pa.Table) -> Result:
    metrics = {name: _column(table, name) for name in METRICS}
    drawn = {name: _column(table, name) for name in numeric_columns(campaign)}
    reasons = [reason for reason in table['failure'].to_pylist() if reason]
    described = {name: statistics(values) for name, values in metrics.items()}
    strongest = correlations(drawn, metrics)
    low, high = share_interval(len(reasons), len(table))
    walls = _column(with_time, WALL)
    data = {
        'runs': len(table), 'seed': campaign.seed, 'campaign_hash': campaign.hash,
        'versions': dict(campaign.versions),
        'failures': {'runs': len(reasons), 'rate': len(reasons) / len(table),
                     'rate_low': low, 'rate_high': high,
                     'reasons': {reason: reasons.count(reason)
                                 for reason in dict.fromkeys(reasons)}},
        'metrics': {name: _as_json(each) for name, each in described.items()},
        'correlations': [vars(each) for each in strongest],
        'mean_wall_s_per_run': finite_or_none(statistics(walls).mean)}
    files: dict[str, str | bytes] = {
        'summary.csv': _summary_csv(described), 'correlations.csv': _correlations_csv(strongest)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.montecarlo_figure import distributions_png, scatter_png
        files['montecarlo.png'] = distributions_png(metrics, described, campaign.limits,
                                                    len(reasons))
        if strongest:
            files['montecarlo_parameters.png'] = scatter_png(
                campaign.parameters, drawn, metrics, strongest)
    return Result(checks_of(campaign.limits, metrics, len(reasons)), data,
                  _text_of(data, described, strongest), files, skipped)


def _column(table: pa.Table, name: str) -> Array:
    """Return a column as numbers (runs,), NaN for none."""
    values: Array = table[name].cast(pa.float64()).to_numpy(zero_copy_only=False)
    return np.array(values, dtype=float)


def _as_json(found: Statistics) -> dict[str, Any]:
    return {'n': found.n, **{name: finite_or_none(getattr(found, name)) for name in (
        'mean', 'mean_low', 'mean_high', 'std')}, **{
            _quantile_name(share): finite_or_none(value)
            for share, value in zip(QUANTILES, found.quantiles)}}


def _quantile_name(share: float) -> str:
    return f'quantile_{100.0 * share:02.0f}'


def _text(value: Any) -> str:
    return '' if value is None else f'{value!r}' if isinstance(value, float) else f'{value}'


def _text_of(data: dict[str, Any], described: dict[str, Statistics],
             strongest: Sequence[Correlation]) -> str:
    failures = data['failures']
    lines = [f'{data["runs"]} runs, {failures["runs"]} failed: '
             f'{100.0 * failures["rate"]:.1f} % (95 % confidence '
             f'{100.0 * failures["rate_low"]:.1f} to {100.0 * failures["rate_high"]:.1f} %)']
    lines += [f'  {count} x {reason}' for reason, count in failures['reasons'].items()]
    heads = ('n', 'mean', '+-', 'std', *(f'{100.0 * share:.0f} %' for share in QUANTILES))
    lines += ['', f'{"":<32}' + ''.join(f'{head:>11}' for head in heads)]
    for name, found in described.items():
        numbers = (found.mean, found.mean_high - found.mean, found.std, *found.quantiles)
        lines.append(f'{name:<32}{found.n:>11}' + ''.join(f'{each:>11.4g}' for each in numbers))
    if strongest:
        lines += ['', 'strongest rank correlations']
        lines += [f'  {each.rho:+.2f}  {each.metric} with {each.parameter}'
                  for each in strongest[:PRINTED]]
    return '\n'.join([*lines, ''])


def _summary_csv(described: dict[str, Statistics]) -> str:
    file = io.StringIO()
    names = ['mean', 'mean_low', 'mean_high', 'std']
    file.write(','.join(['metric', 'unit', 'n', *names, *map(_quantile_name, QUANTILES)]) + '\n')
    for name, found in described.items():
        numbers = [getattr(found, each) for each in names] + list(found.quantiles)
        file.write(','.join([name, METRICS[name].unit, str(found.n), *(
            f'{each:.9g}' if np.isfinite(each) else '' for each in numbers)]) + '\n')
    return file.getvalue()


def _correlations_csv(found: Sequence[Correlation]) -> str:
    file = io.StringIO()
    file.write('parameter,metric,n,rho,p_value\n')
    for each in found:
        file.write(f'{each.parameter},{each.metric},{each.n},{each.rho:.6f},{each.p_value:.3g}\n')
    return file.getvalue()
