# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Run a scenario in one process, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control import Controller, SetpointError
from fourbar_ros.device import DeviceSupervisor, SupervisorSettings
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.estimation import Estimator
from fourbar_ros.loop.closed_loop import ClosedLoop, Step
from fourbar_ros.loop.recording import Recording
from fourbar_ros.loop.scenario import Scenario
from fourbar_ros.plant import Plant
import numpy as np


class RunError(FourbarError):
    """A scenario whose script did not go as it is written."""


def make_loop(scenario: Scenario) -> ClosedLoop:
    """
    Make the closed loop that a scenario describes, at rest before its first tick.

    :raises PlantError: the control period is not a whole multiple of the plant step, or the
        linkage cannot start as described.
    """
    settings = scenario.plant
    plant = Plant(scenario.mechanism, scenario.table, scenario.initial, settings.step,
                  np.random.default_rng(scenario.seed))
    testbed = DeviceSupervisor(SimulatedTable(plant, settings.period_ns), SupervisorSettings(
        settings.rate, settings.command_timeout, settings.sensor_timeout, settings.timeout_action))
    return ClosedLoop(testbed, Estimator(scenario.believed, scenario.estimator),
                      Controller(scenario.believed, scenario.controller))


def run_scenario(scenario: Scenario, loop: ClosedLoop | None = None) -> Iterator[Step]:
    """
    Go through a scenario tick by tick.

    What the script does at a time happens right after the first tick at or after it, and acts
    from the next tick on.

    :param loop: what `make_loop` made of it, for a caller who wants to look inside.
    :raises RunError: the device refused to be armed, or the controller a setpoint.
    :raises FourbarError: the device failed.
    """
    loop = make_loop(scenario) if loop is None else loop
    waiting = list(scenario.setpoints)
    for tick in range(scenario.ticks):
        step = loop.step()
        if scenario.arm_at is not None and tick == scenario.tick_at(scenario.arm_at):
            armed, reason = loop.arm()
            if not armed:
                raise RunError(f'arm_at {scenario.arm_at:g} s: {reason}')
        while waiting and tick == scenario.tick_at(waiting[0].at):
            setpoint = waiting.pop(0)
            number = len(scenario.setpoints) - len(waiting)
            loop.controller.tune(replace(
                scenario.controller,
                setpoint_duration=setpoint.duration or scenario.controller.setpoint_duration))
            try:
                loop.controller.setpoint(
                    setpoint.names, setpoint.positions, step.samples.stamp_ns)
            except SetpointError as error:
                raise RunError(f'setpoints, entry {number} at {setpoint.at:g} s, refused: {error}'
                               ) from None
        yield step


def record_run(scenario: Scenario, watch: Callable[[Iterable[Step], int], Iterable[Step]] | None
               = None) -> Recording:
    """
    Run a scenario and keep everything that the nodes would publish.

    :param watch: is given the steps and their number, and hands them on.
    :raises FourbarError: as :func:`run_scenario`.
    """
    recording = Recording(scenario.table.link_sensors.sensor_names)
    steps: Iterable[Step] = run_scenario(scenario)
    if watch is not None:
        steps = watch(steps, scenario.ticks)
    for step in steps:
        recording.add(step)
    return recording
