# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Compiled code is cached between processes while its sources do not change."""

import io
import json
import os
from pathlib import Path
import subprocess
import sys

from fourbar_ros.kernels import compiler
import pytest

CALLER = """
from ..kernels.compiler import kernel
from ..plant.callee import factor


@kernel
def scaled(x):
    return factor() * x


@kernel(parallel=False, fastmath=True)
def inverse(x):
    return 1.0 / x
"""
CALLEE = """
from ..kernels.compiler import kernel


@kernel
def factor():
    return {factor}
"""
PROGRAM = """
import json
import tempfile
tempfile.tempdir = {temporary!r}
from fourbar_ros.mechanism.caller import inverse, scaled
from fourbar_ros.kernels.compiler import cache_directory
import numba
print(json.dumps({{
    'scaled': scaled(2.0), 'inverse': inverse(0.0), 'directory': str(cache_directory()),
    'loaded': sum(scaled.stats.cache_hits.values()), 'numba': numba.config.CACHE_DIR}}))
"""
NOWHERE = '/dev/null/nowhere'  # below a file, so that not even root can write there


class Tree:
    """A small fourbar_ros with kernels in two rooms, and a home for its cache."""

    def __init__(self, folder):
        self.folder = folder
        self.root = folder / 'tree' / 'fourbar_ros'
        for room in compiler.ROOMS:
            (self.root / room).mkdir(parents=True)
            (self.root / room / '__init__.py').touch()
        (self.root / '__init__.py').touch()
        source = Path(compiler.__file__).read_text()
        (self.root / 'kernels' / 'compiler.py').write_text(source)
        (self.root / 'mechanism' / 'caller.py').write_text(CALLER)
        (self.root / 'plant' / 'callee.py').write_text(CALLEE.format(factor=3.0))

    def run(self, temporary=None, **environment):
        """Run the kernels in a fresh process with one cache folder."""
        inherited = {key: value for key, value in os.environ.items()
                     if not key.startswith('NUMBA_') and key != 'XDG_CACHE_HOME'}
        result = subprocess.run(
            [sys.executable, '-c', PROGRAM.format(temporary=temporary or str(self.folder))],
            cwd='/', capture_output=True, text=True, env={
                **inherited, 'HOME': str(self.folder / 'home'),
                'PYTHONPATH': str(self.root.parent), **environment})
        assert result.returncode == 0, result.stderr
        return {'notes': result.stderr.splitlines(), **json.loads(result.stdout)}


@pytest.fixture
def tree(tmp_path):
    return Tree(tmp_path)


@pytest.fixture
def package(tree):
    return tree.root


@pytest.fixture
def run(tree):
    return tree.run


@pytest.fixture(scope='module')
def common(tmp_path_factory):
    """Make a tree for tests of the files of common runs."""
    return Tree(tmp_path_factory.mktemp('common'))


@pytest.fixture(scope='module')
def first(common):
    return common.run()


@pytest.fixture(scope='module')
def chosen(common, first):
    """Run with a cache folder that the user has set."""
    return common.run(NUMBA_CACHE_DIR=str(common.folder / 'chosen'))


@pytest.mark.slow
def test_second_process_loads_what_the_first_compiled(common, first):
    assert first['loaded'] == 0
    assert common.run()['loaded'] == 1


@pytest.mark.slow
def test_edited_callee_in_another_module_is_compiled(run, package):
    assert run()['scaled'] == 6.0
    callee = package / 'plant' / 'callee.py'
    times = callee.stat()
    callee.write_text(CALLEE.format(factor=5.0))
    # Size and time are the same; only the content differs.
    os.utime(callee, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert run()['scaled'] == 10.0


@pytest.mark.medium
def test_division_by_zero_is_inf_as_in_numpy(first):
    assert first['inverse'] == float('inf')


@pytest.mark.medium
def test_nothing_is_written_beside_the_sources(common, first):
    assert not list(common.root.rglob('*.nbi'))


@pytest.mark.medium
def test_cache_is_in_the_users_cache_folder(common, first):
    home = Path(first['directory'])
    assert home.parent == common.folder / 'home' / '.cache' / 'fourbar_ros'
    xdg = Path(common.run(XDG_CACHE_HOME=str(common.folder / 'xdg'))['directory'])
    assert xdg == common.folder / 'xdg' / 'fourbar_ros' / home.name
    assert list(xdg.rglob('*.nbi'))


@pytest.mark.medium
def test_numba_cache_dir_of_the_user_has_priority(common, chosen):
    assert chosen['directory'] == str(common.folder / 'chosen')
    assert list((common.folder / 'chosen').rglob('*.nbi'))


@pytest.mark.medium
def test_other_code_keeps_its_own_cache_folder(common, first, chosen):
    assert first['numba'] == ''
    assert chosen['numba'] == str(common.folder / 'chosen')


@pytest.mark.slow
@pytest.mark.parametrize('variables', [
    {'HOME': NOWHERE, 'XDG_CACHE_HOME': NOWHERE}, {'NUMBA_CACHE_DIR': NOWHERE}])
def test_temporary_folder_replaces_a_cache_that_is_not_writable(run, tmp_path, variables):
    first, second = run(**variables), run(**variables)
    assert Path(first['directory']).is_relative_to(tmp_path / f'fourbar_ros-{os.getuid()}')
    assert len(first['notes']) == 1 and first['directory'] in first['notes'][0]
    assert second['loaded'] == 1


@pytest.mark.medium
def test_temporary_folder_that_others_can_write_to_is_not_used(run, tmp_path):
    trap = tmp_path / f'fourbar_ros-{os.getuid()}'
    trap.mkdir()
    trap.chmod(0o777)
    directory = Path(run(HOME=NOWHERE)['directory'])
    assert not directory.is_relative_to(trap)
    assert not list(trap.iterdir())


@pytest.mark.medium
def test_kernels_run_without_a_writable_folder(run):
    result = run(temporary=NOWHERE, HOME=NOWHERE, XDG_CACHE_HOME=NOWHERE)
    assert result['scaled'] == 6.0
    assert result['directory'] == 'None'
    assert len(result['notes']) == 1 and 'every start compiles' in result['notes'][0]


@pytest.mark.slow
def test_old_folders_are_removed_and_others_kept(run, tmp_path):
    cache = tmp_path / 'home' / '.cache' / 'fourbar_ros'
    long_ago = 1.6e9
    for name in ('0123456789abcdef', 'fedcba9876543210', 'not ours'):
        (cache / name).mkdir(parents=True)
    for name in ('0123456789abcdef', 'not ours'):
        os.utime(cache / name, (long_ago, long_ago))
    in_use = Path(run()['directory'])
    os.utime(in_use, (long_ago, long_ago))
    assert run()['loaded'] == 1
    assert {path.name for path in cache.iterdir()} == {
        'fedcba9876543210', 'not ours', in_use.name}


def test_compilation_is_announced_once() -> None:
    """One line announces any number of kernels; cached code has no announcement."""
    @compiler.kernel(cache=False)
    def halve(number: float) -> float:
        return 0.5 * number

    @compiler.kernel(cache=False)
    def quarter(number: float) -> float:
        return float(halve(halve(number)))

    first, second = io.StringIO(), io.StringIO()
    with compiler.announced(first):
        assert quarter(8.0) == 2.0
    with compiler.announced(second):
        assert quarter(4.0) == 1.0
    assert first.getvalue().count('\n') == 1
    assert first.getvalue().startswith('Compiling the kernels')
    assert second.getvalue() == ''
