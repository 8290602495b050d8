# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The controller as a node: estimates and setpoints in, wheel commands out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.common import names
from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.control import Controller, ControllerSettings, Point, SetpointError
from fourbar_ros.control.actuation_cost_sums import ENERGIES
from fourbar_ros.control.scalars import (
    ALLOCATION,
    allocation_scalars,
    MOMENTUM,
    momentum_scalars,
)
from fourbar_ros.control.settings import PARAMETERS
from fourbar_ros.control.wheel_command import by_name
from fourbar_ros.loop.stamp_pairing import LatenessDetector, StampPairs
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, load_mechanism
from fourbar_ros.ros import messages
from fourbar_ros.ros.base_node import BaseNode, run_node, settings_from
from fourbar_ros.ros.messages import JointStatePublisher, stamp_of
from fourbar_ros.ros.runtime import Runtime
import numpy as np
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

# Ticks between two messages on allocation and momentum, which take time and change slowly.
TICKS_PER_SCALARS = 5
# Ticks between two checks of the momentum margin, which take time.
TICKS_PER_MOMENTUM_CHECK = 25
NO_DISTURBANCE = np.zeros(2)


class ControllerNode(BaseNode):
    """Pass messages to the controller, and publish commands, reference and status."""

    def __init__(self, runtime: Runtime) -> None:
        super().__init__(runtime, 'controller', PARAMETERS)
        guard = runtime.guard
        self._controller = Controller(
            load_mechanism(self.values['mechanism']),
            settings_from(ControllerSettings, self.values))
        self._pairs = StampPairs()
        # In simulated time the device waits for late nodes.
        self._lateness = None if self.simulated_time else LatenessDetector()
        self._log = messages.ThrottledLog(self)
        self._last_stamp_ns: int | None = None
        self._ticks = 0

        self._command = JointStatePublisher(
            self, names.FLYWHEEL_COMMAND, FLYWHEEL_NAMES, ('effort',))
        self._reference = JointStatePublisher(
            self, names.REFERENCE, LINK_NAMES, frame=messages.TABLE_FRAME)
        self._error = JointStatePublisher(self, names.TRACKING_ERROR, LINK_NAMES)
        self._energy = JointStatePublisher(self, names.ENERGY, ENERGIES, ('position',))
        self._allocation = JointStatePublisher(
            self, names.ALLOCATION, ALLOCATION, ('position',))
        self._momentum = JointStatePublisher(self, names.MOMENTUM, MOMENTUM, ('position',))
        self._status = StatusPublisher(self, self._controller, self._log)

        self.create_service(SetBool, names.ENABLE, guard(self._on_enable))
        self.create_service(Trigger, names.HOLD, guard(self._on_hold))
        self.create_service(Trigger, names.DAMP, guard(self._on_damp))
        self.create_subscription(
            JointState, names.FLYWHEEL_STATES, guard(self._on_wheels), messages.sensor_qos(self))
        self.create_subscription(
            JointState, names.ESTIMATE_LINK_STATES, guard(self._on_estimate), messages.RELIABLE)
        self.create_subscription(
            DiagnosticStatus, names.DEVICE_STATUS, guard(self._on_device_status), messages.LATCHED)
        self.create_subscription(
            JointState, names.SETPOINT, guard(self._on_setpoint), messages.RELIABLE)
        self.create_subscription(
            JointTrajectory, names.TRAJECTORY, guard(self._on_trajectory), messages.RELIABLE)
        self._status.publish_changes()

    def close(self) -> None:
        """Publish a last command of zero torque."""
        if self._last_stamp_ns is not None:
            self._command.publish(
                self._last_stamp_ns, np.zeros(4), names=FLYWHEEL_NAMES, fields=('effort',))

    def parameters_changed(self, values: dict[str, Any]) -> None:
        """Change the settings of the controller."""
        self._controller.tune(settings_from(ControllerSettings, values))
        self._status.publish_changes()

    def _on_device_status(self, message: DiagnosticStatus) -> None:
        states = [item.value for item in message.values if item.key == 'state']
        self._controller.device_armed(states == ['armed'])

    def _on_wheels(self, message: JointState) -> None:
        if tuple(message.name) == FLYWHEEL_NAMES:
            self._complete(stamp_of(message), 'wheels', (
                np.array(message.velocity), np.array(message.effort)))

    def _on_estimate(self, message: JointState) -> None:
        # The efforts of links a and b are the estimated disturbance torques.
        disturbance = (np.array(message.effort[:2]) if len(message.effort) == 4
                       else NO_DISTURBANCE)
        self._complete(stamp_of(message), 'links', (
            np.array(message.position), np.array(message.velocity), disturbance))

    def _complete(self, stamp_ns: int, kind: str, value: tuple[Any, ...]) -> None:
        """Run a control step once estimate and wheel states of a tick have arrived."""
        pair = self._pairs.complete(stamp_ns, kind, value)
        if pair is None:
            return
        late = (self._lateness is not None
                and self._lateness.is_late(stamp_ns, monotonic_ns()))
        control = self._controller.tick(stamp_ns, *pair['links'], *pair['wheels'], late=late)
        wheels, velocities, efforts = by_name(control.command)
        if control.command.by_speed:
            self._command.publish(stamp_ns, velocities, names=wheels, fields=('velocity',))
        else:
            self._command.publish(stamp_ns, efforts, names=wheels, fields=('effort',))
        self._last_stamp_ns = stamp_ns
        self._reference.publish(stamp_ns, control.reference_angles, control.reference_rates)
        self._error.publish(stamp_ns, control.angle_errors, control.rate_errors)
        self._energy.publish(stamp_ns, control.energies)
        self._ticks += 1
        if self._ticks % TICKS_PER_SCALARS == 0:
            self._allocation.publish(stamp_ns, allocation_scalars(self._controller))
            scalars, values = momentum_scalars(self._controller)
            self._momentum.publish(stamp_ns, values, names=scalars)
        self._status.tick()

    def _on_setpoint(self, message: JointState) -> None:
        self._handle_goal(names.SETPOINT, stamp_of(message), lambda: self._controller.setpoint(
            message.name, message.position, stamp_of(message)))

    def _on_trajectory(self, message: JointTrajectory) -> None:
        self._handle_goal(names.TRAJECTORY, stamp_of(message), lambda: self._controller.trajectory(
            message.joint_names, [Point(
                point.positions, point.time_from_start.sec + point.time_from_start.nanosec * 1e-9,
                point.velocities, point.accelerations, point.effort)
                for point in message.points], stamp_of(message)))

    def _handle_goal(self, topic: str, stamp_ns: int, accept: Callable[[], object]) -> None:
        try:
            accept()
        except SetpointError as error:
            self._log.warn(f'{topic} refused: {error}')
        self._status.judged_stamp = str(stamp_ns)
        self._status.publish_changes()

    def _on_enable(self, request: Any, response: Any) -> Any:
        self._controller.enable(request.data)
        response.success = True
        response.message = ('enabled' if request.data else 'not enabled: the wheels get no torque')
        self._status.publish_changes()
        return response

    def _on_hold(self, _request: Any, response: Any) -> Any:
        return self._respond(response, self._controller.hold, 'holds')

    def _on_damp(self, _request: Any, response: Any) -> Any:
        return self._respond(response, self._controller.damp, 'stops all rates')

    def _respond(self, response: Any, act: Callable[[], object], done: str) -> Any:
        try:
            act()
            response.success, response.message = True, done
        except SetpointError as error:
            response.success, response.message = False, str(error)
        self._status.publish_changes()
        return response


class StatusPublisher:
    """
    Publisher of controller_status and of the diagnostics of the controller.

    :ivar judged_stamp: stamp of the last setpoint or trajectory that was accepted or refused.
    """

    def __init__(self, node: BaseNode, controller: Controller, log: messages.ThrottledLog) -> None:
        self.judged_stamp = ''
        self._node = node
        self._controller = controller
        self._log = log
        self._refused = messages.RecentIncrease()
        self._published: tuple[object, ...] | None = None
        self._logged_problem = ''
        self._ticks = 0
        self._momentum_warning = ''
        self._publisher = node.create_publisher(
            DiagnosticStatus, names.CONTROLLER_STATUS, messages.LATCHED)
        self._diagnostics = messages.DiagnosticsPublisher(node, '', self._report)

    def tick(self) -> None:
        """Publish the status after a control step, if it changed."""
        self._ticks += 1
        if self._ticks % TICKS_PER_MOMENTUM_CHECK == 1:
            self._momentum_warning = self._controller.momentum.warning(self._controller.speeds)
        self.publish_changes()

    def publish_changes(self) -> None:
        """Publish the status if it changed."""
        controller = self._controller
        # Each new goal increases the number of accepted setpoints, so the goal itself is left out.
        state = (controller.mode, controller.goal is None, controller.accepted,
                 controller.refused, self.judged_stamp, controller.settings, controller.problem,
                 controller.branch, controller.wheels.fault_states.tobytes(),
                 self._momentum_warning)
        if state == self._published:
            return
        if controller.problem not in ('', self._logged_problem):
            self._log.warn(controller.problem)
        self._published, self._logged_problem = state, controller.problem
        goal = '' if controller.goal is None else ' '.join(
            f'{name}={angle:.6f}' for name, angle in zip(LINK_NAMES, controller.goal))
        level, summary = self._summary()
        self._publisher.publish(messages.status_message(
            self._node, '', level, summary, {
                'mode': controller.mode, 'goal': goal, 'branch': controller.branch,
                'setpoint_duration_s': controller.settings.setpoint_duration,
                'accepted': controller.accepted, 'refused': controller.refused,
                'last_refusal': controller.last_refusal, 'judged_stamp_ns': self.judged_stamp,
                'problem': controller.problem, 'wheel_faults': self._wheel_faults()}))
        self._diagnostics.publish_changes()

    def _wheel_faults(self) -> str:
        faults = self._controller.wheels.faults()
        return ', '.join(f'{name}: {fault}' for name, fault in faults.items())

    def _summary(self) -> tuple[Any, str]:
        controller = self._controller
        warnings = [text for text in (
            controller.problem, self._wheel_faults(), self._momentum_warning) if text]
        return messages.WARN if warnings else messages.OK, ', '.join((controller.mode, *warnings))

    def _report(self) -> messages.Report:
        controller = self._controller
        values: dict[str, object] = {
            'mode': controller.mode, 'setpoints_accepted': controller.accepted,
            'setpoints_refused': controller.refused, 'last_refusal': controller.last_refusal,
            'ticks_saturated': controller.saturated, 'problem': controller.problem,
            'wheel_faults': self._wheel_faults(), 'momentum': self._momentum_warning}
        if not self._ticks:
            return messages.WARN, 'waiting for flywheel_states and estimate/link_states', values
        level, summary = self._summary()
        if level == messages.OK and self._refused.update(controller.refused):
            return messages.WARN, f'{controller.mode}, setpoints were refused', values
        return level, summary, values


def main(argv: Sequence[str]) -> int:
    """Run the node."""
    return run_node(
        ControllerNode, 'controller', 'Tracking law and wheel allocation.', argv)
