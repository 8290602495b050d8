# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The arming gate of a testbed as services, and the topic that stops it."""

from fourbar_ros.ros.messages import RELIABLE
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

# More than one publisher of these means that somebody would be driven by the wrong one.
SINGLE_PUBLISHER = ('flywheel_command', 'link_angles')


class GateServices:
    """
    Let people arm, disarm, stop and reset.

    :param now_ns: reads the clock of the testbed's watchdogs [ns].
    :param announce: called after every change.
    """

    def __init__(self, node, testbed, guard, now_ns, announce):
        self._node = node
        self._testbed = testbed
        self._now_ns = now_ns
        self._announce = announce
        node.create_service(SetBool, 'arm', guard(self._on_arm))
        node.create_service(Trigger, 'emergency_stop', guard(self._on_stop))
        node.create_service(Trigger, 'reset_emergency_stop', guard(self._on_reset))
        node.create_subscription(
            Bool, 'emergency_stop_request', guard(self._on_stop_request), RELIABLE)

    def _on_arm(self, request, response):
        if request.data:
            response.success, response.message = self._testbed.arm(
                self._now_ns(), self._obstacles())
        else:
            self._testbed.disarm('disarmed on request')
            response.success = True
            response.message = self._testbed.gate.state.value
        self._announce()
        return response

    def _obstacles(self):
        found = []
        for topic in SINGLE_PUBLISHER:
            publishers = self._node.count_publishers(self._node.resolve_topic_name(topic))
            if publishers > 1:
                found.append(f'{topic} has {publishers} publishers, limit 1')
        return found

    def _on_stop(self, _request, response):
        self._testbed.emergency_stop('emergency_stop service')
        response.success, response.message = True, 'stopped, the wheels coast'
        self._announce()
        return response

    def _on_reset(self, _request, response):
        response.success, response.message = self._testbed.reset()
        self._announce()
        return response

    def _on_stop_request(self, message):
        if message.data:
            self._testbed.emergency_stop('emergency_stop_request')
            self._announce()
