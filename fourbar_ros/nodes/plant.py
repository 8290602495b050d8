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

"""The simulated air table as a node."""

from math import pi

from fourbar_ros.device import SimulatedTable
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, load_mechanism
from fourbar_ros.mechanism.closure import BRANCHES
from fourbar_ros.nodes import device_node
from fourbar_ros.nodes.messages import JointStatePublisher, TABLE_FRAME
from fourbar_ros.nodes.parameters import Parameter
from fourbar_ros.nodes.runtime import run_node
from fourbar_ros.plant import InitialState, load_table, Plant
import numpy as np

OWN_PARAMETERS = (
    Parameter('table', 'ideal', '', 'preset or path of a table file'),
    Parameter('clock', 'realtime', '', 'what the ticks follow', choices=('realtime',)),
    Parameter('step', 0.0005, 's', 'integration step; the period is a whole multiple of it',
              limits=(1e-6, 0.1)),
    Parameter('seed', 0, '', 'of all random numbers', limits=(0, 2 ** 63 - 1)),
    Parameter('initial.link_a', 0.0, 'rad', 'orientation of link a at the start',
              limits=(-1e6, 1e6)),
    Parameter('initial.link_b', round(pi / 3, 12), 'rad', 'orientation of link b at the start',
              limits=(-1e6, 1e6)),
    Parameter('initial.branch', 'open', '', 'assembly at the start', choices=BRANCHES),
    Parameter('initial.rate_a', 0.0, 'rad/s', 'rate of link a at the start',
              limits=(-100.0, 100.0)),
    Parameter('initial.rate_b', 0.0, 'rad/s', 'rate of link b at the start',
              limits=(-100.0, 100.0)),
)
PARAMETERS = device_node.PARAMETERS + OWN_PARAMETERS


class PlantNode(device_node.DeviceNode):
    """A testbed that also tells what really is."""

    def __init__(self, runtime):
        super().__init__(runtime, 'plant', OWN_PARAMETERS, make_device)
        self._true_links = JointStatePublisher(
            self, 'sim/link_states', LINK_NAMES, frame=TABLE_FRAME)
        self._true_wheels = JointStatePublisher(
            self, 'sim/flywheel_states', FLYWHEEL_NAMES, ('position', 'velocity', 'effort'))

    def publish_truth(self, stamp_ns, truth):
        """Publish the state without its sensors."""
        self._true_links.publish(stamp_ns, truth.link_angles, truth.link_rates)
        self._true_wheels.publish(
            stamp_ns, truth.wheel_angles, truth.wheel_speeds, truth.efforts)


def make_device(values, period_ns):
    """Make the simulated table that the parameters describe."""
    initial = InitialState(**{name.split('.')[1]: value for name, value in values.items()
                              if name.startswith('initial.')})
    plant = Plant(
        load_mechanism(values['mechanism']), load_table(values['table']), initial,
        values['step'], np.random.default_rng(values['seed']))
    return SimulatedTable(plant, period_ns)


def main(argv):
    """Run the node."""
    return run_node(PlantNode, 'plant', 'Simulated air table with the linkage on it.', argv)
