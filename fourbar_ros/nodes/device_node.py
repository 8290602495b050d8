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

"""The ROS shell of a testbed, simulated or real: same topics, same services, same rules."""

import time

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.device import RealtimePace, Testbed, TestbedSettings
from fourbar_ros.device.gate import DeviceState
from fourbar_ros.device.testbed import TIMEOUT_ACTIONS
from fourbar_ros.errors import FourbarError
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
from fourbar_ros.mechanism.by_name import RejectedError
from fourbar_ros.nodes.gate_services import GateServices
from fourbar_ros.nodes.messages import (
    Diagnostics,
    ERROR,
    JointStatePublisher,
    LATCHED,
    OK,
    RareLog,
    Recently,
    RELIABLE,
    stamp_of,
    status_message,
    steady_ns,
    TABLE_FRAME,
    WARN,
)
from fourbar_ros.nodes.parameters import declare, Parameter
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState

PARAMETERS = (
    Parameter('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    Parameter('rate', 250.0, 'Hz', 'control rate, one tick per period', limits=(1.0, 2000.0)),
    Parameter('command_timeout', 0.1, 's', 'longest time without a command while armed',
              limits=(0.002, 10.0)),
    Parameter('sensor_timeout', 0.2, 's', 'a link without a sample for so long is silent',
              limits=(0.002, 10.0)),
    Parameter('timeout_action', 'coast', '', 'what the wheels do when commands stay away',
              choices=TIMEOUT_ACTIONS),
)

# Up to this delay every tick is caught up with; after longer ones they are left out [ns].
PATIENCE_NS = 100_000_000

LEVELS = {DeviceState.DISARMED: OK, DeviceState.ARMED: OK,
          DeviceState.EMERGENCY_STOP: ERROR, DeviceState.FAULT: ERROR}
TIMING_NAMES = ('round_trip_s', 'command_age_s', 'lost', 'step_s')


class DeviceNode(Node):
    """
    Drive a device tick by tick and let its commands through the arming gate.

    :param parameters: the node's own table, added to the common one.
    :param make_device: called with the values of all parameters and the period [ns].
    """

    def __init__(self, runtime, name, parameters, make_device):
        super().__init__(name)
        guard = runtime.guard
        values = declare(self, PARAMETERS + parameters)
        period_ns = round(1e9 / values['rate'])
        self._mechanism = values['mechanism']
        self._testbed = Testbed(make_device(values, period_ns), TestbedSettings(
            values['command_timeout'], values['sensor_timeout'], values['timeout_action']))
        self._log, self._rejected = RareLog(self), Recently()

        self._links = JointStatePublisher(
            self, 'link_angles', LINK_NAMES, ('position',), frame=TABLE_FRAME)
        self._wheels = JointStatePublisher(
            self, 'flywheel_states', FLYWHEEL_NAMES, ('position', 'velocity', 'effort'))
        self._timing = JointStatePublisher(self, 'timing', TIMING_NAMES, ('position',))
        self._status = self.create_publisher(DiagnosticStatus, 'device_status', LATCHED)
        self.create_subscription(
            JointState, 'flywheel_command', guard(self._on_command), RELIABLE)
        GateServices(self, self._testbed, guard, self._announce)
        device = self._testbed.device
        self._diagnostics = Diagnostics(self, device.description, self._collect, guard)
        self._announced = None
        self._catching_up = False
        self._soon = lambda callback: runtime.executor.create_task(guard(callback))
        # One after the other, so that the timer fires right after a tick is due.
        self._pace = RealtimePace(time.time_ns(), steady_ns(), period_ns, PATIENCE_NS)
        self.create_timer((period_ns + 0.5) * 1e-9, guard(self._on_timer),  # rclpy rounds down
                          clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._announce()
        self.get_logger().info(
            f'{device.description} with mechanism {self._mechanism} at {values["rate"]:g} Hz')

    def publish_truth(self, stamp_ns, truth):
        """Publish ground truth, where a device has it."""

    def close(self):
        """Leave the wheels without torque, and say so."""
        self._testbed.disarm('the node ends')
        self._announce()

    def _on_timer(self):
        if not self._catching_up:
            self._advance()

    def _advance(self):
        """Make one tick that is due; the next one, if it is late too, after waiting commands."""
        stamp_ns = self._pace.due(steady_ns())
        if stamp_ns is not None and self._testbed.gate.state is not DeviceState.FAULT:
            self._tick(stamp_ns)
        self._announce()
        self._catching_up = self._pace.is_due(steady_ns())
        if self._catching_up:
            self._soon(self._advance)

    def _tick(self, stamp_ns):
        begin_ns = steady_ns()
        try:
            samples, timing = self._testbed.tick(stamp_ns, begin_ns)
        except FourbarError as error:
            self.get_logger().error(f'{error}: the device stands still')
            return
        step_ns = steady_ns() - begin_ns
        for sample in samples.links:
            self._links.publish(sample.stamp_ns, sample.angles,
                                names=tuple(LINK_NAMES[link] for link in sample.links))
        wheels = samples.wheels
        # The tick, after everything that belongs to it.
        self._wheels.publish(stamp_ns, wheels.angles, wheels.speeds, wheels.efforts)
        self._testbed.published(steady_ns(), step_ns)
        scalars = {name: getattr(timing, name) for name in TIMING_NAMES}
        known = tuple(name for name in TIMING_NAMES if scalars[name] is not None)
        self._timing.publish(stamp_ns, [scalars[name] for name in known], names=known)
        if samples.truth is not None:
            self.publish_truth(stamp_ns, samples.truth)

    def _on_command(self, message):
        clipped = self._testbed.clipped
        try:
            self._testbed.command(stamp_of(message), message.name, message.position,
                                  message.velocity, message.effort, steady_ns())
        except RejectedError as error:
            self._log.warn(f'flywheel_command rejected: {error}')
        if self._testbed.clipped > clipped:
            self._log.warn('flywheel_command asks more torque than a motor has: clipped')

    def _announce(self):
        """Publish the gate's state if it changed."""
        gate = self._testbed.gate
        present = gate.state, gate.reason, gate.since_ns
        if present == self._announced:
            return
        self._announced = present
        self._status.publish(status_message(
            self, self._testbed.device.description, LEVELS[gate.state],
            f'{gate.state.value}: {gate.reason}', {
                'state': gate.state.value, 'reason': gate.reason,
                'since': f'{gate.since_ns * 1e-9:.9f}', 'mechanism': self._mechanism}))
        self._diagnostics.changed()
        self.get_logger().info(f'{gate.state.value}: {gate.reason}')

    def _collect(self):
        gate = self._testbed.gate
        level, summary = LEVELS[gate.state], gate.state.value
        if self._rejected.grew(self._testbed.rejected.total()) and level == OK:
            level, summary = WARN, f'{summary}, commands were rejected'
        return level, summary, {**self._testbed.diagnosis(), 'ticks_skipped': self._pace.skipped}
