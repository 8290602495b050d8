# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Run a scenario in one process, without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.progress import Progress
from fourbar_ros.control import Controller, SetpointError
from fourbar_ros.device import DeviceSupervisor
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.estimation import Estimator
from fourbar_ros.loop.closed_loop import ClosedLoop, Step
from fourbar_ros.loop.run_record import RunRecord
from fourbar_ros.loop.scenario import Scenario
from fourbar_ros.plant import Plant
import numpy as np


class RunError(FourbarError):
    """A run in which the device refuses to arm or the controller refuses a setpoint."""


def make_loop(scenario: Scenario) -> ClosedLoop:
    """
    Return the closed loop that a scenario describes, before its first tick.

    :raises PlantError: the control period is not a whole multiple of the plant step, or the
        linkage cannot start as described.
    """
    settings = scenario.plant
    plant = Plant(scenario.mechanism, scenario.table, scenario.initial, settings.step,
                  np.random.default_rng(scenario.seed))
    supervisor = DeviceSupervisor(SimulatedTable(plant, settings.period_ns), settings)
    return ClosedLoop(supervisor, Estimator(scenario.model, scenario.estimator),
                      Controller(scenario.model, scenario.controller))


def run_scenario(scenario: Scenario, loop: ClosedLoop | None = None) -> Iterator[Step]:
    """
    Run a scenario tick by tick.

    Arming and setpoints take place after the first tick at or after their time, and act from the
    next tick on.

    :param loop: from `make_loop`, for a caller that reads it; by default a new one.
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
                raise RunError(f'arm_at {scenario.arm_at:g} s: {reason}', name='arm_at',
                               value=scenario.arm_at)
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
                raise RunError(
                    f'setpoints, entry {number} at {setpoint.at:g} s, refused: {error}',
                    name=f'setpoints, entry {number}', value=setpoint.at) from None
        yield step


def record_run(scenario: Scenario, progress: Progress | None = None) -> RunRecord:
    """
    Run a scenario and record the messages that the nodes would publish.

    :param progress: wraps the iteration over the steps.
    :raises FourbarError: as :func:`run_scenario`.
    """
    record = RunRecord(scenario.table.link_sensors.sensor_names)
    steps: Iterable[Step] = run_scenario(scenario)
    if progress is not None:
        steps = progress(steps, scenario.ticks)
    for step in steps:
        record.add(step)
    return record
