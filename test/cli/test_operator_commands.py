# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Operator commands for device and controller, and `fourbar status`."""

from importlib.util import module_from_spec, spec_from_file_location
from math import radians
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
import pytest
from std_srvs.srv import SetBool, Trigger

pytestmark = pytest.mark.node

# Tests are no package: the harness of the node tests is loaded from its file.
_path = Path(__file__).parents[1] / 'ros' / 'conftest.py'
_spec = spec_from_file_location('node_harness', _path)
harness = module_from_spec(_spec)
_spec.loader.exec_module(harness)
compiled, domain, shared_memory = harness.compiled, harness.domain, harness.shared_memory
module_suite, make_probe, probe = harness.module_suite, harness.make_probe, harness.probe
suite, fork_server = harness.suite, harness.fork_server

COMMANDS = {'arm': [], 'disarm': [], 'stop': [], 'reset': [], 'status': [],
            'setpoint': ['link_a=0']}
OF_CONTROLLER = ('enable', 'disable', 'hold', 'damp')
# Status of a controller after wheel faults.
DEGRADED = {'mode': 'hold', 'problem': 'axis b is lost: flywheel_b, flywheel_d cannot be used',
            'wheel_faults': 'flywheel_b: dead, flywheel_d: dead'}


@pytest.fixture(scope='module')
def fourbar(module_suite):
    """Return a function that runs a command and returns exit code, stdout and stderr."""
    def run(name, *arguments, fresh=False):
        process = module_suite.start(name, *arguments, fresh=fresh)
        return process.end(), process.stdout, process.stderr
    return run


@pytest.fixture(scope='module')
def nodes(module_suite, probe):
    """Run a testbed without a namespace, watched by the probe."""
    module_suite.nodes(controller={'setpoint_duration': 1.0})
    probe.follow('flywheel_command')
    probe.newest('flywheel_command')
    return probe


@pytest.fixture
def testbed(nodes):
    yield nodes
    nodes.trigger('reset_emergency_stop')
    nodes.arm(False)
    nodes.status('controller_status', mode='disarmed')


@pytest.fixture
def armed(testbed):
    testbed.wait(lambda: testbed.arm().success)
    testbed.status('controller_status', mode='hold')
    return testbed


class Lossy:
    """
    A service that handles every request and loses its first answer.

    :ivar requests: number of requests.
    """

    def __init__(self, node, kind, name):
        self.requests = 0
        self._service = node.create_service(kind, name, self._obey)
        self._send, self._service.send_response = self._service.send_response, self._answer

    def _obey(self, _request, response):
        self.requests += 1
        response.success, response.message = True, f'obeyed {self.requests} times'
        return response

    def _answer(self, *answer):
        if self.requests > 1:
            self._send(*answer)


@pytest.fixture(scope='module')
def unanswered(module_suite, make_probe):
    """
    Run commands in parallel: without a server, or with a service that loses its first answer.

    :returns: exit code, stdout and stderr by namespace and name; and the number of requests
        of the services of /lossy, by their names.
    """
    there = make_probe('/lossy')
    services = {'arm': Lossy(there.node, SetBool, 'arm'),
                'enable': Lossy(there.node, SetBool, 'enable'),
                'damp': Lossy(there.node, Trigger, 'damp'),
                'reset_emergency_stop': Lossy(there.node, Trigger, 'reset_emergency_stop'),
                'sim/step': Lossy(there.node, Trigger, 'sim/step')}
    statuses = {name: there.node.create_publisher(
        DiagnosticStatus, f'/lossy/{name}_status', harness.LATCHED)
        for name in ('device', 'controller')}
    for name, values in (('device', {'state': 'armed'}), ('controller', DEGRADED)):
        statuses[name].publish(DiagnosticStatus(
            values=[KeyValue(key=key, value=value) for key, value in values.items()]))
    started = {(namespace, name): module_suite.start(
        name, *arguments, '--ros-args', '-r', f'__ns:={namespace}')
        for namespace, name, arguments in (
            ('/lossy', 'disarm', []), ('/lossy', 'disable', []), ('/lossy', 'damp', []),
            ('/lossy', 'reset', []), ('/lossy', 'sim', ['step']), ('/lossy', 'status', []),
            *(('/nobody', name, []) for name in OF_CONTROLLER),
            *(('/nobody', name, arguments) for name, arguments in COMMANDS.items()))}
    for process in started.values():
        there.wait(lambda popen=process.popen: popen.poll() is not None)
    return ({key: (process.end(), process.stdout, process.stderr)
             for key, process in started.items()},
            {name: service.requests for name, service in services.items()})


@pytest.mark.parametrize('name', list(COMMANDS))
def test_missing_device_is_reported_in_one_line(unanswered, name):
    code, out, err = unanswered[0]['/nobody', name]
    if name == 'status':
        assert (code, err) == (1, '')
        assert out.count('not found') == 2
        return
    assert (code, out) == (2, '')
    line, = err.splitlines()
    assert line.startswith(f'fourbar {name}: no device found')


@pytest.mark.parametrize('name', OF_CONTROLLER)
def test_missing_controller_is_reported_in_one_line(unanswered, name):
    assert unanswered[0]['/nobody', name] == (
        1, '', f'fourbar {name}: no controller found: service /nobody/'
        f'{"enable" if name == "disable" else name} did not appear within 5 s\n')


@pytest.mark.parametrize(('name', 'service'), [
    ('disarm', 'arm'), ('disable', 'enable'), ('damp', 'damp')])
def test_idempotent_request_is_repeated_after_a_lost_answer(unanswered, name, service):
    results, asked = unanswered
    code, out, err = results['/lossy', name]
    assert (code, out.split()[0], err) == (0, 'obeyed', '')
    # The command returns the answer to the second request, or to a later one on a busy machine.
    assert 2 <= int(out.split()[1]) <= asked[service]


@pytest.mark.parametrize(('name', 'service'), [
    ('sim', 'sim/step'), ('reset', 'reset_emergency_stop')])
def test_other_request_is_not_repeated_after_a_lost_answer(unanswered, name, service):
    results, asked = unanswered
    assert results['/lossy', name] == (
        2, '', f'fourbar {name}: no answer from service /lossy/{service} within 5 s\n')
    assert asked[service] == 1


def test_arm_and_disarm(testbed, fourbar):
    # Only this test starts the commands in a fresh interpreter.
    assert fourbar('arm', fresh=True) == (0, 'armed\n', '')
    assert testbed.status('device_status', state='armed')['reason'] == 'armed on request'
    assert fourbar('arm') == (0, 'already armed\n', '')
    assert fourbar('disarm', fresh=True) == (0, 'disarmed\n', '')
    testbed.status('device_status', state='disarmed')


def test_stop_refused_arming_and_reset(armed, fourbar):
    assert fourbar('stop') == (0, 'stopped, the wheels coast\n', '')
    assert armed.status('device_status', state='emergency_stop')
    code, out, err = fourbar('arm')
    assert (code, out) == (1, '')
    line, = err.splitlines()
    assert 'emergency_stop' in line
    assert fourbar('reset') == (0, 'emergency_stop is reset, disarmed\n', '')
    assert fourbar('reset') == (0, 'nothing to reset: disarmed\n', '')
    armed.status('device_status', state='disarmed')


def test_status_shows_device_and_controller(armed, fourbar):
    code, out, err = fourbar('status')
    assert (code, err) == (0, '')
    values = dict(line.split(maxsplit=1) for line in out.splitlines() if len(line.split()) > 1)
    assert values['state'] == 'armed'
    assert values['reason'] == 'armed on request'
    assert values['mode'] == 'hold'
    lines = out.splitlines()
    assert lines.index('device') < lines.index('controller')


def test_status_shows_faults(unanswered):
    code, out, err = unanswered[0]['/lossy', 'status']
    assert (code, err) == (0, '')
    shown = [line.split(maxsplit=1) for line in out.splitlines()]
    for key, value in DEGRADED.items():
        assert [key, value] in shown


def test_status_has_empty_fault_lines_without_faults(armed, fourbar):
    shown = [line.split() for line in fourbar('status')[1].splitlines()]
    assert ['mode', 'hold'] in shown
    assert ['problem'] in shown
    assert ['wheel_faults'] in shown


@pytest.mark.slow
def test_hold_ends_a_move_and_damp_holds_no_position(armed, fourbar):
    assert fourbar('setpoint', 'link_b=70deg') == (0, 'accepted\n', '')
    assert fourbar('hold') == (0, 'holds\n', '')
    assert armed.status('controller_status', goal='')['mode'] == 'hold'
    assert fourbar('damp') == (0, 'stops all rates\n', '')
    armed.status('controller_status', mode='damp')
    assert fourbar('hold') == (0, 'holds\n', '')
    armed.status('controller_status', mode='hold')


@pytest.mark.slow
def test_hold_after_a_move_drops_its_goal(armed, fourbar):
    assert fourbar('setpoint', 'link_b=80deg') == (0, 'accepted\n', '')
    assert armed.status('controller_status', mode='hold')['goal'] != ''
    assert fourbar('hold') == (0, 'holds\n', '')
    armed.status('controller_status', mode='hold', goal='')


@pytest.mark.slow
def test_disabled_controller_drives_no_wheel_until_it_is_enabled(armed, fourbar):
    assert fourbar('disable') == (0, 'not enabled: the wheels get no torque\n', '')
    armed.status('controller_status', mode='idle')
    assert list(armed.more('flywheel_command')[0].effort) == [0.0] * 4
    assert fourbar('hold') == (1, '', 'the controller is not enabled: enable it first\n')
    assert fourbar('enable') == (0, 'enabled\n', '')
    armed.status('controller_status', mode='hold')
    armed.status('device_status', state='armed')


@pytest.mark.parametrize('name', ['hold', 'damp'])
def test_command_that_needs_an_armed_device_is_refused(testbed, fourbar, name):
    assert fourbar(name) == (1, '', 'the device is not armed: arm it first\n')


def test_setpoint_in_degrees_is_accepted(armed, fourbar):
    assert fourbar('setpoint', 'link_a=0', 'link_b=70deg') == (0, 'accepted\n', '')
    goal = armed.status('controller_status')['goal'].split()
    assert float(goal[0].split('=')[1]) == pytest.approx(0.0, abs=1e-6)
    assert float(goal[1].split('=')[1]) == pytest.approx(radians(70.0), abs=1e-6)


def test_setpoint_that_the_controller_refuses_exits_with_1(armed, fourbar):
    code, out, err = fourbar('setpoint', 'link_x=1')
    assert (code, out) == (1, '')
    line, = err.splitlines()
    assert line.startswith('refused: ')
    assert 'link_x' in line


def test_setpoint_while_disarmed_is_refused(testbed, fourbar):
    assert fourbar('setpoint', 'link_a=0.1') == (
        1, '', 'refused: the device is not armed: arm it first\n')


def test_setpoint_with_bad_syntax_is_refused_without_ros(fourbar):
    code, out, err = fourbar('setpoint', 'link_a=0', 'link_b=up')
    assert (code, out) == (2, '')
    line, = err.splitlines()
    assert "'link_b=up'" in line


@pytest.mark.slow
def test_commands_in_a_namespace(suite, make_probe, fourbar):
    # Two cores are too slow for two loops at full rate.
    suite.nodes('/lab', plant={'rate': 100.0}, controller={'setpoint_duration': 1.0})
    watcher = make_probe('/lab')
    watcher.follow('flywheel_command')
    watcher.newest('flywheel_command')
    there = ['--ros-args', '-r', '__ns:=/lab']
    assert fourbar('arm', *there) == (0, 'armed\n', '')
    watcher.status('device_status', state='armed')
    watcher.status('controller_status', mode='hold')
    assert fourbar('setpoint', 'link_a=10deg', *there) == (0, 'accepted\n', '')
    assert watcher.status('controller_status')['accepted'] == '1'
    code, out, err = fourbar('status', *there)
    assert (code, err) == (0, '')
    assert 'armed' in out
    assert fourbar('disarm', *there)[0] == 0
    watcher.status('device_status', state='disarmed')


@pytest.mark.parametrize('arguments', [
    ['--ros-args', '-r', 'nonsense'], ['--ros-args', '-r', '__ns:=no name'], ['extra']])
def test_bad_arguments_are_refused(fourbar, arguments):
    code, out, err = fourbar('arm', *arguments)
    assert (code, out) == (2, '')
    assert 'Traceback' not in err
    line, = [line for line in err.splitlines() if line.startswith('fourbar arm: ')
             or 'unrecognized arguments' in line]
