# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Prescribed wheels, mixed with wheels driven by torque."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

from fourbar_ros.mechanism import angular_momentum, Mechanism
from fourbar_ros.mechanism.case import Case, simulate
from fourbar_ros.mechanism.forces import surroundings
from fourbar_ros.mechanism.integration import evaluate
from fourbar_ros.mechanism.state import LINK_ANGLES, LINK_RATES, WHEEL_SPEEDS
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Mechanism]
Mask = tuple[bool, ...]

SEEDS = range(10)
# All choices of at least one prescribed wheel.
CHOICES = [choice for choice in product((False, True), repeat=4) if any(choice)]
STEP = 1e-3


def case_of(rng: np.random.Generator, linkage: Mechanism, state: Array, prescribed: Mask,
            time: float = 0.5) -> Case:
    """Draw torques of about 0.1 N m and wheel angles of about 1 rad, up to 2 Hz."""
    given = np.array(prescribed)
    return Case(
        linkage, state[LINK_ANGLES], state[LINK_RATES], state[WHEEL_SPEEDS],
        np.where(given, rng.uniform(-3.0, 3.0, 4), rng.uniform(-0.2, 0.2, 4)),
        rng.uniform(0.5, 2.0, 4), rng.uniform(-3.0, 3.0, 4), np.linspace(0.0, time, 11), given)


def law(case: Case, times: Array) -> tuple[Array, Array]:
    """Return the prescribed angle and speed relative to the link, (n, 4) each."""
    omega = 2.0 * np.pi * case.frequency_hz
    phase = np.outer(times, omega) + case.phase
    return case.amplitude * np.cos(phase), -case.amplitude * omega * np.sin(phase)


# --- An independent derivation ----------------------------------------------------------------

# One, two and four prescribed wheels; each choice needs its own derivation of two seconds.
@pytest.mark.medium
@pytest.mark.parametrize('prescribed', [
    (False, True, False, False), (True, False, True, False), (True, True, True, True)])
@pytest.mark.parametrize('seed', range(3))
def test_motion_agrees_with_kane_equations(
    seed: int, prescribed: Mask, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    pytest.importorskip('sympy')
    from fourbar_ros.studies.independent import kane

    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    case = case_of(rng, linkage, random_state(rng, linkage, 0.7), prescribed, 0.2)
    ours, theirs = simulate(case, STEP), kane.simulate(case)
    # The error is (w h)^4 / 2880 of the motion, with w up to 13 rad/s: 0.3 rad of links, 3 rad of
    # wheels; w times as much in the speeds.
    np.testing.assert_allclose(ours.link_angles, theirs.link_angles, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(ours.link_rates, theirs.link_rates, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(
        ours.flywheel_speeds_absolute, theirs.flywheel_speeds_absolute, rtol=0.0, atol=2e-9)


@pytest.mark.parametrize('prescribed', CHOICES)
@pytest.mark.parametrize('seed', SEEDS)
def test_prescribed_wheel_equals_a_driven_one_with_the_same_torque(
    seed: int, prescribed: Mask, random_linkage: Draw, random_state: Callable[..., Array],
) -> None:
    """The torque is axial inertia times absolute acceleration, with friction and drag."""
    rng = np.random.default_rng(seed)
    linkage = random_linkage(rng)
    state = random_state(rng, linkage)
    around = surroundings(joint_viscous=0.05, link_drag=rng.uniform(0.0, 0.5, 4),
                          link_torques=rng.uniform(-0.3, 0.3, 4))
    drive = rng.uniform(-1.0, 1.0, 4)
    ours, driven = np.empty_like(state), np.empty_like(state)
    evaluate(state, drive, linkage.constants_with(np.array(prescribed)), around, ours)
    torques = np.where(prescribed, linkage.flywheel_inertias * ours[WHEEL_SPEEDS], drive)
    evaluate(state, torques, linkage.constants, around, driven)
    # The terms of the sums may cancel.
    size = np.abs(ours[LINK_RATES]).max()
    np.testing.assert_allclose(ours, driven, rtol=1e-11, atol=1e-11 * size)
    # The law prescribes the acceleration relative to the link.
    relative = ours[WHEEL_SPEEDS] - ours[LINK_RATES]
    np.testing.assert_allclose(
        (linkage.flywheel_inertias * relative)[list(prescribed)], drive[list(prescribed)],
        rtol=0.0, atol=1e-13)


# --- Laws of motion ---------------------------------------------------------------------------

@pytest.fixture(params=CHOICES, ids=str)
def case(request: pytest.FixtureRequest, random_linkage: Draw,
         random_state: Callable[..., Array]) -> Case:
    """Draw a case for every choice of prescribed wheels, with the choice as its seed."""
    rng = np.random.default_rng(CHOICES.index(request.param))
    linkage = random_linkage(rng)
    return case_of(rng, linkage, random_state(rng, linkage, 0.7), request.param)


def test_wheel_follows_its_law(case: Case) -> None:
    """The speed of the initial state has no effect."""
    motion = simulate(case, STEP)
    angles, speeds = law(case, case.times)
    given = case.prescribed
    omega = 2.0 * np.pi * case.frequency_hz
    # The error of Simpson's rule is (w h)^4 / 2880 of the integral. The speed is about amplitude
    # times w; the angle is the integral of the speed.
    left = (omega * STEP)**4 / 2880.0 * np.abs(case.amplitude)
    relative = motion.flywheel_speeds_absolute - motion.link_rates
    assert (np.abs(relative - speeds) <= 2.0 * left * omega + 1e-13)[:, given].all()
    turned = motion.flywheel_angles - (angles - angles[0])
    assert (np.abs(turned) <= 2.0 * left * (1.0 + omega * case.times[-1]) + 1e-13)[:, given].all()


def test_driven_wheel_is_independent_of_the_others(case: Case) -> None:
    """Its absolute speed is the integral of its torque over its axial inertia."""
    motion = simulate(case, STEP)
    omega = 2.0 * np.pi * case.frequency_hz
    size = case.amplitude / omega / case.mechanism.flywheel_inertias
    gained = size * (np.sin(np.outer(case.times, omega) + case.phase) - np.sin(case.phase))
    expected = case.flywheel_speeds_absolute + gained
    error = np.abs(motion.flywheel_speeds_absolute - expected)[:, ~case.prescribed]
    left = 2.0 * np.abs(size) * (omega * STEP)**4 / 2880.0 + 1e-12
    assert (error <= left[~case.prescribed]).all()


def test_momentum_is_conserved(case: Case) -> None:
    """Motor torques are internal."""
    motion = simulate(case, STEP)
    momentum = [angular_momentum(case.mechanism, *rows) for rows in zip(
        motion.link_angles, motion.link_rates, motion.flywheel_speeds_absolute)]
    np.testing.assert_allclose(momentum, momentum[0], rtol=0.0, atol=1e-13)


def test_held_wheel_counts_as_part_of_its_link(case: Case) -> None:
    """The angle is constant and arbitrary; the other wheels are driven by torque."""
    held = replace(case, amplitude=np.where(case.prescribed, 0.0, case.amplitude))
    heavier = replace(case.mechanism, link_inertias=case.mechanism.link_inertias + np.where(
        case.prescribed, case.mechanism.flywheel_inertias, 0.0))
    ours = simulate(held, STEP)
    expected = simulate(replace(
        held, mechanism=heavier, prescribed=np.zeros(4, dtype=bool)), STEP)
    np.testing.assert_array_equal(ours.link_angles, expected.link_angles)
    given = case.prescribed
    np.testing.assert_array_equal(
        ours.flywheel_speeds_absolute[:, given], ours.link_rates[:, given])
    np.testing.assert_array_equal(ours.flywheel_angles[:, given], 0.0)
