# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Wheel parameters: estimates to 1 % and intervals, with free links."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fourbar_ros.analysis.calibration.excitation import SpinAndCoast
from fourbar_ros.analysis.calibration.measurements import WheelMeasurements
from fourbar_ros.analysis.calibration.parameter_estimates import CalibrationError, QUANTILE_95
from fourbar_ros.analysis.calibration.wheel_identification import (
    driven_wheels,
    mean_friction,
    wheel_estimate,
)
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.plant import Table
import numpy as np
import pytest
from scipy.stats import binom

SEEDS = range(10)
COULOMB, VISCOUS = 1e-3, 2e-6
TOP, TORQUE, COAST = 80.0, 0.02, 6.0


@pytest.mark.slow
def test_truth_is_found_to_one_percent_and_covered(
        prototype: Mechanism, lab: Table, excited: Callable[..., Any]) -> None:
    """
    Wheels on the table of the prototype with free links, seeds 0 to 9.

    The bound of the count of 30 intervals at 95 % has a probability of 1e-3.
    """
    uneven = replace(prototype, flywheel_inertias=np.array([1.2e-4, 1.3e-4, 1.1e-4, 1.25e-4]))
    covered = 0
    for seed in SEEDS:
        wheel = seed % 4
        links, wheels = excited(
            uneven, lab, SpinAndCoast(uneven, [wheel], TOP, TORQUE, COAST), seed)
        found = wheel_estimate(wheel, links, wheels)
        truth = np.array([uneven.flywheel_inertias[wheel], COULOMB, VISCOUS])
        errors = np.array([found.inertia, found.coulomb, found.viscous]) - truth
        assert np.abs(errors / truth).max() < 0.01, f'seed {seed}'
        covered += int((np.abs(errors)
                        < QUANTILE_95 * np.sqrt(np.diag(found.covariance))).sum())
    assert covered >= binom.ppf(1e-3, 3 * len(SEEDS), 0.95), 'seeds 0-9'


@pytest.mark.slow
def test_all_wheels_one_after_the_other(
        prototype: Mechanism, lab: Table, excited: Callable[..., Any]) -> None:
    """The friction for the controller is the mean; seed 7."""
    links, wheels = excited(
        prototype, lab, SpinAndCoast(prototype, range(4), TOP, TORQUE, COAST), 7)
    assert driven_wheels(wheels) == [0, 1, 2, 3]
    estimates = [wheel_estimate(wheel, links, wheels) for wheel in range(4)]
    coulomb, viscous = mean_friction(estimates)
    assert coulomb.value == pytest.approx(COULOMB, rel=0.01)
    assert abs(viscous.value - VISCOUS) < 4.0 * viscous.standard_error
    assert coulomb.standard_error < min(
        float(np.sqrt(one.covariance[1, 1])) for one in estimates)


@pytest.mark.medium
def test_recoil_of_the_links_is_accounted_for(
        prototype: Mechanism, lab: Table, excited: Callable[..., Any]) -> None:
    """The recoil changes the inertia by that of the wheel over that of a pair, 0.3 %."""
    links, wheels = excited(
        prototype, lab, SpinAndCoast(prototype, [0], TOP, TORQUE, COAST), 0)
    held = replace(links, angles=np.zeros_like(links.angles))
    right = wheel_estimate(0, links, wheels).inertia
    wrong = wheel_estimate(0, held, wheels).inertia
    assert wrong / right - 1.0 == pytest.approx(-1.2e-4 / 0.039, rel=0.3)


@pytest.mark.medium
def test_unmodelled_error_widens_the_intervals(
        prototype: Mechanism, lab: Table, excited: Callable[..., Any]) -> None:
    """The readings have an oscillation over many samples, which is no white noise; seed 2."""
    links, wheels = excited(
        prototype, lab, SpinAndCoast(prototype, [0], TOP, TORQUE, COAST), 2)
    wobbling = replace(
        links, angles=links.angles + 5e-3 * np.sin(8.0 * links.times)[:, None])
    honest, doubtful = (wheel_estimate(0, signal, wheels) for signal in (links, wobbling))
    # The rms of the residuals doubles, and the autocorrelation grows by far more.
    assert doubtful.covariance[0, 0] > 20.0 * honest.covariance[0, 0]


def cut(wheels: WheelMeasurements, keep: Any) -> WheelMeasurements:
    """Return the ticks of an index."""
    return WheelMeasurements(wheels.times[keep], wheels.angles[keep], wheels.speeds[keep],
                             wheels.efforts[keep])


def test_missing_part_of_the_motion_is_named(
        prototype: Mechanism, lab: Table, excited: Callable[..., Any],
        refuses: Callable[..., Any]) -> None:
    links, wheels = excited(
        prototype, lab, SpinAndCoast(prototype, [1], TOP, TORQUE, 3.0), 0)
    with refuses(CalibrationError, reason='spin-up', name='flywheel_a'):
        wheel_estimate(0, links, wheels)
    driven = np.abs(wheels.efforts[:, 1]) > 0.5 * TORQUE
    with refuses(CalibrationError, reason='coast-down', name='flywheel_b'):
        wheel_estimate(1, links, cut(wheels, driven))
    with refuses(CalibrationError, reason='spin-up', name='flywheel_b'):
        wheel_estimate(1, links, cut(wheels, ~driven))
