# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A bench of four wheels without a linkage, whose every torque is on record."""

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
    A device that does what it is told.

    :ivar driven: torques of every step; speeds are followed in proportion, within the limits, and
        without power there is none.
    :ivar powered: which wheels had power in every step.
    :ivar gate: set by whoever wants to know its state (and reason) at the last step.
    :ivar arming_then: that state and reason.
    :ivar links: the links that give a sample.
    :ivar breaks: whether the next step fails.
    :ivar complete: whether it hears its wheels.
    :ivar told, gates: what it was told between steps, of drives and of the gate.
    :ivar found, in_the_way: its findings, and what speaks against arming.
    :ivar closed: whether it was.
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
        self.told: list[Drive] = []
        self.gates: list[DeviceState] = []
        self.found: list[DeviceFault] = []
        self.in_the_way: list[str] = []
        self.held: list[str] = []
        self.releases = 0
        self.closed = False
        self.arming = Arming()
        self.arming_then = (self.arming.state, '')
        self.speeds = np.array([10.0, -20.0, 0.0, 5.0])

    def drive(self, drive: Drive) -> None:
        """Take down what it is told between steps."""
        if self.breaks:
            raise FourbarError('the bus is off')
        self.told.append(drive)

    def arming_changed(self, state: DeviceState) -> None:
        """Take down what the gate does."""
        self.gates.append(state)

    def release(self) -> Sequence[str]:
        """Take down that it was released, and tell what it was made to hold."""
        self.releases += 1
        return self.held

    def faults(self) -> Sequence[DeviceFault]:
        """Find what it was made to."""
        return self.found

    def arming_blockers(self) -> Sequence[str]:
        """Be in the way if it was made to."""
        return self.in_the_way

    def close(self) -> None:
        """Take down that it was closed."""
        self.closed = True

    def step(self, stamp_ns: int, drive: Drive) -> Samples:
        """Take down the torques and let the wheels follow them."""
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
    """A testbed around the bench, with both clocks in one hand."""

    def __init__(self, mechanism: Mechanism, settings: SupervisorSettings) -> None:
        self.bench = Bench(mechanism)
        self.testbed = DeviceSupervisor(self.bench, settings)
        self.bench.arming = self.testbed.arming
        self.stamp_ns = 1_000_000_000
        self.monotonic_ns = 50_000_000_000

    def tick(self, periods: float = 1.0, steady: float | None = None
             ) -> tuple[Samples, Timing]:
        """Let stamps advance by some periods, the steady clock by as many unless told."""
        self.stamp_ns += round(periods * PERIOD_NS)
        self.monotonic_ns += round((periods if steady is None else steady) * PERIOD_NS)
        result = self.testbed.tick(self.stamp_ns, self.monotonic_ns)
        self.testbed.published(self.monotonic_ns, 1000)
        return result

    def command(self, *efforts: float, ahead_ns: int = 0, names: list[str] | None = None) -> None:
        """Command the wheels a, b, ..., as many as there are efforts."""
        wheels = [f'flywheel_{letter}' for letter in 'abcd'[:len(efforts)]]
        self.testbed.command(
            self.stamp_ns + ahead_ns, names or wheels, [], [], list(efforts), self.monotonic_ns)

    def arm(self, *arming_blockers: str) -> tuple[bool, str]:
        """Ask to drive."""
        return self.testbed.arm(self.monotonic_ns, arming_blockers)

    @property
    def driven(self) -> list[float]:
        """The torques of the last step."""
        torques: list[float] = self.bench.driven[-1].tolist()
        return torques

    @property
    def powered(self) -> list[bool]:
        """Which wheels had power in the last step."""
        return self.bench.powered[-1]


@pytest.fixture(scope='session')
def paper() -> Mechanism:
    """Load the linkage of the paper."""
    return load_mechanism('paper')


@pytest.fixture(scope='session')
def operate(paper: Mechanism) -> Callable[..., Operated]:
    """Return a function that makes a testbed, armed after its first tick unless told."""
    def make(armed: bool = True, **settings: object) -> Operated:
        operated = Operated(paper, SupervisorSettings(**settings))  # type: ignore[arg-type]
        if armed:
            operated.tick()
            assert operated.arm() == (True, 'armed')
        return operated
    return make
