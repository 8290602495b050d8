# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Keep what a device says, for as long as needed, and write it as a bag."""

from functools import partial
from math import inf
import time

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.common import names
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.operator.recorder import offered_qos, QUEUE_DEPTH
from fourbar_ros.ros.environment import RosError
from fourbar_ros.ros.messages import LATCHED, RELIABLE
import numpy as np
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from sensor_msgs.msg import JointState

DEEP = QoSProfile(depth=QUEUE_DEPTH)
# A device without ticks for so long is gone [s].
LONGEST_SILENCE = 2.0


class Experiment:
    """
    What happens on the topics of a device.

    :param testbed: the operator's node, a TestbedClient.
    """

    def __init__(self, testbed):
        self.testbed = testbed
        self.node = testbed.node
        self.status = None
        self.tick = None
        self.angles = np.full(4, np.nan)
        self._kept = []
        self._status_data = None
        self._heard_at = time.monotonic()
        guard = testbed.runtime.guard
        for topic, kind, qos, callback in (
                (names.DEVICE_STATUS, DiagnosticStatus, LATCHED, self.on_status),
                (names.LINK_ANGLES, JointState, DEEP, self.on_links),
                (names.FLYWHEEL_STATES, JointState, DEEP, self.on_tick)):
            self.node.create_subscription(
                kind, topic, guard(partial(self._take, topic, kind, callback)), qos, raw=True)

    def meet_device(self):
        """
        Wait until the device is heard.

        :returns: name of its mechanism.
        :raises RosError: there is none.
        """
        self.testbed.wait(lambda: self.status is not None,
                          missing='no device found: no device_status came')
        self.testbed.wait(lambda: self.tick is not None,
                          missing='the device makes no ticks: no flywheel_states came')
        return self.status['mechanism']

    def listen(self, seconds, progress=lambda elapsed_s: None):
        """
        Keep what is published for a time, while the device is disarmed.

        :param progress: called with the time so far [s].
        :raises RosError: it is armed, or no link angles come.
        """
        self.begin()
        begin = time.monotonic()

        def listened():
            progress(min(seconds, time.monotonic() - begin))
            self.check_alive()
            if self.status['state'] == 'armed':
                raise RosError('the device is armed: disarm it, the links must rest')
            return time.monotonic() - begin >= seconds
        self.testbed.wait(listened, inf)
        if not any(topic == names.LINK_ANGLES for topic, *_ in self._kept):
            raise RosError(f'no link_angles came in {seconds:g} s')

    def begin(self):
        """Forget what came so far, but for the state of the device."""
        self._kept[:] = [self._status_data]

    def write(self, directory):
        """Write what was kept as a rosbag2 directory (MCAP), with the quality that is offered."""
        typestore, connections = get_typestore(Stores.ROS2_JAZZY), {}
        with Writer(directory, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for topic, kind, received_ns, data in self._kept:
                if topic not in connections:
                    status = kind is DiagnosticStatus
                    connections[topic] = writer.add_connection(
                        self.node.resolve_topic_name(topic),
                        'diagnostic_msgs/msg/DiagnosticStatus' if status
                        else 'sensor_msgs/msg/JointState', typestore=typestore,
                        offered_qos_profiles=[offered_qos(LATCHED if status else RELIABLE)])
                writer.write(connections[topic], received_ns, data)

    def check_alive(self):
        """Fail if the device makes no ticks any more."""
        if time.monotonic() - self._heard_at > LONGEST_SILENCE:
            raise RosError(f'no flywheel_states for {LONGEST_SILENCE:g} s: the device is gone')

    def silent_links(self):
        """Return the links that gave no sample yet."""
        return [name for name, angle in zip(LINK_NAMES, self.angles) if np.isnan(angle)]

    def on_status(self, message):
        """Take note of the state of the gate."""
        self._status_data = self._kept[-1]
        self.status = {item.key: item.value for item in message.values}

    def on_links(self, message):
        """Take note of link angles."""
        for name, angle in zip(message.name, message.position):
            if name in LINK_NAMES:
                self.angles[LINK_NAMES.index(name)] = angle

    def on_tick(self, message):
        """Take note of a tick."""
        self.tick, self._heard_at = message, time.monotonic()

    def _take(self, topic, kind, callback, data):
        """Keep a message as it came, byte for byte, and look at it."""
        self._kept.append((topic, kind, time.time_ns(), data))
        callback(deserialize_message(data, kind))
