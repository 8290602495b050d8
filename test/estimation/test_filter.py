# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The filter predicts the linkage, and its covariance is that of its errors."""

from dataclasses import dataclass, replace

from filterpy.kalman import ExtendedKalmanFilter
from fourbar_ros.estimation.filter import LinkageFilter
from fourbar_ros.estimation.filter_model import ProcessNoise
from fourbar_ros.estimation.filter_state import FREE, GYROS
from fourbar_ros.mechanism import assemble, Mechanism, nearest_assembly, reduced_form
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import move_held
from fourbar_ros.mechanism.state import STATE_SIZE
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]

PERIOD = 4e-3
ALL = (0, 1, 2, 3)
NOISE = 1.75e-3
DISTURBANCE = 1e-6
START_RATE = 0.05
RUNS, TICKS = 40, 150
BOUNDS = 0.95
QUIET = ProcessNoise(1e-7)


# The model

def independent_end(mechanism: Mechanism, start: Array, guess: Array, torques: Array,
                    duration: float) -> Array:
    """
    Integrate (phi_a, phi_b, omega_a, omega_b) with scipy and the reduced form, paper eq. 6.

    With tau = If (alpha + dOmega/dt) the wheels' inertia joins that of the links.
    """
    locked = replace(
        mechanism, link_inertias=mechanism.link_inertias + mechanism.flywheel_inertias)

    def derivative(_: float, x: Array) -> Array:
        angles = nearest_assembly(mechanism, (0, 1), (x[0], x[1]), guess)
        form = reduced_form(locked, angles, x[2:])
        force = -form.wheel_map @ torques - form.bias
        return np.concatenate([x[2:], np.linalg.solve(form.mass_matrix, force)])
    solution = solve_ivp(
        derivative, (0.0, duration), start, method='DOP853', rtol=1e-12, atol=1e-13)
    end: Array = solution.y[:, -1]
    return end


def set_rates(linkage: LinkageFilter, mechanism: Mechanism, rates: Array) -> None:
    """Set the rates of links a and b, and those of c and d by the closure."""
    gamma = reduced_form(mechanism, linkage.angles, rates).gamma
    linkage.x[4:8] = np.concatenate([rates, gamma @ rates])


@pytest.mark.parametrize('branch', ['open', 'crossed'])
@pytest.mark.parametrize('duration', [1e-3, 2e-2])
def test_prediction_and_transition_are_those_of_the_linkage(
    mechanism: Mechanism, branch: str, duration: float,
) -> None:
    angles = assemble(mechanism, 0.4, 1.7, branch)
    torques = np.array([3e-5, -2e-5, 1e-5, 4e-5])
    start = np.array([0.4, 1.7, 2.0, -1.5])
    linkage = LinkageFilter(mechanism, angles, 1e-6, 1e-4, ProcessNoise(0.0))
    set_rates(linkage, mechanism, start[2:])
    linkage.predict(duration, torques)
    # One step of order four. Its scale is twice the relative rate of 3.5 rad/s (products of two
    # sines) over the sine of the fold; for the short step it is the integrator's tolerance.
    model = (7.0 / abs(np.sin(angles[3] - angles[2])) * duration) ** 5 / 120.0
    end = independent_end(mechanism, start, angles, torques, duration)
    np.testing.assert_allclose(linkage.x[FREE], end, rtol=0.0, atol=max(model, 1e-11))
    # Central differences of both sides: 1e-12 of the integrator over 2e-4 here, 2e-16 over 2e-6
    # there, and a third derivative times 1e-8 / 6.
    width = 1e-4
    transition = np.empty((4, 4))
    for column in range(4):
        ends = [independent_end(mechanism, start + sign * width * np.eye(4)[column], angles,
                                torques, duration) for sign in (1.0, -1.0)]
        transition[:, column] = (ends[0] - ends[1]) / (2.0 * width)
    np.testing.assert_allclose(
        linkage.F[FREE[:, None], FREE], transition, rtol=0.0, atol=5e-8 + 10.0 * model)


def test_wheel_motion_predicts_the_plant(mechanism: Mechanism) -> None:
    """Without motor torques: the motion of the wheels determines that of the links."""
    plant = Plant(mechanism, Table(LinkSensorSettings(), WheelEncoders(0)),
                  InitialState(0.3, 1.6, 'open', 1.0, -0.5), 5e-4, np.random.default_rng(0))
    truth = plant.truth()
    linkage = LinkageFilter(mechanism, truth.link_angles, 1e-6, 1e-4, ProcessNoise(0.0))
    set_rates(linkage, mechanism, truth.link_rates[:2])
    rng = np.random.default_rng(5)
    for _ in range(50):
        before = plant.truth().wheel_speeds
        plant.advance(8, rng.uniform(-1e-4, 1e-4, 4))
        change = plant.truth().wheel_speeds - before
        linkage.predict(PERIOD, mechanism.flywheel_inertias * change / PERIOD)
    truth = plant.truth()
    # Momentum is exact at every tick. The wheels' evenness within one is not: alpha changes by
    # less than 10 rad/s^3 * 4 ms, of which If/I = 2 % counts, over 0.2 s.
    bound = 10.0 * PERIOD * 0.02 * 0.2
    np.testing.assert_allclose(linkage.rates, truth.link_rates, rtol=0.0, atol=bound)
    np.testing.assert_allclose(linkage.angles, truth.link_angles, rtol=0.0, atol=bound * 0.2)


# Consistency

@dataclass
class Consistency:
    """Errors (runs, ticks, 4), their NEES and NIS (runs, ticks), white innovations, sigmas."""

    errors: Array
    nees: Array
    nis: Array
    whitened: Array
    link_errors: Array
    sigmas: Array


def monte_carlo(mechanism: Mechanism, seed: int) -> Consistency:
    """
    Run the filter on a linkage that fulfils its assumptions exactly.

    White torques on each link, white noise on four angles, a start drawn from its covariance.
    """
    rng = np.random.default_rng(seed)
    shape = (RUNS, TICKS)
    errors, nees = np.empty((*shape, 4)), np.empty(shape)
    nis, whitened = np.empty(shape), np.empty((*shape, 4))
    link_errors, sigmas = np.empty((*shape, 8)), np.empty((*shape, 8))
    constants = mechanism.constants_with(np.ones(4, dtype=bool))
    for run in range(RUNS):
        angles = assemble(mechanism, 0.2, 1.5)
        linkage = LinkageFilter(
            mechanism, angles, NOISE ** 2, START_RATE ** 2, ProcessNoise(DISTURBANCE))
        start = linkage.x[FREE] + rng.standard_normal(4) * linkage.sigmas()[FREE]
        state = np.zeros(STATE_SIZE)
        state[:4] = nearest_assembly(mechanism, (0, 1), (start[0], start[1]), angles)
        gamma = reduced_form(mechanism, state[:4], start[2:]).gamma
        state[4:8] = np.concatenate([start[2:], gamma @ start[2:]])
        for tick in range(TICKS):
            wheels = 2e-5 * np.sin(0.1 * tick + np.arange(4))
            # White torque in two pieces per period; the filter takes it as continuous.
            for _ in range(2):
                disturbed = wheels + DISTURBANCE / np.sqrt(PERIOD / 2) * rng.standard_normal(4)
                move_held(state, disturbed, PERIOD / 2, 1, constants, NOTHING)
            linkage.predict(PERIOD, wheels)
            seen = linkage.update(
                ALL, state[:4] + NOISE * rng.standard_normal(4), NOISE ** 2)
            innovation, nis[run, tick] = seen.values, seen.nis
            whitened[run, tick] = np.linalg.solve(np.linalg.cholesky(linkage.S), innovation)
            error = linkage.x[FREE] - state[[0, 1, 4, 5]]
            errors[run, tick] = error
            nees[run, tick] = error @ np.linalg.solve(linkage.free_covariance, error)
            link_errors[run, tick] = np.concatenate(
                [linkage.angles - state[:4], linkage.rates - state[4:8]])
            sigmas[run, tick] = linkage.sigmas()[:8]
    return Consistency(errors, nees, nis, whitened, link_errors, sigmas)


@pytest.fixture(scope='module', params=['paper', 'uneven'])
def consistency(request: pytest.FixtureRequest) -> Consistency:
    """Run the Monte Carlo once per linkage, seed 11."""
    return monte_carlo(request.getfixturevalue(request.param), seed=11)


def chi_square_mean(freedom: int, count: int) -> tuple[float, float]:
    """Bound the mean of `count` chi-square numbers."""
    low, high = stats.chi2.interval(BOUNDS, freedom * count)
    return low / count, high / count


@pytest.mark.slow
def test_nis_is_chi_square_of_four(consistency: Consistency) -> None:
    low, high = chi_square_mean(4, RUNS * TICKS)
    assert low < consistency.nis.mean() < high


@pytest.mark.slow
@pytest.mark.parametrize('tick', [0, TICKS // 3, TICKS - 1])
def test_nees_is_chi_square_of_four(tick: int, consistency: Consistency) -> None:
    """Runs are independent, ticks are not: the bounds hold for one tick over all runs."""
    low, high = chi_square_mean(4, RUNS)
    assert low < consistency.nees[:, tick].mean() < high


@pytest.mark.medium
def test_estimates_are_without_bias(consistency: Consistency) -> None:
    last = consistency.errors[:, -1]
    mean = last.mean(axis=0) / (last.std(axis=0, ddof=1) / np.sqrt(RUNS))
    # Four components share the 5 %.
    assert np.abs(mean).max() < stats.t.ppf(1.0 - 0.05 / 8.0, RUNS - 1)


def test_innovations_are_white(consistency: Consistency) -> None:
    """Whitened innovations do not correlate with those of the next ten ticks, for any links."""
    white = consistency.whitened
    total = 0.0
    for lag in range(1, 11):
        later, earlier = white[:, lag:].reshape(-1, 4), white[:, :-lag].reshape(-1, 4)
        total += float(((later.T @ earlier) ** 2).sum()) / len(later)
    low, high = stats.chi2.interval(BOUNDS, 16 * 10)
    assert low < total < high


def test_sigmas_of_all_four_links_agree_with_their_errors(consistency: Consistency) -> None:
    """For c and d, which follow by closure, as well as for a and b."""
    # Eight numbers share the 5 %, hence the wider interval.
    low, high = (bound / RUNS for bound in stats.chi2.interval(1.0 - 0.05 / 8.0, RUNS))
    ratio = ((consistency.link_errors[:, -1] / consistency.sigmas[:, -1]) ** 2).mean(axis=0)
    assert (ratio > low).all()
    assert (ratio < high).all()


def test_measurements_reduce_the_sigmas(consistency: Consistency) -> None:
    angle, rate = consistency.sigmas[:, -1, :2], consistency.sigmas[:, -1, 4:6]
    assert (angle < NOISE / 2.0).all()
    assert (rate < START_RATE / 2.0).all()


# Single corrections

def test_paired_links_have_equal_sigmas(paper: Mechanism) -> None:
    linkage = LinkageFilter(paper, assemble(paper, 0.2, 1.5), 4e-6, 1e-2, QUIET)
    linkage.update((1,), linkage.angles[1:2], 1e-6)
    linkage.predict(PERIOD, np.zeros(4))
    sigmas = linkage.sigmas()[:8].reshape(2, 4)
    np.testing.assert_allclose(sigmas[:, 2:], sigmas[:, :2], rtol=1e-8)
    assert sigmas[0, 1] < 0.6 * sigmas[0, 0]


def test_sigma_follows_the_closure(uneven: Mechanism) -> None:
    """Error propagation through the closure, by finite differences of the assembly."""
    angles = assemble(uneven, 0.2, 1.5)
    linkage = LinkageFilter(uneven, angles, 4e-6, 1e-2, QUIET)
    set_rates(linkage, uneven, np.array([1.0, -2.0]))
    linkage.update((1, 2), angles[1:3], 1e-6)
    linkage.predict(PERIOD, np.zeros(4))

    def follow(x: Array) -> Array:
        found = nearest_assembly(uneven, (0, 1), (x[0], x[1]), linkage.angles)
        gamma = reduced_form(uneven, found, x[2:]).gamma
        return np.concatenate([found, x[2:], gamma @ x[2:]])
    free = linkage.x[FREE]
    slopes = np.array([(follow(free + step) - follow(free - step)) / 2e-5
                       for step in 1e-5 * np.eye(4)]).T
    expected = slopes @ linkage.free_covariance @ slopes.T
    # Differences of 1e-5: 1e-16 / 1e-5 of rounding, 1e-10 of curvature; and what the noise of one
    # step leaves at the angles that the rates of c and d have from how Gamma changes.
    np.testing.assert_allclose(linkage.sigmas()[:8], np.sqrt(expected.diagonal()), rtol=1e-7)


@pytest.mark.parametrize('turns', [-3, -1, 1, 50])
def test_turn_of_a_measurement_does_not_matter(turns: int, mechanism: Mechanism) -> None:
    angles = assemble(mechanism, 0.2, 1.5)
    measured = angles + [1e-3, -1e-3, 2e-3, 0.0]
    ends = []
    for offset in (0.0, 2.0 * np.pi * turns):
        linkage = LinkageFilter(mechanism, angles, 1e-6, 1e-4, QUIET)
        linkage.update(ALL, measured + offset, 1e-6)
        ends.append(linkage.angles)
    # 50 turns have a rounding of 6e-14.
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-12)


def test_measured_link_determines_its_paired_link(paper: Mechanism) -> None:
    """The closure determines a link without samples."""
    angles = assemble(paper, 0.2, 1.5)
    target = assemble(paper, 0.25, 1.45)
    linkage = LinkageFilter(paper, angles, 1e-2, 1e-4, QUIET)
    for _ in range(100):
        linkage.update((2, 3), target[2:], 1e-6)
    # What the prior of 0.1 rad still weighs after a hundred samples of 1 mrad: 1e-6 of 0.05 rad.
    np.testing.assert_allclose(linkage.angles, target, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize('wrong', [(0,), (1, 2), (0, 3)], ids=str)
def test_gate_rejects_outliers_only(
    wrong: tuple[int, ...], uneven: Mechanism,
) -> None:
    """The accepted samples have the effect that they have alone."""
    angles = assemble(uneven, 0.2, 1.5)
    measured = angles + [1e-3, -1e-3, 2e-3, 0.0]
    right = tuple(link for link in ALL if link not in wrong)
    gated, alone = (LinkageFilter(uneven, angles, 1e-6, 1e-4, QUIET) for _ in range(2))
    nis = alone.update(right, measured[list(right)], 1e-6).nis
    measured[list(wrong)] += 0.1
    seen = gated.update(ALL, measured, 1e-6, gate=15.0)
    assert seen.used.tolist() == [link in right for link in ALL]
    assert seen.nis == pytest.approx(nis, rel=1e-12)
    np.testing.assert_allclose(seen.values, measured - angles, rtol=1e-12)
    np.testing.assert_allclose(gated.x, alone.x, rtol=1e-14)
    np.testing.assert_allclose(gated.P, alone.P, rtol=1e-12, atol=1e-20)


def test_update_without_accepted_samples_changes_nothing(paper: Mechanism) -> None:
    angles = assemble(paper, 0.2, 1.5)
    linkage = LinkageFilter(paper, angles, 1e-6, 1e-4, QUIET)
    before = linkage.snapshot()[:3]
    seen = linkage.update(ALL, angles + 0.5, 1e-6, gate=15.0)
    assert seen.nis == 0.0 and not seen.used.any()
    for then, now in zip(before, linkage.snapshot()):
        assert then.tobytes() == now.tobytes()


def textbook_of(linkage: LinkageFilter, measurements: int) -> ExtendedKalmanFilter:
    """Return filterpy's filter in the same state."""
    textbook = ExtendedKalmanFilter(dim_x=len(linkage.x), dim_z=measurements)
    textbook.x, textbook.P = linkage.x.copy(), linkage.P.copy()
    return textbook


# Some angles; some angles with their gyros.
SEEN = [(0, 1, 2, 3), (0, 2), (3,), (1, 4, 5, 6, 7), (4, 6), (0, 1, GYROS, GYROS + 1),
        (2, 5, GYROS + 2, GYROS + 5)]


def random_linkage(rng: np.random.Generator) -> Mechanism:
    """Return a linkage that closes for any angle of 0.9 to 1.3 rad between links a and b."""
    lengths = rng.uniform(0.09, 0.12, 4)
    return Mechanism(
        lengths, rng.uniform(0.01, 0.05, 4), rng.uniform(1e-5, 5e-5, 4),
        np.column_stack([rng.uniform(0.2, 0.8, 4) * lengths, rng.uniform(-0.02, 0.02, 4)]),
        rng.uniform(2e-7, 6e-7, 4))


def test_filter_is_a_filterpy_filter(paper: Mechanism) -> None:
    """The class that is imported alone is the one that others import from filterpy."""
    linkage = LinkageFilter(paper, assemble(paper, 0.2, 1.5), 1e-4, 1e-4, QUIET)
    assert isinstance(linkage, ExtendedKalmanFilter)


@pytest.mark.medium
@pytest.mark.parametrize('sensors', SEEN, ids=str)
@pytest.mark.parametrize('kind', ['paper', 'uneven', 'random'])
@pytest.mark.parametrize('seed', range(5))
def test_compiled_steps_are_those_of_filterpy(
    sensors: tuple[int, ...], kind: str, seed: int, request: pytest.FixtureRequest,
) -> None:
    """Predict and update once, and let filterpy do the same with the same matrices."""
    rng = np.random.default_rng(seed)
    mechanism = random_linkage(rng) if kind == 'random' else request.getfixturevalue(kind)
    angle = rng.uniform(-np.pi, np.pi)
    linkage = LinkageFilter(
        mechanism, assemble(mechanism, angle, angle + rng.uniform(0.9, 1.3)), 1e-4, 1e-2,
        ProcessNoise(1e-5, 1e-5, 1e-3))
    rows = np.zeros((len(sensors), 10 + sum(sensor >= GYROS for sensor in sensors)))
    # Joints 1 to 4: b to a, c to b, d to c, a to d.
    of_links = np.vstack([np.eye(4), np.roll(np.eye(4), 1, axis=1) - np.eye(4)])
    bias = 10
    for row, sensor in zip(rows, sensors):
        if sensor < GYROS:
            row[:4] = of_links[sensor]
        else:
            row[4:8] = of_links[sensor - GYROS]
            row[bias] = 1.0
            bias += 1
    # Gated samples add the biases of the gyros to the state, and change nothing else.
    linkage.update(sensors, np.zeros(len(sensors)), 1.0, gate=0.0)
    textbook = textbook_of(linkage, len(sensors))
    prior = linkage.P.copy()
    linkage.predict(PERIOD, mechanism.flywheel_inertias * rng.normal(size=4))
    textbook.F, textbook.Q = linkage.F, linkage.Q
    textbook.predict()
    # Each element is a sum of n^2 products of three, in another order: n^2 + 3 roundings of its
    # absolute sum (Higham, Accuracy and Stability of Numerical Algorithms, 3.1), on both sides.
    size, epsilon = len(linkage.x), np.finfo(float).eps
    bound = np.abs(linkage.F) @ np.abs(prior) @ np.abs(linkage.F.T) + np.abs(linkage.Q)
    assert (np.abs(linkage.P - textbook.P) <= (size ** 2 + 3) * epsilon * bound).all()

    # From here on the same state: the kernel integrates the motion, which F only linearises.
    textbook.x, textbook.P = linkage.x.copy(), linkage.P.copy()
    predicted = rows @ linkage.x
    measured = predicted + rng.normal(scale=1e-3, size=len(sensors))
    measured[np.array(sensors) < GYROS] -= 2.0 * np.pi
    variances = rng.uniform(1e-6, 5e-6, len(sensors))
    prior_of_update = linkage.P.copy()
    textbook.update(
        measured, lambda x: rows, lambda x: predicted, R=np.diag(variances),
        residual=lambda z, h: wrap_angles(z - h))
    seen = linkage.update(sensors, measured, variances)
    assert seen.used.all()
    np.testing.assert_allclose(seen.values, textbook.y, rtol=0.0, atol=1e-14)
    # Links c and d follow a and b by more than the first order.
    free = [0, 1, 4, 5, *range(8, len(linkage.x))]
    # The inverse of S amplifies rounding by its condition. P, K and x are sums of n products, of
    # the scales of the prior covariance, of the largest gain, and of the angles of a turn.
    rounding = size ** 2 * epsilon * np.linalg.cond(linkage.S)
    gain = np.abs(textbook.K).max()
    np.testing.assert_allclose(linkage.K, textbook.K, rtol=0.0, atol=rounding * gain)
    np.testing.assert_allclose(linkage.x[free], textbook.x[free], rtol=0.0,
                               atol=rounding * (gain * 1e-2 + 2.0 * np.pi))
    variance = prior_of_update.diagonal()
    scale = np.sqrt(np.outer(variance, variance))
    assert (np.abs(linkage.P - textbook.P) <= rounding * scale).all()
    # Wrapping by a turn leaves 1e-15 rad of innovations of 1e-3 rad.
    assert seen.nis == pytest.approx(textbook.mahalanobis ** 2, rel=1e-11)
