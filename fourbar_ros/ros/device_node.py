# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The node of a device, simulated or real: same topics, services, parameters and rules."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.common.settings import Setting, settings_of
from fourbar_ros.device import (
    ClockMode,
    ClockModeError,
    Device,
    DeviceSupervisor,
    RealtimeClock,
    Samples,
    SupervisorSettings,
    Timing,
)
from fourbar_ros.device.arming import DeviceState
from fourbar_ros.mechanism import FLYWHEEL_NAMES
from fourbar_ros.ros import messages
from fourbar_ros.ros.base_node import BaseNode, settings_from
from fourbar_ros.ros.messages import JointStatePublisher, stamp_of
from fourbar_ros.ros.runtime import Runtime
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

# Longest delay after which every missed tick is still made [ns].
CATCH_UP_NS = 100_000_000
# Topics with at most one publisher while armed: a second controller or device is an error.
SINGLE_PUBLISHER = (names.FLYWHEEL_COMMAND, names.LINK_ANGLES)
LEVELS = {DeviceState.DISARMED: messages.OK, DeviceState.ARMED: messages.OK,
          DeviceState.EMERGENCY_STOP: messages.ERROR, DeviceState.FAULT: messages.ERROR}
TIMING_NAMES = ('round_trip_s', 'command_age_s', 'lost', 'step_s')


def device_parameters(mechanism: str) -> tuple[Setting, ...]:
    """
    Return the declarations of the parameters that all devices have.

    :param mechanism: default of that parameter.
    """
    return (
        Setting('mechanism', mechanism, '', 'preset or path of a mechanism file'),
        *settings_of(SupervisorSettings),
    )


class DeviceNode(BaseNode, ABC):
    """
    Advance a device tick by tick, and pass commands on while it is armed.

    :param declarations: of all parameters, `device_parameters` among them.
    """

    def __init__(self, runtime: Runtime, name: str, declarations: Sequence[Setting]) -> None:
        super().__init__(runtime, name, declarations)
        values, guard = self.values, runtime.guard
        settings = settings_from(SupervisorSettings, values)
        self.period_ns = settings.period_ns
        self._supervisor = DeviceSupervisor(self.make_device(), settings)
        device = self._supervisor.device
        self._log, self._error_log = messages.ThrottledLog(self), messages.ThrottledLog(self)
        self._rejected = messages.RecentIncrease()
        self._publishers_of_device = DevicePublishers(self, self._supervisor, values['mechanism'])
        self.create_subscription(
            JointState, names.FLYWHEEL_COMMAND, guard(self._on_command), messages.RELIABLE)
        self.create_subscription(
            Bool, names.EMERGENCY_STOP_REQUEST, guard(self._on_emergency_stop_request),
            messages.RELIABLE)
        self.create_service(SetBool, names.ARM, guard(self._on_arm))
        self.create_service(Trigger, names.EMERGENCY_STOP, guard(self._on_emergency_stop))
        self.create_service(
            Trigger, names.RESET_EMERGENCY_STOP, guard(self._on_reset_emergency_stop))
        self._diagnostics = messages.DiagnosticsPublisher(self, device.description, self._report)
        self._catching_up = False
        # The clock starts just before its timer, so that the timer fires right after a tick is
        # due.
        self.clock_mode, poll_ns = self.make_clock_mode()
        # rclpy rounds the period down to whole nanoseconds.
        messages.create_steady_timer(self, (poll_ns + 0.5) * 1e-9, self._on_timer)
        self.publish_status()
        self.logger.info(
            f'{device.description} with mechanism {values["mechanism"]} at {values["rate"]:g} Hz')

    @abstractmethod
    def make_device(self) -> Device:
        """Return the device that the parameters describe."""

    def make_clock_mode(self) -> tuple[ClockMode, int]:
        """Return the clock that ticks follow, and the period of polling it [ns]."""
        return (RealtimeClock(time.time_ns(), monotonic_ns(), self.period_ns, CATCH_UP_NS),
                self.period_ns)

    def tick_published(self, samples: Samples) -> None:
        """Publish further topics of a tick, after its samples."""

    def stall_reason(self) -> str:
        """Return why no ticks are made, '' if they are."""
        return ''

    def close(self) -> None:
        """Remove the torque from the wheels, and publish the status."""
        self._supervisor.close()
        self.publish_status()

    def now_ns(self) -> int:
        """Return the time of the watchdogs, on the scale of the stamps [ns]."""
        return self.clock_mode.now_ns(monotonic_ns())

    def advance(self) -> None:
        """
        Make one tick that is due, and schedule the next one if that is due as well.

        Commands that arrived in between are handled before the next tick.
        """
        self._catching_up = False
        if self._supervisor.arming.state is not DeviceState.FAULT:
            stamp_ns = self.clock_mode.due(monotonic_ns())
            if stamp_ns is not None:
                self._tick(stamp_ns)
            self._catching_up = self.clock_mode.is_due(monotonic_ns())
        self.publish_status()
        if self._catching_up:
            self.runtime.executor.create_task(self.runtime.guard(self.advance))

    def step(self) -> int:
        """
        Make one tick while paused.

        :returns: its stamp [ns].
        :raises FourbarError: the clock is not paused, or no tick can be made now.
        """
        arming = self._supervisor.arming
        if arming.state is DeviceState.FAULT:
            raise ClockModeError(
                f'{arming.state.value} ({arming.reason}), call reset_emergency_stop first')
        stamp_ns = self.clock_mode.step(monotonic_ns())
        self._tick(stamp_ns)
        self.publish_status()
        return stamp_ns

    def publish_status(self) -> None:
        """Publish device_status and the diagnostics if the arming state changed."""
        if self._publishers_of_device.publish_status_changes():
            self._diagnostics.publish_changes()

    def publish_diagnostics_changes(self) -> None:
        """Publish the diagnostics if level or summary changed."""
        self._diagnostics.publish_changes()

    def repeat_tick(self, links: bool) -> None:
        """
        Publish the last tick again, unchanged.

        :param links: also its link angles.
        """
        self._publishers_of_device.publish_samples(links)

    def disarm(self, reason: str) -> None:
        """Disarm the device."""
        self._supervisor.disarm(reason)

    def _on_timer(self) -> None:
        if not self._catching_up:
            self.advance()

    def _tick(self, stamp_ns: int) -> None:
        begin_ns = monotonic_ns()
        try:
            samples, timing = self._supervisor.tick(stamp_ns, self.now_ns())
        except FourbarError as error:
            self.clock_mode.give_up()
            self._error_log.error(f'{error}: the device stands still')
            return
        step_ns = monotonic_ns() - begin_ns
        # The status precedes the tick: a node that answers the tick knows the state.
        self.publish_status()
        self._publishers_of_device.samples = samples
        self._publishers_of_device.publish_samples(links=True)
        if not samples.complete:
            return
        self._supervisor.published(self.now_ns(), step_ns)
        self._publishers_of_device.publish_timing(timing)
        self.tick_published(samples)

    def _on_command(self, message: JointState) -> None:
        stamp_ns = stamp_of(message)
        clipped = self._supervisor.clipped
        try:
            self._supervisor.command(stamp_ns, message.name, message.position,
                                     message.velocity, message.effort, self.now_ns())
        except RejectedError as error:
            self._log.warn(f'flywheel_command rejected: {error}')
        if self._supervisor.clipped > clipped:
            self._log.warn('flywheel_command exceeds a motor limit: clipped')
        # A rejected command answers the tick too: the last valid command holds until the watchdog
        # stops it.
        if self.clock_mode.answered(stamp_ns) and not self._catching_up:
            self.advance()

    def _on_arm(self, request: Any, response: Any) -> Any:
        if request.data:
            response.success, response.message = self._supervisor.arm(
                self.now_ns(), self._arming_blockers())
        else:
            self._supervisor.disarm('disarmed on request')
            response.success, response.message = True, self._supervisor.arming.state.value
        self.publish_status()
        return response

    def _arming_blockers(self) -> list[str]:
        counts = {topic: self.count_publishers(self.resolve_topic_name(topic))
                  for topic in SINGLE_PUBLISHER}
        return [f'{topic} has {count} publishers, limit 1'
                for topic, count in counts.items() if count > 1]

    def _on_emergency_stop(self, _request: Any, response: Any) -> Any:
        self._supervisor.emergency_stop('emergency_stop service')
        response.success, response.message = True, 'stopped, the wheels coast'
        self.publish_status()
        return response

    def _on_reset_emergency_stop(self, _request: Any, response: Any) -> Any:
        response.success, response.message = self._supervisor.reset()
        self.publish_status()
        return response

    def _on_emergency_stop_request(self, message: Bool) -> None:
        if message.data:
            self._supervisor.emergency_stop('emergency_stop_request')
            self.publish_status()

    def _report(self) -> messages.Report:
        arming = self._supervisor.arming
        level, summary = LEVELS[arming.state], arming.state.value
        if self._rejected.update(self._supervisor.rejected.total()) and level == messages.OK:
            level, summary = messages.WARN, f'{summary}, commands were rejected'
        for text in filter(None, (self.stall_reason(), *self._supervisor.device.diagnostics())):
            level, summary = max(level, messages.WARN), f'{summary}, {text}'
        return level, summary, {
            **self._supervisor.diagnostics(), 'ticks_skipped': self.clock_mode.skipped,
            'ticks': self.clock_mode.ticks}


class DevicePublishers:
    """
    Publishers of samples, timing and arming state.

    :param mechanism: its name, a value of device_status.
    :ivar samples: of the last tick.
    """

    samples: Samples

    def __init__(self, node: DeviceNode, supervisor: DeviceSupervisor, mechanism: str) -> None:
        self._node = node
        self._arming = supervisor.arming
        self._device = device = supervisor.device
        self._mechanism = mechanism
        self._published_state: tuple[DeviceState, str, int] | None = None
        self._links = JointStatePublisher(
            node, names.LINK_ANGLES, device.sensor_names,
            ('position', 'velocity') if device.measures_rates else ('position',),
            messages.TABLE_FRAME)
        self._wheels = JointStatePublisher(
            node, names.FLYWHEEL_STATES, FLYWHEEL_NAMES, ('position', 'velocity', 'effort'))
        self._timing = JointStatePublisher(node, names.TIMING, TIMING_NAMES, ('position',))
        self._status = node.create_publisher(
            DiagnosticStatus, names.DEVICE_STATUS, messages.LATCHED)

    def publish_samples(self, links: bool) -> None:
        """
        Publish link angles and then flywheel_states, which is the tick.

        :param links: whether to publish the link angles.
        """
        samples, wheels = self.samples, self.samples.wheels
        for sample in samples.links if links else ():
            self._links.publish(sample.stamp_ns, sample.angles, sample.rates, names=sample.names)
        if samples.complete:
            self._wheels.publish(samples.stamp_ns, wheels.angles, wheels.speeds, wheels.efforts)

    def publish_timing(self, timing: Timing) -> None:
        """Publish the timing of the loop and of the device; unknown scalars are left out."""
        scalars = {name: getattr(timing, name) for name in TIMING_NAMES}
        scalars.update(zip(self._device.timing_names, self.samples.timing))
        known = {name: value for name, value in scalars.items() if value is not None}
        self._timing.publish(self.samples.stamp_ns, list(known.values()), names=tuple(known))

    def publish_status_changes(self) -> bool:
        """Publish device_status if the arming state changed; return whether it did."""
        arming = self._arming
        state = arming.state, arming.reason, arming.since_ns
        if state == self._published_state:
            return False
        self._published_state = state
        text = f'{arming.state.value}: {arming.reason}'
        self._status.publish(messages.status_message(
            self._node, self._device.description, LEVELS[arming.state], text, {
                'state': arming.state.value, 'reason': arming.reason,
                'since': f'{arming.since_ns * 1e-9:.9f}', 'mechanism': self._mechanism}))
        self._node.logger.info(text)
        return True
