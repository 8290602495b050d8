# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A setting accepts values of its type within its limits, and refuses others by name."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, MISSING
from math import inf, nan
from typing import Any, ClassVar

from fourbar_ros.common.settings import (
    check_keys,
    Setting,
    setting,
    SettingError,
    Settings,
    settings_of,
)
import pytest

Refuses = Callable[..., AbstractContextManager[None]]

TEXT = Setting('bus.channel', '0', '', 'channel of the adapter')
RATE = Setting('rate', 1.0, 'Hz', 'ticks per second', low=0.5, high=10.0)


@dataclass(frozen=True)
class Bearings(Settings):
    """Settings of a section, one of them required."""

    section: ClassVar[str] = 'bearings'

    coulomb: float = setting(MISSING, 'N m', 'Coulomb friction', low=0.0)
    counts: int = setting(4, '', 'counts per turn', low=0)
    law: str = setting('stribeck', '', 'friction law', choices=('stribeck', 'plain'))
    width: float = setting(inf, 'm', 'width', above=0.0, infinite=True)


@pytest.mark.parametrize(('typed', 'text'), [(0, '0'), ('can0', 'can0'), (False, 'off')])
def test_text_that_yaml_reads_as_another_type_is_text(typed: object, text: str) -> None:
    assert TEXT.check(typed) == text


@pytest.mark.parametrize('typed', [0.5, True, None, ['can0']])
def test_other_types_than_text_are_refused(typed: object, refuses: Refuses) -> None:
    with refuses(SettingError, name='bus.channel', value=typed, limit=str):
        TEXT.check(typed)


def test_whole_number_is_a_number() -> None:
    assert (RATE.check(2), type(RATE.check(2))) == (2.0, float)


@pytest.mark.parametrize('wrong', [True, '2', None, [2.0]])
def test_other_types_than_numbers_are_refused(wrong: Any, refuses: Refuses) -> None:
    with refuses(SettingError, name='rate', value=wrong, limit=float):
        RATE.check(wrong)


@pytest.mark.parametrize('wrong', [nan, inf, -inf, 0.4999, 10.001, 10 ** 400])
def test_numbers_beyond_the_limits_are_refused(wrong: float, refuses: Refuses) -> None:
    with refuses(SettingError, name='rate', limit=(0.5, 10.0)):
        RATE.check(wrong)


def test_both_limits_are_allowed() -> None:
    assert [RATE.check(limit) for limit in (0.5, 10.0)] == [0.5, 10.0]


def test_message_is_one_short_line_for_any_value(refuses: Refuses) -> None:
    for wrong in ('x' * 10_000, 'two\nlines', 10 ** 5000, [0] * 10_000):
        with pytest.raises(SettingError) as caught:
            RATE.check(wrong)
        assert len(str(caught.value)) < 150
        assert '\n' not in str(caught.value)


def test_settings_are_made_of_a_section() -> None:
    made = Bearings.from_mapping({'coulomb': 1, 'counts': 8.0})
    assert made == Bearings(1.0, 8, 'stribeck', inf)
    assert [type(value) for value in (made.coulomb, made.counts)] == [float, int]


@pytest.mark.parametrize(('values', 'refused'), [
    ({'coulomb': -1.0}, {'name': 'bearings.coulomb', 'value': -1.0, 'limit': (0.0, inf)}),
    ({'coulomb': 0.0, 'counts': 1.5}, {'name': 'bearings.counts', 'value': 1.5, 'limit': int}),
    ({'coulomb': 0.0, 'law': 'none'},
     {'name': 'bearings.law', 'value': 'none', 'limit': ('stribeck', 'plain')}),
    ({'coulomb': 0.0, 'width': 0.0}, {'name': 'bearings.width', 'value': 0.0}),
    ({}, {'missing': ['coulomb'], 'place': 'bearings'}),
    ({'coulomb': 0.0, 'colour': 'red'}, {'unknown': ['colour'], 'place': 'bearings'}),
    ([1.0], {'name': 'bearings', 'value': [1.0], 'limit': dict}),
])
def test_section_is_refused_by_name_value_and_limit(
        values: Any, refused: dict[str, Any], refuses: Refuses) -> None:
    with refuses(SettingError, **refused):
        Bearings.from_mapping(values)


def test_declarations_have_name_type_unit_and_limits() -> None:
    rows = {row.name: row for row in settings_of(Bearings, 'table.')}
    assert list(rows) == ['table.coulomb', 'table.counts', 'table.law', 'table.width']
    assert [row.kind for row in rows.values()] == [float, int, str, float]
    assert rows['table.coulomb'].unit == 'N m'
    assert rows['table.coulomb'].limits == (0.0, inf)
    assert rows['table.law'].choices == ('stribeck', 'plain')


def test_keys_are_checked_with_the_error_of_the_caller(refuses: Refuses) -> None:
    class FileError(SettingError):
        pass
    with refuses(FileError, missing=['a'], place='file'):
        check_keys({'b': 1}, ['a'], 'file', FileError, optional=['b'])


def test_error_keeps_its_values_when_a_place_is_added() -> None:
    with pytest.raises(SettingError) as caught:
        RATE.check(11.0)
    placed = caught.value.at('nodes.yaml', SettingError)
    assert placed.values == {**caught.value.values, 'place': 'nodes.yaml'}
    assert str(placed).startswith('nodes.yaml: ')
