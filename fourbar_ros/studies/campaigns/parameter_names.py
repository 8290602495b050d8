# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Names of scenario parameters: `mechanism.link_lengths[0]`, `setpoints[0].relative.link_b`.

A name is a path through the description of a scenario (`loop.description`), key by key. An array
of the four links takes .a to .d instead of [0] to [3].
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from difflib import get_close_matches
import re
from typing import Any

from fourbar_ros.studies.campaigns import CampaignError

# Keys and indices on the path to a value.
Place = tuple[str | int, ...]

# Key of the mechanism that estimator and controller assume, in the description of a scenario.
MODEL = 'model'
# Its names in campaign files; the second one is deprecated.
MODEL_NAMES = ('model', 'believed')
# Keys that each run sets by itself.
NOT_VARIED = ('seed',)

_LETTERS = 'abcd'
_STEPS = re.compile(r'(?:^|\.)([A-Za-z_]\w*)|\[(\d+)\]')


def place_of(name: str, description: Mapping[str, Any], section: str,
             allow_sections: bool = False) -> Place:
    """
    Return the place of a parameter: a value, or an array of numbers.

    :param section: section of the campaign that the name is in, for messages.
    :param allow_sections: whether the name may be that of a section of the scenario.
    :raises CampaignError: there is no such parameter; the message suggests the nearest names.
    """
    place: list[str | int] = []
    value: Any = description
    position = 0
    while position < len(name):
        match = _STEPS.match(name, position)
        if match is None or (position == 0 and match[1] in NOT_VARIED):
            raise _unknown(name, description, section)
        key: str | int = match[1] if match[2] is None else int(match[2])
        if position == 0 and key in MODEL_NAMES:
            key = MODEL
        position = match.end()
        if (isinstance(value, list) and isinstance(key, str) and key in tuple(_LETTERS)
                and _is_per_link(place, value)):
            key = _LETTERS.index(key)
        known = (key in value if isinstance(value, Mapping) and isinstance(key, str)
                 else isinstance(value, list) and isinstance(key, int) and key < len(value))
        if not known:
            raise _unknown(name, description, section)
        place.append(key)
        value = value[key]
    if not place or not (allow_sections or _is_value(value)):
        raise CampaignError(f'{section}: {name!r} is a section, name one of its values'
                            f'{suggestion(name + ".", names_of(description))}', name=name)
    return tuple(place)


def names_of(description: Mapping[str, Any]) -> list[str]:
    """Return the names of all parameters that may vary, arrays before their elements."""
    return [name for key, value in description.items() if key not in NOT_VARIED
            for name in _names(MODEL_NAMES[0] if key == MODEL else key, value)]


def elements(place: Place, value: Any) -> Iterator[Place]:
    """Iterate over the places of the numbers in an array, row by row."""
    if isinstance(value, list):
        for index, element in enumerate(value):
            yield from elements((*place, index), element)
    else:
        yield place


def value_at(description: Mapping[str, Any], place: Place) -> Any:
    """Return the value at a place."""
    value: Any = description
    for key in place:
        value = value[key]
    return value


def set_value(description: dict[str, Any], place: Place, value: Any) -> None:
    """Replace the value at a place."""
    value_at(description, place[:-1])[place[-1]] = deepcopy(value)


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return a question with the known names nearest to a wrong one, '' if none is near."""
    near = get_close_matches(name, list(known), n=3, cutoff=0.6)
    return f', do you mean {" or ".join(near)}?' if near else ''


def _names(name: str, value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _names(f'{name}.{key}', inner)
        return
    if _is_value(value):
        yield name
    if isinstance(value, list):
        for index, element in enumerate(value):
            yield from _names(f'{name}[{index}]', element)


def _unknown(name: str, description: Mapping[str, Any], section: str) -> CampaignError:
    return CampaignError(
        f'{section}: no parameter {name!r}{suggestion(name, names_of(description))}',
        unknown=[name], place=section)


def _is_value(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(map(_is_value, value))
    return not isinstance(value, Mapping)


def _is_per_link(place: list[str | int], value: list[Any]) -> bool:
    """Tell whether the elements of an array belong to links, and not to joints."""
    return (len(value) == len(_LETTERS) and len(place) == 2
            and place[0] in ('mechanism', MODEL) and not str(place[1]).startswith('joint_'))
