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
class LinkSample:
    """
    Samples of link-angle sensors that were measured at one instant.

    :param stamp_ns: time of measurement [ns].
    :param names: sensors that have a sample, in the order of the device's `sensor_names`.
    :param angles: (n,) orientation of each link in frame `table`, or of a joint's second link
        relative to its first, in (-pi, pi] [rad].
    :param rates: (n,) angular rates [rad/s], or (0,) without gyros.
    """

    stamp_ns: int
    names: tuple[str, ...]
    angles: Array
    rates: Array


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
class TrueState:
    """
    The state of a simulated device without sensors and their errors.

    :param link_angles: (4,) continuous [rad].
    :param link_rates: (4,) [rad/s].
    :param wheel_angles: (4,) relative to the link, unwrapped [rad].
    :param wheel_speeds: (4,) relative to the link [rad/s].
    :param efforts: (4,) torque of each motor, mean over the last control period [N m].
    :param walked_torques: (2,) random-walk torques on links a and b in that period [N m].
    :param centre_position: (2,) centre of mass of the whole in frame `table` [m].
    :param centre_velocity: (2,) [m/s].
    :param base_position: (2,) joint 1, the origin of the frame of link a [m].
    :param base_velocity: (2,) [m/s].
    """

    link_angles: Array
    link_rates: Array
    wheel_angles: Array
    wheel_speeds: Array
    efforts: Array
    walked_torques: Array
    centre_position: Array
    centre_velocity: Array
    base_position: Array
    base_velocity: Array


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

    def arming_changed(self, state: DeviceState) -> None:
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

    def diagnostic_values(self) -> dict[str, object]:
        """Tell what a person wants to know when something is wrong, counters above all."""
        return {}

    def close(self) -> None:
        """Leave the wheels without power, and the device to others."""
        return
