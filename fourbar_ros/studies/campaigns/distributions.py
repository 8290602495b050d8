# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Distributions of a campaign, and the use of a drawn value in a scenario.

The random stream of a parameter in a run depends on the seed of the campaign, the number of the
run and the name of the parameter. So a run does not depend on the number of runs, and a further
parameter does not change the draws of the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, MISSING
from functools import cached_property
import hashlib
import json
from math import inf
from typing import Any

from fourbar_ros.common.settings import Setting, setting, Settings
from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns.parameter_names import Place, suggestion
import numpy as np
from scipy import stats

# Distributions and the syntax of their arguments.
KINDS = {
    'uniform': '[low, high]',
    'normal': '{mean, std}',
    'lognormal': '{median, sigma}, the standard deviation of the natural logarithm',
    'loguniform': '[low, high], both positive',
    'choice': '[value, value, ...]',
    'grid': '[value, value, ...], each with each of the other grids',
}

# Smallest probability of the range `within`; a smaller one is taken for a mistake.
LEAST_SHARE = 1e-3
# Draws per run; with `LEAST_SHARE` all of them miss the range in one of 1e43 runs.
MOST_DRAWS = 100_000


@dataclass(frozen=True)
class _Normal(Settings):
    mean: float = setting(MISSING, '', 'mean')
    std: float = setting(MISSING, '', 'standard deviation', low=0.0)


@dataclass(frozen=True)
class _Lognormal(Settings):
    median: float = setting(MISSING, '', 'median', above=0.0)
    sigma: float = setting(MISSING, '', 'standard deviation of the logarithm', low=0.0)


@dataclass(frozen=True)
class _Options(Settings):
    scale: bool = setting(False, '', 'the drawn value multiplies the nominal value')
    add: bool = setting(False, '', 'the drawn value is added to the nominal value')
    each: bool = setting(False, '', 'each element of an array is drawn by itself')


OPTIONS = ('scale', 'add', 'each', 'within')


@dataclass(frozen=True)
class Distribution:
    """
    A distribution of a campaign file.

    :param kind: one of `KINDS`.
    :param values: low and high, mean and std, median and sigma, or the values to choose from.
    :param how: '' to replace the nominal value, `scale` to multiply it, `add` to add to it.
    :param each: whether the elements of an array are drawn one by one.
    :param within: range of a normal or lognormal distribution; draws outside are repeated.
    """

    kind: str
    values: tuple[Any, ...]
    how: str = ''
    each: bool = False
    within: tuple[float, float] | None = None

    @classmethod
    def from_mapping(cls, content: Any, place: str) -> Distribution:
        """
        Make a distribution from the content of a campaign file.

        :param place: name of the parameter in the file, for messages.
        :raises FourbarError: wrong kind, argument or option.
        """
        if not isinstance(content, Mapping):
            raise CampaignError(f'{place} must be a distribution like {{uniform: [0.9, 1.1]}}, '
                                f'got {content!r}', name=place, value=content)
        options = {key: value for key, value in content.items() if key in OPTIONS}
        kinds = [str(key) for key in content if key not in OPTIONS]
        if unknown := [key for key in kinds if key not in KINDS]:
            raise CampaignError(f'{place}: no distribution {unknown[0]!r}'
                                f'{suggestion(unknown[0], [*KINDS, *OPTIONS])} '
                                f'(known are {", ".join(KINDS)})', unknown=unknown, place=place)
        if len(kinds) != 1:
            raise CampaignError(f'{place} needs one distribution of {", ".join(KINDS)}, got '
                                f'{", ".join(kinds) or "none"}', name=place, value=kinds)
        kind, bounds = kinds[0], options.pop('within', None)
        flags = _Options.from_mapping(options, place)
        values = _values(kind, content[kind], f'{place}.{kind}')
        how = 'scale' if flags.scale else 'add' if flags.add else ''
        if flags.scale and flags.add:
            raise CampaignError(f'{place}: scale and add exclude each other', name=place)
        if how and not all(type(value) in (int, float) for value in values):
            raise CampaignError(f'{place}: {how} needs numbers, got {list(values)!r}', name=place)
        if kind == 'grid' and flags.each:
            raise CampaignError(f'{place}: a grid sets one value for all elements, it does not '
                                'take each', name=place)
        if bounds is None:
            return cls(kind, values, how, flags.each)
        if kind not in ('normal', 'lognormal'):
            raise CampaignError(f'{place}.within is an option of normal and lognormal only',
                                name=f'{place}.within')
        low, high = _range(bounds, f'{place}.within')
        made = cls(kind, values, how, flags.each, (low, high))
        if not made.probability(low, high) >= LEAST_SHARE:
            raise CampaignError(
                f'{place}.within: less than {100.0 * LEAST_SHARE:g} % of the draws are between '
                f'{low:g} and {high:g}', name=f'{place}.within', limit=LEAST_SHARE)
        return made

    @cached_property
    def law(self) -> Any:
        """Frozen distribution of scipy.stats; a constant is a uniform one of width 0."""
        first, second = self.values
        if self.kind == 'uniform':
            return stats.uniform(first, second - first)
        if self.kind == 'loguniform':
            return (stats.loguniform(first, second) if first < second
                    else stats.uniform(float(np.exp(np.log(first))), 0.0))
        if second == 0.0:
            return stats.uniform(first, 0.0)
        return (stats.norm(first, second) if self.kind == 'normal'
                else stats.lognorm(second, scale=first))

    @property
    def extremes(self) -> tuple[Any, ...]:
        """Smallest and largest value, or all values; empty where the range is unlimited."""
        return (self.within or ()) if self.kind in ('normal', 'lognormal') else self.values

    def probability(self, low: float, high: float) -> float:
        """Return the probability of a value from low to high, of a normal or lognormal one."""
        if self.values[1] == 0.0:
            return float(low <= self.values[0] <= high)
        return float(self.law.cdf(high) - self.law.cdf(low))

    def draw(self, rng: np.random.Generator, count: int) -> list[Any]:
        """
        Draw independent values, of any distribution but a grid.

        :raises CampaignError: none of `MOST_DRAWS` was within the range.
        """
        if self.kind == 'choice':
            return [self.values[int(rng.integers(len(self.values)))] for _ in range(count)]
        low, high = self.within or (-inf, inf)
        accepted: list[float] = []
        size = count
        while size <= MOST_DRAWS:
            # A value that overflows is inf, which the scenario refuses.
            with np.errstate(over='ignore'):
                values = np.asarray(self.law.rvs(size=size, random_state=rng))
            accepted += values[(low <= values) & (values <= high)].tolist()
            if len(accepted) >= count:
                return accepted[:count]
            size *= 2
        raise CampaignError(f'no draws within {low:g} to {high:g}', limit=(low, high))


@dataclass(frozen=True)
class Parameter:
    """
    A parameter that varies from run to run.

    :param name: as in the campaign file.
    :param place: of the parameter in the description of a scenario.
    :param distribution: of its values.
    :param places: of the elements that are drawn one by one; () where one number applies to
        the whole of `place`.
    """

    name: str
    place: Place
    distribution: Distribution
    places: tuple[Place, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the drawn values: the parameter's, with indices for elements."""
        if not self.places:
            return (self.name,)
        return tuple(self.name + ''.join(f'[{index}]' for index in place[len(self.place):])
                     for place in self.places)

    @property
    def value_type(self) -> type:
        """Type of the columns: float, bool or str; lists are JSON in text."""
        if self.distribution.kind not in ('choice', 'grid'):
            return float
        for kind, types in ((bool, (bool,)), (float, (int, float))):
            if all(type(value) in types for value in self.distribution.values):
                return kind
        return str

    def draw(self, seed: int, run: int, cell: Mapping[str, int]) -> list[Any]:
        """
        Draw for a run.

        :param cell: index of the value of each grid in this run.
        :returns: one value per column.
        """
        if self.distribution.kind == 'grid':
            return [self.distribution.values[cell[self.name]]]
        digest = hashlib.sha256(self.name.encode()).digest()
        rng = np.random.default_rng(np.random.SeedSequence(
            seed, spawn_key=(run, *np.frombuffer(digest[:8], '<u4').tolist())))
        return self.distribution.draw(rng, len(self.columns))

    def column_value(self, value: Any) -> Any:
        """Return a drawn value in the type of the column."""
        if self.value_type is float:
            return float(value)
        return value if self.value_type is bool or isinstance(value, str) else json.dumps(value)


def combine(nominal: Any, drawn: Any, how: str) -> Any:
    """
    Combine the nominal value with a drawn one, for an array element by element.

    :param how: as of `Distribution`.
    """
    if isinstance(nominal, list) and not (not how and isinstance(drawn, list)):
        return [combine(element, drawn, how) for element in nominal]
    if how == 'scale':
        return nominal * drawn
    return nominal + drawn if how == 'add' else drawn


def _values(kind: str, arguments: Any, place: str) -> tuple[Any, ...]:
    if kind in ('choice', 'grid'):
        if not isinstance(arguments, list) or not arguments:
            raise CampaignError(f'{place} must be a list of values, got {arguments!r}',
                                name=place, value=arguments)
        return tuple(arguments)
    if kind in ('uniform', 'loguniform'):
        return _range(arguments, place, above=0.0 if kind == 'loguniform' else -inf)
    settings = (_Normal if kind == 'normal' else _Lognormal).from_mapping(arguments, place)
    return tuple(vars(settings).values())


def _range(content: Any, place: str, above: float = -inf) -> tuple[float, float]:
    if not isinstance(content, Sequence) or isinstance(content, str) or len(content) != 2:
        raise CampaignError(f'{place} must be [low, high], got {content!r}', name=place,
                            value=content)
    number = Setting(place, 0.0, '', 'end of a range', above=above)
    low, high = map(number.check, content)
    if not low <= high:
        raise CampaignError(f'{place}: low {low:g} is more than high {high:g}', name=place,
                            value=(low, high))
    return low, high
