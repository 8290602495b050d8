# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Lock-step without an estimate, and with lost answers: every tick is answered in the end."""

import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

pytestmark = pytest.mark.node

FIRST_NS = 1_000_000_000
PERIOD_NS = 4_000_000
LINKS = [f'link_{letter}' for letter in 'abcd']
WHEELS = [f'flywheel_{letter}' for letter in 'abcd']
# Initial link angles of the square, the same as of the linkage of the paper [rad].
ANGLES = [0.0, 1.047197551197, 0.0, 1.047197551197]


def at(stamp_ns, message):
    stamp = message.stamp if isinstance(message, Header) else message.header.stamp
    stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    return message


def stamp_of(message):
    stamp = message.stamp if isinstance(message, Header) else message.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


@pytest.fixture(scope='module')
def plant(module_suite, make_probe):
    """Run a plant in lock-step; the probe replaces estimator and controller, and sends nothing."""
    module_suite.node('plant', {'clock': 'lockstep', 'guard_timeout': 0.3}, '/plant_alone')
    testbed = make_probe('/plant_alone')
    testbed.follow('flywheel_states', 'link_angles')
    testbed.waiting = testbed.publisher(Header, 'estimate/waiting')
    for topic in ('estimate/link_states', 'flywheel_command'):
        testbed.publisher(JointState, topic)
    testbed.wait(lambda: testbed.received['flywheel_states'])
    return testbed


def test_tick_without_an_answer_is_repeated_unchanged(plant):
    ticks, angles = plant.received['flywheel_states'], plant.received['link_angles']
    plant.wait(lambda: len(ticks) >= 3 and len(angles) >= 3)
    assert stamp_of(ticks[0]) == FIRST_NS
    for messages in (ticks, angles):
        assert all(message == messages[0] for message in messages)


def test_message_that_there_is_no_estimate_answers_a_tick(plant):
    ticks = plant.received['flywheel_states']
    for _ in range(20):
        stamp_ns = stamp_of(ticks[-1])
        plant.waiting.publish(at(stamp_ns, Header()))
        plant.wait(lambda last_ns=stamp_ns: stamp_of(ticks[-1]) != last_ns)
        assert stamp_of(ticks[-1]) == stamp_ns + PERIOD_NS


def test_message_about_another_tick_answers_nothing(plant):
    ticks = plant.received['flywheel_states']
    plant.catch_up()
    pending_ns = stamp_of(ticks[-1])
    for stamp_ns in (0, pending_ns - PERIOD_NS, pending_ns + PERIOD_NS):
        plant.waiting.publish(at(stamp_ns, Header()))
    begin = len(ticks)
    # The plant repeats the pending tick and makes no other one.
    plant.wait(lambda: len(ticks) > begin)
    assert stamp_of(ticks[-1]) == pending_ns


@pytest.fixture(scope='module')
def estimator(module_suite, make_probe):
    """Run an estimator; the probe replaces its plant."""
    module_suite.node('estimator', {'use_sim_time': True}, '/estimator_alone')
    testbed = make_probe('/estimator_alone')
    testbed.follow('estimate/waiting', kind=Header)
    testbed.follow('estimate/sigma', 'estimate/innovation', 'estimate/link_states')
    testbed.angles = testbed.publisher(JointState, 'link_angles')
    testbed.ticks = testbed.publisher(JointState, 'flywheel_states')
    testbed.wait(lambda: testbed.node.count_publishers(
        testbed.node.resolve_topic_name('estimate/waiting')))
    return testbed


def tick(stamp_ns, speeds=(0.0, 0.0, 0.0, 0.0)):
    return at(stamp_ns, JointState(name=WHEELS, position=[0.0] * 4, velocity=list(speeds),
                                   effort=[0.0] * 4))


def test_estimator_reports_at_every_tick_whether_it_has_an_estimate(estimator):
    waiting = estimator.received['estimate/waiting']
    estimates = estimator.received['estimate/link_states']
    estimator.ticks.publish(tick(FIRST_NS))
    estimator.wait(lambda: waiting)
    estimator.angles.publish(
        at(FIRST_NS + PERIOD_NS, JointState(name=LINKS, position=ANGLES)))
    estimator.ticks.publish(tick(FIRST_NS + PERIOD_NS))
    estimator.wait(lambda: estimates)
    # The tick is older than the last one, as after a restart of the plant.
    estimator.ticks.publish(tick(FIRST_NS))
    estimator.wait(lambda: len(waiting) == 2)
    assert [stamp_of(message) for message in waiting] == [FIRST_NS, FIRST_NS]
    assert [stamp_of(message) for message in estimates] == [FIRST_NS + PERIOD_NS]


def test_estimator_answers_a_repeated_tick_with_the_same_messages(estimator):
    for n in (2, 3):
        estimator.angles.publish(at(FIRST_NS + n * PERIOD_NS, JointState(
            name=LINKS, position=[angle + 1e-3 * n for angle in ANGLES])))
        estimator.ticks.publish(tick(FIRST_NS + n * PERIOD_NS, [float(n)] * 4))
    topics = ('estimate/link_states', 'estimate/sigma', 'estimate/innovation')
    last_ns = FIRST_NS + 3 * PERIOD_NS

    def answers(topic):
        return [message for message in estimator.received[topic] if stamp_of(message) == last_ns]
    estimator.wait(lambda: all(answers(topic) for topic in topics))
    rejected = estimator.counts('estimator_alone/estimator', 'rejected_')
    for _ in range(2):
        estimator.ticks.publish(tick(last_ns, [3.0] * 4))
    estimator.wait(lambda: all(len(answers(topic)) == 3 for topic in topics))
    for topic in topics:
        first, *others = answers(topic)
        assert all(other == first for other in others)
    assert estimator.counts('estimator_alone/estimator', 'rejected_') == rejected
