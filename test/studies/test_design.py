# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Sizes of wheels and motors: energy balance, friction by hand, and the closed loop."""

from dataclasses import replace
import math

from fourbar_ros.kernels.runge_kutta import Drive
from fourbar_ros.mechanism import assemble, load_mechanism
from fourbar_ros.mechanism.forces import surroundings, System
from fourbar_ros.mechanism.integration import advance_state
from fourbar_ros.mechanism.state import LINK_ANGLES, make_state
from fourbar_ros.plant import load_table
from fourbar_ros.plant.table import surroundings_of
from fourbar_ros.studies import design
from fourbar_ros.studies.design_model import (
    Design,
    evaluate,
    least_energy,
    MANOEUVRES,
    with_ratio,
    with_wheels,
)
from fourbar_ros.studies.planned_cost import actuation_cost, rest_to_rest
import numpy as np
import pytest
from scipy.integrate import trapezoid

NOMINAL, TABLE = load_mechanism('prototype'), load_table('prototype')


@pytest.fixture(scope='module')
def present() -> Design:
    return evaluate(NOMINAL, TABLE)


@pytest.mark.slow
def test_study_passes_its_checks() -> None:
    result = design.run(lambda items, _: items)
    assert [check.name for check in result.checks if not check.passed] == []
    assert result.data['best_ratio']['whole_drawn'] == pytest.approx(1.0)
    sizes = result.data['sizes']
    within = [size['keeps_shares'] for size in sizes]
    assert within == sorted(within)
    assert not sizes[0]['keeps_shares']
    assert result.data['least']['keeps_shares']
    assert result.data['least']['total_mass_kg'] < result.data['present']['total_mass_kg']
    assert str(result.files['design.csv']).count('\n') == 1 + len(sizes) + len(
        result.data['ratios'])


def test_energy_balance_needs_all_losses(present: Design) -> None:
    for cost in present.costs.values():
        assert design.imbalance(cost, TABLE) < 1e-6
        assert design.imbalance(cost, load_table('ideal')) > 1e-4
        # The energy drawn covers the losses.
        lost = float(trapezoid((cost.bearings * cost.motor_speeds).sum(axis=1),
                               cost.times))
        assert cost.energy_drawn[-1] > lost + cost.copper_loss[-1]


def test_joint_friction_leaves_momentum_in_the_wheels(present: Design) -> None:
    """Four joints of 2e-4 N m slide for 10 s; drag reduces the momentum."""
    cost = present.costs['configuration']
    impulse = cost.torques.sum(axis=0) * (cost.times[1] - cost.times[0])
    np.testing.assert_allclose(
        impulse / NOMINAL.flywheel_inertias, cost.speeds[-1], rtol=1e-6)
    theta = math.pi / 3.0
    frictionless = actuation_cost(
        NOMINAL, rest_to_rest(theta, MANOEUVRES['configuration'], 10.0),
        assemble(NOMINAL, 0.0, theta), least_energy(NOMINAL))
    np.testing.assert_allclose(frictionless.speeds[-1], 0.0, atol=1e-9)
    slower, faster = (4.0 * 2e-4 * ratio * 10.0 / (2.0 * 1.2e-4) for ratio in (1.0, 1.3))
    assert slower < present.residual_speed < faster


def test_torques_make_the_motion_against_friction(present: Design) -> None:
    """The integrator with the same surroundings reproduces the motion."""
    around = surroundings_of(TABLE)
    assert around.acting
    for cost in present.costs.values():
        state = make_state(cost.angles[0], cost.link_rates[0], cost.speeds[0])
        step, worst = float(cost.times[2] - cost.times[0]), 0.0
        # Tilt moves the mass centre only, so the test omits it.
        level = surroundings(
            joint_coulomb=around.joint_coulomb, joint_viscous=around.joint_viscous,
            joint_static_ratio=float(around.joint_static_ratio),
            stribeck_rate=float(around.stribeck_rate), smoothing=float(around.smoothing),
            link_drag=around.link_drag, link_spin_drag=around.link_spin_drag)
        for n in range(0, len(cost.times) - 2, 2):
            advance_state(state, Drive(*cost.torques[n:n + 3]), step,
                          System(NOMINAL.constants, level))
            worst = max(worst, float(np.abs(state[LINK_ANGLES] - cost.angles[n + 2]).max()))
        assert worst < 2e-3


def test_links_of_another_ratio_have_the_same_circumference_and_mass() -> None:
    for ratio in (0.5, 1.0, 2.0):
        mechanism = with_ratio(NOMINAL, ratio)
        assert mechanism.link_lengths.sum() == pytest.approx(1.2)
        assert mechanism.link_masses.sum() == pytest.approx(NOMINAL.link_masses.sum())
        assert mechanism.link_lengths[0] / mechanism.link_lengths[1] == pytest.approx(ratio)
    np.testing.assert_allclose(with_ratio(NOMINAL, 1.0).link_inertias,
                               NOMINAL.link_inertias)


def test_heavier_wheels_make_heavier_links() -> None:
    mechanism = with_wheels(NOMINAL, 2.4e-4)
    np.testing.assert_allclose(
        mechanism.link_masses - NOMINAL.link_masses, 1.2e-4 / (0.7 * 0.05 ** 2))


def test_moves_add_up_until_the_limit(present: Design) -> None:
    assert design.moves_until_limit(present) == 3
    slower = replace(present.mechanism, motor_speed_limits=np.full(4, 2.0 * present.speed - 1.0))
    assert design.moves_until_limit(replace(present, mechanism=slower)) == 0
