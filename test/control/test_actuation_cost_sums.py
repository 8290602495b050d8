# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Actuation cost: kinetic energy of the wheels, and sums over time."""

from __future__ import annotations

from fourbar_ros.control.actuation_cost_sums import (
    ActuationCostSums,
    COPPER,
    ENERGIES,
    EQ9,
    FLYWHEEL_ENERGY,
    MAX_PERIOD,
    WORK,
)
from fourbar_ros.mechanism import assemble, kinetic_energy, Mechanism
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

NONE = np.zeros(4)


def test_names_are_in_the_order_of_the_numbers() -> None:
    assert [ENERGIES[n] for n in (FLYWHEEL_ENERGY, EQ9, WORK, COPPER)] == [
        'flywheel_energy_j', 'eq9_j_s', 'work_j', 'copper_loss_j']


def test_energy_is_that_of_the_wheels_with_their_links(prototype: Mechanism) -> None:
    cost, angles = ActuationCostSums(prototype), assemble(prototype, 0.0, 1.0)
    rates, speeds = np.array([0.5, -0.2, 0.5, -0.2]), np.array([20.0, -30.0, 40.0, 0.0])
    for _ in range(3):
        cost.add(4e-3, rates, speeds, NONE)
    assert cost.energies[FLYWHEEL_ENERGY] == pytest.approx(
        kinetic_energy(prototype, angles, NONE, speeds + rates), rel=1e-12)


@pytest.mark.parametrize('seed', range(3))
def test_heat_is_that_of_the_energy_budget_of_the_plant(seed: int, prototype: Mechanism) -> None:
    """The reference is the energy budget of the plant; efforts are means over a period."""
    plant = Plant(prototype, Table(LinkSensorSettings(), WheelEncoders(0)), InitialState(), 5e-4,
                  np.random.default_rng(0))
    cost, rng = ActuationCostSums(prototype), np.random.default_rng(seed)
    for _ in range(50):
        torques = rng.uniform(-0.004, 0.004, 4)
        # The motor torques are constant after the lag, so the square of the mean is the mean of
        # squares.
        plant.advance(200, torques)
        before = plant.ledger().copper
        plant.advance(8, torques)
        truth = plant.truth()
        before_tick = cost.energies[COPPER]
        cost.add(4e-3, truth.link_rates, truth.wheel_speeds, truth.efforts)
        assert cost.energies[COPPER] - before_tick == pytest.approx(
            plant.ledger().copper - before, rel=1e-6), f'seed {seed}'


def test_motors_without_described_windings_lose_nothing(paper: Mechanism) -> None:
    cost = ActuationCostSums(paper)
    cost.add(4e-3, NONE, NONE + 5.0, NONE + 1e-4)
    assert cost.energies[COPPER] == 0.0
    assert cost.energies[WORK] == pytest.approx(4.0 * 5.0 * 1e-4 * 4e-3)


@pytest.mark.parametrize('period', [0.0, 1.01 * MAX_PERIOD, 100.0])
def test_gap_in_time_does_not_count(period: float, prototype: Mechanism) -> None:
    cost = ActuationCostSums(prototype)
    cost.add(period, NONE, NONE + 5.0, NONE + 1e-2)
    assert not cost.energies[[EQ9, WORK, COPPER]].any()
    assert cost.energies[FLYWHEEL_ENERGY] > 0.0


def test_sums_grow_for_any_signs_until_reset(prototype: Mechanism) -> None:
    cost, rng = ActuationCostSums(prototype), np.random.default_rng(3)
    last = cost.energies.copy()
    for _ in range(100):
        cost.add(4e-3, rng.normal(size=4), 50.0 * rng.normal(size=4),
                 1e-2 * rng.normal(size=4))
        assert (cost.energies[[EQ9, WORK, COPPER]] > last[[EQ9, WORK, COPPER]]).all()
        last = cost.energies.copy()
    cost.reset()
    assert not cost.energies.any()
