# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What a campaign draws: distributions, and how what is drawn enters a scenario.

Every parameter of every run has random numbers of its own, from the seed of the campaign, the
number of the run and the name of the parameter. So a run is the same whichever others there are,
and another parameter in the campaign leaves what is drawn for the first as it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import hashlib
import json
from math import erfc, exp, inf, isfinite, log, sqrt
from typing import Any

from fourbar_ros.studies.campaigns.names import nearest, Place
from fourbar_ros.studies.campaigns.processes import CampaignError
import numpy as np

KINDS = {
    'uniform': '[low, high]',
    'normal': '{mean, std}',
    'lognormal': '{median, sigma}, the standard deviation of the natural logarithm',
    'loguniform': '[low, high], both positive',
    'choice': '[one, another, ...]',
    'grid': '[one, another, ...], each with each of the other grids',
}
"""Distributions and what is written behind their names."""

OPTIONS = ('scale', 'add', 'each', 'within')

# Bounds that a smaller share of the draws keeps are a mistake.
LEAST_SHARE = 1e-3
# None of so many draws keeps them in less than one of 1e43 cases then.
DRAWS = 100_000


@dataclass(frozen=True)
class Parameter:
    """
    A parameter that is drawn.

    :param name: as the campaign writes it.
    :param place: where it is in the description of a scenario.
    :param kind: one of `KINDS`.
    :param values: low and high, mean and std, median and sigma, or what is chosen from.
    :param how: '' to replace the nominal value, `scale` to multiply it, `add` to add to it.
    :param places: of the elements that are drawn on their own; without any, one number counts
        for all that is at `place`.
    :param within: bounds of a normal or lognormal distribution; beyond them it is drawn again.
    """

    name: str
    place: Place
    kind: str
    values: tuple[Any, ...]
    how: str = ''
    places: tuple[Place, ...] = ()
    within: tuple[float, float] | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of what is drawn: the parameter's, with an index where elements are."""
        if not self.places:
            return (self.name,)
        return tuple(self.name + ''.join(f'[{index}]' for index in place[len(self.place):])
                     for place in self.places)

    @property
    def type(self) -> type:
        """float, bool or str: of what is in the columns; lists are JSON in text."""
        if self.kind not in ('choice', 'grid'):
            return float
        for kind, types in ((bool, (bool,)), (float, (int, float))):
            if all(type(value) in types for value in self.values):
                return kind
        return str

    def draw(self, seed: int, run: int, cell: Mapping[str, int]) -> tuple[Any, ...]:
        """
        Draw for a run.

        :param cell: which of its values each grid has in this run.
        :returns: one value for each column.
        """
        if self.kind == 'grid':
            return (self.values[cell[self.name]],)
        digest = hashlib.sha256(self.name.encode()).digest()
        rng = np.random.default_rng(np.random.SeedSequence(
            seed, spawn_key=(run, *np.frombuffer(digest[:8], '<u4').tolist())))
        return tuple(self._one(rng) for _ in self.columns)

    def extremes(self) -> tuple[Any, ...]:
        """Return the values that it cannot go beyond, none where there are none."""
        if self.kind in ('normal', 'lognormal'):
            return self.within or ()
        return self.values

    def shown(self, value: Any) -> Any:
        """Return a drawn value as a column holds it."""
        if self.type is float:
            return float(value)
        return value if self.type is bool or isinstance(value, str) else json.dumps(value)

    def _one(self, rng: np.random.Generator) -> Any:
        if self.kind == 'choice':
            return self.values[int(rng.integers(len(self.values)))]
        low, high = self.within or (-inf, inf)
        for _ in range(DRAWS):
            try:
                value = self._number(rng)
            except OverflowError:
                # Larger than any number: so it is told, and refused, like one that is not finite.
                value = inf
            if low <= value <= high:
                return value
        raise CampaignError(f'vary.{self.name}: {DRAWS} draws were not within '
                            f'{low:g} to {high:g}')

    def _number(self, rng: np.random.Generator) -> float:
        first, second = self.values
        if self.kind == 'uniform':
            return float(rng.uniform(first, second))
        if self.kind == 'normal':
            return float(first + second * float(rng.standard_normal()))
        if self.kind == 'lognormal':
            return float(first * exp(second * float(rng.standard_normal())))
        return exp(float(rng.uniform(log(first), log(second))))


def combined(nominal: Any, drawn: Any, how: str) -> Any:
    """
    Apply what was drawn to a value, or to all elements of an array.

    :param how: as of `Parameter`.
    """
    if isinstance(nominal, list) and not (not how and isinstance(drawn, list)):
        return [combined(each, drawn, how) for each in nominal]
    if how == 'scale':
        return nominal * drawn
    return nominal + drawn if how == 'add' else drawn


def distribution(name: str, given: Any) -> tuple[str, tuple[Any, ...], dict[str, Any]]:
    """
    Read what a campaign writes behind the name of a parameter.

    :returns: kind, values and options.
    :raises CampaignError: that is no distribution.
    """
    where = f'vary.{name}'
    if not isinstance(given, Mapping):
        raise CampaignError(f'{where} must be a distribution like {{uniform: [0.9, 1.1]}}, got '
                            f'{given!r}')
    options = {key: value for key, value in given.items() if key in OPTIONS}
    kinds = [key for key in given if key not in OPTIONS]
    unknown = [str(key) for key in kinds if key not in KINDS]
    if unknown:
        raise CampaignError(f'{where}: no distribution {unknown[0]!r}'
                            f'{nearest(unknown[0], [*KINDS, *OPTIONS])} '
                            f'(known are {", ".join(KINDS)})')
    if len(kinds) != 1:
        raise CampaignError(f'{where} needs one distribution of {", ".join(KINDS)}, got '
                            f'{", ".join(kinds) or "none"}')
    kind = kinds[0]
    values = _values(f'{where}.{kind}', kind, given[kind])
    for option in ('scale', 'add', 'each'):
        if not isinstance(options.get(option, False), bool):
            raise CampaignError(f'{where}.{option} must be true or false, got '
                                f'{options[option]!r}')
    if options.get('scale') and options.get('add'):
        raise CampaignError(f'{where}: scale and add exclude each other')
    if (options.get('scale') or options.get('add')) and not all(map(_is_number, values)):
        raise CampaignError(f'{where}: scale and add need numbers, got {list(values)!r}')
    if kind == 'grid' and options.get('each'):
        raise CampaignError(f'{where}: a grid has one value for all, each is not for it')
    if (within := options.get('within')) is not None:
        if kind not in ('normal', 'lognormal'):
            raise CampaignError(f'{where}.within goes with normal and lognormal only')
        options['within'] = low, high = _pair(f'{where}.within', within)
        if not _share(kind, values, low, high) >= LEAST_SHARE:
            raise CampaignError(f'{where}.within: less than {100.0 * LEAST_SHARE:g} % of the '
                                f'draws are between {low:g} and {high:g}')
    return kind, values, options


def _share(kind: str, values: tuple[float, ...], low: float, high: float) -> float:
    """Return which share of a normal or lognormal distribution is between two numbers."""
    first, second = values
    if kind == 'lognormal':
        first, low, high = (log(each) if each > 0.0 else -inf for each in (first, low, high))
    if second == 0.0:
        return float(low <= first <= high)
    below, above = ((each - first) / second / sqrt(2.0) for each in (low, high))
    # From the tail on this side, where the difference of two that are nearly 1 is nothing.
    if below > 0.0:
        below, above = -above, -below
    return 0.5 * (erfc(-above) - erfc(-below))


def _values(where: str, kind: str, given: Any) -> tuple[Any, ...]:
    if kind in ('choice', 'grid'):
        if not isinstance(given, list) or not given:
            raise CampaignError(f'{where} must be a list of values, got {given!r}')
        return tuple(given)
    if kind in ('uniform', 'loguniform'):
        low, high = _pair(where, given)
        if kind == 'loguniform' and not low > 0.0:
            raise CampaignError(f'{where} must be positive, got {low:g}')
        return low, high
    names = ('mean', 'std') if kind == 'normal' else ('median', 'sigma')
    if not isinstance(given, Mapping) or set(given) != set(names):
        raise CampaignError(f'{where} must have {names[0]} and {names[1]}, got {given!r}')
    first, second = (_number(f'{where}.{each}', given[each]) for each in names)
    if second < 0.0:
        raise CampaignError(f'{where}.{names[1]} must not be negative, got {second:g}')
    if kind == 'lognormal' and not first > 0.0:
        raise CampaignError(f'{where}.median must be positive, got {first:g}')
    return first, second


def _pair(where: str, given: Any) -> tuple[float, float]:
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != 2:
        raise CampaignError(f'{where} must be [low, high], got {given!r}')
    low, high = (_number(where, each) for each in given)
    if not low <= high:
        raise CampaignError(f'{where}: {low:g} is more than {high:g}')
    return low, high


def _number(where: str, given: Any) -> float:
    if not _is_number(given):
        raise CampaignError(f'{where} must be a finite number, got {given!r}')
    return float(given)


def _is_number(given: Any) -> bool:
    return isinstance(given, (int, float)) and not isinstance(given, bool) and isfinite(given)
