# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The reference is continuous and comes to rest before a change point."""

from __future__ import annotations

from math import pi, sin

from fourbar_ros.control.reference_generator import ReferenceGenerator, STOPPING_TIME
from fourbar_ros.control.setpoint import follow_path
from fourbar_ros.control.soft_step import SoftStep
from fourbar_ros.mechanism import assemble, closure_error, Mechanism, reduced_form
from fourbar_ros.mechanism.change_points import PLANNING_MARGIN
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

PERIOD_NS = 4_000_000
PERIOD = 4e-3
SEEDS = range(10)

each_seed = pytest.mark.parametrize('seed', SEEDS)


def moving_reference(mechanism: Mechanism, angles: Array, travel: Array, duration: float,
                     seconds: float) -> tuple[ReferenceGenerator, int]:
    """Return a reference after some time of a move, and the stamp."""
    reference = ReferenceGenerator(mechanism)
    reference.rest_at(angles)
    step = SoftStep(reference.motion.copy(), reference.motion[0] + travel, duration)
    end = follow_path(mechanism, step, reference.angles, crossing=reference.paired)[-1]
    reference.start(step, end, 10 ** 9)
    now = 10 ** 9
    for _ in range(round(seconds / PERIOD)):
        now += PERIOD_NS
        reference.advance(now)
    return reference, now


def run(reference: ReferenceGenerator, now: int, seconds: float) -> tuple[Array, Array, Array]:
    """Run, and return angles, rates and accelerations (n, 4) from the present on."""
    found = [(reference.angles.copy(), reference.rates.copy(), reference.accelerations.copy())]
    for _ in range(round(seconds / PERIOD)):
        now += PERIOD_NS
        reference.advance(now)
        found.append((
            reference.angles.copy(), reference.rates.copy(), reference.accelerations.copy()))
    angles, rates, accelerations = (np.array(values) for values in zip(*found))
    return angles, rates, accelerations


def check_continuous(angles: Array, rates: Array, jerk: float) -> None:
    """Check that rates are the derivative of angles, within the effect of a jerk."""
    # The error of the trapezoidal rule is at most jerk T^3 / 12.
    np.testing.assert_allclose(
        np.diff(angles, axis=0), 0.5 * PERIOD * (rates[1:] + rates[:-1]),
        atol=jerk * PERIOD ** 3 / 12.0 + 1e-13)


# Begin

def test_reference_is_at_the_links(uneven: Mechanism) -> None:
    reference, angles = ReferenceGenerator(uneven), assemble(uneven, 0.3, 1.5)
    reference.rest_at(angles)
    np.testing.assert_array_equal(reference.angles, angles)
    np.testing.assert_array_equal(reference.destination, angles)
    assert not reference.paired
    assert not reference.moving
    assert reference.goal is None
    assert not reference.motion[1:].any()


@pytest.mark.parametrize('turns_c', [0, 1, -3])
@pytest.mark.parametrize('turns_d', [0, -1, 2])
@pytest.mark.parametrize('theta', [1.0, 0.0, pi, -0.5])
def test_pairs_are_parallel_on_any_turns(
    theta: float, turns_c: int, turns_d: int, paper: Mechanism,
) -> None:
    """The reference is nearest to the given angles, on their turns."""
    reference = ReferenceGenerator(paper)
    off = np.array([1e-3, -2e-3, -1e-3, 4e-3])
    turns = 2.0 * pi * np.array([0, 0, turns_c, turns_d])
    measured = 0.4 + np.array([0.0, theta, 0.0, theta]) + off + turns
    reference.rest_at(measured)
    assert reference.paired
    np.testing.assert_allclose(
        reference.angles[2:] - reference.angles[:2], 2.0 * pi * np.array([turns_c, turns_d]),
        atol=1e-12)
    # The reference is the mean of each pair, so half of the difference remains.
    np.testing.assert_allclose(np.abs(reference.angles - measured), [1e-3, 3e-3, 1e-3, 3e-3],
                               atol=1e-12)
    step = SoftStep(reference.motion.copy(), reference.motion[0] + 0.3, 1.0)
    reference.start(step, reference.angles + 0.3, 10 ** 9)
    before = reference.angles.copy()
    assert not reference.advance(10 ** 9)
    np.testing.assert_allclose(reference.angles, before, atol=1e-12)
    assert reference.advance(2 * 10 ** 9)
    np.testing.assert_allclose(reference.angles, before + 0.3, atol=1e-12)


@each_seed
def test_links_c_and_d_follow_by_closure(seed: int, uneven: Mechanism) -> None:
    rng = np.random.default_rng(seed)
    angles = assemble(uneven, 0.3, 1.5)
    reference, now = moving_reference(uneven, angles, rng.uniform(-0.4, 0.4, 2), 2.0, 0.8)
    assert closure_error(uneven, reference.angles) < 1e-15
    gamma = reduced_form(uneven, reference.angles, reference.rates).gamma
    np.testing.assert_allclose(reference.rates[2:], gamma @ reference.rates[:2], rtol=1e-12)
    assert reference.time_left(now) == pytest.approx(1.2)
    reached, rates, _ = run(reference, now, 1.2)
    # The third derivative is that of a quintic of 0.4 rad in 2 s, times Gamma.
    check_continuous(reached, rates, 60.0 * 0.4 / 2.0 ** 3 * 10.0)
    assert not reference.moving
    assert not reference.rates.any()
    np.testing.assert_allclose(reference.angles, reference.goal, atol=1e-9)


# Halt

@pytest.mark.parametrize('seconds', [0.2, 1.0, 1.7])
@pytest.mark.parametrize('linkage', ['uneven', 'paper'])
def test_halt_comes_to_rest_in_time_without_a_jump(
    linkage: str, seconds: float, request: pytest.FixtureRequest,
) -> None:
    mechanism = request.getfixturevalue(linkage)
    reference, now = moving_reference(
        mechanism, assemble(mechanism, 0.3, 1.5), np.array([0.4, 0.3]), 2.0, seconds)
    motion = reference.motion.copy()
    reference.stop(now)
    assert reference.goal is not None
    reference.advance(now)
    # Angle, rate and acceleration are continuous.
    np.testing.assert_allclose(reference.motion, motion, atol=1e-12)
    angles, rates, _ = run(reference, now, STOPPING_TIME + 2.0 * PERIOD)
    check_continuous(angles, rates, 60.0 * 10.0)
    assert not rates[-1].any()
    assert not reference.moving
    # The travel is at most that of the present rate and acceleration.
    reach = np.abs(motion[1]) * STOPPING_TIME + 0.5 * np.abs(motion[2]) * STOPPING_TIME ** 2
    assert (np.abs(angles[:, :2] - motion[0]) <= reach + 1e-12).all()


def test_halt_at_rest_has_no_effect(paper: Mechanism) -> None:
    reference = ReferenceGenerator(paper)
    reference.rest_at(assemble(paper, 0.3, 1.5))
    before = reference.angles.copy()
    reference.stop(10 ** 9)
    assert not reference.moving
    np.testing.assert_array_equal(reference.angles, before)


@each_seed
def test_reference_starts_with_the_rates_of_the_links(seed: int, uneven: Mechanism) -> None:
    """The reference stops within its stopping time."""
    rng = np.random.default_rng(seed)
    reference, angles = ReferenceGenerator(uneven), assemble(uneven, 0.3, 1.5)
    rates = np.zeros(4)
    rates[:2] = rng.uniform(-0.3, 0.3, 2)
    rates[2:] = reduced_form(uneven, angles, rates).gamma @ rates[:2]
    reference.stop_from(angles, rates, 10 ** 9)
    assert reference.goal is None
    assert reference.moving
    reference.advance(10 ** 9)
    np.testing.assert_allclose(reference.rates, rates, rtol=1e-12)
    np.testing.assert_allclose(reference.angles, angles, atol=1e-12)
    reached, speeds, _ = run(reference, 10 ** 9, STOPPING_TIME)
    check_continuous(reached, speeds, 60.0 * 10.0)
    assert not reference.rates.any()
    # A quintic from a rate to rest over half of rate times time is monotonic.
    assert (reached[1:, :2] - reached[:-1, :2]) @ np.diag(np.sign(rates[:2])) == pytest.approx(
        np.abs(np.diff(reached[:, :2], axis=0)), abs=1e-15)


def near_change_point(mechanism: Mechanism, sine: float) -> Array:
    """Return angles with a given |sin(phi_d - phi_c)|."""
    lengths = mechanism.link_lengths
    a, b, c, d = lengths
    gap = np.sqrt(c * c + d * d - 2.0 * c * d * np.cos(pi - np.arcsin(sine)))
    theta = np.arccos((a * a + b * b - gap * gap) / (2.0 * a * b))
    return assemble(mechanism, 0.2, 0.2 + float(theta))


@pytest.fixture(scope='module')
def folding() -> Mechanism:
    """Make a linkage with unequal opposite links whose links c and d can be in line."""
    return Mechanism(  # type: ignore[arg-type]
        [0.12, 0.10, 0.09, 0.10], [0.02] * 4, [2.2e-5] * 4, [[0.05, 0.0]] * 4, [3.4e-7] * 4)


@pytest.mark.parametrize(('sine', 'rate', 'at_once'), [
    (0.5, 0.3, False), (0.3, 0.3, False), (0.13, 0.05, False), (0.11, 0.02, False),
    (0.11, 1.0, True), (0.1001, 0.3, True)])
def test_reference_comes_to_rest_before_a_change_point(
    sine: float, rate: float, at_once: bool, folding: Mechanism,
) -> None:
    """The stopping time decreases with the distance to the change point, down to zero."""
    reference, angles = ReferenceGenerator(folding), near_change_point(folding, sine)
    assert abs(sin(angles[3] - angles[2])) == pytest.approx(sine, rel=1e-9)
    rates = np.array([0.0, rate, 0.0, 0.0])
    rates[2:] = reduced_form(folding, angles, rates).gamma @ rates[:2]
    reference.stop_from(angles, rates, 10 ** 9)
    assert reference.moving == (not at_once)
    reached, speeds, _ = run(reference, 10 ** 9, STOPPING_TIME)
    sines = np.abs(np.sin(reached[:, 3] - reached[:, 2]))
    assert sines[-1] < sine or at_once
    assert sines.min() >= PLANNING_MARGIN - 1e-6
    assert not speeds[-1].any()


def test_on_the_parallelogram_a_change_point_is_no_obstacle(paper: Mechanism) -> None:
    reference = ReferenceGenerator(paper)
    rates = np.tile([0.0, 0.3], 2)
    reference.stop_from(np.array([0.2, 0.15, 0.2, 0.15]), rates, 10 ** 9)
    reached, _, _ = run(reference, 10 ** 9, STOPPING_TIME)
    theta = reached[:, 1] - reached[:, 0]
    assert theta[0] < 0.0 < theta[-1]
    np.testing.assert_allclose(reached[:, 2:], reached[:, :2], atol=1e-15)
    assert theta[-1] == pytest.approx(-0.05 + 0.3 * 0.5 * STOPPING_TIME)


def test_reference_that_follows_the_links_has_no_motion(paper: Mechanism) -> None:
    reference, _ = moving_reference(
        paper, assemble(paper, 0.3, 1.5), np.array([0.4, 0.3]), 2.0, 0.8)
    here = assemble(paper, 0.5, 1.4)
    reference.track_links(here)
    np.testing.assert_array_equal(reference.angles, here)
    assert not reference.moving
    assert not reference.rates.any()
    assert not reference.motion[1:].any()
    assert not reference.advance(10 ** 10)
