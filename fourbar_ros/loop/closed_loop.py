# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The closed loop in one process: what the nodes do over topics, call by call.

The next tick comes when the command that answers the last one is there, so nothing is ever lost
and time is simulated.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.control import Control, Controller
from fourbar_ros.control.wheel_command import by_name
from fourbar_ros.device import DeviceSupervisor, Samples
from fourbar_ros.device.clock_modes import FIRST_STAMP_NS
from fourbar_ros.estimation import Estimate, Estimator


@dataclass(frozen=True, eq=False)
class Step:
    """Everything of one tick; without estimate or control while the estimator is starting."""

    samples: Samples
    estimate: Estimate | None
    control: Control | None


class ClosedLoop:
    """
    A testbed with its estimator and controller.

    :param testbed: the device behind its gate.
    :param estimator, controller: made for the same mechanism.
    """

    def __init__(self, testbed: DeviceSupervisor, estimator: Estimator, controller: Controller
                 ) -> None:
        self.testbed = testbed
        self.estimator = estimator
        self.controller = controller
        self._next_ns = FIRST_STAMP_NS

    def step(self) -> Step:
        """
        Go through one tick: device, estimator, controller, command.

        What one of them rejects it counts, and the others go on without it.

        :raises FourbarError: the device failed.
        """
        stamp_ns = self._next_ns
        self._next_ns += self.testbed.device.period_ns
        samples, _ = self.testbed.tick(stamp_ns, stamp_ns)
        self.testbed.published(stamp_ns, 0)
        self.controller.device_armed(self.testbed.arming.armed)
        for sample in samples.links:
            with suppress(RejectedError):
                self.estimator.measure(
                    sample.stamp_ns, sample.names, sample.angles.tolist(), sample.rates.tolist())
        estimate = None
        with suppress(RejectedError):
            estimate = self.estimator.tick(
                stamp_ns, samples.wheels.speeds, samples.wheels.efforts)
        if estimate is None:
            return Step(samples, None, None)
        control = self.controller.tick(
            stamp_ns, estimate.link_angles, estimate.link_rates, estimate.disturbance,
            samples.wheels.speeds, samples.wheels.efforts)
        names, velocities, efforts = by_name(control.command)
        with suppress(RejectedError):
            self.testbed.command(stamp_ns, names, (), velocities, efforts, stamp_ns)
        return Step(samples, estimate, control)

    def arm(self) -> tuple[bool, str]:
        """Arm the testbed at the last tick."""
        return self.testbed.arm(self._next_ns - self.testbed.device.period_ns, ())
