# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The closed loop in one process: the function calls that the nodes make over topics.

Each tick waits for the command that answers the previous one, so no message is lost and time is
simulated.
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
    """Results of one tick; estimate and control are None while the estimator is starting."""

    samples: Samples
    estimate: Estimate | None
    control: Control | None


class ClosedLoop:
    """
    A device with its estimator and controller.

    :param supervisor: of the device.
    :param estimator, controller: with the same model.
    """

    def __init__(self, supervisor: DeviceSupervisor, estimator: Estimator, controller: Controller
                 ) -> None:
        self.supervisor = supervisor
        self.estimator = estimator
        self.controller = controller
        self._next_ns = FIRST_STAMP_NS

    def step(self) -> Step:
        """
        Run one tick: device, estimator, controller, command.

        A rejected measurement or command is counted by the part that rejects it.

        :raises FourbarError: the device failed.
        """
        stamp_ns = self._next_ns
        self._next_ns += self.supervisor.device.period_ns
        samples, _ = self.supervisor.tick(stamp_ns, stamp_ns)
        self.supervisor.published(stamp_ns, 0)
        self.controller.device_armed(self.supervisor.arming.armed)
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
            self.supervisor.command(stamp_ns, names, (), velocities, efforts, stamp_ns)
        return Step(samples, estimate, control)

    def arm(self) -> tuple[bool, str]:
        """Arm the device at the last tick: success and message."""
        return self.supervisor.arm(self._next_ns - self.supervisor.device.period_ns, ())
