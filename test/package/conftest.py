# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Copies of the tree for installations, and processes without this installation."""

from concurrent.futures import ThreadPoolExecutor
import os
from pathlib import Path
import shutil
import subprocess

import pytest

ROOT = Path(__file__).parents[2]
LEAKS = (
    'AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'LD_LIBRARY_PATH',
    'PYTHONHOME', 'PYTHONPATH', 'RMW_IMPLEMENTATION', 'VIRTUAL_ENV',
    '_ROS_WHEELS_BOOTSTRAP_COMPLETE',
)


@pytest.fixture(scope='session')
def copy_tree():
    """Return a function that copies the tree to a new folder, without ignored files."""
    ignored = [line.rstrip('/') for line in (ROOT / '.gitignore').read_text().split()]

    def copy(target):
        return shutil.copytree(
            ROOT, target, symlinks=True, ignore=shutil.ignore_patterns('.git', *ignored))
    return copy


@pytest.fixture(scope='session')
def check():
    """
    Return a function that runs a command, checks its success, and returns its output.

    The environment has no variables of this installation or of a sourced ROS.
    """
    def check(*command, cwd='/', **variables):
        inherited = {key: value for key, value in os.environ.items() if key not in LEAKS}
        result = subprocess.run(
            [str(part) for part in command], cwd=cwd, env={**inherited, **variables},
            capture_output=True, text=True, timeout=400)
        assert result.returncode == 0, f'{command}\n{result.stdout}\n{result.stderr}'
        return result.stdout
    return check


@pytest.fixture(scope='session')
def executables():
    """Return the names for `ros2 run`."""
    return sorted(path.name for path in (ROOT / 'scripts').glob('[!_]*'))


@pytest.fixture(scope='session')
def check_help(check):
    """Return a function that checks that executables print --help."""
    def check_help(*prefix, folder, names, **options):
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            texts = pool.map(
                lambda name: check(*prefix, folder / name, '--help', **options), names)
            assert [name for name, text in zip(names, texts) if 'usage' not in text] == []
    return check_help
