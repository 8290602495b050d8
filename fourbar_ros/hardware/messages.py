# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What host and links tell each other, whatever the messages on the bus look like.

A codec turns this into frames and back. Links are numbered 0 to 3, for a to d. Link times are
those of the link's own clock, in whole microseconds; they and wheel angles start over after so
many, which is given with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol

from fourbar_ros.common.errors import FourbarError


class BusError(FourbarError):
    """A bus that is not there, cannot be used, or has gone away."""


class FrameError(FourbarError):
    """
    A frame that is not taken.

    :ivar kind: `length`, `checksum` or `value`, to be counted by.
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class Frame(NamedTuple):
    """One CAN frame; a remote frame asks for data and carries none."""

    frame_id: int
    data: bytes = b''
    remote: bool = False


class LinkState(Enum):
    """What the electronics of a link do."""

    IDLE = 0
    ARMED = 1
    COASTING = 2
    """No command came for too long: no torque until it is disarmed, and armed again."""
    STOPPED = 3
    """By the emergency stop: no torque until that is released."""
    FAULT = 4
    """By itself: no torque until the cause has gone, and it is disarmed and armed again."""


COUNTERS, SEQUENCES = 256, 16
"""Counters of a `Sync`, sequences of commands and numbers of starts begin again after so many;
sequences of samples and heartbeats after fewer."""

LINK_FAULTS = ('driver', 'encoder', 'angle_sensor', 'overspeed', 'overtemperature',
               'undervoltage', 'no_limits')
"""What may be wrong with a link, in the order of the bits; `no_limits`: none were loaded."""


# From the host to a link.

@dataclass(frozen=True)
class Command:
    """
    Drive a wheel.

    :param value: torque [N m], or speed relative to the link [rad/s].
    :param by_speed: which of both.
    :param enable: whether the wheel has power; without it the link is disarmed.
    :param sequence: 0 to 255, one more with every command to this link.
    """

    link: int
    value: float
    by_speed: bool
    enable: bool
    sequence: int


@dataclass(frozen=True)
class Limits:
    """
    What a link must not exceed, whatever it is told.

    :param torque: [N m].
    :param speed: of the wheel relative to the link [rad/s].
    """

    link: int
    torque: float
    speed: float


# From the host to all links.

@dataclass(frozen=True)
class Sync:
    """Measure now, and answer with this counter (0 to 255)."""

    counter: int


@dataclass(frozen=True)
class Stop:
    """Cut the power of all wheels, until a `Release`."""


@dataclass(frozen=True)
class Release:
    """End the emergency stop; the links are idle."""


# From a link to the host.

@dataclass(frozen=True)
class WheelReport:
    """
    The wheel encoder when a `Sync` came, or as near to it as the link has it.

    :param counter: of the `Sync`; None from electronics that do not know it.
    :param angle: relative to the link [rad], modulo `turn`.
    :param time_us: link time of the measurement modulo `wrap_us`; None from electronics that have
        no clock.
    :param speed: relative to the link, where the electronics measure it [rad/s].
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
    What the motor did since the last `Sync`.

    :param torque: really applied to the wheel, mean [N m].
    :param answers: sequence of the last command that was obeyed; None from electronics that do not
        know it.
    :param state: of the link; None where only the heartbeat tells.
    :param counter: of the `Sync`; None from electronics that do not know it.
    """

    link: int
    torque: float
    answers: int | None
    state: LinkState | None
    counter: int | None = None


@dataclass(frozen=True)
class AngleReport:
    """
    One sample of the link-angle sensor.

    :param sequence: 0 to 15, one more with every sample.
    :param angle: orientation in frame `table`, in (-pi, pi] [rad].
    :param rate: of the gyro [rad/s], None without one.
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
    When a `Sync` came, sent at once.

    :param counter: of the `Sync`.
    :param time_us: link time modulo 2**32.
    :param boot: another number after each start of the electronics (0 to 255).
    """

    link: int
    counter: int
    time_us: int
    boot: int


@dataclass(frozen=True)
class Heartbeat:
    """
    How a link is.

    :param sequence: 0 to 15, one more with every heartbeat; None where electronics have none.
    :param faults: of `LINK_FAULTS`.
    :param voltage: of the supply [V], None if it is not told.
    :param temperature: of the motor or its driver [deg C], None if it is not told.
    :param boot: as of `ClockReport`, None if it is not told.
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
    """
    One language on the bus, understood from both ends.

    :cvar name: of it.
    :cvar has_angles: whether links tell their angles in it.
    :cvar has_clock: whether links tell their time, by `ClockReport` and in reports.
    """

    name: str
    has_angles: bool
    has_clock: bool

    def to_links(self, message: ToLinks) -> Sequence[Frame]:
        """
        Write what the host says; nothing where the language has no word for it.

        :raises FrameError: kind `value`: a number that is not finite or does not fit.
        """

    def to_host(self, message: ToHost) -> Sequence[Frame]:
        """
        Write what a link says, as :meth:`to_links`.

        :raises FrameError: likewise.
        """

    def from_links(self, frame: Frame) -> ToHost | None:
        """
        Read at the host what a link says.

        :returns: the message; None for a frame that is none of a link's.
        :raises FrameError: it is a link's, but of a wrong length, corrupted, or says what cannot
            be.
        """

    def from_host(self, frame: Frame) -> ToLinks | None:
        """
        Read at the links what the host says.

        :returns: the message; None for a frame that is none of the host's.
        :raises FrameError: likewise.
        """
