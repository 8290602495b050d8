# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Ticks: one per period, after the samples, answered once, with stamps on a grid."""

from collections import Counter
import os
import signal

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

PERIOD_NS = 5_000_000
OF_THE_TICK = ('link_angles', 'timing', 'sim/link_states', 'sim/flywheel_states')
ANSWERS = ('estimate/link_states', 'estimate/sigma', 'estimate/innovation', 'reference',
           'tracking_error', 'energy', 'flywheel_command')


def stamp_of(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def stamps(messages):
    return [stamp_of(message) for message in messages]


@pytest.fixture(scope='module')
def nodes(module_suite):
    return module_suite.nodes(plant={'rate': 200})


@pytest.fixture(scope='module')
def testbed(nodes, probe):
    probe.follow('flywheel_states', *OF_THE_TICK, *ANSWERS)
    for topic in ANSWERS:
        probe.newest(topic)
    return probe


def test_one_tick_per_period_on_a_grid(testbed):
    ticks = stamps(testbed.more('flywheel_states', 400))
    steps = [later - earlier for earlier, later in zip(ticks, ticks[1:])]
    assert all(step > 0 and step % PERIOD_NS == 0 for step in steps)
    if testbed.counts('plant', 'ticks_')['skipped'] == 0:
        assert set(steps) == {PERIOD_NS}


def test_stamps_are_system_time(testbed):
    tick = testbed.more('flywheel_states')[0]
    now = testbed.node.get_clock().now().nanoseconds
    assert 0 <= now - stamp_of(tick) < 10_000_000_000


@pytest.mark.parametrize('topic', OF_THE_TICK)
def test_device_publishes_all_its_topics_once_per_tick(testbed, topic):
    testbed.catch_up()
    begin = len(testbed.received[topic])
    ticks = set(stamps(testbed.more('flywheel_states', 100)))
    testbed.wait(lambda: stamp_of(testbed.received[topic][-1]) >= max(ticks))
    found = Counter(stamps(testbed.received[topic][max(0, begin - 100):]))
    assert {stamp: found[stamp] for stamp in ticks} == dict.fromkeys(ticks, 1)


def test_every_tick_is_answered_once_by_all(testbed):
    """A run of ticks with all answers exists, since a busy machine may lose messages of others."""
    ticks, received = testbed.received['flywheel_states'], testbed.received
    begin = {topic: len(received[topic]) for topic in (*ANSWERS, 'flywheel_states')}
    run = 200
    # A search after every message would take longer than the period of the messages.
    next_look = [begin['flywheel_states'] + run + 20]

    def all_answered():
        if len(ticks) < next_look[0]:
            return False
        next_look[0] = len(ticks) + 20
        answered = [set(stamps(received[topic][-10 * run:])) for topic in ANSWERS]
        newest = stamps(ticks[-run - 20:-20])
        return all(set(newest) <= those for those in answered)
    testbed.wait(all_answered)
    known = set(stamps(ticks))
    for topic in ANSWERS:
        counts = Counter(stamps(received[topic][begin[topic]:]))
        assert set(counts.values()) == {1}
        assert set(counts) <= known


def test_tick_is_sent_after_the_samples_that_belong_to_it(domain, nodes):
    """The middleware stamps every message when it is sent."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node('listener', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    sent = {'link_angles': {}, 'flywheel_states': {}}
    for topic, times in sent.items():
        def note(message, info, times=times):
            times[stamp_of(message)] = info['source_timestamp']
        node.create_subscription(JointState, topic, note, QoSProfile(depth=1000))
    common = set()
    while len(common) < 200:
        executor.spin_once(timeout_sec=20.0)
        common = set(sent['link_angles']) & set(sent['flywheel_states'])
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)
    assert all(sent['link_angles'][stamp] < sent['flywheel_states'][stamp] for stamp in common)


@pytest.mark.slow
def test_lost_ticks_are_counted_while_the_controller_is_stopped(nodes, testbed):
    def lost(message):
        return dict(zip(message.name, message.position))['lost']
    before = lost(testbed.more('timing')[0])
    pid = nodes['controller'].popen.pid
    os.kill(pid, signal.SIGSTOP)
    try:
        begin = stamp_of(testbed.more('flywheel_states')[0])
        testbed.wait(lambda: stamp_of(testbed.received['timing'][-1]) > begin + 300 * PERIOD_NS)
        silent = testbed.received['timing'][-1]
        assert lost(silent) - before >= 250
        assert 'round_trip_s' not in silent.name
        age = dict(zip(silent.name, silent.position))['command_age_s']
        assert 1.0 < age < 60.0
    finally:
        os.kill(pid, signal.SIGCONT)
    testbed.wait(lambda: 'round_trip_s' in testbed.received['timing'][-1].name)
    run = 100

    def all_answered_again():
        newest = [lost(message) for message in testbed.received['timing'][-run:]]
        return newest[0] == newest[-1]
    testbed.more('timing', run)
    testbed.wait(all_answered_again)


def test_period_that_is_no_multiple_of_the_step_is_refused(suite):
    plant = suite.node('plant', {'rate': 300.0})
    assert plant.end() == 2
    line, = plant.stderr.splitlines()
    assert 'whole multiple' in line
