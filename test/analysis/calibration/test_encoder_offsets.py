# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Encoder offsets: estimates, intervals, poses, and refusal of moving links."""

from collections.abc import Callable
from dataclasses import replace
from math import radians
from typing import Any

from fourbar_ros.analysis.calibration.encoder_offsets import (
    encoder_offsets,
    jig_pose,
    mean_readings,
)
from fourbar_ros.analysis.calibration.measurements import link_measurements, LinkMeasurements
from fourbar_ros.analysis.calibration.parameter_estimates import CalibrationError, QUANTILE_95
from fourbar_ros.mechanism import assemble, Mechanism
from fourbar_ros.plant import InitialState, Table
import numpy as np
import pytest
from scipy.stats import binom

COUNT = 500
NOISE = 1.7e-3
BIASES = np.array([0.02, -0.03, 0.001, 0.05])


def readings(pose: Any, seed: int, drift: float = 0.0, noise: float = NOISE) -> LinkMeasurements:
    """Read a pose with biases, noise and 1 % of dropout; all links drift [rad]."""
    generator = np.random.default_rng(seed)
    angles = (np.asarray(pose) + BIASES + noise * generator.standard_normal((COUNT, 4))
              + drift * np.linspace(0.0, 1.0, COUNT)[:, None])
    angles[generator.random(angles.shape) < 0.01] = np.nan
    wrapped = np.pi - (np.pi - angles) % (2.0 * np.pi)
    return link_measurements(np.arange(COUNT) * 4_000_000, wrapped, 0)


@pytest.mark.parametrize('phi_a', [0.0, 3.13, -3.13])
def test_offsets_are_found_at_any_orientation(prototype: Mechanism, phi_a: float) -> None:
    pose = assemble(prototype, phi_a, phi_a + 1.0)
    found = encoder_offsets(readings(pose, seed=3), pose)
    # Errors exceed five standard errors once in two million.
    np.testing.assert_array_less(np.abs(found.offsets - BIASES), 5.0 * found.standard_errors)
    np.testing.assert_allclose(found.standard_errors, NOISE / np.sqrt(COUNT), rtol=0.5)


def test_intervals_have_their_coverage(prototype: Mechanism) -> None:
    """The bounds of the count of 200 intervals at 95 % have a probability of 1e-4 each."""
    pose = assemble(prototype, 0.2, 1.2)
    covered = 0
    for seed in range(50):
        found = encoder_offsets(readings(pose, seed), pose)
        covered += int((np.abs(found.offsets - BIASES)
                        < QUANTILE_95 * found.standard_errors).sum())
    assert binom.ppf(1e-4, 200, 0.95) <= covered <= binom.ppf(1.0 - 1e-4, 200, 0.95), 'seeds 0-49'


def test_bias_of_the_simulated_sensors_is_found(
        prototype: Mechanism, lab: Table, make_bed: Callable[..., Any]) -> None:
    """Friction of the table of the prototype keeps its links at rest; seed 1."""
    biased = replace(lab, link_sensors=replace(lab.link_sensors, bias=tuple(BIASES)))
    bed = make_bed(prototype, biased, 1, InitialState())
    for _ in range(COUNT):
        bed.tick()
    links, _ = bed.recorded()
    pose = jig_pose(prototype, {'link_a': 0.0, 'link_b': np.pi / 3}, mean_readings(links))
    found = encoder_offsets(links, pose)
    # The noise dithers the quantization of 14 bits.
    np.testing.assert_allclose(found.offsets, BIASES, atol=5.0 * NOISE / np.sqrt(0.98 * COUNT))


def test_link_that_drifts_is_refused(prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    pose = assemble(prototype, 0.0, 1.0)
    with refuses(CalibrationError, reason='drift', name='link_a'):
        encoder_offsets(readings(pose, seed=0, drift=0.01), pose)


def test_link_that_shakes_is_refused(prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    pose = assemble(prototype, 0.0, 1.0)
    with refuses(CalibrationError, reason='deviation', name='link_a', limit=0.01):
        encoder_offsets(readings(pose, seed=0, noise=0.02), pose)


def test_few_samples_are_refused(prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    signal = readings(assemble(prototype, 0.0, 1.0), seed=0)
    with refuses(CalibrationError, reason='too_few', name='link_a', limit=20):
        encoder_offsets(LinkMeasurements(signal.times[:10], signal.angles[:10]), np.zeros(4))


@pytest.mark.parametrize('branch', ['open', 'crossed'])
def test_two_links_and_the_readings_give_the_pose(irregular: Mechanism, branch: str) -> None:
    pose = assemble(irregular, 0.3, 1.4, branch)
    known = {'link_a': 0.3, 'link_b': 1.4}
    np.testing.assert_allclose(np.cos(jig_pose(irregular, known, pose + BIASES) - pose), 1.0)


def test_third_link_decides_the_branch_against_bad_readings(irregular: Mechanism) -> None:
    pose = assemble(irregular, 0.3, 1.4, 'crossed')
    known = {'link_a': 0.3, 'link_b': 1.4, 'link_d': float(pose[3])}
    found = jig_pose(irregular, known, assemble(irregular, 0.3, 1.4, 'open'))
    np.testing.assert_allclose(np.cos(found - pose), 1.0)


@pytest.mark.parametrize(('known', 'expected'), [
    ({'link_a': 0.0, 'link_b': 1.0, 'link_c': 0.5, 'link_d': 1.0},
     {'reason': 'closure', 'limit': pytest.approx(6e-4)}),
    ({'link_a': 0.0, 'link_b': 1.0, 'link_c': radians(20.0)},
     {'reason': 'closure', 'limit': 2e-3}),
    ({'link_a': 0.0, 'link_e': 1.0}, {'reason': 'unknown', 'name': 'link_e'}),
    ({'link_a': 0.0}, {'reason': 'too_few', 'value': 1, 'limit': 2}),
    ({'link_a': 0.0, 'link_b': 0.0}, {'reason': 'closure', 'limit': None}),
])
def test_impossible_pose_is_refused(
        prototype: Mechanism, refuses: Callable[..., Any], known: dict[str, float],
        expected: dict[str, Any]) -> None:
    with refuses(CalibrationError, **expected):
        jig_pose(prototype, known, np.array([0.0, 1.0, 0.0, 1.0]))


def test_pose_beyond_reach_is_refused(
        irregular: Mechanism, refuses: Callable[..., Any]) -> None:
    with refuses(CalibrationError, reason='closure'):
        jig_pose(irregular, {'link_a': 0.0, 'link_c': np.pi - 0.05}, np.zeros(4))


def test_perfect_sensors_have_no_error(prototype: Mechanism) -> None:
    pose = assemble(prototype, 0.1, 1.1)
    signal = link_measurements(np.arange(100) * 4_000_000, np.tile(pose, (100, 1)), 0)
    found = encoder_offsets(signal, pose)
    np.testing.assert_allclose(found.offsets, 0.0, atol=1e-15)
    np.testing.assert_allclose(found.standard_errors, 0.0, atol=1e-15)
