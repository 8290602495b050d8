# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
At change points the sigmas cover the errors, and the sensors determine the branch.

The prototype's linkage has equal opposite links: at theta = phi_b - phi_a = 0 and pi all four lie
on a line, and psi = phi_c - phi_a is free there besides theta.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from fourbar_ros.estimation import Estimate, Estimator, EstimatorSettings
from fourbar_ros.estimation.filter import LinkageFilter
from fourbar_ros.estimation.filter_model import ProcessNoise
from fourbar_ros.mechanism import load_mechanism, Mechanism
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import move_held
from fourbar_ros.mechanism.state import LINK_ANGLES, LINK_RATES, make_state, WHEEL_SPEEDS
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy import stats

Array = NDArray[np.float64]

PERIOD_NS = 4_000_000
PERIOD = 4e-3
NOISE = 1.7453e-3
SETTINGS = EstimatorSettings(
    angle_noise=NOISE, counts_per_turn=0, disturbance_torque=1e-5, disturbance_walk=1e-5)
# Bound of errors in sigmas: one of a thousand normal numbers exceeds 5 with p = 0.0006.
SIGMAS = 5.0
SEEDS = range(3)


@pytest.fixture(scope='module')
def mechanism() -> Mechanism:
    """Load the linkage of the prototype."""
    return load_mechanism('prototype')


class Moment(NamedTuple):
    """True angles and rates of the links at a tick, and their estimate."""

    angles: Array
    rates: Array
    estimate: Estimate

    def deviations(self) -> Array:
        """Return the errors of angles and rates in sigmas (8,)."""
        estimate = self.estimate
        return np.concatenate([
            wrap_angles(estimate.link_angles - self.angles) / estimate.angle_sigmas,
            (estimate.link_rates - self.rates) / estimate.rate_sigmas])


def watch(mechanism: Mechanism, angles: Array, rates: Array, torques: Callable[[float], Array],
          seconds: float, seed: int, sensors: tuple[int, ...] = (0, 1, 2, 3)
          ) -> tuple[Estimator, Iterator[Moment]]:
    """Estimate the motion of a linkage from any state, also from change points."""
    rng = np.random.default_rng(seed)
    estimator = Estimator(mechanism, SETTINGS)
    names = [('link_a', 'link_b', 'link_c', 'link_d')[sensor] for sensor in sensors]

    def moments() -> Iterator[Moment]:
        state = make_state(angles, rates)
        stamp_ns = 10 ** 9
        speed = state[WHEEL_SPEEDS] - state[LINK_RATES]
        for n in range(round(seconds / PERIOD)):
            before = speed
            move_held(state, torques(n * PERIOD), 5e-4, 8, mechanism.constants, NOTHING)
            speed = state[WHEEL_SPEEDS] - state[LINK_RATES]
            stamp_ns += PERIOD_NS
            estimator.measure(stamp_ns, names, list(
                state[LINK_ANGLES][list(sensors)] + NOISE * rng.standard_normal(len(sensors))))
            estimate = estimator.tick(stamp_ns, list(0.5 * (before + speed)))
            assert estimate is not None, f'seed {seed}'
            yield Moment(state[LINK_ANGLES].copy(), state[LINK_RATES].copy(), estimate)
    return estimator, moments()


def at_rest(_: float) -> Array:
    return np.zeros(4)


def settled(estimator: Estimator, moments: Iterator[Moment], seed: int) -> list[Moment]:
    """Check that errors stay within their sigmas and that NIS is that of noise."""
    everything = list(moments)[100:]
    deviations = np.array([moment.deviations() for moment in everything])
    assert np.abs(deviations).max() < SIGMAS, f'seed {seed}'
    innovations = [moment.estimate.innovation for moment in everything]
    nis = sum(seen.nis for seen in innovations if seen is not None)
    freedom = sum(seen.degrees_of_freedom for seen in innovations if seen is not None)
    low, high = stats.chi2.interval(0.9999, freedom)
    assert low < nis < high, f'seed {seed}'
    assert estimator.starts == 1
    assert estimator.sensor_faults() == {}
    return everything


@pytest.mark.medium
@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('aligned', [0.0, np.pi], ids=['0', 'pi'])
@pytest.mark.parametrize(('before', 'rate'), [(-0.4, 0.6), (-0.06, 0.02), (0.4, -2.0)])
def test_passage(seed: int, aligned: float, before: float, rate: float, mechanism: Mechanism
                 ) -> None:
    """Fast and slow, on the branch of the motion."""
    angles = np.array([0.2, 0.2, 0.2, 0.2]) + (aligned + before) * np.array([0, 1, 0, 1])
    rates = rate * np.array([0.0, 1.0, 0.0, 1.0])
    last = settled(*watch(mechanism, angles, rates, at_rest, 1.0 + 2.0 * abs(before / rate), seed),
                   seed)[-1]
    assert (last.angles[1] - 0.2 - aligned) * before < 0.0
    np.testing.assert_allclose(wrap_angles(last.angles[2] - last.angles[0]), 0.0, atol=1e-6)


@pytest.mark.medium
@pytest.mark.parametrize('seed', SEEDS)
def test_folding_at_a_change_point_is_followed(seed: int, mechanism: Mechanism) -> None:
    """Opposite torques on opposite wheels turn it onto the branch on which b stays on a."""
    end = settled(*watch(
        mechanism, np.full(4, 0.2), np.zeros(4),
        lambda t: 2e-3 * np.sin(3.0 * t) * np.array([1.0, 1.0, -1.0, -1.0]), 3.0, seed), seed)[-1]
    assert abs(end.angles[1] - end.angles[0]) < 1e-6
    assert abs(end.angles[2] - end.angles[0]) > 0.4


@pytest.mark.medium
@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('theta', [0.0, 0.002, 0.05, np.pi - 0.01])
def test_start_at_or_near_a_change_point(seed: int, theta: float, mechanism: Mechanism) -> None:
    """From measurements, while the whole rotates."""
    angles = 0.2 + theta * np.array([0.0, 1.0, 0.0, 1.0])
    settled(*watch(mechanism, angles, np.full(4, 0.3), at_rest, 2.0, seed), seed)


def test_three_sensors_determine_three_free_motions(mechanism: Mechanism) -> None:
    """At a change point three motions are free."""
    angles = 0.2 - 0.3 * np.array([0.0, 1.0, 0.0, 1.0])
    settled(*watch(mechanism, angles, 0.5 * np.array([0.0, 1.0, 0.0, 1.0]), at_rest, 1.5, 1,
                   (0, 1, 3)), 1)


def test_unconstrained_motion_has_larger_sigmas(mechanism: Mechanism) -> None:
    """With two sensors at theta = 0, the closure does not determine c and d."""
    sigmas = []
    for theta in (0.0, 0.3):
        linkage = LinkageFilter(mechanism, 0.2 + theta * np.array([0.0, 1.0, 0.0, 1.0]), 1e-2,
                                1e-2, ProcessNoise(1e-5))
        for _ in range(20):
            linkage.update((0, 1), linkage.angles[:2], NOISE ** 2)
            linkage.predict(PERIOD, np.zeros(4))
        sigmas.append(linkage.sigmas()[:4])
    assert (sigmas[0][:2] < NOISE).all() and (sigmas[1] < NOISE).all()
    assert (sigmas[0][2:] > 0.05).all()


def test_covariance_is_continuous_at_the_limit_of_the_reduced_form(mechanism: Mechanism) -> None:
    """Theta is just inside and outside the limit, where both descriptions hold."""
    sigmas = []
    for sine in (0.29, 0.31):
        theta = np.arcsin(sine)
        linkage = LinkageFilter(mechanism, 0.2 + theta * np.array([0.0, 1.0, 0.0, 1.0]), 1e-4,
                                1e-2, ProcessNoise(1e-4, 1e-4))
        for _ in range(250):
            linkage.update((0, 1, 2, 3), linkage.angles, NOISE ** 2)
            linkage.predict(PERIOD, np.zeros(4))
        sigmas.append(linkage.sigmas())
    # The mass matrix of this linkage does not depend on theta.
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=1e-3)
