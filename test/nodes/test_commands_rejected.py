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

"""A wheel command is taken whole or rejected whole, counted and reported."""

from math import inf, nan

import pytest
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

WHEELS = ['flywheel_a', 'flywheel_b', 'flywheel_c', 'flywheel_d']
GOOD = [2e-5, -1e-5, 3e-5, -2e-5]
LIMIT = 1e-4

# By kind of rejection: commands that are wrong in nothing else.
WRONG = {
    'finite': [
        {'effort': [nan, 1e-5, 1e-5, 1e-5]},
        {'effort': [1e-5, 1e-5, 1e-5, inf]},
        {'effort': [1e-5, -inf, 1e-5, 1e-5]},
    ],
    'names': [
        {'names': ['flywheel_a', 'flywheel_x'], 'effort': [1e-5, 1e-5]},
        {'names': ['flywheel_a', 'flywheel_a'], 'effort': [1e-5, 1e-5]},
        {'names': ['link_a'], 'effort': [1e-5]},
        {'names': [''], 'effort': [1e-5]},
    ],
    'length': [
        {'effort': [1e-5]},
        {'effort': [1e-5] * 5},
        {'effort': []},
        {'names': [], 'effort': [1e-5] * 4},
        {'names': [], 'effort': []},
    ],
    'fields': [
        {'effort': [1e-5] * 4, 'velocity': [1.0] * 4},
        {'effort': [1e-5] * 4, 'position': [1.0] * 4},
        {'position': [1.0] * 4},
    ],
}
# By a word of the reason: how far from the last tick a stamp must not be [ns].
STALE = {'older than the last tick': -1_200_000_000, 'ahead': 1_000_000_000}


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
    # Disarming and arming may both fit in one tick, which still tells the torques before.
    driven.wait(lambda: driven.arm().success and not any(efforts(driven)))
    yield driven
    driven.drive([0.0] * 4)
    driven.arm(False)


def newest_stamp(testbed):
    testbed.catch_up()
    return stamp_of(testbed.received['flywheel_states'][-1])


def efforts(testbed):
    """Return the torques really applied at the newest tick."""
    return list(testbed.received['sim/flywheel_states'][-1].effort)


def rejected(testbed, fresh=False):
    return testbed.counts('plant', 'commands_rejected_', fresh)


def assert_rejected(testbed, kind, count, before, begin):
    """Check that so many more of one kind were counted, and that no wheel felt any."""
    def counted():
        now = rejected(testbed, fresh=True)
        return now if now.get(kind, 0) - before.get(kind, 0) >= count else None
    now = testbed.wait(counted)
    # On a busy machine the probe itself may answer a few ticks too late.
    for counts in (before, now):
        counts.pop('stale', None)
    assert now == before if kind == 'stale' else now == {
        **before, kind: before.get(kind, 0) + count}
    assert not any(any(message.effort)
                   for message in testbed.received['sim/flywheel_states'][begin:])


def assert_next_good_one_works(testbed):
    testbed.drive(GOOD)
    testbed.wait(lambda: testbed.arm().success and efforts(testbed) == pytest.approx(GOOD))


@pytest.mark.parametrize('kind', list(WRONG))
def test_wrong_command_is_rejected_whole(testbed, kind):
    before = rejected(testbed)
    begin = len(testbed.received['sim/flywheel_states'])

    for command in WRONG[kind]:
        testbed.command(newest_stamp(testbed), **command)

    assert_rejected(testbed, kind, len(WRONG[kind]), before, begin)
    assert_next_good_one_works(testbed)


@pytest.mark.parametrize('reason', list(STALE))
def test_stale_command_is_rejected(testbed, reason):
    before = rejected(testbed)
    begin = len(testbed.received['sim/flywheel_states'])

    testbed.command(newest_stamp(testbed) + STALE[reason], effort=GOOD)

    assert_rejected(testbed, 'stale', 1, before, begin)
    said = testbed.received['/diagnostics'][-1].status[0].values
    assert reason in {item.key: item.value for item in said}['last_rejection']
    assert_next_good_one_works(testbed)


def test_command_without_a_stamp_is_stale(testbed):
    before = rejected(testbed)
    begin = len(testbed.received['sim/flywheel_states'])
    testbed.command(0, effort=GOOD)
    assert_rejected(testbed, 'stale', 1, before, begin)
    assert_next_good_one_works(testbed)


def test_command_that_was_overtaken_by_a_newer_one_is_stale(testbed):
    before = rejected(testbed)
    begin = len(testbed.received['sim/flywheel_states'])
    # Fifteen periods: older than the one in force, but not too old by itself.
    testbed.command(newest_stamp(testbed) - 60_000_000, effort=GOOD)
    assert_rejected(testbed, 'stale', 1, before, begin)
    assert_next_good_one_works(testbed)


def test_rejections_are_a_warning_with_the_last_reason(testbed, plant):
    before = rejected(testbed)
    begin = len(testbed.received['sim/flywheel_states'])
    testbed.command(newest_stamp(testbed), names=['nonsense'], effort=[1e-5])
    assert_rejected(testbed, 'names', 1, before, begin)
    status = testbed.received['/diagnostics'][-1].status[0]
    assert status.level == b'\x01'
    assert 'nonsense' in {item.key: item.value for item in status.values}['last_rejection']
    testbed.wait(lambda: 'flywheel_command rejected' in plant.stdout + plant.stderr)


def test_wheels_are_found_by_name_in_any_order(testbed):
    testbed.drive(None)
    by_name = dict(zip(WHEELS, GOOD))

    def obeyed():
        testbed.command(newest_stamp(testbed), names=list(reversed(by_name)),
                        effort=list(reversed(by_name.values())))
        return efforts(testbed) == pytest.approx(GOOD)
    testbed.wait(lambda: testbed.arm().success and obeyed())


def test_wheels_follow_a_commanded_speed(testbed):
    """By the loop in the motors' electronics; a wheel that is not named coasts."""
    testbed.drive(None)
    wanted = {'flywheel_a': 30.0, 'flywheel_c': -20.0}

    def reached():
        testbed.command(newest_stamp(testbed), names=list(wanted), velocity=list(wanted.values()))
        now = testbed.received['sim/flywheel_states'][-1]
        assert not any(now.effort[1::2])
        return now.velocity[0] == pytest.approx(30.0, rel=1e-3) and now.velocity[
            2] == pytest.approx(-20.0, rel=1e-3)
    testbed.wait(lambda: testbed.arm().success and reached())


def test_wheel_that_is_not_named_gets_no_torque(testbed):
    testbed.drive(None)

    def obeyed():
        testbed.command(newest_stamp(testbed), names=['flywheel_c'], effort=[1e-5])
        return efforts(testbed) == pytest.approx([0.0, 0.0, 1e-5, 0.0])
    testbed.wait(lambda: testbed.arm().success and obeyed())


def test_too_much_torque_is_clipped_and_counted(testbed):
    before = testbed.counts('plant', 'commands_clipped', fresh=False)['']
    testbed.drive([1.0, -1.0, 0.5 * LIMIT, 0.0])
    testbed.wait(lambda: testbed.arm().success
                 and efforts(testbed) == pytest.approx([LIMIT, -LIMIT, 0.5 * LIMIT, 0.0]))
    testbed.drive([0.0] * 4)
    testbed.wait(lambda: testbed.counts('plant', 'commands_clipped')[''] > before)


def test_good_command_while_disarmed_is_neither_rejected_nor_obeyed(driven):
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


def test_message_from_a_default_publisher_is_taken(testbed):
    """A rival with the quality of service of `ros2 topic pub`, after which arming is refused."""
    rival = testbed.publisher(JointState, 'flywheel_command', 10)
    before = rejected(testbed)
    rival.publish(JointState(name=['nonsense'], effort=[0.0]))
    testbed.wait(lambda: sum(rejected(testbed, fresh=True).values()) > sum(before.values()))
    testbed.node.destroy_publisher(rival)
