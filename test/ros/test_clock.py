# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Simulated time over topics: lock-step with three nodes, its guard, and the fast clock."""

import os
import signal
import time

from diagnostic_msgs.msg import DiagnosticArray
import pytest
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

pytestmark = pytest.mark.node

PERIOD_NS = 4_000_000
FIRST_NS = 1_000_000_000
SIMULATED = {'use_sim_time': True}
LOCKSTEP = {**SIMULATED, 'clock': 'lockstep', 'guard_timeout': 0.5}


def stamps(messages):
    return [message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            for message in messages]


def distinct(messages):
    """Return the stamps without repetitions: unanswered ticks and their answers are repeated."""
    return list(dict.fromkeys(stamps(messages)))


def pause(testbed, wanted=True):
    response = testbed.call(SetBool, 'sim/pause', SetBool.Request(data=wanted))
    assert response.success
    return response


def assert_no_tick_is_missing(testbed, plant):
    """
    Pause, and compare the number of ticks of the plant with the stamp of the last one.

    The stamps alone do not suffice: publishers keep ten messages, and a delayed probe misses some.
    """
    pause(testbed)
    count, = [int(item.value) for item in testbed.diagnostics(plant).values if item.key == 'ticks']
    last_ns = FIRST_NS + (count - 1) * PERIOD_NS
    testbed.wait(lambda: stamps(testbed.received['flywheel_states'])[-1] == last_ns)
    for stamp in distinct(testbed.received['flywheel_states']):
        assert (stamp - FIRST_NS) % PERIOD_NS == 0


def wait_for_summary(testbed, node, text):
    return testbed.diagnostics(node, lambda status: text in status.message)


@pytest.fixture
def nodes(make_probe, suite, request):
    """Return a function that starts the three nodes in lock-step in a namespace of the test."""
    def start(*names, **plant):
        namespace = f'/{request.node.name.split("[")[0]}'
        testbed = make_probe(namespace)
        testbed.follow('flywheel_states', 'flywheel_command')
        return namespace, testbed, {
            name: suite.node(name, {**LOCKSTEP, **plant} if name == 'plant' else SIMULATED,
                             namespace) for name in names}
    return start


@pytest.mark.parametrize('order', [
    ('plant', 'estimator', 'controller'),
    pytest.param(('controller', 'estimator', 'plant'), marks=pytest.mark.slow)],
    ids=lambda o: o[0])
def test_every_tick_is_answered_before_the_next(nodes, order):
    """No tick is missing from the first one on, in any order of start."""
    namespace, testbed, _ = nodes(*order)
    testbed.follow('estimate/link_states')
    testbed.wait(lambda: len(testbed.received['flywheel_command']) >= 1000)
    assert_no_tick_is_missing(testbed, f'{namespace[1:]}/plant')
    assert distinct(testbed.received['flywheel_states'])[0] == FIRST_NS
    last_ns = stamps(testbed.received['flywheel_states'])[-1]
    for answer in ('estimate/link_states', 'flywheel_command'):
        answers = testbed.received[answer]
        testbed.wait(lambda found=answers: stamps(found)[-1] == last_ns)
        assert stamps(answers) == sorted(stamps(answers))


def test_guard_names_the_stopped_node_and_time_waits(nodes):
    _, testbed, processes = nodes('plant', 'estimator', 'controller')
    testbed.wait(lambda: len(testbed.received['flywheel_command']) >= 100)
    assert testbed.arm().success
    plant = f'{testbed.node.get_namespace()[1:]}/plant'
    for name in ('estimator', 'controller'):
        pid = processes[name].popen.pid
        os.kill(pid, signal.SIGSTOP)
        try:
            wait_for_summary(testbed, plant, f'waiting for {name}: no ')
            testbed.catch_up()
            last = stamps(testbed.received['flywheel_states'])[-1]
            testbed.diagnostics(plant)
            # Simulated time stops, so no command timeout passes: the plant stays armed and waits.
            assert stamps(testbed.received['flywheel_states'])[-1] == last
            assert testbed.state() == 'armed' or testbed.status('device_status', state='armed')
        finally:
            os.kill(pid, signal.SIGCONT)
        testbed.more('flywheel_states', 100)
        wait_for_summary(testbed, plant, 'armed')
    assert_no_tick_is_missing(testbed, plant)


@pytest.mark.slow
@pytest.mark.parametrize('name', ['controller', 'estimator'])
def test_loop_continues_disarmed_after_the_restart_of_a_node(nodes, suite, name):
    namespace, testbed, processes = nodes('plant', 'estimator', 'controller')
    testbed.wait(lambda: len(testbed.received['flywheel_command']) >= 100)
    assert testbed.arm().success
    plant = f'{namespace[1:]}/plant'
    assert processes[name].end(signal.SIGINT) == 0
    topic = {'controller': 'flywheel_command', 'estimator': 'estimate/link_states'}[name]
    status = wait_for_summary(
        testbed, plant, f'waiting for {name}: {topic} has no publisher')
    assert status.level != b'\x00'
    suite.node(name, SIMULATED, namespace)
    assert 'joined' in testbed.status('device_status', state='disarmed')['reason']
    testbed.more('flywheel_command', 100)
    assert_no_tick_is_missing(testbed, plant)


def test_missing_controller_is_reported_and_no_tick_is_lost(nodes):
    namespace, testbed, _ = nodes('plant')
    wait_for_summary(testbed, f'{namespace[1:]}/plant', 'waiting for controller')
    assert testbed.received['flywheel_states'] == []


def test_rejected_answers_advance_time_until_the_command_timeout(nodes):
    """Rejected commands disarm the plant after `command_timeout` of simulated time."""
    _, testbed, _ = nodes('plant', command_timeout=0.1)
    testbed.drive([0.0] * 4)
    testbed.wait(lambda: len(testbed.received['flywheel_states']) >= 50)
    assert testbed.arm().success
    testbed.status('device_status', state='armed')
    testbed.more('flywheel_states', 50)
    pause(testbed)
    testbed.drive([float('nan')] * 4)
    pause(testbed, False)
    status = testbed.status('device_status', state='disarmed')
    assert status['reason'] == 'no flywheel_command for 0.1 s'
    rejected = testbed.diagnostics(
        f'{testbed.node.get_namespace()[1:]}/plant', lambda status: 'rejected' in status.message)
    count, = [int(item.value) for item in rejected.values
              if item.key == 'commands_rejected_finite']
    assert count >= 25


@pytest.mark.slow
@pytest.mark.parametrize('clock', ['fast', 'lockstep'])
def test_clock_topic_is_monotonic_with_a_limited_rate(nodes, clock):
    """A late subscriber receives at most 200 messages per second, and time never decreases."""
    namespace, testbed, _ = nodes('plant', clock=clock, real_time_factor=20.0)
    testbed.drive([0.0] * 4)
    testbed.wait(lambda: len(testbed.received['flywheel_states']) >= 500)
    times = testbed.follow('/clock', kind=Clock)

    def clock_ns():
        return [now.clock.sec * 1_000_000_000 + now.clock.nanosec for now in times]
    # Discovery may take longer than the measurement; messages queued until then do not count.
    testbed.wait(lambda: times)
    testbed.catch_up()
    begin, before = time.monotonic(), len(times)
    testbed.more('flywheel_states', 3000)
    pause(testbed)
    testbed.catch_up()
    last_ns = stamps(testbed.received['flywheel_states'])[-1]
    # A paused clock shows the last tick or the next one, which is due.
    testbed.wait(lambda: 0 <= clock_ns()[-1] - last_ns <= PERIOD_NS)
    count, elapsed = len(times) - before, time.monotonic() - begin
    assert clock_ns() == sorted(clock_ns())
    assert FIRST_NS < clock_ns()[0]
    # At least ten messages a second; queued messages may arrive together.
    assert 10 * elapsed < count < 200 * elapsed + 20
    arrays = testbed.follow('/diagnostics', kind=DiagnosticArray)
    testbed.diagnostics(f'{namespace[1:]}/plant')
    # The stamp is simulated time, not system time.
    assert arrays[-1].header.stamp.sec < 10 ** 6


@pytest.mark.slow
def test_fast_clock_is_faster_than_real_time_and_skips_no_tick(nodes):
    """The module test_clock_modes tests the ratio; here a busy machine may lag and catch up."""
    namespace, testbed, _ = nodes('plant', clock='fast', real_time_factor=2.0)
    testbed.wait(lambda: len(testbed.received['flywheel_states']) >= 10)
    begin = testbed.node.get_clock().now().nanoseconds
    ticks = stamps(testbed.more('flywheel_states', 1000))
    elapsed = testbed.node.get_clock().now().nanoseconds - begin
    assert ticks == sorted(ticks)
    assert 1.0 < (ticks[-1] - ticks[0]) / elapsed < 2.5
    assert_no_tick_is_missing(testbed, f'{namespace[1:]}/plant')


def test_real_time_has_no_clock_topic(nodes):
    _, testbed, _ = nodes('plant', clock='realtime', use_sim_time=False)
    testbed.newest('flywheel_states')
    assert testbed.node.count_publishers('/clock') == 0


def test_estimator_subscribes_reliably_under_simulated_time(nodes, suite):
    namespace, testbed, _ = nodes('estimator')
    suite.node('controller', {}, namespace)

    def found():
        return sorted((info.node_name, info.qos_profile.reliability.name)
                      for info in testbed.node.get_subscriptions_info_by_topic(
                          f'{namespace}/flywheel_states') if info.node_name != 'probe')
    # Discovery reports the name of a node after its subscriptions.
    testbed.wait(lambda: {name for name, _ in found()} == {'estimator', 'controller'})
    assert found() == [('controller', 'BEST_EFFORT'), ('estimator', 'RELIABLE')]
