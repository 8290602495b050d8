# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Arming, emergency stop, command timeout: conditions, and their effect on the wheels."""

import signal

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

pytestmark = pytest.mark.node

PERIOD_S = 0.004
# Time limit for the discovery to drop a dead node, which takes 20 s on a quiet machine [s].
FORGOTTEN_S = 60.0
# Command timeout with which the suite starts plants [s].
COMMAND_TIMEOUT_S = 1.0
# Largest delay of a command on a busy machine [s].
A_FEW_TICKS_S = 25 * PERIOD_S

SPIN_UP = [6e-5, 2e-5, -4e-5, 5e-5]


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


@pytest.fixture(scope='module')
def testbed(module_suite, probe):
    """Run a plant alone, driven by the probe."""
    module_suite.node('plant')
    probe.drive([0.0] * 4)
    probe.follow('flywheel_states', 'sim/flywheel_states', 'sim/link_states')
    probe.newest('sim/flywheel_states')
    return probe


@pytest.fixture(autouse=True)
def released(request):
    """Leave the plant disarmed, with one publisher of commands."""
    yield
    if 'testbed' in request.fixturenames:
        testbed = request.getfixturevalue('testbed')
        testbed.drive([0.0] * 4)
        testbed.trigger('reset_emergency_stop')
        testbed.arm(False)
        testbed.status('device_status', state='disarmed')


def speeds_after(testbed, count):
    """Return absolute wheel speeds (n, 4) and efforts (n, 4) of n more ticks."""
    testbed.catch_up()
    testbed.more('sim/flywheel_states', count)
    wheels = {stamp_of(message): message for message in
              testbed.received['sim/flywheel_states'][-count:]}
    links = {stamp_of(message): message for message in
             testbed.received['sim/link_states'][-count:]}
    common = sorted(set(wheels) & set(links))
    assert len(common) > count / 2
    return (np.array([np.array(wheels[stamp].velocity) + links[stamp].velocity
                      for stamp in common]),
            np.array([wheels[stamp].effort for stamp in common]))


def spinning(testbed, minimum=10.0):
    """Return whether every wheel turns."""
    return min(np.abs(testbed.received['sim/flywheel_states'][-1].velocity)) > minimum


def spin_up(testbed):
    """Drive until every wheel turns; arm again after a command timeout."""
    testbed.drive(SPIN_UP)

    def turning():
        state = testbed.state()
        if state == 'disarmed':
            testbed.arm()
        return state == 'armed' and spinning(testbed)
    testbed.wait(turning)


def refusal(testbed):
    """Request arming until it is refused, and return the reason."""
    def refused():
        response = testbed.arm()
        if response.success:
            testbed.arm(False)
            return None
        return response.message
    return testbed.wait(refused)


def arm_when_possible(testbed):
    """Request arming until it is granted."""
    testbed.wait(lambda: testbed.arm().success)


def assert_coasting(testbed):
    """Check that the wheels have no torque and constant absolute speeds."""
    speeds, efforts = speeds_after(testbed, 100)
    assert not efforts.any()
    assert np.ptp(speeds, axis=0) == pytest.approx(0.0, abs=1e-9)


def test_armed_and_disarmed_on_request(testbed):
    response = testbed.arm()
    assert (response.success, response.message) == (True, 'armed')
    status = testbed.status('device_status', state='armed')
    assert status['reason'] == 'armed on request'
    assert testbed.arm().success
    spin_up(testbed)

    assert testbed.arm(False).success

    after = testbed.status('device_status', state='disarmed')
    assert after['reason'] == 'disarmed on request'
    assert float(after['since']) > float(status['since'])
    assert_coasting(testbed)


def test_status_goes_to_diagnostics_at_once(testbed):
    testbed.diagnostics('plant')
    testbed.arm()
    testbed.status('device_status', state='armed')
    status = testbed.diagnostics('plant', lambda status: status.message.startswith('armed'))
    assert {item.key: item.value for item in status.values}['state'] == 'armed'
    arrays = testbed.received['/diagnostics']
    stamps = [array.header.stamp.sec + array.header.stamp.nanosec * 1e-9 for array in arrays]
    # The regular messages are a second apart; the message of the change is between two of them.
    testbed.diagnostics('plant')
    assert min(np.diff(stamps)) < 0.95


def test_emergency_stop_is_latched_until_reset(testbed):
    testbed.arm()
    spin_up(testbed)

    assert testbed.trigger('emergency_stop').success

    status = testbed.status('device_status', state='emergency_stop')
    assert status['reason'] == 'emergency_stop service'
    assert_coasting(testbed)
    refused = testbed.arm()
    assert not refused.success
    assert 'emergency_stop' in refused.message
    assert testbed.arm(False).message == 'emergency_stop'
    assert testbed.status('device_status')['state'] == 'emergency_stop'

    assert testbed.trigger('reset_emergency_stop').success
    status = testbed.status('device_status', state='disarmed')
    assert status['reason'] == 'emergency_stop was reset'
    assert_coasting(testbed)
    assert testbed.arm().success


def test_reset_without_a_stop_changes_nothing(testbed):
    testbed.arm()
    response = testbed.trigger('reset_emergency_stop')
    assert 'nothing to reset' in response.message
    assert testbed.status('device_status')['state'] == 'armed'


def test_request_true_on_the_stop_topic_stops_and_false_has_no_effect(testbed):
    request = testbed.publisher(Bool, 'emergency_stop_request')
    testbed.arm()
    testbed.drive(SPIN_UP)
    testbed.status('device_status', state='armed')
    for _ in range(3):
        request.publish(Bool(data=False))
    testbed.more('sim/flywheel_states', 100)
    assert testbed.status('device_status')['state'] == 'armed'

    request.publish(Bool(data=True))

    status = testbed.status('device_status', state='emergency_stop')
    assert status['reason'] == 'emergency_stop_request'
    request.publish(Bool(data=False))
    assert_coasting(testbed)
    assert testbed.status('device_status')['state'] == 'emergency_stop'
    testbed.node.destroy_publisher(request)


def test_a_second_publisher_of_angles_prevents_arming(testbed):
    rival = testbed.node.create_publisher(JointState, 'link_angles', 10)

    reason = refusal(testbed)

    assert reason == 'refused: link_angles has 2 publishers, limit 1'
    assert testbed.status('device_status')['state'] == 'disarmed'
    testbed.node.destroy_publisher(rival)
    arm_when_possible(testbed)


def test_refusal_names_all_arming_blockers(testbed):
    rivals = [testbed.node.create_publisher(JointState, topic, 10)
              for topic in ('flywheel_command', 'link_angles')]
    testbed.wait(lambda: 'flywheel_command' in (reason := refusal(testbed))
                 and 'link_angles' in reason)
    for rival in rivals:
        testbed.node.destroy_publisher(rival)
    arm_when_possible(testbed)


def test_wheels_coast_after_the_command_timeout(testbed):
    testbed.arm()
    spin_up(testbed)

    testbed.drive(None)

    status = testbed.status('device_status', state='disarmed')
    assert status['reason'] == f'no flywheel_command for {COMMAND_TIMEOUT_S:g} s'
    assert_coasting(testbed)


def test_plant_without_commands_disarms_after_the_timeout(testbed):
    testbed.drive(None)
    testbed.more('sim/flywheel_states', 50)
    testbed.arm()
    status = testbed.status(
        'device_status', state='disarmed',
        reason=f'no flywheel_command for {COMMAND_TIMEOUT_S:g} s')
    assert float(status['since']) > 1e9


@pytest.mark.parametrize('action', [
    'coast', *(pytest.param(other, marks=pytest.mark.slow) for other in ('hold_speed', 'brake'))])
def test_timeout_action(suite, make_probe, action):
    suite.node('plant', {'timeout_action': action}, f'/{action}')
    testbed = make_probe(f'/{action}')
    testbed.drive(SPIN_UP)
    testbed.follow('flywheel_states', 'sim/flywheel_states', 'sim/link_states')
    testbed.newest('sim/flywheel_states')
    arm_when_possible(testbed)
    spin_up(testbed)

    testbed.drive(None)

    status = testbed.status('device_status', state='disarmed')
    assert 'no flywheel_command' in status['reason']
    if action == 'coast':
        assert_coasting(testbed)
        return
    lost_ns = round(float(status['since']) * 1e9)
    first = testbed.wait(lambda: next((
        message for message in testbed.received['sim/flywheel_states']
        if stamp_of(message) >= lost_ns - 1000), None))
    wanted = np.zeros(4) if action == 'brake' else np.array(first.velocity)
    # The speed loop measures means over a period, which lag by half a period while speeds rise,
    # with an error of one encoder count per period, at its begin and afterwards.
    tolerance = max(SPIN_UP) / 3.4e-7 * PERIOD_S / 2 + 2 * (2 * np.pi / 16384 / PERIOD_S)
    testbed.wait(lambda: np.abs(
        testbed.received['sim/flywheel_states'][-1].velocity - wanted).max() < tolerance)
    for message in testbed.more('sim/flywheel_states', 50):
        assert np.abs(message.velocity - wanted).max() < tolerance


@pytest.fixture
def moving(suite, make_probe):
    """Return three nodes in the middle of a move, and a probe."""
    nodes = suite.nodes('/moving', controller={'setpoint_duration': 6.0})
    watcher = make_probe('/moving')
    watcher.follow('flywheel_states', 'sim/flywheel_states', 'sim/link_states',
                   'flywheel_command', 'timing')
    watcher.newest('flywheel_command')
    arm_when_possible(watcher)
    watcher.status('controller_status', mode='hold')
    decision = watcher.setpoint_decision(
        JointState(name=['link_a', 'link_b'], position=[0.6, 1.7]),
        watcher.publisher(JointState, 'setpoint'))
    assert decision['accepted'] == '1', decision['last_refusal']
    watcher.wait(lambda: spinning(watcher, 5.0))
    return nodes, watcher


@pytest.mark.parametrize(
    'number', [pytest.param(signal.SIGKILL, marks=pytest.mark.slow), signal.SIGSTOP],
    ids=lambda n: n.name)
def test_lost_controller_leaves_the_wheels_coasting(moving, make_probe, number):
    nodes, watcher = moving
    controller = nodes['controller']

    controller.kill() if number == signal.SIGKILL else controller.send(number)

    status = watcher.status('device_status', state='disarmed')
    assert status['reason'] == f'no flywheel_command for {COMMAND_TIMEOUT_S:g} s'
    assert_coasting(watcher)
    silent_ns = max(stamp_of(message) for message in watcher.received['flywheel_command'])
    driven_ns = max(stamp_of(message) for message in watcher.received['sim/flywheel_states']
                    if any(message.effort))
    assert (driven_ns - silent_ns) * 1e-9 < COMMAND_TIMEOUT_S + A_FEW_TICKS_S
    if number == signal.SIGKILL:
        # Wait until the discovery has dropped the dead node: Fast DDS deadlocks when a publisher
        # is destroyed at that moment, as at the end of the module.
        topic = watcher.node.resolve_topic_name('flywheel_command')
        for each in make_probe.probes:
            watcher.wait(lambda node=each.node: node.count_publishers(topic) == 0, FORGOTTEN_S)
        return
    # The controller continues and finds the device disarmed: no goal, no torque.
    controller.send(signal.SIGCONT)
    assert watcher.status('controller_status', mode='disarmed')['goal'] == ''
    assert_coasting(watcher)
    assert watcher.status('device_status')['state'] == 'disarmed'
