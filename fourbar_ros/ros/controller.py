# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The controller as a node: estimates and setpoints in, wheel commands out."""

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.control import Controller, ControllerSettings, Point, SetpointError
from fourbar_ros.control.actuation_cost import ENERGIES
from fourbar_ros.control.parameters import PARAMETERS
from fourbar_ros.control.scalars import (
    ALLOCATION,
    allocation_scalars,
    MOMENTUM,
    momentum_scalars,
)
from fourbar_ros.control.wheel_command import by_name
from fourbar_ros.loop.stamp_pairing import Punctuality, StampPairs
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, load_mechanism
from fourbar_ros.ros.controller_services import ControllerServices
from fourbar_ros.ros.controller_status import ControllerStatus
from fourbar_ros.ros.messages import (
    JointStatePublisher,
    LATCHED,
    RareLog,
    RELIABLE,
    sensor_quality,
    stamp_of,
    TABLE_FRAME,
)
from fourbar_ros.ros.parameters import declare
from fourbar_ros.ros.runtime import run_node
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

# What changes slowly is published every so many ticks: it takes time.
SLOW = 5

NOTHING = np.zeros(2)


class ControllerNode(Node):
    """Hand messages to the controller and its commands to the device."""

    def __init__(self, runtime):
        super().__init__('controller')
        guard = runtime.guard
        values = declare(self, PARAMETERS, self._on_parameters)
        mechanism = load_mechanism(values['mechanism'])
        self._controller = Controller(mechanism, _settings(values))
        self._pairs = StampPairs()
        # Simulated time waits for whoever is late, or is of no fixed pace.
        simulated = self.get_parameter('use_sim_time').value
        self._punctuality = None if simulated else Punctuality()
        self._log = RareLog(self)
        self._last_stamp_ns = None
        self._ticks = 0

        self._command = JointStatePublisher(
            self, 'flywheel_command', FLYWHEEL_NAMES, ('effort',))
        self._reference = JointStatePublisher(
            self, 'reference', LINK_NAMES, frame=TABLE_FRAME)
        self._error = JointStatePublisher(self, 'tracking_error', LINK_NAMES)
        self._energy = JointStatePublisher(self, 'energy', ENERGIES, ('position',))
        self._allocation = JointStatePublisher(self, 'allocation', ALLOCATION, ('position',))
        self._momentum = JointStatePublisher(self, 'momentum', MOMENTUM, ('position',))
        self._status = ControllerStatus(self, self._controller, self._log, guard)
        ControllerServices(self, self._controller, guard, self._status.announce)
        self.create_subscription(
            JointState, 'flywheel_states', guard(self._on_wheels), sensor_quality(self))
        self.create_subscription(
            JointState, 'estimate/link_states', guard(self._on_estimate), RELIABLE)
        self.create_subscription(
            DiagnosticStatus, 'device_status', guard(self._on_device), LATCHED)
        self.create_subscription(JointState, 'setpoint', guard(self._on_setpoint), RELIABLE)
        self.create_subscription(
            JointTrajectory, 'trajectory', guard(self._on_trajectory), RELIABLE)
        self._status.announce()

    def close(self):
        """Send a last zero torque."""
        if self._last_stamp_ns is not None:
            self._command.publish(
                self._last_stamp_ns, np.zeros(4), names=FLYWHEEL_NAMES, fields=('effort',))

    def _on_parameters(self, values):
        self._controller.tune(_settings(values))
        self._status.announce()

    def _on_device(self, message):
        states = [item.value for item in message.values if item.key == 'state']
        self._controller.device_armed(states == ['armed'])

    def _on_wheels(self, message):
        if tuple(message.name) == FLYWHEEL_NAMES:
            self._act(stamp_of(message), 'wheels', (
                np.array(message.velocity), np.array(message.effort)))

    def _on_estimate(self, message):
        # The effort of a link is what pushes it besides the wheels.
        pushed = np.array(message.effort[:2]) if len(message.effort) == 4 else NOTHING
        self._act(stamp_of(message), 'links', (
            np.array(message.position), np.array(message.velocity), pushed))

    def _act(self, stamp_ns, kind, value):
        pair = self._pairs.complete(stamp_ns, kind, value)
        if pair is None:
            return
        late = (self._punctuality is not None
                and self._punctuality.is_late(stamp_ns, monotonic_ns()))
        control = self._controller.tick(stamp_ns, *pair['links'], *pair['wheels'], late=late)
        names, velocities, efforts = by_name(control.command)
        if control.command.by_speed:
            self._command.publish(stamp_ns, velocities, names=names, fields=('velocity',))
        else:
            self._command.publish(stamp_ns, efforts, names=names, fields=('effort',))
        self._last_stamp_ns = stamp_ns
        self._reference.publish(stamp_ns, control.reference_angles, control.reference_rates)
        self._error.publish(stamp_ns, control.angle_errors, control.rate_errors)
        self._energy.publish(stamp_ns, control.energies)
        self._ticks += 1
        if self._ticks % SLOW == 0:
            self._allocation.publish(stamp_ns, allocation_scalars(self._controller))
            names, values = momentum_scalars(self._controller)
            self._momentum.publish(stamp_ns, values, names=names)
        self._status.announce(running=True)

    def _on_setpoint(self, message):
        self._judge('setpoint', message, lambda: self._controller.setpoint(
            message.name, message.position, stamp_of(message)))

    def _on_trajectory(self, message):
        self._judge('trajectory', message, lambda: self._controller.trajectory(
            message.joint_names, [Point(
                point.positions, point.time_from_start.sec + point.time_from_start.nanosec * 1e-9,
                point.velocities, point.accelerations, point.effort)
                for point in message.points], stamp_of(message)))

    def _judge(self, what, message, give):
        try:
            give()
        except SetpointError as error:
            self._log.warn(f'{what} refused: {error}')
        self._status.judged = f'{stamp_of(message)}'
        self._status.announce()


def _settings(values):
    return ControllerSettings(
        **{name: value for name, value in values.items() if name != 'mechanism'})


def main(argv):
    """Run the node."""
    return run_node(
        ControllerNode, 'controller', 'Tracking law and wheel allocation.', argv)
