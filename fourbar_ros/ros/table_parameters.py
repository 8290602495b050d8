# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated table as parameters describe it: for the plant, and for an emulated prototype."""

from math import pi

from fourbar_ros.common.settings import Setting
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.mechanism import FLYWHEEL_NAMES, load_mechanism, SENSOR_NAMES
from fourbar_ros.mechanism.closure import BRANCHES
from fourbar_ros.plant import InitialState, load_table, Plant
from fourbar_ros.plant.fault_schedule import read_schedule
import numpy as np


def table_parameters(table):
    """
    List the parameters of a simulated table.

    :param table: default of that parameter.
    """
    return (
        Setting('table', table, '', 'preset or path of a table file'),
        Setting('step', 0.0005, 's', 'integration step; the period is a whole multiple of it',
                  low=1e-6, high=0.1),
        Setting('seed', 0, '', 'of all random numbers', low=0, high=2 ** 63 - 1),
        Setting('fault_schedule', '', '', 'path of a YAML file of faults that come and go',
                  live=True),
        *(Setting(f'fault.{name}', '', '', 'what is wrong with it, as `off` or `wrong 0.1`',
                    live=True) for name in SENSOR_NAMES),
        *(Setting(f'fault.{name}', '', '', 'what is wrong with it, as `dead` or `weak 0.5`',
                    live=True) for name in FLYWHEEL_NAMES),
        Setting('initial.link_a', 0.0, 'rad', 'orientation of link a at start and reset',
                  low=-1e6, high=1e6, live=True),
        Setting('initial.link_b', round(pi / 3, 12), 'rad',
                  'orientation of link b at start and reset', low=-1e6, high=1e6, live=True),
        Setting('initial.branch', 'open', '', 'assembly at start and reset', choices=BRANCHES,
                  live=True),
        Setting('initial.rate_a', 0.0, 'rad/s', 'rate of link a at start and reset',
                  low=-100.0, high=100.0, live=True),
        Setting('initial.rate_b', 0.0, 'rad/s', 'rate of link b at start and reset',
                  low=-100.0, high=100.0, live=True),
    )


FAULTS = tuple(row.name for row in table_parameters('') if row.name.startswith('fault'))


def initial_state(values):
    """Return the state that the parameters describe."""
    return InitialState(**{name.split('.')[1]: value for name, value in values.items()
                           if name.startswith('initial.')})


def make_table(values, period_ns):
    """Make the simulated table that the parameters describe."""
    plant = Plant(
        load_mechanism(values['mechanism']), load_table(values['table']), initial_state(values),
        values['step'], np.random.default_rng(values['seed']))
    table = SimulatedTable(plant, period_ns)
    apply_faults(table, dict.fromkeys(FAULTS, ''), values)
    return table


def apply_faults(table, before, now):
    """
    Break, mend and schedule what parameters say that are not what they were.

    :raises FaultError, ConfigurationError: a fault that cannot be, or of what is not there, or a
        file that is refused; then nothing was changed.
    """
    changed = [name for name in FAULTS if now[name] != before[name]]
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
