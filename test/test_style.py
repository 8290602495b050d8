# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Rules of the source tree: headers, one-way imports, imports of ROS, one version."""

import ast
import functools
from graphlib import CycleError, TopologicalSorter
from importlib.util import resolve_name
import os
from pathlib import Path
import re
import sys
from xml.etree import ElementTree

import fourbar_ros
from fourbar_ros.cli.main import COMMANDS
from fourbar_ros.kernels import compiler
import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'fourbar_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))
SCRIPTS = sorted((ROOT / 'scripts').iterdir())
FOLDERS = ('fourbar_ros', 'launch', 'test')
SOURCES = [ROOT / 'setup.py', ROOT / 'scripts' / '_run', *(
    path for folder in FOLDERS for path in sorted((ROOT / folder).rglob('*.py')))]
HEADER = ['# Copyright 2026 The fourbar_ros authors', '# SPDX-License-Identifier: Apache-2.0']

# Rooms that each room may import besides itself, from the bottom up.
_MECHANICS = ('common', 'kernels', 'mechanism')
_CORE = (*_MECHANICS, 'plant', 'estimation', 'control', 'device')
_OFFLINE = (*_CORE, 'hardware', 'loop', 'plotting')
MAY_IMPORT = {
    'common': (),
    'kernels': (),
    'mechanism': ('common', 'kernels'),
    'plant': _MECHANICS,
    'estimation': _MECHANICS,
    'control': _MECHANICS,
    'device': (*_MECHANICS, 'plant'),
    'hardware': (*_MECHANICS, 'plant', 'device'),
    'loop': _CORE,
    'plotting': ('common',),
    'analysis': (*_CORE, 'loop', 'plotting'),
    'studies': _OFFLINE,
    'benchmarks': (*_OFFLINE, 'studies'),
    'ros': (*_CORE, 'hardware', 'loop'),
    'operator': (*_MECHANICS, 'ros'),
    'cli': (*_OFFLINE, 'analysis', 'studies', 'benchmarks', 'ros', 'operator'),
    '__main__': ('cli',),
    '__init__': (),
}
ROS = re.compile(r'rclpy|rcl_\w+|rmw\w*|rosidl\w*|ament\w*|launch\w*|tf2\w*|'
                 r'\w+_(msgs|srvs|interfaces)')


def room_of(path):
    """Return the room that a module is in."""
    return path.relative_to(PACKAGE).with_suffix('').parts[0]


@functools.cache
def tree_of(path):
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text())


@functools.cache
def imports(path):
    """Return the full names of all imports of a file, inside functions too."""
    package = '.'.join(path.relative_to(ROOT).parent.parts)
    found = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = resolve_name('.' * node.level + (node.module or ''), package)
            found |= {f'{module}.{alias.name}' for alias in node.names}
    return found


def ros_packages(path):
    """Return the ROS packages that a file imports."""
    return {name.split('.')[0] for name in imports(path) if ROS.fullmatch(name.split('.')[0])}


def dependencies():
    """Return the run-time dependencies of package.xml."""
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    return {element.text for element in manifest.findall('exec_depend')}


def test_every_file_has_copyright_header_and_docstring():
    heads = {path: path.read_text().splitlines()[:3] for path in SOURCES}
    assert [path for path, lines in heads.items()
            if lines[int(lines[0].startswith('#!')):][:2] != HEADER] == []
    assert [path for path in SOURCES if not ast.get_docstring(tree_of(path))] == []


def test_rooms_import_one_way():
    forbidden = {}
    for path in MODULES:
        room = room_of(path)
        rooms = {name.split('.')[1] for name in imports(path) if name.startswith('fourbar_ros.')}
        if wrong := (rooms & set(MAY_IMPORT)) - {room} - set(MAY_IMPORT[room]):
            forbidden[path] = wrong
    assert forbidden == {}


def test_imports_have_no_cycles():
    """The graph of files includes imports inside functions and for type checking."""
    names = {path: '.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__')
             for path in MODULES}
    modules = set(names.values())
    graph = {name: {target if target in modules else target.rpartition('.')[0]
                    for target in imports(path)} & modules - {name}
             for path, name in names.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(' -> '.join(error.args[1]))


def test_every_folder_is_a_known_room():
    assert {room_of(path) for path in MODULES} <= set(MAY_IMPORT)


def test_only_ros_rooms_import_ros():
    assert {path: ros_packages(path) for path in MODULES
            if room_of(path) not in ('ros', 'operator') and ros_packages(path)} == {}


def test_ros_packages_are_declared():
    declared = dependencies()
    assert {path: ros_packages(path) - declared for path in MODULES
            if ros_packages(path) - declared} == {}


def test_kernels_are_compiled_in_one_place_and_from_hashed_sources():
    """The cache of the kernels is valid only if its fingerprint covers all sources."""
    assert [path for path in MODULES if path != PACKAGE / 'kernels' / 'compiler.py'
            and 'numba' in {name.split('.')[0] for name in imports(path)}] == []
    assert [path for path in MODULES if 'fourbar_ros.kernels.compiler.kernel' in imports(path)
            and room_of(path) not in compiler.ROOMS] == []


def test_every_command_has_its_executable():
    assert {path.name for path in SCRIPTS} - {'_run'} == set(COMMANDS)
    for path in SCRIPTS:
        assert os.access(path, os.X_OK)
        assert path.name == '_run' or os.readlink(path) == '_run'


def test_versions_agree():
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert manifest.findtext('version') == fourbar_ros.__version__


@pytest.mark.skipif(Path(sys.prefix) != ROOT / '.venv', reason='not run from .venv')
def test_the_code_under_test_is_the_installed_one():
    installed = Path(fourbar_ros.__file__).parent
    assert installed.is_relative_to(sys.prefix)
    names = [path.relative_to(PACKAGE) for path in MODULES]
    assert [name for name in names if not (installed / name).is_file()] == []
    assert [name for name in names
            if (installed / name).read_bytes() != (PACKAGE / name).read_bytes()] == []
