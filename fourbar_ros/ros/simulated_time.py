# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated plant's time over ROS: /clock, and who a lock-step waits for."""

import struct

from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.device import (
    ClockLimit,
    LockstepGuard,
    Participants,
)
from fourbar_ros.ros.messages import RareLog, RELIABLE
from rclpy.clock import Clock, ClockType
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

# Simulated time is told at most so often, and at least so often for those who come later [ns].
CLOCK_NS = 5_000_000
IDLE_CLOCK_NS = 50_000_000

# How often to look who is there [ns], and how long nodes need to find each other [ns].
LOOK_NS = 50_000_000
SETTLE_NS = 500_000_000

# Where a serialized message keeps its stamp: after the four bytes that tell the byte order.
SERIALIZED_STAMP = struct.Struct('<4xiI')


class SimulatedClock:
    """Publish simulated time; nothing here runs on it."""

    def __init__(self, node, pace, guard):
        self._pace = pace
        self._limit = ClockLimit(CLOCK_NS)
        self._message = ClockMessage()
        self._publisher = node.create_publisher(ClockMessage, '/clock', RELIABLE)
        # Somebody who starts while time stands still must learn it too.
        node.create_timer(IDLE_CLOCK_NS * 1e-9, guard(self.tell),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def tell(self):
        """Publish the time, unless it was told a moment ago."""
        now_ns = monotonic_ns()
        if self._limit.passes(now_ns):
            stamp = self._message.clock
            stamp.sec, stamp.nanosec = divmod(self._pace.now_ns(now_ns), 1_000_000_000)
            self._publisher.publish(self._message)


class Lockstep:
    """
    Look who is there to answer ticks, and report who is late.

    :param on_late: called as long as somebody is late, with what helps.
    :param advance: called when there will be no command for the tick, and none is needed.
    """

    def __init__(self, node, pace, guard, timeout_ns, on_late, advance):
        self._node = node
        self._pace = pace
        self._advance = advance
        self._log = RareLog(node)
        self._guard = LockstepGuard(pace, timeout_ns, SETTLE_NS)
        self._on_late = on_late
        self._reported = ''
        self._estimate = None
        # Raw, since only the last one is ever looked into, and only when somebody is late.
        node.create_subscription(
            JointState, 'estimate/link_states', guard(self._on_estimate), RELIABLE, raw=True)
        node.create_subscription(Header, 'estimate/waiting', guard(self._on_waiting), RELIABLE)
        node.create_timer(LOOK_NS * 1e-9, guard(self._look),
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    def awaited(self):
        """Tell for whom a tick has waited too long, '' for nobody."""
        return self._guard.awaited(self._estimate_ns(), monotonic_ns())

    def _on_waiting(self, message):
        # Without an estimate the controller has nothing to command, at this tick.
        if self._pace.answered(message.stamp.sec * 1_000_000_000 + message.stamp.nanosec):
            self._advance()

    def _on_estimate(self, serialized):
        self._estimate = serialized

    def _estimate_ns(self):
        if self._estimate is None:
            return None
        seconds, nanoseconds = SERIALIZED_STAMP.unpack_from(self._estimate)
        return seconds * 1_000_000_000 + nanoseconds

    def _look(self):
        node, now_ns = self._node, monotonic_ns()

        def publishers(topic):
            return node.get_publishers_info_by_topic(node.resolve_topic_name(topic))

        def subscribers(topic):
            return node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic))

        def name(info):
            return info.node_namespace, info.node_name
        commanders = publishers('flywheel_command')
        names = set(map(name, commanders))
        self._guard.look(Participants(
            len(subscribers('flywheel_states')), len(subscribers('link_angles')),
            len(commanders), len(publishers('estimate/link_states')),
            # Those who only look on need no estimator.
            sum(name(info) in names for info in subscribers('estimate/link_states'))), now_ns)
        awaited = self.awaited()
        if awaited and awaited != self._reported:
            self._log.warn(f'lock-step waits for the {awaited}')
        if awaited or self._reported:
            self._on_late(self._guard.remedy(self._estimate_ns(), now_ns))
        self._reported = awaited
