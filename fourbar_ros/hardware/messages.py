# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Messages between host and links, independent of their layout on the bus.

A codec converts them to frames and back. Links are numbered 0 to 3, for a to d. Link times are
readings of the link's own clock in whole microseconds. Link times and wheel angles wrap; a report
carries the period.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

from fourbar_ros.common.errors import FourbarError


class BusError(FourbarError):
    """A bus that cannot be opened or used."""


class FrameError(FourbarError):
    """
    A frame that is rejected, or a message that cannot be encoded.

    :ivar kind: `length`, `checksum` or `value`; also the key of the counter of such frames.
    """

    def __init__(self, kind: str, message: str, /, **values: Any) -> None:
        super().__init__(message, **values)
        self.kind = kind


class Frame(NamedTuple):
    """One CAN frame; a remote frame requests data and carries none."""

    frame_id: int
    data: bytes = b''
    remote: bool = False


class Bus(Protocol):
    """A bus that sends and receives frames; times are of the host's monotonic clock [ns]."""

    @property
    def fault(self) -> str | None:
        """Fault of the bus itself, as far as its driver reports one."""

    def send(self, frame: Frame) -> None:
        """
        Send a frame.

        :raises BusError: the bus cannot be used.
        """

    def receive(self, timeout_s: float) -> tuple[Frame, int] | None:
        """
        Wait for a frame.

        :returns: the frame and its time of arrival [ns], None at the timeout.
        :raises BusError: the bus cannot be used.
        """

    def diagnostic_values(self) -> dict[str, object]:
        """Return counters and states for diagnostics, by name."""

    def close(self) -> None:
        """Close the bus."""


class LinkState(IntEnum):
    """State of the electronics of a link."""

    IDLE = 0
    ARMED = 1
    # Command timeout: no torque until the link is disarmed and armed again.
    COASTING = 2
    # Emergency stop: no torque until it is released.
    STOPPED = 3
    # Own fault: no torque until the cause is gone and the link is disarmed and armed again.
    FAULT = 4


# Number of values of 8-bit counters (`Sync`, commands, boots) and of 4-bit sequence numbers (angle
# samples, heartbeats).
COUNTERS, SEQUENCES = 256, 16

# Faults of a link, in the order of the bits; `no_limits`: no limits are loaded.
LINK_FAULTS = ('driver', 'encoder', 'angle_sensor', 'overspeed', 'overtemperature',
               'undervoltage', 'no_limits')


# From the host to one link.

@dataclass(frozen=True)
class Command:
    """
    Drive a wheel.

    :param value: torque [N m], or speed relative to the link [rad/s].
    :param by_speed: whether the value is a speed.
    :param enable: whether the motor has power; False disarms the link.
    :param sequence: 0 to 255, incremented with every command to this link.
    """

    link: int
    value: float
    by_speed: bool
    enable: bool
    sequence: int


@dataclass(frozen=True)
class Limits:
    """
    Limits that the link enforces itself.

    :param torque: [N m].
    :param speed: of the wheel relative to the link [rad/s].
    """

    link: int
    torque: float
    speed: float


# From the host to all links.

@dataclass(frozen=True)
class Sync:
    """Request to measure now and to answer with this counter (0 to 255)."""

    counter: int


@dataclass(frozen=True)
class Stop:
    """
    Emergency stop: no power on any wheel until `Release`.

    :param code: fixed; a corrupted frame with another identifier is not accepted for this one.
    """

    code: int = 0xC3


@dataclass(frozen=True)
class Release:
    """
    End of the emergency stop; the links become idle.

    :param code: fixed, as that of `Stop`.
    """

    code: int = 0x3C


# From a link to the host.

@dataclass(frozen=True)
class WheelReport:
    """
    Reading of the wheel encoder at a `Sync`, or as close to it as the link can measure.

    :param counter: of the `Sync`; None from electronics that do not repeat it.
    :param angle: relative to the link [rad], modulo `turn`.
    :param time_us: link time of the measurement modulo `wrap_us`; None from electronics without a
        clock.
    :param speed: relative to the link [rad/s], None where the electronics do not measure it.
    """

    link: int
    counter: int | None
    angle: float
    turn: float
    time_us: int | None
    wrap_us: int
    speed: float | None = None


@dataclass(frozen=True)
class MotorReport:
    """
    Motor torque since the last `Sync`.

    :param torque: mean torque applied to the wheel [N m].
    :param state: of the link; None where only the heartbeat reports it.
    :param counter: of the `Sync`; None from electronics that do not repeat it.
    :param answered: whether a command has arrived since the electronics started.
    :param answers: sequence of the last command that was carried out, if `answered`.
    """

    link: int
    torque: float
    state: LinkState | None = None
    counter: int | None = None
    answered: bool = False
    answers: int = 0


@dataclass(frozen=True)
class AngleReport:
    """
    One sample of the link-angle sensor.

    :param sequence: 0 to 15, incremented with every sample.
    :param angle: orientation in frame `table`, in (-pi, pi] [rad].
    :param rate: of the gyro [rad/s], None without a gyro.
    :param time_us: link time of the measurement modulo `wrap_us`.
    """

    link: int
    sequence: int
    angle: float
    rate: float | None
    time_us: int
    wrap_us: int


@dataclass(frozen=True)
class ClockReport:
    """
    Link time at which a `Sync` arrived, sent immediately.

    :param counter: of the `Sync`.
    :param time_us: link time modulo 2**32.
    :param boot: number of this start of the electronics (0 to 255); it changes with every start.
    """

    link: int
    counter: int
    time_us: int
    boot: int


@dataclass(frozen=True)
class Heartbeat:
    """
    Health of a link.

    :param sequence: 0 to 15, incremented with every heartbeat; None from electronics without one.
    :param faults: of `LINK_FAULTS`.
    :param voltage: of the supply [V], None if it is not reported.
    :param temperature: of the motor or its driver [deg C], None if it is not reported.
    :param boot: as in `ClockReport`, None if it is not reported.
    """

    link: int
    sequence: int | None
    state: LinkState
    faults: frozenset[str]
    voltage: float | None = None
    temperature: float | None = None
    boot: int | None = None


ToLinks = Command | Limits | Sync | Stop | Release
ToHost = WheelReport | MotorReport | AngleReport | ClockReport | Heartbeat


class Codec(Protocol):
    """A protocol on the bus: conversion between messages and frames, for both ends."""

    def to_links(self, message: ToLinks) -> Sequence[Frame]:
        """
        Encode a message of the host; no frames if the protocol has no such message.

        :raises FrameError: kind `value`: a number is not finite or does not fit.
        """

    def to_host(self, message: ToHost) -> Sequence[Frame]:
        """
        Encode a message of a link, as :meth:`to_links`.

        :raises FrameError: kind `value`, as :meth:`to_links`.
        """

    def from_links(self, frame: Frame) -> ToHost | None:
        """
        Decode at the host a message of a link.

        :returns: the message; None for a frame that no link sends.
        :raises FrameError: wrong length, wrong checksum, or an invalid value.
        """

    def from_host(self, frame: Frame) -> ToLinks | None:
        """
        Decode at a link a message of the host.

        :returns: the message; None for a frame that the host does not send.
        :raises FrameError: as :meth:`from_links`.
        """


def check_link(link: int) -> None:
    """
    Check the number of a link.

    :raises FrameError: kind `value`: not 0 to 3.
    """
    if link not in range(4):
        raise FrameError('value', f'link must be 0 to 3, got {link}', name='link', value=link,
                         limit=(0, 3))
