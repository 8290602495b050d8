# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Presets are found in every kind of installation; invalid files are refused in one line."""

import errno
import os
from pathlib import Path
import subprocess
import sys

from fourbar_ros.common import config_files
from fourbar_ros.common.config_files import (
    config_file,
    ConfigurationError,
    load_yaml,
    share_directory,
)
import pytest

COMMON = Path(config_files.__file__).parent


@pytest.fixture
def presets(tmp_path, monkeypatch):
    """Replace the installed presets."""
    config = tmp_path / 'share' / 'config'
    config.mkdir(parents=True)
    for name in ('mechanism_paper', 'mechanism_prototype', 'table_ideal'):
        (config / f'{name}.yaml').write_text('key: 1\n')
    monkeypatch.setattr(config_files, 'share_directory', lambda: config.parent)
    return config


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a file and returns its path."""
    def write(content):
        path = tmp_path / 'file.yaml'
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path
    return write


def place(prefix, package, data):
    """Make an installation: the package with room common, and a config folder."""
    package, data = prefix / package, prefix / data
    (data / 'config').mkdir(parents=True)
    (package / 'common').mkdir(parents=True)
    (package / '__init__.py').touch()
    for name in ('__init__.py', 'config_files.py', 'errors.py'):
        (package / 'common' / name).write_bytes((COMMON / name).read_bytes())
    return package, data


def found_from(package, **environment):
    """Return the share directory that a fresh process finds for a package."""
    code = 'from fourbar_ros.common.config_files import share_directory; print(share_directory())'
    inherited = {key: value for key, value in os.environ.items() if key != 'AMENT_PREFIX_PATH'}
    result = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, cwd='/',
        env={**inherited, 'PYTHONPATH': str(package.parent), **environment})
    return Path(result.stdout.strip()) if result.returncode == 0 else result.stderr


@pytest.mark.parametrize(('package', 'data'), [
    ('lib/python3.12/site-packages/fourbar_ros', 'share/fourbar_ros'),
    ('local/lib/python3.12/dist-packages/fourbar_ros', 'share/fourbar_ros'),
    ('fourbar_ros', 'share/fourbar_ros'),  # pip install --target
])
def test_share_is_found_under_the_prefix_of_the_package(tmp_path, package, data):
    package, data = place(tmp_path, package, data)
    assert found_from(package) == data


def test_share_of_a_bare_checkout_is_the_checkout(tmp_path):
    package, data = place(tmp_path, 'fourbar_ros', '.')
    (tmp_path / 'package.xml').touch()
    assert found_from(package) == data


def test_share_of_a_linked_package_is_the_linked_tree(tmp_path):
    source, data = place(tmp_path / 'src', 'fourbar_ros', '.')
    (data / 'package.xml').touch()
    (tmp_path / 'build').mkdir()
    link = tmp_path / 'build' / 'fourbar_ros'
    link.symlink_to(source)
    assert found_from(link) == data


def test_own_prefix_comes_before_the_ament_path(tmp_path):
    package, data = place(
        tmp_path / 'own', 'lib/python3.12/site-packages/fourbar_ros', 'share/fourbar_ros')
    place(tmp_path / 'other', 'lib/fourbar_ros', 'share/fourbar_ros')
    assert found_from(package, AMENT_PREFIX_PATH=str(tmp_path / 'other')) == data


def test_ament_path_is_used_for_a_package_without_share(tmp_path):
    package, data = place(tmp_path / 'own', 'lib/python3.12/site-packages/fourbar_ros', 'none')
    _, other = place(tmp_path / 'other', 'lib/fourbar_ros', 'share/fourbar_ros')
    path = os.pathsep.join(['', str(tmp_path / 'no such'), str(tmp_path / 'other')])
    assert found_from(package, AMENT_PREFIX_PATH=path) == other


def test_missing_config_folder_is_an_error(tmp_path):
    package, _ = place(tmp_path, 'a/b/c/d/e/f/fourbar_ros', 'none')
    assert 'no config folder of fourbar_ros' in found_from(package)


def test_every_preset_is_found_and_is_a_mapping():
    files = sorted((share_directory() / 'config').glob('mechanism_*.yaml'))
    assert files
    for file in files:
        path = config_file('mechanism', file.stem.removeprefix('mechanism_'))
        assert path == file
        assert load_yaml(path)


def test_unknown_preset_is_refused_with_the_known_ones(presets, refuses):
    with refuses(ConfigurationError, name='papre', known=['paper', 'prototype']):
        config_file('mechanism', 'papre')


@pytest.mark.parametrize('name', ['mine.yaml', './mine', 'folder/mine', 'plain'])
def test_path_is_not_changed(presets, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path('folder').mkdir()
    Path(name).touch()
    assert config_file('mechanism', name).samefile(name)


def test_home_is_expanded(presets, tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', str(tmp_path))
    (tmp_path / 'mine.yaml').touch()
    assert config_file('table', '~/mine.yaml') == tmp_path / 'mine.yaml'


@pytest.mark.parametrize('name', ['missing.yaml', 'folder/paper', './paper'])
def test_missing_path_is_refused(presets, tmp_path, monkeypatch, name, refuses):
    monkeypatch.chdir(tmp_path)
    with refuses(ConfigurationError, name=name):
        config_file('mechanism', name)


def test_file_in_the_working_folder_does_not_hide_a_preset(presets, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path('paper').touch()
    assert config_file('mechanism', 'paper') == presets / 'mechanism_paper.yaml'


def test_json_is_read_too(written):
    path = written('{"mass": 0.02, "inertia": 2.2e-05, "names": ["a", "b"]}')
    assert load_yaml(path) == {'mass': 0.02, 'inertia': 2.2e-5, 'names': ['a', 'b']}


@pytest.mark.parametrize(('text', 'value'), [
    ('1e-4', 1e-4), ('-2E3', -2000.0), ('1.0e4', 1e4), ('.5e-1', 0.05), ('+3.e+2', 300.0),
    ('1e', '1e'), ('e-4', 'e-4'), ('1e-4s', '1e-4s'), ('12', 12), ('v1e4', 'v1e4'),
])
def test_scientific_notation_is_a_number(written, text, value):
    loaded = load_yaml(written(f'key: {text}\n'))['key']
    assert loaded == value and type(loaded) is type(value)


def test_merge_keys_may_be_overridden(written):
    text = 'base: &base {a: 1, b: 2}\nderived: {<<: *base, b: 3}\n'
    assert load_yaml(written(text))['derived'] == {'a': 1, 'b': 3}


@pytest.mark.parametrize(('content', 'values'), [
    ('', {}),
    ('- 1\n- 2\n', {}),
    ('just words\n', {}),
    ('a: 1\nb: 2\na: 3\n', {'line': 3}),
    ('top:\n  x: 1\n  x: 2\n', {'line': 3}),
    ('a: [1, 2\nb: 3\n', {'line': 2}),
    ('a: \x01\n', {}),
    (b'a: \xff\xfe\n', {}),
    ('{[1, 2]: 3}: 4\n', {'line': 1}),
    ('!!python/object/apply:os.getcwd []\n', {'line': 1}),
    ('1: one\n', {'key': 1}),
])
def test_bad_content_is_refused_with_its_place(written, content, values, refuses):
    path = written(content)
    with refuses(ConfigurationError, file=path, **values):
        load_yaml(path)


def test_missing_file_and_folder_are_refused(tmp_path, refuses):
    with refuses(ConfigurationError, file=tmp_path / 'none.yaml', errno=errno.ENOENT):
        load_yaml(tmp_path / 'none.yaml')
    with refuses(ConfigurationError, file=tmp_path, errno=errno.EISDIR):
        load_yaml(tmp_path)
