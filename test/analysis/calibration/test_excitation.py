# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Excitations end by themselves, keep the limits, and stop where it would go too far."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fourbar_ros.analysis.calibration.excitation import (
    away_from_change_points,
    clearance,
    MultiSine,
    SpinAndCoast,
)
from fourbar_ros.analysis.calibration.quantity import CalibrationError
from fourbar_ros.mechanism import assemble, FLYWHEEL_NAMES, Mechanism
from fourbar_ros.plant import InitialState, Table
import numpy as np
import pytest


def test_one_wheel_after_the_other_and_all_come_to_rest(
        prototype: Mechanism, lab: Table, make_bed: Callable[..., Any]) -> None:
    """Seed 0; while a wheel has its turn no other is driven."""
    bed = make_bed(prototype, lab, 0, InitialState())
    bed.follow(SpinAndCoast(prototype, [2, 0], 60.0, 0.02, 2.0))
    for efforts in bed.efforts:
        assert len(efforts) == 1
    driven = [next(iter(efforts)) for efforts in bed.efforts if next(iter(efforts.values()))]
    assert list(dict.fromkeys(driven)) == ['flywheel_c', 'flywheel_a']
    _, wheels = bed.recorded()
    assert np.abs(wheels.speeds[:, [2, 0]]).max() == pytest.approx(60.0, abs=2.0)
    assert (wheels.speeds.min(axis=0)[[0, 2]] < -55.0).all()
    # Rest is where braking ends, and what the motor's lag still adds within a few ticks.
    assert np.abs(wheels.speeds[-1]).max() < 6.0


@pytest.mark.parametrize('wheel', range(4))
@pytest.mark.parametrize('phi_b', [0.9, 1.2, 2.0, 2.2])
def test_first_direction_leads_away_from_change_points(
        prototype: Mechanism, lab: Table, make_bed: Callable[..., Any], wheel: int, phi_b: float
        ) -> None:
    initial = InitialState(link_b=phi_b)
    angles = assemble(prototype, 0.0, phi_b)
    torque = 0.02 * away_from_change_points(prototype, angles, wheel)
    bed = make_bed(prototype, lab, 0, initial)

    class Push:
        duration_s = 1.0

        def efforts(self, elapsed_s: float, _angles: Any, _speeds: Any) -> dict[str, float] | None:
            return {FLYWHEEL_NAMES[wheel]: torque} if elapsed_s < 1.0 else None
    bed.follow(Push())
    links, _ = bed.recorded()
    known = np.isfinite(links.angles).all(axis=1)
    assert clearance(links.angles[known][-1]) > clearance(angles) + 0.02


def test_multi_sine_keeps_the_limit_and_does_not_drift(
        prototype: Mechanism, lab: Table, make_bed: Callable[..., Any]) -> None:
    """Links swing about where they were; seed 0."""
    bed = make_bed(prototype, lab, 0, InitialState())
    bed.follow(MultiSine(prototype, 20.0, 0.02))
    asked = np.array([[efforts[name] for name in FLYWHEEL_NAMES] for efforts in bed.efforts])
    assert np.abs(asked).max() <= 0.02
    np.testing.assert_array_equal(asked[:, [0, 1]], asked[:, [2, 3]])
    links, _ = bed.recorded()
    swing = np.nanmax(links.angles, axis=0) - np.nanmin(links.angles, axis=0)
    final = np.nanmean(links.angles[-50:], axis=0) - np.nanmean(links.angles[:50], axis=0)
    assert (swing > 0.1).all()
    # Friction of the bearings takes a share of the momentum, no more than it is of the torque.
    assert (np.abs(final) < swing).all()


def test_change_point_ahead_stops_it(prototype: Mechanism) -> None:
    excitation = MultiSine(prototype, 20.0, 0.02)
    excitation.efforts(0.0, assemble(prototype, 0.0, 1.0), np.zeros(4))
    with pytest.raises(CalibrationError, match='within 5.7 deg of a line, limit 10.0 deg'):
        excitation.efforts(1.0, assemble(prototype, 0.0, 0.1), np.zeros(4))


def test_links_in_a_jig_may_be_anywhere(prototype: Mechanism) -> None:
    excitation = SpinAndCoast(prototype, [0], 60.0, 0.02, 2.0)
    near = assemble(prototype, 0.0, 0.1)
    for elapsed_s in (0.0, 0.1):
        assert excitation.efforts(elapsed_s, near, np.zeros(4)) is not None


def test_wheel_that_runs_too_fast_stops_it(prototype: Mechanism) -> None:
    excitation = MultiSine(prototype, 20.0, 0.02)
    with pytest.raises(CalibrationError, match='flywheel_c reached 280 rad/s, limit 270 rad/s'):
        excitation.efforts(0.0, assemble(prototype, 0.0, 1.0), np.array([0.0, 0.0, 280.0, 0.0]))


def test_wheel_that_does_not_turn_is_given_up(prototype: Mechanism) -> None:
    excitation = SpinAndCoast(prototype, [3], 60.0, 0.02, 2.0)
    pose = assemble(prototype, 0.0, 1.0)
    for elapsed_s in (0.0, 0.5, 1.0):
        excitation.efforts(elapsed_s, pose, np.zeros(4))
    with pytest.raises(CalibrationError, match='flywheel_d did not reach its speed'):
        excitation.efforts(30.0, pose, np.zeros(4))


@pytest.mark.parametrize(('make', 'complaint'), [
    (lambda m: SpinAndCoast(m, [0], 400.0, 0.02, 2.0), 'speed of flywheel_a must lie between'),
    (lambda m: SpinAndCoast(m, [0], 60.0, 0.06, 2.0), 'torque of flywheel_a must lie between'),
    (lambda m: SpinAndCoast(m, [0], 25.0, 0.02, 2.0), 'must be 30 rad/s at least'),
    (lambda m: MultiSine(m, 20.0, 0.06), 'torque of flywheel_a must lie between'),
    (lambda m: MultiSine(m, 5.0, 0.02), 'must last 10 s at least'),
])
def test_what_the_motors_have_not_is_refused(
        prototype: Mechanism, make: Callable[[Mechanism], object], complaint: str) -> None:
    with pytest.raises(CalibrationError, match=complaint):
        make(replace(prototype))
