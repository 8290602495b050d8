# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Recordings of excitations of the simulated table, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fourbar_ros.analysis.calibration.excitation import Excitation
from fourbar_ros.analysis.calibration.measurements import (
    link_measurements,
    LinkMeasurements,
    WheelMeasurements,
)
from fourbar_ros.device.command import drive_by_name
from fourbar_ros.device.interface import no_torque
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.mechanism import LINK_NAMES, load_mechanism, Mechanism
from fourbar_ros.plant import InitialState, load_table, Plant, Table
import numpy as np
import pytest

PERIOD_NS = 4_000_000
BEGIN_NS = 1_000_000_000

Excited = Callable[..., tuple[LinkMeasurements, WheelMeasurements]]


@pytest.fixture(scope='session')
def prototype() -> Mechanism:
    """Load the bench-scale rhombus."""
    return load_mechanism('prototype')


@pytest.fixture(scope='session')
def lab() -> Table:
    """Load the table with friction, drag, tilt, random torques and late, lossy sensors."""
    return load_table('prototype')


@pytest.fixture(scope='session')
def irregular(prototype: Mechanism) -> Mechanism:
    """Make a bench-scale linkage without equal parameters."""
    return replace(  # type: ignore[arg-type]
        prototype, link_lengths=[0.36, 0.24, 0.33, 0.30], link_masses=[0.6, 0.7, 0.65, 0.55],
        link_inertias=[6e-3, 5e-3, 7e-3, 5.5e-3],
        com_positions=[[0.16, 0.01], [0.12, -0.02], [0.17, 0.015], [0.14, 0.0]])


class Bed:
    """
    A simulated table that is driven tick by tick, with its recorded samples.

    :ivar efforts: commanded torques of every tick [N m].
    """

    def __init__(self, mechanism: Mechanism, table: Table, seed: int,
                 initial: InitialState) -> None:
        self._device = SimulatedTable(
            Plant(mechanism, table, initial, 1e-3, np.random.default_rng(seed)), PERIOD_NS)
        self._links: list[tuple[int, Any]] = []
        self._wheels: list[tuple[int, Any]] = []
        self._angles = np.full(4, np.nan)
        self._stamp_ns = BEGIN_NS
        self._drive = no_torque()
        self.efforts: list[dict[str, float]] = []

    def tick(self) -> None:
        """Advance to the next tick."""
        samples = self._device.step(self._stamp_ns, self._drive)
        for reading in samples.links:
            row = np.full(4, np.nan)
            row[[LINK_NAMES.index(name) for name in reading.names]] = reading.angles
            self._links.append((reading.stamp_ns, row))
            self._angles = np.where(np.isfinite(row), row, self._angles)
        self._wheels.append((self._stamp_ns, samples.wheels))
        self._stamp_ns += PERIOD_NS

    def follow(self, excitation: Excitation) -> None:
        """Wait for the sensors, then drive until the end of the excitation."""
        while np.isnan(self._angles).any():
            self.tick()
        begin_ns = self._stamp_ns
        while True:
            asked = excitation.efforts(
                (self._stamp_ns - begin_ns) * 1e-9, self._angles, self._wheels[-1][1].speeds)
            if asked is None:
                return
            self.efforts.append(dict(asked))
            self._drive = drive_by_name(list(asked), (), (), list(asked.values()))
            self.tick()

    def recorded(self) -> tuple[LinkMeasurements, WheelMeasurements]:
        """Return the measurements as from a bag."""
        stamps, angles = zip(*self._links)
        ticks, wheels = zip(*self._wheels)
        return (link_measurements(np.array(stamps), np.array(angles), BEGIN_NS),
                WheelMeasurements((np.array(ticks) - BEGIN_NS) * 1e-9, *(
                    np.array([getattr(sample, name) for sample in wheels])
                    for name in ('angles', 'speeds', 'efforts'))))


@pytest.fixture(scope='session')
def excited() -> Excited:
    """Return a function that records an excitation: links and wheels."""
    def run(mechanism: Mechanism, table: Table, excitation: Excitation, seed: int,
            initial: InitialState | None = None) -> tuple[LinkMeasurements, WheelMeasurements]:
        bed = Bed(mechanism, table, seed, initial or InitialState())
        bed.follow(excitation)
        return bed.recorded()
    return run


@pytest.fixture(scope='session')
def make_bed() -> type[Bed]:
    """Return the class of beds."""
    return Bed
