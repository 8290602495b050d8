# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Find and read configuration files: presets in config/, or files of the user.

The search works in a pip install, in a colcon install with and without --symlink-install, and in a
bare checkout.
"""

from collections.abc import Iterator
import os
from pathlib import Path
import re
from typing import Any

from fourbar_ros.common.errors import FourbarError
import yaml

PACKAGE = 'fourbar_ros'
_SUFFIXES = ('.yaml', '.yml')
# Levels between a package and its install prefix: lib/python3.x/site-packages are three; Debian's
# local/ and platform folders add up to two.
_LEVELS_TO_PREFIX = 5


class ConfigurationError(FourbarError):
    """
    A configuration file that is missing, unreadable, or not a mapping.

    Its `values` hold `name` (of a preset or path), or `file` with `line` and `key` where known.
    """


def share_directory() -> Path:
    """
    Return the folder that holds config/ and launch/.

    The install prefix of the running package comes first, AMENT_PREFIX_PATH second: files of an
    overlay or a second installation never mix with this code.

    :raises ConfigurationError: no such folder exists.
    """
    for directory in _candidates():
        if (directory / 'config').is_dir():
            return directory
    raise ConfigurationError(
        f'no config folder of {PACKAGE} beside {Path(__file__).parents[1]}, under its install '
        'prefix, or in AMENT_PREFIX_PATH: install the package again')


def presets(kind: str) -> list[str]:
    """Return the names of the presets of one kind: ['paper', ...] for 'mechanism'."""
    files = (share_directory() / 'config').glob(f'{kind}_*.yaml')
    return sorted(file.stem[len(kind) + 1:] for file in files)


def config_file(kind: str, name: str) -> Path:
    """
    Return the path of a preset or of a user's file.

    :param kind: 'mechanism', 'table', 'scenario', ...
    :param name: name of a preset ('paper' is config/mechanism_paper.yaml for the kind
        'mechanism') or a path. A name with a slash or the suffix .yaml is a path; so is the name
        of an existing file that is not a preset.
    :raises ConfigurationError: neither a preset nor a file has this name.
    """
    path = Path(name).expanduser()
    if '/' in name or path.suffix in _SUFFIXES:
        if path.is_file():
            return path
        raise ConfigurationError(f'{kind} file {name}: no such file', name=name)
    known = presets(kind)
    if name in known:
        return share_directory() / 'config' / f'{kind}_{name}.yaml'
    if path.is_file():
        return path
    raise ConfigurationError(
        f'no {kind} {name!r}: available are {", ".join(known) or "none"}, or a path to a file',
        name=name, known=known)


def load_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """
    Return the mapping of a YAML or JSON file.

    Unlike plain PyYAML it refuses repeated keys and reads 1e-4 as a number.

    :raises ConfigurationError: the file is missing, not YAML, or not a mapping of text keys.
    """
    try:
        with open(path, encoding='utf-8') as stream:
            content = yaml.load(stream, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f', line {mark.line + 1}, column {mark.column + 1}' if mark else ''
        raise ConfigurationError(
            f'{path}{place}: {_one_line(error.problem)}', file=path,
            line=mark.line + 1 if mark else None) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f'{path} is not YAML: {_one_line(error)}', file=path) from error
    except OSError as error:
        raise ConfigurationError(
            f'{path}: {error.strerror}', file=path, errno=error.errno) from error
    if not isinstance(content, dict):
        found = 'is empty' if content is None else f'holds a {type(content).__name__}'
        raise ConfigurationError(f'{path} {found}, but a mapping "key: value" is needed',
                                 file=path)
    for key in content:
        if not isinstance(key, str):
            raise ConfigurationError(
                f'{path}: the key {key!r} is not text: quote it', file=path, key=key)
    return content


def _candidates() -> Iterator[Path]:
    module = Path(os.path.abspath(__file__))
    # With --symlink-install the package is a link into the source tree.
    for package in dict.fromkeys((module.parents[1], module.resolve().parents[1])):
        checkout = package.parent
        if (checkout / 'package.xml').is_file():
            yield checkout
        for prefix in package.parents[:_LEVELS_TO_PREFIX]:
            yield prefix / 'share' / PACKAGE
    for entry in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if entry:
            yield Path(entry) / 'share' / PACKAGE


def _one_line(message: object) -> str:
    return ' '.join(str(message or 'not YAML').split())


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader that refuses repeated keys and reads 1e-4 as a number."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == 'tag:yaml.org,2002:merge':
                continue
            key = self.construct_object(key_node, deep=True)
            try:
                repeated = key in seen
            except TypeError:
                break  # the safe loader reports a key that is not hashable, with its line
            if repeated:
                raise yaml.constructor.ConstructorError(
                    problem=f'the key {key!r} occurs twice', problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


# YAML 1.1 reads 1e-4 (no point) and 1.0e4 (no sign) as text; YAML 1.2, JSON and ROS parameter
# files read them as numbers.
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$'),
    list('-+.0123456789'))
