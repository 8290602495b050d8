# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A campaign: a scenario, the distributions of its parameters, and limits of the results."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, MISSING, replace
import hashlib
import json
import logging
from math import prod
from pathlib import Path
import re
from typing import Any

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import check_keys, Setting, setting, Settings
from fourbar_ros.loop.description import describe, load_description
from fourbar_ros.loop.run import make_loop
from fourbar_ros.loop.scenario import Scenario, scenario_from
from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns.campaign_metrics import METRICS
from fourbar_ros.studies.campaigns.distributions import combine, Distribution, Parameter
from fourbar_ros.studies.campaigns.parameter_names import (
    elements,
    MODEL,
    MODEL_NAMES,
    place_of,
    set_value,
    suggestion,
    value_at,
)
from fourbar_ros.studies.campaigns.versions import versions
import numpy as np

# Name of the share of failed runs among the limits.
FAILURE_RATE = 'failure_rate'
# Number of runs whose scenarios are checked before the first run starts.
CHECKED_RUNS = 2000
# Key of the random stream from which a run takes the seed of its noise.
_NOISE_STREAM = 0x5EED


@dataclass(frozen=True)
class CampaignSettings(Settings):
    """Settings of a campaign file beside its sections."""

    scenario: str = setting(MISSING, '', 'preset or path of the scenario')
    runs: int = setting(100, '', 'number of runs', low=1)
    seed: int = setting(0, '', 'seed of all draws, and of the noise in each run', low=0)
    model: str = setting('nominal', '', 'mechanism that estimator and controller assume',
                         choices=('nominal', 'drawn'))


SECTIONS = ('set', 'vary', 'limits')


@dataclass(frozen=True)
class Limit:
    """
    A limit of the results.

    :param metric: a column, or `failure_rate`.
    :param quantile: of the metric, None for its mean.
    :param at_most, at_least: the limit; one of them is None.
    """

    metric: str
    quantile: float | None = None
    at_most: float | None = None
    at_least: float | None = None


_LIMIT_KEYS = {
    'at_most': Setting('', 0.0, '', 'largest allowed value'),
    'at_least': Setting('', 0.0, '', 'smallest allowed value'),
    'quantile': Setting('', 0.5, '', 'quantile of the metric over the runs', low=0.0, high=1.0)}


@dataclass(frozen=True)
class Campaign:
    """
    Runs of a closed loop with random parameters.

    :param description: of the nominal scenario, see `loop.description`.
    :param parameters: that vary.
    :param model: `nominal` if estimator and controller assume the nominal mechanism, `drawn` if
        they assume the mechanism of each run.
    :param seed: of all runs.
    :param runs: their number.
    :param limits: of the results.
    :param versions: of the software that computes the numbers.
    """

    description: Mapping[str, Any]
    parameters: tuple[Parameter, ...]
    model: str
    seed: int
    runs: int
    limits: tuple[Limit, ...]
    versions: Mapping[str, str]

    @property
    def columns(self) -> dict[str, type]:
        """Names and types of the columns of drawn values."""
        return {name: parameter.value_type for parameter in self.parameters
                for name in parameter.columns}

    @property
    def identity(self) -> dict[str, Any]:
        """
        Everything that determines the numbers of a run, except its own number, as in JSON.

        The number of runs and the limits are not part of it.
        """
        vary = {parameter.name: [law.kind, *law.values, law.how, bool(parameter.places),
                                 law.within]
                for parameter in self.parameters for law in (parameter.distribution,)}
        identity: dict[str, Any] = json.loads(json.dumps({
            'scenario': self.description, 'vary': vary, 'believed': self.model,
            'seed': self.seed, 'versions': self.versions}))
        return identity

    @property
    def digest(self) -> str:
        """SHA-256 of the identity."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()

    def seed_of(self, run: int) -> int:
        """Return the seed of the noise in a run, as a scenario takes it."""
        state = np.random.SeedSequence(self.seed, spawn_key=(run, _NOISE_STREAM)).generate_state(
            1, np.uint64)
        return int(state[0] >> np.uint64(1))

    def drawn(self, run: int) -> dict[str, Any]:
        """Return the drawn values of a run, by column."""
        return {name: value for parameter in self.parameters for name, value in zip(
            parameter.columns, parameter.draw(self.seed, run, self._cell(run)))}

    def drawn_row(self, run: int) -> dict[str, Any]:
        """Return number, seed and drawn values of a run, as its row holds them."""
        drawn = self.drawn(run)
        return {'run': run, 'seed': self.seed_of(run), **{
            name: parameter.column_value(drawn[name])
            for parameter in self.parameters for name in parameter.columns}}

    def described(self, run: int) -> dict[str, Any]:
        """Return the description of the scenario of a run."""
        return self._with(self.drawn(run), self.seed_of(run))

    def scenario(self, run: int) -> Scenario:
        """
        Return the scenario of a run.

        :raises FourbarError: it refuses a drawn value.
        """
        return scenario_from(self.described(run), Path())

    def check(self) -> None:
        """
        Check the values before any run, as far as a scenario can be checked without running it.

        Checked are the nominal scenario, every end of each distribution, and the first runs.

        :raises CampaignError: a scenario refuses a value.
        """
        _check_scenario(self._with({}, self.seed), 'the nominal scenario is refused')
        for parameter in self.parameters:
            for value in parameter.distribution.extremes:
                _check_scenario(self._with(dict.fromkeys(parameter.columns, value), self.seed),
                                f'vary.{parameter.name} = {value} is refused')
        for run in range(min(self.runs, CHECKED_RUNS)):
            try:
                self.scenario(run)
            except FourbarError as error:
                raise CampaignError(
                    f'run {run} is refused: {error}; limit the distribution, a normal one by '
                    'within: [low, high]', **error.values) from None

    def _with(self, drawn: Mapping[str, Any], seed: int) -> dict[str, Any]:
        description = deepcopy(dict(self.description))
        description['seed'] = seed
        # The model comes after the mechanism, which it may be a copy of.
        for of_model in (False, True):
            if of_model and self.model == 'drawn':
                description[MODEL] = deepcopy(description['mechanism'])
            for parameter in self.parameters:
                if (parameter.place[0] == MODEL) != of_model:
                    continue
                for column, place in zip(parameter.columns,
                                         parameter.places or (parameter.place,)):
                    if column in drawn:
                        set_value(description, place, combine(
                            value_at(description, place), drawn[column],
                            parameter.distribution.how))
        return description

    def _cell(self, run: int) -> dict[str, int]:
        """Return the index of each grid's value in a run; the last grid changes first."""
        cell: dict[str, int] = {}
        for parameter in reversed(self.parameters):
            if parameter.distribution.kind == 'grid':
                run, cell[parameter.name] = divmod(run, len(parameter.distribution.values))
        return cell


def load_campaign(name: str, runs: int | None = None, seed: int | None = None) -> Campaign:
    """
    Read a campaign file.

    :param name: a preset (`prototype` for config/campaign_prototype.yaml) or the path of a file.
    :param runs, seed: replace those of the file.
    :raises FourbarError: there is no such file, or it is refused.
    """
    path = config_file('campaign', name)
    values = load_yaml(path)
    try:
        campaign = campaign_from(values, path.parent)
    except FourbarError as error:
        raise error.at(path, CampaignError) from None
    return replace(campaign, runs=campaign.runs if runs is None else runs,
                   seed=campaign.seed if seed is None else seed)


def campaign_from(values: Mapping[str, Any], folder: Path) -> Campaign:
    """
    Make a campaign from the keys of its file.

    :param folder: base of a relative path of a scenario.
    :raises FourbarError: as `load_campaign`.
    """
    values = _with_new_names(values)
    check_keys(values, ('scenario', 'vary'), 'campaign', CampaignError,
               optional=('runs', 'seed', 'model', 'duration', *SECTIONS))
    sections = {name: _mapping(name, values.get(name, {})) for name in SECTIONS}
    if 'duration' in values:
        sections['set'] = {**sections['set'], 'duration': values['duration']}
    settings = CampaignSettings.from_mapping(
        {key: value for key, value in values.items() if key not in (*SECTIONS, 'duration')})
    description = _nominal(settings.scenario, sections['set'], folder)
    parameters = _parameters(sections['vary'], description)
    cells = prod(len(parameter.distribution.values) for parameter in parameters
                 if parameter.distribution.kind == 'grid')
    runs = cells if cells > 1 and 'runs' not in values else settings.runs
    return Campaign(description, parameters, settings.model, settings.seed, runs,
                    tuple(_limits(sections['limits'])), versions())


def _with_new_names(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Replace the deprecated key of the model, and report deprecated names once."""
    new, old = MODEL_NAMES
    names = [*values, *(name for section in ('set', 'vary')
                        if isinstance(values.get(section), Mapping) for name in values[section])]
    deprecated = [name for name in map(str, names) if re.split(r'\W', name)[0] == old]
    if deprecated:
        logging.getLogger(__name__).warning(
            'campaign: %r is deprecated, write %r (%s)', old, new, ', '.join(deprecated))
    return {new if key == old else key: value for key, value in values.items()}


def _nominal(name: str, changes: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the description of a scenario with the changes of section `set`."""
    if '/' in name or Path(name).suffix in ('.yaml', '.yml'):
        name = str((folder / Path(name).expanduser()).absolute())
    description = load_description(name)
    if description[MODEL] == description['mechanism']:
        # Changes of the mechanism apply to the model as well then.
        del description[MODEL]
    changes = {str(key): value for key, value in changes.items()}
    of_model = {key for key in changes if key.split('.')[0] in MODEL_NAMES}
    for later in (False, True):
        for key, value in changes.items():
            if (key in of_model) == later:
                set_value(description, place_of(key, description, 'set', True), value)
        # Spells out names of files and sections with keys left out.
        description = describe(description, folder)
    return description


def _parameters(vary: Mapping[str, Any], description: Mapping[str, Any]
                ) -> tuple[Parameter, ...]:
    parameters: list[Parameter] = []
    for name, content in vary.items():
        name, where = str(name), f'vary.{name}'
        place = place_of(name, description, 'vary')
        distribution = Distribution.from_mapping(content, where)
        nominal = value_at(description, place)
        if distribution.how and not all(
                isinstance(value_at(description, element), (int, float))
                for element in elements(place, nominal)):
            raise CampaignError(f'{where}: {distribution.how} needs a number, the nominal value '
                                f'is {nominal!r}', name=where, value=nominal)
        if distribution.each and not isinstance(nominal, list):
            raise CampaignError(f'{where}: each is for arrays, the nominal value is {nominal!r}',
                                name=where, value=nominal)
        for other in parameters:
            shorter = min(len(place), len(other.place))
            if place[:shorter] == other.place[:shorter]:
                raise CampaignError(f'vary: {other.name} and {name} overlap', name=where)
        parameters.append(Parameter(name, place, distribution, tuple(
            elements(place, nominal)) if distribution.each else ()))
    return tuple(parameters)


def _limits(section: Mapping[str, Any]) -> list[Limit]:
    known = [*METRICS, FAILURE_RATE]
    limits = []
    for metric, entries in section.items():
        if metric not in known:
            raise CampaignError(f'limits: no metric {metric!r}{suggestion(str(metric), known)} '
                                f'(known are {", ".join(known)})', unknown=[metric],
                                place='limits')
        where = f'limits.{metric}'
        keys = [key for key in _LIMIT_KEYS if metric != FAILURE_RATE or key != 'quantile']
        for entry in entries if isinstance(entries, list) else [entries]:
            check_keys(_mapping(where, entry), (), where, CampaignError, optional=keys)
            if ('at_most' in entry) == ('at_least' in entry):
                raise CampaignError(f'{where} must have either at_most or at_least, got '
                                    f'{entry!r}', name=where, value=entry)
            limits.append(Limit(metric, **{
                key: _LIMIT_KEYS[key].check(value, f'{where}.{key}')
                for key, value in entry.items()}))
    return limits


def _mapping(name: str, content: Any) -> Mapping[str, Any]:
    if not isinstance(content, Mapping):
        raise CampaignError(f'{name} must hold keys of its own, got {content!r}', name=name,
                            value=content, limit=dict)
    return content


def _check_scenario(description: dict[str, Any], refused: str) -> None:
    try:
        make_loop(scenario_from(description, Path()))
    except FourbarError as error:
        raise error.at(refused, CampaignError) from None
