# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Excitations: end, limits, and stop near a change point or at a too fast wheel."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fourbar_ros.analysis.calibration.excitation import (
    change_point_margin,
    direction_from_change_points,
    MultiSine,
    SpinAndCoast,
)
from fourbar_ros.analysis.calibration.parameter_estimates import CalibrationError
from fourbar_ros.mechanism import assemble, FLYWHEEL_NAMES, Mechanism
from fourbar_ros.plant import InitialState, Table
import numpy as np
import pytest


@pytest.mark.medium
def test_one_wheel_after_the_other_and_all_come_to_rest(
        prototype: Mechanism, lab: Table, make_bed: Callable[..., Any]) -> None:
    """Only one wheel is driven at a time; seed 0."""
    bed = make_bed(prototype, lab, 0, InitialState())
    bed.follow(SpinAndCoast(prototype, [2, 0], 60.0, 0.02, 2.0))
    for efforts in bed.efforts:
        assert len(efforts) == 1
    driven = [next(iter(efforts)) for efforts in bed.efforts if next(iter(efforts.values()))]
    assert list(dict.fromkeys(driven)) == ['flywheel_c', 'flywheel_a']
    _, wheels = bed.recorded()
    assert np.abs(wheels.speeds[:, [2, 0]]).max() == pytest.approx(60.0, abs=2.0)
    assert (wheels.speeds.min(axis=0)[[0, 2]] < -55.0).all()
    # After braking the motor lag adds some speed within a few ticks.
    assert np.abs(wheels.speeds[-1]).max() < 6.0


@pytest.mark.medium
@pytest.mark.parametrize('wheel', range(4))
@pytest.mark.parametrize('phi_b', [0.9, 1.2, 2.0, 2.2])
def test_first_direction_leads_away_from_change_points(
        prototype: Mechanism, lab: Table, make_bed: Callable[..., Any], wheel: int, phi_b: float
        ) -> None:
    initial = InitialState(link_b=phi_b)
    angles = assemble(prototype, 0.0, phi_b)
    torque = 0.02 * direction_from_change_points(prototype, angles, wheel)
    bed = make_bed(prototype, lab, 0, initial)

    class Push:
        duration_s = 1.0

        def efforts(self, elapsed_s: float, _angles: Any, _speeds: Any) -> dict[str, float] | None:
            return {FLYWHEEL_NAMES[wheel]: torque} if elapsed_s < 1.0 else None
    bed.follow(Push())
    links, _ = bed.recorded()
    known = np.isfinite(links.angles).all(axis=1)
    assert change_point_margin(links.angles[known][-1]) > change_point_margin(angles) + 0.02


@pytest.mark.slow
def test_multi_sine_keeps_the_limit_and_does_not_drift(
        prototype: Mechanism, lab: Table, make_bed: Callable[..., Any]) -> None:
    """Links oscillate about their initial angles; seed 0."""
    bed = make_bed(prototype, lab, 0, InitialState())
    bed.follow(MultiSine(prototype, 20.0, 0.02))
    asked = np.array([[efforts[name] for name in FLYWHEEL_NAMES] for efforts in bed.efforts])
    assert np.abs(asked).max() <= 0.02
    np.testing.assert_array_equal(asked[:, [0, 1]], asked[:, [2, 3]])
    links, _ = bed.recorded()
    swing = np.nanmax(links.angles, axis=0) - np.nanmin(links.angles, axis=0)
    final = np.nanmean(links.angles[-50:], axis=0) - np.nanmean(links.angles[:50], axis=0)
    assert (swing > 0.1).all()
    # The share of momentum lost to bearing friction is at most its share of the torque.
    assert (np.abs(final) < swing).all()


def test_excitation_stops_before_a_change_point(
        prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    excitation = MultiSine(prototype, 20.0, 0.02)
    excitation.efforts(0.0, assemble(prototype, 0.0, 1.0), np.zeros(4))
    with refuses(CalibrationError, reason='change_point', value=pytest.approx(0.1),
                 limit=pytest.approx(np.radians(10.0))):
        excitation.efforts(1.0, assemble(prototype, 0.0, 0.1), np.zeros(4))


def test_links_in_a_jig_may_be_anywhere(prototype: Mechanism) -> None:
    excitation = SpinAndCoast(prototype, [0], 60.0, 0.02, 2.0)
    near = assemble(prototype, 0.0, 0.1)
    for elapsed_s in (0.0, 0.1):
        assert excitation.efforts(elapsed_s, near, np.zeros(4)) is not None


def test_excitation_stops_at_a_too_fast_wheel(
        prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    excitation = MultiSine(prototype, 20.0, 0.02)
    with refuses(CalibrationError, reason='speed', name='flywheel_c', value=280.0, limit=270.0):
        excitation.efforts(0.0, assemble(prototype, 0.0, 1.0), np.array([0.0, 0.0, 280.0, 0.0]))


def test_wheel_that_does_not_turn_is_an_error(
        prototype: Mechanism, refuses: Callable[..., Any]) -> None:
    excitation = SpinAndCoast(prototype, [3], 60.0, 0.02, 2.0)
    pose = assemble(prototype, 0.0, 1.0)
    for elapsed_s in (0.0, 0.5, 1.0):
        excitation.efforts(elapsed_s, pose, np.zeros(4))
    with refuses(CalibrationError, reason='timeout', name='flywheel_d'):
        excitation.efforts(30.0, pose, np.zeros(4))


@pytest.mark.parametrize(('make', 'name', 'limit'), [
    (lambda m: SpinAndCoast(m, [0], 400.0, 0.02, 2.0), 'speed of flywheel_a', 270.0),
    (lambda m: SpinAndCoast(m, [0], 60.0, 0.06, 2.0), 'torque of flywheel_a', 0.05),
    (lambda m: SpinAndCoast(m, [0], 25.0, 0.02, 2.0), 'speed', 30.0),
    (lambda m: MultiSine(m, 20.0, 0.06), 'torque of flywheel_a', 0.05),
    (lambda m: MultiSine(m, 5.0, 0.02), 'duration', 10.0),
])
def test_excitation_beyond_the_limits_is_refused(
        prototype: Mechanism, refuses: Callable[..., Any], make: Callable[[Mechanism], object],
        name: str, limit: float) -> None:
    with refuses(CalibrationError, reason='range', name=name, limit=limit):
        make(replace(prototype))
