# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The soft step meets its ends in angle, rate and acceleration."""

from fourbar_ros.control.soft_step import evaluate, quintic, SoftStep
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

REST = np.array([[0.2, -1.0], [0.0, 0.0], [0.0, 0.0]])
GOAL = np.array([1.7, 0.5])
pairs = st.tuples(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0)).map(np.array)
starts = st.tuples(pairs, pairs, pairs).map(np.array)
durations = st.floats(0.1, 100.0)


@pytest.mark.parametrize('share', [0.0, 0.1, 0.25, 0.5, 0.75, 0.999, 1.0])
def test_from_rest_it_is_the_soft_step_of_the_paper(share: float) -> None:
    """The values are 10 s^3 - 15 s^4 + 6 s^5 and its derivatives."""
    duration, rise = 8.0, GOAL - REST[0]
    s = share
    step = SoftStep(REST, GOAL, duration).at(share * duration)
    np.testing.assert_allclose(
        step[0], REST[0] + rise * (10 * s ** 3 - 15 * s ** 4 + 6 * s ** 5), atol=1e-14)
    np.testing.assert_allclose(step[1], rise / duration * 30 * s ** 2 * (1 - s) ** 2, atol=1e-14)
    np.testing.assert_allclose(
        step[2], rise / duration ** 2 * 60 * s * (1 - s) * (1 - 2 * s), atol=1e-14)


def test_peak_rate_is_fifteen_eighths_of_the_mean() -> None:
    peak = SoftStep(REST, GOAL, 10.0).at(5.0)[1]
    np.testing.assert_allclose(peak, 15.0 / 8.0 * (GOAL - REST[0]) / 10.0, rtol=1e-14)


@pytest.mark.medium
@settings(derandomize=True)
@given(start=starts, goal=pairs, duration=durations)
def test_it_starts_and_ends_as_asked(start: Array, goal: Array, duration: float) -> None:
    step = SoftStep(start, goal, duration)
    np.testing.assert_allclose(step.at(0.0), start, rtol=1e-12, atol=1e-300)
    end = np.array([goal, np.zeros(2), np.zeros(2)])
    np.testing.assert_array_equal(step.at(duration), end)
    np.testing.assert_array_equal(step.at(duration * 1.5), end)
    # Just before the end the polynomial itself is there. Its coefficients reach size * 15, so
    # rounding leaves some hundred 2e-16 of that, and 1e-9 of the duration its share of the slope.
    size = np.abs(start[0] - goal) + np.abs(start[1]) * duration + np.abs(start[2]) * duration ** 2
    scale = np.array([1.0, 1.0 / duration, 1.0 / duration ** 2])[:, None]
    near = np.abs(step.at(duration * (1.0 - 1e-9)) - end)
    assert (near <= scale * (1e-6 * size + 1e-12)).all()


@settings(derandomize=True)
@given(start=starts, goal=pairs, duration=durations, share=st.floats(0.01, 0.99))
def test_rate_and_acceleration_are_the_derivatives(
    start: Array, goal: Array, duration: float, share: float,
) -> None:
    step = SoftStep(start, goal, duration)
    width = 1e-4 * duration
    before, now, after = (step.at(share * duration + n * width) for n in (-1, 0, 1))
    # In units of the duration: third derivatives up to 60 * 15 sizes times 1e-8 / 6, rounding
    # 1e-15 sizes over 2e-4.
    size = (np.abs(start[0] - goal) + np.abs(start[1]) * duration
            + np.abs(start[2]) * duration ** 2 + np.abs(goal))
    for order in (0, 1):
        slope = (after[order] - before[order]) / (2.0 * width)
        assert (np.abs(slope - now[order + 1]) * duration ** (order + 1)
                <= 2e-5 * size + 1e-9).all()


def test_motion_before_the_begin_is_rest_at_the_start() -> None:
    moving = np.array([[0.2, -1.0], [0.3, 0.1], [0.05, -0.2]])
    np.testing.assert_allclose(SoftStep(moving, GOAL, 5.0).at(-1.0), moving, rtol=1e-15)


def test_path_is_the_motion_sampled_evenly() -> None:
    step = SoftStep(np.array([[0.1, -0.2], [0.3, 0.1], [-0.1, 0.2]]), np.array([1.0, 2.0]), 3.0)
    np.testing.assert_allclose(
        step.path(31), [step.at(time)[0] for time in np.linspace(0.0, 3.0, 31)],
        rtol=0.0, atol=1e-13)


@settings(derandomize=True)
@given(start=starts, end=starts, duration=durations)
def test_quintic_meets_both_states(start: Array, end: Array, duration: float) -> None:
    coefficients = quintic(start, end, duration)
    # Coefficients reach 15 times the sizes in units of the duration, and the second derivative
    # multiplies them by 20; some roundings of that.
    powers = duration ** np.arange(3.0)[:, None]
    size = ((np.abs(start) + np.abs(end)) * powers).sum(axis=0)
    for time, state in ((0.0, start), (duration, end)):
        off = np.abs(evaluate(coefficients, time, duration) - state) * powers
        assert (off <= 1e-13 * 20.0 * size + 1e-300).all()


def test_sample_is_the_same_at_many_instants() -> None:
    step = SoftStep(np.array([[0.1, -0.2], [0.3, 0.1], [-0.1, 0.2]]), np.array([1.0, 2.0]), 3.0)
    times = step.instants(40)
    assert (times[0], times[-1], len(times)) == (0.0, 3.0, 40)
    np.testing.assert_allclose(
        step.sample(times), [step.at(time) for time in times], rtol=0.0, atol=1e-13)
