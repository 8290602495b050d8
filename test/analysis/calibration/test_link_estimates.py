# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Link parameters: determined combinations are found to 1 %, the others keep their prior."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fourbar_ros.analysis.calibration.evaluation import links_text, MAX_RESIDUAL_RATIO
from fourbar_ros.analysis.calibration.excitation import MultiSine
from fourbar_ros.analysis.calibration.link_identification import link_estimate, LinkEstimate
from fourbar_ros.analysis.calibration.measurements import LinkMeasurements, WheelMeasurements
from fourbar_ros.analysis.calibration.output_error import link_parameters
from fourbar_ros.analysis.calibration.parameter_estimates import CalibrationError, QUANTILE_95
from fourbar_ros.mechanism import Mechanism, reduced_form
from fourbar_ros.plant import InitialState, Table
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.stats import binom

START = {'prototype': InitialState(), 'irregular': InitialState(link_b=1.3)}


def prior_mechanism(truth: Mechanism, seed: int) -> Mechanism:
    """Return a mechanism file that is off by 5 % in inertias and by 5 mm in mass centres."""
    generator = np.random.default_rng(100 + seed)
    return replace(
        truth, link_inertias=truth.link_inertias * (1.0 + 0.05 * generator.standard_normal(4)),
        com_positions=truth.com_positions + 5e-3 * generator.standard_normal((4, 2)))


def reduced(mechanism: Mechanism, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return A_aa, A_ab, A_bb at poses, one after the other [kg m^2]."""
    return np.concatenate([
        reduced_form(mechanism, pose, np.zeros(4)).mass_matrix[[0, 0, 1], [0, 1, 1]]
        for pose in poses])


@pytest.fixture(scope='module', params=[
    pytest.param(1, id='one seed'), pytest.param(4, id='four seeds', marks=pytest.mark.slow)])
def estimates(request: pytest.FixtureRequest, prototype: Mechanism, irregular: Mechanism,
              lab: Table, excited: Callable[..., Any]
              ) -> dict[str, list[tuple[Mechanism, LinkEstimate]]]:
    """Estimate both linkages on the table of the prototype, seeds from 0."""
    found: dict[str, list[tuple[Mechanism, LinkEstimate]]] = {}
    for name, truth in (('prototype', prototype), ('irregular', irregular)):
        found[name] = []
        for seed in range(request.param):
            links, wheels = excited(truth, lab, MultiSine(truth, 24.0, 0.02), seed, START[name])
            found[name].append((truth, link_estimate(prior_mechanism(truth, seed), links, wheels)))
    return found


@pytest.mark.medium
@pytest.mark.parametrize('name', START)
def test_reduced_inertias_are_found_to_one_percent(
        estimates: dict[str, list[tuple[Mechanism, LinkEstimate]]], name: str) -> None:
    """The error is below 1 % of the diagonal, and below 30 % of that of the prior."""
    for seed, (truth, found) in enumerate(estimates[name]):
        wanted = reduced(truth, found.poses)
        size = np.sqrt(wanted[0] * wanted[2])
        values = np.array([item.value for item in found.reduced_inertias()])
        assert np.abs(values - wanted).max() < 0.01 * size, f'seed {seed}'
        before = np.array([item.before for item in found.reduced_inertias()], dtype=float)
        assert np.abs(values - wanted).max() < 0.3 * np.abs(before - wanted).max(), f'seed {seed}'


@pytest.mark.slow
def test_only_noise_is_left_where_nothing_else_moved_the_links(
        estimates: dict[str, list[tuple[Mechanism, LinkEstimate]]]) -> None:
    assert max(found.residual_ratio for of_one in estimates.values() for _, found in of_one) < 1.2


@pytest.mark.slow
def test_disturbance_in_the_residuals_is_reported(
        estimates: dict[str, list[tuple[Mechanism, LinkEstimate]]]) -> None:
    """The disturbance is an oscillation of a degree, as after a contact with the edge."""
    _, found = estimates['prototype'][0]
    without = links_text(found, [], []).splitlines()
    pushed = replace(found, residuals=tuple(
        (times, angles, left + np.radians(1.0) * np.sin(times))
        for times, angles, left in found.residuals))
    assert pushed.residual_ratio > MAX_RESIDUAL_RATIO
    assert found.residual_ratio < MAX_RESIDUAL_RATIO
    assert len(links_text(pushed, [], []).splitlines()) == len(without) + 1


@pytest.mark.medium
@pytest.mark.parametrize('name', START)
def test_intervals_cover_the_truth(
        estimates: dict[str, list[tuple[Mechanism, LinkEstimate]]], name: str) -> None:
    """
    A_aa, A_ab and A_bb at a middle pose: three intervals at 95 % for each seed.

    The bound of the count has a probability of 1e-3 for independent intervals.
    """
    covered = 0
    for truth, found in estimates[name]:
        wanted = reduced(truth, found.poses)[3:6]
        for item, value in zip(found.reduced_inertias()[3:6], wanted):
            covered += abs(item.value - value) < QUANTILE_95 * item.standard_error
    assert covered >= binom.ppf(1e-3, 3 * len(estimates[name]), 0.95), 'seeds from 0'


@pytest.mark.medium
def test_rhombus_determines_four_combinations_and_another_linkage_more(
        estimates: dict[str, list[tuple[Mechanism, LinkEstimate]]]) -> None:
    """
    A motion of a rhombus depends on A_aa, A_bb, and A_ab with a cosine and a sine.

    The fourth and the fifth combination differ by an order of magnitude, far more than noise.
    """
    for seed, (_, found) in enumerate(estimates['prototype']):
        assert [one.determined for one in found.combinations] == [True] * 4 + [False] * 8, seed
        assert found.combinations[4].error > 10.0 * found.combinations[3].error, seed
    for seed, (_, found) in enumerate(estimates['irregular']):
        assert sum(one.determined for one in found.combinations) > 4, seed


@pytest.mark.medium
def test_sums_over_opposite_links_are_determined_and_differences_are_not(
        estimates: dict[str, list[tuple[Mechanism, LinkEstimate]]]) -> None:
    """
    In a rhombus I_a - I_c has no effect, so its estimate is the prior.

    The estimate is the nearest one to the prior of all equal fits, so the truth is farther.
    """
    for seed, (truth, found) in enumerate(estimates['prototype']):
        weights = np.array([one.weights for one in found.combinations if one.determined])
        moved, away = ((link_parameters(other) - link_parameters(found.before))
                       / found.prior_sigmas for other in (found.mechanism, truth))
        for first, second in ((0, 2), (1, 3)):
            apart = np.zeros(12)
            apart[[first, second]] = np.array([1.0, -1.0]) / np.sqrt(2.0)
            # Components are relative to the prior, which differs by 5 %.
            assert np.linalg.norm(weights @ apart) < 0.1, f'seed {seed}'
            assert abs(moved @ apart) < 0.1 * np.linalg.norm(moved), f'seed {seed}'
        assert np.linalg.norm(moved) < np.linalg.norm(away), f'seed {seed}'


@pytest.mark.medium
def test_noise_of_the_sensors_is_what_is_left(
        estimates: dict[str, list[tuple[Mechanism, LinkEstimate]]], lab: Table) -> None:
    """Residuals are noise and rounding to 14 bits; their rms is known to half a percent."""
    expected = np.hypot(lab.link_sensors.noise_rms,
                        2.0 * np.pi / lab.link_sensors.counts_per_turn / np.sqrt(12.0))
    for pairs in estimates.values():
        for seed, (_, found) in enumerate(pairs):
            assert found.noise == pytest.approx(expected, rel=0.03), f'seed {seed}'


def still(seconds: float) -> tuple[LinkMeasurements, WheelMeasurements]:
    """Record links and wheels that rest."""
    times = np.arange(0.0, seconds, 4e-3)
    angles = np.tile([0.0, 1.0, 0.0, 1.0], (len(times), 1))
    zeros = np.zeros((len(times), 4))
    return LinkMeasurements(times, angles), WheelMeasurements(times, zeros, zeros, zeros)


def test_links_at_rest_are_refused(prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    with refuses(CalibrationError, reason='too_short', value=0.0, limit=8.0):
        link_estimate(prototype, *still(20.0))


def test_link_with_a_gap_is_named(prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    links, wheels = still(20.0)
    links.angles[1000:1250, 2] = np.nan
    with refuses(CalibrationError, reason='gap', name='link_c', limit=0.4,
                 value=pytest.approx(1.0, abs=0.01)):
        link_estimate(prototype, links, wheels)


def test_missing_ticks_are_counted(prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    links, wheels = still(20.0)
    kept = np.delete(np.arange(len(wheels.times)), 700)
    with refuses(CalibrationError, reason='missing_ticks', value=1):
        link_estimate(prototype, links, WheelMeasurements(
            wheels.times[kept], wheels.angles[kept], wheels.speeds[kept], wheels.efforts[kept]))
