# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Names of what is in a scenario: `mechanism.link_lengths[0]`, `setpoints[0].relative.link_b`.

A name leads through the description of a scenario (`loop.description`), key by key. Instead of
[0] to [3] an array of the four links takes .a to .d.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from difflib import get_close_matches
import re
from typing import Any

from fourbar_ros.studies.campaigns.processes import CampaignError

Place = tuple[str | int, ...]
"""Keys and indices on the way to a value."""

# Drawn for each run anyway.
NOT_VARIED = ('seed',)

_LETTERS = 'abcd'
_WORDS = re.compile(r'(?:^|\.)([A-Za-z_]\w*)|\[(\d+)\]')


def place_of(name: str, description: Mapping[str, Any], where: str, sections: bool = False
             ) -> Place:
    """
    Find what a name stands for: a value, or an array of numbers.

    :param where: in which section of the campaign it is, for messages.
    :param sections: whether it may be a section.
    :raises CampaignError: there is none; the nearest names are told.
    """
    place: list[str | int] = []
    value: Any = description
    at = 0
    while at < len(name):
        match = _WORDS.match(name, at)
        if match is None or (at == 0 and match[1] in NOT_VARIED):
            raise _unknown(name, description, where)
        at = match.end()
        key: str | int = match[1] if match[2] is None else int(match[2])
        if (isinstance(value, list) and isinstance(key, str) and key in tuple(_LETTERS)
                and _by_link(place, value)):
            key = _LETTERS.index(key)
        known = (key in value if isinstance(value, Mapping) and isinstance(key, str)
                 else isinstance(value, list) and isinstance(key, int) and key < len(value))
        if not known:
            raise _unknown(name, description, where)
        place.append(key)
        value = value[key]
    if not place or not (sections or _is_value(value)):
        raise CampaignError(f'{where}: {name!r} is a section, name one of its values'
                            f'{nearest(name + ".", names_of(description))}')
    return tuple(place)


def names_of(description: Mapping[str, Any]) -> list[str]:
    """List all names that may be varied, arrays before their elements."""
    return [name for key, value in description.items() if key not in NOT_VARIED
            for name in _names(key, value)]


def elements(place: Place, value: Any) -> Iterator[Place]:
    """Go through the places of the numbers in an array, row by row."""
    if isinstance(value, list):
        for index, each in enumerate(value):
            yield from elements((*place, index), each)
    else:
        yield place


def value_at(description: Mapping[str, Any], place: Place) -> Any:
    """Return what is at a place."""
    value: Any = description
    for key in place:
        value = value[key]
    return value


def put(description: dict[str, Any], place: Place, value: Any) -> None:
    """Put something at a place."""
    value_at(description, place[:-1])[place[-1]] = deepcopy(value)


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a question with the names that are nearest to one, or '' if none is near."""
    near = get_close_matches(name, list(known), n=3, cutoff=0.6)
    return f', do you mean {" or ".join(near)}?' if near else ''


def _names(name: str, value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, each in value.items():
            yield from _names(f'{name}.{key}', each)
        return
    if _is_value(value):
        yield name
    if isinstance(value, list):
        for index, each in enumerate(value):
            yield from _names(f'{name}[{index}]', each)


def _unknown(name: str, description: Mapping[str, Any], where: str) -> CampaignError:
    return CampaignError(
        f'{where}: no parameter {name!r}{nearest(name, names_of(description))}')


def _is_value(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(_is_value(each) for each in value)
    return not isinstance(value, Mapping)


def _by_link(place: list[str | int], value: list[Any]) -> bool:
    """Tell whether the elements of an array belong to links, and not to joints."""
    return (len(value) == len(_LETTERS) and len(place) == 2
            and place[0] in ('mechanism', 'believed') and not str(place[1]).startswith('joint_'))
