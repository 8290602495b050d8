# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The filter follows a linkage with length errors and compliant joints.

The prototype's linkage near its change points: a length mismatch delta rotates the links of a pair
apart by about delta / (l theta), limited by the stiffness of the joints.
"""

from dataclasses import replace

from fourbar_ros.estimation import Estimate, Estimator, EstimatorSettings
from fourbar_ros.estimation.filter import LinkageFilter
from fourbar_ros.estimation.filter_model import ProcessNoise
from fourbar_ros.estimation.filter_state import GYROS, LENGTHS
from fourbar_ros.mechanism import assemble, load_mechanism, Mechanism, nearest_assembly
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import move_held
from fourbar_ros.mechanism.state import LINK_ANGLES, LINK_RATES, make_state, WHEEL_SPEEDS
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy import stats

Array = NDArray[np.float64]

PERIOD = 4e-3
PERIOD_NS = 4_000_000
NOISE = 1.7453e-3
TOLERANCE = 3e-4
SETTINGS = EstimatorSettings(
    angle_noise=NOISE, counts_per_turn=0, disturbance_torque=1e-5, disturbance_walk=1e-5,
    closure_tolerance=TOLERANCE)
LINKS = ('link_a', 'link_b', 'link_c', 'link_d')
# Bound of errors in sigmas: one of a thousand normal numbers exceeds 5 with p = 0.0006.
SIGMAS = 5.0
SEEDS = range(3)
STIFFNESS = {'joint_stiffness': np.full(4, 1e4), 'joint_damping': np.full(4, 5.0)}


@pytest.fixture(scope='module')
def rigid() -> Mechanism:
    """Load the linkage of the prototype."""
    return load_mechanism('prototype')


@pytest.fixture(scope='module')
def compliant(rigid: Mechanism) -> Mechanism:
    """Make its joints compliant."""
    return replace(rigid, **STIFFNESS)


def missing(mechanism: Mechanism, *misses: float) -> Mechanism:
    """Return a linkage with length errors [m]."""
    return replace(mechanism, link_lengths=mechanism.link_lengths + misses)


class World:
    """A linkage under prescribed torques."""

    def __init__(self, linkage: Mechanism, theta: float, rate: float, apart: float = 0.0) -> None:
        self.linkage = linkage
        angles = assemble(linkage, 0.2, 0.2 + theta)
        gamma = gamma_matrix(angles, linkage.link_lengths)
        rates = np.concatenate([[0.0, rate], gamma @ [0.0, rate]])
        # Opposite links of both pairs turn apart.
        other = np.sign(np.cos(theta))
        self.state = make_state(angles, rates + apart * np.array([-1.0, -other, 1.0, other]))

    @property
    def wheels(self) -> Array:
        """Speeds of the wheels relative to their links (4,) [rad/s]."""
        speeds: Array = self.state[WHEEL_SPEEDS] - self.state[LINK_RATES]
        return speeds

    @property
    def angles(self) -> Array:
        """Angles of the links (4,) [rad]."""
        angles: Array = self.state[LINK_ANGLES].copy()
        return angles

    @property
    def rates(self) -> Array:
        """Rates of the links (4,) [rad/s]."""
        rates: Array = self.state[LINK_RATES].copy()
        return rates

    def move(self, torques: Array) -> Array:
        """Advance by a period, and return the mean speeds of the wheels (4,) [rad/s]."""
        before = self.wheels
        move_held(self.state, torques, 5e-4, 8, self.linkage.constants, NOTHING)
        return 0.5 * (before + self.wheels)


def watch(world: World, estimator: Estimator, seconds: float, seed: int, torque: float = 0.0
          ) -> tuple[list[Estimate], Array]:
    """
    Run an estimator while the motors swing opposite links slowly apart [N m].

    :returns: its estimates, and their deviations in sigmas (ticks, 8).
    """
    rng = np.random.default_rng(seed)
    estimates, deviations = [], []
    for n in range(1, round(seconds / PERIOD) + 1):
        push = torque * np.sin(3.0 * n * PERIOD) * np.array([1.0, 1.0, -1.0, -1.0])
        wheels = world.move(push)
        stamp_ns = 10 ** 9 + n * PERIOD_NS
        estimator.measure(stamp_ns, LINKS, list(world.angles + NOISE * rng.standard_normal(4)))
        estimate = estimator.tick(stamp_ns, list(wheels))
        assert estimate is not None, f'seed {seed}'
        estimates.append(estimate)
        deviations.append(np.concatenate([
            wrap_angles(estimate.link_angles - world.angles) / estimate.angle_sigmas,
            (estimate.link_rates - world.rates) / estimate.rate_sigmas]))
    return estimates, np.array(deviations)


def settled(world: World, known: Mechanism, seconds: float, seed: int, torque: float = 0.0,
            settle: float = 0.2) -> list[Estimate]:
    """Check errors against their sigmas, NIS against noise, and that no sensor has a fault."""
    estimator = Estimator(known, SETTINGS)
    estimates, deviations = watch(world, estimator, seconds, seed, torque)
    begin = round(settle / PERIOD)
    assert np.abs(deviations[begin:]).max() < SIGMAS, f'seed {seed}'
    seen = [estimate.innovation for estimate in estimates[begin:]]
    nis = sum(innovation.nis for innovation in seen if innovation is not None)
    freedom = sum(
        innovation.degrees_of_freedom for innovation in seen if innovation is not None)
    low, high = stats.chi2.interval(0.9999, freedom)
    assert low < nis < high, f'seed {seed}'
    assert estimator.starts == 1, f'seed {seed}'
    assert estimator.sensor_faults() == {}, f'seed {seed}'
    return estimates


# Passages

@pytest.mark.slow
@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('aligned', [0.0, np.pi], ids=['0', 'pi'])
@pytest.mark.parametrize('miss', [(1e-4, 0.0, 0.0, 0.0), (0.0, -1e-4, 0.0, 0.0), (0.0,) * 4],
                         ids=['a', 'b', 'none'])
def test_slow_passage(seed: int, aligned: float, miss: tuple[float, ...], compliant: Mechanism
                      ) -> None:
    """Through the change point, until the links are apart by a degree and swing."""
    world = World(missing(compliant, *miss), aligned - 0.4, 0.2)
    settled(world, compliant, 2.7, seed, torque=5e-4)
    assert np.sin(world.angles[1] - world.angles[0] - aligned) > 0.08


@pytest.mark.slow
@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('aligned', [0.0, np.pi], ids=['0', 'pi'])
@pytest.mark.parametrize('miss', [(3e-4, 0.0, 0.0, 0.0), (0.0, -3e-4, 0.0, 0.0)], ids=['a', 'b'])
def test_turning_off_at_a_change_point(seed: int, aligned: float, miss: tuple[float, ...],
                                       compliant: Mechanism) -> None:
    """Too slow for the large mismatch: the linkage leaves towards the folded branch."""
    world = World(missing(compliant, *miss), aligned - 0.3, 0.08)
    settled(world, compliant, 4.5, seed)
    assert abs(np.sin(world.angles[2] - world.angles[0])) > 0.02


@pytest.mark.slow
@pytest.mark.parametrize('seed', SEEDS)
def test_compliant_joints_with_a_rigid_model(seed: int, rigid: Mechanism,
                                             compliant: Mechanism) -> None:
    """The force of the joints is uncertain: errors are larger, but no sensor is faulty."""
    world = World(missing(compliant, 1e-4, 0.0, 0.0, 0.0), -0.4, 0.2)
    estimator = Estimator(rigid, SETTINGS)
    estimates, _ = watch(world, estimator, 2.7, seed)
    assert estimator.starts == 1, f'seed {seed}'
    assert estimator.sensor_faults() == {}, f'seed {seed}'
    # The error is at most that of a few samples.
    errors = wrap_angles(estimates[-1].link_angles - world.angles)
    assert np.abs(errors).max() < 2.0 * NOISE, f'seed {seed}'


@pytest.mark.medium
@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize(('theta', 'rate', 'seconds'), [(-0.4, 0.2, 4.0), (-0.06, 0.02, 6.0)])
def test_rigid_joints(seed: int, theta: float, rate: float, seconds: float, rigid: Mechanism
                      ) -> None:
    """Exact lengths with a tolerance: joints count as stiff as the filter can follow."""
    world = World(rigid, theta, rate)
    settled(world, rigid, seconds, seed)
    assert world.angles[1] > world.angles[0]


@pytest.mark.slow
@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('theta', [-0.3, -0.1, 0.02, np.pi - 0.2])
@pytest.mark.parametrize('miss', [0.0, 3e-4])
def test_start_near_a_change_point(seed: int, theta: float, miss: float, compliant: Mechanism
                                   ) -> None:
    """All four rates are unknown, and the links of a pair may rotate against each other."""
    # The joints are open at rest if the loop cannot close.
    world = World(missing(compliant, 0.0, -miss if theta > 0.0 else miss, 0.0, 0.0), theta, 0.05)
    settled(world, compliant, 0.6, seed, settle=0.02)


# What is known of lengths

@pytest.mark.slow
@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize(('miss', 'delta'), [
    ((3e-4, 0.0, 0.0, 0.0), -3e-4), ((0.0, 3e-4, 0.0, 0.0), 3e-4),
    ((2e-4, 0.0, 0.0, -1e-4), -1e-4)])
def test_length_mismatch_is_estimated_before_a_change_point(
    seed: int, miss: tuple[float, ...], delta: float, compliant: Mechanism,
) -> None:
    """The mismatch at theta = 0; it does not matter which link causes it."""
    rng = np.random.default_rng(seed)
    world = World(missing(compliant, *miss), -0.5, 0.2)
    linkage = LinkageFilter(compliant, world.angles, 0.01, 1.0, SETTINGS.process_noise)
    for _ in range(500):
        linkage.update((0, 1, 2, 3), world.angles + NOISE * rng.standard_normal(4), NOISE ** 2)
        before = world.wheels
        world.move(np.zeros(4))
        linkage.predict(PERIOD, compliant.flywheel_inertias * (world.wheels - before) / PERIOD)
    adds = np.array([-1.0, 1.0, 1.0, -1.0])
    sigma = np.sqrt(adds[1:] @ linkage.P[LENGTHS, LENGTHS] @ adds[1:])
    error = adds @ (linkage.lengths - compliant.link_lengths) - delta
    assert abs(error) < SIGMAS * sigma, f'seed {seed}'
    assert sigma < 0.1 * TOLERANCE


@pytest.mark.medium
def test_wrong_lengths_leave_no_error_away_from_change_points(rigid: Mechanism) -> None:
    """Without tolerance the errors of links c and d are many sigmas."""
    far = []
    for tolerance in (TOLERANCE, 0.0):
        world = World(missing(rigid, 3e-4, -3e-4, 0.0, 0.0), 0.6, 0.1)
        estimator = Estimator(rigid, replace(SETTINGS, closure_tolerance=tolerance))
        _, deviations = watch(world, estimator, 3.0, 0)
        far.append(np.abs(deviations[250:]).max())
    assert far[0] < SIGMAS < far[1]


def test_sensor_bias_is_isolated_with_uncertain_lengths(compliant: Mechanism) -> None:
    """0.6 deg: length errors of 1e-3 explain 0.1 deg only."""
    rng = np.random.default_rng(4)
    world = World(compliant, 1.0, 0.0)
    estimator = Estimator(compliant, SETTINGS)
    for n in range(1, 501):
        wheels = world.move(np.zeros(4))
        measured = world.angles + NOISE * rng.standard_normal(4)
        measured[1] += np.radians(0.6) * (n > 250)
        estimator.measure(n * PERIOD_NS, LINKS, list(measured))
        estimator.tick(n * PERIOD_NS, list(wheels))
    assert list(estimator.sensor_faults()) == ['link_b']


# The model

@pytest.mark.parametrize('aligned', [0.0, np.pi], ids=['0', 'pi'])
@pytest.mark.parametrize('theta', [0.1, 0.2])
@pytest.mark.parametrize('changed', [
    {}, {'joint_stiffness': [1e4, 2e4, 1e4, 3e4]}, {'link_masses': [0.6, 0.9, 0.6, 0.5]},
    {'com_positions': [[0.1, 0.0], [0.15, 0.0], [0.2, 0.0], [0.12, 0.0]]}],
    ids=['even', 'joints', 'masses', 'centres'])
def test_links_swing_as_those_of_the_plant(
    theta: float, aligned: float, changed: dict[str, Array], compliant: Mechanism,
) -> None:
    """Compare positions half a second after an exact initial state."""
    linkage = replace(compliant, **changed)
    world = World(missing(linkage, 1e-4, 0.0, 0.0, 0.0), aligned + theta, 0.05, apart=0.05)
    filtered = LinkageFilter(
        linkage, world.angles, 1e-8, 1e-8, ProcessNoise(0.0, closure_tolerance=TOLERANCE))
    filtered.x[LENGTHS] -= 1e-4
    filtered.x[4:8] = world.rates
    apart, errors = [], []
    for _ in range(125):
        before = world.wheels
        world.move(np.zeros(4))
        filtered.predict(PERIOD, linkage.flywheel_inertias * (world.wheels - before) / PERIOD)
        apart.append(world.angles[2] - world.angles[0])
        errors.append(wrap_angles(filtered.angles - world.angles))
    # Joints oscillate at 155 rad/s, paired links at up to 40 rad/s. The neglected terms are of
    # order four in the ratio, 0.004 of the squared frequency, which is 0.04 rad of 20 rad in half
    # a second.
    assert np.abs(errors).max() < 0.04 * 0.5 * np.ptp(apart)


def test_transition_is_that_of_the_prediction(compliant: Mechanism) -> None:
    """Off its equilibrium, along motions and lengths that keep the gap across the line closed."""
    linkage = LinkageFilter(
        compliant, np.array([0.2, 0.3, 0.2, 0.3]), 1e-6, 1e-4, ProcessNoise(1e-5, 1e-5, 0.0, 3e-4))
    # Apart by 2 mrad.
    linkage.x[:4] += 1e-3 * np.array([-1.0, -1.0, 1.0, 1.0])
    linkage.update((0,), linkage.angles[:1], 1.0)
    start = linkage.snapshot()

    def end(change: Array) -> Array:
        linkage.restore(start)
        linkage.x += change
        linkage.predict(PERIOD, np.zeros(4))
        return linkage.x.copy()
    end(np.zeros(13))
    transition = linkage.F.copy()
    turned = 0.5 * np.array([[-1, -1, 1, 1], [-1, 1, -1, 1], [1, 1, 1, 1]])
    for mode in turned:
        for first in (0, 4):
            change = np.zeros(13)
            change[first:first + 4] = mode
            slope = (end(1e-5 * change) - end(-1e-5 * change)) / 2e-5
            # How the mass matrix changes with the angles is left out: 1 % of what the spring does,
            # which gives 1.5 rad/s per rad. Projections are along a line that turns by 1 mrad.
            np.testing.assert_allclose(slope, transition @ change, rtol=0.0, atol=2e-2)
            np.testing.assert_allclose(slope[:4], (transition @ change)[:4], rtol=0.0, atol=1e-3)
    # Torques, where there are lengths to pull at: 60 rad/s per m.
    change = np.zeros(13)
    change[[10, 11, 12]] = 1.0, 1.0, -1.0
    slope = (end(1e-6 * change) - end(-1e-6 * change)) / 2e-6
    np.testing.assert_allclose(slope[4:8], (transition @ change)[4:8], rtol=0.02)


def test_links_follow_the_lengths_away_from_change_points(uneven: Mechanism) -> None:
    """By finite differences of the assembly, of the transition and of the covariance."""
    linkage = LinkageFilter(uneven, assemble(uneven, 0.2, 1.5), 1e-12, 1e-12,
                            ProcessNoise(0.0, closure_tolerance=1e-4))
    # At rest, so that nothing but the lengths changes.
    linkage.predict(PERIOD, np.zeros(4))
    slopes = np.zeros((2, 3))
    for n in range(3):
        for sign in (1.0, -1.0):
            change = np.zeros(4)
            change[1 + n] = sign * 1e-6
            other = replace(uneven, link_lengths=uneven.link_lengths + change)
            angles = nearest_assembly(other, (0, 1), (0.2, 1.5), linkage.angles)
            slopes[:, n] += sign * angles[2:] / 2e-6
    # Differences of 1e-6 m: rounding of 1e-16 / 1e-6, curvature of 1e-12 / length^2.
    np.testing.assert_allclose(linkage.F[2:4, LENGTHS], slopes, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(
        linkage.P[2:4, 2:4], slopes @ linkage.P[LENGTHS, LENGTHS] @ slopes.T, rtol=1e-4)


def test_initial_closure_error_is_the_tolerance(uneven: Mechanism) -> None:
    """The standard deviation of the gap around the loop is the setting."""
    linkage = LinkageFilter(uneven, assemble(uneven, 0.2, 1.5), 1e-6, 1e-6,
                            ProcessNoise(0.0, closure_tolerance=1e-3))
    signed = np.array([[np.cos(angle), np.sin(angle)] for angle in linkage.angles]).T * [
        -1.0, 1.0, 1.0, -1.0]
    covariance = linkage.P[LENGTHS, LENGTHS]
    gap = np.trace(signed[:, 1:] @ covariance @ signed[:, 1:].T)
    # Errors of 0.5e-3 in each link; that of a counts as one of scale, which closes.
    np.testing.assert_allclose(np.sqrt(gap), 1e-3, rtol=1e-9)


def test_gyro_biases_follow_the_lengths_in_the_state(compliant: Mechanism) -> None:
    rng = np.random.default_rng(6)
    angles = assemble(compliant, 0.2, 1.3)
    linkage = LinkageFilter(compliant, angles, 1e-4, 1e-4, SETTINGS.process_noise)
    for _ in range(1000):
        noise = rng.standard_normal(5)
        linkage.update(
            (0, 1, 2, 3, GYROS + 1), np.append(angles + NOISE * noise[:4], 0.02 + 1e-3 * noise[4]),
            [NOISE ** 2] * 4 + [1e-6])
        linkage.predict(PERIOD, np.zeros(4))
    np.testing.assert_allclose(list(linkage.gyro_biases.values()), [0.02], rtol=0.0,
                               atol=SIGMAS * linkage.sigmas()[-1])
    assert len(linkage.x) == 14


# Without tolerance

def test_exact_lengths_are_not_estimated(rigid: Mechanism, compliant: Mechanism) -> None:
    """The stiffness of the joints has no effect: equal to the last bit."""
    ends = []
    for mechanism in (rigid, compliant):
        rng = np.random.default_rng(7)
        linkage = LinkageFilter(mechanism, np.array([0.2, 0.3, 0.2, 0.3]), 1e-4, 1e-2,
                                ProcessNoise(1e-5, 1e-5))
        for _ in range(50):
            linkage.update((0, 1, 2, 3), linkage.angles + NOISE * rng.standard_normal(4),
                           NOISE ** 2)
            linkage.predict(PERIOD, 1e-3 * rng.standard_normal(4))
        np.testing.assert_array_equal(linkage.lengths, rigid.link_lengths)
        ends.append(np.concatenate([linkage.x, linkage.P.ravel()]).tobytes())
    assert ends[0] == ends[1]
    assert len(linkage.x) == 10
