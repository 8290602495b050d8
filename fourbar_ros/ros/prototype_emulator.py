# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The links of the prototype, emulated on the bus, as a node."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
import time
from typing import Any

from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.settings import Setting, settings_of
from fourbar_ros.hardware.bus_settings import bus_parameters, make_codec, open_bus
from fourbar_ros.hardware.emulator import (
    check_injected_fault,
    Emulator,
    EmulatorError,
    EmulatorSettings,
    INJECTABLE_BUS_FAULTS,
    INJECTABLE_LINK_FAULTS,
)
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.ros.base_node import BaseNode, run_node, settings_from
from fourbar_ros.ros.runtime import Runtime
from fourbar_ros.ros.simulation import apply_faults, GroundTruth, make_table, table_parameters
import numpy as np

LETTERS = 'abcd'
# Period of running the callbacks of ROS, between the frames of the bus [ns].
CALLBACK_PERIOD_NS = 5_000_000

PARAMETERS = (
    Setting('mechanism', 'prototype', '', 'preset or path of a mechanism file'),
    *bus_parameters('fourbar_udp', '127.0.0.1:29537', 'peers=127.0.0.1:29536'),
    Setting('links', LETTERS, '', 'letters of the links that exist'),
    *settings_of(EmulatorSettings),
    # The links are placed at the start only: this node has no sim/reset.
    *(replace(row, live=False) if row.name.startswith('initial.') else row
      for row in table_parameters('prototype')),
    *(Setting(f'trouble.{target}', '', '', ' or '.join(troubles), live=True)
      for target, troubles in (*((name, INJECTABLE_LINK_FAULTS) for name in LINK_NAMES),
                               ('bus', INJECTABLE_BUS_FAULTS))),
)
# Target of each parameter that causes trouble on the bus.
TROUBLES = {row.name: row.name.partition('.')[2] for row in PARAMETERS
            if row.name.startswith('trouble.')}


class EmulatorNode(BaseNode):
    """Step the emulated links, serve their bus and publish the ground truth."""

    def __init__(self, runtime: Runtime) -> None:
        super().__init__(runtime, 'prototype_emulator', PARAMETERS)
        values = self.values
        letters = values['links']
        if not letters or set(letters) - set(LETTERS) or len(set(letters)) < len(letters):
            raise EmulatorError(f'links must be some of {LETTERS}, got {letters!r}',
                                name='links', value=letters, limit=LETTERS)
        self._table = make_table(values, round(1e9 / values['rate']))
        self._bus = open_bus(values)
        now_ns, stamp_ns = monotonic_ns(), time.time_ns()
        settings = settings_from(EmulatorSettings, values)
        self._emulator = Emulator(
            self._table, make_codec(values, self._table.mechanism),
            [LETTERS.index(letter) for letter in letters], settings,
            # Without a seed: two emulators with equal parameters still have different jitter.
            np.random.default_rng(), now_ns, stamp_ns)
        self._apply_trouble(dict.fromkeys(TROUBLES, ''), values)
        self._truth_period_ns = round(1e9 / values['truth_rate'])
        self._truth = GroundTruth(self, self._table, self._truth_period_ns)
        self._truth_ns = self._callbacks_ns = now_ns
        self._edge_reported = False
        self.logger.info(
            f'{", ".join(f"link_{letter}" for letter in letters)} with mechanism '
            f'{values["mechanism"]} on {values["bus.interface"]} {values["bus.channel"]}')

    def close(self) -> None:
        """Close the bus."""
        self._bus.close()

    def run_once(self) -> None:
        """Serve the next frame or step; then publish the ground truth and run callbacks if due."""
        emulator = self._emulator
        now_ns = emulator.serve(self._bus, monotonic_ns)
        samples = emulator.samples
        if (now_ns - self._truth_ns >= self._truth_period_ns and samples is not None
                and samples.truth is not None):
            self._truth_ns += max(
                1, (now_ns - self._truth_ns) // self._truth_period_ns) * self._truth_period_ns
            self._truth.publish(samples.stamp_ns, samples.truth)
            self._report_edge()
        if now_ns - self._callbacks_ns >= CALLBACK_PERIOD_NS:
            self._callbacks_ns = now_ns
            self.runtime.spin_once(0.0)

    def parameters_changed(self, values: dict[str, Any]) -> None:
        """Set and clear trouble and faults; a refused value changes nothing."""
        for name, target in TROUBLES.items():
            check_injected_fault(target, values[name])
        apply_faults(self._table, self.values, values)
        self._apply_trouble(self.values, values)

    def _report_edge(self) -> None:
        """Log the first contact with the edge, which an operator would see on a real table."""
        if not self._edge_reported and 'edge' in self._table.diagnostics():
            self._edge_reported = True
            self.logger.warning('the linkage has met the edge of the table')

    def _apply_trouble(self, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
        for name, target in TROUBLES.items():
            if now[name] != before[name]:
                self._emulator.inject_fault(target, now[name])


def main(argv: Sequence[str]) -> int:
    """Run the node."""
    return run_node(
        EmulatorNode, 'prototype_emulator', 'The links of the prototype, emulated on the bus.',
        argv)
