# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Rejection of commands by the plant, beyond the tests for all devices."""

import pytest
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

GOOD = [2e-5, -1e-5, 3e-5, -2e-5]


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


@pytest.fixture(scope='module')
def plant(module_suite):
    return module_suite.node('plant')


@pytest.fixture(scope='module')
def driven(plant, probe):
    probe.drive([0.0] * 4)
    probe.follow('flywheel_states', 'sim/flywheel_states')
    probe.newest('sim/flywheel_states')
    return probe


@pytest.fixture
def testbed(driven):
    """Arm the plant and hold it with commands of zero torque."""
    driven.drive([0.0] * 4)
    # Disarming and arming may fit in one tick, which still shows the torques before.
    driven.wait(lambda: driven.arm().success and not any(efforts(driven)))
    yield driven
    driven.drive([0.0] * 4)
    driven.arm(False)


def newest_stamp(testbed):
    testbed.catch_up()
    return stamp_of(testbed.received['flywheel_states'][-1])


def efforts(testbed):
    """Return the true torques at the newest tick."""
    return list(testbed.received['sim/flywheel_states'][-1].effort)


def rejected(testbed, fresh=False):
    return testbed.counts('plant', 'commands_rejected_', fresh)


def assert_rejected(testbed, kind, count, before, begin):
    """Check that `count` more of one kind are counted, and that no wheel has torque."""
    def counted():
        now = rejected(testbed, fresh=True)
        return now if now.get(kind, 0) - before.get(kind, 0) >= count else None
    now = testbed.wait(counted)
    # On a busy machine the probe itself may answer a few ticks late, so stale ones do not count.
    for counts in (before, now):
        counts.pop('stale', None)
    assert now == before if kind == 'stale' else now == {
        **before, kind: before.get(kind, 0) + count}
    assert not any(any(message.effort)
                   for message in testbed.received['sim/flywheel_states'][begin:])


def assert_next_good_command_acts(testbed):
    testbed.drive(GOOD)
    testbed.wait(lambda: testbed.arm().success and efforts(testbed) == pytest.approx(GOOD))


def test_command_without_a_stamp_is_stale(testbed):
    before = rejected(testbed)
    begin = len(testbed.received['sim/flywheel_states'])
    testbed.command(0, effort=GOOD)
    assert_rejected(testbed, 'stale', 1, before, begin)
    assert_next_good_command_acts(testbed)


def test_command_older_than_the_last_one_is_stale(testbed):
    before = rejected(testbed)
    begin = len(testbed.received['sim/flywheel_states'])
    # An age of fifteen periods is below the age limit, but the last command is newer.
    testbed.command(newest_stamp(testbed) - 60_000_000, effort=GOOD)
    assert_rejected(testbed, 'stale', 1, before, begin)
    assert_next_good_command_acts(testbed)


def test_rejections_are_a_warning_with_the_last_reason(testbed, plant):
    before = rejected(testbed)
    begin = len(testbed.received['sim/flywheel_states'])
    testbed.command(newest_stamp(testbed), names=['nonsense'], effort=[1e-5])
    assert_rejected(testbed, 'names', 1, before, begin)
    status = testbed.received['/diagnostics'][-1].status[0]
    assert status.level == b'\x01'
    assert 'nonsense' in {item.key: item.value for item in status.values}['last_rejection']
    testbed.wait(lambda: 'flywheel_command rejected' in plant.stdout + plant.stderr)


def test_good_command_while_disarmed_is_not_rejected_and_has_no_effect(driven):
    before = rejected(driven)
    driven.arm(False)
    driven.drive(GOOD)
    begin = len(driven.received['sim/flywheel_states'])
    driven.more('sim/flywheel_states', 50)
    assert rejected(driven, fresh=True) == before
    driven.catch_up()
    assert not any(any(message.effort)
                   for message in driven.received['sim/flywheel_states'][begin + 5:])
    driven.drive([0.0] * 4)


def test_message_from_a_default_publisher_is_received(testbed):
    """The second publisher has the quality of service of `ros2 topic pub`."""
    rival = testbed.publisher(JointState, 'flywheel_command', 10)
    before = rejected(testbed)
    rival.publish(JointState(name=['nonsense'], effort=[0.0]))
    testbed.wait(lambda: sum(rejected(testbed, fresh=True).values()) > sum(before.values()))
    testbed.node.destroy_publisher(rival)
