# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Build, run and test the package in a colcon workspace, linked or copied."""

import os
from pathlib import Path
import sys
from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.package

CASE = Path(__file__).parents[2] / 'config' / 'reference' / 'paper_pair_ac.json'
COLCON = (sys.executable, '-m', 'colcon', '--log-base', 'log')
# Prefix of commands in the environment of the workspace.
SOURCED = ('sh', '-c', '. install/setup.sh && exec "$@"', 'sh')
# `env python3` must find the Python of colcon.
PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ['PATH']])


@pytest.fixture(scope='module', params=['copied', pytest.param('linked', marks=pytest.mark.slow)])
def workspace(request, tmp_path_factory, copy_tree, check):
    """Build a copy of the tree in its own workspace, and return the workspace."""
    workspace = tmp_path_factory.mktemp(request.param)
    copy_tree(workspace / 'src' / 'fourbar_ros')
    options = ['--symlink-install'] if request.param == 'linked' else []
    check(*COLCON, 'build', *options, cwd=workspace, PATH=PATH)
    return workspace


@pytest.fixture(scope='module')
def folder(workspace):
    """Return the folder where `ros2 run` looks for executables."""
    return workspace / 'install' / 'fourbar_ros' / 'lib' / 'fourbar_ros'


def test_every_executable_is_where_ros2_run_looks(folder, executables):
    assert sorted(path.name for path in folder.iterdir()) == sorted([*executables, 'fourbar'])
    assert all(os.access(path, os.X_OK) for path in folder.iterdir())


@pytest.mark.slow
def test_every_executable_has_help(workspace, folder, executables, check_help):
    names = [*executables, 'fourbar']
    check_help(*SOURCED, folder=folder, names=names, cwd=workspace, PATH=PATH)


def test_simulate_writes_a_table(workspace, folder, check):
    # Compiling takes longer than the case without it.
    check(*SOURCED, folder / 'simulate', CASE, '-o', 'out.csv', cwd=workspace, PATH=PATH,
          NUMBA_DISABLE_JIT='1')
    header, *rows = (workspace / 'out.csv').read_text().splitlines()
    assert header.startswith('t,link_a') and len(rows) > 1


def test_code_and_presets_are_those_of_the_workspace(workspace, check):
    code = ('import fourbar_ros; from fourbar_ros.common.config_files import config_file as f; '
            'print(fourbar_ros.__file__); print(f("mechanism", "paper"))')
    printed = check(*SOURCED, sys.executable, '-c', code, cwd=workspace, PATH=PATH)
    module, preset = map(Path, printed.splitlines())
    assert module.is_relative_to(workspace)
    assert preset.is_relative_to(workspace) and preset.is_file()


def test_colcon_test_runs_tests_that_pass(workspace, check):
    results = workspace / 'build' / 'fourbar_ros' / 'pytest.xml'
    # One quick file: the other tests run against the installed package elsewhere.
    check(*COLCON, 'test', '--return-code-on-test-failure', '--pytest-args',
          '-m', 'not package and not node', 'test/common/test_config_files.py',
          cwd=workspace, PATH=PATH)
    suite = ElementTree.parse(results).getroot().find('testsuite')
    assert int(suite.get('tests')) > 10
    assert (suite.get('failures'), suite.get('errors')) == ('0', '0')
