# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Testbeds behind one interface, simulated or real: samples, commands, arming, clock modes.

The simulated table is not imported here (`fourbar_ros.device.simulated`), so that a node for real
hardware loads no plant.
"""

from fourbar_ros.device.arming import Arming, DeviceState
from fourbar_ros.device.clock_modes import (
    ClockMode,
    ClockModeError,
    FastClock,
    LockstepClock,
    LockstepGuard,
    Participants,
    RateLimit,
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
from fourbar_ros.device.supervisor import DeviceSupervisor, SupervisorSettings, Timing
from fourbar_ros.mechanism.samples import LinkSample, TrueState

__all__ = [
    'Arming', 'ClockMode', 'ClockModeError', 'Device', 'DeviceFault', 'DeviceState',
    'DeviceSupervisor', 'Drive', 'drive_by_name', 'FastClock', 'LinkSample', 'LockstepClock',
    'LockstepGuard', 'Participants', 'RateLimit', 'Reaction', 'RealtimeClock', 'Recovery',
    'Samples', 'SupervisorSettings', 'Timing', 'TrueState', 'WheelSample',
]
