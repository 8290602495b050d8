# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The crossing study: random numbers, criterion of a pass, and statistics of the runs."""

from collections.abc import Callable, Iterable
import csv
from dataclasses import replace
from functools import partial
from io import BytesIO, StringIO
import json
from math import inf, isfinite, nan, radians
from types import SimpleNamespace
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop import load_scenario, Scenario
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies import crossing, crossing_runs, load_study, Result, Sample
from fourbar_ros.studies.crossing import DESCRIPTIONS
from fourbar_ros.studies.crossing_runs import (
    CrossingOutcome,
    CrossingRun,
    CrossingStatistics,
    execute,
    FRICTION_SPREAD,
    INERTIA_SPREAD,
    MANOEUVRES,
    METHODS,
    scenario_of,
)
import numpy as np
import pytest
from scipy.stats import binom

SEEDS = range(40)
# The first half of the manoeuvre: it parks for 5 s.
PARKING = replace(MANOEUVRES['parking'], script=MANOEUVRES['parking'].script[:1], duration=9.5)


def outcome(passed: bool) -> CrossingOutcome:
    """Return an artificial outcome of a run."""
    theta = np.linspace(0.5, -0.5, 20)
    eta = 1e-3 * np.cos(theta) if passed else 4.0 * theta
    return CrossingOutcome(passed, 2e-3 if passed else inf, float(np.abs(eta).max()), 0.01,
                           '' if passed else 'elsewhere', np.column_stack([theta, eta]))


# Confidence intervals

@pytest.mark.parametrize(('passed', 'runs', 'low', 'high'), [
    (0, 10, 0.0, 0.3085), (1, 10, 0.0025, 0.4450), (5, 10, 0.1871, 0.8129),
    (10, 10, 0.6915, 1.0), (100, 100, 0.9638, 1.0)])
def test_interval_is_that_of_the_tables(passed: int, runs: int, low: float, high: float) -> None:
    """The reference is tables of the interval of Clopper and Pearson with four digits."""
    statistics = CrossingStatistics([outcome(number < passed) for number in range(runs)])
    assert (statistics.passed, statistics.runs) == (passed, runs)
    assert statistics.interval == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(('passed', 'runs'), [
    (0, 300), (1, 3), (297, 300), (300, 300), (0, 30), (3, 30), (30, 30)])
def test_interval_leaves_2_5_percent_on_either_side(passed: int, runs: int) -> None:
    """At the ends of the interval the tail probability of the result is 2.5 %."""
    low, high = CrossingStatistics([outcome(number < passed) for number in range(runs)]).interval
    assert low <= passed / runs <= high
    if passed > 0:
        assert binom.sf(passed - 1, runs, low) == pytest.approx(0.025)
    if passed < runs:
        assert binom.cdf(passed, runs, high) == pytest.approx(0.025)


# Random numbers

def drawn(scenario: Scenario) -> tuple[float, ...]:
    """Return all random numbers of a run."""
    mechanism, table = scenario.mechanism, scenario.table
    return (*mechanism.flywheel_inertias, *mechanism.link_lengths, table.joints.coulomb,
            table.wheel_bearings.coulomb, scenario.initial.link_a, scenario.seed)


@pytest.mark.parametrize('name', list(MANOEUVRES))
def test_every_method_has_the_same_draws(name: str) -> None:
    for seed in range(3):
        scenarios = [scenario_of(CrossingRun(MANOEUVRES[name], method, seed))
                     for method in METHODS]
        assert len({drawn(scenario) for scenario in scenarios}) == 1
        assert len({scenario.setpoints for scenario in scenarios}) == 1
        assert [scenario.controller.allocation == 'two_wheels' for scenario in scenarios] == [
            method == 'two' for method in METHODS]
        assert [scenario.controller.branch_bandwidth > 0.0 for scenario in scenarios] == [
            method == 'four_held' for method in METHODS]
        base = scenarios[0].controller
        assert {replace(scenario.controller, allocation=base.allocation,
                        branch_bandwidth=base.branch_bandwidth) for scenario in scenarios} == {
            base}


@pytest.mark.medium
def test_every_seed_has_other_draws_within_the_spread() -> None:
    """In seeds 0 to 39 one of four links or signs is missing with a probability of 4 %."""
    base = load_scenario('prototype')
    hard = MANOEUVRES['mismatch']
    scenarios = [scenario_of(CrossingRun(hard, 'four', seed)) for seed in SEEDS]
    for place, numbers in enumerate(zip(*(drawn(scenario) for scenario in scenarios))):
        # There are only eight different lengths.
        if not 4 <= place < 8:
            assert len(set(numbers)) == len(SEEDS)
    longer = set()
    for scenario in scenarios:
        mechanism = scenario.mechanism
        wheels = mechanism.flywheel_inertias / base.mechanism.flywheel_inertias - 1.0
        assert np.abs(wheels).max() <= INERTIA_SPREAD
        for found, known in ((scenario.table.joints, base.table.joints),
                             (scenario.table.wheel_bearings, base.table.wheel_bearings)):
            assert abs(found.coulomb / known.coulomb - 1.0) <= FRICTION_SPREAD + 1e-12
        lengths = mechanism.link_lengths / base.mechanism.link_lengths - 1.0
        link = int(np.argmax(np.abs(lengths)))
        assert abs(lengths[link]) == pytest.approx(hard.mismatch)
        assert np.count_nonzero(lengths) == 1
        longer.add((link, lengths[link] > 0.0))
        # The model has compliant joints and not the drawn lengths.
        model = scenario.model
        np.testing.assert_array_equal(model.link_lengths, base.mechanism.link_lengths)
        np.testing.assert_array_equal(model.flywheel_inertias, base.mechanism.flywheel_inertias)
        np.testing.assert_array_equal(model.joint_stiffness, [hard.stiffness] * 4)
        np.testing.assert_array_equal(mechanism.joint_stiffness, [hard.stiffness] * 4)
    assert len(longer) == 8


def test_script_turns_with_the_heading() -> None:
    scenario = scenario_of(CrossingRun(MANOEUVRES['parking'], 'four', 0))
    heading = scenario.initial.link_a
    assert scenario.initial.link_b - heading == pytest.approx(MANOEUVRES['parking'].theta)
    for setpoint, (at, phi_a, phi_b, duration) in zip(
            scenario.setpoints, MANOEUVRES['parking'].script, strict=True):
        assert (setpoint.at, setpoint.duration) == (at, duration)
        assert [angle - heading for angle in setpoint.positions] == pytest.approx([phi_a, phi_b])


# Criterion of a pass

@pytest.mark.slow
@pytest.mark.parametrize('method', METHODS)
def test_crossing_in_motion_passes_by_every_method(method: str) -> None:
    found = execute(CrossingRun(MANOEUVRES['motion'], method, 0))
    assert (found.passed, found.reason) == (True, '')
    assert found.error < crossing_runs.GOAL_TOLERANCE
    # From one side of the change point to the other, on the branch of the parallelogram.
    theta, eta = found.path.T
    assert theta[0] == pytest.approx(radians(40.0))
    assert theta[-1] == pytest.approx(radians(-40.0), abs=crossing_runs.GOAL_TOLERANCE)
    assert np.abs(eta).max() < 1e-9


@pytest.mark.slow
def test_four_wheels_stay_on_the_branch_that_two_leave() -> None:
    held = execute(CrossingRun(PARKING, 'four_held', 0))
    assert (held.passed, held.reason) == (True, '')
    for seed in range(3):
        found = execute(CrossingRun(PARKING, 'two', seed))
        assert not found.passed, f'seed {seed}'
        assert found.reason == 'elsewhere', f'seed {seed}'
        # The angle between opposite links is far larger than with four wheels.
        assert found.largest_eta > 10.0 * held.largest_eta, f'seed {seed}'


def test_refused_run_has_failed_with_the_reason() -> None:
    """80 degrees in a tenth of a second are too much for any motor."""
    at, phi_a, phi_b, _ = MANOEUVRES['motion'].script[0]
    fast = replace(MANOEUVRES['motion'], script=((at, phi_a, phi_b, 0.1),))
    found = execute(CrossingRun(fast, 'four', 0))
    assert not found.passed
    assert found.reason.startswith('setpoints, entry 1 at 0.5 s, refused: needs ')
    # The linkage has not moved, so its error is the distance to the goal.
    assert found.error == pytest.approx(radians(80.0), abs=crossing_runs.GOAL_TOLERANCE)


Runs = Callable[[Scenario, Any], Iterable[Any]]


@pytest.fixture
def crossed(monkeypatch: pytest.MonkeyPatch) -> Callable[[Runs], CrossingOutcome]:
    """Return a function that replaces the run of a crossing and returns its outcome."""
    def make(run_scenario: Runs) -> CrossingOutcome:
        monkeypatch.setattr(crossing_runs, 'run_scenario', run_scenario)
        return execute(CrossingRun(MANOEUVRES['motion'], 'four', 0))
    return make


def at(angles: Array) -> Any:
    """Make a step with given true angles."""
    return SimpleNamespace(samples=SimpleNamespace(truth=SimpleNamespace(
        link_angles=angles, efforts=np.zeros(4))))


def goal_of(scenario: Scenario) -> Array:
    return np.tile(scenario.setpoints[-1].positions, 2)


def test_final_error_ignores_whole_turns(crossed: Callable[[Runs], CrossingOutcome]) -> None:
    def turned(scenario: Scenario, loop: Any) -> Iterable[Any]:
        loop.supervisor.arming.arm(0, ())
        return [at(goal_of(scenario) + 2.0 * np.pi + 0.9 * crossing_runs.GOAL_TOLERANCE)]
    found = crossed(turned)
    assert found.error == pytest.approx(0.9 * crossing_runs.GOAL_TOLERANCE)
    assert (found.passed, found.reason) == (True, '')


@pytest.mark.parametrize(('off', 'armed', 'reason'), [
    ([1.1, 0.0, 0.0, 0.0], True, 'elsewhere'), ([0.0, 0.0, -1.1, 0.0], True, 'elsewhere'),
    ([nan] * 4, True, 'elsewhere'), ([0.0] * 4, False, 'not armed since start')])
def test_end_off_the_goal_or_disarmed_fails(
    off: list[float], armed: bool, reason: str, crossed: Callable[[Runs], CrossingOutcome],
) -> None:
    """Errors are in units of GOAL_TOLERANCE; NaN is off the goal."""
    def ended(scenario: Scenario, loop: Any) -> Iterable[Any]:
        if armed:
            loop.supervisor.arming.arm(0, ())
        return [at(goal_of(scenario) + crossing_runs.GOAL_TOLERANCE * np.array(off))]
    found = crossed(ended)
    assert not found.passed
    assert found.reason == reason


def test_run_that_fails_before_its_first_tick(crossed: Callable[[Runs], CrossingOutcome]) -> None:
    def failed(scenario: Scenario, loop: Any) -> Iterable[Any]:
        raise FourbarError('the table is on fire')
    found = crossed(failed)
    assert (found.passed, found.reason) == (False, 'the table is on fire')
    assert found.error == inf
    assert found.path.shape == (0, 2)


# Statistics of the runs

def studied(passes: Callable[[CrossingRun], bool], monkeypatch: pytest.MonkeyPatch,
            runs: int = 60, *, drawn: bool = False) -> Result:
    """Run the study on artificial outcomes; the figure takes two seconds."""
    figure = pytest.importorskip('fourbar_ros.studies.crossing_figure')
    monkeypatch.setattr(crossing, 'execute', lambda run: outcome(passes(run)))
    if not drawn:
        monkeypatch.setattr(figure, 'png', lambda by_kind, of_map: b'')
    return crossing.run(lambda items, count: items, Sample(runs, 0, 1))


def easy(run: CrossingRun) -> bool:
    """Return whether a run passes, with different shares for each kind of run."""
    if run.method == 'two':
        return run.manoeuvre.duration == MANOEUVRES['motion'].duration and (
            run.manoeuvre.mismatch == 0.0)
    return run.manoeuvre.mismatch < 1e-3 or run.manoeuvre.stiffness == 1e4 and run.seed % 2 == 0


@pytest.mark.medium
@pytest.mark.parametrize('passes', [easy, lambda run: False, lambda run: True],
                         ids=['some', 'none', 'all'])
def test_numbers_are_of_the_runs_that_they_name(
    passes: Callable[[CrossingRun], bool], monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = studied(passes, monkeypatch)
    # The document has neither NaN nor infinity.
    document = json.loads(json.dumps(result.data, allow_nan=False))
    rows = list(csv.DictReader(StringIO(str(result.files['crossing.csv']))))
    assert len(rows) == len(MANOEUVRES) * len(METHODS) + len(document['map']) == 9 + 48
    for name, made in MANOEUVRES.items():
        for method in METHODS:
            wanted = sum(passes(CrossingRun(made, method, seed)) for seed in range(60))
            numbers = document['crossings'][name][method]
            assert (numbers['passed'], numbers['runs']) == (wanted, 60)
            assert numbers['passed_low'] <= wanted / 60.0 <= numbers['passed_high']
            assert sum(numbers['reasons'].values()) == 60 - wanted
            assert (numbers['largest_eta_deg_of_passed'] is None) == (wanted == 0)
            row, = (row for row in rows if (row['kind'], row['method']) == (name, method))
            assert (int(row['passed']), int(row['runs'])) == (wanted, 60)
            assert f'{wanted} of 60' in ' '.join(result.text.split())
        assert DESCRIPTIONS[name] in result.text
    cells = [row for row in rows if row['kind'] == 'map']
    for cell, row in zip(document['map'], cells, strict=True):
        stiffness = cell['stiffness_n_m'] if cell['stiffness_n_m'] is not None else inf
        manoeuvre = replace(
            MANOEUVRES['mismatch'], mismatch=cell['mismatch'], stiffness=stiffness)
        run = CrossingRun(manoeuvre, 'four_held', 0)
        wanted = sum(passes(replace(run, seed=seed)) for seed in range(2))
        assert (cell['passed'], cell['runs']) == (wanted, 2)
        assert (float(row['mismatch']), float(row['stiffness_n_m']), float(row['time_s']),
                int(row['passed'])) == (cell['mismatch'], stiffness, cell['time_s'], wanted)
    assert not any(cell in ('', 'nan') for row in rows for cell in row.values())


@pytest.mark.medium
@pytest.mark.parametrize(('lost', 'kept'), [(0, True), (3, True), (4, False), (300, False)])
def test_one_run_in_a_hundred_may_fail_and_not_more(
    lost: int, kept: bool, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The limit applies to four wheels with feedback; the other methods have no limit."""
    result = studied(lambda run: run.method == 'four_held' and run.seed >= lost, monkeypatch, 300)
    assert len(result.checks) == len(MANOEUVRES)
    assert [check.passed for check in result.checks] == [kept] * len(MANOEUVRES)
    assert all(isfinite(check.value) for check in result.checks)
    assert len({check.name for check in result.checks}) == len(MANOEUVRES)


@pytest.mark.slow
@pytest.mark.parametrize(('passes', 'runs'), [
    (easy, 60), (lambda run: False, 1), (lambda run: True, 300)], ids=['some', 'none', 'all'])
def test_figure_is_complete(
    passes: Callable[[CrossingRun], bool], runs: int, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The figure has contents in the middle and none at the edge."""
    image = pytest.importorskip('matplotlib.image')
    result = studied(passes, monkeypatch, runs, drawn=True)
    assert result.skipped == []
    png = result.files['crossing.png']
    assert isinstance(png, bytes)
    pixels = image.imread(BytesIO(png))[..., :3]
    assert pixels.std() > 0.05
    for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
        assert edge.min() == 1.0


def test_default_number_of_runs_suffices_for_the_limit() -> None:
    study = load_study('crossing')
    assert isinstance(study, partial)
    assert study.keywords['sample'].runs == 300
    study: Any = load_study('crossing', runs=2)
    assert study.keywords['sample'].runs == 2
