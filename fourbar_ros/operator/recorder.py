# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Record topics into a rosbag2 directory (MCAP), for machines that have no ``ros2 bag``.

Messages are taken off the wire as bytes and written as they are. The bag keeps the quality of
service each publisher offered, so that ``ros2 bag play`` sends latched topics latched.
"""

from functools import partial
import importlib
import time

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.ros.priority import step_back
from fourbar_ros.ros.runtime import Runtime, SPIN_TIMEOUT
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden
from rclpy.validate_topic_name import validate_topic_name
import rosbags.interfaces as bag
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import get_typestore, Stores, TypesysError
from tqdm import tqdm

INTERNAL_TOPICS = ('/rosout', '/parameter_events')
# A disk that stalls for seconds must not cost a message: a closed loop sends 3000 a second.
QUEUE_DEPTH = 10_000
GRAPH_POLL_S = 0.1
# What had arrived when the signal came is still in the executor's queue.
DRAIN_S = 0.3


class RecorderError(FourbarError):
    """The recording cannot start, or had to end."""


class Recorder(Node):
    """Subscribe to each topic asked for once it has a publisher; write what arrives."""

    def __init__(self, writer, topics, exclude_internal):
        super().__init__('recorder', enable_rosout=False, start_parameter_services=False)
        for topic in topics:
            validate_topic_name(topic)
        self.wanted = {self.resolve_topic_name(topic) for topic in topics}
        self.excluded = INTERNAL_TOPICS if exclude_internal else ()
        self.writer = writer
        self.counts = {}
        self.failure = None
        self._publisher_counts = {}
        self._skipped = set()
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # ROS time can stand still
        self.create_timer(GRAPH_POLL_S, self._follow_graph, clock=steady)

    def _follow_graph(self):
        for topic, types in self.get_topic_names_and_types():
            publishers = self.count_publishers(topic)
            if not publishers or topic in self._skipped or not self._is_wanted(topic):
                continue
            if topic not in self.counts:
                self._subscribe(topic, types[0])
            elif publishers > self._publisher_counts[topic]:
                self._check_late_publisher(topic)
            self._publisher_counts[topic] = publishers

    def _is_wanted(self, topic):
        unwanted = topic in self.excluded or topic_or_service_is_hidden(topic)
        return topic in self.wanted if self.wanted else not unwanted

    def _offered(self, topic):
        return [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]

    def _subscribe(self, topic, type_name):
        offered = self._offered(topic)
        package, _, name = type_name.partition('/msg/')
        try:
            message_type = getattr(importlib.import_module(package + '.msg'), name)
            connection = self.writer.add_connection(
                topic, type_name, typestore=self._typestore,
                offered_qos_profiles=[offered_qos(qos) for qos in offered])
        except (ImportError, AttributeError, TypesysError) as error:
            self._skipped.add(topic)
            tqdm.write(f'not recording {topic}: type {type_name} is unknown here ({error})')
            return
        self.counts[topic] = 0
        self.create_subscription(message_type, topic, partial(self._write, topic, connection),
                                 matching_qos(offered), raw=True)

    def _write(self, topic, connection, data):
        if self.failure:
            return
        try:
            self.writer.write(connection, time.time_ns(), data)
            self.counts[topic] += 1
        except OSError as error:  # out of a callback it would be a FATAL and a traceback
            self.failure = f'cannot write to {self.writer.path}: {error.strerror}'

    def _check_late_publisher(self, topic):
        subscribed = next(s for s in self.subscriptions if s.topic_name == topic).qos_profile
        needed = matching_qos(self._offered(topic))
        # In both enumerations of the middleware the weaker policy is the larger number.
        if (needed.reliability > subscribed.reliability
                or needed.durability > subscribed.durability):
            tqdm.write(f'not recording a late publisher of {topic}: it offers less than the first')


def matching_qos(offered):
    """Return the strongest subscription that matches every publisher (a QoSProfile each)."""
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        depth=QUEUE_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


def offered_qos(qos):
    """Convert a QoSProfile of rclpy to what rosbags writes."""
    deadline, lifespan, lease = (
        bag.QosTime(*divmod(duration.nanoseconds, 10**9))
        for duration in (qos.deadline, qos.lifespan, qos.liveliness_lease_duration))
    return bag.Qos(
        bag.QosHistory(int(qos.history)), qos.depth, bag.QosReliability(int(qos.reliability)),
        bag.QosDurability(int(qos.durability)), deadline, lifespan,
        bag.QosLiveliness(int(qos.liveliness)), lease, qos.avoid_ros_namespace_conventions)


def record(directory, topics=(), *, exclude_internal=False, ros_args=(), live=False):
    """
    Record until SIGINT, SIGTERM or SIGHUP.

    :param directory: the bag to make; nothing is made if the recording cannot start.
    :param topics: names to record, relative ones in the node's namespace; empty: all.
    :param ros_args: what follows ``--ros-args`` on the command line.
    :param live: show a running count.
    :returns: number of messages by topic.
    :raises RecorderError: it cannot start, or cannot write.
    """
    step_back()
    runtime, node = Runtime(['--ros-args', *ros_args]), None
    try:
        writer = Writer(directory, version=9, storage_plugin=StoragePlugin.MCAP)
        node = Recorder(writer, topics, exclude_internal)
        runtime.executor.add_node(node)
        with writer, tqdm(unit=' messages', disable=not live, leave=False) as progress:
            tqdm.write(f'recording to {directory}')
            _spin(runtime, node, progress)
    except InvalidTopicNameException as error:
        raise RecorderError(' '.join(str(error).rstrip(' ^\n').split())) from error
    except (WriterError, OSError) as error:
        raise RecorderError(f'cannot write {directory}: {error}') from error
    finally:
        runtime.shut_down(node)
    if node.failure:
        raise RecorderError(node.failure)
    return node.counts


def _spin(runtime, node, progress):
    while not runtime.stopping and not node.failure:
        runtime.executor.spin_once(timeout_sec=SPIN_TIMEOUT)
        progress.update(sum(node.counts.values()) - progress.n)
    end = time.monotonic() + DRAIN_S
    while time.monotonic() < end:
        runtime.executor.spin_once(timeout_sec=0.05)
