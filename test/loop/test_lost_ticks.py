# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Ticks get lost between device and controller, which must not take that for a broken wheel."""

from collections import deque
from contextlib import suppress
from dataclasses import replace

from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.control import SetpointError
from fourbar_ros.control.wheel_command import by_name
from fourbar_ros.device import Samples
from fourbar_ros.device.clock_modes import FIRST_STAMP_NS
from fourbar_ros.loop.closed_loop import ClosedLoop
from fourbar_ros.loop.run import make_loop
from fourbar_ros.loop.scenario import load_scenario
import numpy as np
import pytest

SEEDS = range(6)


def run(loop: ClosedLoop, seed: int, seconds: float, loss: float, longest: int, device: bool
        ) -> None:
    """
    Hold estimator and controller, or the device, up now and then, from the first tick on.

    Of the ticks meanwhile the last few wait for them, as they do in a subscription; the commands
    for these come all at once, when their time has passed. A device that is held up leaves ticks
    out, and its wheels keep their last command.

    :param loss: share of ticks at which they are held up.
    :param longest: largest number of ticks.
    :param device: who.
    """
    rng = np.random.default_rng(seed)
    away, waiting = 0, deque[tuple[int, Samples]](maxlen=5)
    for tick in range(round(seconds * 1e9 / loop.supervisor.device.period_ns)):
        stamp_ns = FIRST_STAMP_NS + tick * loop.supervisor.device.period_ns
        if device and away:
            away -= 1
            continue
        samples, _ = loop.supervisor.tick(stamp_ns, stamp_ns)
        loop.supervisor.published(stamp_ns, 0)
        waiting.append((stamp_ns, samples))
        if away:
            away -= 1
            continue
        if rng.random() < loss:
            away = int(rng.integers(1, longest + 1))
        for then_ns, then in list(waiting):
            answer(loop, then_ns, then, stamp_ns)
        waiting.clear()
        # Early, when the estimator still knows little.
        if not loop.supervisor.arming.armed:
            loop.supervisor.arm(stamp_ns, ())
        elif loop.controller.mode == 'hold' and tick % 100 == 0:
            up = 1.0 if tick % 200 else -1.0
            with suppress(SetpointError):
                loop.controller.setpoint(['link_a', 'link_b'], [0.3 * up, 1.3 + 0.3 * up])


def answer(loop: ClosedLoop, stamp_ns: int, samples: Samples, now_ns: int) -> None:
    """Let estimator and controller work on a tick, and the device take what comes of it."""
    loop.controller.device_armed(loop.supervisor.arming.armed)
    with suppress(RejectedError):
        for sample in samples.links:
            loop.estimator.measure(
                sample.stamp_ns, sample.names, sample.angles.tolist(), sample.rates.tolist())
        estimate = loop.estimator.tick(stamp_ns, samples.wheels.speeds, samples.wheels.efforts)
        if estimate is None:
            return
        control = loop.controller.tick(
            stamp_ns, estimate.link_angles, estimate.link_rates, estimate.disturbance,
            samples.wheels.speeds, samples.wheels.efforts, late=now_ns > stamp_ns)
        names, velocities, efforts = by_name(control.command)
        loop.supervisor.command(stamp_ns, names, (), velocities, efforts, now_ns)


@pytest.mark.slow
@pytest.mark.parametrize('preset', ['paper', 'prototype'])
@pytest.mark.parametrize('command', ['effort', 'velocity'])
@pytest.mark.parametrize(('loss', 'longest'), [(0.05, 5), (0.01, 40)])
@pytest.mark.parametrize('device', [False, True], ids=['loop', 'device'])
def test_healthy_wheels_stay_healthy(
    preset: str, command: str, loss: float, longest: int, device: bool,
) -> None:
    scenario = load_scenario(preset)
    controller = replace(scenario.controller, command=command, setpoint_duration=1.0,
                         setpoint_timing='shortest')
    for seed in SEEDS:
        scenario = replace(scenario, seed=seed)
        loop = make_loop(replace(scenario, controller=controller))
        run(loop, seed, 4.0, loss, longest, device)
        assert not loop.controller.wheels.faults(), f'seed {seed}'
