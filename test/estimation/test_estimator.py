# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The estimator follows the linkage under late, lost, wrong and missing inputs."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import combinations
from math import inf, nan, pi
from typing import Any

from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.estimation import Estimate, Estimator, EstimatorSettings, SAMPLE_STATUSES
from fourbar_ros.mechanism import assemble, branch_of, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.forces import surroundings
from fourbar_ros.mechanism.integration import move_held
from fourbar_ros.mechanism.state import LINK_ANGLES, LINK_RATES, make_state, WHEEL_SPEEDS
from fourbar_ros.plant import Fault, InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

PERIOD_NS = 4_000_000
FIRST_NS = 1_000_000_000
NOISE = 1.7453e-3
REAL = Table(LinkSensorSettings(noise_rms=NOISE, counts_per_turn=16384), WheelEncoders(16384))
PERFECT = Table(LinkSensorSettings(), WheelEncoders(0))
STILL = [0.0] * 4
# Bound of errors in sigmas: one of 4000 normal numbers exceeds 5 with p = 0.002.
SIGMAS = 5.0


class Run:
    """A plant and an estimator of its motion, tick by tick."""

    def __init__(self, mechanism: Mechanism, initial: InitialState, table: Table = REAL,
                 seed: int = 0) -> None:
        self.plant = Plant(mechanism, table, initial, 5e-4, np.random.default_rng(seed))
        self.estimator = Estimator(mechanism, EstimatorSettings())
        self.stamp_ns = FIRST_NS

    def tick(self, sensors: tuple[int, ...] | None = None, torques: Array | None = None,
             offsets: Array | None = None) -> Estimate | None:
        """Advance by a period, measure with some or all sensors with offsets, and estimate."""
        before = self.plant.sense_wheels()
        self.plant.advance(8, np.zeros(4) if torques is None else torques)
        speeds = (self.plant.sense_wheels() - before) / 4e-3
        self.stamp_ns += PERIOD_NS
        names = self.plant.link_sensors.names
        chosen = range(len(names)) if sensors is None else sensors
        if chosen:
            self.plant.measure_links(self.stamp_ns)
            reading, = self.plant.link_sensors.due(self.stamp_ns)
            self.estimator.measure(
                self.stamp_ns, [names[sensor] for sensor in chosen],
                list((reading.angles + (0.0 if offsets is None else offsets))[list(chosen)]),
                list(reading.rates))
        return self.estimator.tick(self.stamp_ns, list(speeds))

    def ticks(self, count: int, *args: Any) -> Iterator[Estimate]:
        """Advance by some ticks, and check that all give an estimate."""
        for _ in range(count):
            estimate = self.tick(*args)
            assert estimate is not None
            yield estimate

    def after(self, count: int) -> Estimate:
        """Return the last estimate of some ticks."""
        return list(self.ticks(count))[-1]

    def error(self, estimate: Estimate) -> Array:
        """Return estimate minus truth of angles and rates (8,)."""
        truth = self.plant.truth()
        return np.concatenate([estimate.link_angles - truth.link_angles,
                               estimate.link_rates - truth.link_rates])

    def unwrapped_error(self, estimate: Estimate) -> Array:
        """Return the error of the angles (4,), relative to the turn of the start."""
        error = self.error(estimate)[:4]
        return error - 2.0 * pi * np.round(error / (2.0 * pi))


# Tracking the linkage

@pytest.mark.medium
@pytest.mark.parametrize('branch', ['open', 'crossed'])
def test_errors_settle_within_their_sigmas(mechanism: Mechanism, branch: str) -> None:
    run = Run(mechanism, InitialState(0.3, 1.6, branch, 0.5, -0.3))
    run.after(250)
    for estimate in run.ticks(250):
        assert (np.abs(run.unwrapped_error(estimate)) < SIGMAS * estimate.angle_sigmas).all()
    # By the model and samples at 250 Hz the error is far smaller than that of one sample.
    assert estimate.angle_sigmas[:2].max() < NOISE / 3.0
    assert np.abs(run.error(estimate)[4:]).max() < 0.02


@pytest.mark.medium
@pytest.mark.parametrize('direction', [1.0, -1.0])
def test_estimate_is_continuous_over_many_turns(mechanism: Mechanism, direction: float) -> None:
    """The whole spins at 12 rad/s: every link passes the cut at pi eleven times in 6 s."""
    rate = 12.0 * direction
    run = Run(mechanism, InitialState(3.0, 4.2, 'open', rate, rate))
    angles, errors = [], []
    for estimate in run.ticks(1500):
        angles.append(estimate.link_angles)
        errors.append(estimate.link_angles - run.plant.truth().link_angles)
    assert np.abs(np.ptp(angles, axis=0)).min() > 11 * 2.0 * pi
    # After one second the initial rate is known, and the number of turns is constant.
    settled = np.array(errors[250:])
    turns = np.round(settled[0] / (2.0 * pi))
    assert np.abs(settled - 2.0 * pi * turns).max() < SIGMAS * NOISE


def joint_encoders(heading: str) -> Table:
    """Make a table with encoders in the joints, and one absolute sensor."""
    return replace(REAL, link_sensors=replace(
        REAL.link_sensors, kind='joint', heading=heading))


@pytest.mark.slow
@pytest.mark.parametrize('heading', LINK_NAMES)
def test_joint_encoders_and_a_heading_are_as_accurate(heading: str, mechanism: Mechanism) -> None:
    """Errors settle within their sigmas, for an absolute sensor on any link."""
    run = Run(mechanism, InitialState(0.3, 1.6, 'open', 0.5, -0.3), joint_encoders(heading))
    assert len(run.after(250).innovation.sensors) == 5
    for estimate in run.ticks(250):
        assert (np.abs(run.unwrapped_error(estimate)) < SIGMAS * estimate.angle_sigmas).all()
    assert (estimate.angle_sigmas < NOISE / 2.0).all()


@pytest.mark.parametrize('branch', ['open', 'crossed'])
@pytest.mark.parametrize('left_out', range(4))
def test_start_needs_three_joint_encoders_beside_the_heading(
    branch: str, left_out: int, uneven: Mechanism,
) -> None:
    """The angles around the loop follow in both senses, and determine the branch."""
    run = Run(uneven, InitialState(3.0, 4.4, branch), joint_encoders('link_c'))
    estimate = run.tick(tuple(sensor for sensor in range(5) if sensor != left_out))
    assert estimate is not None
    assert branch_of(estimate.link_angles) == branch
    assert (np.abs(run.unwrapped_error(estimate)) < SIGMAS * estimate.angle_sigmas).all()


def test_joint_encoders_alone_do_not_start_the_filter(paper: Mechanism) -> None:
    """Joint encoders do not measure the orientation of the whole."""
    run = Run(paper, InitialState(0.3, 1.6), joint_encoders('link_a'))
    assert run.tick((0, 1, 2, 3)) is None
    assert 'link_a' in run.estimator.waiting_for
    assert run.tick() is not None


@pytest.mark.medium
@pytest.mark.parametrize(
    'links', [links for n in (1, 2, 3) for links in combinations(range(4), n)])
def test_any_subset_of_links_updates_the_filter(links: tuple[int, ...], uneven: Mechanism) -> None:
    """After a start from all four links, one link alone corrects the estimate."""
    run = Run(uneven, InitialState(0.3, 1.6, 'open', 0.2, -0.1))
    run.after(100)
    for estimate in run.ticks(100, links):
        assert estimate.innovation is not None
        assert estimate.innovation.sensors == links
        assert estimate.innovation.values.shape == (len(links),)
        assert np.abs(run.unwrapped_error(estimate)).max() < SIGMAS * max(estimate.angle_sigmas)


def test_without_samples_wheels_alone_drive_the_prediction(mechanism: Mechanism) -> None:
    """The sensors are silent for 0.2 s, and the motors give torque."""
    run = Run(mechanism, InitialState(0.3, 1.6, 'open', 0.2, -0.1))
    estimate = run.after(250)
    rate_error = np.abs(run.error(estimate)[4:]).max()
    before = np.abs(run.unwrapped_error(estimate)).max()
    sigmas = estimate.angle_sigmas
    for n in range(50):
        (estimate,) = run.ticks(1, (), 5e-5 * np.sin(0.2 * n + np.arange(4)))
        assert estimate.innovation is None
    # The error of the rate is constant, one count of the encoders is If/I = 1 % of 0.1 rad/s, and
    # Gamma amplifies both by at most three.
    growth = 3.0 * (rate_error + 0.01 * 0.1) * 0.2
    assert np.abs(run.unwrapped_error(estimate)).max() < 3.0 * before + growth
    assert (estimate.angle_sigmas > sigmas).all()


@pytest.mark.parametrize('theta_rate', [0.8, -0.8])
def test_motion_through_a_change_point(theta_rate: float, paper: Mechanism) -> None:
    """The rhombus passes theta = 0 (or pi) on its branch: no NaN, and no jump."""
    start = 0.4 if theta_rate < 0.0 else pi - 0.4
    run = Run(paper, InitialState(0.0, start, 'open', 0.0, theta_rate))
    for estimate in run.ticks(250):
        values = [estimate.link_angles, estimate.link_rates, estimate.angle_sigmas,
                  estimate.rate_sigmas]
        assert np.isfinite(values).all()
        assert np.abs(run.unwrapped_error(estimate)).max() < SIGMAS * NOISE
    theta = estimate.link_angles[1] - estimate.link_angles[0]
    assert theta < -0.3 if theta_rate < 0.0 else theta > pi + 0.3
    assert run.estimator.starts == 1


# Starting

def angles_of(mechanism: Mechanism, branch: str) -> Array:
    return assemble(mechanism, 0.3, 1.6, branch)


def names_of(*links: int) -> list[str]:
    return [LINK_NAMES[link] for link in links]


@pytest.mark.parametrize('branch', ['open', 'crossed'])
@pytest.mark.parametrize('missing', range(4))
def test_three_links_determine_the_branch(mechanism: Mechanism, branch: str, missing: int) -> None:
    angles = angles_of(mechanism, branch)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        estimator = Estimator(mechanism, EstimatorSettings())
        links = rng.permutation([link for link in range(4) if link != missing])
        measured = angles[links] + NOISE * rng.standard_normal(3)
        estimator.measure(FIRST_NS, names_of(*links), list(measured))
        estimate = estimator.tick(FIRST_NS, STILL)
        assert estimate is not None, f'seed {seed}'
        wrapped = np.angle(np.exp(1j * (estimate.link_angles - angles)))
        # Gamma of these linkages is at most 2; four numbers of twenty seeds are within 4 sigma.
        assert np.abs(wrapped).max() < 4.0 * 3.0 * NOISE, f'seed {seed}'


def test_links_measured_one_after_the_other_start_the_filter(mechanism: Mechanism) -> None:
    """Each link has its own stamp, as on a bus, and no single link suffices."""
    angles = angles_of(mechanism, 'open')
    for seed in range(20):
        rng = np.random.default_rng(seed)
        estimator = Estimator(mechanism, EstimatorSettings())
        for count, link in enumerate(rng.permutation(4)[:3], 1):
            estimator.measure(FIRST_NS - 4_000_000 + count * 1_000_000, names_of(link),
                              [angles[link] + NOISE * rng.standard_normal()])
        estimate = estimator.tick(FIRST_NS, STILL)
        assert estimate is not None, f'seed {seed}'
        wrapped = np.angle(np.exp(1j * (estimate.link_angles - angles)))
        assert np.abs(wrapped).max() < 4.0 * 3.0 * NOISE, f'seed {seed}'


def test_links_measured_long_after_each_other_do_not_start_it(paper: Mechanism) -> None:
    estimator = Estimator(paper, EstimatorSettings())
    angles = angles_of(paper, 'open')
    for count, link in enumerate((0, 1, 3)):
        estimator.measure(FIRST_NS + count * 30_000_000, names_of(link), [angles[link]])
    assert estimator.tick(FIRST_NS + 60_000_000, STILL) is None


@pytest.mark.parametrize('links', [(0,), (0, 1), (0, 2), (1, 3), (2, 3)])
def test_fewer_links_do_not_start_the_filter(links: tuple[int, ...], paper: Mechanism) -> None:
    estimator = Estimator(paper, EstimatorSettings())
    assert estimator.waiting_for == 'flywheel_states'
    estimator.measure(FIRST_NS, names_of(*links), list(angles_of(paper, 'open')[list(links)]))
    assert estimator.tick(FIRST_NS, STILL) is None
    assert 'three of the four links' in estimator.waiting_for
    assert estimator.starts == 0


def test_inconsistent_angles_do_not_start_the_filter(uneven: Mechanism) -> None:
    long = Mechanism(  # type: ignore[arg-type]
        [0.3, 0.3, 0.2, 0.2], [0.02] * 4, [2e-5] * 4, [[0.05, 0.0]] * 4, [3e-7] * 4)
    estimator = Estimator(long, EstimatorSettings())
    estimator.measure(FIRST_NS, list(LINK_NAMES), [0.0, 3.0, 0.0, 3.0])
    assert estimator.tick(FIRST_NS, STILL) is None
    assert estimator.starts == 0
    assert 'link_b = 3' in estimator.waiting_for


def test_waiting_ends_with_a_good_sample(paper: Mechanism) -> None:
    run = Run(paper, InitialState())
    assert run.tick((0, 1)) is None
    assert run.tick() is not None
    assert run.estimator.waiting_for == ''
    assert run.estimator.starts == 1


# Rejections

@contextmanager
def rejected(kind: str) -> Iterator[pytest.ExceptionInfo[RejectedError]]:
    """Expect a rejection of a kind."""
    with pytest.raises(RejectedError) as caught:
        yield caught
    assert caught.value.kind == kind


@pytest.fixture
def running(paper: Mechanism) -> Run:
    """Make an estimator that has run for ten ticks."""
    run = Run(paper, InitialState(), PERFECT)
    run.after(10)
    return run


@pytest.mark.parametrize(('kind', 'names', 'angles'), [
    ('names', ['link_e'], [0.0]),
    ('names', ['link_a', 'flywheel_a'], [0.0, 0.0]),
    ('names', ['link_a', 'link_a'], [0.0, 0.0]),
    ('length', [], []),
    ('length', ['link_a', 'link_b'], [0.0]),
    ('length', ['link_a'], []),
    ('finite', ['link_a', 'link_b'], [0.0, nan]),
    ('finite', ['link_c'], [inf]),
])
def test_unusable_sample_is_rejected_whole_and_counted(
    kind: str, names: list[str], angles: list[float], running: Run,
) -> None:
    with rejected(kind) as caught:
        running.estimator.measure(running.stamp_ns + PERIOD_NS, names, angles)
    assert running.estimator.rejected == Counter({kind: 1})
    assert running.estimator.last_rejection == str(caught.value)
    # No part of the message was kept, so the sample of the tick is accepted.
    (estimate,) = running.ticks(1)
    assert np.abs(running.error(estimate)).max() < 1e-6


def test_repeated_sample_is_rejected(running: Run) -> None:
    stamp = running.stamp_ns + PERIOD_NS
    running.estimator.measure(stamp, ['link_a', 'link_b'], [0.0, 1.0])
    for names in (['link_a'], ['link_b', 'link_c']):
        with rejected('repeated'):
            running.estimator.measure(stamp, names, [0.0] * len(names))
    running.estimator.measure(stamp, ['link_c'], [0.0])
    assert running.estimator.rejected == Counter(repeated=2)


@pytest.mark.parametrize('age_ms', [101, 500, 999])
def test_late_sample_is_rejected(age_ms: int, running: Run) -> None:
    with rejected('late'):
        running.estimator.measure(running.stamp_ns - age_ms * 1_000_000, ['link_a'], [0.5])
    assert running.estimator.rejected == Counter(late=1)


@pytest.mark.parametrize('age_s', [2, 3600])
def test_very_late_sample_is_not_taken_as_new(age_s: int, running: Run) -> None:
    """The sample is as old as after a restart of time, but the ticks continue."""
    try:
        running.estimator.measure(
            running.stamp_ns - age_s * 1_000_000_000, list(LINK_NAMES), [0.5, 1.5, 0.5, 1.5])
    except RejectedError:
        pass
    (estimate,) = running.ticks(1)
    assert np.abs(running.error(estimate)).max() < 1e-6


def test_sample_of_the_last_tick_is_used_at_the_next(running: Run) -> None:
    (estimate,) = running.ticks(1, ())
    assert estimate.innovation is None
    running.estimator.measure(
        running.stamp_ns, list(LINK_NAMES), list(running.plant.truth().link_angles))
    (estimate,) = running.ticks(1, ())
    assert estimate.innovation is not None


@pytest.mark.parametrize('speeds', [[0.0] * 3, [0.0] * 5, [0.0, nan, 0.0, 0.0],
                                    [inf, 0.0, 0.0, 0.0]])
def test_unusable_wheel_speeds_are_rejected(speeds: list[float], running: Run) -> None:
    with rejected('wheels'):
        running.estimator.tick(running.stamp_ns + PERIOD_NS, speeds)
    assert running.estimator.rejected == Counter(wheels=1)
    (estimate,) = running.ticks(1)
    assert np.abs(running.error(estimate)).max() < 1e-6


@pytest.mark.parametrize('behind_ns', [0, 1, PERIOD_NS])
def test_tick_not_newer_than_the_last_is_rejected(behind_ns: int, running: Run) -> None:
    with rejected('stamp'):
        running.estimator.tick(running.stamp_ns - behind_ns, STILL)
    assert running.estimator.starts == 1


# Restarts

@pytest.mark.parametrize('jump_ns', [-5_000_000_000, 1_100_000_000, 3600 * 10 ** 9])
def test_jump_of_time_begins_a_new_run(jump_ns: int, paper: Mechanism) -> None:
    """Time decreases or has a gap, and the configuration is another one."""
    run = Run(paper, InitialState(), PERFECT)
    run.stamp_ns += 10_000_000_000
    run.after(10)
    angles = assemble(paper, 2.0, 3.0)
    stamp = run.stamp_ns + jump_ns
    run.estimator.measure(stamp, list(LINK_NAMES), list(angles))
    estimate = run.estimator.tick(stamp, STILL)
    assert estimate is not None
    assert run.estimator.starts == 2
    np.testing.assert_allclose(np.exp(1j * estimate.link_angles), np.exp(1j * angles), atol=1e-9)
    assert not estimate.link_rates.any()


def test_new_run_forgets_the_sensors_of_the_last(paper: Mechanism) -> None:
    """Time decreases, and one sensor is missing afterwards."""
    run = Run(paper, InitialState())
    run.stamp_ns += 10_000_000_000
    run.after(10)
    run.stamp_ns -= 5_000_000_000
    run.plant.link_sensors.reset()
    run.tick((0, 1, 3))
    for _ in run.ticks(100, (0, 1, 3)):
        assert run.estimator.sensor_faults() == {}


def test_gap_of_less_than_a_second_is_bridged(paper: Mechanism) -> None:
    run = Run(paper, InitialState(), PERFECT)
    run.after(10)
    run.stamp_ns += 900_000_000
    assert run.tick() is not None
    assert run.estimator.starts == 1


def test_reset_starts_again_on_the_same_turn(paper: Mechanism) -> None:
    run = Run(paper, InitialState(0.0, 1.0, 'open', 6.0, 6.0), PERFECT)
    before = run.after(600)
    run.estimator.reset()
    assert run.tick(()) is None
    assert run.estimator.waiting_for
    after = run.tick()
    assert after is not None
    assert run.estimator.starts == 2
    # Two periods at 6 rad/s.
    assert np.abs(after.link_angles - before.link_angles - 0.048).max() < 1e-3
    # Samples from before the reset have no effect, so the rates are unknown.
    assert after.rate_sigmas.min() > 1.0


def test_reset_before_the_first_tick_has_no_effect(paper: Mechanism) -> None:
    run = Run(paper, InitialState())
    run.estimator.reset()
    assert run.tick() is not None


def test_covariance_agrees_with_the_sigmas(paper: Mechanism) -> None:
    estimate = Run(paper, InitialState()).after(50)
    np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance)), [
        *estimate.angle_sigmas[:2], *estimate.rate_sigmas[:2]], rtol=1e-12)
    np.testing.assert_allclose(estimate.covariance, estimate.covariance.T, rtol=1e-12)


@pytest.mark.parametrize('jump', [0.5, -2.0, 3.0])
def test_lost_filter_recovers(jump: float, paper: Mechanism) -> None:
    """The linkage is lifted and put back rotated: the filter recovers within 20 samples."""
    run = Run(paper, InitialState())
    run.after(250)
    elsewhere = Run(paper, InitialState(jump, jump + 1.5), seed=1)
    elsewhere.estimator, elsewhere.stamp_ns = run.estimator, run.stamp_ns
    elsewhere.after(20)
    for estimate in elsewhere.ticks(250):
        assert np.abs(elsewhere.unwrapped_error(estimate)).max() < SIGMAS * NOISE
    assert run.estimator.starts <= 2


@pytest.mark.medium
def test_noise_alone_does_not_restart_the_filter(paper: Mechanism) -> None:
    run = Run(paper, InitialState(0.0, 1.0, 'open', 0.3, 0.1), seed=4)
    run.after(2000)
    assert run.estimator.starts == 1
    assert not run.estimator.rejected


# The gate

def measured_with(run: Run, offsets: Array) -> Estimate:
    """Advance by a period with offsets of the four sensors [rad]."""
    estimate = run.tick(offsets=offsets)
    assert estimate is not None and estimate.innovation is not None
    return estimate


@pytest.mark.medium
@pytest.mark.parametrize('sensor', range(4))
@pytest.mark.parametrize('offset', [0.05, -0.5, 3.0])
def test_wrong_sensor_is_gated_until_it_agrees_again(
    sensor: int, offset: float, mechanism: Mechanism,
) -> None:
    run = Run(mechanism, InitialState(0.3, 1.6, 'open', 0.5, -0.3))
    run.after(250)
    gated = dict(run.estimator.gated)
    for _ in range(100):
        estimate = measured_with(run, offset * np.eye(4)[sensor])
        assert estimate.innovation.used.tolist() == [link != sensor for link in range(4)]
        assert estimate.innovation.degrees_of_freedom == 3
        assert (np.abs(run.unwrapped_error(estimate)) < SIGMAS * estimate.angle_sigmas).all()
    assert run.estimator.gated[LINK_NAMES[sensor]] == gated.get(LINK_NAMES[sensor], 0) + 100
    assert run.estimator.sensor_faults() == {LINK_NAMES[sensor]: 'samples far off'}
    for estimate in run.ticks(100):
        assert estimate.innovation.used[sensor]
    assert run.estimator.sensor_faults() == {}
    assert run.estimator.starts == 1


@pytest.mark.medium
def test_gate_rejects_the_fraction_of_its_probability(paper: Mechanism) -> None:
    """The gate rejects one of a hundred healthy samples, and reports no fault; seed 2."""
    run = Run(paper, InitialState(0.3, 1.6, 'open', 0.5, -0.3), seed=2)
    run.estimator = Estimator(paper, EstimatorSettings(
        angle_noise=NOISE, disturbance_torque=1e-7, gate_probability=0.99))
    run.after(250)
    before = run.estimator.gated.total()
    for _ in run.ticks(2000):
        assert run.estimator.sensor_faults() == {}
    # Counts of 8000 samples, nearly independent: 4 standard deviations of sqrt(80).
    assert abs(run.estimator.gated.total() - before - 80) < 36


@pytest.mark.slow
@pytest.mark.parametrize('sensor', range(4))
def test_stuck_sensor_is_reported_at_once_and_excluded(sensor: int, mechanism: Mechanism) -> None:
    """Also at rest, where its frozen sample fits better than any other."""
    run = Run(mechanism, InitialState(0.3, 1.6))
    run.after(250)
    run.plant.link_sensors.set_faults({LINK_NAMES[sensor]: Fault(LINK_NAMES[sensor], 'stuck')})
    run.after(48)
    # A sensor frozen at a large error may be reported earlier for that error.
    assert 'repeats one value' not in run.estimator.sensor_faults().values()
    estimate = run.after(1)
    assert run.estimator.sensor_faults() == {LINK_NAMES[sensor]: 'repeats one value'}
    assert estimate.innovation is not None
    assert estimate.innovation.sensors == tuple(link for link in range(4) if link != sensor)
    run.plant.link_sensors.set_faults({})
    assert len(run.after(1).innovation.sensors) == 4
    run.after(250)
    assert run.estimator.sensor_faults() == {}


def test_links_at_rest_under_sensors_without_noise_are_not_stuck(paper: Mechanism) -> None:
    run = Run(paper, InitialState(), PERFECT)
    for _ in run.ticks(200):
        assert run.estimator.sensor_faults() == {}
    assert len(run.after(1).innovation.sensors) == 4


def test_silent_sensor_is_reported_and_recovers(paper: Mechanism) -> None:
    run = Run(paper, InitialState(0.3, 1.6))
    run.after(50)
    for n, _ in enumerate(run.ticks(60, (0, 1, 3)), 1):
        # The fault is reported after 0.2 s, which is fifty ticks.
        assert run.estimator.sensor_faults() == ({'link_c': 'no data'} if n > 50 else {})
    run.after(1)
    assert run.estimator.sensor_faults() == {}


@pytest.mark.medium
@pytest.mark.parametrize('garbage', [False, True])
def test_estimate_is_lost_a_second_after_the_last_accepted_sample(
    garbage: bool, paper: Mechanism,
) -> None:
    """Without samples or with outliers only; a good sample restarts it on the same turn."""
    run = Run(paper, InitialState(0.3, 1.6, 'open', 0.4, -0.3))
    run.after(250)

    def blind() -> Estimate | None:
        if garbage:
            run.estimator.measure(
                run.stamp_ns + PERIOD_NS, ['link_a'], [3.0 + 0.1 * (run.stamp_ns % 7)])
        return run.tick(())
    for _ in range(250):
        estimate = blind()
        assert estimate is not None
        assert np.abs(run.unwrapped_error(estimate)).max() < pi / 180.0
    assert blind() is None
    assert 'the estimate is lost' in run.estimator.waiting_for
    assert run.tick(()) is None
    back = run.tick()
    assert back is not None
    assert np.abs(run.unwrapped_error(back)).max() < SIGMAS * NOISE
    assert run.estimator.waiting_for == ''
    assert run.estimator.starts == 2


def test_without_a_gate_all_samples_are_accepted(paper: Mechanism) -> None:
    run = Run(paper, InitialState())
    run.estimator = Estimator(paper, EstimatorSettings(gate_probability=1.0))
    run.after(100)
    assert measured_with(run, np.array([0.5, 0.0, 0.0, 0.0])).innovation.used.all()
    assert not run.estimator.gated


# Late samples

HISTORY_MS = 100


class Delivered:
    """
    Ticks and measurements of one motion, for delivery with delays.

    :ivar ticks: stamp [ns] and wheel speeds of each.
    :ivar samples: stamp [ns], links, angles of each, several per tick or none, between the ticks.
    """

    def __init__(self, mechanism: Mechanism, seed: int, count: int = 150) -> None:
        rng = np.random.default_rng(seed)
        plant = Plant(mechanism, PERFECT, InitialState(0.3, 1.6, 'open', 2.0, -0.5), 5e-4, rng)
        self.ticks: list[tuple[int, Array]] = []
        self.samples: list[tuple[int, list[str], Array]] = []
        stamp_ns = FIRST_NS
        for _ in range(count):
            torques = rng.uniform(-5e-5, 5e-5, 4)
            before = plant.sense_wheels()
            for _ in range(8):
                plant.advance(1, torques)
                stamp_ns += PERIOD_NS // 8
                if rng.random() < 0.15:
                    # Some stamps have two messages.
                    links = rng.permutation(4)
                    angles = plant.truth().link_angles[links] + NOISE * rng.standard_normal(4)
                    cut = int(rng.integers(1, 5))
                    for part in (slice(0, cut), slice(cut, 4)):
                        if links[part].size:
                            self.samples.append((stamp_ns, names_of(*links[part]), angles[part]))
            self.ticks.append((stamp_ns, (plant.sense_wheels() - before) / 4e-3))
        # The first sample starts the filter in every order of arrival.
        start = FIRST_NS + PERIOD_NS // 16
        self.samples.insert(0, (start, names_of(0, 1, 2, 3), assemble(mechanism, 0.3, 1.6)))

    def estimates(self, mechanism: Mechanism, delays_ns: Array) -> list[Estimate | None]:
        """Deliver each sample with its delay, in the order of arrival."""
        estimator = Estimator(mechanism, EstimatorSettings())
        arrivals = sorted(
            (stamp + int(delay), n) for n, ((stamp, *_), delay)
            in enumerate(zip(self.samples, delays_ns)))
        estimates = []
        for tick_ns, speeds in self.ticks:
            while arrivals and arrivals[0][0] <= tick_ns:
                stamp, names, angles = self.samples[arrivals.pop(0)[1]]
                estimator.measure(stamp, names, list(angles))
            estimates.append(estimator.tick(tick_ns, speeds))
        assert not estimator.rejected
        assert estimator.starts == 1
        return estimates


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(8))
def test_estimate_depends_on_what_arrived_and_not_on_when(
    seed: int, mechanism: Mechanism,
) -> None:
    """Each sample has its own delay of up to 0.1 s; only the set of arrived samples matters."""
    motion = Delivered(mechanism, seed)
    rng = np.random.default_rng(seed + 100)
    in_time = motion.estimates(mechanism, np.zeros(len(motion.samples)))
    delays = rng.uniform(0.0, HISTORY_MS * 1e6, len(motion.samples))
    # All late samples arrive by the last tick.
    end_ns = motion.ticks[-1][0]
    delays = np.minimum(delays, [end_ns - stamp for stamp, *_ in motion.samples])
    late = motion.estimates(mechanism, delays)
    final, expected = late[-1], in_time[-1]
    assert final is not None
    assert expected is not None
    for name in ('link_angles', 'link_rates', 'angle_sigmas', 'rate_sigmas'):
        np.testing.assert_allclose(
            getattr(final, name), getattr(expected, name), rtol=0.0, atol=1e-12,
            err_msg=f'{name}, seed {seed}')
    # In the middle of the run samples are missing, so that the estimates differ there.
    middle = late[len(late) // 2], in_time[len(late) // 2]
    assert middle[0] is not None
    assert middle[1] is not None
    assert not np.allclose(middle[0].link_angles, middle[1].link_angles, rtol=0.0, atol=1e-9)


@pytest.mark.medium
@pytest.mark.parametrize('latency_ms', [1, 5, 40])
def test_latency_causes_no_error_in_motion(latency_ms: int, mechanism: Mechanism) -> None:
    """At 5 rad/s a sample of 5 ms ago differs by 25 mrad, ten times the tolerance."""
    run = Run(mechanism, InitialState(0.3, 1.6, 'open', 5.0, 5.0))
    rng = np.random.default_rng(7)
    waiting: list[tuple[int, Array]] = []
    estimates = []
    for _ in range(400):
        before = run.plant.sense_wheels()
        run.plant.advance(8, np.zeros(4))
        run.stamp_ns += PERIOD_NS
        noise = NOISE * rng.standard_normal(4)
        waiting.append((run.stamp_ns, run.plant.truth().link_angles + noise))
        while waiting and waiting[0][0] + latency_ms * 1_000_000 <= run.stamp_ns:
            stamp, angles = waiting.pop(0)
            run.estimator.measure(stamp, list(LINK_NAMES), list(angles))
        estimate = run.estimator.tick(
            run.stamp_ns, (run.plant.sense_wheels() - before) / 4e-3)
        if estimate is not None:
            estimates.append((estimate, run.unwrapped_error(estimate)))
    assert run.estimator.starts == 1
    assert not run.estimator.rejected
    for estimate, error in estimates[-150:]:
        assert (np.abs(error) < SIGMAS * estimate.angle_sigmas).all()
        assert np.abs(error).max() < 2.5e-3
        assert estimate.innovation is not None


def test_sample_as_old_as_the_history_is_used(running: Run) -> None:
    running.after(50)
    truth = running.plant.truth().link_angles
    running.ticks(1, ())
    stamp = running.stamp_ns - HISTORY_MS * 1_000_000 + 1_000_000
    running.estimator.measure(stamp, list(LINK_NAMES), list(truth))
    (estimate,) = running.ticks(1, ())
    assert estimate.innovation is not None
    assert not running.estimator.rejected


def test_late_repeated_sample_is_rejected(running: Run) -> None:
    running.after(20)
    with rejected('repeated'):
        running.estimator.measure(running.stamp_ns - 5 * PERIOD_NS, ['link_b'], [0.5])


def test_start_from_a_late_sample_is_predicted_to_the_tick(mechanism: Mechanism) -> None:
    """The first sample arrives ten ticks late, and the wheels have moved since its stamp."""
    run = Run(mechanism, InitialState(0.3, 1.6), PERFECT)
    first = run.plant.truth().link_angles
    stamp = run.stamp_ns + PERIOD_NS
    torques = np.array([1e-4, -1e-4, 1e-4, -1e-4])
    assert run.tick((), np.zeros(4)) is None
    for _ in range(9):
        assert run.tick((), torques) is None
    run.estimator.measure(stamp, list(LINK_NAMES), list(first))
    estimate = run.tick((), torques)
    assert estimate is not None
    truth = run.plant.truth().link_angles
    moved = np.abs(truth - first).max()
    # The encoder speeds lag by half a period: 1 - (9.5 / 10)^2 of ten periods from rest.
    assert np.abs(run.unwrapped_error(estimate)).max() < 0.11 * moved


def test_restart_in_the_same_run_stays_on_its_turn(paper: Mechanism) -> None:
    """After two turns, a restart does not jump back: the controller would follow."""
    run = Run(paper, InitialState(0.0, 1.0, 'open', 6.0, 6.0), PERFECT)
    before = run.after(600)
    assert before.link_angles.min() > 4.0 * pi
    elsewhere = Run(paper, InitialState(1.0, 2.5), PERFECT)
    elsewhere.estimator, elsewhere.stamp_ns = run.estimator, run.stamp_ns
    after = elsewhere.after(30)
    assert run.estimator.starts == 2
    assert np.abs(after.link_angles - before.link_angles).max() < 1.5 * pi


# Constant errors, too small for the gate

def named(run: Run, ticks: int, offsets: Array, wrong: int) -> tuple[float, float]:
    """Offset sensors; return the time of isolation of the wrong one, and the largest error."""
    after, worst = inf, 0.0
    for n in range(ticks):
        estimate = run.tick(None, None, offsets)
        assert estimate is not None
        worst = max(worst, float(np.abs(run.unwrapped_error(estimate)).max()))
        if after == inf and list(run.estimator.sensor_faults()) == [LINK_NAMES[wrong]]:
            after = n * PERIOD_NS * 1e-9
    return after, worst


@pytest.mark.slow
@pytest.mark.parametrize(('degrees', 'seed'), [(0.3, 0), (-0.3, 1), (-0.5, 2)])
@pytest.mark.parametrize('wrong', range(4))
def test_small_bias_of_a_sensor_is_isolated(
    wrong: int, degrees: float, seed: int, mechanism: Mechanism,
) -> None:
    """Not that of its paired link; the sensor is excluded. 0.3 deg are three sigmas."""
    run = Run(mechanism, InitialState(0.3, 1.6, 'open', 0.3, -0.2), seed=seed)
    run.after(500)
    assert run.estimator.sensor_faults() == {}
    after, worst = named(run, 500, np.radians(degrees) * np.eye(4)[wrong], wrong)
    assert after < 2.0, f'seed {seed}'
    assert worst < np.radians(0.3), f'seed {seed}'
    assert list(run.estimator.sensor_faults()) == [LINK_NAMES[wrong]]
    # The sensor is used again after its error ends.
    run.after(250)
    assert run.estimator.sensor_faults() == {}
    (estimate,) = run.ticks(1)
    assert estimate.innovation is not None and estimate.innovation.degrees_of_freedom == 4


@pytest.mark.medium
def test_both_sensors_are_suspected_where_neither_can_be_isolated(paper: Mechanism) -> None:
    """
    Sensors of paired links have opposite offsets from the start.

    The filter did not observe the onset, so it cannot isolate one of them.
    """
    run = Run(paper, InitialState(0.3, 1.6))
    for _ in range(1000):
        run.tick(None, None, np.radians(0.1) * np.array([1.0, 0.0, -1.0, 0.0]))
    faults = run.estimator.sensor_faults()
    assert set(faults) == {'link_a', 'link_c'}
    assert faults['link_a'].endswith('or link_c is')
    statistics = run.estimator.glr_statistics()
    assert abs(statistics['link_a'] - statistics['link_c']) < 10.0
    assert min(statistics['link_a'], statistics['link_c']) > 20.0 > statistics['link_b']
    # Both are used on: the mean of the two is the best that there is.
    (estimate,) = run.ticks(1)
    assert estimate.innovation is not None and estimate.innovation.degrees_of_freedom == 4


def test_indispensable_sensor_is_reported_and_used(paper: Mechanism) -> None:
    """The heading beside joint encoders: no other sensor measures the orientation."""
    run = Run(paper, InitialState(0.3, 1.6), joint_encoders('link_a'))
    run.after(500)
    offsets = np.radians(0.3) * np.eye(5)[4]
    seen = set()
    for _ in range(250):
        estimate = run.tick(None, None, offsets)
        assert estimate is not None
        seen.update(run.estimator.sensor_faults())
    assert seen == {'link_a'}
    assert estimate.innovation is not None and estimate.innovation.degrees_of_freedom == 5


# Gyros

GYROS = replace(REAL, link_sensors=replace(
    REAL.link_sensors, gyro=True, gyro_noise_rms=5e-3, gyro_bias=(0.05, -0.03, 0.0, 0.1)))


@pytest.mark.medium
def test_biases_of_gyros_are_estimated(mechanism: Mechanism) -> None:
    run = Run(mechanism, InitialState(0.3, 1.6, 'open', 0.5, -0.3), GYROS)
    estimate = run.after(1000)
    assert list(estimate.gyro_biases) == [0, 1, 2, 3]
    # The tolerance is for a thousand samples with 5 mrad/s of noise and a known rate.
    np.testing.assert_allclose(
        list(estimate.gyro_biases.values()), [0.05, -0.03, 0.0, 0.1], rtol=0.0, atol=2e-3)
    assert (np.abs(run.error(estimate)[4:]) < SIGMAS * estimate.rate_sigmas).all()


def test_gyros_reduce_the_sigma_of_the_rate(paper: Mechanism) -> None:
    """With converged biases, and unknown torques on the linkage."""
    sigmas = []
    for table in (REAL, GYROS):
        run = Run(paper, InitialState(0.3, 1.6), table)
        run.estimator = Estimator(paper, EstimatorSettings(disturbance_torque=1e-5))
        sigmas.append(run.after(500).rate_sigmas[0])
    assert sigmas[1] < 0.5 * sigmas[0]


def test_gyro_that_is_not_finite_is_rejected_with_its_message(running: Run) -> None:
    with rejected('finite'):
        running.estimator.measure(
            running.stamp_ns + 1, list(LINK_NAMES), [0.0] * 4, [0.0, nan, 0.0, 0.0])


# Wheels that are not measured

@pytest.mark.parametrize('source', ['wheel efforts', 'commanded efforts'])
def test_without_speeds_the_efforts_drive_the_prediction(source: str, paper: Mechanism) -> None:
    """Reported, and with larger sigmas of the rates, in a motion driven by the motors."""
    table = replace(REAL, wheel_encoders=WheelEncoders(0))
    run = Run(paper, InitialState(0.3, 1.6), table)
    sure = run.after(500).rate_sigmas
    worst = 0.0
    for n in range(250):
        torques = 5e-5 * np.sin(0.1 * n + np.arange(4))
        run.plant.advance(8, torques)
        run.stamp_ns += PERIOD_NS
        run.plant.measure_links(run.stamp_ns)
        reading, = run.plant.link_sensors.due(run.stamp_ns)
        run.estimator.measure(run.stamp_ns, LINK_NAMES, list(reading.angles))
        efforts = run.plant.efforts.copy()
        if source == 'commanded efforts':
            run.estimator.set_command(list(efforts))
            efforts = np.empty(0)
        estimate = run.estimator.tick(run.stamp_ns, [], list(efforts))
        assert estimate is not None
        assert run.estimator.driven_by == source
        worst = max(worst, float(np.abs(run.error(estimate)[4:]).max()))
    assert (estimate.rate_sigmas > 1.5 * sure).all()
    # A torque of 5e-5 N m accelerates a pair of links by 0.3 rad/s^2, to 0.05 rad/s.
    assert worst < 0.02
    run.after(2)
    assert run.estimator.driven_by == 'wheel speeds'


def test_missing_wheel_motion_is_reported(paper: Mechanism) -> None:
    run = Run(paper, InitialState(0.3, 1.6))
    run.after(250)
    estimate = run.estimator.tick(run.stamp_ns + PERIOD_NS, [])
    assert estimate is not None
    assert run.estimator.driven_by == 'nothing'


def test_old_commands_are_ignored(running: Run) -> None:
    running.estimator.set_command([1e-5] * 4)
    driven = []
    for n in range(1, 30):
        running.estimator.tick(running.stamp_ns + n * PERIOD_NS, [])
        driven.append(running.estimator.driven_by)
    assert driven == 25 * ['commanded efforts'] + 4 * ['nothing']


@pytest.mark.parametrize('efforts', [[0.0] * 3, [nan, 0.0, 0.0, 0.0], [inf] * 4])
def test_unusable_commands_are_ignored(efforts: list[float], running: Run) -> None:
    running.estimator.set_command(efforts)
    assert running.estimator.tick(running.stamp_ns + PERIOD_NS, []) is not None
    assert running.estimator.driven_by == 'nothing'


# Disturbances

@pytest.mark.medium
def test_constant_torques_are_estimated(paper: Mechanism) -> None:
    """A torque on link c acts as one on its paired link a."""
    estimator = Estimator(paper, EstimatorSettings(disturbance_walk=3e-7))
    around = surroundings(link_torques=[2e-6, -1e-6, 1e-6, 0.0])
    rng = np.random.default_rng(0)
    state, speeds = make_state(assemble(paper, 0.3, 1.6)), np.zeros(4)
    for n in range(1, 1501):
        before = speeds
        move_held(state, np.zeros(4), 5e-4, 8, paper.constants, around)
        speeds = state[WHEEL_SPEEDS] - state[LINK_RATES]
        stamp_ns = FIRST_NS + n * PERIOD_NS
        estimator.measure(stamp_ns, list(LINK_NAMES),
                          list(state[LINK_ANGLES] + NOISE * rng.standard_normal(4)))
        estimate = estimator.tick(stamp_ns, 0.5 * (before + speeds))
    assert estimate is not None
    error = estimate.disturbance - [3e-6, -1e-6]
    assert (np.abs(error) < SIGMAS * estimate.disturbance_sigmas).all()
    assert (estimate.disturbance_sigmas < 1e-6).all()


# Sample statuses

def test_every_sensor_has_a_status_at_every_tick(running: Run) -> None:
    """Accepted, gated, late, not finite, no data; by name, with the NIS."""
    def decided(estimate: Estimate | None) -> dict[str, str]:
        assert estimate is not None
        return {LINK_NAMES[status.sensor]: SAMPLE_STATUSES[status.status]
                for status in running.estimator.sample_statuses()}
    accepted = dict.fromkeys(LINK_NAMES, 'accepted')
    (estimate,) = running.ticks(1)
    assert decided(estimate) == accepted
    assert decided(running.tick((0, 2))) == {
        **accepted, 'link_b': 'no data', 'link_d': 'no data'}
    far_off = running.tick(None, None, 0.5 * np.eye(4)[3])
    assert decided(far_off) == {**accepted, 'link_d': 'gated'}
    assert running.estimator.sample_statuses()[3].nis > EstimatorSettings().gate
    for stamp_ns, angle, reason in ((running.stamp_ns - 200_000_000, 0.3, 'late'),
                                    (running.stamp_ns + 1, nan, 'not finite')):
        with pytest.raises(RejectedError):
            running.estimator.measure(stamp_ns, ['link_b'], [angle])
        assert decided(running.tick((0, 2, 3))) == {**accepted, 'link_b': reason}


def test_measurements_of_the_future_are_counted(running: Run) -> None:
    running.estimator.measure(running.stamp_ns + 20_000_000_000, ['link_b'], [0.3])
    running.after(1)
    assert running.estimator.rejected == Counter(future=1)
    assert 'after the tick' in running.estimator.last_rejection


@pytest.mark.parametrize(('lag', 'fault'), [(12, 'samples come late'),
                                            (40, 'samples come too late')])
def test_slow_sensor_is_reported(lag: int, fault: str, paper: Mechanism
                                 ) -> None:
    """Its samples act at their stamps within the history."""
    run = Run(paper, InitialState(0.3, 1.6, 'open', 0.5, -0.3))
    run.after(250)
    late: list[tuple[int, float]] = []
    for _ in range(100):
        estimate = run.tick((0, 1, 2))
        late.append((run.stamp_ns, float(run.plant.truth().link_angles[3])))
        if len(late) > lag:
            stamp_ns, angle = late.pop(0)
            with suppress(RejectedError):
                run.estimator.measure(stamp_ns, ['link_d'], [angle])
    assert run.estimator.sensor_faults() == {'link_d': fault}
    assert estimate is not None
    assert np.abs(run.unwrapped_error(estimate)).max() < SIGMAS * NOISE / 3.0
