# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Distributions and parameters of a campaign, and refusals before the first run."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from math import exp, inf, log
from pathlib import Path
from typing import Any

from fourbar_ros.common.config_files import presets
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop import load_scenario
from fourbar_ros.loop.description import load_description
from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns.campaign import Campaign, campaign_from, load_campaign
from fourbar_ros.studies.campaigns.parameter_names import names_of, place_of, value_at
import numpy as np
import pytest
from scipy.stats import kstest, lognorm, loguniform, norm, truncnorm, uniform
import yaml

RUNS = 2000
# Significance level of the statistical tests; the seeds are fixed.
SIGNIFICANCE = 1e-3


def campaign(vary: dict[str, Any], **others: Any) -> Campaign:
    """Make a campaign of the prototype."""
    return campaign_from({'scenario': 'prototype', 'vary': vary, **others}, Path())


def draws(made: Campaign, column: str, runs: int = RUNS) -> np.ndarray:
    """Return the drawn values of a column (runs,)."""
    return np.array([made.drawn(run)[column] for run in range(runs)])


@pytest.mark.medium
@pytest.mark.parametrize(('given', 'law'), [
    ({'uniform': [2.0, 3.0]}, uniform(2.0, 1.0)),
    ({'normal': {'mean': -1.0, 'std': 0.5}}, norm(-1.0, 0.5)),
    ({'normal': {'mean': 0.0, 'std': 1.0}, 'within': [-0.5, 2.0]}, truncnorm(-0.5, 2.0)),
    ({'lognormal': {'median': 3.0, 'sigma': 0.4}}, lognorm(0.4, scale=3.0)),
    ({'loguniform': [1e-4, 1e-1]}, loguniform(1e-4, 1e-1)),
])
def test_draws_follow_their_distribution(given: dict[str, Any], law: Any) -> None:
    """Kolmogorov-Smirnov test against the distribution of that name."""
    seed = 3
    made = campaign({'initial.link_a': given}, seed=seed)
    found = kstest(draws(made, 'initial.link_a'), law.cdf)
    assert found.pvalue > SIGNIFICANCE, f'seed {seed}'


@pytest.mark.slow
def test_choices_are_even_and_elements_and_parameters_independent() -> None:
    seed = 4
    made = campaign({
        'controller.allocation': {'choice': ['bounded', 'min_norm', 'min_energy']},
        'mechanism.flywheel_inertias': {'uniform': [0.9, 1.1], 'scale': True, 'each': True},
        'table.joints.coulomb': {'uniform': [0.9, 1.1], 'scale': True}}, seed=seed)
    chosen = draws(made, 'controller.allocation').tolist()
    for choice in ('bounded', 'min_norm', 'min_energy'):
        # Four standard deviations of a binomial share.
        assert abs(chosen.count(choice) / RUNS - 1.0 / 3.0) < 4.0 * (2.0 / 9.0 / RUNS) ** 0.5
    numbers = np.array([draws(made, name) for name, kind in made.columns.items()
                        if kind is float])
    apart = np.corrcoef(numbers) - np.eye(5)
    assert np.abs(apart).max() < 4.0 / RUNS ** 0.5, f'seed {seed}'


def test_a_run_does_not_depend_on_the_other_runs_or_parameters() -> None:
    vary = {'table.joints.coulomb': {'uniform': [0.9, 1.1], 'scale': True},
            'initial.link_a': {'uniform': [-0.1, 0.1]}}
    made = campaign(vary, seed=7, runs=10)
    more = campaign({'initial.rate_a': {'uniform': [0.0, 0.1]},
                     **dict(reversed(vary.items()))}, seed=7, runs=1000)
    for run in (0, 3, 9):
        assert made.drawn(run).items() <= more.drawn(run).items()
        assert made.seed_of(run) == more.seed_of(run)
    others = [replace(made, seed=8).drawn(3), made.drawn(4)]
    assert all(made.drawn(3)[name] != other[name] for other in others for name in vary)
    assert len({made.seed_of(run) for run in range(1000)}) == 1000


def test_drawn_values_enter_the_scenario() -> None:
    """Values are scaled, added or replaced; elements have single draws or a common one."""
    made = campaign({
        'mechanism.flywheel_inertias': {'uniform': [0.9, 1.1], 'scale': True, 'each': True},
        'mechanism.com_positions[2]': {'uniform': [0.0, 0.01], 'add': True, 'each': True},
        'mechanism.link_masses': {'uniform': [0.9, 1.1], 'scale': True},
        'table.joints.coulomb': {'uniform': [1e-4, 2e-4]},
        'controller.allocation': {'choice': ['two_wheels']},
        'setpoints[0].relative.link_b': {'uniform': [1.0, 1.2]},
        'model.motor_resistances.b': {'choice': [7.0]},
        'duration': {'uniform': [5.0, 6.0]}})
    nominal, drawn, found = load_scenario('prototype'), made.drawn(5), made.scenario(5)
    for link in range(4):
        assert found.mechanism.flywheel_inertias[link] == pytest.approx(
            nominal.mechanism.flywheel_inertias[link]
            * drawn[f'mechanism.flywheel_inertias[{link}]'], rel=1e-15)
    moved = found.mechanism.com_positions - nominal.mechanism.com_positions
    assert moved[2] == pytest.approx([drawn['mechanism.com_positions[2][0]'],
                                      drawn['mechanism.com_positions[2][1]']], rel=1e-12)
    assert not np.delete(moved, 2, axis=0).any()
    assert found.mechanism.link_masses / nominal.mechanism.link_masses == pytest.approx(
        [drawn['mechanism.link_masses']] * 4, rel=1e-15)
    assert found.table.joints.coulomb == drawn['table.joints.coulomb']
    assert found.controller.allocation == 'two_wheels'
    assert found.setpoints[0].positions[1] == pytest.approx(
        np.pi / 3.0 + drawn['setpoints[0].relative.link_b'], rel=1e-15)
    assert found.duration == drawn['duration']
    assert found.seed == made.seed_of(5)
    assert found.model.motor_resistances.tolist() == [1.0, 7.0, 1.0, 1.0]
    # All other values are nominal, including the model.
    assert (found.model.flywheel_inertias == nominal.mechanism.flywheel_inertias).all()
    assert found.mechanism.link_lengths.tolist() == nominal.mechanism.link_lengths.tolist()
    assert found.estimator == nominal.estimator


def test_model_may_be_the_drawn_mechanism() -> None:
    vary = {'mechanism.link_masses': {'uniform': [0.5, 0.7]},
            'model.link_inertias': {'choice': [2.0], 'scale': True}}
    found = campaign(vary, model='drawn').scenario(1)
    assert found.model.link_masses.tolist() == found.mechanism.link_masses.tolist()
    assert found.model.link_inertias == pytest.approx(2.0 * found.mechanism.link_inertias)
    apart = campaign(vary).scenario(1)
    assert apart.model.link_masses.tolist() != apart.mechanism.link_masses.tolist()


def test_set_changes_mechanism_and_model() -> None:
    """The result is that of a scenario with this mechanism; the model is changed last."""
    vary = {'mechanism.link_inertias': {'uniform': [0.9, 1.1], 'scale': True}}
    masses = {'mechanism.link_masses': [0.5, 0.6, 0.7, 0.8]}
    made = campaign(vary, set={'model.link_masses.a': 0.4, **masses})
    found = made.scenario(0)
    assert found.mechanism.link_masses.tolist() == [0.5, 0.6, 0.7, 0.8]
    assert found.model.link_masses.tolist() == [0.4, 0.6, 0.7, 0.8]


def test_scenario_with_its_own_model_keeps_it(tmp_path: Path) -> None:
    described = load_description('prototype')
    described['model']['link_masses'] = [0.4, 0.4, 0.4, 0.4]
    (tmp_path / 'mine.yaml').write_text(yaml.safe_dump(described))
    made = campaign_from({'scenario': 'mine.yaml', 'set': {'mechanism.link_masses.a': 0.7},
                          'vary': {'initial.link_a': {'uniform': [0.0, 0.1]}}}, tmp_path)
    found = made.scenario(0)
    assert found.mechanism.link_masses.tolist() == [0.7, 0.6, 0.6, 0.6]
    assert found.model.link_masses.tolist() == [0.4, 0.4, 0.4, 0.4]


def test_mechanism_may_be_set_by_its_name() -> None:
    """The values of the mechanism have the usual names."""
    made = campaign({'mechanism.link_masses.a': {'choice': [2.0], 'scale': True}},
                    set={'mechanism': 'paper', 'table': 'ideal'})
    found, nominal = made.scenario(0), load_scenario('paper').mechanism
    assert found.mechanism.link_masses[0] == 2.0 * nominal.link_masses[0]
    assert found.model.link_masses.tolist() == nominal.link_masses.tolist()


def test_grids_take_each_combination_in_turn() -> None:
    made = campaign({'controller.allocation': {'grid': ['bounded', 'min_norm']},
                     'controller.bandwidth': {'grid': [2.0, 3.0, 4.0]},
                     'initial.link_a': {'uniform': [0.0, 0.1]}})
    assert made.runs == 6
    cells = [(made.drawn(run)['controller.allocation'], made.drawn(run)['controller.bandwidth'])
             for run in range(12)]
    assert cells[:6] == [(allocation, bandwidth) for allocation in ('bounded', 'min_norm')
                         for bandwidth in (2.0, 3.0, 4.0)]
    assert cells[6:] == cells[:6]


def test_set_changes_the_nominal_value() -> None:
    made = campaign({'table.joints.coulomb': {'choice': [2.0], 'scale': True}},
                    set={'table.joints.coulomb': 1e-3, 'setpoints[0].duration': 4.0},
                    duration=5.0)
    found = made.scenario(0)
    assert found.table.joints.coulomb == 2e-3
    assert (found.duration, found.setpoints[0].duration) == (5.0, 4.0)


def test_every_name_has_a_value() -> None:
    description = load_description('prototype')
    names = names_of(description)
    assert len(names) == len(set(names)) > 200
    for name in names:
        value_at(description, place_of(name, description, 'vary'))
    assert {'mechanism.link_lengths', 'mechanism.link_lengths[3]', 'table.joints.coulomb',
            'model.com_positions[2][1]', 'setpoints[0].relative.link_b', 'plant.rate',
            'estimator.angle_noise', 'duration', 'arm_at'} <= set(names)
    assert place_of('mechanism.com_positions.c[1]', description, '') == (
        'mechanism', 'com_positions', 2, 1)


GOOD = {'uniform': [0.9, 1.1], 'scale': True}


Refuses = Callable[..., AbstractContextManager[None]]


@pytest.mark.parametrize(('name', 'near'), [
    ('mechanism.flywheel_inertia', 'mechanism.flywheel_inertias'),
    ('table.joint.coulomb', 'table.joints.coulomb'), ('setpoints[1].at', 'setpoints[0].at'),
    ('mechanism.link_lengths[4]', ''), ('mechanism.link_lengths.e', ''),
    ('mechanism.joint_damping.a', ''), ('seed', ''), ('zzz', ''),
])
def test_unknown_names_are_refused_with_the_nearest(name: str, near: str) -> None:
    with pytest.raises(CampaignError) as caught:
        campaign({name: GOOD})
    assert caught.value.values == {'unknown': [name], 'place': 'vary'}
    message = str(caught.value)
    assert name in message and near in message and '\n' not in message


A = 'initial.link_a'


@pytest.mark.parametrize(('vary', 'values'), [
    ({'table.joints': GOOD}, {'name': 'table.joints'}),
    ({'setpoints': GOOD}, {'name': 'setpoints'}),
    ({A: {'unifrom': [0, 1]}}, {'unknown': ['unifrom'], 'place': f'vary.{A}'}),
    ({A: {'uniform': [0, 1], 'normal': {}}},
     {'name': f'vary.{A}', 'value': ['uniform', 'normal']}),
    ({A: {'scale': True}}, {'name': f'vary.{A}', 'value': []}),
    ({A: 3.0}, {'name': f'vary.{A}', 'value': 3.0}),
    ({A: {'uniform': [1.0, 0.0]}}, {'name': f'vary.{A}.uniform', 'value': (1.0, 0.0)}),
    ({A: {'uniform': [0.0, inf]}}, {'name': f'vary.{A}.uniform', 'value': inf}),
    ({A: {'uniform': [0.0]}}, {'name': f'vary.{A}.uniform', 'value': [0.0]}),
    ({A: {'loguniform': [0.0, 1.0]}}, {'name': f'vary.{A}.loguniform', 'value': 0.0}),
    ({A: {'normal': {'mean': 0.0}}}, {'missing': ['std'], 'place': f'vary.{A}.normal'}),
    ({A: {'normal': {'mean': 0.0, 'std': -1.0}}}, {'name': f'vary.{A}.normal.std', 'value': -1.0}),
    ({A: {'lognormal': {'median': 0.0, 'sigma': 1.0}}},
     {'name': f'vary.{A}.lognormal.median', 'value': 0.0}),
    ({A: {'choice': []}}, {'name': f'vary.{A}.choice', 'value': []}),
    ({A: {**GOOD, 'add': True}}, {'name': f'vary.{A}'}),
    ({A: {**GOOD, 'scale': 2.0}}, {'name': f'vary.{A}.scale', 'value': 2.0, 'limit': bool}),
    ({A: {**GOOD, 'each': True}}, {'name': f'vary.{A}'}),
    ({A: {**GOOD, 'within': [0, 1]}}, {'name': f'vary.{A}.within'}),
    ({'controller.allocation': GOOD}, {'name': 'vary.controller.allocation', 'value': 'bounded'}),
    ({'controller.allocation': {'choice': ['bounded'], 'add': True}},
     {'name': 'vary.controller.allocation'}),
    ({'plant.rate': {'grid': [1.0], 'each': True}}, {'name': 'vary.plant.rate'}),
    ({'mechanism.link_masses': GOOD, 'mechanism.link_masses.b': GOOD},
     {'name': 'vary.mechanism.link_masses.b'}),
])
def test_wrong_distributions_are_refused(
        vary: dict[str, Any], values: dict[str, Any], refuses: Refuses) -> None:
    with refuses(FourbarError, **values):
        campaign(vary)


@pytest.mark.parametrize(('others', 'values'), [
    ({'run': 3}, {'unknown': ['run']}),
    ({'runs': 0}, {'name': 'runs', 'value': 0}),
    ({'seed': 1.5}, {'name': 'seed', 'value': 1.5, 'limit': int}),
    ({'model': 'true'}, {'name': 'model', 'value': 'true', 'limit': ('nominal', 'drawn')}),
    ({'set': {'plant.rat': 1}}, {'unknown': ['plant.rat'], 'place': 'set'}),
    ({'set': 3}, {'name': 'set', 'value': 3}),
    ({'scenario': 3.5}, {'name': 'scenario', 'value': 3.5}),
    ({'scenario': 'protoype'}, {}),
    ({'limits': {'tracking_rms': {'at_most': 1}}}, {'unknown': ['tracking_rms']}),
    ({'limits': {'work_j': {'quantile': 1.5, 'at_most': 1}}},
     {'name': 'limits.work_j.quantile', 'value': 1.5, 'limit': (0.0, 1.0)}),
    ({'limits': {'work_j': {'quantile': 0.5}}}, {'name': 'limits.work_j'}),
    ({'limits': {'work_j': {'at_most': inf}}}, {'name': 'limits.work_j.at_most', 'value': inf}),
    ({'limits': {'failure_rate': {'quantile': 0.5, 'at_most': 1}}}, {'unknown': ['quantile']}),
])
def test_wrong_keys_are_refused(
        others: dict[str, Any], values: dict[str, Any], refuses: Refuses) -> None:
    with refuses(FourbarError, **values):
        campaign({A: {'uniform': [0, 1]}}, **others)


@pytest.mark.parametrize(('vary', 'part'), [
    # Refused at one end of the range, before any draw.
    ({'table.joints.coulomb': {'uniform': [-1e-9, 1.0]}}, 'joints.coulomb'),
    ({'controller.bandwidth': {'choice': [4.0, 21.0]}}, 'controller.bandwidth'),
    ({'controller.allocation': {'choice': ['bounded', 'best']}}, 'controller.allocation'),
    ({'table.wheel_encoders.counts_per_turn': {'uniform': [10.0, 11.5]}}, 'counts_per_turn'),
    ({'mechanism.link_lengths.a': {'uniform': [0.3, 1.0]}}, 'vary.mechanism.link_lengths.a = 1.0'),
    ({'plant.rate': {'choice': [250.0, 333.0]}}, 'vary.plant.rate = 333.0'),
    # Refused in one of the runs.
    ({'table.joints.coulomb': {'normal': {'mean': 0.0, 'std': 1.0}}}, 'run '),
])
def test_values_that_the_scenario_refuses_are_reported_before_any_run(
        vary: dict[str, Any], part: str) -> None:
    """The message names the parameter, or the run."""
    made = campaign(vary, runs=20)
    with pytest.raises(CampaignError) as caught:
        made.check()
    assert part in str(caught.value) and '\n' not in str(caught.value)


def test_deprecated_name_of_the_model_draws_the_same(caplog: pytest.LogCaptureFixture) -> None:
    """An old file has its old draws, and one line reports the old name."""
    vary = {'mechanism.link_masses': {'uniform': [0.5, 0.7]},
            'believed.link_inertias': {'uniform': [1.0, 2.0], 'scale': True}}
    made = campaign(vary, believed='drawn', set={'believed.link_masses.a': 0.4})
    assert made.model == 'drawn'
    assert len(caplog.messages) == 1 and "'believed' is deprecated" in caplog.text
    drawn = made.drawn(1)
    # The expected values are draws of commit 33b3bad.
    assert drawn == {'mechanism.link_masses': 0.6633142852302307,
                     'believed.link_inertias': 1.0249258844249016}
    found = made.scenario(1)
    assert found.model.link_inertias == pytest.approx(
        drawn['believed.link_inertias'] * found.mechanism.link_inertias)
    caplog.clear()
    campaign({'model.link_inertias': GOOD}, model='drawn')
    assert caplog.messages == []


@pytest.mark.parametrize(('law', 'bounds'), [
    ({'normal': {'mean': 0.0, 'std': 1.0}}, [20.0, 21.0]),
    ({'normal': {'mean': 0.0, 'std': 1.0}}, [-9.0, -3.1]),
    ({'normal': {'mean': 0.0, 'std': 0.0}}, [0.1, 1.0]),
    ({'lognormal': {'median': 1.0, 'sigma': 0.1}}, [-1.0, 0.0]),
    ({'lognormal': {'median': 1.0, 'sigma': 0.1}}, [1.5, 9.0]),
])
def test_ranges_of_small_probability_are_refused(
        law: dict[str, Any], bounds: list[float], refuses: Refuses) -> None:
    with refuses(CampaignError, name=f'vary.{A}.within', limit=1e-3):
        campaign({'initial.link_a': {**law, 'within': bounds}})


@pytest.mark.parametrize(('law', 'bounds'), [
    ({'normal': {'mean': 0.0, 'std': 1.0}}, [3.05, 9.0]),
    ({'normal': {'mean': 0.0, 'std': 0.0}}, [0.0, 1.0]),
    ({'lognormal': {'median': 1.0, 'sigma': 0.1}}, [-1.0, 0.75]),
])
def test_rare_ranges_are_met_in_every_run(law: dict[str, Any], bounds: list[float]) -> None:
    """A thousand draws may all miss a range of probability 1e-3."""
    made = campaign({'initial.link_a': {**law, 'within': bounds}}, runs=50)
    found = draws(made, 'initial.link_a', 50)
    assert ((bounds[0] <= found) & (found <= bounds[1])).all()


@pytest.mark.parametrize('given', [
    {'lognormal': {'median': 1.0, 'sigma': 1000.0}},
    {'loguniform': [1.7976931348623157e308, 1.7976931348623157e308]},
    {'uniform': [-1.7e308, 1.7e308], 'scale': True},
])
def test_draws_that_overflow_are_refused(given: dict[str, Any]) -> None:
    made = campaign({A: given}, runs=20)
    with pytest.raises(CampaignError) as caught:
        made.check()
    assert A in str(caught.value) and '\n' not in str(caught.value)


def test_identity_has_all_that_the_numbers_depend_on(campaign_file: Callable[..., str]) -> None:
    same = load_campaign(campaign_file())
    for change in ({'runs': 50}, {'limits': {'work_j': {'at_most': 1.0}}}):
        assert load_campaign(campaign_file(**change)).digest == same.digest
    for change in ({'seed': 6}, {'duration': 0.31}, {'model': 'drawn'}, {'scenario': 'paper'},
                   {'vary': {'initial.link_a': {'uniform': [0.0, 0.1]}}}):
        assert load_campaign(campaign_file(**change)).digest != same.digest
    assert load_campaign(campaign_file(), seed=6).digest == load_campaign(
        campaign_file(seed=6)).digest
    assert replace(same, versions={**same.versions, 'numpy': '0'}).digest != same.digest


@pytest.mark.parametrize('name', presets('campaign'))
def test_presets_can_be_run(name: str) -> None:
    made = replace(load_campaign(name), runs=50)
    made.check()
    assert made.limits


def test_extremes_of_log_distributions_stay_inside() -> None:
    """Draws exceed the ends by at most the rounding of exp and log."""
    made = campaign({'initial.link_a': {'loguniform': [0.1, 0.1]}})
    assert draws(made, 'initial.link_a', 5) == pytest.approx([exp(log(0.1))] * 5, rel=1e-15)
