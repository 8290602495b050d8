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

"""What a testbed is, simulated or real: samples in, torques out, and when it may be driven."""

from fourbar_ros.device.command import drive_by_name
from fourbar_ros.device.gate import ArmingGate, DeviceState
from fourbar_ros.device.pacing import (
    Attendance,
    ClockLimit,
    FastPace,
    LockstepGuard,
    LockstepPace,
    Pace,
    PaceError,
    RealtimePace,
    Remedy,
)
from fourbar_ros.device.protocol import (
    Device,
    Drive,
    Finding,
    Reaction,
    Samples,
    WheelSample,
)
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.device.testbed import Testbed, TestbedSettings, Timing

__all__ = [
    'ArmingGate', 'Attendance', 'ClockLimit', 'Device', 'DeviceState', 'Drive', 'drive_by_name',
    'FastPace', 'Finding', 'LockstepGuard', 'LockstepPace', 'Pace', 'PaceError', 'Reaction',
    'RealtimePace', 'Remedy', 'Samples', 'SimulatedTable', 'Testbed', 'TestbedSettings', 'Timing',
    'WheelSample',
]
