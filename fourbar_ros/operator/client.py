# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A node of an operator: calls services, sends setpoints, and reads states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.common.names import (
    ARM,
    CONTROLLER_STATUS,
    DAMP,
    DEVICE_STATUS,
    EMERGENCY_STOP,
    ENABLE,
    ESTIMATE_RESET,
    FLYWHEEL_STATES,
    HOLD,
    SETPOINT,
    SIM_PAUSE,
    SIM_RESET,
)
from fourbar_ros.ros.environment import RosError
from fourbar_ros.ros.messages import LATCHED, RELIABLE, SENSOR, stamp_of, write_stamp
from fourbar_ros.ros.runtime import Runtime
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

# Longest wait for the discovery of a running node, or for its answer [s].
TIMEOUT = 5.0
# Retry interval of a service call [s].
RETRY_INTERVAL = 1.0
# Delay of a call that must not be retried, in which the server discovers the client [s].
DISCOVERY_DELAY = 0.2
# Longest time between two checks of a condition [s].
POLL_INTERVAL = 0.05
# Services that may be retried: a second call has no further effect.
#
# Not among them: sim/step; and arming, enabling and releasing a stop, because another operator may
# have disarmed or stopped the device between the two calls.
IDEMPOTENT = frozenset({DAMP, EMERGENCY_STOP, ESTIMATE_RESET, HOLD, SIM_PAUSE, SIM_RESET})
# Services that may be retried with the argument false.
IDEMPOTENT_IF_FALSE = frozenset({ARM, ENABLE})


class ServiceCall:
    """
    A request to a service, with retry.

    A server drops its response to a client that it has not discovered yet, and a client discovers
    the server before that (ros2/rmw_fastrtps, issue 842). So the first request may be executed
    without a response.

    :param client: of a service that is ready.
    :param service: relative name; one that is not idempotent is called once, after a delay.
    """

    def __init__(self, client: Any, service: str, request: Any) -> None:
        self._client = client
        self._request = request
        retry = service in IDEMPOTENT or service in IDEMPOTENT_IF_FALSE and not request.data
        self._interval = RETRY_INTERVAL if retry else inf
        self._due = time.monotonic() + (0.0 if retry else DISCOVERY_DELAY)
        self._futures: list[Any] = []

    def poll(self) -> bool:
        """Return whether a response arrived; send the request if it is due."""
        now = time.monotonic()
        if self._done() is None and now >= self._due:
            self._futures.append(self._client.call_async(self._request))
            self._due = now + self._interval
        return self._done() is not None

    @property
    def response(self) -> Any:
        """The response, once there is one."""
        return self._done().result()

    def _done(self) -> Any:
        # To any of the requests: a response may be late and not lost.
        return next((future for future in self._futures if future.done()), None)


class TestbedClient:
    """
    The node of an operator, and the context manager of its process.

    :param ros_args: arguments of ROS including `--ros-args`, for namespace and remapping.
    :ivar statuses: values of the newest message of each subscribed status, by topic.
    :ivar joint_states: newest message of each subscribed JointState, by topic.
    """

    def __init__(self, ros_args: Sequence[str] = ()) -> None:
        self.runtime = Runtime(ros_args)
        self.node = Node('operator', enable_rosout=False, start_parameter_services=False)
        self.runtime.executor.add_node(self.node)
        self.statuses: dict[str, dict[str, str]] = {}
        self.joint_states: dict[str, Any] = {}
        self._subscribed: dict[str, Any] = {}
        self._setpoints: Any = None

    def __enter__(self) -> TestbedClient:
        """Return the client."""
        return self

    def __exit__(self, *_: object) -> None:
        """Shut ROS down in this process."""
        self.runtime.shut_down(self.node)

    def wait(self, condition: Callable[[], object], seconds: float = TIMEOUT,
             missing: str | None = None) -> bool:
        """
        Run callbacks until a condition holds.

        :param seconds: longest wait [s]; time in which a busy machine does not run this process
            does not count.
        :param missing: message of the error at a timeout; None to return False instead.
        :returns: whether the condition holds.
        :raises RosError: timeout.
        :raises KeyboardInterrupt: a signal arrived.
        """
        end = time.monotonic() + seconds
        while True:
            # Before the condition, which may wait for what a failed callback did not do.
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
                raise RosError(f'{missing} within {seconds:g} s', limit=seconds)
            begin, timeout = time.monotonic(), min(POLL_INTERVAL, remaining)
            self.runtime.spin_once(timeout)
            end += max(0.0, time.monotonic() - begin - timeout)

    def subscribe_statuses(self, *topics: str) -> None:
        """Keep the newest message of DiagnosticStatus topics in `statuses`."""
        def keep(topic: str, message: Any) -> None:
            self.statuses[topic] = {item.key: item.value for item in message.values}
        self._subscribe(topics, DiagnosticStatus, LATCHED, keep)

    def subscribe_joint_states(self, *topics: str) -> None:
        """Keep the newest message of JointState topics in `joint_states`."""
        self._subscribe(topics, JointState, SENSOR, self.joint_states.__setitem__)

    def _subscribe(self, topics: Sequence[str], kind: Any, qos: QoSProfile,
                   keep: Callable[[str, Any], None]) -> None:
        def callback_of(topic: str) -> Callable[[Any], None]:
            # The EventsExecutor passes message infos to callbacks with two parameters.
            return lambda message: keep(topic, message)
        for topic in topics:
            if topic not in self._subscribed:
                self._subscribed[topic] = self.node.create_subscription(
                    kind, topic, self.runtime.guard(callback_of(topic)), qos)

    def unsubscribe(self, *topics: str) -> None:
        """End subscriptions; the newest message of each topic is kept."""
        for topic in topics:
            self.node.destroy_subscription(self._subscribed.pop(topic))

    def stamp_ns(self, topic: str = FLYWHEEL_STATES) -> int | None:
        """Return the newest stamp of a subscribed JointState [ns], None before the first."""
        return stamp_of(self.joint_states[topic]) if topic in self.joint_states else None

    def positions(self, topic: str, names: Sequence[str]) -> list[float]:
        """Return the newest positions of some joints of a subscribed JointState."""
        message = self.joint_states[topic]
        return [message.position[message.name.index(name)] for name in names]

    def has_device(self) -> bool:
        """Return whether a device publishes its status."""
        return bool(self.node.count_publishers(self.node.resolve_topic_name(DEVICE_STATUS)))

    def is_recorded(self, topics: Sequence[str]) -> bool:
        """Return whether a recorder subscribes to all of these topics."""
        return all(
            any(info.node_name == 'recorder' for info in
                self.node.get_subscriptions_info_by_topic(self.node.resolve_topic_name(topic)))
            for topic in topics)

    def call(self, kind: Any, service: str, request: Any, timeout: float = TIMEOUT,
             server: str = 'device') -> tuple[bool, str]:
        """
        Call a service, with retry where it is idempotent.

        :param kind: type of the service.
        :param timeout: longest wait for the service to appear [s].
        :param server: node that offers it, for messages.
        :returns: success and message of the response.
        :raises RosError: the service does not appear, or does not answer.
        """
        client = self.node.create_client(kind, service)
        name = self.node.resolve_service_name(service)
        self.wait(client.service_is_ready, timeout,
                  f'no {server} found: service {name} did not appear')
        call = ServiceCall(client, service, request)
        self.wait(call.poll, timeout, f'no answer from service {name}')
        self.node.destroy_client(client)
        return call.response.success, call.response.message

    def call_set_bool(self, service: str, value: bool, server: str = 'device'
                      ) -> tuple[bool, str]:
        """Call a SetBool service: success and message."""
        return self.call(SetBool, service, SetBool.Request(data=value), server=server)

    def call_trigger(self, service: str, server: str = 'device') -> tuple[bool, str]:
        """Call a Trigger service: success and message."""
        return self.call(Trigger, service, Trigger.Request(), server=server)

    def advertise_setpoints(self) -> None:
        """Create the publisher of setpoints, so that subscribers discover it before the first."""
        if self._setpoints is None:
            self._setpoints = self.node.create_publisher(JointState, SETPOINT, RELIABLE)

    def send_setpoint(self, names: Sequence[str], positions: Sequence[float]
                      ) -> tuple[bool, str]:
        """
        Send a setpoint and wait until the controller accepts or refuses it.

        :returns: whether it is accepted, and the reason of the last refusal.
        :raises RosError: no device, no controller, or no answer.
        """
        self.subscribe_statuses(CONTROLLER_STATUS)
        self.subscribe_joint_states(FLYWHEEL_STATES)
        self.advertise_setpoints()
        self.wait(lambda: self.stamp_ns() is not None,
                  missing='no device found: no flywheel_states received')
        self.wait(lambda: (self.node.count_subscribers(self._setpoints.topic_name) > 0
                           and CONTROLLER_STATUS in self.statuses),
                  missing='no controller found: setpoint has no subscriber')
        # The stamp of the newest tick is not stale, and identifies the answer to this setpoint.
        stamp_ns = self.stamp_ns() or 0
        message = JointState(name=list(names), position=list(positions))
        write_stamp(message.header.stamp, stamp_ns)
        refused = self.statuses[CONTROLLER_STATUS]['refused']
        self._setpoints.publish(message)
        self.wait(lambda: self.statuses[CONTROLLER_STATUS]['judged_stamp_ns'] == str(stamp_ns),
                  missing='no answer from the controller')
        status = self.statuses[CONTROLLER_STATUS]
        return status['refused'] == refused, status['last_refusal']
