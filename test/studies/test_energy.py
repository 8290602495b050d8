# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Actuation cost of motions: momentum by hand, the integrator, eq. 8 by the pseudo-inverse."""

import csv
from dataclasses import replace
import io
from math import pi

from fourbar_ros.control.allocation import make_allocation, WeightedNorm
from fourbar_ros.mechanism import (
    angular_momentum,
    assemble,
    load_mechanism,
    Mechanism,
    reduced_form,
)
from fourbar_ros.studies.energy import balancing, integration_error, run, turn
from fourbar_ros.studies.planned_cost import (
    actuation_cost,
    ActuationCostError,
    rest_to_rest,
)
import numpy as np
import pytest

WHOLE = (pi / 2.0, pi / 2.0)
PAPER = load_mechanism('paper')
UNEQUAL = replace(PAPER, flywheel_inertias=PAPER.flywheel_inertias * (0.88, 0.41, 1.37, 0.77))
# A linkage without equal links, with mass centres off the lines of the links.
ODD = Mechanism(
    link_lengths=[0.1, 0.12, 0.11, 0.14], link_masses=[0.02, 0.03, 0.025, 0.02],
    link_inertias=[2.2e-5, 3e-5, 2.5e-5, 4e-5],
    com_positions=[[0.05, 0.01], [0.06, -0.01], [0.05, 0.0], [0.08, 0.02]],
    flywheel_inertias=[3e-7, 4e-7, 5e-7, 6e-7])


def odd_step(speeds=None, law: str = 'min_norm'):
    return actuation_cost(
        ODD, rest_to_rest(1.2, (0.9, 0.3), 2.0), assemble(ODD, 0.0, 1.2),
        make_allocation(law, ODD.flywheel_inertias, [True] * 4), speeds)


@pytest.mark.medium
def test_study_passes_its_checks_and_has_its_keys() -> None:
    result = run(lambda items, _: items)
    assert [check.name for check in result.checks if not check.passed] == []
    for law in ('two_wheels', 'four_wheels'):
        assert {'peak_speed_rad_s', 'peak_energy_j', 'eq9_j_s', 'work_j', 'copper_j'} <= set(
            result.data[law])
    assert result.data['two_wheels']['peak_speed_rad_s'] == pytest.approx(124.74, abs=0.005)
    assert result.data['two_wheels']['eq9_j_s'] == pytest.approx(4.2995e-2, abs=5e-7)
    assert result.data['four_wheels']['peak_energy_j'] == pytest.approx(2.6452e-3, abs=5e-8)
    rows = list(csv.DictReader(io.StringIO(str(result.files['energy.csv']))))
    last = [row for row in rows if (row['manoeuvre'], row['law']) == ('whole', 'two_wheels')][-1]
    assert float(last['t_s']) == 10.0
    assert float(last['eq9_j_s']) == pytest.approx(result.data['two_wheels']['eq9_j_s'])


@pytest.mark.parametrize('law', ['two_wheels', 'min_norm', 'min_energy'])
def test_torques_make_the_motion_of_any_linkage(law: str) -> None:
    """The integrator, which is independent of the inverse dynamics, reproduces the motion."""
    cost = odd_step(np.array([30.0, -20.0, 10.0, 0.0]), law)
    assert integration_error(cost) < 1e-9
    total = [angular_momentum(ODD, *row) for row in zip(
        cost.angles, cost.link_rates, cost.speeds)]
    np.testing.assert_allclose(total, total[0], atol=1e-6 * np.ptp(
        cost.speeds @ ODD.flywheel_inertias))
    assert cost.motor_speeds[0] == pytest.approx([30.0, -20.0, 10.0, 0.0])


def test_least_accelerations_are_those_of_the_pseudo_inverse() -> None:
    """The reference is paper eq. 8, corrected: (G diag(If))^+ of the demand."""
    cost = odd_step()
    for n in (700, 2000, 3100):
        form = reduced_form(ODD, cost.angles[n], cost.link_rates[n])
        step = 1e-3
        rates = np.array([np.interp(cost.times[n] + dt, cost.times, column)
                          for column in cost.link_rates[:, :2].T for dt in (-step, step)])
        demand = form.mass_matrix @ ((rates[1::2] - rates[::2]) / (2.0 * step)) + form.bias
        accelerations = -np.linalg.pinv(form.wheel_map * ODD.flywheel_inertias) @ demand
        np.testing.assert_allclose(
            cost.torques[n], ODD.flywheel_inertias * accelerations,
            atol=1e-4 * np.abs(cost.torques).max())


def test_work_is_the_gain_of_energy_while_no_motor_brakes() -> None:
    """All motors drive until the peak rate, so the work is the energy of wheels and links."""
    cost = turn(PAPER, WHOLE, 'min_norm')
    middle = len(cost.times) // 2
    links = 0.5 * 2.0 * 1.44e-4 * cost.link_rates[middle, 0] ** 2
    assert cost.work[middle] == pytest.approx(
        cost.energy[middle] + links, rel=1e-6)


def test_balanced_speeds_have_the_least_energy() -> None:
    for cost in (turn(PAPER, WHOLE, 'two_wheels'), turn(UNEQUAL, WHOLE, 'min_norm'),
                 turn(PAPER, WHOLE, 'min_norm', np.array([50.0, 20.0, -10.0, 0.0]))):
        assert (cost.energy >= cost.least_energy * (1.0 - 1e-12)).all()
    unequal = turn(UNEQUAL, WHOLE, 'min_energy')
    np.testing.assert_allclose(unequal.energy, unequal.least_energy, atol=1e-18)
    kept = turn(UNEQUAL, WHOLE, 'min_energy', np.array([50.0, 20.0, -10.0, 0.0]))
    cost = balancing(kept)
    assert integration_error(cost) < 1e-9
    np.testing.assert_allclose(cost.speeds[-1], cost.balanced_speeds[-1], atol=1e-2)
    # Null-space torques do not change the momentum of a pair.
    for pair in ([0, 2], [1, 3]):
        np.testing.assert_allclose(cost.speeds[:, pair] @ UNEQUAL.flywheel_inertias[pair],
                                   kept.speeds[:, pair] @ UNEQUAL.flywheel_inertias[pair])
    np.testing.assert_allclose(
        np.gradient(cost.speeds, cost.times, axis=0)[5:-5] * UNEQUAL.flywheel_inertias,
        cost.torques[5:-5], atol=1e-4 * np.abs(cost.torques).max())


def test_wheels_of_one_pair_do_not_turn_the_other(refuses) -> None:
    with refuses(ActuationCostError, value=pytest.approx(1.0), limit=1e-9):
        actuation_cost(PAPER, rest_to_rest(1.0, (1.0, 1.0), 5.0), assemble(PAPER, 0.0, 1.0),
                       WeightedNorm(np.array([1.0, 0.0, 1.0, 0.0])))
