# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Quality of service, and messages that are made once and written in place."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from fourbar_ros.common.monotonic_clock import monotonic_ns
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

# Best-effort publishers are invisible to default subscribers, so everything is offered reliable.
RELIABLE = QoSProfile(depth=10)
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
SENSOR_IN_SIMULATED_TIME = QoSProfile(depth=5)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

TABLE_FRAME = 'table'

# A message on a wrong input at most so often [s].
LOG_PERIOD = 1.0

# How long a rejected message keeps a node's diagnostics at warning [s]; it stays counted.
RECENT = 10.0

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def sensor_quality(node):
    """
    Choose how to subscribe to sensor data: the newest counts, except where time waits for it.

    A lock-step stands still when a sample is lost, so with use_sim_time none may be.
    """
    simulated = node.get_parameter('use_sim_time').value
    return SENSOR_IN_SIMULATED_TIME if simulated else SENSOR


def stamp_of(message):
    """Return the stamp of a message [ns]."""
    stamp = message.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


class JointStatePublisher:
    """
    Publish a JointState with the same names every time, reusing one message.

    :param fields: those of position, velocity, effort that are used; the others stay empty.
    :param frame: in which orientations are given.
    """

    def __init__(self, node, topic, names, fields=('position', 'velocity'), frame=''):
        self._publisher = node.create_publisher(JointState, topic, RELIABLE)
        self._fields = fields
        self._message = JointState()
        self._message.header.frame_id = frame
        self._set_names(tuple(names))

    def _set_names(self, names):
        self._names = names
        self._message.name = list(names)
        for field in ('position', 'velocity', 'effort'):
            used = field in self._fields
            setattr(self._message, field, [0.0] * len(names) if used else [])
        self._views = [np.frombuffer(getattr(self._message, field)) for field in self._fields]

    def publish(self, stamp_ns, *values, names=None, fields=None):
        """
        Send one message.

        :param values: an array for each field.
        :param names, fields: instead of those given before; other fields are empty.
        """
        names = self._names if names is None else names
        fields = self._fields if fields is None else fields
        if names != self._names or fields != self._fields:
            self._fields = fields
            self._set_names(names)
        stamp = self._message.header.stamp
        stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        for view, value in zip(self._views, values):
            view[:] = value
        self._publisher.publish(self._message)


def status_message(node, hardware, level, summary, values):
    """Make a node's DiagnosticStatus; `values` is a dict of anything that has a text."""
    name = node.get_fully_qualified_name().lstrip('/')
    return DiagnosticStatus(
        level=level, name=name, message=summary, hardware_id=hardware,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])


class Diagnostics:
    """
    Publish one status on /diagnostics at 1 Hz, and at once when its summary changes.

    :param collect: returns level, summary and a dict of values.
    """

    def __init__(self, node, hardware, collect, guard):
        self._node = node
        self._hardware = hardware
        self._collect = collect
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', RELIABLE)
        self._last = None
        node.create_timer(1.0, guard(self.publish), clock=Clock(clock_type=ClockType.STEADY_TIME))

    def changed(self):
        """Publish if level or summary are not what they were."""
        if self._collect()[:2] != self._last:
            self.publish()

    def publish(self):
        """Publish now."""
        level, summary, values = self._collect()
        self._last = level, summary
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        array.status = [status_message(self._node, self._hardware, level, summary, values)]
        self._publisher.publish(array)


class Recently:
    """Tell whether a counter grew within the last RECENT seconds."""

    def __init__(self):
        self._count = 0
        self._grew_ns = None

    def grew(self, count):
        """Take the present count."""
        if count != self._count:
            self._count, self._grew_ns = count, monotonic_ns()
        return self._grew_ns is not None and monotonic_ns() - self._grew_ns < RECENT * 1e9


class RareLog:
    """Log at most once per LOG_PERIOD; rclpy's own throttle costs 0.3 ms a call."""

    def __init__(self, node):
        self._logger = node.get_logger()
        self._last_ns = None
        self._held = 0

    def warn(self, message):
        """Log, or count as held back."""
        self._write(self._logger.warning, message)

    def error(self, message):
        """Likewise, of what is worse."""
        self._write(self._logger.error, message)

    def _write(self, write, message):
        now_ns = monotonic_ns()
        if self._last_ns is not None and now_ns - self._last_ns < LOG_PERIOD * 1e9:
            self._held += 1
            return
        more = f' ({self._held} more since the last message)' if self._held else ''
        write(message + more)
        self._last_ns, self._held = now_ns, 0
