# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The estimator follows the linkage through everything that topics may do to its inputs."""

from collections import Counter
from collections.abc import Iterator
from itertools import combinations
from math import inf, nan, pi
from typing import Any

from fourbar_ros.estimation import Estimate, Estimator, EstimatorSettings
from fourbar_ros.mechanism import assemble, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.by_name import RejectedError
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.table import LinkSensors, WheelEncoders
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

PERIOD_NS = 4_000_000
FIRST_NS = 1_000_000_000
NOISE = 1.7453e-3
REAL = Table(LinkSensors(NOISE, 16384), WheelEncoders(16384))
PERFECT = Table(LinkSensors(0.0, 0), WheelEncoders(0))
STILL = [0.0] * 4
# With noise the errors stay within so many sigmas: 4000 numbers exceed 5 with p = 0.002.
SIGMAS = 5.0


class Run:
    """A plant and an estimator that watches it, tick by tick."""

    def __init__(self, mechanism: Mechanism, initial: InitialState, table: Table = REAL,
                 seed: int = 0) -> None:
        self.plant = Plant(mechanism, table, initial, 5e-4, np.random.default_rng(seed))
        self.estimator = Estimator(mechanism, EstimatorSettings())
        self.stamp_ns = FIRST_NS

    def tick(self, links: tuple[int, ...] = (0, 1, 2, 3), torques: Array | None = None
             ) -> Estimate | None:
        """Advance by a period, measure some links, and estimate."""
        before = self.plant.sense_wheels()
        self.plant.advance(8, np.zeros(4) if torques is None else torques)
        speeds = (self.plant.sense_wheels() - before) / 4e-3
        self.stamp_ns += PERIOD_NS
        if links:
            self.estimator.measure(
                self.stamp_ns, [LINK_NAMES[link] for link in links],
                list(self.plant.sense_links()[list(links)]))
        return self.estimator.tick(self.stamp_ns, list(speeds))

    def ticks(self, count: int, *args: Any) -> Iterator[Estimate]:
        """Go on for some ticks, all of which give an estimate."""
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
        """Return the error of the angles (4,), whatever turn the filter started on."""
        error = self.error(estimate)[:4]
        return error - 2.0 * pi * np.round(error / (2.0 * pi))


# Following

@pytest.mark.parametrize('branch', ['open', 'crossed'])
def test_errors_settle_within_their_sigmas(mechanism: Mechanism, branch: str) -> None:
    run = Run(mechanism, InitialState(0.3, 1.6, branch, 0.5, -0.3))
    run.after(250)
    for estimate in run.ticks(250):
        assert (np.abs(run.unwrapped_error(estimate)) < SIGMAS * estimate.angle_sigmas).all()
    # A tenth of a degree at 250 Hz, and a model: the estimate is far better than a sample.
    assert estimate.angle_sigmas[:2].max() < NOISE / 3.0
    assert np.abs(run.error(estimate)[4:]).max() < 0.02


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
    # From the second second on, when the unknown initial rate is known: no turn is ever gained,
    # lost or passed through.
    settled = np.array(errors[250:])
    turns = np.round(settled[0] / (2.0 * pi))
    assert np.abs(settled - 2.0 * pi * turns).max() < SIGMAS * NOISE


@pytest.mark.parametrize(
    'links', [links for n in (1, 2, 3) for links in combinations(range(4), n)])
def test_any_subset_of_links_keeps_it_going(links: tuple[int, ...], uneven: Mechanism) -> None:
    """After a start from all four, one link alone corrects what it can and disturbs nothing."""
    run = Run(uneven, InitialState(0.3, 1.6, 'open', 0.2, -0.1))
    run.after(100)
    for estimate in run.ticks(100, links):
        assert estimate.innovation is not None
        assert estimate.innovation.links == links
        assert estimate.innovation.angles.shape == (len(links),)
        assert np.abs(run.unwrapped_error(estimate)).max() < SIGMAS * max(estimate.angle_sigmas)


def test_without_samples_wheels_alone_carry_it(mechanism: Mechanism) -> None:
    """Silence of 0.2 s, with the motors working."""
    run = Run(mechanism, InitialState(0.3, 1.6, 'open', 0.2, -0.1))
    estimate = run.after(250)
    rate_error = np.abs(run.error(estimate)[4:]).max()
    before = np.abs(run.unwrapped_error(estimate)).max()
    sigmas = estimate.angle_sigmas
    for n in range(50):
        (estimate,) = run.ticks(1, (), 5e-5 * np.sin(0.2 * n + np.arange(4)))
        assert estimate.innovation is None
    # The rate's error goes on, and one count of the encoders is If/I = 1 % of 0.1 rad/s; Gamma
    # makes at most three of each.
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
@pytest.mark.parametrize('third', [2, 3])
def test_three_links_tell_the_branch(mechanism: Mechanism, branch: str, third: int) -> None:
    angles = angles_of(mechanism, branch)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        estimator = Estimator(mechanism, EstimatorSettings())
        links = rng.permutation([0, 1, third])
        measured = angles[links] + NOISE * rng.standard_normal(3)
        estimator.measure(FIRST_NS, names_of(*links), list(measured))
        estimate = estimator.tick(FIRST_NS, STILL)
        assert estimate is not None, f'seed {seed}'
        wrapped = np.angle(np.exp(1j * (estimate.link_angles - angles)))
        # Gamma of these linkages is at most 2, four numbers of twenty seeds stay within 4 sigma.
        assert np.abs(wrapped).max() < 4.0 * 3.0 * NOISE, f'seed {seed}'


@pytest.mark.parametrize('links', [(0,), (0, 1), (0, 2, 3), (1, 2, 3), (2, 3)])
def test_fewer_do_not_start_it(links: tuple[int, ...], paper: Mechanism) -> None:
    estimator = Estimator(paper, EstimatorSettings())
    assert estimator.waiting_for == 'flywheel_states'
    estimator.measure(FIRST_NS, names_of(*links), list(angles_of(paper, 'open')[list(links)]))
    assert estimator.tick(FIRST_NS, STILL) is None
    assert 'link_a, link_b and one of link_c, link_d' in estimator.waiting_for
    assert estimator.starts == 0


def test_angles_that_do_not_fit_together_do_not_start_it(uneven: Mechanism) -> None:
    long = Mechanism(  # type: ignore[arg-type]
        [0.3, 0.3, 0.2, 0.2], [0.02] * 4, [2e-5] * 4, [[0.05, 0.0]] * 4, [3e-7] * 4)
    estimator = Estimator(long, EstimatorSettings())
    estimator.measure(FIRST_NS, list(LINK_NAMES), [0.0, 3.0, 0.0, 3.0])
    assert estimator.tick(FIRST_NS, STILL) is None
    assert 'fit together' in estimator.waiting_for
    assert 'link_b = 3' in estimator.waiting_for


def test_waiting_ends_with_a_good_sample(paper: Mechanism) -> None:
    run = Run(paper, InitialState())
    assert run.tick((0, 1)) is None
    assert run.tick() is not None
    assert run.estimator.waiting_for == ''
    assert run.estimator.starts == 1


# What is rejected

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
    with pytest.raises(RejectedError) as caught:
        running.estimator.measure(running.stamp_ns + PERIOD_NS, names, angles)
    assert caught.value.kind == kind
    assert running.estimator.rejected == Counter({kind: 1})
    assert running.estimator.last_rejection == str(caught.value)
    # Nothing of it was kept: the tick's own sample is still welcome, and the only one.
    (estimate,) = running.ticks(1)
    assert np.abs(running.error(estimate)).max() < 1e-6


def test_repeated_sample_is_rejected(running: Run) -> None:
    stamp = running.stamp_ns + PERIOD_NS
    running.estimator.measure(stamp, ['link_a', 'link_b'], [0.0, 1.0])
    for names in (['link_a'], ['link_b', 'link_c']):
        with pytest.raises(RejectedError) as caught:
            running.estimator.measure(stamp, names, [0.0] * len(names))
        assert caught.value.kind == 'repeated'
    running.estimator.measure(stamp, ['link_c'], [0.0])
    assert running.estimator.rejected == Counter(repeated=2)


@pytest.mark.parametrize('age_ms', [4, 500, 999])
def test_late_sample_is_rejected(age_ms: int, running: Run) -> None:
    with pytest.raises(RejectedError) as caught:
        running.estimator.measure(running.stamp_ns - age_ms * 1_000_000, ['link_a'], [0.5])
    assert caught.value.kind == 'late'
    assert running.estimator.rejected == Counter(late=1)


@pytest.mark.parametrize('age_s', [2, 3600])
def test_very_late_sample_does_not_pass_for_a_new_one(age_s: int, running: Run) -> None:
    """Older than a restart of time may look like, but the ticks go on: it must do nothing."""
    try:
        running.estimator.measure(
            running.stamp_ns - age_s * 1_000_000_000, list(LINK_NAMES), [0.5, 1.5, 0.5, 1.5])
    except RejectedError:
        pass
    (estimate,) = running.ticks(1)
    assert np.abs(running.error(estimate)).max() < 1e-6


def test_sample_of_the_last_tick_still_serves_the_next(running: Run) -> None:
    (estimate,) = running.ticks(1, ())
    assert estimate.innovation is None
    running.estimator.measure(
        running.stamp_ns, list(LINK_NAMES), list(running.plant.truth().link_angles))
    (estimate,) = running.ticks(1, ())
    assert estimate.innovation is not None


@pytest.mark.parametrize('speeds', [[0.0] * 3, [0.0] * 5, [], [0.0, nan, 0.0, 0.0],
                                    [inf, 0.0, 0.0, 0.0]])
def test_unusable_wheel_speeds_are_rejected(speeds: list[float], running: Run) -> None:
    with pytest.raises(RejectedError) as caught:
        running.estimator.tick(running.stamp_ns + PERIOD_NS, speeds)
    assert caught.value.kind == 'wheels'
    assert running.estimator.rejected == Counter(wheels=1)
    (estimate,) = running.ticks(1)
    assert np.abs(running.error(estimate)).max() < 1e-6


@pytest.mark.parametrize('behind_ns', [0, 1, PERIOD_NS])
def test_tick_that_was_there_is_rejected(behind_ns: int, running: Run) -> None:
    with pytest.raises(RejectedError) as caught:
        running.estimator.tick(running.stamp_ns - behind_ns, STILL)
    assert caught.value.kind == 'stamp'
    assert running.estimator.starts == 1


# Restarts

@pytest.mark.parametrize('jump_ns', [-5_000_000_000, 1_100_000_000, 3600 * 10 ** 9])
def test_another_time_is_another_run(jump_ns: int, paper: Mechanism) -> None:
    """Time goes back, or on after a gap, and the linkage is somewhere else."""
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


def test_gap_of_less_is_bridged(paper: Mechanism) -> None:
    run = Run(paper, InitialState(), PERFECT)
    run.after(10)
    run.stamp_ns += 900_000_000
    assert run.tick() is not None
    assert run.estimator.starts == 1


@pytest.mark.parametrize('jump', [0.5, -2.0, 3.0])
def test_lost_filter_recovers(jump: float, paper: Mechanism) -> None:
    """Somebody lifts the linkage and puts it back turned: within 20 samples all is well."""
    run = Run(paper, InitialState())
    run.after(250)
    elsewhere = Run(paper, InitialState(jump, jump + 1.5), seed=1)
    elsewhere.estimator, elsewhere.stamp_ns = run.estimator, run.stamp_ns
    elsewhere.after(20)
    for estimate in elsewhere.ticks(250):
        assert np.abs(elsewhere.unwrapped_error(estimate)).max() < SIGMAS * NOISE
    assert run.estimator.starts <= 2


def test_noise_alone_never_restarts_it(paper: Mechanism) -> None:
    run = Run(paper, InitialState(0.0, 1.0, 'open', 0.3, 0.1), seed=4)
    run.after(2000)
    assert run.estimator.starts == 1
    assert not run.estimator.rejected
