# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated table of the plant and of the emulator: parameters, faults, ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from math import cos, sin
from typing import Any

from fourbar_ros.common import names
from fourbar_ros.common.settings import Setting, settings_of
from fourbar_ros.device import TrueState
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, load_mechanism, SENSOR_NAMES
from fourbar_ros.plant import InitialState, load_table, Plant, SimulationSettings
from fourbar_ros.plant.energy_budget import EnergyBudget
from fourbar_ros.plant.fault_schedule import read_schedule
from fourbar_ros.ros.base_node import BaseNode, settings_from
from fourbar_ros.ros.messages import JointStatePublisher, RELIABLE, TABLE_FRAME, write_stamp
from nav_msgs.msg import Odometry
import numpy as np

# Scalars of sim/ledger: energies, angular momenta, then the number of contacts with the edge.
LEDGER_NAMES = tuple(
    item.name if item.name == 'contacts' else
    f'{item.name}_n_m_s' if item.name.endswith('_spin') else f'{item.name}_j'
    for item in fields(EnergyBudget))
# Rate of sim/ledger [Hz in stamps]: its scalars are sums, which change slowly.
LEDGER_RATE = 10.0


def table_parameters(table: str) -> tuple[Setting, ...]:
    """
    Return the declarations of the parameters of a simulated table.

    :param table: default of that parameter.
    """
    return (
        Setting('table', table, '', 'preset or path of a table file'),
        *settings_of(SimulationSettings),
        Setting('fault_schedule', '', '', 'path of a YAML file of faults that come and go',
                live=True),
        *(Setting(f'fault.{name}', '', '', 'fault of the sensor, as `off` or `wrong 0.1`',
                  live=True) for name in SENSOR_NAMES),
        *(Setting(f'fault.{name}', '', '', 'fault of the wheel, as `dead` or `weak 0.5`',
                  live=True) for name in FLYWHEEL_NAMES),
        # Twelve digits of the defaults are legible in a parameters file.
        *(replace(row, default=round(row.default, 12)) if row.kind is float else row
          for row in settings_of(InitialState, 'initial.')),
    )


FAULT_PARAMETERS = tuple(
    row.name for row in table_parameters('') if row.name.startswith('fault'))


def initial_state(values: Mapping[str, Any]) -> InitialState:
    """Return the initial state that the parameters describe."""
    return settings_from(InitialState, values, 'initial.')


def make_table(values: Mapping[str, Any], period_ns: int) -> SimulatedTable:
    """Return the simulated table that the parameters describe."""
    plant = Plant(
        load_mechanism(values['mechanism']), load_table(values['table']), initial_state(values),
        values['step'], np.random.default_rng(values['seed']))
    table = SimulatedTable(plant, period_ns)
    apply_faults(table, dict.fromkeys(FAULT_PARAMETERS, ''), values)
    return table


def apply_faults(table: SimulatedTable, before: Mapping[str, Any], now: Mapping[str, Any]
                 ) -> None:
    """
    Set, clear and schedule the faults whose parameters changed.

    :param before, now: values of the parameters.
    :raises FaultError, ConfigurationError: a fault, its target or a schedule is refused; then
        nothing changed.
    """
    changed = [name for name in FAULT_PARAMETERS if now[name] != before[name]]
    faults = {}
    for name in changed:
        target = name.partition('.')[2]
        if target:
            faults[target] = table.injected_faults.parse(target, now[name])
    if 'fault_schedule' in changed:
        path = now['fault_schedule']
        table.schedule_faults(read_schedule(path) if path else [], path)
    for target, fault in faults.items():
        table.break_down(target, fault)


class GroundTruth:
    """
    Publisher of the true state and of the budgets of energy and momentum.

    :param period_ns: period of the calls of `publish` [ns].
    """

    def __init__(self, node: BaseNode, table: SimulatedTable, period_ns: int) -> None:
        self._table = table
        self._links = JointStatePublisher(
            node, names.SIM_LINK_STATES, LINK_NAMES, frame=TABLE_FRAME)
        self._wheels = JointStatePublisher(
            node, names.SIM_FLYWHEEL_STATES, FLYWHEEL_NAMES, ('position', 'velocity', 'effort'))
        self._ledger = JointStatePublisher(
            node, names.SIM_LEDGER, LEDGER_NAMES, ('position',))
        self._ticks_per_ledger = max(1, round(1e9 / period_ns / LEDGER_RATE))
        self._ticks = 0
        self._odometry = node.create_publisher(Odometry, names.SIM_ODOMETRY, RELIABLE)
        self._message = Odometry()
        self._message.header.frame_id = TABLE_FRAME
        self._message.child_frame_id = LINK_NAMES[0]
        # Load the kernels of the budget now: at the first message they would delay the ticks.
        table.ledger()

    def publish(self, stamp_ns: int, truth: TrueState) -> None:
        """Publish the true state at a tick."""
        self._links.publish(stamp_ns, truth.link_angles, truth.link_rates)
        self._wheels.publish(stamp_ns, truth.wheel_angles, truth.wheel_speeds, truth.efforts)
        self._publish_odometry(stamp_ns, truth)
        if self._ticks % self._ticks_per_ledger == 0:
            ledger = self._table.ledger()
            self._ledger.publish(
                stamp_ns, [getattr(ledger, item.name) for item in fields(ledger)])
        self._ticks += 1

    def _publish_odometry(self, stamp_ns: int, truth: TrueState) -> None:
        """Publish the pose of link a, and its twist in its own frame (REP 105)."""
        message, angle = self._message, truth.link_angles[0]
        write_stamp(message.header.stamp, stamp_ns)
        pose, twist = message.pose.pose, message.twist.twist
        pose.position.x, pose.position.y = truth.base_position.tolist()
        pose.orientation.z, pose.orientation.w = sin(0.5 * angle), cos(0.5 * angle)
        x, y = truth.base_velocity.tolist()
        twist.linear.x = cos(angle) * x + sin(angle) * y
        twist.linear.y = cos(angle) * y - sin(angle) * x
        twist.angular.z = float(truth.link_rates[0])
        self._odometry.publish(message)
