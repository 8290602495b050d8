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

"""The prototype as a node: the topics of the plant, over a bus to four links."""

from fourbar_ros.device.prototype.parameters import bus_parameters, make_codec, open_bus
from fourbar_ros.device.prototype.prototype import Prototype
from fourbar_ros.device.prototype.safety import load_safety
from fourbar_ros.device.steady import steady_ns
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.nodes import device_node
from fourbar_ros.nodes.device_parameters import common_parameters
from fourbar_ros.nodes.parameters import Parameter
from fourbar_ros.nodes.runtime import run_node

OWN_PARAMETERS = (
    *bus_parameters('socketcan', 'can0', ''),
    Parameter('safety', 'prototype', '', 'preset or path of a table of limits and reactions'),
    Parameter('answer_timeout', 0.002, 's', 'how long a tick waits for the wheels to answer',
              limits=(1e-4, 0.1)),
    Parameter('gyro', False, '', 'whether the links have gyros'),
)
PARAMETERS = common_parameters('prototype') + OWN_PARAMETERS


class HardwareNode(device_node.DeviceNode):
    """A testbed that stands on a table."""

    def __init__(self, runtime):
        super().__init__(runtime, 'hardware', PARAMETERS, make_device)


def make_device(values, period_ns, stamp_of):
    """Reach the prototype that the parameters describe."""
    mechanism = load_mechanism(values['mechanism'])
    return Prototype(
        mechanism, lambda: open_bus(values), make_codec(values, mechanism),
        load_safety(values['safety']), period_ns, values['answer_timeout'], values['gyro'],
        steady_ns, stamp_of)


def main(argv):
    """Run the node."""
    return run_node(HardwareNode, 'hardware', 'The prototype, over a bus to its links.', argv)
