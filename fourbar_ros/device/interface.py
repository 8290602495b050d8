# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The interface between the supervisor and a testbed, simulated or real."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from fourbar_ros.device.arming import DeviceState
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.samples import LinkSample, TrueState
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Drive:
    """
    Input of the motors until the next tick.

    :param values: (4,) torque [N m], or speed of the wheel relative to its link [rad/s].
    :param by_speed: (4,) bool, whether a value is a speed; the motor electronics control it.
    :param powered: (4,) bool, whether a motor has power; without power the wheel coasts.
    """

    values: Array
    by_speed: NDArray[np.bool_]
    powered: NDArray[np.bool_]


def no_torque() -> Drive:
    """Return the drive of coasting wheels, without power."""
    return Drive(np.zeros(4), np.zeros(4, dtype=bool), np.zeros(4, dtype=bool))


@dataclass(frozen=True, eq=False)
class WheelSample:
    """
    The four wheels at a tick.

    :param angles: (4,) relative to the link, unwrapped [rad].
    :param speeds: (4,) relative to the link [rad/s].
    :param efforts: (4,) torque applied to the wheel [N m].
    """

    angles: Array
    speeds: Array
    efforts: Array


@dataclass(frozen=True, eq=False)
class Samples:
    """
    All samples of a device at a tick.

    :param stamp_ns: the tick [ns].
    :param links: samples of the link-angle sensors that arrived since the last tick.
    :param wheels: present wheels, or their last known state.
    :param truth: state without sensors, None on a real device.
    :param complete: whether every wheel has answered recently; if not, no tick is published.
    :param timing: the device's own timing, in the order of its `timing_names`; None: unknown.
    """

    stamp_ns: int
    links: tuple[LinkSample, ...]
    wheels: WheelSample
    truth: TrueState | None = None
    complete: bool = True
    timing: Sequence[float | None] = ()


class Reaction(IntEnum):
    """Reaction to a fault, in the order of severity."""

    # Report in diagnostics only.
    WARN = 0
    # Disarm: the wheels have no power.
    COAST = 1
    # Emergency stop: the wheels have no power until a reset.
    STOP = 2


@dataclass(frozen=True)
class DeviceFault:
    """
    A fault of the device.

    :param text: subject, condition, value and limit.
    """

    reaction: Reaction
    text: str


class Device(Protocol):
    """
    A testbed, simulated or real.

    :cvar description: name for messages.
    :cvar mechanism: the linkage, its wheels and motor limits.
    :cvar period_ns: time between two ticks [ns].
    :cvar sensor_names: the link-angle sensors, `link_a` and so on.
    :cvar measures_rates: whether the sensors have gyros.
    :cvar timing_names: names of the device's own timing values, with units.
    """

    description: str
    mechanism: Mechanism
    period_ns: int
    sensor_names: tuple[str, ...]
    measures_rates: bool
    timing_names: tuple[str, ...] = ()

    def step(self, stamp_ns: int, drive: Drive) -> Samples:
        """
        Drive the wheels up to a tick, and return the samples since the last one.

        :param stamp_ns: the tick; the first call only sets the time [ns].
        :param drive: within the motor limits.
        :raises FourbarError: the device failed and must not be driven.
        """

    def drive(self, drive: Drive) -> None:
        """
        Apply a drive at once; the next step repeats it.

        A device that moves only in its steps does nothing.

        :raises FourbarError: the device failed and must not be driven.
        """
        return

    def arming_changed(self, state: DeviceState) -> None:
        """Take over a new arming state."""
        return

    def release(self) -> Sequence[str]:
        """
        End emergency stops in the device itself; called while disarmed.

        :returns: names of the parts that were stopped.
        """
        return ()

    def arming_blockers(self) -> Sequence[str]:
        """Return what prevents arming now."""
        return ()

    def faults(self) -> Sequence[DeviceFault]:
        """Return the faults of the last step to which the supervisor must react."""
        return ()

    def diagnostics(self) -> dict[str, str]:
        """Return present faults and warnings by subject."""
        return {}

    def diagnostic_values(self) -> dict[str, object]:
        """Return counters and measured states by name, for diagnostics."""
        return {}

    def close(self) -> None:
        """Switch the power of the wheels off, and close the connection to the device."""
        return
