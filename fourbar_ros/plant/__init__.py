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

"""What the table does: the moving linkage, its flywheel motors and its sensors."""

from fourbar_ros.plant.faults import Fault, FaultError, parse_fault
from fourbar_ros.plant.plant import InitialState, Plant, PlantError, Truth
from fourbar_ros.plant.sensors import LinkSensorSettings, SensorReading
from fourbar_ros.plant.table import load_table, Table, TableError

__all__ = [
    'Fault', 'FaultError', 'InitialState', 'LinkSensorSettings', 'load_table', 'parse_fault',
    'Plant', 'PlantError', 'SensorReading', 'Table', 'TableError', 'Truth',
]
