# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Record topics into a rosbag2 directory (MCAP), for machines that have no ``ros2 bag``.

The recorder subscribes to serialized messages and writes them unchanged. The bag keeps the quality
of service that each publisher offers, so that ``ros2 bag play`` publishes latched topics latched.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
import importlib
from pathlib import Path
import time
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.ros.environment import lower_priority
from fourbar_ros.ros.runtime import Runtime
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
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
# Messages per topic that wait for a slow disk; a closed loop publishes 3000 a second in all.
QUEUE_DEPTH = 10_000
# Period of the search for new topics [s].
GRAPH_POLL_S = 0.1
# Time after a signal for the messages in the queue of the executor [s].
DRAIN_S = 0.3


class RecorderError(FourbarError):
    """The recording cannot start or go on."""


class Recorder(Node):
    """
    Subscribes to each requested topic once it has a publisher, and writes its messages.

    :ivar counts: number of messages by topic.
    :ivar failure: why writing failed, '' if it did not.
    """

    def __init__(self, writer: Writer, topics: Sequence[str], exclude_internal: bool) -> None:
        super().__init__('recorder', enable_rosout=False, start_parameter_services=False)
        for topic in topics:
            validate_topic_name(topic)
        self.requested = {self.resolve_topic_name(topic) for topic in topics}
        self.excluded = INTERNAL_TOPICS if exclude_internal else ()
        self.writer = writer
        self.counts: dict[str, int] = {}
        self.failure = ''
        self._publisher_counts: dict[str, int] = {}
        self._skipped: set[str] = set()
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # ROS time can stand still
        self.create_timer(GRAPH_POLL_S, self._check_graph, clock=steady)

    def _check_graph(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            publishers = self.count_publishers(topic)
            if not publishers or topic in self._skipped or not self._is_requested(topic):
                continue
            if topic not in self.counts:
                self._subscribe(topic, types[0])
            elif publishers > self._publisher_counts[topic]:
                self._check_late_publisher(topic)
            self._publisher_counts[topic] = publishers

    def _is_requested(self, topic: str) -> bool:
        if self.requested:
            return topic in self.requested
        return topic not in self.excluded and not topic_or_service_is_hidden(topic)

    def _offered(self, topic: str) -> list[QoSProfile]:
        return [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]

    def _subscribe(self, topic: str, type_name: str) -> None:
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

    def _write(self, topic: str, connection: Any, data: bytes) -> None:
        if self.failure:
            return
        try:
            self.writer.write(connection, time.time_ns(), data)
            self.counts[topic] += 1
        except OSError as error:  # leaving a callback it would print FATAL and a traceback
            self.failure = f'cannot write to {self.writer.path}: {error.strerror}'

    def _check_late_publisher(self, topic: str) -> None:
        subscribed = next(s for s in self.subscriptions if s.topic_name == topic).qos_profile
        needed = matching_qos(self._offered(topic))
        # In both enumerations of the middleware the weaker policy has the larger number.
        if (needed.reliability > subscribed.reliability
                or needed.durability > subscribed.durability):
            tqdm.write(f'not recording a late publisher of {topic}: its quality of service is '
                       'weaker than that of the first')


def matching_qos(offered: Sequence[QoSProfile]) -> QoSProfile:
    """Return the strongest quality of service of a subscription to all of these publishers."""
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        depth=QUEUE_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


def offered_qos(qos: QoSProfile) -> bag.Qos:
    """Convert a QoSProfile of rclpy to that of rosbags."""
    deadline, lifespan, lease = (
        bag.QosTime(*divmod(duration.nanoseconds, 10**9))
        for duration in (qos.deadline, qos.lifespan, qos.liveliness_lease_duration))
    return bag.Qos(
        bag.QosHistory(int(qos.history)), qos.depth, bag.QosReliability(int(qos.reliability)),
        bag.QosDurability(int(qos.durability)), deadline, lifespan,
        bag.QosLiveliness(int(qos.liveliness)), lease, qos.avoid_ros_namespace_conventions)


def record(directory: Path, topics: Sequence[str] = (), *, exclude_internal: bool = False,
           ros_args: Sequence[str] = (), live: bool = False) -> dict[str, int]:
    """
    Record until SIGINT, SIGTERM or SIGHUP.

    :param directory: the new bag; not created if the recording cannot start.
    :param topics: names, relative ones in the namespace of the node; empty for all.
    :param ros_args: arguments after ``--ros-args``.
    :param live: show the number of messages.
    :returns: number of messages by topic.
    :raises RecorderError: the recording cannot start, or the bag cannot be written.
    """
    lower_priority()
    runtime = Runtime(['--ros-args', *ros_args])
    node: Recorder | None = None
    try:
        writer = Writer(directory, version=9, storage_plugin=StoragePlugin.MCAP)
        node = Recorder(writer, topics, exclude_internal)
        runtime.executor.add_node(node)
        with writer, tqdm(unit=' messages', disable=not live, leave=False) as progress:
            tqdm.write(f'recording to {directory}')
            _record_until_signal(runtime, node, progress)
    except InvalidTopicNameException as error:
        raise RecorderError(' '.join(str(error).rstrip(' ^\n').split())) from error
    except (WriterError, OSError) as error:
        raise RecorderError(f'cannot write {directory}: {error}') from error
    finally:
        runtime.shut_down(node)
    if node.failure:
        raise RecorderError(node.failure)
    return node.counts


def _record_until_signal(runtime: Runtime, node: Recorder, progress: Any) -> None:
    while not runtime.stopping and not node.failure:
        runtime.spin_once()
        progress.update(sum(node.counts.values()) - progress.n)
    end = time.monotonic() + DRAIN_S
    while time.monotonic() < end:
        runtime.spin_once(0.05)
