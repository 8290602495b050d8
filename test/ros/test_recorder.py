# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The recorder over DDS: the bag contains all published messages."""

import os
import signal
import subprocess
import sys
import time

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point
import pytest
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

DEADLINE_S = 20.0
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def node(domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node('publisher', context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


class Record:
    """A process of `fourbar record`, with files of its stdout and stderr."""

    def __init__(self, start, printed):
        self._out, self._err = printed / 'stdout', printed / 'stderr'
        self._out.touch()
        self._err.touch()
        self.popen = start(self._out, self._err)

    @property
    def stdout(self):
        return self._out.read_text()

    def end(self, number=None):
        """Send a signal if one is given; return exit code, stdout and stderr."""
        if number is not None:
            self.popen.send_signal(number)
        return self.popen.wait(3 * DEADLINE_S), self.stdout, self._err.read_text()


@pytest.fixture
def record(domain, fork_server, tmp_path, tmp_path_factory):
    """
    Return a function that starts `fourbar record`; running processes end with the test.

    The argument `fresh` starts it in a new interpreter.
    """
    started = []

    def start(*arguments, fresh=False, **environment):
        command, environment = ['record', *arguments], {**os.environ, **environment}

        def begin(out, err):
            if not fresh:
                return fork_server.start(command, tmp_path, out, err, environment)
            with out.open('wb') as out_file, err.open('wb') as err_file:
                return subprocess.Popen(
                    [sys.executable, '-m', 'fourbar_ros', *command], cwd=tmp_path,
                    stdout=out_file, stderr=err_file, env=environment)
        started.append(Record(begin, tmp_path_factory.mktemp('printed')))
        return started[-1]

    yield start
    for process in started:
        if process.popen.poll() is None:
            process.popen.kill()
            process.popen.wait()


@pytest.fixture
def publish(load_clock):
    """Return a function that publishes numbered messages once the recorder has subscribed."""
    def publish(publisher, count):
        load_clock.wait(lambda: publisher.get_subscription_count() == 1)
        for number in range(count):
            publisher.publish(JointState(name=['number'], position=[float(number)]))
            time.sleep(0.0005)
        # The messages are in shared memory; to wait for their acknowledgement would take seconds.
        load_clock.sleep(0.2)
    return publish


def numbers(bag, topic):
    """Return the recorded numbers of a topic, in order."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [store.deserialize_cdr(data, connection.msgtype).position[0]
                for connection, _, data in reader.messages(connections)] if connections else None


@pytest.mark.parametrize(
    'number', [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)],
    ids=lambda n: n.name)
def test_every_message_is_in_the_bag_after_a_signal(node, record, tmp_path, number, publish):
    first, second = (node.create_publisher(JointState, name, 10) for name in ('one', 'two'))
    process = record('-o', 'bag', fresh=number == signal.SIGINT)
    publish(first, 700)
    publish(second, 300)
    assert first.wait_for_all_acked(Duration(seconds=5))
    assert second.wait_for_all_acked(Duration(seconds=5))

    code, out, err = process.end(number)

    assert (code, err) == (0, '')
    assert out.splitlines()[0] == 'recording to bag'
    assert '1000 messages' in out.splitlines()[-1]
    assert numbers(tmp_path / 'bag', '/one') == list(range(700))
    assert numbers(tmp_path / 'bag', '/two') == list(range(300))


def test_topics_that_appear_later_are_recorded(node, record, tmp_path, publish):
    early = node.create_publisher(JointState, 'early', 10)
    process = record('-o', 'bag')
    publish(early, 1)

    publish(node.create_publisher(JointState, 'late', 10), 50)

    assert process.end(signal.SIGINT)[0] == 0
    assert numbers(tmp_path / 'bag', '/late') == list(range(50))


def test_latched_message_from_before_is_recorded_as_latched(node, record, tmp_path, load_clock):
    latched = node.create_publisher(DiagnosticStatus, 'status', LATCHED)
    latched.publish(DiagnosticStatus(message='armed'))
    weak = node.create_publisher(
        JointState, 'weak', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    process = record('-o', 'bag')
    load_clock.wait(lambda: latched.get_subscription_count() and weak.get_subscription_count())
    load_clock.sleep(0.5)

    assert process.end(signal.SIGINT)[0] == 0

    with Reader(tmp_path / 'bag') as reader:
        status = reader.topics['/status']
        offered = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert status.msgcount == 1
    assert offered['/status'].durability == QosDurability.TRANSIENT_LOCAL
    assert offered['/weak'].durability == QosDurability.VOLATILE
    assert offered['/weak'].reliability == QosReliability.BEST_EFFORT


def test_named_topics_follow_the_namespace(node, record, tmp_path, publish):
    publishers = [node.create_publisher(JointState, name, 10)
                  for name in ('/lab/wanted', '/absolute', '/wanted', '/lab/other')]
    process = record('-o', 'bag', 'wanted', '/absolute', '--ros-args', '-r', '__ns:=/lab')
    for publisher in publishers[:2]:
        publish(publisher, 3)

    assert process.end(signal.SIGINT)[0] == 0

    with Reader(tmp_path / 'bag') as reader:
        assert set(reader.topics) == {'/lab/wanted', '/absolute'}


@pytest.mark.parametrize('internal', [True, False])
def test_internal_topics_can_be_left_out(node, record, tmp_path, internal, publish):
    publisher = node.create_publisher(JointState, 'one', 10)
    node.create_publisher(JointState, '_hidden', 10)
    process = record('-o', 'bag', *([] if internal else ['--exclude-internal']))
    publish(publisher, 1)

    assert process.end(signal.SIGINT)[0] == 0

    with Reader(tmp_path / 'bag') as reader:
        assert ('/rosout' in reader.topics) == internal
        assert '/_hidden' not in reader.topics


def test_type_that_cannot_be_imported_is_named_once_and_the_rest_recorded(
        node, record, tmp_path, publish):
    (tmp_path / 'shadow' / 'geometry_msgs').mkdir(parents=True)
    (tmp_path / 'shadow' / 'geometry_msgs' / '__init__.py').touch()
    node.create_publisher(Point, 'foreign', 10)
    publisher = node.create_publisher(JointState, 'one', 10)
    path = os.pathsep.join([str(tmp_path / 'shadow'), os.environ.get('PYTHONPATH', '')])
    process = record('-o', 'bag', fresh=True, PYTHONPATH=path)
    publish(publisher, 500)

    code, out, _ = process.end(signal.SIGINT)

    assert code == 0
    assert [line for line in out.splitlines() if '/foreign' in line] == [
        line for line in out.splitlines() if 'geometry_msgs/msg/Point' in line]
    assert out.count('/foreign') == 1
    assert numbers(tmp_path / 'bag', '/one') == list(range(500))


def test_recording_without_messages_makes_a_bag(record, tmp_path, load_clock):
    process = record('-o', 'bag')
    load_clock.wait(lambda: process.stdout.startswith('recording to bag\n'))

    assert process.end(signal.SIGINT)[0] == 0

    with Reader(tmp_path / 'bag') as reader:
        assert reader.message_count == 0


@pytest.mark.parametrize(('arguments', 'environment', 'complaint'), [
    (['-o', 'taken'], {}, 'exists'),
    (['-o', 'file/bag'], {}, 'not a directory'),
    (['-o', 'bag', 'no topic!'], {}, 'topic'),
    (['-o', 'bag'], {'ROS_DOMAIN_ID': '999'}, 'ROS_DOMAIN_ID'),
])
def test_bad_input_is_one_line_and_leaves_no_file(record, tmp_path, arguments, environment,
                                                  complaint):
    (tmp_path / 'taken').mkdir()
    (tmp_path / 'file').touch()

    process = record(*arguments, **environment)
    code, out, err = process.end()

    assert code == 2
    assert out == ''
    assert len(err.splitlines()) == 1
    assert complaint in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ['file', 'taken']
