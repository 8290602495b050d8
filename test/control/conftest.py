# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Linkages, and controllers with simple and with simulated plants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from fourbar_ros.control import Control, Controller, ControllerSettings
from fourbar_ros.mechanism import assemble, load_mechanism, Mechanism
from fourbar_ros.mechanism.closure import SIGNS
from fourbar_ros.mechanism.dynamics import mass_matrix
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
PERIOD_NS = 4_000_000
PLANT_STEP = 5e-4
IDEAL = Table(LinkSensorSettings(), WheelEncoders(0))


def link_accelerations(mechanism: Mechanism, angles: Array, rates: Array, wheel_torques: Array
                       ) -> Array:
    """
    Solve the equations of motion of all four links with joint forces as unknowns (4,) [rad/s^2].

    `M alpha - J^T lambda = -tau - h`, `J alpha = sum s_i l_i omega_i^2 e_i` (docs/mechanics.md).
    At a change point J has one row less, and eta is free.
    """
    constants = mechanism.constants
    apart = angles[None, :] - angles[:, None]
    bias = (constants.sine * np.cos(apart) - constants.cosine * np.sin(apart)) @ rates ** 2
    arms = np.array(SIGNS) * mechanism.link_lengths
    along, across = arms * np.cos(angles), arms * np.sin(angles)
    jacobian = np.array([-across, along])
    matrix = np.block([[mass_matrix(angles, constants), -jacobian.T],
                       [jacobian, np.zeros((2, 2))]])
    right = np.concatenate([-wheel_torques - bias, np.array([along, across]) @ rates ** 2])
    found: Array = np.linalg.lstsq(matrix, right, rcond=1e-11)[0][:4]
    return found


class Driven:
    """A controller on a linkage that follows its reference without error, wheels healthy."""

    def __init__(self, mechanism: Mechanism, phi_a: float, phi_b: float, branch: str,
                 settings: ControllerSettings) -> None:
        self.controller = Controller(mechanism, settings)
        self.angles: Array = assemble(mechanism, phi_a, phi_b, branch)
        self.rates: Array = np.zeros(4)
        self.speeds: Array = np.zeros(4)
        self.efforts: Array = np.zeros(4)
        self.stamp_ns = 1_000_000_000

    def tick(self) -> Control:
        """Advance by one tick; links and wheels follow reference and command exactly."""
        self.stamp_ns += PERIOD_NS
        control = self.controller.tick(
            self.stamp_ns, self.angles, self.rates, np.zeros(2), self.speeds, self.efforts)
        inertias, period = self.controller.mechanism.flywheel_inertias, PERIOD_NS * 1e-9
        turned = control.reference_rates - self.rates
        if control.command.by_speed:
            gained = control.command.values - self.speeds
            self.efforts = inertias * (gained + turned) / period
        else:
            self.efforts = control.command.values
            gained = period * self.efforts / inertias - turned
        self.speeds = self.speeds + gained
        self.angles, self.rates = control.reference_angles, control.reference_rates
        return control


@pytest.fixture(scope='session')
def drive(paper: Mechanism) -> Callable[..., Driven]:
    """Return a function that makes a controller, by default armed after one tick."""
    def make(mechanism: Mechanism = paper, phi_a: float = 0.0, phi_b: float = np.pi / 3,
             branch: str = 'open', armed: bool = True, **settings: float) -> Driven:
        driven = Driven(mechanism, phi_a, phi_b, branch, ControllerSettings(**settings))
        if armed:
            driven.controller.device_armed(True)
            driven.tick()
        return driven
    return make


class Steered:
    """
    A plant and a controller with exact inputs.

    :ivar disturbance: disturbance torques for the controller (2,) [N m].
    """

    def __init__(self, plant: Plant, controller: Controller) -> None:
        self.plant = plant
        self.controller = controller
        self.disturbance: Array = np.zeros(2)
        self.stamp_ns = 1_000_000_000
        self._wheel_angles = plant.truth().wheel_angles

    def tick(self) -> Control:
        """Advance by one tick; its command acts until the next one."""
        self.stamp_ns += PERIOD_NS
        truth = self.plant.truth()
        # Encoders measure the mean over a period.
        speeds = (truth.wheel_angles - self._wheel_angles) / (PERIOD_NS * 1e-9)
        self._wheel_angles = truth.wheel_angles
        control = self.controller.tick(
            self.stamp_ns, truth.link_angles, truth.link_rates, self.disturbance, speeds,
            truth.efforts)
        command = control.command
        self.plant.advance(round(PERIOD_NS * 1e-9 / PLANT_STEP), command.values,
                           command.by_speed, command.powered)
        return control

    def ticks(self, count: int) -> list[Control]:
        """Advance by several ticks."""
        return [self.tick() for _ in range(count)]


@pytest.fixture(scope='session')
def steer(paper: Mechanism) -> Callable[..., Steered]:
    """Return a function that makes a steered plant, by default armed after one tick."""
    def make(mechanism: Mechanism = paper, initial: InitialState | None = None,
             armed: bool = True, table: Table = IDEAL, **settings: float | str) -> Steered:
        plant = Plant(mechanism, table, initial or InitialState(), PLANT_STEP,
                      np.random.default_rng(0))
        steered = Steered(
            plant, Controller(mechanism, ControllerSettings(**settings)))  # type: ignore[arg-type]
        if armed:
            steered.controller.device_armed(True)
            steered.tick()
        return steered
    return make


@pytest.fixture(scope='session')
def strong(paper: Mechanism) -> Mechanism:
    """Make the linkage of the paper with motors for fast moves."""
    return replace(paper, motor_torque_limits=np.full(4, 1e-2),
                   motor_speed_limits=np.full(4, 5e4))


@pytest.fixture(scope='session')
def prototype() -> Mechanism:
    """Load the bench-scale linkage."""
    return load_mechanism('prototype')


@pytest.fixture(scope='session')
def parallelogram() -> Mechanism:
    """Make a parallelogram whose only equal parameters are opposite lengths."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.08, 0.12, 0.08], [0.02, 0.03, 0.025, 0.018], [2.2e-5, 1.5e-5, 3e-5, 1.8e-5],
        [[0.05, 0.01], [0.04, -0.01], [0.06, 0.005], [0.05, 0.0]], [3e-7, 4e-7, 5e-7, 2e-7],
        [1e-4] * 4, [500.0] * 4)


@pytest.fixture(scope='session')
def accelerations() -> Callable[[Mechanism, Array, Array, Array], Array]:
    """Return `link_accelerations`."""
    return link_accelerations
