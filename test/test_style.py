# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Rules of the source tree: headers, one-way imports, imports of ROS, one version."""

import ast
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

each_module = pytest.mark.parametrize(
    'path', MODULES, ids=[str(path.relative_to(PACKAGE)) for path in MODULES])


def room_of(path):
    """Return the room that a module is in."""
    return path.relative_to(PACKAGE).with_suffix('').parts[0]


def imports(path):
    """Return the full names of all imports of a file, inside functions too."""
    package = '.'.join(path.relative_to(ROOT).parent.parts)
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
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


@pytest.mark.medium
@pytest.mark.parametrize('path', SOURCES, ids=[str(path.relative_to(ROOT)) for path in SOURCES])
def test_file_has_copyright_header_and_docstring(path):
    lines = path.read_text().splitlines()
    if lines[0].startswith('#!'):
        del lines[0]
    assert lines[:2] == HEADER
    assert ast.get_docstring(ast.parse(path.read_text()))


@pytest.mark.medium
@each_module
def test_rooms_import_one_way(path):
    room = room_of(path)
    rooms = {name.split('.')[1] for name in imports(path) if name.startswith('fourbar_ros.')}
    assert (rooms & set(MAY_IMPORT)) - {room} <= set(MAY_IMPORT[room])


@pytest.mark.medium
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


@each_module
def test_only_ros_rooms_import_ros(path):
    if room_of(path) not in ('ros', 'operator'):
        assert ros_packages(path) == set()


@each_module
def test_ros_packages_are_declared(path):
    assert ros_packages(path) <= dependencies()


@pytest.mark.medium
@each_module
def test_kernels_are_compiled_in_one_place_and_from_hashed_sources(path):
    """The cache of the kernels is valid only if its fingerprint covers all sources."""
    if path != PACKAGE / 'kernels' / 'compiler.py':
        assert 'numba' not in {name.split('.')[0] for name in imports(path)}
    if 'fourbar_ros.kernels.compiler.kernel' in imports(path):
        assert room_of(path) in compiler.ROOMS


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
