# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What an operator does over ROS: call services, send setpoints, read states."""

import time

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.common.names import CONTROLLER_STATUS, DEVICE_STATUS, FLYWHEEL_STATES, SETPOINT
from fourbar_ros.operator.service_call import ServiceCall
from fourbar_ros.ros.environment import RosError
from fourbar_ros.ros.messages import LATCHED, RELIABLE, SENSOR, stamp_of
from fourbar_ros.ros.runtime import Runtime
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

# How long a running node may need to be found, or to answer [s].
PATIENCE = 5.0


class TestbedClient:
    """
    A short-lived node; use as a context manager.

    :param ros_args: ROS arguments including `--ros-args`, for namespace and remapping.
    """

    def __init__(self, ros_args=()):
        self.runtime = Runtime(ros_args)
        self.node = Node('operator', enable_rosout=False, start_parameter_services=False)
        self.runtime.executor.add_node(self.node)
        self.statuses = {}
        self.joints = {}
        self._followed = {}
        self._setpoints = None

    def __enter__(self):
        """Return the client."""
        return self

    def __exit__(self, *_):
        """End ROS in this process."""
        self.runtime.shut_down(self.node)

    def wait(self, condition, seconds=PATIENCE, missing=None):
        """
        Run callbacks until a condition holds.

        :param missing: what to say if it does not hold in time; None to return False instead.
        :raises RosError: with `missing`.
        :raises KeyboardInterrupt: a signal came.
        """
        end = time.monotonic() + seconds
        while True:
            # First: what a callback has failed at may be all that the condition waits for.
            if self.runtime.failure is not None:
                raise self.runtime.failure
            if condition():
                return True
            if self.runtime.stopping:
                raise KeyboardInterrupt
            remaining = end - time.monotonic()
            if remaining <= 0.0:
                if missing is None:
                    return False
                raise RosError(f'{missing} within {seconds:g} s')
            self.runtime.executor.spin_once(timeout_sec=min(0.05, remaining))

    def follow(self, *topics):
        """Keep the newest status of `device_status` or `controller_status` in `statuses`."""
        def keep(topic, message):
            self.statuses[topic] = {item.key: item.value for item in message.values}
        self._subscribe(topics, DiagnosticStatus, LATCHED, keep)

    def follow_joints(self, *topics):
        """Keep the newest JointState of each topic in `joints`."""
        self._subscribe(topics, JointState, SENSOR, self.joints.__setitem__)

    def _subscribe(self, topics, kind, quality, keep):
        """Subscribe to those that are not followed yet, and hand on topic and message."""
        def keeping(topic):
            # Callbacks with a default argument would get more than the message.
            return lambda message: keep(topic, message)
        for topic in topics:
            if topic not in self._followed:
                self._followed[topic] = self.node.create_subscription(
                    kind, topic, self.runtime.guard(keeping(topic)), quality)

    def leave_joints(self, *topics):
        """Follow these topics no longer; what was last heard stays in `joints`."""
        for topic in topics:
            self.node.destroy_subscription(self._followed.pop(topic))

    def stamp_ns(self, topic=FLYWHEEL_STATES):
        """Return the newest stamp of a followed topic [ns], None before the first."""
        return stamp_of(self.joints[topic]) if topic in self.joints else None

    def positions(self, topic, names):
        """Return the newest positions of some joints of a followed topic."""
        message = self.joints[topic]
        return [message.position[message.name.index(name)] for name in names]

    def device_visible(self):
        """Tell whether any device publishes its status here."""
        return self.node.count_publishers(self.node.resolve_topic_name(DEVICE_STATUS)) > 0

    def recorded(self, topics):
        """Tell whether a recorder subscribes to all of these topics."""
        return all(
            any(info.node_name == 'recorder' for info in
                self.node.get_subscriptions_info_by_topic(self.node.resolve_topic_name(topic)))
            for topic in topics)

    def call(self, kind, service, request, patience=PATIENCE, of='device'):
        """
        Call a service, again if no answer comes and that does no harm.

        :param kind: its type.
        :param of: who offers it, to say who is missing.
        :returns: success and message of the response.
        :raises RosError: nobody offers it, or nobody answers.
        """
        client = self.node.create_client(kind, service)
        name = self.node.resolve_service_name(service)
        self.wait(client.service_is_ready, patience,
                  f'no {of} found: service {name} did not appear')
        question = ServiceCall(client, service, request)
        self.wait(question.answered, patience, f'no answer from service {name}')
        self.node.destroy_client(client)
        return question.response.success, question.response.message

    def switch(self, service, wanted, of='device'):
        """Call a service that takes yes or no, `arm` or `sim/pause`: success and message."""
        return self.call(SetBool, service, SetBool.Request(data=wanted), of=of)

    def trigger(self, service, of='device'):
        """Call a service without arguments: success and message."""
        return self.call(Trigger, service, Trigger.Request(), of=of)

    def offer_setpoints(self):
        """Become a publisher of setpoints, so that others can find it before the first one."""
        if self._setpoints is None:
            self._setpoints = self.node.create_publisher(JointState, SETPOINT, RELIABLE)

    def setpoint(self, names, positions):
        """
        Send a setpoint and wait for the controller's verdict.

        :returns: whether it was accepted, and why not.
        :raises RosError: no device, no controller, or no verdict.
        """
        self.follow(CONTROLLER_STATUS)
        self.follow_joints(FLYWHEEL_STATES)
        self.offer_setpoints()
        self.wait(lambda: self.stamp_ns() is not None,
                  missing='no device found: no flywheel_states came')
        self.wait(lambda: (self.node.count_subscribers(self._setpoints.topic_name) > 0
                           and CONTROLLER_STATUS in self.statuses),
                  missing='no controller found: nobody takes setpoint')
        # The newest tick is a stamp that nobody can call stale, and tells our verdict from others.
        stamp_ns = self.stamp_ns()
        message = JointState(name=list(names), position=list(positions))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        refused = self.statuses[CONTROLLER_STATUS]['refused']
        self._setpoints.publish(message)
        self.wait(lambda: self.statuses[CONTROLLER_STATUS]['judged_stamp_ns'] == str(stamp_ns),
                  missing='no verdict from the controller')
        status = self.statuses[CONTROLLER_STATUS]
        return status['refused'] == refused, status['last_refusal']
