# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated air table as a node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import struct
from typing import Any

from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.settings import Setting
from fourbar_ros.device import (
    ClockMode,
    Device,
    FastClock,
    LockstepClock,
    LockstepGuard,
    Participants,
    RateLimit,
    Recovery,
    Samples,
)
from fourbar_ros.loop.scenario import PlantSettings
from fourbar_ros.ros.base_node import run_node
from fourbar_ros.ros.device_node import CATCH_UP_NS, device_parameters, DeviceNode
from fourbar_ros.ros.messages import create_steady_timer, RELIABLE, ThrottledLog, write_stamp
from fourbar_ros.ros.runtime import Runtime
from fourbar_ros.ros.simulation import (
    apply_faults,
    GroundTruth,
    initial_state,
    make_table,
    table_parameters,
)
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

# Limits of the period of polling a simulated clock [ns]; a poll makes all ticks that are due.
SHORTEST_POLL_NS = 500_000
LONGEST_POLL_NS = 50_000_000
# Shortest period of /clock [ns of the monotonic clock].
CLOCK_NS = 5_000_000
# Longest period of /clock [ns]: nodes that start while time is paused need the time too.
IDLE_CLOCK_NS = 50_000_000
# Period of counting the participants of a lock-step [ns].
GRAPH_POLL_NS = 50_000_000
# Time that nodes need to discover each other [ns].
SETTLE_NS = 500_000_000
# Stamp in a serialized message with a header: it follows four bytes of encapsulation.
SERIALIZED_STAMP = struct.Struct('<4xiI')

_TABLE, *_OTHERS = table_parameters('ideal')
PARAMETERS = (
    *(replace(row, default=PlantSettings.command_timeout) if row.name == 'command_timeout' else row
      for row in device_parameters('paper')),
    _TABLE,
    Setting('clock', 'realtime', '', 'clock that the ticks follow',
            choices=('realtime', 'fast', 'lockstep')),
    Setting('real_time_factor', 1.0, '', 'simulated seconds per second of the fast clock, 0 '
            'for as fast as possible', low=0.0, high=1000.0),
    Setting('guard_timeout', 1.0, 's', 'time without an answer after which lock-step reports '
            'which node it waits for', low=0.05, high=3600.0),
    Setting('start_paused', False, '', 'wait for sim/step or sim/pause before the first tick'),
    *_OTHERS,
)


class PlantNode(DeviceNode):
    """The node of the simulated table, with the topics and services under sim/."""

    # The base class calls methods of this one before these are made.
    _lockstep: Lockstep | None = None
    _simulated_clock: SimulatedClock | None = None

    def __init__(self, runtime: Runtime) -> None:
        super().__init__(runtime, 'plant', PARAMETERS)
        self._ground_truth = GroundTruth(self, self._table, self.period_ns)
        if isinstance(self.clock_mode, LockstepClock):
            self._lockstep = Lockstep(
                self, self.clock_mode, round(self.values['guard_timeout'] * 1e9))
        if self.simulated_time:
            self._simulated_clock = SimulatedClock(self)
        guard = runtime.guard
        self.create_service(SetBool, names.SIM_PAUSE, guard(self._on_pause))
        self.create_service(Trigger, names.SIM_STEP, guard(self._on_step))
        self.create_service(Trigger, names.SIM_RESET, guard(self._on_reset))

    @property
    def simulated_time(self) -> bool:
        """Whether stamps are simulated time, whatever use_sim_time says."""
        return bool(self.values['clock'] != 'realtime')

    def make_device(self) -> Device:
        """Return the simulated table that the parameters describe."""
        self._table = make_table(self.values, self.period_ns)
        return self._table

    def make_clock_mode(self) -> tuple[ClockMode, int]:
        """Return the clock that the parameter `clock` names, and its polling period [ns]."""
        clock, poll_ns = super().make_clock_mode()
        if self.values['clock'] == 'lockstep':
            clock, poll_ns = LockstepClock(self.period_ns), LONGEST_POLL_NS
        elif self.values['clock'] == 'fast':
            factor = self.values['real_time_factor']
            clock = FastClock(monotonic_ns(), self.period_ns, factor, CATCH_UP_NS)
            poll_ns = round(self.period_ns / factor) if factor else 0
            poll_ns = max(SHORTEST_POLL_NS, min(poll_ns, LONGEST_POLL_NS))
        if self.values['start_paused']:
            clock.pause(monotonic_ns())
        return clock, poll_ns

    def parameters_changed(self, values: dict[str, Any]) -> None:
        """Set and clear faults."""
        apply_faults(self._table, self.values, values)

    def tick_published(self, samples: Samples) -> None:
        """Publish the ground truth, and the time where it is simulated."""
        if samples.truth is not None:
            self._ground_truth.publish(samples.stamp_ns, samples.truth)
        if self._simulated_clock is not None:
            self._simulated_clock.publish()

    def stall_reason(self) -> str:
        """Return that the clock is paused, and which node a lock-step waits for."""
        overdue = self._lockstep.overdue() if self._lockstep is not None else ''
        paused = 'paused' if self.clock_mode.paused else ''
        return ', '.join(filter(None, (paused, overdue and f'waiting for {overdue}')))

    def recover(self, recovery: Recovery) -> None:
        """Repeat or give up a tick that a lock-step waits for, and publish the diagnostics."""
        if recovery is Recovery.GIVE_UP:
            self.disarm('estimator or controller joined too late for a tick')
            self.clock_mode.give_up()
            self.advance()
        elif recovery is not Recovery.NOTHING:
            self.repeat_tick(links=recovery is Recovery.SEND_ALL)
        self.publish_diagnostics_changes()

    def _on_pause(self, request: Any, response: Any) -> Any:
        if request.data:
            self.clock_mode.pause(monotonic_ns())
        else:
            self.clock_mode.resume(monotonic_ns())
        response.success = True
        response.message = (
            f'{"paused" if request.data else "running"} at {seconds(self.now_ns())}')
        self.advance()
        return response

    def _on_step(self, _request: Any, response: Any) -> Any:
        # A step no longer waits for a node that was reported as missing: otherwise nothing could
        # be done while paused.
        if (self.clock_mode.paused and self._lockstep is not None and self._lockstep.overdue()):
            self.clock_mode.give_up()
        try:
            response.message = f'tick at {seconds(self.step())}'
            response.success = True
        except FourbarError as error:
            response.success, response.message = False, f'refused: {error}'
        return response

    def _on_reset(self, _request: Any, response: Any) -> Any:
        try:
            self._table.reset(initial_state(self.values))
            self.disarm('sim/reset')
            self.publish_status()
            response.success = True
            response.message = f'reset and disarmed at {seconds(self.now_ns())}'
        except FourbarError as error:
            response.success, response.message = False, f'refused: {error}'
        return response


class SimulatedClock:
    """Publisher of /clock; the device does not depend on it."""

    def __init__(self, node: DeviceNode) -> None:
        self._clock_mode = node.clock_mode
        self._limit = RateLimit(CLOCK_NS)
        self._message = ClockMessage()
        self._publisher = node.create_publisher(ClockMessage, names.CLOCK, RELIABLE)
        create_steady_timer(node, IDLE_CLOCK_NS * 1e-9, self.publish)

    def publish(self) -> None:
        """Publish the time, at most once per CLOCK_NS."""
        now_ns = monotonic_ns()
        if self._limit.passes(now_ns):
            write_stamp(self._message.clock, self._clock_mode.now_ns(now_ns))
            self._publisher.publish(self._message)


class Lockstep:
    """
    Count the nodes that answer ticks, and report a node whose answer is overdue.

    :param timeout_ns: time without an answer after which a node is overdue [ns].
    """

    def __init__(self, plant: PlantNode, clock: LockstepClock, timeout_ns: int) -> None:
        self._plant = plant
        self._clock = clock
        self._log = ThrottledLog(plant)
        self._guard = LockstepGuard(clock, timeout_ns, SETTLE_NS)
        self._reported = ''
        self._estimate: bytes | None = None
        guard = plant.runtime.guard
        # Raw: only the stamp of the last estimate is read, and only when an answer is overdue.
        plant.create_subscription(JointState, names.ESTIMATE_LINK_STATES,
                                  guard(self._on_estimate), RELIABLE, raw=True)
        plant.create_subscription(
            Header, names.ESTIMATE_WAITING, guard(self._on_waiting), RELIABLE)
        create_steady_timer(plant, GRAPH_POLL_NS * 1e-9, self._check_participants)

    def overdue(self) -> str:
        """Return the node whose answer to the tick is overdue, '' for none."""
        return self._guard.waiting_for(self._estimate_ns(), monotonic_ns())

    def _on_waiting(self, message: Header) -> None:
        # Without an estimate the controller sends no command at this tick.
        if self._clock.answered(message.stamp.sec * 1_000_000_000 + message.stamp.nanosec):
            self._plant.advance()

    def _on_estimate(self, serialized: bytes) -> None:
        self._estimate = serialized

    def _estimate_ns(self) -> int | None:
        if self._estimate is None:
            return None
        seconds, nanoseconds = SERIALIZED_STAMP.unpack_from(self._estimate)
        return int(seconds * 1_000_000_000 + nanoseconds)

    def _check_participants(self) -> None:
        plant, now_ns = self._plant, monotonic_ns()

        def publishers(topic: str) -> list[Any]:
            return list(plant.get_publishers_info_by_topic(plant.resolve_topic_name(topic)))

        def subscribers(topic: str) -> list[Any]:
            return list(plant.get_subscriptions_info_by_topic(plant.resolve_topic_name(topic)))

        def node_of(info: Any) -> tuple[str, str]:
            return info.node_namespace, info.node_name
        commanders = publishers(names.FLYWHEEL_COMMAND)
        controllers = set(map(node_of, commanders))
        self._guard.update(Participants(
            len(subscribers(names.FLYWHEEL_STATES)), len(subscribers(names.LINK_ANGLES)),
            len(commanders), len(publishers(names.ESTIMATE_LINK_STATES)),
            # Subscribers that only monitor need no estimator.
            sum(node_of(info) in controllers
                for info in subscribers(names.ESTIMATE_LINK_STATES))), now_ns)
        overdue = self.overdue()
        if overdue and overdue != self._reported:
            self._log.warn(f'lock-step waits for the {overdue}')
        if overdue or self._reported:
            self._plant.recover(self._guard.recovery(self._estimate_ns(), now_ns))
        self._reported = overdue


def seconds(time_ns: int) -> str:
    """Write a time [ns] in seconds, without rounding it."""
    return f'{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000:09d} s'


def main(argv: Sequence[str]) -> int:
    """Run the node."""
    return run_node(PlantNode, 'plant', 'Simulated air table with the linkage on it.', argv)
