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

"""`fourbar sim` as it is typed, where it never reaches a plant."""

import os

from fourbar_ros.commands.main import main
import pytest


@pytest.mark.parametrize('arguments', [[], ['dance'], ['pause', 'resume']])
def test_what_cannot_be_read_is_refused(arguments, capsys):
    with pytest.raises(SystemExit) as done:
        main(['sim', *arguments])
    assert done.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert 'error: ' in captured.err.splitlines()[-1]


def test_help_tells_the_four_actions(capsys):
    with pytest.raises(SystemExit):
        main(['sim', '--help'])
    lines = capsys.readouterr().out.splitlines()
    for action in ('pause', 'resume', 'step', 'reset'):
        assert any(line.startswith(f'{action}  ') for line in lines)


def test_unusable_ros_is_one_line(capsys, monkeypatch):
    monkeypatch.setitem(os.environ, 'ROS_DOMAIN_ID', 'no number')
    assert main(['sim', 'pause']) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    line, = captured.err.splitlines()
    assert line.startswith('fourbar sim: ROS_DOMAIN_ID')
