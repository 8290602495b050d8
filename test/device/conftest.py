# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A device of four wheels without a linkage that records every torque."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.device import (
    Arming,
    Device,
    DeviceFault,
    DeviceState,
    DeviceSupervisor,
    Drive,
    LinkSample,
    Samples,
    SupervisorSettings,
    Timing,
    WheelSample,
)
from fourbar_ros.mechanism import LINK_NAMES, load_mechanism, Mechanism
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
PERIOD_NS = 4_000_000


class Bench(Device):
    """
    A device that records its inputs and returns prepared outputs.

    :ivar driven: torques of every step; a proportional controller follows speeds, within the
        limits; without power the torque is 0.
    :ivar powered: which wheels had power in every step.
    :ivar arming: of the supervisor, to record its state and reason at the last step.
    :ivar arming_then: that state and reason.
    :ivar links: the links that have a sample.
    :ivar breaks: whether the next step fails.
    :ivar complete: whether all wheels answer.
    :ivar drives, states: drives and arming states that were sent between steps.
    :ivar present_faults, blockers, held: prepared faults, arming blockers and stopped parts.
    :ivar closed: whether the device was closed.
    """

    description = 'bench'
    sensor_names = LINK_NAMES
    measures_rates = False

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        self.period_ns = PERIOD_NS
        self.driven: list[Array] = []
        self.powered: list[list[bool]] = []
        self.links: tuple[int, ...] = (0, 1, 2, 3)
        self.breaks = False
        self.complete = True
        self.drives: list[Drive] = []
        self.states: list[DeviceState] = []
        self.present_faults: list[DeviceFault] = []
        self.blockers: list[str] = []
        self.held: list[str] = []
        self.releases = 0
        self.closed = False
        self.arming = Arming()
        self.arming_then = (self.arming.state, '')
        self.speeds = np.array([10.0, -20.0, 0.0, 5.0])

    def drive(self, drive: Drive) -> None:
        """Record the drive."""
        if self.breaks:
            raise FourbarError('the bus is off')
        self.drives.append(drive)

    def arming_changed(self, state: DeviceState) -> None:
        """Record the state."""
        self.states.append(state)

    def release(self) -> Sequence[str]:
        """Count the call, and return the prepared parts."""
        self.releases += 1
        return self.held

    def faults(self) -> Sequence[DeviceFault]:
        """Return the prepared faults."""
        return self.present_faults

    def arming_blockers(self) -> Sequence[str]:
        """Return the prepared blockers."""
        return self.blockers

    def close(self) -> None:
        """Record the call."""
        self.closed = True

    def step(self, stamp_ns: int, drive: Drive) -> Samples:
        """Record the torques, and accelerate the wheels."""
        inertias, limits = self.mechanism.flywheel_inertias, self.mechanism.motor_torque_limits
        following = np.clip(30.0 * inertias * (drive.values - self.speeds), -limits, limits)
        torques = np.where(
            drive.powered, np.where(drive.by_speed, following, drive.values), 0.0)
        self.powered.append(drive.powered.tolist())
        self.driven.append(torques)
        self.arming_then = (self.arming.state, self.arming.reason)
        if self.breaks:
            raise FourbarError('the bus is off')
        self.speeds = self.speeds + torques / self.mechanism.flywheel_inertias * 4e-3
        names = tuple(LINK_NAMES[link] for link in self.links)
        sample = LinkSample(stamp_ns, names, np.zeros(len(names)), np.empty(0))
        return Samples(stamp_ns, (sample,), WheelSample(np.zeros(4), self.speeds, torques),
                       complete=self.complete)


class Operated:
    """A supervised device, with control over both clocks."""

    def __init__(self, mechanism: Mechanism, settings: SupervisorSettings) -> None:
        self.device = Bench(mechanism)
        self.supervisor = DeviceSupervisor(self.device, settings)
        self.device.arming = self.supervisor.arming
        self.stamp_ns = 1_000_000_000
        self.monotonic_ns = 50_000_000_000

    def tick(self, periods: float = 1.0, monotonic: float | None = None
             ) -> tuple[Samples, Timing]:
        """Advance stamps by some periods, and the monotonic clock by as many unless given."""
        self.stamp_ns += round(periods * PERIOD_NS)
        self.monotonic_ns += round((periods if monotonic is None else monotonic) * PERIOD_NS)
        result = self.supervisor.tick(self.stamp_ns, self.monotonic_ns)
        self.supervisor.published(self.monotonic_ns, 1000)
        return result

    def command(self, *efforts: float, ahead_ns: int = 0, names: list[str] | None = None) -> None:
        """Command the wheels a, b, ..., as many as there are efforts."""
        wheels = [f'flywheel_{letter}' for letter in 'abcd'[:len(efforts)]]
        self.supervisor.command(
            self.stamp_ns + ahead_ns, names or wheels, [], [], list(efforts), self.monotonic_ns)

    def arm(self, *arming_blockers: str) -> tuple[bool, str]:
        """Request arming."""
        return self.supervisor.arm(self.monotonic_ns, arming_blockers)

    @property
    def driven(self) -> list[float]:
        """The torques of the last step."""
        torques: list[float] = self.device.driven[-1].tolist()
        return torques

    @property
    def powered(self) -> list[bool]:
        """Which wheels had power in the last step."""
        return self.device.powered[-1]


@pytest.fixture(scope='session')
def paper() -> Mechanism:
    """Load the linkage of the paper."""
    return load_mechanism('paper')


@pytest.fixture(scope='session')
def operate(paper: Mechanism) -> Callable[..., Operated]:
    """Return a function that makes a supervised device, by default armed after one tick."""
    def make(armed: bool = True, **settings: object) -> Operated:
        operated = Operated(paper, SupervisorSettings(**settings))  # type: ignore[arg-type]
        if armed:
            operated.tick()
            assert operated.arm() == (True, 'armed')
        return operated
    return make
