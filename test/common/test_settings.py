# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""One row of a table of parameters, and what YAML makes of what is typed."""

from fourbar_ros.common.settings import Parameter, ParameterError
from fourbar_ros.hardware.bus_settings import bus_parameters
import pytest

CHANNEL = {row.name: row for row in bus_parameters('kvaser', '0', '')}['bus.channel']


@pytest.mark.parametrize(('typed', 'text'), [(0, '0'), ('can0', 'can0'), (False, 'off')])
def test_text_that_yaml_reads_as_something_else_is_text(typed: object, text: str) -> None:
    assert CHANNEL.checked(typed) == text


@pytest.mark.parametrize('typed', [0.5, True, None, ['can0']])
def test_what_is_no_text_is_refused(typed: object) -> None:
    with pytest.raises(ParameterError, match='bus.channel must be of type str, got'):
        CHANNEL.checked(typed)


def test_whole_number_is_a_number() -> None:
    row = Parameter('rate', 1.0, 'Hz', 'how often', limits=(0.5, 10.0))
    assert (row.checked(2), type(row.checked(2))) == (2.0, float)
    for wrong in (True, '2', float('nan'), 11):
        with pytest.raises(ParameterError, match='rate'):
            row.checked(wrong)
