# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Runs of a campaign: metrics, repetition of a run, and statistics over all runs."""

from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
import json
from math import nan
from pathlib import Path
from typing import Any

from fourbar_ros.cli.main import main
from fourbar_ros.loop import load_scenario, record_run
from fourbar_ros.studies import montecarlo
from fourbar_ros.studies.campaigns.campaign import campaign_from, Limit, load_campaign
from fourbar_ros.studies.campaigns.campaign_metrics import METRICS
from fourbar_ros.studies.campaigns.campaign_run import execute_run, measure, WALL
from fourbar_ros.studies.campaigns.campaign_summary import checks_of, correlations, statistics
import numpy as np
from PIL import Image
import pyarrow.parquet
import pytest
from scipy.stats import rankdata
from scipy.stats import t as student


@pytest.mark.medium
def test_metrics_equal_those_of_the_published_topics() -> None:
    """The same run is recorded as topics, and the metrics are computed from these."""
    scenario = load_scenario('prototype')
    setpoint = replace(scenario.setpoints[0], duration=1.5, positions=(0.05, 1.1))
    scenario = replace(scenario, setpoints=(setpoint,), duration=3.2)
    found, armed, reason = measure(scenario)
    assert armed and reason == ''
    topics = record_run(scenario).arrays()
    first = topics['sim/link_states.stamp_ns'][0] + round(0.4e9)

    def since(name: str) -> Any:
        return topics[name][topics[name.rsplit('.', 1)[0] + '.stamp_ns'] >= first]

    def rms(errors: Any) -> float:
        return float(np.sqrt((errors ** 2).mean()))
    truth = since('sim/link_states.position')
    tracking = truth[:, :2] - since('reference.position')[:, :2]
    estimation = since('estimate/link_states.position') - truth
    last = truth[-251:, :2] - [0.05, 1.1]
    quality = since('estimate/innovation.position')[:, :2].sum(axis=0)
    speeds = np.abs(topics['sim/flywheel_states.velocity'])
    energies = since('energy.position')
    expected = {
        'tracking_rms_rad': rms(tracking), 'tracking_peak_rad': np.abs(tracking).max(),
        'final_error_rad': np.abs(last.mean(axis=0)).max(),
        'estimate_rms_rad': rms(estimation), 'estimate_peak_rad': np.abs(estimation).max(),
        'nis_per_degree_of_freedom': quality[0] / quality[1],
        'peak_wheel_speed_rad_s': speeds.max(), 'speed_margin': 1.0 - speeds.max() / 300.0,
        'peak_torque_n_m': np.abs(topics['sim/flywheel_states.effort']).max()}
    for column, name in enumerate(('eq9_j_s', 'work_j', 'copper_loss_j'), 1):
        # The sums restart at the setpoint.
        expected[name] = energies[-1, column] - energies[energies[:, column].argmin(), column]
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-9)
    assert set(found) - set(expected) == {'nees_per_degree_of_freedom'}


@pytest.mark.slow
def test_nees_and_nis_grow_with_the_square_of_the_sensor_noise(
        campaign_file: Callable[..., str]) -> None:
    """The noise is half, equal to and twice what the estimator assumes."""
    names, runs = ['nees_per_degree_of_freedom', 'nis_per_degree_of_freedom'], 5
    found = {}
    for noise in (0.5, 1.0, 2.0):
        made = load_campaign(campaign_file(duration=1.0, vary={
            'table.link_sensors.noise_rms': {'choice': [noise], 'scale': True}}), runs, seed=1)
        rows = [execute_run(made, run) for run in range(runs)]
        found[noise] = np.mean([[row[name] for name in names] for row in rows], axis=0)
    # The factor is four each, reduced by the share of other errors. NEES has few independent
    # samples in a run, so the test has no upper bound.
    for more, less in ((2.0, 1.0), (1.0, 0.5)):
        assert (found[more] > 2.0 * found[less]).all()
        assert found[more][1] < 4.5 * found[less][1]


def test_run_that_fails_is_a_row(campaign_file: Callable[..., str]) -> None:
    """A goal out of reach is refused by the controller in the middle of the run."""
    made = load_campaign(campaign_file(vary={
        'setpoints[0].relative.link_b': {'choice': [2.9]}}))
    row = execute_run(made, 0)
    assert row['failure'].startswith('setpoints, entry 1 at 0.08 s, refused')
    assert not row['armed_at_end']
    assert all(row[name] is None for name in METRICS)
    assert row['setpoints[0].relative.link_b'] == 2.9


def test_device_that_disarms_is_a_failure() -> None:
    """A silent sensor prevents arming."""
    made = campaign_from({
        'scenario': 'prototype', 'duration': 1.0,
        'vary': {'table.link_sensors.dropout': {'choice': [1.0]}}}, Path())
    row = execute_run(made, 0)
    assert row['failure'] and not row['armed_at_end']


@pytest.mark.slow
def test_only_is_bit_identical_and_its_scenario_runs_anywhere(
    campaign_file: Callable[..., str], tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    path, folder = campaign_file(), tmp_path / 'out'
    given = ['study', 'montecarlo', path, '-o', str(folder), '--jobs', '1', '--runs', '6']
    assert main(given) == 0
    before = {file: file.read_bytes() for file in folder.rglob('*') if file.is_file()}
    capsys.readouterr()
    assert main([*given, '--only', '4']) == 0
    out = capsys.readouterr().out
    table = pyarrow.parquet.read_table(folder / 'runs.parquet')
    row = table.slice(4, 1).to_pylist()[0]
    found = json.loads((folder / 'run_4.json').read_text())
    assert found['row'] == row
    for name in ('tracking_rms_rad', 'mechanism.flywheel_inertias[2]'):
        assert f'{name:<44}{row[name]!r}' in out
    # The files of the campaign are unchanged.
    assert {file: file.read_bytes() for file in before} == before
    # The scenario file reproduces the run.
    again, *_ = measure(load_scenario(str(folder / 'run_4.yaml')))
    assert again == {name: row[name] for name in METRICS}
    assert load_scenario(str(folder / 'run_4.yaml')).seed == row['seed']


@pytest.mark.slow
def test_same_seed_gives_same_bytes_for_any_number_of_jobs(
    campaign_file: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(montecarlo, 'MOST_IN_BATCH', 3)
    found = []
    for jobs in ('1', '2'):
        folder = tmp_path / jobs
        assert main(['study', 'montecarlo', campaign_file(), '-o', str(folder), '--runs', '12',
                     '--jobs', jobs]) == 0
        found.append(folder)
    for name in ('runs.parquet', 'summary.csv', 'correlations.csv'):
        assert (found[0] / name).read_bytes() == (found[1] / name).read_bytes(), name
    table = pyarrow.parquet.read_table(found[0] / 'runs.parquet')
    assert table['run'].to_pylist() == list(range(12))
    assert WALL not in table.column_names
    other = tmp_path / 'other'
    assert main(['study', 'montecarlo', campaign_file(), '-o', str(other), '--seed', '6',
                 '--runs', '3', '--jobs', '1']) == 0
    assert pyarrow.parquet.read_table(other / 'runs.parquet')['tracking_rms_rad'].to_pylist() != (
        table['tracking_rms_rad'].to_pylist()[:3])


@pytest.mark.slow
def test_limits_of_a_campaign_become_checks_and_figures_are_pictures(
        campaign_file: Callable[..., str], tmp_path: Path) -> None:
    path = campaign_file(limits={'work_j': {'quantile': 0.5, 'at_most': 1e-9},
                                 'failure_rate': {'at_most': 0.0}})
    assert main(['study', 'montecarlo', path, '-o', str(tmp_path / 'out'), '--jobs', '1']) == 1
    found = json.loads((tmp_path / 'out' / 'montecarlo.json').read_text())
    assert [(check['name'], check['unit'], check['limit'], check['passed'])
            for check in found['checks']] == [
        ('work_j, quantile 0.5', 'J', 1e-9, False), ('failed runs, share', '', 0.0, True)]
    assert found['metrics']['work_j']['n'] == 12
    assert found['failures']['runs'] == 0 and found['failures']['rate_high'] > 0.2
    strongest = found['correlations'][0]
    assert {'parameter', 'metric', 'n', 'rho', 'p_value'} == set(strongest)
    for name in ('montecarlo.png', 'montecarlo_parameters.png'):
        image = Image.open(BytesIO((tmp_path / 'out' / name).read_bytes()))
        assert image.width > 1000 and len(image.convert('RGB').getcolors(1 << 24)) > 20


@pytest.mark.parametrize('only', ['-1', '12'])
def test_number_of_a_run_out_of_range_is_refused(
    campaign_file: Callable[..., str], tmp_path: Path, only: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(['study', 'montecarlo', campaign_file(), '-o', str(tmp_path / 'out'),
                 f'--only={only}']) == 2
    error, = capsys.readouterr().err.splitlines()
    assert '--only' in error and only in error and '0 to 11' in error


# The statistics

def test_statistics_of_a_known_sample() -> None:
    """The sample 1 to 5 has mean 3, variance 2.5, and Student's t with 4 degrees 2.776."""
    found = statistics(np.array([3.0, 1.0, nan, 5.0, 2.0, 4.0]))
    assert (found.n, found.mean) == (5, 3.0)
    assert found.std == pytest.approx(2.5 ** 0.5)
    assert found.mean_high - 3.0 == pytest.approx(2.776 * (2.5 / 5.0) ** 0.5, rel=1e-3)
    assert found.quantiles == pytest.approx((1.2, 3.0, 4.8))
    assert statistics(np.array([nan])).n == 0


@pytest.mark.medium
def test_confidence_interval_of_the_mean_has_its_coverage() -> None:
    seed, trials = 11, 2000
    rng = np.random.default_rng(seed)
    covered = sum(found.mean_low <= 2.0 <= found.mean_high for found in (
        statistics(sample) for sample in rng.normal(2.0, 3.0, (trials, 8))))
    # Four standard deviations of a binomial count.
    assert abs(covered - 0.95 * trials) < 4.0 * (trials * 0.95 * 0.05) ** 0.5, f'seed {seed}'


def test_correlations_are_of_ranks_the_strongest_first() -> None:
    seed = 2
    rng = np.random.default_rng(seed)
    drawn = {'strong': rng.uniform(size=200), 'weak': rng.uniform(size=200), 'same': np.ones(200)}
    metric = np.exp(5.0 * drawn['strong']) + 10.0 * drawn['weak'] ** 3
    metric[::17] = nan
    found = correlations(drawn, {'m': metric, 'nothing': np.full(200, nan)})
    assert [(each.parameter, each.metric) for each in found] == [('strong', 'm'), ('weak', 'm')]
    for each in found:
        known = np.isfinite(metric)
        rho = np.corrcoef(rankdata(drawn[each.parameter][known]), rankdata(metric[known]))[0, 1]
        assert each.rho == pytest.approx(rho)
        assert each.p_value == pytest.approx(
            2.0 * student.sf(abs(rho) * (186.0 / (1.0 - rho ** 2)) ** 0.5, 186))
        assert each.n == 188


def test_runs_without_a_metric_count_as_beyond_a_limit() -> None:
    values = {'work_j': np.array([1.0] * 90 + [nan] * 10)}

    def passed(**limit: Any) -> bool:
        return checks_of([Limit('work_j', **{
            'quantile': None, 'at_most': None, 'at_least': None, **limit})], values, 10)[0].passed
    assert passed(quantile=0.9, at_most=2.0)
    assert not passed(quantile=0.91, at_most=2.0)
    assert passed(quantile=0.11, at_least=0.5)
    assert not passed(quantile=0.1, at_least=0.5)
    assert passed(at_most=1.0)
    failures, = checks_of([Limit('failure_rate', None, 0.1, None)], values, 10)
    assert (failures.value, failures.passed) == (0.1, True)
