# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The estimator as a node: link angles and ticks in, estimates out."""

from functools import partial

from fourbar_ros.common.names import (
    ESTIMATE_RESET,
    ESTIMATE_WAITING,
    FLYWHEEL_COMMAND,
    FLYWHEEL_STATES,
)
from fourbar_ros.estimation import EstimatorSettings
from fourbar_ros.estimation.estimator import BY_SPEED
from fourbar_ros.estimation.parameters import PARAMETERS
from fourbar_ros.estimation.topics import EstimatorTopics, INPUTS, OUTPUTS
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.ros.messages import (
    Diagnostics,
    JointStatePublisher,
    OK,
    RareLog,
    Recently,
    RELIABLE,
    sensor_quality,
    stamp_of,
    WARN,
)
from fourbar_ros.ros.parameters import declare
from fourbar_ros.ros.runtime import run_node
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

# Whether the diagnosis has changed is looked after every so many ticks: it takes time.
LOOK_EVERY = 5


class EstimatorNode(Node):
    """Hand messages to the estimator and its estimates to whoever listens."""

    def __init__(self, runtime):
        super().__init__('estimator')
        self._runtime = runtime
        values = declare(self, PARAMETERS)
        self._topics = EstimatorTopics(
            load_mechanism(values.pop('mechanism')), EstimatorSettings(**values))
        self._estimator = self._topics.estimator
        self._log, self._rejected = RareLog(self), Recently()
        self._listens_to_commands, self._starts, self._ticks = False, 0, 0
        self._outputs = {}
        for topic, output in OUTPUTS.items():
            if not output.optional:
                self._offer(topic)
        self._waiting = self.create_publisher(Header, ESTIMATE_WAITING, RELIABLE)
        self.create_service(Trigger, ESTIMATE_RESET, runtime.guard(self._on_reset))
        self._diagnostics = Diagnostics(self, '', self._collect, runtime.guard)
        for topic in INPUTS:
            self._listen(topic)

    def _offer(self, topic):
        output = OUTPUTS[topic]
        self._outputs[topic] = JointStatePublisher(
            self, topic, output.names, output.fields, output.frame)

    def _listen(self, topic):
        self.create_subscription(JointState, topic, self._runtime.guard(
            partial(self._receive, topic)), sensor_quality(self))

    def close(self):
        """Nothing is left to do."""

    def _receive(self, topic, message):
        answer = self._topics.receive(topic, stamp_of(message), message.name, message.position,
                                      message.velocity, message.effort)
        if answer.rejection:
            self._log.warn(f'{topic} rejected: {answer.rejection}')
        for published in answer.messages:
            self._publish(published)
        if topic == FLYWHEEL_STATES and not answer.rejection:
            self._tell_starts()
            self._ticks += 1
            if self._ticks % LOOK_EVERY == 0:
                self._diagnostics.changed()
            if self._topics.needs_commands and not self._listens_to_commands:
                # Only here: these messages cost time at every tick.
                self._listens_to_commands = True
                self._listen(FLYWHEEL_COMMAND)

    def _tell_starts(self):
        starts = self._estimator.starts
        if starts != self._starts:
            self._starts = starts
            self.get_logger().info(
                'started' if starts == 1 else f'acquired the linkage anew, start {starts}')

    def _publish(self, message):
        if message.topic == ESTIMATE_WAITING:
            stamp = Header()
            stamp.stamp.sec, stamp.stamp.nanosec = divmod(message.stamp_ns, 1_000_000_000)
            self._waiting.publish(stamp)
            return
        if message.topic not in self._outputs:
            self._offer(message.topic)
        self._outputs[message.topic].publish(
            message.stamp_ns, *message.values, names=message.names)

    def _on_reset(self, _request, response):
        self._estimator.reset()
        self.get_logger().info('reset on request')
        response.success, response.message = True, 'starts again from the next link_angles'
        return response

    def _collect(self):
        estimator = self._estimator
        values = {'starts': estimator.starts, 'last_rejection': estimator.last_rejection}
        values.update((f'rejected_{kind}', count)
                      for kind, count in sorted(estimator.rejected.items()))
        values.update((f'gated_{name}', count) for name, count in sorted(estimator.gated.items()))
        faults = ', '.join(f'{name}: {fault}' for name, fault in estimator.sensor_faults().items())
        values['sensor_faults'] = faults
        values['driven_by'] = estimator.driven_by
        if estimator.waiting_for:
            return WARN, f'waiting for {estimator.waiting_for}', values
        if faults:
            return WARN, f'running, {faults}', values
        if estimator.driven_by != BY_SPEED:
            return WARN, f'running without wheel speeds, driven by {estimator.driven_by}', values
        if self._rejected.grew(estimator.rejected.total()):
            return WARN, 'running, measurements were rejected', values
        return OK, 'running', values


def main(argv):
    """Run the node."""
    return run_node(
        EstimatorNode, 'estimator', 'Kalman filter on link angles and wheel motion.', argv)
