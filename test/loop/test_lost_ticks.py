# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Lost ticks between device and controller do not look like wheel faults."""

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
    Delay estimator and controller, or the device, at random from the first tick on.

    The last ticks of a delay wait in the subscription; their commands are sent together after the
    delay. A delayed device skips ticks, and its wheels keep their last command.

    :param loss: share of ticks at which a delay begins.
    :param longest: longest delay [ticks].
    :param device: whether the device is delayed, or estimator and controller.
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
        # The device is armed early, when the covariance is still large.
        if not loop.supervisor.arming.armed:
            loop.supervisor.arm(stamp_ns, ())
        elif loop.controller.mode == 'hold' and tick % 100 == 0:
            up = 1.0 if tick % 200 else -1.0
            with suppress(SetpointError):
                loop.controller.setpoint(['link_a', 'link_b'], [0.3 * up, 1.3 + 0.3 * up])


def answer(loop: ClosedLoop, stamp_ns: int, samples: Samples, now_ns: int) -> None:
    """Run estimator and controller for a tick, and send the command to the device."""
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
def test_lost_ticks_cause_no_wheel_fault(
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
