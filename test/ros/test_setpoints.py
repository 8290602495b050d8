# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Setpoints over DDS: from the command line, accepted, or refused with the reason."""

from math import inf, nan

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

LINKS = ['link_a', 'link_b', 'link_c', 'link_d']
DURATION_S = 2.0
# Quality of service of `ros2 topic pub`, in this and in earlier distributions.
OF_TOPIC_PUB = {
    'volatile': QoSProfile(depth=10),
    'latched': QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}
# Refused setpoints, and a word of the reason.
WRONG = {
    'not a number': ([['link_a'], [nan]], 'nan'),
    'infinite': ([['link_a', 'link_b'], [0.0, inf]], 'inf'),
    'unknown': ([['link_x'], [0.0]], 'link_x'),
    'wheel': ([['flywheel_a'], [0.0]], 'flywheel_a'),
    'twice': ([['link_a', 'link_a'], [0.0, 0.0]], 'twice'),
    'too few': ([['link_a', 'link_b'], [0.0]], '2 names but 1'),
    'too many': ([['link_a'], [0.0, 0.0]], '1 names but 2'),
    'empty': ([[], []], 'no name'),
    'nameless': ([[], [0.0, 1.57]], 'no name'),
    'contradictory': ([['link_a', 'link_b', 'link_c'], [0.0, 1.2, 0.5]], 'link_c'),
}


@pytest.fixture(scope='module')
def nodes(module_suite):
    return module_suite.nodes(controller={'setpoint_duration': DURATION_S})


@pytest.fixture(scope='module')
def publisher(nodes, probe):
    return probe.publisher(JointState, 'setpoint')


@pytest.fixture(scope='module')
def started(nodes, probe):
    probe.follow('reference', 'sim/link_states', 'sim/flywheel_states', 'flywheel_states',
                 'estimate/link_states', 'flywheel_command')
    probe.newest('reference')
    return probe


@pytest.fixture
def testbed(started):
    """Arm; the controller holds the present angles."""
    started.wait(lambda: started.arm().success)
    started.status('controller_status', mode='hold')
    # Earlier messages follow the noisy estimate.
    held = started.received['reference']
    started.wait(lambda: len(held) > 1 and held[-1].position == held[-2].position)
    yield started
    started.arm(False)
    started.status('controller_status', mode='disarmed')


def goal_of(status):
    return [float(item.split('=')[1]) for item in status['goal'].split()]


def reference(testbed):
    """Return the present reference [rad]."""
    return np.array(testbed.more('reference')[0].position)


@pytest.mark.parametrize('quality', list(OF_TOPIC_PUB))
def test_setpoint_from_the_command_line_is_reached(testbed, quality):
    """The message is that of `ros2 topic pub --once /setpoint ...` in the README."""
    publisher = testbed.publisher(JointState, 'setpoint', OF_TOPIC_PUB[quality])
    decision = testbed.setpoint_decision(
        JointState(name=['link_a', 'link_b'], position=[0.0, 1.57]), publisher)
    assert decision['mode'] == 'track'
    assert goal_of(decision)[:2] == pytest.approx([0.0, 1.57], abs=1e-6)

    testbed.status('controller_status', mode='hold')

    assert reference(testbed)[:2] == pytest.approx([0.0, 1.57], abs=1e-12)
    testbed.node.destroy_publisher(publisher)


def test_reference_reaches_the_goal_in_the_setpoint_duration(testbed, publisher):
    begin = reference(testbed)
    count = len(testbed.received['reference'])
    testbed.setpoint_decision(JointState(name=['link_a'], position=[0.2]), publisher)
    testbed.status('controller_status', mode='hold')
    testbed.more('reference', 5)
    moved = [message for message in testbed.received['reference'][count:]
             if any(message.velocity)]
    times = [message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 for message in moved]
    assert times[-1] - times[0] == pytest.approx(DURATION_S, abs=0.1)
    first = [message.position[0] for message in moved]
    assert first[0] == pytest.approx(begin[0], abs=1e-6)
    assert np.all(np.diff(first) * np.sign(0.2 - begin[0]) >= 0)
    assert reference(testbed)[0] == pytest.approx(0.2, abs=1e-12)


def test_link_that_is_not_named_holds(testbed, publisher):
    """Link a alone moves; the reference of link b stays the same in all bits."""
    before = reference(testbed)
    decision = testbed.setpoint_decision(
        JointState(name=['link_a'], position=[before[0] + 0.1]), publisher)
    assert goal_of(decision)[1] == pytest.approx(before[1], abs=1e-6)
    testbed.status('controller_status', mode='hold')
    after = reference(testbed)
    assert after[0] == pytest.approx(before[0] + 0.1, abs=1e-9)
    assert after[1] == before[1]


@pytest.mark.parametrize('case', list(WRONG))
def test_wrong_setpoint_is_refused_as_a_whole(testbed, publisher, case):
    (names, positions), word = WRONG[case]
    before = testbed.status('controller_status')
    present = reference(testbed)

    decision = testbed.setpoint_decision(JointState(name=names, position=positions), publisher)

    assert decision['accepted'] == before['accepted']
    assert int(decision['refused']) == int(before['refused']) + 1
    assert word in decision['last_refusal']
    assert (decision['mode'], decision['goal']) == ('hold', before['goal'])
    assert (reference(testbed) == present).all()


@pytest.mark.parametrize('age_s', [5.0, -5.0])
def test_stale_setpoint_is_refused(testbed, publisher, age_s):
    present = reference(testbed)
    message = JointState(name=['link_a'], position=[0.3])
    stamp_ns = testbed.node.get_clock().now().nanoseconds - round(age_s * 1e9)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    decision = testbed.setpoint_decision(message, publisher)
    assert 'stamp' in decision['last_refusal']
    assert decision['mode'] == 'hold'
    assert (reference(testbed) == present).all()


def test_setpoint_with_the_stamp_of_the_last_tick_is_accepted(testbed, publisher):
    message = JointState(name=['link_a'], position=[0.05])
    message.header.stamp = testbed.more('flywheel_states')[0].header.stamp
    decision = testbed.setpoint_decision(message, publisher)
    assert decision['mode'] == 'track'


def test_refused_setpoint_does_not_change_the_present_move(testbed, publisher):
    begin = reference(testbed)
    goal = testbed.setpoint_decision(
        JointState(name=['link_a'], position=[begin[0] - 0.2]), publisher)['goal']
    refused = testbed.setpoint_decision(JointState(name=['link_a'], position=[nan]), publisher)
    assert (refused['mode'], refused['goal']) == ('track', goal)
    testbed.status('controller_status', mode='hold')
    assert reference(testbed)[0] == pytest.approx(begin[0] - 0.2, abs=1e-9)


def test_goal_is_dropped_when_disarmed(testbed, publisher):
    testbed.setpoint_decision(JointState(name=['link_a'], position=[0.3]), publisher)

    testbed.arm(False)

    assert testbed.status('controller_status', mode='disarmed')['goal'] == ''
    # While disarmed the reference is the present estimate.
    testbed.more('reference', 20)
    estimates = {(message.header.stamp.sec, message.header.stamp.nanosec): message.position
                 for message in testbed.received['estimate/link_states'][-200:]}
    for message in testbed.received['reference'][-10:]:
        stamp = message.header.stamp.sec, message.header.stamp.nanosec
        if stamp in estimates:
            assert message.position == estimates[stamp]
            assert not any(message.velocity)
    # After arming the controller holds and does not resume the old goal.
    testbed.arm()
    held = testbed.status('controller_status', mode='hold')
    assert held['goal'] == ''
    first = reference(testbed)
    testbed.more('reference', 50)
    assert (reference(testbed) == first).all()


def test_setpoint_while_disarmed_is_refused_and_not_kept(started, publisher):
    started.arm(False)
    before = started.status('controller_status', mode='disarmed')
    decision = started.setpoint_decision(
        JointState(name=['link_a'], position=[0.5]), publisher)
    assert int(decision['refused']) == int(before['refused']) + 1
    assert 'not armed' in decision['last_refusal']
    assert (decision['mode'], decision['goal']) == ('disarmed', '')
    assert not any(any(message.effort) for message in started.more('flywheel_command', 50))
    started.arm()
    assert started.status('controller_status', mode='hold')['goal'] == ''


def test_refusals_are_counted_on_diagnostics_too(started, publisher):
    decision = started.setpoint_decision(
        JointState(name=['link_x'], position=[0.5]), publisher)
    wanted = {key: decision[key] for key in ('refused', 'last_refusal')}
    status = started.diagnostics('controller', lambda status: {
        'setpoints_refused': wanted['refused'], 'last_refusal': wanted['last_refusal'],
    }.items() <= {item.key: item.value for item in status.values}.items())
    assert status.level == b'\x01'
