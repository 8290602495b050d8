# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""One row of a table of parameters, and what YAML makes of what is typed."""

from fourbar_ros.common.settings import Setting, SettingError
from fourbar_ros.hardware.bus_settings import bus_parameters
import pytest

CHANNEL = {row.name: row for row in bus_parameters('kvaser', '0', '')}['bus.channel']


@pytest.mark.parametrize(('typed', 'text'), [(0, '0'), ('can0', 'can0'), (False, 'off')])
def test_text_that_yaml_reads_as_something_else_is_text(typed: object, text: str) -> None:
    assert CHANNEL.check(typed) == text


@pytest.mark.parametrize('typed', [0.5, True, None, ['can0']])
def test_what_is_no_text_is_refused(typed: object) -> None:
    with pytest.raises(SettingError, match='bus.channel must be of type str, got'):
        CHANNEL.check(typed)


def test_whole_number_is_a_number() -> None:
    row = Setting('rate', 1.0, 'Hz', 'how often', low=0.5, high=10.0)
    assert (row.check(2), type(row.check(2))) == (2.0, float)
    for wrong in (True, '2', float('nan'), 11):
        with pytest.raises(SettingError, match='rate'):
            row.check(wrong)
