# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The prototype as a node: the topics of the plant, over a bus to four links."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.settings import settings_of
from fourbar_ros.device import Device
from fourbar_ros.hardware.bus_settings import bus_parameters, make_codec, open_bus
from fourbar_ros.hardware.prototype import Prototype, PrototypeSettings
from fourbar_ros.hardware.safety_table import load_safety
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.ros.base_node import run_node, settings_from
from fourbar_ros.ros.device_node import device_parameters, DeviceNode
from fourbar_ros.ros.runtime import Runtime

PARAMETERS = (
    *device_parameters('prototype'),
    *bus_parameters('socketcan', 'can0', ''),
    *settings_of(PrototypeSettings),
)


class HardwareNode(DeviceNode):
    """The node of the prototype."""

    def __init__(self, runtime: Runtime) -> None:
        super().__init__(runtime, 'hardware', PARAMETERS)

    def make_device(self) -> Device:
        """Return the prototype that the parameters describe."""
        values = self.values
        mechanism = load_mechanism(values['mechanism'])
        settings = settings_from(PrototypeSettings, values)
        return Prototype(
            mechanism, lambda: open_bus(values), make_codec(values, mechanism),
            load_safety(settings.safety), settings, self.period_ns, monotonic_ns,
            lambda time_ns: self.clock_mode.now_ns(time_ns))


def main(argv: Sequence[str]) -> int:
    """Run the node."""
    return run_node(HardwareNode, 'hardware', 'The prototype, over a bus to its links.', argv)
