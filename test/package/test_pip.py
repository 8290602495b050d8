# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`pip install .` into a fresh environment gives all commands and all files."""

import csv
import json
import os
from pathlib import Path
import re
import sys

import pytest

pytestmark = [pytest.mark.package, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
CASE = ROOT / 'config' / 'reference' / 'paper_pair_ac.json'


@pytest.fixture(scope='module')
def prefix(tmp_path_factory, copy_tree, check):
    """Install a copy of the tree with its dependencies, and return the prefix."""
    tree = copy_tree(tmp_path_factory.mktemp('pip') / 'tree')
    prefix = tree.parent / 'prefix'
    check(sys.executable, '-m', 'venv', prefix)
    # Most modules are never imported, so pip does not compile them.
    check(prefix / 'bin' / 'python', '-m', 'pip', 'install', '--quiet', '--no-compile', '.',
          cwd=tree)
    return prefix


@pytest.fixture(scope='module')
def folder(prefix):
    """Return the folder where `ros2 run` looks for executables."""
    return prefix / 'lib' / 'fourbar_ros'


def test_every_executable_is_where_ros2_run_looks(folder, executables):
    assert sorted(path.name for path in folder.iterdir()) == executables
    assert all(os.access(path, os.X_OK) for path in folder.iterdir())


def test_every_executable_has_help(folder, executables, check_help):
    check_help(folder=folder, names=executables)


def test_fourbar_has_help_and_lists_every_command(prefix, executables, check):
    text = check(prefix / 'bin' / 'fourbar', '--help')
    assert [name for name in executables if not re.search(rf'^ +{name}\b', text, re.M)] == []


def test_executable_finds_its_python_when_another_one_starts_it(folder, check):
    # `ros2 run` starts it with the Python of the system.
    other = check(sys.executable, '-c', 'import sys; print(sys._base_executable)').strip()
    assert not Path(other).is_relative_to(folder.parents[1])
    assert 'usage' in check(other, folder / 'simulate', '--help')


def test_simulate_writes_the_times_of_the_case(folder, check, tmp_path):
    # Compiling takes longer than the case without it.
    check(folder / 'simulate', CASE, '-o', tmp_path / 'out.csv', cwd=tmp_path,
          NUMBA_DISABLE_JIT='1')
    with open(tmp_path / 'out.csv', newline='') as stream:
        header, *rows = csv.reader(stream)
    assert header == ['t', *(f'{kind}_{link}' for kind in ('link', 'rate', 'flywheel')
                             for link in 'abcd')]
    assert [float(row[0]) for row in rows] == pytest.approx(json.loads(CASE.read_text())['t'])


def test_share_has_the_files_of_the_tree(prefix):
    share = prefix / 'share' / 'fourbar_ros'
    for name in ('config', 'launch'):
        # Only files: compiled launch files may be in a folder.
        expected, found = (
            {path.name: path.read_bytes() for path in folder.glob('*') if path.is_file()}
            for folder in (ROOT / name, share / name))
        assert found == expected
    assert (share / 'package.xml').is_file()
    assert (prefix / 'share/ament_index/resource_index/packages/fourbar_ros').is_file()


def test_presets_are_found_from_any_folder(prefix, check, tmp_path):
    code = ('from fourbar_ros.common.config_files import config_file as f; '
            'print(f("mechanism", "paper"))')
    found = check(prefix / 'bin' / 'python', '-c', code, cwd=tmp_path).strip()
    assert Path(found) == prefix / 'share' / 'fourbar_ros' / 'config' / 'mechanism_paper.yaml'
