# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated air table as a node."""

from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.settings import Setting
from fourbar_ros.device import Recovery
from fourbar_ros.ros import device_node
from fourbar_ros.ros.device_parameters import common_parameters
from fourbar_ros.ros.ground_truth import GroundTruth
from fourbar_ros.ros.paces import fast_pace, lockstep_pace, realtime_pace
from fourbar_ros.ros.runtime import run_node
from fourbar_ros.ros.sim_services import SimServices
from fourbar_ros.ros.simulated_time import Lockstep, SimulatedClock
from fourbar_ros.ros.table_parameters import (
    apply_faults,
    initial_state,
    make_table,
    table_parameters,
)

# Clocks, each with a function of all parameters and the period [ns] that makes its pace.
CLOCKS = {'realtime': realtime_pace, 'fast': fast_pace, 'lockstep': lockstep_pace}

_TABLE = table_parameters('ideal')
PARAMETERS = (
    *common_parameters('paper'),
    _TABLE[0],
    Setting('clock', 'realtime', '', 'what the ticks follow', choices=tuple(CLOCKS)),
    Setting('real_time_factor', 1.0, '', 'simulated seconds per second of the fast clock, 0 '
              'for as fast as it can', low=0.0, high=1000.0),
    Setting('guard_timeout', 1.0, 's', 'lock-step tells for whom it waits after so long',
              low=0.05, high=3600.0),
    Setting('start_paused', False, '', 'wait for sim/step or sim/pause before the first tick'),
    *_TABLE[1:],
)


class PlantNode(device_node.DeviceNode):
    """A testbed that also tells what really is."""

    # Until they are made.
    _lockstep = _simulated_clock = None

    def __init__(self, runtime):
        super().__init__(runtime, 'plant', PARAMETERS, make_device, make_pace)
        self._ground_truth = GroundTruth(
            self, self._testbed.device, self._testbed.device.period_ns)
        guard, values = runtime.guard, self._values
        if values['clock'] == 'lockstep':
            self._lockstep = Lockstep(
                self, self._pace, guard, round(values['guard_timeout'] * 1e9), self._on_hindrance,
                self.advance)
        self.simulated = values['clock'] != 'realtime'
        if self.simulated:
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
        if remedy is Recovery.GIVE_UP:
            self._testbed.disarm('estimator or controller joined too late for a tick')
            self._pace.give_up()
            self.advance()
        elif remedy is not Recovery.NOTHING:
            self._topics.send_again(links=remedy is Recovery.SEND_ALL)
        self._diagnostics.changed()

    def reset(self):
        """
        Put the linkage where the parameters say, and disarm.

        :raises FourbarError: it cannot be there; nothing was changed.
        """
        self._testbed.device.reset(initial_state(self._values))
        self._testbed.disarm('sim/reset')
        self._announce()


def make_device(values, period_ns, _stamp_of):
    """Make the simulated table that the parameters describe."""
    return make_table(values, period_ns)


def make_pace(values, period_ns):
    """Make the pace of the clock that the parameters name, and how often to look at it [ns]."""
    pace, poll_ns = CLOCKS[values['clock']](values, period_ns)
    if values['start_paused']:
        pace.pause(monotonic_ns())
    return pace, poll_ns


def main(argv):
    """Run the node."""
    return run_node(PlantNode, 'plant', 'Simulated air table with the linkage on it.', argv)
