# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A prototype and its emulated links on a wire, in simulated time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import count

from fourbar_ros.device import DeviceSupervisor, Samples, SupervisorSettings
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.hardware.dbc_codec import DbcCodec
from fourbar_ros.hardware.emulator import ClockSettings, Emulator, EmulatorSettings
from fourbar_ros.hardware.messages import BusError, Codec, Frame
from fourbar_ros.hardware.prototype import Prototype, PrototypeSettings
from fourbar_ros.hardware.safety_table import load_safety
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.plant import InitialState, load_table, Plant
import numpy as np
import pytest

PERIOD_NS = 4_000_000
# Host time and stamp at the start [ns].
START_NS, STAMP_NS = 5_000_000_000, 1_700_000_000_000_000_000
DRIFTS = (80e-6, -40e-6, 10e-6, -60e-6)


@dataclass
class Wire:
    """
    The host's end of a bus in simulated time.

    :ivar now_ns: clock of the host [ns].
    :ivar delays_ns: smallest and largest delay of a frame [ns].
    :ivar loss: share of lost frames.
    :ivar broken: whether the bus is broken.
    :ivar sent_frames: the last frames of the host.
    :ivar lost_ids: identifiers whose frames to the host are lost.
    :ivar opened_ns: times at which the host opened the bus, or tried to [ns].
    """

    emulators: list[Emulator] = field(default_factory=list)
    now_ns: int = START_NS
    delays_ns: tuple[int, int] = (60_000, 200_000)
    loss: float = 0.0
    broken: bool = False
    fault: str | None = None
    lost_ids: set[int] = field(default_factory=set)
    opened_ns: list[int] = field(default_factory=list)
    sent_frames: deque[Frame] = field(default_factory=lambda: deque(maxlen=1000))
    sent: int = 0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))
    _number: count[int] = field(default_factory=count)
    _to_links: list[tuple[int, int, Frame]] = field(default_factory=list)
    _to_host: list[tuple[int, int, Frame]] = field(default_factory=list)

    def send(self, frame: Frame) -> None:
        """Send a frame to the links."""
        if self.broken:
            raise BusError('the bus is gone')
        self.sent_frames.append(frame)
        self.sent += 1
        self._push(self._to_links, frame, self.now_ns)

    def receive(self, timeout_s: float) -> tuple[Frame, int] | None:
        """Let time pass until a frame arrives."""
        if self.broken:
            raise BusError('the bus is gone')
        end_ns = self.now_ns + round(timeout_s * 1e9)
        while True:
            self._let_links_work(end_ns)
            if not self._to_host or self._to_host[0][0] > end_ns:
                self.now_ns = end_ns
                return None
            arrival_ns, _, frame = heappop(self._to_host)
            self.now_ns = max(self.now_ns, arrival_ns)
            return frame, arrival_ns

    def _let_links_work(self, end_ns: int) -> None:
        """Advance the links until a frame may have arrived at the host, at most until `end_ns`."""
        while True:
            due = [emulator.next_ns for emulator in self.emulators]
            if self._to_links:
                due.append(self._to_links[0][0])
            next_ns = min(due, default=end_ns + 1)
            if next_ns > end_ns or self._to_host and self._to_host[0][0] <= next_ns:
                return
            if self._to_links and self._to_links[0][0] == next_ns:
                _, _, frame = heappop(self._to_links)
                for emulator in self.emulators:
                    for answer in emulator.receive(frame, next_ns):
                        self._push(self._to_host, answer, next_ns)
            else:
                for emulator in self.emulators:
                    for said in emulator.advance(next_ns):
                        self._push(self._to_host, said, next_ns)

    def inject(self, frame: Frame) -> None:
        """Send a frame to the host."""
        self._push(self._to_host, frame, self.now_ns)

    def diagnostic_values(self) -> dict[str, object]:
        """Return the number of sent frames."""
        return {'frames_sent': self.sent}

    def close(self) -> None:
        """Do nothing."""

    def _push(self, queue: list[tuple[int, int, Frame]], frame: Frame, now_ns: int) -> None:
        if self.rng.random() >= self.loss and not (
                queue is self._to_host and frame.frame_id in self.lost_ids):
            delay_ns = int(self.rng.integers(*self.delays_ns, endpoint=True))
            heappush(queue, (now_ns + delay_ns, next(self._number), frame))


class World:
    """
    A supervised prototype with its bus, its emulated links and its table.

    :ivar samples: samples of the ticks so far.
    """

    def __init__(self, codec: Codec | None = None, links: tuple[int, ...] = (0, 1, 2, 3),
                 table: str = 'prototype',
                 settings: PrototypeSettings | None = None,
                 supervisor: SupervisorSettings | None = None) -> None:
        self.codec = codec or DbcCodec('prototype')
        self.wire = Wire()
        self.samples: list[Samples] = []
        mechanism = load_mechanism('prototype')
        self.wire.emulators.append(self.emulator(links, table, seed=0))
        self.prototype = Prototype(
            mechanism, self.connect, self.codec, load_safety('prototype'),
            settings or PrototypeSettings(), PERIOD_NS, lambda: self.wire.now_ns, self.stamp_of)
        self.testbed = DeviceSupervisor(self.prototype, supervisor or SupervisorSettings())
        self.command: Callable[[], None] | None = None
        self._ticks = 0

    def emulator(self, links: tuple[int, ...], table: str, seed: int) -> Emulator:
        """Make emulated links that start now."""
        now_ns = self.wire.now_ns
        plant = Plant(load_mechanism('prototype'), load_table(table),
                      InitialState(link_a=0.0, link_b=1.0, branch='open', rate_a=0.0, rate_b=0.0),
                      5e-4, np.random.default_rng(seed))
        return Emulator(
            SimulatedTable(plant, 1_000_000), self.codec, links, EmulatorSettings(),
            np.random.default_rng(seed), now_ns, self.stamp_of(now_ns),
            ClockSettings((100.0, 2000.0, 0.5, 50.0), DRIFTS))

    def connect(self) -> Wire:
        """Return the wire unless it is broken."""
        self.wire.opened_ns.append(self.wire.now_ns)
        if self.wire.broken:
            raise BusError('the bus is gone')
        return self.wire

    @staticmethod
    def stamp_of(time_ns: int) -> int:
        """Return the stamp of a host time [ns]."""
        return time_ns - START_NS + STAMP_NS

    def tick(self) -> Samples:
        """Advance time by a period."""
        due_ns = START_NS + self._ticks * PERIOD_NS
        self._ticks += 1
        self.wire.now_ns = max(self.wire.now_ns, due_ns)
        stamp_ns = self.stamp_of(due_ns)
        samples, _ = self.testbed.tick(stamp_ns, self.wire.now_ns)
        self.testbed.published(self.wire.now_ns, 0)
        self.samples.append(samples)
        if self.command is not None and samples.complete:
            self.command()
        return samples

    def run(self, seconds: float) -> None:
        """Advance time."""
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            self.tick()

    def torque(self, *torques: float) -> None:
        """Command the same torques at every tick from now on."""
        names = [f'flywheel_{letter}' for letter in 'abcd'[:len(torques)]]

        def give() -> None:
            self.testbed.command(
                self.samples[-1].stamp_ns, names, [], [], list(torques), self.wire.now_ns)
        self.command = give

    def arm(self) -> tuple[bool, str]:
        """Request arming."""
        return self.testbed.arm(self.wire.now_ns, ())


@pytest.fixture
def world() -> World:
    """Return a world whose clocks and limits are settled."""
    world = World()
    world.run(1.0)
    return world


@pytest.fixture
def make_world() -> type[World]:
    """Return the class of worlds."""
    return World
