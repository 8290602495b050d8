# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Statistics of consistency on known samples, and the study on runs."""

from dataclasses import replace
from math import inf, isnan, nan

from fourbar_ros.estimation import filter as estimation_filter
from fourbar_ros.loop import load_scenario, run_scenario, Scenario
from fourbar_ros.plant import plant as plant_module
from fourbar_ros.studies import consistency
from fourbar_ros.studies.consistency_results import CaseResult, ConsistencyCase
from fourbar_ros.studies.consistency_runs import bound_of, execute, near_reversals
from fourbar_ros.studies.estimator_statistics import (
    autocorrelation,
    chi_square_bounds,
    lagged_products,
    normalised_squares,
    posterior_bound,
    share_inside,
)
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.stats import chi2

Array = NDArray[np.float64]


@pytest.fixture(scope='module')
def scenario() -> Scenario:
    return load_scenario('prototype')


def test_errors_drawn_from_their_covariance_are_within_bounds() -> None:
    """1000 draws of four numbers, seed 0; half of the covariance is out of bounds."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((1000, 4, 4)) * [1e-3, 1.0, 1e2, 1.0]
    covariances = root @ np.swapaxes(root, 1, 2)
    errors = (root @ rng.standard_normal((1000, 4, 1)))[..., 0]
    low, high = chi_square_bounds(4000, 0.9999)
    assert low < normalised_squares(errors, covariances).sum() < high
    assert normalised_squares(errors, 0.5 * covariances).sum() > high
    assert normalised_squares(errors, 2.0 * covariances).sum() < low


def test_bounds_are_those_of_scipy_and_none_without_degrees() -> None:
    degrees = np.array([1, 4, 400, 0])
    low, high = chi_square_bounds(degrees)
    np.testing.assert_allclose(low[:3], chi2.ppf(0.025, degrees[:3]), rtol=1e-10)
    np.testing.assert_allclose(high[:3], chi2.ppf(0.975, degrees[:3]), rtol=1e-10)
    assert isnan(low[3])
    assert isnan(high[3])


def test_share_counts_samples_with_bounds() -> None:
    values, low = np.array([1.0, 2.0, 3.0, 4.0, nan]), np.array([1.0, 1.0, 1.0, nan, 1.0])
    assert share_inside(values, low, low + 1.0) == pytest.approx(2.0 / 3.0)
    assert isnan(share_inside(values, low * nan, low))


def test_bounds_of_a_white_series_have_their_coverage() -> None:
    """
    The series has 400 autocorrelations, and a third of the samples is lost; seed 1.

    The share inside 95 % bounds has a standard error of 1.1 %; the tolerance is four of them.
    """
    rng = np.random.default_rng(1)
    series = 3.0 * rng.standard_normal((5000, 20))
    series[rng.random(series.shape) < 0.33] = nan
    found, bounds = autocorrelation(*lagged_products(series, 20))
    assert share_inside(found, -bounds, bounds) == pytest.approx(0.95, abs=0.044)


def test_coloured_series_has_the_autocorrelation_of_its_recursion() -> None:
    """For x(k+1) = 0.5 x(k) + noise it is 0.5^lag, within four standard errors (Bartlett)."""
    rng = np.random.default_rng(2)
    series = np.zeros((40_000, 1))
    for n, noise in enumerate(rng.standard_normal(len(series) - 1)):
        series[n + 1] = 0.5 * series[n] + noise
    series[rng.random(series.shape) < 0.2] = nan
    found, bounds = autocorrelation(*lagged_products(series, 4))
    standard_error = bounds / 1.96 * np.sqrt((1.0 + 0.25) / (1.0 - 0.25))
    assert np.all(np.abs(found - 0.5 ** np.arange(1, 5)[:, None]) < 4.0 * standard_error)
    assert share_inside(found, -bounds, bounds) == 0.0


def test_products_of_runs_are_summed_without_mixing() -> None:
    """The end of a run and the begin of the next one are no neighbours."""
    one, other = np.array([[1.0], [2.0], [nan], [4.0]]), np.array([[10.0]])
    sums, counts = lagged_products(one, 2)
    assert sums.tolist() == [[21.0], [2.0], [8.0]]
    assert counts.tolist() == [[3], [1], [1]]
    more, pairs = lagged_products(other, 2)
    assert more.tolist() == [[100.0], [0.0], [0.0]]
    assert pairs.tolist() == [[1], [0], [0]]


@pytest.mark.parametrize('late', [0, 3])
def test_bound_of_a_linear_system_is_the_covariance_of_its_kalman_filter(late: int) -> None:
    """The system is time-variant, seed 3; `late` is the number of predicted steps."""
    rng = np.random.default_rng(3)
    steps, size = 40, 3
    transitions = np.eye(size) + 0.3 * rng.standard_normal((steps - 1, size, size))
    roots = rng.standard_normal((steps - 1, size, size))
    noises = roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(size)
    rows = rng.standard_normal((steps, 2, size))
    prior = np.diag([1.0, 4.0, 9.0])

    corrected, filtered = [], prior
    for step in range(steps):
        if step:
            filtered = transitions[step - 1] @ filtered @ transitions[step - 1].T
            filtered += noises[step - 1]
        gain = filtered @ rows[step].T @ np.linalg.inv(
            rows[step] @ filtered @ rows[step].T + np.eye(2))
        filtered = (np.eye(size) - gain @ rows[step]) @ filtered
        corrected.append(filtered)

    driven = np.linalg.inv(noises)
    crossed = np.swapaxes(transitions, 1, 2) @ driven
    bounds = posterior_bound(np.linalg.inv(prior), crossed @ transitions, crossed, driven,
                             np.swapaxes(rows, 1, 2) @ rows, late)
    assert np.isnan(bounds[:late]).all()
    for step in range(late, steps):
        expected = corrected[step - late]
        for ahead in range(step - late, step):
            expected = transitions[ahead] @ expected @ transitions[ahead].T + noises[ahead]
        np.testing.assert_allclose(bounds[step], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.medium
@pytest.mark.parametrize('matched', [True, False])
def test_bound_equals_the_covariance_of_the_filter_without_losses(
    matched: bool, scenario: Scenario,
) -> None:
    """
    Along one trajectory they agree up to the linearisation at the estimate.

    The noise of the angles changes Gamma by 1e-3; with a latency the covariance is predicted.
    """
    if matched:
        scenario = consistency.matched(scenario, 0)
    else:
        sensors = replace(scenario.table.link_sensors, dropout=0.0)
        scenario = replace(scenario, table=replace(scenario.table, link_sensors=sensors))
    scenario = replace(scenario, duration=0.8)
    bound = bound_of(scenario, execute(scenario))
    said = [step.estimate for step in run_scenario(scenario)]
    assert [estimate is None for estimate in said] == np.isnan(bound[:, 0, 0]).tolist()
    for n in (10, 50, 200):
        estimate = said[n]
        assert estimate is not None
        sigmas = np.sqrt(estimate.covariance.diagonal())
        np.testing.assert_allclose(np.sqrt(bound[n].diagonal()[:4]), sigmas, rtol=0.01)


def test_reversal_is_a_change_of_the_friction_regime() -> None:
    """Joint 1 sticks, slides and reverses, and joint 4 slides too."""
    rates = np.zeros((14, 4))
    rates[:, 1] = [1e-5, -1e-5, 1e-5, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, -1.0, 0.0]
    rates[:, 2] = rates[:, 1]
    rates[:, 3] = 0.0
    # Joints 1 and 3 move, 2 and 4 do not.
    near = near_reversals(rates, 1e-4, 2)
    assert np.flatnonzero(near).tolist() == [3, 4, 8, 9, 13]


def test_matched_table_follows_the_model_of_the_filter(scenario: Scenario) -> None:
    made = consistency.matched(scenario, 0)
    table, settings = made.table, made.estimator
    assert (table.disturbance.torque_density, table.disturbance.torque_walk) == (
        settings.disturbance_torque, settings.disturbance_walk)
    assert settings.disturbance_walk == scenario.estimator.disturbance_walk > 0.0
    assert plant_module.TORQUE_WALK_AGE == estimation_filter.TORQUE_WALK_AGE
    assert (table.link_sensors.noise_rms, table.link_sensors.counts_per_turn) == (
        settings.angle_noise, settings.counts_per_turn)
    assert settings.gate == inf
    assert (table.link_sensors.latency, table.link_sensors.dropout) == (0.0, 0.0)
    assert (table.joints.coulomb, table.wheel_bearings.coulomb, table.links.drag,
            table.surface.tilt_x) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.medium
def test_overconfident_filter_fails_the_checks(scenario: Scenario) -> None:
    """The random-walk torques are ten times the assumed ones, over two runs of 1.5 s."""
    made = replace(consistency.matched(scenario, 0), duration=1.5)
    wild = replace(made, table=replace(made.table, disturbance=replace(
        made.table.disturbance, torque_walk=10.0 * made.table.disturbance.torque_walk)))
    passed = {}
    for name, case in (('right', made), ('wrong', wild)):
        sums = execute(case) + execute(replace(case, seed=1))
        outcome = CaseResult(
            ConsistencyCase('matched', 'matched', case), sums, bound_of(case, sums))
        passed[name] = {check.name: check.passed for check in consistency.checks([outcome])}
        assert (outcome.mean_nees > 10.0) == (name == 'wrong')
    assert passed['right']['matched, steps with NEES in its 95 % bounds']
    assert not passed['wrong']['matched, steps with NEES in its 95 % bounds']
    assert not passed['wrong']['matched, rms error / bound, phi_a']
    assert passed['wrong']['matched, runs in which a sensor was named faulty']
