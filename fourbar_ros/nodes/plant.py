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

from fourbar_ros.device import Remedy, SimulatedTable
from fourbar_ros.mechanism import FLYWHEEL_NAMES, load_mechanism, SENSOR_NAMES
from fourbar_ros.mechanism.closure import BRANCHES
from fourbar_ros.nodes import device_node
from fourbar_ros.nodes.ground_truth import GroundTruth
from fourbar_ros.nodes.messages import steady_ns
from fourbar_ros.nodes.paces import fast_pace, lockstep_pace, realtime_pace
from fourbar_ros.nodes.parameters import Parameter
from fourbar_ros.nodes.runtime import run_node
from fourbar_ros.nodes.sim_services import SimServices
from fourbar_ros.nodes.simulated_time import (
    Lockstep,
    SimulatedClock,
)
from fourbar_ros.plant import InitialState, load_table, Plant
from fourbar_ros.plant.schedule import read_schedule
import numpy as np

# Clocks, each with a function of all parameters and the period [ns] that makes its pace.
CLOCKS = {'realtime': realtime_pace, 'fast': fast_pace, 'lockstep': lockstep_pace}

OWN_PARAMETERS = (
    Parameter('table', 'ideal', '', 'preset or path of a table file'),
    Parameter('clock', 'realtime', '', 'what the ticks follow', choices=tuple(CLOCKS)),
    Parameter('real_time_factor', 1.0, '', 'simulated seconds per second of the fast clock, 0 '
              'for as fast as it can', limits=(0.0, 1000.0)),
    Parameter('guard_timeout', 1.0, 's', 'lock-step tells for whom it waits after so long',
              limits=(0.05, 3600.0)),
    Parameter('start_paused', False, '', 'wait for sim/step or sim/pause before the first tick'),
    Parameter('step', 0.0005, 's', 'integration step; the period is a whole multiple of it',
              limits=(1e-6, 0.1)),
    Parameter('seed', 0, '', 'of all random numbers', limits=(0, 2 ** 63 - 1)),
    Parameter('fault_schedule', '', '', 'path of a YAML file of faults that come and go',
              live=True),
    *(Parameter(f'fault.{name}', '', '', 'what is wrong with it, as `off` or `wrong 0.1`',
                live=True) for name in SENSOR_NAMES),
    *(Parameter(f'fault.{name}', '', '', 'what is wrong with it, as `dead` or `weak 0.5`',
                live=True) for name in FLYWHEEL_NAMES),
    Parameter('initial.link_a', 0.0, 'rad', 'orientation of link a at start and reset',
              limits=(-1e6, 1e6), live=True),
    Parameter('initial.link_b', round(pi / 3, 12), 'rad',
              'orientation of link b at start and reset', limits=(-1e6, 1e6), live=True),
    Parameter('initial.branch', 'open', '', 'assembly at start and reset', choices=BRANCHES,
              live=True),
    Parameter('initial.rate_a', 0.0, 'rad/s', 'rate of link a at start and reset',
              limits=(-100.0, 100.0), live=True),
    Parameter('initial.rate_b', 0.0, 'rad/s', 'rate of link b at start and reset',
              limits=(-100.0, 100.0), live=True),
)
PARAMETERS = device_node.PARAMETERS + OWN_PARAMETERS


FAULTS = tuple(row.name for row in PARAMETERS if row.name.startswith('fault'))


class PlantNode(device_node.DeviceNode):
    """A testbed that also tells what really is."""

    # Until they are made.
    _lockstep = _simulated_clock = None

    def __init__(self, runtime):
        super().__init__(runtime, 'plant', OWN_PARAMETERS, make_device, make_pace)
        self._ground_truth = GroundTruth(self, self._testbed.device)
        guard, values = runtime.guard, self._values
        if values['clock'] == 'lockstep':
            self._lockstep = Lockstep(
                self, self._pace, guard, round(values['guard_timeout'] * 1e9), self._on_hindrance,
                self.advance)
        if values['clock'] != 'realtime':
            self._simulated_clock = SimulatedClock(self, self._pace, guard)
        SimServices(self, self._pace, guard, self._lockstep)

    def parameters_changed(self, values):
        """Break and mend what was asked for."""
        apply_faults(self._testbed.device, self._values, values)

    def ticked(self, stamp_ns, truth):
        """Publish the state without its sensors, and tell the time where it is simulated."""
        self._ground_truth.publish(stamp_ns, truth)
        if self._simulated_clock is not None:
            self._simulated_clock.tell()

    def hindrance(self):
        """Tell whom a lock-step waits for, or that the clock stands still."""
        awaited = self._lockstep.awaited() if self._lockstep is not None else ''
        paused = 'paused' if self._pace.paused else ''
        return ', '.join(filter(None, (paused, awaited and f'waiting for {awaited}')))

    def _on_hindrance(self, remedy):
        """Report whom a lock-step waits for, and do what helps."""
        if remedy is Remedy.GIVE_UP:
            self._testbed.disarm('estimator or controller joined too late for a tick')
            self._pace.give_up()
            self.advance()
        elif remedy is not Remedy.NOTHING:
            self._topics.send_again(links=remedy is Remedy.SEND_ALL)
        self._diagnostics.changed()

    def reset(self):
        """
        Put the linkage where the parameters say, and disarm.

        :raises FourbarError: it cannot be there; nothing was changed.
        """
        self._testbed.device.reset(initial_state(self._values))
        self._testbed.disarm('sim/reset')
        self._announce()


def initial_state(values):
    """Return the state that the parameters describe."""
    return InitialState(**{name.split('.')[1]: value for name, value in values.items()
                           if name.startswith('initial.')})


def make_device(values, period_ns):
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
            faults[target] = table.faults.parse(target, now[name])
    if 'fault_schedule' in changed:
        path = now['fault_schedule']
        table.schedule_faults(read_schedule(path) if path else [], path)
    for target, fault in faults.items():
        table.break_down(target, fault)


def make_pace(values, period_ns):
    """Make the pace of the clock that the parameters name, and how often to look at it [ns]."""
    pace, poll_ns = CLOCKS[values['clock']](values, period_ns)
    if values['start_paused']:
        pace.pause(steady_ns())
    return pace, poll_ns


def main(argv):
    """Run the node."""
    return run_node(PlantNode, 'plant', 'Simulated air table with the linkage on it.', argv)
