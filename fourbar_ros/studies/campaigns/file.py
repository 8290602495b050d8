# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A campaign: a scenario, what is drawn for each of its runs, and what must come of them."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
import hashlib
import json
from math import isfinite, prod
from pathlib import Path
from typing import Any

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop.description import describe, load_description
from fourbar_ros.loop.run import make_loop
from fourbar_ros.loop.scenario import Scenario, scenario_from
from fourbar_ros.studies.campaigns.draws import combined, distribution, Parameter
from fourbar_ros.studies.campaigns.names import (
    elements,
    nearest,
    Place,
    place_of,
    put,
    value_at,
)
from fourbar_ros.studies.campaigns.processes import CampaignError
from fourbar_ros.studies.campaigns.run import METRICS
from fourbar_ros.studies.campaigns.versions import versions
import numpy as np

KEYS = ('scenario', 'runs', 'seed', 'duration', 'set', 'believed', 'vary', 'limits')
REQUIRED = ('scenario', 'vary')
BELIEVED = ('nominal', 'drawn')
FAILURE_RATE = 'failure_rate'
DEFAULT_RUNS = 100
# So many runs are looked at before the first begins.
LOOKED_AT = 2000

# What a run of a campaign has to itself, beside its parameters.
_SEED = 0x5EED


@dataclass(frozen=True)
class Limit:
    """
    What must come of all runs.

    :param metric: a column, or `failure_rate`.
    :param quantile: of the metric, None for its mean.
    :param at_most, at_least: limit, the other one None.
    """

    metric: str
    quantile: float | None
    at_most: float | None
    at_least: float | None


@dataclass(frozen=True)
class Campaign:
    """
    Runs of a closed loop that differ in what is drawn.

    :param description: of the nominal scenario, see `loop.description`.
    :param parameters: that are drawn.
    :param believed: `nominal` if estimator and controller believe to have the nominal mechanism,
        whatever is drawn for the real one; `drawn` if they know each.
    :param seed: of all runs.
    :param runs: how many.
    :param limits: what must come of them.
    :param versions: of what makes the numbers.
    """

    description: Mapping[str, Any]
    parameters: tuple[Parameter, ...]
    believed: str
    seed: int
    runs: int
    limits: tuple[Limit, ...]
    versions: Mapping[str, str]

    @property
    def columns(self) -> dict[str, type]:
        """Names of what is drawn, and of what type it is."""
        return {name: parameter.type for parameter in self.parameters
                for name in parameter.columns}

    @property
    def identity(self) -> dict[str, Any]:
        """
        Return all that the numbers of a run depend on, but for its own, as JSON has it.

        More runs or other limits do not change those that there are.
        """
        vary = {parameter.name: [parameter.kind, *parameter.values, parameter.how,
                                 bool(parameter.places), parameter.within]
                for parameter in self.parameters}
        found: dict[str, Any] = json.loads(json.dumps({
            'scenario': self.description, 'vary': vary, 'believed': self.believed,
            'seed': self.seed, 'versions': self.versions}))
        return found

    @property
    def hash(self) -> str:
        """Name the identity by 64 digits."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()

    def seed_of(self, run: int) -> int:
        """Return the seed of the noise in a run, as a scenario takes it."""
        state = np.random.SeedSequence(self.seed, spawn_key=(run, _SEED)).generate_state(
            1, np.uint64)
        return int(state[0] >> np.uint64(1))

    def drawn(self, run: int) -> dict[str, Any]:
        """Draw the parameters of a run, by column."""
        return {name: value for parameter in self.parameters for name, value in zip(
            parameter.columns, parameter.draw(self.seed, run, self._cell(run)))}

    def described(self, run: int) -> dict[str, Any]:
        """Return the description of the scenario of a run."""
        return self._with(self.drawn(run), self.seed_of(run))

    def scenario(self, run: int) -> Scenario:
        """
        Make the scenario of a run.

        :raises FourbarError: what was drawn is refused.
        """
        return scenario_from(self.described(run), Path())

    def check(self) -> None:
        """
        Try what is drawn, as far as that can be done beforehand.

        The nominal scenario, every end of each distribution by itself, and the first runs.

        :raises CampaignError: a scenario refuses a value; says which.
        """
        _try(self._with({}, self.seed), 'the nominal scenario')
        for parameter in self.parameters:
            for value in parameter.extremes():
                _try(self._with(dict.fromkeys(parameter.columns, value), self.seed),
                     f'vary.{parameter.name} = {value}', 'refused alone')
        for run in range(min(self.runs, LOOKED_AT)):
            try:
                self.scenario(run)
            except FourbarError as error:
                raise CampaignError(
                    f'run {run} is refused: {error}; bound the distribution, of normal ones by '
                    'within: [low, high]') from None

    def _with(self, drawn: Mapping[str, Any], seed: int) -> dict[str, Any]:
        made = deepcopy(dict(self.description))
        made['seed'] = seed
        # What is believed comes after what is, which it may be made from.
        for believed in (False, True):
            if believed and self.believed == 'drawn':
                made['believed'] = deepcopy(made['mechanism'])
            for parameter in self.parameters:
                if (parameter.place[0] == 'believed') != believed:
                    continue
                for column, place in zip(parameter.columns,
                                         parameter.places or (parameter.place,)):
                    if column in drawn:
                        put(made, place, combined(
                            value_at(made, place), drawn[column], parameter.how))
        return made

    def _cell(self, run: int) -> dict[str, int]:
        """Return which value of each grid a run has; the last one changes first."""
        cell: dict[str, int] = {}
        for parameter in reversed(self.parameters):
            if parameter.kind == 'grid':
                run, cell[parameter.name] = divmod(run, len(parameter.values))
        return cell


def load_campaign(name: str, runs: int | None = None, seed: int | None = None) -> Campaign:
    """
    Read a campaign file.

    :param name: a preset (`prototype` for config/campaign_prototype.yaml) or the path of a file.
    :param runs, seed: instead of what it says.
    :raises CampaignError: what it says cannot be done.
    :raises FourbarError: there is no such file, or the scenario is refused.
    """
    path = config_file('campaign', name)
    values = load_yaml(path)
    try:
        campaign = campaign_from(values, path.parent)
    except FourbarError as error:
        raise CampaignError(f'{path}: {error}') from None
    return replace(campaign, runs=campaign.runs if runs is None else runs,
                   seed=campaign.seed if seed is None else seed)


def campaign_from(values: Mapping[str, Any], folder: Path) -> Campaign:
    """
    Make a campaign from the keys of its file.

    :param folder: where the relative path of a scenario begins.
    :raises FourbarError: as `load_campaign`.
    """
    for key in values:
        if key not in KEYS:
            raise CampaignError(f'unknown {key!r}{nearest(str(key), KEYS)} '
                                f'(known are {", ".join(KEYS)})')
    if missing := [key for key in REQUIRED if key not in values]:
        raise CampaignError(f'{", ".join(missing)} missing')
    believed = values.get('believed', 'nominal')
    if believed not in BELIEVED:
        raise CampaignError(f'believed must be {" or ".join(BELIEVED)}, got {believed!r}')
    description = _nominal(values, folder)
    parameters = _parameters(_section('vary', values), description)
    cells = prod(len(parameter.values) for parameter in parameters if parameter.kind == 'grid')
    runs = values.get('runs', cells if cells > 1 else DEFAULT_RUNS)
    seed = values.get('seed', 0)
    for key, number, low in (('runs', runs, 1), ('seed', seed, 0)):
        if isinstance(number, bool) or not isinstance(number, int) or number < low:
            raise CampaignError(f'{key} must be a whole number from {low}, got {number!r}')
    return Campaign(description, parameters, believed, seed, runs,
                    tuple(_limits(_section('limits', values))), versions())


def _nominal(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    name = values['scenario']
    if not isinstance(name, str):
        raise CampaignError(f'scenario must be the name of a preset or file, got {name!r}')
    if '/' in name or Path(name).suffix in ('.yaml', '.yml'):
        name = str((folder / Path(name).expanduser()).absolute())
    description = load_description(name)
    changes = dict(_section('set', values))
    if 'duration' in values:
        changes['duration'] = values['duration']
    if description['believed'] == description['mechanism']:
        # What is set of the mechanism is believed as well, then.
        del description['believed']
    apart = [str(each) for each in changes if str(each).split('.')[0] == 'believed']
    for name, value in changes.items():
        if name not in apart:
            put(description, place_of(str(name), description, 'set', True), value)
    # Names of files, and sections with keys left out, are spelled out.
    description = describe(description, folder)
    for name in apart:
        put(description, place_of(name, description, 'set', True), changes[name])
    return describe(description, folder)


def _parameters(vary: Mapping[str, Any], description: Mapping[str, Any]
                ) -> tuple[Parameter, ...]:
    found: list[Parameter] = []
    for name, given in ((str(name), given) for name, given in vary.items()):
        place = place_of(name, description, 'vary')
        kind, values, options = distribution(name, given)
        nominal = value_at(description, place)
        how = 'scale' if options.get('scale') else 'add' if options.get('add') else ''
        numbers = all(isinstance(value_at(description, each), (int, float))
                      for each in elements(place, nominal))
        if how and not numbers:
            raise CampaignError(f'vary.{name}: {how} needs a number, the nominal is {nominal!r}')
        places: tuple[Place, ...] = ()
        if options.get('each'):
            if not isinstance(nominal, list):
                raise CampaignError(f'vary.{name}: each is for arrays, the nominal is '
                                    f'{nominal!r}')
            places = tuple(elements(place, nominal))
        for other in found:
            shorter = min(len(place), len(other.place))
            if place[:shorter] == other.place[:shorter]:
                raise CampaignError(f'vary: {other.name} and {name} are both about the same')
        found.append(Parameter(name, place, kind, values, how, places, options.get('within')))
    return tuple(found)


def _limits(given: Mapping[str, Any]) -> list[Limit]:
    found = []
    for metric, entries in given.items():
        if metric != FAILURE_RATE and metric not in METRICS:
            known = [*METRICS, FAILURE_RATE]
            raise CampaignError(f'limits: no metric {metric!r}{nearest(str(metric), known)} '
                                f'(known are {", ".join(known)})')
        for entry in entries if isinstance(entries, list) else [entries]:
            found.append(_limit(metric, entry))
    return found


def _limit(metric: str, entry: Any) -> Limit:
    where = f'limits.{metric}'
    keys = ('at_most', 'at_least', *(() if metric == FAILURE_RATE else ('quantile',)))
    if not isinstance(entry, Mapping) or not set(entry) <= set(keys) or (
            ('at_most' in entry) == ('at_least' in entry)):
        raise CampaignError(f'{where} must have at_most or at_least'
                            f'{", and may have quantile" if "quantile" in keys else ""}; got '
                            f'{entry!r}')
    for key, value in entry.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value):
            raise CampaignError(f'{where}.{key} must be a finite number, got {value!r}')
    quantile = entry.get('quantile')
    if quantile is not None and not 0.0 <= quantile <= 1.0:
        raise CampaignError(f'{where}.quantile must be from 0 to 1, got {quantile:g}')
    return Limit(metric, quantile, entry.get('at_most'), entry.get('at_least'))


def _section(name: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
    section = values.get(name, {})
    if not isinstance(section, Mapping):
        raise CampaignError(f'{name} must be a section of its own, got {section!r}')
    return section


def _try(description: dict[str, Any], what: str, how: str = 'refused') -> None:
    try:
        make_loop(scenario_from(description, Path()))
    except FourbarError as error:
        raise CampaignError(f'{what} is {how}: {error}') from None
