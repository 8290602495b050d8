# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Lost frames and round trips between the host and emulated links in ten minutes, over UDP.

Two processes on loopback, without ROS: the round trip includes the bus, the message codec and the
processing at both ends.
"""

from __future__ import annotations

from multiprocessing import get_context
from multiprocessing.synchronize import Event
import time
from typing import Any

from fourbar_ros.common.checks import at_least, at_most
from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.common.progress import Progress
from fourbar_ros.device import Device, DeviceState, Drive
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.hardware.can_port import Port
from fourbar_ros.hardware.dbc_codec import DbcCodec
from fourbar_ros.hardware.emulator import Emulator, EmulatorSettings
from fourbar_ros.hardware.prototype import Prototype, PrototypeSettings
from fourbar_ros.hardware.safety_table import load_safety
from fourbar_ros.hardware.udp_bus import UdpBus
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant import InitialState, load_table, Plant
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS
from fourbar_ros.studies import Result, StudyError
from matplotlib.figure import Figure
import numpy as np

SECONDS = 600
PERIOD_NS = 4_000_000
# Answer timeout of the node [s], and the one of the study, which exceeds every limit so that it
# measures late answers as well.
NODE_TIMEOUT_S, ANSWER_TIMEOUT_S = 2e-3, 2e-2
# Timeout of the start of the emulated links and of arming [s].
START_UP_S = 30.0
# Torque on the wheels, whose sign alternates every second [N m], and ticks before arming.
TORQUE, IDLE_TICKS = 1e-3, 250
MEDIAN_MS, SLOWEST_MS = 1.0, 5.0
NO_TORQUE = Drive(np.zeros(4), np.zeros(4, dtype=bool), np.zeros(4, dtype=bool))

# Counters of lost frames of a link at the host. An answer that arrives after the timeout of its
# tick is late and not lost.
LOST = ('lost_angles', 'lost_heartbeats', 'replayed', 'wrong_time')


def run(progress: Progress, seconds: int = SECONDS) -> Result:
    """Drive emulated links for a number of seconds; count lost frames and time the answers."""
    # Compiles here, where it is announced, and caches for the process of the links.
    _emulator()
    context = get_context('spawn')
    stop, (here, there) = context.Event(), context.Pipe()
    links = context.Process(target=_serve_links, args=(stop, there), daemon=True)
    host = UdpBus('127.0.0.1:0', peers=())
    links.start()
    try:
        if not here.poll(START_UP_S):
            raise StudyError(f'the emulated links did not start within {START_UP_S:g} s',
                             limit=START_UP_S)
        host.add_peer(here.recv())
        here.send(_address(host))
        prototype = Prototype(
            load_mechanism('prototype'), lambda: Port(host, 'fourbar_udp', _address(host)),
            DbcCodec(), load_safety('prototype'),
            PrototypeSettings(answer_timeout=ANSWER_TIMEOUT_S), PERIOD_NS, monotonic_ns,
            lambda time_ns: time_ns)
        round_trips, counts = _drive(prototype, progress, seconds)
        prototype.close()
        stop.set()
        lost = here.recv() if here.poll(START_UP_S) else {}
    finally:
        stop.set()
        links.join(START_UP_S)
        host.shutdown()
    return _result({**counts, **lost}, round_trips, seconds)


def _address(bus: UdpBus) -> str:
    host, port = bus.address
    return f'{host}:{port}'


def _emulator() -> Emulator:
    """Make the emulator of the four links, with its kernels compiled."""
    plant = Plant(load_mechanism('prototype'), load_table('prototype'), InitialState(), 5e-4,
                  np.random.default_rng(0))
    emulator = Emulator(
        SimulatedTable(plant, 1_000_000), DbcCodec(), range(4), EmulatorSettings(),
        np.random.default_rng(), monotonic_ns(), time.time_ns())
    emulator.advance(emulator.next_ns)
    return emulator


def _serve_links(stop: Event, host: Any) -> None:
    """Serve the four links until the stop event, then send the counts of lost commands."""
    emulator = _emulator()
    bus = UdpBus('127.0.0.1:0', peers=())
    host.send(_address(bus))
    bus.add_peer(host.recv())
    port = Port(bus, 'fourbar_udp', _address(bus))
    while not stop.is_set():
        emulator.serve(port, monotonic_ns)
    host.send({f'commands_{kind}': sum(link.counts[kind] for link in emulator.firmware)
               for kind in ('lost_commands', 'replayed')})
    port.close()


def _drive(prototype: Prototype, progress: Progress, seconds: int
           ) -> tuple[Array, dict[str, int]]:
    """Return the round trips of the ticks [s], limited to the timeout, and counts."""
    begin_ns, tick = monotonic_ns(), 0

    def step(drive: Drive) -> float | None:
        nonlocal tick
        due_ns = begin_ns + tick * PERIOD_NS
        tick += 1
        if (ahead_ns := due_ns - monotonic_ns()) > 0:
            time.sleep(ahead_ns * 1e-9)
        return prototype.step(due_ns, drive).timing[0]

    while prototype.arming_blockers() or tick < IDLE_TICKS:
        step(NO_TORQUE)
        if tick * PERIOD_NS > START_UP_S * 1e9:
            raise StudyError(f'cannot arm: {"; ".join(prototype.arming_blockers())}')
    _arm(prototype)
    before, round_trips, missing = _counts(prototype), [], 0
    for second in progress(range(seconds), seconds):
        torque = TORQUE if second % 2 else -TORQUE
        drive = Drive(np.full(4, torque), np.zeros(4, dtype=bool), np.ones(4, dtype=bool))
        for _ in range(round(1e9) // PERIOD_NS):
            round_trip = step(drive)
            round_trips.append(ANSWER_TIMEOUT_S if round_trip is None else round_trip)
            missing += sum(link.missing for link in prototype.links)
            prototype.drive(drive)
    step(NO_TORQUE)
    counts = {kind: count - before[kind] for kind, count in _counts(prototype).items()}
    return np.array(round_trips), {**counts, 'lost_answers': missing - counts['late']}


def _arm(device: Device) -> None:
    device.arming_changed(DeviceState.ARMED)


def _counts(prototype: Prototype) -> dict[str, int]:
    values = prototype.diagnostic_values()
    bus = {f'frames_{kind}': int(str(values[f'frames_{kind}'])) for kind in ('sent', 'received')}
    return {**bus, **{kind: sum(link.counts[kind] for link in prototype.links)
                      for kind in (*LOST, 'late')}}


def _result(counts: dict[str, int], round_trips: Array, seconds: int) -> Result:
    lost = sum(count for kind, count in counts.items()
               if kind != 'late' and not kind.startswith('frames_'))
    late = int((round_trips > NODE_TIMEOUT_S).sum())
    middle, slow, slowest = np.percentile(round_trips * 1e3, [50.0, 99.0, 100.0]).tolist()
    data = {**counts, 'seconds': seconds, 'ticks': len(round_trips),
            'ticks_later_than_the_node_waits': late, 'round_trip_p50_ms': middle,
            'round_trip_p99_ms': slow, 'round_trip_max_ms': slowest}
    text = '\n'.join([
        f'{len(round_trips)} ticks, {counts["frames_sent"]} frames to the links, '
        f'{counts["frames_received"]} from them',
        f'round trip, from the request to the last of eight answers: median {middle:.3f} ms, '
        f'99 % {slow:.3f} ms, maximum {slowest:.3f} ms; {late} exceed the answer timeout of '
        f'{NODE_TIMEOUT_S * 1e3:g} ms of the node'])
    checks = [at_most('frames_lost', lost, '', 0),
              at_least('frames_received', counts['frames_received'], '', 12.0 * len(round_trips)
                       * 0.97),
              at_most('round_trip_p50_ms', middle, 'ms', MEDIAN_MS),
              at_most('round_trip_p99_ms', slow, 'ms', SLOWEST_MS)]
    return Result(checks, data, text, {'bus.png': _png(round_trips * 1e3)})


@style.as_png
def _png(round_trips: Array) -> Figure:
    """Draw the share of round trips that exceed a duration [ms]."""
    figure, axes = style.panels(3.2, 1, 1)
    ordered = np.sort(round_trips)
    axes.plot(ordered, 1.0 - np.arange(len(ordered)) / len(ordered), color=COLOURS['link_a'])
    for limit, share in ((MEDIAN_MS, 0.5), (SLOWEST_MS, 0.01)):
        axes.plot(limit, share, 'v', color=COLOURS['limit'])
        axes.annotate(f'limit {limit:g} ms', (limit, share), (6, 4),
                      textcoords='offset points', color=COLOURS['limit'])
    axes.set(xscale='log', yscale='log', xlabel='round trip [ms]',
             ylabel='share that took longer', ylim=(0.5 / len(ordered), 1.3))
    axes.set_title('From the request of a tick to the last answer')
    return figure
