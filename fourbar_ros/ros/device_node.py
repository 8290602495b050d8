# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The ROS shell of a testbed, simulated or real: same topics, same services, same rules."""

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.common.settings import settings_of
from fourbar_ros.device import ClockModeError, DeviceSupervisor, SupervisorSettings
from fourbar_ros.device.arming import DeviceState
from fourbar_ros.ros.device_topics import DeviceTopics, LEVELS
from fourbar_ros.ros.gate_services import GateServices
from fourbar_ros.ros.messages import (
    Diagnostics,
    OK,
    RareLog,
    Recently,
    RELIABLE,
    stamp_of,
    WARN,
)
from fourbar_ros.ros.paces import realtime_pace
from fourbar_ros.ros.parameters import declare
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState


class DeviceNode(Node):
    """
    Drive a device tick by tick and let its commands through the arming gate.

    :param parameters: the node's table, the common ones among them.
    :param make_device: called with the values of all parameters, the period [ns], and what turns
        the time of the steady clock into that of stamps [ns], once there are ticks.
    :param make_pace: called with the same, returns the pace and how often to look at it [ns].
    """

    def __init__(self, runtime, name, parameters, make_device, make_pace=None):
        super().__init__(name)
        guard = runtime.guard
        # Changed in place when somebody sets a parameter.
        self._values = values = declare(self, parameters, self.parameters_changed)
        period_ns = round(1e9 / values['rate'])
        self._testbed = DeviceSupervisor(
            make_device(values, period_ns, lambda time_ns: self._pace.now_ns(time_ns)),
            SupervisorSettings(**{row.name: values[row.name]
                                  for row in settings_of(SupervisorSettings)}))
        device = self._testbed.device
        self._log, self._errors, self._rejected = RareLog(self), RareLog(self), Recently()
        self._topics = DeviceTopics(self, self._testbed, values['mechanism'])
        self.create_subscription(JointState, 'flywheel_command', guard(self._on_command), RELIABLE)
        GateServices(self, self._testbed, guard, self.now_ns, self._announce)
        self._diagnostics = Diagnostics(self, device.description, self._collect, guard)
        self._catching_up = False
        self._soon = lambda callback: runtime.executor.create_task(guard(callback))
        # One after the other, so that the timer fires right after a tick is due.
        self._pace, poll_ns = (make_pace or realtime_pace)(values, period_ns)
        self.create_timer((poll_ns + 0.5) * 1e-9, guard(self._on_timer),  # rclpy rounds down
                          clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._announce()
        self.get_logger().info(
            f'{device.description} with mechanism {values["mechanism"]} at {values["rate"]:g} Hz')

    def parameters_changed(self, values):
        """Take note of other parameters; what is raised here refuses them."""

    def close(self):
        """Leave the wheels without torque, and say so."""
        self._testbed.close()
        self._announce()

    def now_ns(self):
        """Read the clock of the watchdogs, on the scale of the stamps [ns]."""
        return self._pace.now_ns(monotonic_ns())

    def ticked(self, stamp_ns, truth):
        """Do what else belongs to a tick, after it went out; `truth` where a device has it."""

    def hindrance(self):
        """Tell what keeps ticks from coming, '' if nothing does."""
        return ''

    def _on_timer(self):
        if not self._catching_up:
            self.advance()

    def advance(self):
        """Make one tick that is due; the next one, if it is late too, after waiting commands."""
        self._catching_up = False
        # Nothing moves while the device is broken, so no tick is taken that would not go out.
        if self._testbed.gate.state is not DeviceState.FAULT:
            stamp_ns = self._pace.due(monotonic_ns())
            if stamp_ns is not None:
                self._tick(stamp_ns)
            self._catching_up = self._pace.is_due(monotonic_ns())
        self._announce()
        if self._catching_up:
            self._soon(self.advance)

    def step(self):
        """
        Make one tick while paused.

        :returns: its stamp [ns].
        :raises FourbarError: it is not paused, or there can be no tick now.
        """
        gate = self._testbed.gate
        if gate.state is DeviceState.FAULT:
            raise ClockModeError(
                f'{gate.state.value} ({gate.reason}), call reset_emergency_stop first')
        stamp_ns = self._pace.step(monotonic_ns())
        self._tick(stamp_ns)
        self._announce()
        return stamp_ns

    def _tick(self, stamp_ns):
        begin_ns = monotonic_ns()
        try:
            samples, timing = self._testbed.tick(stamp_ns, self.now_ns())
        except FourbarError as error:
            self._pace.give_up()
            self._errors.error(f'{error}: the device stands still')
            return
        step_ns = monotonic_ns() - begin_ns
        # Whoever answers the tick should know by then what state the device is in.
        self._announce()
        self._topics.publish_samples(samples)
        if not samples.complete:
            return
        self._testbed.published(self.now_ns(), step_ns)
        self._topics.publish_timing(stamp_ns, timing)
        self.ticked(stamp_ns, samples.truth)

    def _on_command(self, message):
        stamp_ns = stamp_of(message)
        clipped = self._testbed.clipped
        try:
            self._testbed.command(stamp_ns, message.name, message.position,
                                  message.velocity, message.effort, self.now_ns())
        except RejectedError as error:
            self._log.warn(f'flywheel_command rejected: {error}')
        if self._testbed.clipped > clipped:
            self._log.warn('flywheel_command asks more than a motor has: clipped')
        # Even a rejected one: the last good command holds until the watchdog, as ever.
        if self._pace.answered(stamp_ns) and not self._catching_up:
            self.advance()

    def _announce(self):
        """Publish the gate's state if it changed."""
        if self._topics.announce():
            self._diagnostics.changed()

    def _collect(self):
        gate = self._testbed.gate
        level, summary = LEVELS[gate.state], gate.state.value
        if self._rejected.grew(self._testbed.rejected.total()) and level == OK:
            level, summary = WARN, f'{summary}, commands were rejected'
        for trouble in filter(None, (self.hindrance(), *self._testbed.device.diagnostics())):
            level, summary = max(level, WARN), f'{summary}, {trouble}'
        return level, summary, {
            **self._testbed.diagnostics(), 'ticks_skipped': self._pace.skipped,
            'ticks': self._pace.ticks}
