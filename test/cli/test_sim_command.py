# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The command `fourbar sim` without a plant."""

import os

from fourbar_ros.cli.main import main
import pytest


@pytest.mark.parametrize('arguments', [[], ['dance'], ['pause', 'resume']])
def test_bad_action_is_refused(arguments, capsys):
    with pytest.raises(SystemExit) as done:
        main(['sim', *arguments])
    assert done.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert 'error: ' in captured.err.splitlines()[-1]


def test_help_describes_the_four_actions(capsys):
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
