# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Find and read the configuration files: presets in config/, or files of the user's own.

The one finder of the package. It works in a pip install, in a colcon install with and without
--symlink-install, and in a bare checkout.
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
# From site-packages up to its prefix: lib/python3.x/site-packages, with one or two to spare for
# the local/ of Debian and the platform folders of others.
_LEVELS_TO_PREFIX = 5


class ConfigurationError(FourbarError):
    """A configuration file that is missing, unreadable, or not what it should be."""


def share_directory() -> Path:
    """
    Return the folder that holds config/ and launch/.

    The prefix that the running package is installed in comes first, AMENT_PREFIX_PATH second, so
    that an overlay or a second install never mixes its files with this code. Raises
    ConfigurationError when there is none.
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
    Return the file that a preset name or a path stands for.

    For the kind 'mechanism' the name 'paper' is config/mechanism_paper.yaml. A name with a slash,
    or one that ends in .yaml, is a path; so is the name of an existing file that is no preset.
    Raises ConfigurationError when there is no such preset or file.
    """
    path = Path(name).expanduser()
    if '/' in name or path.suffix in _SUFFIXES:
        if path.is_file():
            return path
        raise ConfigurationError(f'{kind} file {name}: no such file')
    known = presets(kind)
    if name in known:
        return share_directory() / 'config' / f'{kind}_{name}.yaml'
    if path.is_file():
        return path
    raise ConfigurationError(
        f'no {kind} {name!r}: available are {", ".join(known) or "none"}, or a path to a file')


def load_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """
    Return the mapping in a YAML (or JSON) file.

    Unlike plain PyYAML this refuses keys that occur twice, and reads 1e-4 as a number. Raises
    ConfigurationError, with the line where there is one.
    """
    try:
        with open(path, encoding='utf-8') as stream:
            content = yaml.load(stream, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f', line {mark.line + 1}, column {mark.column + 1}' if mark else ''
        raise ConfigurationError(f'{path}{place}: {_one_line(error.problem)}') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f'{path} is not YAML: {_one_line(error)}') from error
    except OSError as error:
        raise ConfigurationError(f'{path}: {error.strerror}') from error
    if not isinstance(content, dict):
        found = 'is empty' if content is None else f'holds a {type(content).__name__}'
        raise ConfigurationError(f'{path} {found}, but a mapping "key: value" is needed')
    for key in content:
        if not isinstance(key, str):
            raise ConfigurationError(f'{path}: the key {key!r} is not a name: quote it')
    return content


def _candidates() -> Iterator[Path]:
    module = Path(os.path.abspath(__file__))
    # A file reached through the links of --symlink-install belongs to the tree it links to.
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
    """The safe loader, without the two surprises that cost an afternoon in the lab."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.tag == 'tag:yaml.org,2002:merge':
                continue
            key = self.construct_object(key_node, deep=True)
            try:
                repeated = key in seen
            except TypeError:
                break  # not hashable: the safe loader says so, with the line
            if repeated:
                raise yaml.constructor.ConstructorError(
                    problem=f'the key {key!r} occurs twice', problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


# YAML 1.1 takes 1e-4 (no point) and 1.0e4 (no sign) for text; YAML 1.2, JSON and the parameter
# files of ROS take them for numbers.
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$'),
    list('-+.0123456789'))
