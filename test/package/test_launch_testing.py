# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The tests run beside the pytest plugins of ROS.

The plugin of launch_testing imports every test file when pytest collects it, in search of launch
tests. A file that skips itself on import ends the whole collection there, and two files of one
name hide each other: `colcon test` then runs nothing and reports success.
"""

import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.package

ROOT = Path(__file__).parents[2]
PLUGIN = '''
"""Imports every collected file, as the plugin of launch_testing does."""

import sys

from _pytest.pathlib import import_path, ImportMode
import pytest

# None makes an import fail and importlib.util.find_spec return None.
sys.modules.update(dict.fromkeys({absent!r}))


def pytest_pycollect_makemodule(module_path, parent):
    try:
        module = import_path(
            module_path, mode=ImportMode.prepend, root=parent.config.rootpath,
            consider_namespace_packages=False)
    except SyntaxError:
        module = None
    assert not hasattr(module, 'generate_test_description')
    return pytest.Module.from_parent(parent, path=module_path)
'''
# Python packages of the extras that no rosdep key of package.xml brings.
ABSENT = ('cma', 'dask', 'distributed', 'mujoco', 'pyarrow', 'sympy')


@pytest.fixture(scope='module')
def plugin(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Write the plugin, and return an environment in which pytest loads it."""
    folder = tmp_path_factory.mktemp('plugin')
    (folder / 'launch_hook.py').write_text(PLUGIN.format(absent=()))
    (folder / 'launch_hook_on_ros.py').write_text(PLUGIN.format(absent=ABSENT))
    return {**os.environ, 'PYTHONPATH': str(folder), 'PYTEST_PLUGINS': 'launch_hook'}


def counted(text: str, word: str) -> int:
    """Return the number before a word in the summary of pytest."""
    found = re.findall(rf'(\d+) (?:tests? )?{word}', text)
    return int(found[-1]) if found else 0


def run_pytest(*arguments: str, environment: dict[str, str] | None = None
               ) -> subprocess.CompletedProcess[str]:
    """Run pytest on the tree in its own process."""
    return subprocess.run(
        [sys.executable, '-P', '-m', 'pytest', '-q', '-p', 'no:cacheprovider', *arguments],
        cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_collection_is_complete_beside_the_plugin(plugin: dict[str, str]) -> None:
    """Every test is collected."""
    alone = run_pytest('--collect-only')
    beside = run_pytest('--collect-only', environment=plugin)
    assert alone.returncode == beside.returncode == 0, beside.stdout[-2000:] + beside.stderr
    assert counted(beside.stdout, 'collected') == counted(alone.stdout, 'collected') > 5000


@pytest.mark.slow
def test_collection_needs_no_package_that_ros_lacks(plugin: dict[str, str]) -> None:
    """Without the optional packages only the tests of campaigns are left out."""
    result = run_pytest('--collect-only',
                        environment={**plugin, 'PYTEST_PLUGINS': 'launch_hook_on_ros'})
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr
    assert counted(result.stdout, 'collected') > 5000


def test_tests_run_beside_the_plugin(plugin: dict[str, str]) -> None:
    """A quick folder passes, and its tests are counted."""
    result = run_pytest('test/common', environment=plugin)
    assert result.returncode == 0, result.stdout[-2000:]
    assert counted(result.stdout, 'passed') > 80


def test_names_of_test_files_are_unique() -> None:
    names = [path.name for path in (ROOT / 'test').rglob('test_*.py')]
    assert [name for name in names if names.count(name) > 1] == []
