# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Launch files: syntax, arguments and nodes, also without an installed launch package."""

import ast
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace

from fourbar_ros.ros.parameters import TABLES
import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / 'launch').glob('*.launch.py'))
PROTOTYPE, SIMULATION = (ROOT / 'launch' / f'{name}.launch.py' for name in ('prototype', 'sim'))

each_file = pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)


def tree_of(path):
    return ast.parse(path.read_text(), filename=str(path))


def calls(path, name):
    """Return first positional argument and keywords of the calls of a name."""
    found = []
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Call) and getattr(node.func, 'id', None) == name:
            found.append((node.args[0] if node.args else None,
                          {keyword.arg: keyword.value for keyword in node.keywords}))
    return found


def constants(path):
    """Return the constants of the module, which may depend on each other."""
    values = {'str': str, 'float': float, 'int': int, 'bool': bool}
    for node in tree_of(path).body:
        if isinstance(node, ast.Assign):
            code = compile(ast.Expression(node.value), str(path), 'eval')
            values[node.targets[0].id] = eval(code, {'__builtins__': {}}, values)
    return values


def arguments(path):
    """Return the declared launch arguments: name, default and description."""
    return {ast.literal_eval(name): {key: ast.literal_eval(value) for key, value in given.items()}
            for name, given in calls(path, 'DeclareLaunchArgument')}


def test_simulation_and_prototype_have_a_launch_file():
    assert FILES == [PROTOTYPE, SIMULATION]


@each_file
def test_launch_file_compiles_and_has_a_description(path):
    compile(path.read_text(), str(path), 'exec')
    names = [node.name for node in tree_of(path).body if isinstance(node, ast.FunctionDef)]
    assert 'generate_launch_description' in names


@each_file
def test_every_executable_exists(path):
    assert {ast.literal_eval(given['package']) for _, given in calls(path, 'Node')} == {
        'fourbar_ros'}
    executables = constants(path)['EXECUTABLES']
    assert executables
    for name in executables:
        assert (ROOT / 'scripts' / name).exists()
        assert name in TABLES


@each_file
def test_every_argument_is_described(path):
    found = arguments(path)
    assert found
    for name, given in found.items():
        assert (name, bool(given.get('description', '').strip())) == (name, True)
        assert 'default_value' in given


@each_file
def test_arguments_that_set_parameters_fit_the_tables(path):
    """Each named node has the parameter, of the type of the conversion."""
    for name, (nodes, kind) in constants(path)['PARAMETERS'].items():
        assert name in arguments(path)
        for node in nodes:
            row = next(row for row in TABLES[node] if row.name == name)
            assert (name, type(row.default)) == (name, kind)


@each_file
def test_launch_loads_the_file(path):
    pytest.importorskip('launch_ros')
    from launch.actions import DeclareLaunchArgument
    from launch.launch_description_sources import get_launch_description_from_python_launch_file
    description = get_launch_description_from_python_launch_file(str(path))
    declared = {entity.name for entity in description.entities
                if isinstance(entity, DeclareLaunchArgument)}
    assert declared == set(arguments(path))


class Stub(ModuleType):
    """A module in which every name is a function that records its calls."""

    def __getattr__(self, name):
        if name.startswith('__'):
            raise AttributeError(name)
        return lambda *args, **given: SimpleNamespace(args=args, **given)


def actions(monkeypatch, path, given):
    """Return the recorded calls of a launch file with some arguments."""
    for name in ('launch', 'launch.actions', 'launch.event_handlers', 'launch.substitutions',
                 'launch_ros', 'launch_ros.actions'):
        monkeypatch.setitem(sys.modules, name, Stub(name))
    monkeypatch.setattr(
        sys.modules['launch.substitutions'], 'LaunchConfiguration', lambda name: SimpleNamespace(
            perform=lambda context: given.get(name, context[name]['default_value'])),
        raising=False)
    spec = spec_from_file_location('launched', path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    _, handler = module.start_nodes(arguments(path))
    return handler.args[0].on_exit


def nodes_started(monkeypatch, path, given):
    """Return the parameters of each started node, without those in files."""
    return {node.executable: dict(pair for part in node.parameters if isinstance(part, dict)
                                  for pair in part.items())
            for node in actions(monkeypatch, path, given)}


@each_file
def test_namespace_is_that_of_all_nodes(monkeypatch, path):
    assert {node.namespace for node in actions(monkeypatch, path, {'namespace': 'lab'})} == {'lab'}


@pytest.mark.parametrize(('clock', 'simulated'), [
    ('realtime', False), ('fast', True), ('lockstep', True)])
def test_one_argument_sets_the_time_of_all_nodes(monkeypatch, clock, simulated):
    started = nodes_started(monkeypatch, SIMULATION, {'clock': clock})
    assert set(started) == {'plant', 'estimator', 'controller'}
    assert {name: given['use_sim_time'] for name, given in started.items()} == dict.fromkeys(
        started, simulated)
    assert started['plant']['clock'] == clock


@each_file
def test_missing_arguments_set_no_parameter(monkeypatch, path):
    started = nodes_started(monkeypatch, path, {})
    assert len(started) == 3
    assert all(given == {} for given in started.values())


def test_parameters_file_of_the_user_follows_that_of_the_prototype(monkeypatch):
    for node in actions(monkeypatch, PROTOTYPE, {'params_file': 'lab.yaml', 'rate': '200'}):
        own, users, *_ = node.parameters
        assert Path(own) == ROOT / 'config' / 'nodes_prototype.yaml'
        assert users == 'lab.yaml'


def test_arguments_of_the_bus_set_parameters_of_the_hardware_node_only(monkeypatch):
    bus = {'bus.interface': 'slcan', 'bus.channel': '/dev/ttyACM0', 'bus.options': 'a=1 b=2'}
    assert nodes_started(monkeypatch, PROTOTYPE, bus) == {
        'hardware': bus, 'estimator': {}, 'controller': {}}


@pytest.mark.parametrize(('given', 'host', 'links'), [
    ({}, ('fourbar_udp', '127.0.0.1:29536', 'peers=127.0.0.1:29537'),
     ('fourbar_udp', '127.0.0.1:29537', 'peers=127.0.0.1:29536')),
    ({'bus.channel': '127.0.0.1:1', 'emulator_channel': '127.0.0.1:2'},
     ('fourbar_udp', '127.0.0.1:1', 'peers=127.0.0.1:2'),
     ('fourbar_udp', '127.0.0.1:2', 'peers=127.0.0.1:1')),
    ({'bus.interface': 'socketcan', 'bus.channel': 'vcan0', 'bus.options': 'fd=false'},
     ('socketcan', 'vcan0', 'fd=false'), ('socketcan', 'vcan0', 'fd=false')),
    ({'bus.interface': 'socketcan'}, ('socketcan',), ('socketcan',)),
])
def test_emulated_links_are_on_the_bus_of_the_host(monkeypatch, given, host, links):
    started = nodes_started(
        monkeypatch, PROTOTYPE, {'emulate': 'true', 'codec': 'odrive', **given})
    assert list(started) == ['prototype_emulator', 'hardware', 'estimator', 'controller']
    for name, bus in (('hardware', host), ('prototype_emulator', links)):
        safety = {'safety': 'emulated'} if name == 'hardware' else {}
        assert started[name] == {
            'codec': 'odrive', **safety,
            **dict(zip(('bus.interface', 'bus.channel', 'bus.options'), bus))}


def test_channels_of_emulated_links_are_the_defaults_of_their_node(monkeypatch):
    defaults = {row.name: row.default for row in TABLES['prototype_emulator']}
    started = nodes_started(monkeypatch, PROTOTYPE, {'emulate': 'true'})['prototype_emulator']
    assert started == {name: defaults[name] for name in started}


def test_emulate_is_true_or_false(monkeypatch):
    with pytest.raises(RuntimeError) as caught:
        actions(monkeypatch, PROTOTYPE, {'emulate': 'maybe'})
    for part in ('emulate', 'true', 'false', 'maybe'):
        assert part in str(caught.value)
