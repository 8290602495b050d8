# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The command `fourbar report`."""

import json
from pathlib import Path
import subprocess
import sys

from fourbar_ros.cli.main import main
import pytest


@pytest.fixture(scope='module')
def bag(synthetic, tmp_path_factory):
    return synthetic.write_bag(tmp_path_factory.mktemp('bag') / 'run1',
                               synthetic.motion_messages())


def report(*arguments, cwd):
    return subprocess.run(
        [sys.executable, '-m', 'fourbar_ros', 'report', *map(str, arguments)], cwd=cwd,
        capture_output=True, text=True, timeout=120)


@pytest.mark.slow
def test_files_are_beside_the_bag(bag):
    done = report('run1', cwd=bag.parent)
    assert (done.returncode, done.stderr) == (0, '')
    assert [Path(line).name for line in done.stdout.splitlines()] == [
        'run1.report.html', 'run1.metrics.json']
    assert (bag.parent / 'run1.report.html').read_text().startswith('<!DOCTYPE html>')
    numbers = json.loads((bag.parent / 'run1.metrics.json').read_text())
    assert numbers['missing'] == {}
    assert not list(bag.glob('*.html'))


@pytest.mark.slow
def test_files_are_written_to_the_given_paths(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(['report', str(bag), '-o', 'a.html', '--metrics', 'b.json',
                 '--mechanism', 'paper']) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ['a.html', 'b.json']


@pytest.mark.slow
@pytest.mark.parametrize(('arguments', 'named'), [
    (['nowhere'], 'nowhere: '),
    (['.'], 'metadata.yaml'),
    (['{bag}', '--mechanism', 'nonsense'], 'nonsense'),
    (['{bag}', '--namespace', '/lab'], 'setpoint'),
    (['{bag}', '-o', 'no/a.html'], 'no/a.html'),
])
def test_bad_input_is_one_line_and_exit_code_2(
        bag, tmp_path, monkeypatch, capfd, arguments, named):
    monkeypatch.chdir(tmp_path)
    assert main(['report', *(argument.format(bag=bag) for argument in arguments)]) == 2
    out, err = capfd.readouterr()
    assert len(err.splitlines()) == 1
    assert err.startswith('fourbar report: ')
    assert named in err
    assert out == ''


@pytest.mark.medium
def test_bad_input_ends_a_process_with_one_line(tmp_path):
    done = report('nowhere', cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, '')
    line, = done.stderr.splitlines()
    assert line.startswith('fourbar report: ')
    assert 'nowhere' in line


def test_help_needs_no_heavy_library(tmp_path):
    code = ('import sys; from fourbar_ros.cli import report; '
            'import argparse; report.add_arguments(argparse.ArgumentParser()); '
            'print(sorted({"matplotlib", "rosbags", "numpy", "rclpy"} & set(sys.modules)))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          cwd=tmp_path, check=True)
    assert done.stdout == '[]\n'
