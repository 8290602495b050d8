# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The prototype without a prototype: answers on the bus as its four links would."""

from dataclasses import replace
import time

from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.settings import Setting
from fourbar_ros.hardware.bus_settings import bus_parameters, make_codec, open_bus
from fourbar_ros.hardware.emulator import (
    BUS_TROUBLES,
    check_trouble,
    ClockSettings,
    Emulator,
    LINK_TROUBLES,
    TroubleError,
)
from fourbar_ros.hardware.firmware import FirmwareSettings
from fourbar_ros.hardware.poll_loop import attend
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.ros.ground_truth import GroundTruth
from fourbar_ros.ros.parameters import declare
from fourbar_ros.ros.runtime import run_node
from fourbar_ros.ros.table_parameters import apply_faults, make_table, table_parameters
import numpy as np
from rclpy.node import Node

LETTERS = 'abcd'

PARAMETERS = (
    Setting('mechanism', 'prototype', '', 'preset or path of a mechanism file'),
    *bus_parameters('fourbar_udp', '127.0.0.1:29537', 'peers=127.0.0.1:29536'),
    Setting('links', LETTERS, '', 'those that are there, by their letters'),
    Setting('rate', 1000.0, 'Hz', 'of the electronics', low=100.0, high=2000.0),
    Setting('truth_rate', 250.0, 'Hz', 'of the ground truth on sim/', low=1.0, high=1000.0),
    Setting('command_timeout', 0.1, 's', 'longest time without a command before a link coasts',
              low=0.01, high=10.0),
    Setting('clock_offset', 100.0, 's', 'what the clocks of the links show at the start, beside '
              'some seconds between them', low=0.0, high=4000.0),
    Setting('clock_drift', 30e-6, 's/s', 'by how much links a and b run fast and c and d slow',
              low=0.0, high=1e-3),
    # The links stay where they are: nobody puts them back.
    *(replace(row, live=False) if row.name.startswith('initial.') else row
      for row in table_parameters('prototype')),
    *(Setting(f'trouble.{target}', '', '', f'{" or ".join(troubles)}', live=True)
      for target, troubles in (*((name, LINK_TROUBLES) for name in LINK_NAMES),
                               ('bus', BUS_TROUBLES))),
)
TROUBLES = tuple(row.name for row in PARAMETERS if row.name.startswith('trouble.'))

# How often ROS gets its turn [ns].
SPIN_NS = 5_000_000


class EmulatorNode(Node):
    """Move the table, talk on the bus, tell the truth."""

    def __init__(self, runtime):
        super().__init__('prototype_emulator')
        self._values = values = declare(self, PARAMETERS, self._changed)
        period_ns = round(1e9 / values['rate'])
        letters = values['links']
        if not letters or set(letters) - set(LETTERS) or len(set(letters)) < len(letters):
            raise TroubleError(f'links must be some of {LETTERS}, got {letters!r}')
        table = make_table(values, period_ns)
        self._bus = open_bus(values)
        codec = make_codec(values, table.mechanism)
        now_ns, stamp_ns = monotonic_ns(), time.time_ns()
        offset, drift = values['clock_offset'], values['clock_drift']
        self._emulator = Emulator(
            table, codec, [LETTERS.index(letter) for letter in letters],
            FirmwareSettings(values['command_timeout']),
            ClockSettings(tuple(offset + 7.0 * link for link in range(4)),
                          (drift, 0.5 * drift, -0.5 * drift, -drift)),
            # Two that are started alike are two all the same.
            np.random.default_rng(), now_ns, stamp_ns)
        self._trouble(dict.fromkeys(TROUBLES, ''), values)
        self._truth_period_ns = round(1e9 / values['truth_rate'])
        self._truth = GroundTruth(self, table, self._truth_period_ns)
        self._truth_ns = self._spin_ns = now_ns
        self._met_edge = False
        self._runtime = runtime
        self.get_logger().info(
            f'{", ".join(f"link_{letter}" for letter in letters)} with mechanism '
            f'{values["mechanism"]} on {values["bus.interface"]} {values["bus.channel"]}')

    def close(self):
        """Leave the bus."""
        self._bus.close()

    def work(self):
        """Wait for the next frame or step, and do what it takes; then let ROS have its turn."""
        emulator = self._emulator
        now_ns = attend(emulator, self._bus, monotonic_ns)
        if now_ns - self._truth_ns >= self._truth_period_ns and emulator.samples is not None:
            self._truth_ns += max(
                1, (now_ns - self._truth_ns) // self._truth_period_ns) * self._truth_period_ns
            self._truth.publish(emulator.samples.stamp_ns, emulator.samples.truth)
            self._tell_of_edge()
        if now_ns - self._spin_ns >= SPIN_NS:
            self._spin_ns = now_ns
            self._runtime.executor.spin_once(timeout_sec=0.0)

    def _tell_of_edge(self):
        """Say once what people who stand beside a table would see."""
        if not self._met_edge and 'edge' in self._emulator.table.diagnostics():
            self._met_edge = True
            self.get_logger().warning('the linkage has met the edge of the table')

    def _changed(self, values):
        """Make and end trouble and faults: what is refused leaves all as it was."""
        for name in TROUBLES:
            check_trouble(target_of(name), values[name])
        apply_faults(self._emulator.table, self._values, values)
        self._trouble(self._values, values)

    def _trouble(self, before, now):
        for name in TROUBLES:
            if now[name] != before[name]:
                self._emulator.trouble(target_of(name), now[name])


def target_of(parameter):
    """Return what `trouble.TARGET` makes trouble for."""
    return parameter.partition('.')[2]


def main(argv):
    """Run the node."""
    return run_node(
        EmulatorNode, 'prototype_emulator', 'The links of the prototype, emulated on the bus.',
        argv)
