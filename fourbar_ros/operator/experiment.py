# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""An experiment with a device: record its topics, at rest or while it is driven."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import inf
from pathlib import Path
import time
from typing import Any, Protocol

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.operator.client import TestbedClient
from fourbar_ros.operator.recorder import offered_qos, QUEUE_DEPTH
from fourbar_ros.ros.environment import RosError
from fourbar_ros.ros.messages import LATCHED, RELIABLE, stamp_of
from fourbar_ros.ros.runtime import exempt_from_garbage_collection, flush
import numpy as np
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from sensor_msgs.msg import JointState

DEEP = QoSProfile(depth=QUEUE_DEPTH)
# Time without a tick after which the device counts as gone [s].
SILENCE_TIMEOUT = 2.0
# Time in which another publisher of commands is discovered [s].
DISCOVERY_TIME = 1.0

# Called with the elapsed time [s].
Progress = Callable[[float], None]


class Excitation(Protocol):
    """Torques of the wheels as a function of time and measurements."""

    def efforts(self, elapsed_s: float, link_angles: Array, wheel_speeds: Array
                ) -> Mapping[str, float] | None:
        """
        Return the torques until the next tick.

        :param elapsed_s: time since the first tick [s].
        :param link_angles: (4,) last measured orientations [rad].
        :param wheel_speeds: (4,) relative to the links [rad/s].
        :returns: torque by wheel [N m], None at the end.
        :raises FourbarError: the excitation must stop.
        """


class Experiment:
    """
    Recording of the topics of a device, optionally with an excitation of its wheels.

    :ivar status: values of the newest device_status, None before the first.
    :ivar angles: (4,) last measured orientations of the links, NaN before the first [rad].
    """

    def __init__(self, testbed: TestbedClient) -> None:
        self.status: dict[str, str] | None = None
        self.angles = np.full(4, np.nan)
        self._testbed = testbed
        self._node = testbed.node
        self._tick: Any = None
        self._tick_time = time.monotonic()
        self._messages: list[tuple[str, Any, int, bytes]] = []
        self._status_message: list[tuple[str, Any, int, bytes]] = []
        self._commands: Any = None
        self._excitation: Excitation | None = None
        self._start_ns: int | None = None
        self._elapsed_s = 0.0
        self._finished = False
        for topic, kind, qos, callback in (
                (names.DEVICE_STATUS, DiagnosticStatus, LATCHED, self._on_status),
                (names.LINK_ANGLES, JointState, DEEP, self._on_links),
                (names.FLYWHEEL_STATES, JointState, DEEP, self._on_tick)):
            self._node.create_subscription(kind, topic, testbed.runtime.guard(
                partial(self._keep, topic, kind, callback)), qos, raw=True)

    def wait_for_device(self) -> str:
        """
        Wait for the status and the first tick of the device.

        :returns: name of its mechanism.
        :raises RosError: timeout.
        """
        self._testbed.wait(lambda: self.status is not None,
                           missing='no device found: no device_status received')
        self._testbed.wait(lambda: self._tick is not None,
                           missing='the device makes no ticks: no flywheel_states received')
        return (self.status or {})['mechanism']

    def record_at_rest(self, seconds: float, progress: Progress = lambda elapsed_s: None) -> None:
        """
        Record for a time while the device is disarmed.

        :raises RosError: the device is armed, or link_angles is silent.
        """
        self._start_recording()
        begin = time.monotonic()

        def finished() -> bool:
            progress(min(seconds, time.monotonic() - begin))
            self._check_ticks()
            if self._state == 'armed':
                raise RosError('the device is armed: disarm it, the links must rest')
            return time.monotonic() - begin >= seconds
        self._testbed.wait(finished, inf)
        if not any(topic == names.LINK_ANGLES for topic, *_ in self._messages):
            raise RosError(f'no link_angles received in {seconds:g} s')

    def drive(self, excitation: Excitation, progress: Progress = lambda elapsed_s: None) -> None:
        """
        Arm the device, record while an excitation drives it, and disarm it.

        Whatever ends the excitation, the last command is zero torque.

        :raises RosError: commands have another publisher, or the device does not arm, is disarmed
            or makes no ticks.
        :raises FourbarError: the excitation must stop.
        :raises KeyboardInterrupt: a signal arrived.
        """
        exempt_from_garbage_collection()    # a collection takes longer than a command timeout
        topic = self._node.resolve_topic_name(names.FLYWHEEL_COMMAND)
        if self._testbed.wait(lambda: self._node.count_publishers(topic), DISCOVERY_TIME):
            raise RosError(f'{topic} has a publisher already: stop the controller')
        self._commands = self._node.create_publisher(JointState, topic, RELIABLE)
        try:
            self._testbed.wait(lambda: self._commands.get_subscription_count() > 0,
                               missing=f'{topic} has no subscriber')
            if not self._testbed.wait(lambda: np.isfinite(self.angles).all()):
                silent = [name for name, angle in zip(LINK_NAMES, self.angles) if np.isnan(angle)]
                raise RosError(f'link_angles has no {", ".join(silent)}: each link needs an '
                               'absolute sensor', missing=silent)
            self._arm()
            self._start_recording()
            self._excitation = excitation

            def finished() -> bool:
                progress(self._elapsed_s)
                self._check_ticks()
                if self._state != 'armed':
                    raise RosError(f'the device does not drive any more: {self._state} '
                                   f'({(self.status or {})["reason"]})')
                return self._finished
            self._testbed.wait(finished, inf)
        finally:
            self._disarm()

    def write(self, directory: Path) -> None:
        """Write the recorded messages as a rosbag2 directory (MCAP) with the offered QoS."""
        typestore = get_typestore(Stores.ROS2_JAZZY)
        connections: dict[str, Any] = {}
        with Writer(directory, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for topic, kind, received_ns, data in self._messages:
                if topic not in connections:
                    status = kind is DiagnosticStatus
                    connections[topic] = writer.add_connection(
                        self._node.resolve_topic_name(topic),
                        'diagnostic_msgs/msg/DiagnosticStatus' if status
                        else 'sensor_msgs/msg/JointState', typestore=typestore,
                        offered_qos_profiles=[offered_qos(LATCHED if status else RELIABLE)])
                writer.write(connections[topic], received_ns, data)

    @property
    def _state(self) -> str:
        return (self.status or {}).get('state', '')

    def _start_recording(self) -> None:
        """Discard the recorded messages but the newest status."""
        self._messages[:] = self._status_message

    def _check_ticks(self) -> None:
        if time.monotonic() - self._tick_time > SILENCE_TIMEOUT:
            raise RosError(f'no flywheel_states for {SILENCE_TIMEOUT:g} s: the device is gone')

    def _keep(self, topic: str, kind: Any, callback: Callable[[Any], None], data: bytes) -> None:
        """Record a serialized message and handle it."""
        self._messages.append((topic, kind, time.time_ns(), data))
        callback(deserialize_message(data, kind))

    def _on_status(self, message: DiagnosticStatus) -> None:
        self._status_message = self._messages[-1:]
        self.status = {item.key: item.value for item in message.values}

    def _on_links(self, message: JointState) -> None:
        for name, angle in zip(message.name, message.position):
            if name in LINK_NAMES:
                self.angles[LINK_NAMES.index(name)] = angle

    def _on_tick(self, message: JointState) -> None:
        self._tick, self._tick_time = message, time.monotonic()
        if self._commands is None:
            return
        efforts = None
        try:
            efforts = self._efforts(message)
        except FourbarError:
            self._finished = True
            raise       # the guard of the runtime passes it on
        finally:
            self._publish(efforts)

    def _efforts(self, tick: JointState) -> Mapping[str, float] | None:
        """Return the torques that answer a tick, None for zero torque."""
        if self._excitation is None or self._finished:
            return None
        stamp_ns = stamp_of(tick)
        if self._start_ns is None:
            self._start_ns = stamp_ns
        self._elapsed_s = (stamp_ns - self._start_ns) * 1e-9
        speeds = np.array([tick.velocity[tick.name.index(name)] for name in FLYWHEEL_NAMES])
        efforts = self._excitation.efforts(self._elapsed_s, self.angles.copy(), speeds)
        self._finished = efforts is None
        return efforts

    def _publish(self, efforts: Mapping[str, float] | None) -> None:
        efforts = efforts or dict.fromkeys(FLYWHEEL_NAMES, 0.0)
        message = JointState(name=list(efforts), effort=list(map(float, efforts.values())))
        message.header.stamp = self._tick.header.stamp
        self._commands.publish(message)

    def _arm(self) -> None:
        armed, message = self._testbed.call_set_bool(names.ARM, True)
        if not armed:
            hint = ': stop the controller' if names.FLYWHEEL_COMMAND in message else ''
            raise RosError(f'the device does not arm: {message}{hint}')
        self._testbed.wait(lambda: self._state == 'armed', missing='the device was not armed')

    def _disarm(self) -> None:
        """Publish zero torque and disarm the device, even after a signal."""
        runtime = self._testbed.runtime
        stopping, runtime.stopping = runtime.stopping, False
        runtime.failure, self._finished = None, True
        try:
            if self._tick is not None:
                self._publish(None)
            self._testbed.call_set_bool(names.ARM, False)
        except RosError as error:
            raise RosError(f'{error}: could not disarm; without commands the device stops the '
                           'wheels by itself') from None
        finally:
            runtime.stopping = stopping
            flush([self._commands])
            self._node.destroy_publisher(self._commands)
            self._commands = None
