# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated table: the moving linkage, its flywheel motors and its sensors."""

from fourbar_ros.plant.faults import Fault, FaultError, parse_fault
from fourbar_ros.plant.plant import Plant, PlantError
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.settings import InitialState, SimulationSettings
from fourbar_ros.plant.table import load_table, Table, TableError

__all__ = [
    'Fault', 'FaultError', 'InitialState', 'LinkSensorSettings', 'load_table', 'parse_fault',
    'Plant', 'PlantError', 'SimulationSettings', 'Table', 'TableError',
]
