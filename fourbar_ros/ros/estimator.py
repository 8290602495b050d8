# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The estimator as a node: link angles and ticks in, estimates out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from fourbar_ros.common.names import (
    ESTIMATE_RESET,
    ESTIMATE_WAITING,
    FLYWHEEL_COMMAND,
    FLYWHEEL_STATES,
)
from fourbar_ros.estimation import EstimatorSettings
from fourbar_ros.estimation.estimator_settings import PARAMETERS
from fourbar_ros.estimation.estimator_topics import (
    EstimatorTopics,
    INPUTS,
    OutputMessage,
    OUTPUTS,
)
from fourbar_ros.estimation.wheel_motion import BY_SPEED
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.ros import messages
from fourbar_ros.ros.base_node import BaseNode, run_node, settings_from
from fourbar_ros.ros.messages import JointStatePublisher, stamp_of
from fourbar_ros.ros.runtime import Runtime
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

# Ticks between two comparisons of the diagnostics, which take time.
TICKS_PER_DIAGNOSTICS = 5


class EstimatorNode(BaseNode):
    """Pass messages to the estimator, and publish its estimates."""

    def __init__(self, runtime: Runtime) -> None:
        super().__init__(runtime, 'estimator', PARAMETERS)
        self._topics = EstimatorTopics(
            load_mechanism(self.values['mechanism']),
            settings_from(EstimatorSettings, self.values))
        self._estimator = self._topics.estimator
        self._log, self._rejected = messages.ThrottledLog(self), messages.RecentIncrease()
        self._subscribed_to_commands, self._starts, self._ticks = False, 0, 0
        self._outputs: dict[str, JointStatePublisher] = {}
        for topic, output in OUTPUTS.items():
            if not output.optional:
                self._create_output(topic)
        self._waiting = self.create_publisher(Header, ESTIMATE_WAITING, messages.RELIABLE)
        self.create_service(Trigger, ESTIMATE_RESET, runtime.guard(self._on_reset))
        self._diagnostics = messages.DiagnosticsPublisher(self, '', self._report)
        for topic in INPUTS:
            self._subscribe(topic)

    def _create_output(self, topic: str) -> None:
        output = OUTPUTS[topic]
        self._outputs[topic] = JointStatePublisher(
            self, topic, output.names, output.fields, output.frame)

    def _subscribe(self, topic: str) -> None:
        self.create_subscription(JointState, topic, self.runtime.guard(
            partial(self._on_input, topic)), messages.sensor_qos(self))

    def _on_input(self, topic: str, message: JointState) -> None:
        answer = self._topics.receive(topic, stamp_of(message), message.name, message.position,
                                      message.velocity, message.effort)
        if answer.rejection:
            self._log.warn(f'{topic} rejected: {answer.rejection}')
        for output in answer.messages:
            self._publish(output)
        if topic == FLYWHEEL_STATES and not answer.rejection:
            self._log_starts()
            self._ticks += 1
            if self._ticks % TICKS_PER_DIAGNOSTICS == 0:
                self._diagnostics.publish_changes()
            if self._topics.needs_commands and not self._subscribed_to_commands:
                # Only now: these messages take time at every tick.
                self._subscribed_to_commands = True
                self._subscribe(FLYWHEEL_COMMAND)

    def _log_starts(self) -> None:
        starts = self._estimator.starts
        if starts != self._starts:
            self._starts = starts
            self.logger.info(
                'started' if starts == 1 else f'acquired the linkage again, start {starts}')

    def _publish(self, output: OutputMessage) -> None:
        if output.topic == ESTIMATE_WAITING:
            header = Header()
            messages.write_stamp(header.stamp, output.stamp_ns)
            self._waiting.publish(header)
            return
        if output.topic not in self._outputs:
            self._create_output(output.topic)
        self._outputs[output.topic].publish(
            output.stamp_ns, *output.values, names=output.names)

    def _on_reset(self, _request: Any, response: Any) -> Any:
        self._estimator.reset()
        self.logger.info('reset on request')
        response.success, response.message = True, 'starts again from the next link_angles'
        return response

    def _report(self) -> messages.Report:
        estimator = self._estimator
        values: dict[str, object] = {
            'starts': estimator.starts, 'last_rejection': estimator.last_rejection}
        values.update((f'rejected_{kind}', count)
                      for kind, count in sorted(estimator.rejected.items()))
        values.update((f'gated_{name}', count) for name, count in sorted(estimator.gated.items()))
        faults = ', '.join(f'{name}: {fault}' for name, fault in estimator.sensor_faults().items())
        values['sensor_faults'] = faults
        values['driven_by'] = estimator.driven_by
        if estimator.waiting_for:
            return messages.WARN, f'waiting for {estimator.waiting_for}', values
        if faults:
            return messages.WARN, f'running, {faults}', values
        if estimator.driven_by != BY_SPEED:
            text = f'running without wheel speeds, driven by {estimator.driven_by}'
            return messages.WARN, text, values
        if self._rejected.update(estimator.rejected.total()):
            return messages.WARN, 'running, measurements were rejected', values
        return messages.OK, 'running', values


def main(argv: Sequence[str]) -> int:
    """Run the node."""
    return run_node(
        EstimatorNode, 'estimator', 'Kalman filter on link angles and wheel motion.', argv)
