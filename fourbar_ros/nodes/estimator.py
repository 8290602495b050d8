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

"""The estimator as a node: link angles and ticks in, estimates out."""

from fourbar_ros.estimation import Estimator, EstimatorSettings, STATE_NAMES
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, load_mechanism, SENSOR_NAMES
from fourbar_ros.mechanism.by_name import RejectedError
from fourbar_ros.nodes.messages import (
    Diagnostics,
    JointStatePublisher,
    OK,
    RareLog,
    Recently,
    RELIABLE,
    sensor_quality,
    stamp_of,
    TABLE_FRAME,
    WARN,
)
from fourbar_ros.nodes.parameters import declare, Parameter
from fourbar_ros.nodes.runtime import run_node
import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

DEFAULTS = EstimatorSettings()
# The upper triangle, row by row.
COVARIANCES = tuple(
    f'{row}.{column}' for n, row in enumerate(STATE_NAMES) for column in STATE_NAMES[n:])
UPPER = np.triu_indices(len(STATE_NAMES))
PARAMETERS = (
    Parameter('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    Parameter('angle_noise', DEFAULTS.angle_noise, 'rad',
              'standard deviation of a link-angle sample', limits=(1e-9, 1.0)),
    Parameter('counts_per_turn', DEFAULTS.counts_per_turn, '',
              'resolution of the link-angle sensors, 0 for none', limits=(0, 2 ** 31)),
    Parameter('gyro_noise', DEFAULTS.gyro_noise, 'rad/s',
              'standard deviation of a gyro sample, where gyros are fitted', limits=(1e-9, 100.0)),
    Parameter('gyro_walk', DEFAULTS.gyro_walk, 'rad/s/sqrt(s)',
              'density of the random walk of the bias of a gyro', limits=(0.0, 10.0)),
    Parameter('disturbance_torque', DEFAULTS.disturbance_torque, 'N m/sqrt(Hz)',
              'density of unknown torques on each link', limits=(0.0, 10.0)),
    Parameter('disturbance_walk', DEFAULTS.disturbance_walk, 'N m/sqrt(s)',
              'density of the random walk of the torques that stand for friction and drag',
              limits=(0.0, 10.0)),
    Parameter('gate_probability', DEFAULTS.gate_probability, '',
              'share of the samples of a healthy sensor that is used, 1 for no gate',
              limits=(0.9, 1.0)),
)


class EstimatorNode(Node):
    """Hand messages to the estimator and its estimates to whoever listens."""

    def __init__(self, runtime):
        super().__init__('estimator')
        values = declare(self, PARAMETERS)
        self._estimator = Estimator(
            load_mechanism(values.pop('mechanism')), EstimatorSettings(**values))
        self._log, self._rejected = RareLog(self), Recently()
        self._states = JointStatePublisher(
            self, 'estimate/link_states', LINK_NAMES, frame=TABLE_FRAME)
        self._sigma = JointStatePublisher(self, 'estimate/sigma', LINK_NAMES)
        self._covariance = JointStatePublisher(
            self, 'estimate/covariance', COVARIANCES, ('position',))
        self._innovation = JointStatePublisher(
            self, 'estimate/innovation', ('nis', 'degrees_of_freedom', *LINK_NAMES),
            ('position',))
        self.create_service(Trigger, 'estimate/reset', runtime.guard(self._on_reset))
        self._waiting = self.create_publisher(Header, 'estimate/waiting', RELIABLE)
        self._answered = None
        self._diagnostics = Diagnostics(self, '', self._collect, runtime.guard)
        self.create_subscription(
            JointState, 'link_angles', runtime.guard(self._on_angles), sensor_quality(self))
        self.create_subscription(
            JointState, 'flywheel_states', runtime.guard(self._on_tick), sensor_quality(self))

    def close(self):
        """Nothing is left to do."""

    def _on_angles(self, message):
        try:
            self._estimator.measure(
                stamp_of(message), message.name, message.position, message.velocity)
        except RejectedError as error:
            self._log.warn(f'link_angles rejected: {error}')

    def _on_tick(self, message):
        stamp_ns = stamp_of(message)
        if self._answered is not None and self._answered[0] == stamp_ns:
            # A lock-step sends a tick again when its answer was lost.
            self._answer(*self._answered)
            return
        try:
            if tuple(message.name) != FLYWHEEL_NAMES:
                raise RejectedError('wheels', f'the names must be {", ".join(FLYWHEEL_NAMES)}')
            estimate = self._estimator.tick(stamp_ns, message.velocity, message.effort)
        except RejectedError as error:
            self._log.warn(f'flywheel_states rejected: {error}')
            self._answer(stamp_ns, None)
            return
        self._answered = stamp_ns, estimate
        self._answer(stamp_ns, estimate)
        self._diagnostics.changed()

    def _on_reset(self, _request, response):
        self._estimator.reset()
        self.get_logger().info('reset on request')
        response.success, response.message = True, 'starts again from the next link_angles'
        return response

    def _answer(self, stamp_ns, estimate):
        """Publish the estimate of a tick, or that there is none: either answers a lock-step."""
        if estimate is None:
            stamp = Header()
            stamp.stamp.sec, stamp.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
            self._waiting.publish(stamp)
            return
        self._states.publish(stamp_ns, estimate.link_angles, estimate.link_rates)
        self._sigma.publish(stamp_ns, estimate.angle_sigmas, estimate.rate_sigmas)
        self._covariance.publish(stamp_ns, estimate.covariance[UPPER])
        if estimate.innovation is not None:
            self._publish_innovation(stamp_ns, estimate.innovation)

    def _publish_innovation(self, stamp_ns, innovation):
        names = ('nis', 'degrees_of_freedom',
                 *(SENSOR_NAMES[sensor] for sensor in innovation.sensors))
        self._innovation.publish(
            stamp_ns, [innovation.nis, innovation.degrees_of_freedom, *innovation.values],
            names=names)

    def _collect(self):
        estimator = self._estimator
        values = {'starts': estimator.starts, 'last_rejection': estimator.last_rejection}
        values.update((f'rejected_{kind}', count)
                      for kind, count in sorted(estimator.rejected.items()))
        values.update((f'gated_{name}', count) for name, count in sorted(estimator.gated.items()))
        faults = ', '.join(f'{name}: {fault}' for name, fault in estimator.sensor_faults().items())
        values['sensor_faults'] = faults
        if estimator.waiting_for:
            return WARN, f'waiting for {estimator.waiting_for}', values
        if faults:
            return WARN, f'running, {faults}', values
        if self._rejected.grew(estimator.rejected.total()):
            return WARN, 'running, measurements were rejected', values
        return OK, 'running', values


def main(argv):
    """Run the node."""
    return run_node(
        EstimatorNode, 'estimator', 'Kalman filter on link angles and wheel motion.', argv)
