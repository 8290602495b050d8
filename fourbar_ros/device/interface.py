# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What a testbed offers, whether it is simulated or stands in the lab."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from fourbar_ros.device.arming import DeviceState
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant import SensorReading, Truth
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Drive:
    """
    What the motors are asked for until the next tick.

    :param values: (4,) torque [N m], or speed of the wheel relative to its link [rad/s].
    :param by_speed: (4,) bool, which of both; speeds are followed by the motors' own electronics.
    :param powered: (4,) bool, whose power stage is on; a wheel without power coasts, whatever its
        value.
    """

    values: Array
    by_speed: NDArray[np.bool_]
    powered: NDArray[np.bool_]


def no_torque() -> Drive:
    """Let all wheels coast, without power."""
    return Drive(np.zeros(4), np.zeros(4, dtype=bool), np.zeros(4, dtype=bool))


@dataclass(frozen=True, eq=False)
class WheelSample:
    """
    The four wheels at a tick.

    :param angles: (4,) relative to the link, unwrapped [rad].
    :param speeds: (4,) relative to the link [rad/s].
    :param efforts: (4,) torque really applied to the wheel [N m].
    """

    angles: Array
    speeds: Array
    efforts: Array


@dataclass(frozen=True, eq=False)
class Samples:
    """
    Everything that a testbed has to say at a tick.

    :param stamp_ns: the tick [ns].
    :param links: what the sensors of the links measured since the last one.
    :param wheels: as they are, or were when all of them were last heard.
    :param truth: only where it is simulated.
    :param complete: whether all wheels were heard lately enough; if not, this is no tick.
    :param timing: of the device's own, in the order of its `timing_names`; None is not known.
    """

    stamp_ns: int
    links: tuple[SensorReading, ...]
    wheels: WheelSample
    truth: Truth | None = None
    complete: bool = True
    timing: Sequence[float | None] = ()


class Reaction(IntEnum):
    """What a finding leads to, the harder the higher."""

    WARN = 0
    """People are told."""
    COAST = 1
    """The device is disarmed, the wheels have no power."""
    STOP = 2
    """As an emergency stop: likewise, until it is reset."""


@dataclass(frozen=True)
class DeviceFault:
    """
    Something that is not as it should be.

    :param text: what, where, and the limit.
    """

    reaction: Reaction
    text: str


class Device(Protocol):
    """
    A testbed.

    :cvar description: what it is, for people.
    :cvar mechanism: the linkage, its wheels and motor limits.
    :cvar period_ns: time between two ticks [ns].
    :cvar sensor_names: the sensors of the links, `link_a` and so on.
    :cvar measures_rates: whether they have gyros.
    :cvar timing_names: what the device itself knows of how it keeps time, with units.
    """

    description: str
    mechanism: Mechanism
    period_ns: int
    sensor_names: tuple[str, ...]
    measures_rates: bool
    timing_names: tuple[str, ...] = ()

    def step(self, stamp_ns: int, drive: Drive) -> Samples:
        """
        Drive the wheels up to a tick, and report what was measured since the last one.

        :param stamp_ns: the tick; the first call only sets the time [ns].
        :param drive: within the motor limits.
        :raises FourbarError: the device failed and must not be driven.
        """

    def drive(self, drive: Drive) -> None:
        """
        Learn at once how the wheels shall be driven from now on; the next step says it again.

        Nothing to do for a device that moves in its steps only.

        :raises FourbarError: the device failed and must not be driven.
        """
        return

    def gate_changed(self, state: DeviceState) -> None:
        """Learn that the wheels may be driven now, or not any more, and why."""
        return

    def release(self) -> Sequence[str]:
        """
        Let go of what the device holds by itself, whoever stopped it; asked for while disarmed.

        :returns: names of what was held.
        """
        return ()

    def arming_blockers(self) -> Sequence[str]:
        """Tell what speaks against arming now."""
        return ()

    def faults(self) -> Sequence[DeviceFault]:
        """Tell what was found at the last step that must have consequences."""
        return ()

    def diagnostics(self) -> dict[str, str]:
        """Tell what is not as it should be, by what it is about; nothing if all is well."""
        return {}

    def facts(self) -> dict[str, object]:
        """Tell what a person wants to know when something is wrong, counters above all."""
        return {}

    def close(self) -> None:
        """Leave the wheels without power, and the device to others."""
        return
