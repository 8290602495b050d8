# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters: declared as in the tables, checked at start and at run time."""

import os

from fourbar_ros.common.config_files import share_directory
from fourbar_ros.ros.parameters import TABLES, yaml_text
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)

pytestmark = pytest.mark.node

FIELDS = {float: 'double_value', int: 'integer_value', str: 'string_value', bool: 'bool_value'}
TYPES = {float: ParameterType.PARAMETER_DOUBLE, int: ParameterType.PARAMETER_INTEGER,
         str: ParameterType.PARAMETER_STRING, bool: ParameterType.PARAMETER_BOOL}
# Parameters of every node of rclpy.
OF_ROS = ('use_sim_time', 'start_type_description_service', 'qos_overrides')

# Nodes that need a bus; they share topics with other nodes, so they have their own namespace.
BUS_NODES, BENCH = ('hardware', 'prototype_emulator'), '/bench'
BUS = ('bus.interface', 'bus.channel', 'bus.options')

ROWS = [(node, row) for node, table in TABLES.items() for row in table]
each_node = pytest.mark.parametrize('node', list(TABLES))

# Node, refused argument, and a name or value in the error message.
BAD_AT_START = [
    ('plant', ['-p', 'rate:=nan'], 'rate'),
    ('plant', ['-p', 'rate:=0.0'], '2000'),
    ('plant', ['-p', 'rate:=fast'], 'rate'),
    ('plant', ['-p', 'seed:=1.5'], 'seed'),
    ('plant', ['-p', 'seed:=-1'], 'seed'),
    ('plant', ['-p', 'clock:=sundial'], 'realtime'),
    ('plant', ['-p', 'timeout_action:=explode'], 'coast'),
    ('plant', ['-p', 'initial.branch:=third'], 'crossed'),
    ('plant', ['-p', 'mechanism:=nonsense'], 'paper'),
    ('plant', ['-p', 'table:=/nowhere/table.yaml'], '/nowhere/table.yaml'),
    ('plant', ['-p', 'step:=0.003'], 'whole multiple'),
    ('estimator', ['-p', 'angle_noise:=-1.0'], 'angle_noise'),
    ('estimator', ['-p', 'counts_per_turn:=true'], 'counts_per_turn'),
    ('controller', ['-p', 'bandwidth:=.inf'], 'bandwidth'),
    ('controller', ['-p', 'bandwidth:=[1.0, 2.0]'], 'bandwidth'),
    ('controller', ['-p', 'bandwidth'], 'bandwidth'),
    ('controller', ['-r', '__ns:=no name'], 'no name'),
    ('controller', ['--params-file', '/nowhere/nodes.yaml'], '/nowhere/nodes.yaml'),
]


def value_in(value):
    """Return the value of a ParameterValue."""
    return next(getattr(value, field) for kind, field in FIELDS.items()
                if TYPES[kind] == value.type)


def given(value):
    """Return the ParameterValue of a value."""
    message = ParameterValue(type=TYPES[type(value)])
    setattr(message, FIELDS[type(value)], value)
    return message


def values_in(probe, node, names):
    """Return the values of parameters of a node."""
    values = probe.call(
        GetParameters, f'{node}/get_parameters', GetParameters.Request(names=names)).values
    return {name: value_in(value) for name, value in zip(names, values)}


def set_value(probe, node, name, value):
    """Set a parameter; return whether it was accepted, and the reason."""
    result, = probe.call(SetParameters, f'{node}/set_parameters', SetParameters.Request(
        parameters=[Parameter(name=name, value=given(value))])).results
    return result.successful, result.reason


def full_name(node):
    """Return the full name of a node of the testbed."""
    return f'{BENCH}/{node}' if node in BUS_NODES else node


@pytest.fixture(scope='module')
def testbed(module_suite, probe):
    """Start the nodes with their defaults, and with a bus where they need one."""
    for node in TABLES:
        if node not in BUS_NODES:
            module_suite.start(node)
    for node, values in module_suite.bus().items():
        bus = [argument for name, value in values.items() for argument in (
            '-p', f'{name}:={value}')]
        module_suite.start(node, '--ros-args', '-r', f'__ns:={BENCH}', *bus)
    probe.follow('tracking_error', 'flywheel_command', 'reference')
    probe.newest('flywheel_command')
    return probe


@each_node
def test_node_declares_exactly_its_table(testbed, node):
    service = f'{full_name(node)}/list_parameters'
    names = testbed.call(ListParameters, service, ListParameters.Request()).result.names
    assert sorted(name for name in names if not name.startswith(OF_ROS)) == sorted(
        row.name for row in TABLES[node])


@each_node
def test_parameters_have_their_defaults_and_types(testbed, node):
    wanted = {row.name: row.default for row in TABLES[node] if row.name not in BUS}
    found = values_in(testbed, full_name(node), list(wanted))
    assert found == wanted
    assert {name: type(value) for name, value in found.items()} == {
        name: type(value) for name, value in wanted.items()}


@each_node
def test_parameters_are_described_with_their_units(testbed, node):
    rows = {row.name: row for row in TABLES[node]}
    descriptors = testbed.call(
        DescribeParameters, f'{full_name(node)}/describe_parameters',
        DescribeParameters.Request(names=list(rows))).descriptors
    assert [descriptor.name for descriptor in descriptors] == list(rows)
    for descriptor in descriptors:
        row = rows[descriptor.name]
        assert row.meaning in descriptor.description
        assert row.unit in descriptor.description
        assert (row.name, descriptor.read_only) == (row.name, not row.live)


@each_node
def test_parameters_are_described_with_their_ranges(testbed, node):
    rows = {row.name: row for row in TABLES[node]}
    descriptors = testbed.call(
        DescribeParameters, f'{full_name(node)}/describe_parameters',
        DescribeParameters.Request(names=list(rows))).descriptors
    found = {descriptor.name: (
        [(limits.from_value, limits.to_value) for limits in descriptor.floating_point_range],
        [(limits.from_value, limits.to_value) for limits in descriptor.integer_range])
        for descriptor in descriptors}
    assert found == {
        row.name: ([row.limits] if row.limits and row.kind is float else [],
                   [row.limits] if row.limits and row.kind is int else [])
        for row in rows.values()}


def test_choices_are_described(testbed):
    descriptor, = testbed.call(
        DescribeParameters, 'plant/describe_parameters',
        DescribeParameters.Request(names=['timeout_action'])).descriptors
    for choice in ('coast', 'hold_speed', 'brake'):
        assert choice in descriptor.additional_constraints


@pytest.mark.parametrize(
    ('node', 'row'), [(node, row) for node, row in ROWS if not row.live],
    ids=[f'{node}-{row.name}' for node, row in ROWS if not row.live])
def test_read_only_parameter_cannot_be_set_at_run_time(testbed, node, row):
    other = row.default + '2' if isinstance(row.default, str) else row.default + type(
        row.default)(1)
    before = values_in(testbed, full_name(node), [row.name])
    accepted, reason = set_value(testbed, full_name(node), row.name, other)
    assert not accepted
    assert reason
    assert values_in(testbed, full_name(node), [row.name]) == before


@pytest.mark.parametrize('value', [0.0, 20.1, -1.0, float('nan'), float('inf'), '5.0', True])
def test_bad_value_is_refused_at_run_time(testbed, value):
    before = values_in(testbed, 'controller', ['bandwidth'])
    accepted, reason = set_value(testbed, 'controller', 'bandwidth', value)
    assert not accepted
    # The message is that of the package; the message of rclpy names no unit.
    assert 'bandwidth' in reason
    assert type(value) is not float or 'rad/s' in reason
    assert values_in(testbed, 'controller', ['bandwidth']) == before


def test_parameters_set_together_change_all_or_none(testbed):
    before = values_in(testbed, 'controller', ['bandwidth', 'damping'])
    result = testbed.call(
        SetParametersAtomically, 'controller/set_parameters_atomically',
        SetParametersAtomically.Request(parameters=[
            Parameter(name='bandwidth', value=given(3.0)),
            Parameter(name='damping', value=given(-1.0))])).result
    assert not result.successful
    assert values_in(testbed, 'controller', ['bandwidth', 'damping']) == before


def test_integer_is_accepted_for_a_float(testbed):
    assert set_value(testbed, 'controller', 'damping', 1) == (True, '')
    assert set_value(testbed, 'controller', 'damping', 0.9) == (True, '')


def test_setpoint_duration_acts_at_once(testbed):
    assert set_value(testbed, 'controller', 'setpoint_duration', 1.5) == (True, '')
    status = testbed.status('controller_status', setpoint_duration_s='1.5')
    assert status['mode'] == 'disarmed'


def test_bandwidth_acts_at_once(testbed):
    """
    The wheel torque per tracking error changes with the gains of the law.

    At rest the law is `torque ~ w^2 angle_error + 2 d w rate_error`: a regression of the torque
    on the errors gives w. The compensation of disturbances is off, because it adds to the torque.
    """
    assert set_value(testbed, 'controller', 'disturbance_compensation', 0.0) == (True, '')
    testbed.wait(lambda: testbed.arm().success)
    testbed.status('controller_status', mode='hold')

    def found():
        errors = {(message.header.stamp.sec, message.header.stamp.nanosec): message
                  for message in testbed.more('tracking_error', 250)}
        testbed.catch_up()
        pairs = [(errors[stamp], message) for message in testbed.received['flywheel_command']
                 if (stamp := (message.header.stamp.sec, message.header.stamp.nanosec)) in errors]
        terms = np.array([[error.position[0], error.velocity[0]] for error, _ in pairs])
        torques = np.array([command.effort[0] for _, command in pairs])
        return np.linalg.lstsq(terms, torques, rcond=None)[0]
    for bandwidth in (4.0, 8.0):
        assert set_value(testbed, 'controller', 'bandwidth', bandwidth) == (True, '')
        testbed.more('tracking_error', 20)
        stiffness, damping = found()
        # Each wheel of a pair takes half of the inertia; its torque opposes that on the link.
        assert stiffness == pytest.approx(-1.44e-4 / 2 * bandwidth ** 2, rel=0.02)
        assert damping == pytest.approx(-1.44e-4 / 2 * 2 * 0.9 * bandwidth, rel=0.02)
    testbed.arm(False)


def test_shipped_file_holds_the_tables():
    path = share_directory() / 'config' / 'nodes.yaml'
    assert path.read_text() == yaml_text()


@pytest.mark.slow
def test_shipped_file_works_in_a_namespace(suite, make_probe):
    """All nodes without a bus start with the file, and take other values from a changed copy."""
    path = share_directory() / 'config' / 'nodes.yaml'
    text = path.read_text()
    changed = {'rate: 250.0': 'rate: 125', 'angle_noise: 0.0017453': 'angle_noise: 0.002',
               'bandwidth: 4.0': 'bandwidth: 5.0'}
    copy = suite.folder / 'copy.yaml'
    for old, new in changed.items():
        assert old in text
        text = text.replace(old, new)
    copy.write_text(text)
    for namespace, file in (('/shipped', path), ('/lab', copy)):
        for node in TABLES:
            if node not in BUS_NODES:
                suite.node(node, namespace=namespace, arguments=('--params-file', str(file)))
    defaults = {(node, row.name): row.default for node, row in ROWS}
    other = {('plant', 'rate'): 125.0, ('estimator', 'angle_noise'): 0.002,
             ('controller', 'bandwidth'): 5.0}
    for namespace, values in (('/shipped', {}), ('/lab', other)):
        watcher = make_probe(namespace)
        for node, table in TABLES.items():
            if node in BUS_NODES:
                continue
            found = values_in(watcher, node, [row.name for row in table])
            assert found == {row.name: {**defaults, **values}[node, row.name] for row in table}
    watcher.follow('flywheel_command', 'flywheel_states')
    first, second = watcher.more('flywheel_states', 2)
    assert (second.header.stamp.nanosec - first.header.stamp.nanosec) % 8_000_000 == 0


@pytest.mark.parametrize('priority', [0, 1])
def test_realtime_priority_is_that_of_the_parameter(suite, make_probe, priority):
    """A node without the permission for the priority reports this and runs."""
    namespace = f'/priority_{priority}'
    process = suite.node('estimator', {'realtime_priority': priority}, namespace)
    make_probe(namespace).diagnostics(f'{namespace[1:]}/estimator')
    pid = process.popen.pid
    policy = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK
    if priority and policy != os.SCHED_FIFO:
        assert 'realtime_priority' in process.stderr
    else:
        assert policy == (os.SCHED_FIFO if priority else os.SCHED_OTHER)
        assert os.sched_getparam(pid).sched_priority == priority


@pytest.fixture(scope='module')
def refused(module_suite):
    """Start nodes with bad values in parallel, and wait until they end."""
    processes = [module_suite.start(node, '--ros-args', *arguments)
                 for node, arguments, _ in BAD_AT_START]
    for process in processes:
        process.end(seconds=60.0)
    return processes


@pytest.mark.parametrize(
    'index', range(len(BAD_AT_START)), ids=[' '.join(case[1]) for case in BAD_AT_START])
def test_bad_value_at_start_ends_the_node_with_one_line(refused, index):
    process, (node, _, word) = refused[index], BAD_AT_START[index]
    assert process.popen.returncode == 2, process.stderr
    # rcl prints further lines when it cannot parse its arguments.
    line, = [line for line in process.stderr.splitlines() if '[rcl]' not in line]
    assert line.startswith(f'fourbar {node}: ')
    assert word in line
