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

from fourbar_ros.estimation import Estimator, EstimatorSettings
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, load_mechanism
from fourbar_ros.mechanism.by_name import RejectedError
from fourbar_ros.nodes.messages import (
    Diagnostics,
    JointStatePublisher,
    OK,
    RareLog,
    Recently,
    SENSOR,
    stamp_of,
    TABLE_FRAME,
    WARN,
)
from fourbar_ros.nodes.parameters import declare, Parameter
from fourbar_ros.nodes.runtime import run_node
from rclpy.node import Node
from sensor_msgs.msg import JointState

DEFAULTS = EstimatorSettings()
PARAMETERS = (
    Parameter('mechanism', 'paper', '', 'preset or path of a mechanism file'),
    Parameter('angle_noise', DEFAULTS.angle_noise, 'rad',
              'standard deviation of a link-angle sample', limits=(1e-9, 1.0)),
    Parameter('counts_per_turn', DEFAULTS.counts_per_turn, '',
              'resolution of the link-angle sensors, 0 for none', limits=(0, 2 ** 31)),
    Parameter('disturbance_torque', DEFAULTS.disturbance_torque, 'N m/sqrt(Hz)',
              'density of unknown torques on each link', limits=(0.0, 10.0)),
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
        self._innovation = JointStatePublisher(
            self, 'estimate/innovation', ('nis', 'degrees_of_freedom', *LINK_NAMES),
            ('position',))
        self._diagnostics = Diagnostics(self, '', self._collect, runtime.guard)
        self.create_subscription(
            JointState, 'link_angles', runtime.guard(self._on_angles), SENSOR)
        self.create_subscription(
            JointState, 'flywheel_states', runtime.guard(self._on_tick), SENSOR)

    def close(self):
        """Nothing is left to do."""

    def _on_angles(self, message):
        try:
            self._estimator.measure(stamp_of(message), message.name, message.position)
        except RejectedError as error:
            self._log.warn(f'link_angles rejected: {error}')

    def _on_tick(self, message):
        stamp_ns = stamp_of(message)
        try:
            estimate = self._estimator.tick(
                stamp_ns, message.velocity if tuple(message.name) == FLYWHEEL_NAMES else ())
        except RejectedError as error:
            self._log.warn(f'flywheel_states rejected: {error}')
            return
        if estimate is not None:
            self._states.publish(stamp_ns, estimate.link_angles, estimate.link_rates)
            self._sigma.publish(stamp_ns, estimate.angle_sigmas, estimate.rate_sigmas)
            if estimate.innovation is not None:
                self._publish_innovation(stamp_ns, estimate.innovation)
        self._diagnostics.changed()

    def _publish_innovation(self, stamp_ns, innovation):
        names = ('nis', 'degrees_of_freedom', *(LINK_NAMES[link] for link in innovation.links))
        self._innovation.publish(
            stamp_ns, [innovation.nis, len(innovation.links), *innovation.angles], names=names)

    def _collect(self):
        estimator = self._estimator
        values = {'starts': estimator.starts, 'last_rejection': estimator.last_rejection}
        values.update((f'rejected_{kind}', count)
                      for kind, count in sorted(estimator.rejected.items()))
        if estimator.waiting_for:
            return WARN, f'waiting for {estimator.waiting_for}', values
        if self._rejected.grew(estimator.rejected.total()):
            return WARN, 'running, measurements were rejected', values
        return OK, 'running', values


def main(argv):
    """Run the node."""
    return run_node(
        EstimatorNode, 'estimator', 'Kalman filter on link angles and wheel motion.', argv)
