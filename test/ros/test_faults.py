# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Effect on the topics of sensor and wheel faults, set at run time and by a schedule."""

import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters

pytestmark = pytest.mark.node


@pytest.fixture(scope='module')
def testbed(module_suite, probe):
    module_suite.node('plant', {'rate': 100.0})
    probe.drive([1e-6] * 4)
    probe.follow('link_angles', 'sim/flywheel_states')
    probe.newest('link_angles')
    return probe


def set_fault(testbed, name, text):
    """Set a parameter; return whether it was accepted, and the reason."""
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)
    result, = testbed.call(SetParameters, 'plant/set_parameters', SetParameters.Request(
        parameters=[Parameter(name=name, value=value)])).results
    return result.successful, result.reason


def test_sensor_with_fault_off_is_missing_until_the_fault_ends(testbed):
    assert set_fault(testbed, 'fault.link_c', 'off') == (True, '')
    testbed.wait(lambda: list(testbed.received['link_angles'][-1].name) == [
        'link_a', 'link_b', 'link_d'])
    assert set_fault(testbed, 'fault.link_c', '') == (True, '')
    testbed.wait(lambda: len(testbed.received['link_angles'][-1].name) == 4)


def test_wrong_sensor_has_the_given_error(testbed):
    assert set_fault(testbed, 'fault.link_b', 'wrong 0.5')[0]
    status = testbed.diagnostics('plant', lambda status: 'faults' in status.message)
    assert {item.key: item.value for item in status.values}['faults'] == 'link_b wrong 0.5'
    testbed.wait(lambda: testbed.received['link_angles'][-1].position[1] == pytest.approx(
        1.0472 + 0.5, abs=0.02))
    assert set_fault(testbed, 'fault.link_b', 'none')[0]


@pytest.mark.slow
def test_estimator_gates_a_wrong_sensor_and_reports_it(suite, make_probe):
    """The error of the estimate is far smaller than the error of the sensor."""
    watch = make_probe('/wrong')
    for name, parameters in (('plant', {'rate': 100.0}), ('estimator', {})):
        suite.node(name, parameters, '/wrong')
    watch.follow('estimate/link_states', 'sim/link_states', 'estimate/innovation')
    watch.wait(lambda: len(watch.received['estimate/link_states']) > 100)
    assert set_fault(watch, 'fault.link_c', 'wrong 0.5')[0]
    status = watch.diagnostics(
        'wrong/estimator', lambda status: status.message == 'running, link_c: samples far off')
    assert status.level == b'\x01'
    counted, = [item.value for item in status.values if item.key == 'gated_link_c']
    assert int(counted) > 5
    seen, = [dict(zip(message.name, message.position))
             for message in watch.received['estimate/innovation'][-1:]]
    assert seen['degrees_of_freedom'] == 3.0
    assert seen['link_c'] == pytest.approx(0.5, abs=0.02)
    truth = watch.received['sim/link_states'][-1].position
    assert watch.received['estimate/link_states'][-1].position == pytest.approx(truth, abs=0.01)

    assert set_fault(watch, 'fault.link_c', '')[0]
    assert watch.trigger('estimate/reset').success
    watch.diagnostics('wrong/estimator', lambda status: 'starts' in {
        item.key for item in status.values if item.value == '2'})


def test_dead_wheel_gives_no_torque(testbed):
    testbed.wait(lambda: testbed.arm().success)
    testbed.wait(lambda: all(testbed.received['sim/flywheel_states'][-1].effort))
    assert set_fault(testbed, 'fault.flywheel_d', 'dead')[0]
    testbed.wait(lambda: [bool(effort) for effort in testbed.received[
        'sim/flywheel_states'][-1].effort] == [True, True, True, False])
    assert set_fault(testbed, 'fault.flywheel_d', 'none')[0]
    testbed.arm(False)


@pytest.mark.parametrize(('kind', 'cut'), [('runaway', True), ('shorted', False)])
def test_wheel_missing_in_a_command_loses_its_power(kind, cut, testbed):
    """Loss of power ends a runaway, as disarming does, and does not end a short circuit."""
    def efforts():
        return list(testbed.received['sim/flywheel_states'][-1].effort)

    def without_b():
        tick = testbed.received['sim/flywheel_states'][-1].header.stamp
        testbed.command(tick.sec * 1_000_000_000 + tick.nanosec, effort=[2e-6] * 3,
                        names=['flywheel_a', 'flywheel_c', 'flywheel_d'])
        return efforts() == pytest.approx([2e-6, 0.0 if cut else 1e-5, 2e-6, 2e-6])

    testbed.drive([1e-6] * 4)
    assert set_fault(testbed, 'fault.flywheel_b', f'{kind} 1e-5')[0]
    testbed.wait(lambda: testbed.arm().success)
    testbed.wait(lambda: efforts() == pytest.approx([1e-6, 1e-5, 1e-6, 1e-6]))
    testbed.drive(None)
    testbed.wait(without_b)
    testbed.drive([1e-6] * 4)
    testbed.wait(lambda: efforts() == pytest.approx([1e-6, 1e-5, 1e-6, 1e-6]))
    testbed.arm(False)
    testbed.wait(lambda: efforts() == pytest.approx([0.0, 0.0 if cut else 1e-5, 0.0, 0.0]))
    assert set_fault(testbed, 'fault.flywheel_b', 'none')[0]
    testbed.wait(lambda: not any(efforts()))


@pytest.mark.parametrize(('name', 'text', 'word'), [
    ('fault.link_a', 'broken', "unknown fault 'broken' of link_a"),
    ('fault.link_a', 'intermittent 1.5', 'between 0 and 1, got 1.5'),
    ('fault.joint_1', 'off', 'no joint_1'),
    ('fault.flywheel_a', 'weak x', "must be a number, got 'x'"),
    ('fault_schedule', '/nowhere/faults.yaml', '/nowhere/faults.yaml')])
def test_invalid_fault_is_refused_and_has_no_effect(testbed, name, text, word):
    accepted, reason = set_fault(testbed, name, text)
    assert not accepted
    assert word in reason
    assert len(testbed.more('link_angles')[0].name) == 4


def test_schedule_is_followed_from_the_start(suite, make_probe, tmp_path):
    path = tmp_path / 'faults.yaml'
    path.write_text('faults:\n'
                    '  - {at: 0.5, until: 1.0, target: link_a, fault: off}\n')
    testbed = make_probe('/scheduled')
    testbed.follow('link_angles')
    suite.node('plant', {'rate': 100.0, 'fault_schedule': str(path)}, '/scheduled')
    angles = testbed.received['link_angles']
    testbed.wait(lambda: any(len(message.name) == 3 for message in angles))
    testbed.wait(lambda: len(angles[-1].name) == 4)
    missing = [message for message in angles if len(message.name) == 3]
    # The fault lasts half a second at 100 Hz; a busy machine may skip ticks.
    assert len(missing) <= 50
    assert list(missing[0].name) == ['link_b', 'link_c', 'link_d']


def test_bad_schedule_ends_the_node_with_one_line(suite, tmp_path):
    path = tmp_path / 'faults.yaml'
    path.write_text('faults:\n  - {at: -1.0, target: link_a, fault: off}\n')
    process = suite.node('plant', {'fault_schedule': str(path)}, '/bad')
    assert process.end() == 2
    line, = [line for line in process.stderr.splitlines() if 'faults.yaml' in line]
    assert 'entry 1' in line
    assert 'Traceback' not in process.stderr
