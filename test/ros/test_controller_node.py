# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The controller over DDS: trajectories, services, scalars, gains, and a dead wheel."""

from math import nan, pi

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.mechanism import FLYWHEEL_NAMES
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

pytestmark = pytest.mark.node

# The rate is low, so that some gains are unstable and two cores suffice [Hz].
RATE = 50.0
PERIOD = 1.0 / RATE

# Refused trajectories: names, points (positions, time, further fields), and a word of the reason.
WRONG = {
    'no points': (['link_a'], [], 'point'),
    'unknown': (['link_x'], [([0.1], 5.0, {})], 'link_x'),
    'nameless': ([], [([], 5.0, {})], 'name'),
    'twice': (['link_a', 'link_a'], [([0.1, 0.1], 5.0, {})], 'twice'),
    'not a number': (['link_a'], [([nan], 5.0, {})], 'nan'),
    'too few': (['link_a', 'link_b'], [([0.1], 5.0, {})], '2 names but 1'),
    'back in time': (['link_a'], [([0.1], 5.0, {}), ([0.2], 4.0, {})], 'time'),
    'torques': (['link_a'], [([0.1], 5.0, {'effort': [1.0]})], 'effort'),
    'in motion at the end': (['link_a'], [([0.1], 5.0, {'velocities': [1.0]})], 'must be 0'),
    'too fast': (['link_a', 'link_b'], [([2.0, 2.0 + pi / 3], 1.0, {})], 'needs '),
    'through a change point': (['link_a', 'link_b'], [([0.0, 0.0], 20.0, {})], 'change point'),
}


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def trajectory(names, points):
    message = JointTrajectory(joint_names=names)
    for positions, seconds, others in points:
        point = JointTrajectoryPoint(positions=positions, **others)
        point.time_from_start.sec = int(seconds)
        point.time_from_start.nanosec = round(seconds % 1.0 * 1e9)
        message.points.append(point)
    return message


def set_value(probe, node, name, value):
    """Set a parameter; return whether it was accepted, and the reason."""
    given = (ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
             if isinstance(value, str) else
             ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value))
    result, = probe.call(SetParameters, f'{node}/set_parameters', SetParameters.Request(
        parameters=[Parameter(name=name, value=given)])).results
    return result.successful, result.reason


@pytest.fixture(scope='module')
def nodes(module_suite):
    return module_suite.nodes(plant={'rate': RATE}, controller={'setpoint_duration': 3.0})


@pytest.fixture(scope='module')
def publisher(nodes, probe):
    return probe.publisher(JointTrajectory, 'trajectory')


@pytest.fixture(scope='module')
def started(nodes, probe):
    probe.follow('reference', 'flywheel_command', 'allocation', 'momentum')
    probe.newest('reference')
    probe.wait(lambda: probe.arm().success)
    probe.status('controller_status', mode='hold')
    return probe


@pytest.fixture
def testbed(started):
    """Return the probe with the controller in mode hold, at rest."""
    status = started.status('controller_status')
    if status['mode'] == 'idle':
        assert started.call(SetBool, 'enable', SetBool.Request(data=True)).success
    elif status['mode'] != 'hold':
        assert started.trigger('hold').success
    started.status('controller_status', mode='hold')
    references = started.received['reference']
    started.wait(lambda: len(references) > 1 and not any(references[-1].velocity)
                 and references[-1].position == references[-2].position)
    return started


def reference(testbed):
    """Return the present reference [rad]."""
    return np.array(testbed.more('reference')[0].position)


# Trajectories

def test_trajectory_is_followed_through_its_points(testbed, publisher):
    begin, count = reference(testbed), len(testbed.received['reference'])
    points = [(1.0, [0.05, 0.02]), (2.0, [0.02, -0.03]), (3.5, [-0.04, 0.0])]
    decision = testbed.setpoint_decision(
        trajectory(['link_a', 'link_b'],
                   [((begin[:2] + by).tolist(), time, {}) for time, by in points]), publisher)
    assert decision['mode'] == 'track'
    goal = [float(item.split('=')[1]) for item in decision['goal'].split()]
    assert goal[:2] == pytest.approx(begin[:2] + points[-1][1], abs=2e-6)

    testbed.status('controller_status', mode='hold')

    assert reference(testbed)[:2] == pytest.approx(begin[:2] + points[-1][1], abs=1e-9)
    moved = testbed.received['reference'][count:]
    first = next(n for n, message in enumerate(moved) if any(message.velocity))
    # The trajectory starts at the tick before the first motion.
    start_ns = stamp_of(moved[first]) - round(PERIOD * 1e9)
    times = np.array([(stamp_of(message) - start_ns) * 1e-9 for message in moved])
    for time, by in points:
        at = np.array(moved[int(np.argmin(np.abs(times - time)))].position)
        # The tick may be off by one; the rate is at most 0.2 rad/s.
        assert at[:2] == pytest.approx(begin[:2] + by, abs=0.2 * PERIOD)
    steps = np.diff([message.position[:2] for message in moved], axis=0)
    assert np.abs(steps).max() < 0.2 * PERIOD * 1.5


def test_refused_trajectories_are_counted_and_reported_with_the_reason(testbed, publisher, nodes):
    """The reference does not change; log, status and diagnostics contain the reason."""
    before = testbed.status('controller_status')
    held = reference(testbed)
    for number, (what, (names, points, word)) in enumerate(WRONG.items(), 1):
        decision = testbed.setpoint_decision(trajectory(names, points), publisher)
        assert word in decision['last_refusal'], what
        assert int(decision['refused']) == int(before['refused']) + number, what
        assert decision['accepted'] == before['accepted'], what
        assert (decision['mode'], decision['goal']) == ('hold', before['goal']), what
    wanted = {'setpoints_refused': decision['refused'], 'last_refusal': decision['last_refusal']}
    status = testbed.diagnostics('controller', lambda status: wanted.items() <= {
        item.key: item.value for item in status.values}.items())
    assert status.level == DiagnosticStatus.WARN
    assert status.message == 'hold, setpoints were refused'
    assert 'trajectory refused: ' in nodes['controller'].stderr
    assert (reference(testbed) == held).all()


# Services

def move(testbed, publisher):
    """Begin a move that takes five seconds."""
    begin = reference(testbed)
    decision = testbed.setpoint_decision(
        trajectory(['link_a'], [([float(begin[0]) + 0.3], 5.0, {})]), publisher)
    assert decision['mode'] == 'track'
    messages = testbed.received['reference']
    testbed.wait(lambda: abs(messages[-1].velocity[0]) > 0.02)


def test_hold_stops_a_move(testbed, publisher):
    move(testbed, publisher)
    response = testbed.trigger('hold')
    assert (response.success, response.message) == (True, 'holds')
    assert testbed.status('controller_status', mode='hold')['goal'] == ''
    messages = testbed.received['reference']
    testbed.wait(lambda: not any(messages[-1].velocity), seconds=3.0)


def test_damp_ends_the_reference_motion(testbed, publisher):
    move(testbed, publisher)
    response = testbed.trigger('damp')
    assert (response.success, response.message) == (True, 'stops all rates')
    assert testbed.status('controller_status', mode='damp')['goal'] == ''
    assert not any(any(message.velocity) for message in testbed.more('reference', 10)[1:])


def test_idle_controller_gives_no_torque_and_refuses_trajectories(testbed, publisher):
    response = testbed.call(SetBool, 'enable', SetBool.Request(data=False))
    assert (response.success, response.message) == (
        True, 'not enabled: the wheels get no torque')
    testbed.status('controller_status', mode='idle')
    for message in testbed.more('flywheel_command', 10):
        assert list(message.effort) == [0.0] * 4
    for service in ('hold', 'damp'):
        response = testbed.trigger(service)
        assert not response.success
        assert 'not enabled' in response.message
    decision = testbed.setpoint_decision(trajectory(['link_a'], [([0.1], 5.0, {})]), publisher)
    assert 'not enabled' in decision['last_refusal']
    response = testbed.call(SetBool, 'enable', SetBool.Request(data=True))
    assert (response.success, response.message) == (True, 'enabled')
    testbed.status('controller_status', mode='hold')


# Scalars

@pytest.mark.parametrize('topic', ['allocation', 'momentum'])
def test_scalars_are_finite_during_a_move(topic, testbed, publisher):
    move(testbed, publisher)
    messages = testbed.more(topic, 5)
    for message in messages:
        assert len(message.name) == len(message.position)
        assert np.isfinite(message.position).all()
    found = dict(zip(messages[-1].name, messages[-1].position))
    if topic == 'allocation':
        assert found['scale'] == 1.0
        # The links form a rhombus, so cond(A) is 1.
        assert found['condition_number'] == pytest.approx(1.0, abs=1e-6)
    else:
        # The table has no friction; encoder resolution and estimation noise remain.
        assert abs(found['total_n_m_s']) < 1e-6
        assert 0.0 < found['margin'] < 1.0


# Gains

def test_gains_that_are_unstable_at_the_rate_are_refused(testbed):
    assert set_value(testbed, 'controller', 'damping', 2.0) == (True, '')
    accepted, reason = set_value(testbed, 'controller', 'bandwidth', 20.0)
    assert not accepted
    for value in ('bandwidth 20 rad/s', 'damping 2', '50 Hz', 'at most '):
        assert value in reason
    values = testbed.call(GetParameters, 'controller/get_parameters', GetParameters.Request(
        names=['bandwidth'])).values
    assert values[0].double_value == 4.0
    assert set_value(testbed, 'controller', 'damping', 0.9) == (True, '')
    assert testbed.status('controller_status', mode='hold')['problem'] == ''


# A dead wheel; the last test, because the controller keeps the fault until it is disarmed

@pytest.mark.slow
def test_dead_wheel_is_named_in_the_status_and_missing_in_commands(testbed, publisher):
    move(testbed, publisher)
    assert set_value(testbed, 'plant', 'fault.flywheel_a', 'dead') == (True, '')
    statuses = testbed.received['controller_status']

    def faults():
        return {item.key: item.value for item in statuses[-1].values}['wheel_faults']
    testbed.wait(lambda: 'flywheel_a: dead' in faults())
    assert statuses[-1].level == DiagnosticStatus.WARN
    assert 'flywheel_a: dead' in statuses[-1].message
    for message in testbed.more('flywheel_command', 20)[2:]:
        assert message.name == list(FLYWHEEL_NAMES[1:])
        assert len(message.effort) == 3
    # The other wheels complete the move.
    status = testbed.status('controller_status', mode='hold')
    assert status['problem'] == ''
    assert set_value(testbed, 'plant', 'fault.flywheel_a', 'none') == (True, '')
    assert testbed.arm(False).success
    testbed.status('controller_status', mode='disarmed')
    testbed.wait(lambda: testbed.arm().success)
    assert testbed.status('controller_status', mode='hold')['wheel_faults'] == ''
    testbed.wait(lambda: testbed.more('flywheel_command')[0].name == list(FLYWHEEL_NAMES))
