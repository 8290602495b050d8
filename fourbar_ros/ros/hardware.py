# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The prototype as a node: the topics of the plant, over a bus to four links."""

from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.settings import Setting
from fourbar_ros.hardware.bus_settings import bus_parameters, make_codec, open_bus
from fourbar_ros.hardware.prototype import Prototype
from fourbar_ros.hardware.safety_table import load_safety
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.ros import device_node
from fourbar_ros.ros.device_parameters import common_parameters
from fourbar_ros.ros.runtime import run_node

OWN_PARAMETERS = (
    *bus_parameters('socketcan', 'can0', ''),
    Setting('safety', 'prototype', '', 'preset or path of a table of limits and reactions'),
    Setting('answer_timeout', 0.002, 's', 'how long a tick waits for the wheels to answer',
              low=1e-4, high=0.1),
    Setting('gyro', False, '', 'whether the links have gyros'),
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
        monotonic_ns, stamp_of)


def main(argv):
    """Run the node."""
    return run_node(HardwareNode, 'hardware', 'The prototype, over a bus to its links.', argv)
