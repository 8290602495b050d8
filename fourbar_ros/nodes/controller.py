# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The controller as a node: estimates and setpoints in, wheel commands out."""

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.control import Controller, ControllerSettings, SetpointError
from fourbar_ros.loop.pairing import StampPairs
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, load_mechanism
from fourbar_ros.nodes.messages import (
    Diagnostics,
    JointStatePublisher,
    LATCHED,
    OK,
    RareLog,
    Recently,
    RELIABLE,
    sensor_quality,
    stamp_of,
    status_message,
    TABLE_FRAME,
    WARN,
)
from fourbar_ros.nodes.parameters import declare, Parameter
from fourbar_ros.nodes.runtime import run_node
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState

DEFAULTS = ControllerSettings()
PARAMETERS = (
    Parameter('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    Parameter('bandwidth', DEFAULTS.bandwidth, 'rad/s', 'of the tracking law',
              limits=(0.1, 20.0), live=True),
    Parameter('damping', DEFAULTS.damping, '', 'damping ratio of the tracking law',
              limits=(0.1, 2.0), live=True),
    Parameter('setpoint_duration', DEFAULTS.setpoint_duration, 's',
              'time in which a setpoint is reached', limits=(0.1, 3600.0), live=True),
)
SCALARS = ('flywheel_energy_j', 'eq9_j_s', 'work_j')


class ControllerNode(Node):
    """Hand messages to the controller and its torques to the device."""

    def __init__(self, runtime):
        super().__init__('controller')
        guard = runtime.guard
        values = declare(self, PARAMETERS, self._on_parameters)
        mechanism = load_mechanism(values['mechanism'])
        self._controller = Controller(mechanism, _settings(values))
        self._pairs = StampPairs()
        self._log, self._refused = RareLog(self), Recently()
        self._announced = None
        self._judged = ''
        self._last_stamp_ns = None

        self._command = JointStatePublisher(
            self, 'flywheel_command', FLYWHEEL_NAMES, ('effort',))
        self._reference = JointStatePublisher(
            self, 'reference', LINK_NAMES, frame=TABLE_FRAME)
        self._error = JointStatePublisher(self, 'tracking_error', LINK_NAMES)
        self._energy = JointStatePublisher(self, 'energy', SCALARS, ('position',))
        self._status = self.create_publisher(DiagnosticStatus, 'controller_status', LATCHED)
        self._diagnostics = Diagnostics(self, '', self._collect, guard)
        self.create_subscription(
            JointState, 'flywheel_states', guard(self._on_wheels), sensor_quality(self))
        self.create_subscription(
            JointState, 'estimate/link_states', guard(self._on_estimate), RELIABLE)
        self.create_subscription(
            DiagnosticStatus, 'device_status', guard(self._on_device), LATCHED)
        self.create_subscription(JointState, 'setpoint', guard(self._on_setpoint), RELIABLE)
        self._announce()

    def close(self):
        """Send a last zero torque."""
        if self._last_stamp_ns is not None:
            self._command.publish(self._last_stamp_ns, np.zeros(4))

    def _on_parameters(self, values):
        self._controller.settings = _settings(values)
        self._announce()

    def _on_device(self, message):
        states = [item.value for item in message.values if item.key == 'state']
        self._controller.device_armed(states == ['armed'])

    def _on_wheels(self, message):
        if tuple(message.name) == FLYWHEEL_NAMES:
            self._act(stamp_of(message), 'wheels', (
                np.array(message.velocity), np.array(message.effort)))

    def _on_estimate(self, message):
        self._act(stamp_of(message), 'links', (
            np.array(message.position), np.array(message.velocity)))

    def _act(self, stamp_ns, kind, value):
        pair = self._pairs.complete(stamp_ns, kind, value)
        if pair is None:
            return
        control = self._controller.tick(stamp_ns, *pair['links'], *pair['wheels'])
        self._command.publish(stamp_ns, control.torques)
        self._last_stamp_ns = stamp_ns
        self._reference.publish(stamp_ns, control.reference_angles, control.reference_rates)
        self._error.publish(stamp_ns, control.angle_errors, control.rate_errors)
        self._energy.publish(stamp_ns, (control.flywheel_energy, control.eq9, control.work))
        self._announce()

    def _on_setpoint(self, message):
        try:
            self._controller.setpoint(message.name, message.position, stamp_of(message))
        except SetpointError as error:
            self._log.warn(f'setpoint refused: {error}')
        self._judged = f'{stamp_of(message)}'
        self._announce()

    def _announce(self):
        """Publish the status if it changed."""
        controller = self._controller
        present = (controller.mode, controller.accepted, controller.refused, self._judged,
                   controller.settings)
        if present == self._announced:
            return
        self._announced = present
        goal = '' if controller.goal is None else ' '.join(
            f'{name}={angle:.6f}' for name, angle in zip(LINK_NAMES, controller.goal))
        self._status.publish(status_message(
            self, '', OK, controller.mode, {
                'mode': controller.mode, 'goal': goal,
                'setpoint_duration_s': controller.settings.setpoint_duration,
                'accepted': controller.accepted, 'refused': controller.refused,
                'last_refusal': controller.last_refusal, 'judged_stamp_ns': self._judged}))
        self._diagnostics.changed()

    def _collect(self):
        controller = self._controller
        values = {'mode': controller.mode, 'setpoints_accepted': controller.accepted,
                  'setpoints_refused': controller.refused,
                  'last_refusal': controller.last_refusal,
                  'ticks_saturated': controller.saturated}
        if self._last_stamp_ns is None:
            return WARN, 'waiting for flywheel_states and estimate/link_states', values
        if self._refused.grew(controller.refused):
            return WARN, f'{controller.mode}, setpoints were refused', values
        return OK, controller.mode, values


def _settings(values):
    return ControllerSettings(
        values['bandwidth'], values['damping'], values['setpoint_duration'])


def main(argv):
    """Run the node."""
    return run_node(
        ControllerNode, 'controller', 'Tracking law and wheel allocation.', argv)
