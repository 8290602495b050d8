# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What the tree promises about itself: headers, one-way imports, thin nodes, one version."""

import ast
from importlib.util import resolve_name
import os
from pathlib import Path
import re
import sys
from xml.etree import ElementTree

import fourbar_ros
from fourbar_ros.commands.main import COMMANDS
from fourbar_ros.mechanism import compiled
import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'fourbar_ros'
MODULES = sorted(PACKAGE.rglob('*.py'))
SCRIPTS = sorted((ROOT / 'scripts').iterdir())
FOLDERS = ('fourbar_ros', 'launch', 'test')
SOURCES = [ROOT / 'setup.py', ROOT / 'scripts' / '_run', *(
    path for folder in FOLDERS for path in sorted((ROOT / folder).rglob('*.py')))]
HEADER = (ROOT / 'setup.py').read_text().splitlines()[:13]

NODE_LINES = 180
# What each room may import besides itself and the modules that belong to no room.
_CORE = ('mechanism', 'plant', 'estimation', 'control', 'device')
MAY_IMPORT = {
    '': (),
    'mechanism': (),
    'plant': ('mechanism',),
    'estimation': ('mechanism',),
    'control': ('mechanism',),
    'device': ('mechanism', 'plant'),
    'loop': _CORE,
    'nodes': (*_CORE, 'loop'),
    'analysis': (*_CORE, 'loop'),
    'commands': (*_CORE, 'loop', 'nodes', 'analysis'),
    '__main__': ('commands',),
}
ROS = re.compile(r'rclpy|rcl_\w+|rmw\w*|rosidl\w*|ament\w*|launch\w*|tf2\w*|'
                 r'\w+_(msgs|srvs|interfaces)')

each_module = pytest.mark.parametrize(
    'path', MODULES, ids=[str(path.relative_to(PACKAGE)) for path in MODULES])


def room_of(path):
    """Return the room that a module is in: '' for errors.py and its like."""
    first, *rest = path.relative_to(PACKAGE).with_suffix('').parts
    return first if rest or first in MAY_IMPORT else ''


def imports(path):
    """Return the full names of all that a file imports, inside functions too."""
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
    """Return the names that package.xml depends on for running."""
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    return {element.text for element in manifest.findall('exec_depend')}


@pytest.mark.parametrize('path', SOURCES, ids=[str(path.relative_to(ROOT)) for path in SOURCES])
def test_file_has_copyright_header_and_docstring(path):
    lines = path.read_text().splitlines()
    if lines[0].startswith('#!'):
        del lines[0]
    assert HEADER[0].startswith('# Copyright')
    assert lines[:13] == HEADER
    assert ast.get_docstring(ast.parse(path.read_text()))


@each_module
def test_rooms_import_one_way(path):
    room = room_of(path)
    rooms = {name.split('.')[1] for name in imports(path) if name.startswith('fourbar_ros.')}
    assert (rooms & set(MAY_IMPORT)) - {room} <= set(MAY_IMPORT[room])


def test_every_folder_is_a_known_room():
    assert {room_of(path) for path in MODULES} <= set(MAY_IMPORT)


@each_module
def test_only_nodes_know_ros(path):
    if room_of(path) != 'nodes':
        assert ros_packages(path) == set()


@pytest.mark.parametrize('path', sorted((PACKAGE / 'nodes').glob('*.py')),
                         ids=lambda path: path.name)
def test_nodes_are_thin_and_their_packages_declared(path):
    assert len(path.read_text().splitlines()) <= NODE_LINES
    assert ros_packages(path) <= dependencies()


@each_module
def test_machine_code_is_made_in_one_place_and_from_hashed_sources(path):
    """The cache of the kernels is right only while its fingerprint covers them all."""
    if path != PACKAGE / 'mechanism' / 'compiled.py':
        assert 'numba' not in {name.split('.')[0] for name in imports(path)}
    if 'fourbar_ros.mechanism.compiled.kernel' in imports(path):
        assert room_of(path) in compiled.ROOMS


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
