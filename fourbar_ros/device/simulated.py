# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated table as a device."""

from __future__ import annotations

from collections import deque
from typing import Any

from fourbar_ros.device.interface import Device, Drive, no_torque, Samples, WheelSample
from fourbar_ros.mechanism import FLYWHEEL_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant import Fault, InitialState, Plant
from fourbar_ros.plant.energy_budget import EnergyBudget
from fourbar_ros.plant.fault_schedule import FaultBoard
from fourbar_ros.plant.faults import WHEEL_FAULTS, wheel_faults
from fourbar_ros.plant.step import conditions_of, SOUND
import numpy as np
from numpy.typing import NDArray


class SimulatedTable(Device):
    """
    A plant behind the device protocol.

    :param plant: what is simulated.
    :param period_ns: time between two ticks [ns].
    :ivar injected_faults: present faults, set by `break_down` and `schedule_faults`.
    :raises PlantError: the period is not a whole multiple of the plant step.
    """

    description = 'simulated table'

    def __init__(self, plant: Plant, period_ns: int) -> None:
        self.mechanism = plant.mechanism
        self.period_ns = period_ns
        self.sensor_names = plant.link_sensors.names
        self.measures_rates = plant.link_sensors.settings.gyro
        self.injected_faults = FaultBoard((*self.sensor_names, *FLYWHEEL_NAMES))
        self._plant = plant
        self._steps_per_period = plant.steps_in(period_ns * 1e-9)
        self._step_ns = period_ns // self._steps_per_period
        self._first_ns: int | None = None
        self._stamp_ns = 0
        self._conditions = SOUND
        # The last drives, newest first, with the step at which each began.
        self._drives: deque[tuple[int, Drive]] = deque([(-1, no_torque())])
        self._delays: NDArray[np.int64] | None = None
        self._longest_delay = round(WHEEL_FAULTS['delayed'].high * 1e9) // self._step_ns
        self._steps = 0
        self._wheel_angles = self._wheel_angles_before()

    def reset(self, initial: InitialState) -> None:
        """
        Set the state of the linkage; time and faults continue.

        :raises PlantError, ClosureError: the state is impossible; then nothing has changed.
        """
        self._plant.reset(initial)
        self._wheel_angles = self._wheel_angles_before()

    def break_down(self, target: str, fault: Fault | None) -> None:
        """
        Set the fault of a sensor or a wheel from now on, or clear it with None.

        :raises FaultError: unknown sensor or wheel.
        """
        self.injected_faults.set_fault(target, fault)
        self._apply_faults()

    def schedule_faults(self, entries: Any, origin: str) -> None:
        """
        Load a schedule of faults, in seconds since the first tick.

        :param entries: see `fourbar_ros.plant.fault_schedule`.
        :param origin: name of the source, for messages.
        :raises FaultError: the schedule is refused; then nothing has changed.
        """
        self.injected_faults.load(entries, origin, self._elapsed_ns)
        self._apply_faults()

    def step(self, stamp_ns: int, drive: Drive) -> Samples:
        """Advance the plant to the tick under a constant drive, and sample all sensors there."""
        if self._first_ns is None:
            self._first_ns = self._stamp_ns = stamp_ns
            self._follow_schedule()
            periods, efforts = 1, np.zeros(4)
        else:
            periods = max(1, round((stamp_ns - self._stamp_ns) / self.period_ns))
            efforts = self._move(periods * self._steps_per_period, drive)
            self._stamp_ns = stamp_ns
            self._follow_schedule()
        self._plant.measure_links(stamp_ns)
        wheel_angles = self._plant.sense_wheels()
        speeds = (wheel_angles - self._wheel_angles) / (periods * self.period_ns * 1e-9)
        self._wheel_angles = wheel_angles
        return Samples(
            stamp_ns, self._plant.link_sensors.due(stamp_ns),
            WheelSample(wheel_angles, speeds, efforts), self._plant.truth(efforts))

    def diagnostics(self) -> dict[str, str]:
        """Return present faults, and whether the linkage has touched the edge of the table."""
        texts = {}
        if self.injected_faults.faults:
            texts['faults'] = ', '.join(
                f'{target} {fault}' for target, fault in self.injected_faults.faults.items())
        if contacts := self._plant.contacts:
            texts['edge'] = f'the linkage has met the edge of the table, {contacts} contacts'
        return texts

    def ledger(self) -> EnergyBudget:
        """Return the budget of energy and momentum since the start or the last reset."""
        return self._plant.ledger()

    @property
    def _elapsed_ns(self) -> int:
        return 0 if self._first_ns is None else self._stamp_ns - self._first_ns

    def _move(self, steps: int, drive: Drive) -> Array:
        """Advance, and sample the sensors whenever they are due; return the mean efforts."""
        values, by_speed = self._commands(steps, drive)
        self._plant.disturb(steps * self._step_ns * 1e-9)
        efforts, done = np.zeros(4), 0
        while done < steps:
            until = self._next_pause(done, steps)
            part = values if values.ndim == 1 else values[done:until]
            self._plant.advance(
                until - done, part, by_speed, drive.powered, self._conditions)
            efforts += self._plant.efforts * ((until - done) / steps)
            done = until
            if done < steps:
                self._plant.measure_links(self._stamp_ns + done * self._step_ns)
        self._steps += steps
        return efforts

    def _next_pause(self, done: int, steps: int) -> int:
        """Return the step after which the next sample is due, or the last one."""
        due_ns = self._plant.link_sensors.next_sample_ns
        if due_ns is None or not self._plant.link_sensors.settings.rate:
            return steps
        return min(steps, max(done + 1, -((self._stamp_ns - due_ns) // self._step_ns)))

    def _commands(self, steps: int, drive: Drive) -> tuple[Array, Any]:
        """
        Return the effective input of the motors: the drive, delayed for wheels with that fault.

        Power is switched without a delay.
        """
        self._drives.appendleft((self._steps, drive))
        while len(self._drives) > 1 and self._drives[-2][0] <= self._steps - self._longest_delay:
            self._drives.pop()
        delays = self._delays
        if delays is None:
            return drive.values, drive.by_speed
        values, by_speed = np.tile(drive.values, (steps, 1)), drive.by_speed.copy()
        for wheel in np.flatnonzero(delays):
            past = [self._drive_at(self._steps + step - delays[wheel]) for step in range(steps)]
            values[:, wheel] = [each.values[wheel] for each in past]
            # A change between torque and speed acts from the begin of the period.
            by_speed[wheel] = past[0].by_speed[wheel]
            values[[each.by_speed[wheel] != by_speed[wheel] for each in past], wheel] = (
                past[0].values[wheel])
        return values, by_speed

    def _drive_at(self, step: int) -> Drive:
        """Return the drive at a step."""
        return next((drive for since, drive in self._drives if since <= step),
                    self._drives[-1][1])

    def _follow_schedule(self) -> None:
        if self.injected_faults.at_time(self._elapsed_ns):
            self._apply_faults()

    def _apply_faults(self) -> None:
        present = self.injected_faults.faults
        self._plant.link_sensors.set_faults(present)
        broken = wheel_faults(present.values())
        self._conditions = conditions_of(broken)
        delays = np.round(broken.command_delay_s * 1e9 / self._step_ns).astype(int)
        self._delays = delays if delays.any() else None

    def _wheel_angles_before(self) -> Array:
        """Return the encoder readings one period ago, at constant wheel speeds [rad]."""
        return (self._plant.sense_wheels()
                - self._plant.truth().wheel_speeds * (self.period_ns * 1e-9))
