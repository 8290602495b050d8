# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One row of a table of parameters, and what YAML makes of what is typed."""

from fourbar_ros.device.prototype.parameters import bus_parameters
from fourbar_ros.parameters import Parameter, ParameterError
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
