# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What a testbed is, simulated or real: samples in, torques out, and when it may be driven."""

from fourbar_ros.device.arming import ArmingGate, DeviceState
from fourbar_ros.device.clock_modes import (
    ClockLimit,
    ClockMode,
    ClockModeError,
    FastClock,
    LockstepClock,
    LockstepGuard,
    Participants,
    RealtimeClock,
    Recovery,
)
from fourbar_ros.device.command import drive_by_name
from fourbar_ros.device.interface import (
    Device,
    DeviceFault,
    Drive,
    Reaction,
    Samples,
    WheelSample,
)
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.device.supervisor import DeviceSupervisor, SupervisorSettings, Timing

__all__ = [
    'ArmingGate', 'ClockLimit', 'ClockMode', 'ClockModeError', 'Device', 'DeviceFault',
    'DeviceState', 'DeviceSupervisor', 'Drive', 'drive_by_name', 'FastClock', 'LockstepClock',
    'LockstepGuard', 'Participants', 'Reaction', 'RealtimeClock', 'Recovery', 'Samples',
    'SimulatedTable', 'SupervisorSettings', 'Timing', 'WheelSample',
]
