# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Scalars of the topics `allocation` and `momentum` against physics and the law."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fourbar_ros.control import Controller, ControllerSettings
from fourbar_ros.control.scalars import (
    ALLOCATION,
    allocation_scalars,
    MOMENTUM,
    momentum_scalars,
)
from fourbar_ros.control.tracking_law import MOTOR_SHARE
from fourbar_ros.mechanism import angular_momentum, assemble, Mechanism, reduced_form
from fourbar_ros.mechanism.dynamics import mass_matrix
from fourbar_ros.plant import InitialState
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
Steer = Callable[..., Any]

LINKS = tuple('abcd')
QUIET, NONE = np.zeros(2), np.zeros(4)


def allocation_of(controller: Controller) -> dict[str, float]:
    return dict(zip(ALLOCATION, allocation_scalars(controller).tolist(), strict=True))


def momentum_of(controller: Controller) -> dict[str, float]:
    names, values = momentum_scalars(controller)
    return dict(zip(names, values.tolist(), strict=True))


def ticked(mechanism: Mechanism, angles: Array, rates: Array, speeds: Array,
           **settings: float | str) -> Controller:
    controller = Controller(mechanism, ControllerSettings(**settings))  # type: ignore[arg-type]
    controller.device_armed(True)
    for tick in range(2):
        controller.tick(10 ** 9 + 4_000_000 * tick, angles, rates, QUIET, speeds, NONE)
    return controller


def test_scalars_are_finite_before_the_first_motion(paper: Mechanism) -> None:
    controller = Controller(paper, ControllerSettings())
    controller.tick(10 ** 9, assemble(paper, 0.0, 1.0), NONE, QUIET, NONE, NONE)
    assert np.isfinite(allocation_scalars(controller)).all()
    names, values = momentum_scalars(controller)
    assert names == MOMENTUM[:-1]
    assert np.isfinite(values).all()


@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('linkage', ['uneven', 'paper'])
def test_momenta_are_those_of_the_whole_and_of_the_axes(
    seed: int, linkage: str, request: pytest.FixtureRequest,
) -> None:
    """The momentum of an axis is `A u + G If omega`, in the terms of paper eq. 6."""
    mechanism = request.getfixturevalue(linkage)
    rng = np.random.default_rng(seed)
    angles = assemble(mechanism, 0.3, 0.3 + rng.uniform(0.9, 2.0))
    rates = np.zeros(4)
    rates[:2] = rng.uniform(-0.5, 0.5, 2)
    form = reduced_form(mechanism, angles, rates)
    rates[2:] = form.gamma @ rates[:2]
    speeds = rng.uniform(-50.0, 50.0, 4)
    found = momentum_of(ticked(mechanism, angles, rates, speeds))
    whole = angular_momentum(mechanism, angles, rates, speeds + rates)
    assert found['total_n_m_s'] == pytest.approx(whole, rel=1e-9), f'seed {seed}'
    on_axes = form.mass_matrix @ rates[:2] + form.wheel_map @ (
        mechanism.flywheel_inertias * (speeds + rates))
    np.testing.assert_allclose(
        [found['axis_a_n_m_s'], found['axis_b_n_m_s']], on_axes, rtol=1e-9, atol=1e-18)
    if linkage == 'paper':
        # The pairs of a parallelogram have all momentum.
        assert on_axes.sum() == pytest.approx(whole, rel=1e-9)
    assert found['margin'] == pytest.approx(1.0 - np.abs(speeds).max() / 500.0, rel=1e-12)


def test_pairs_of_a_rhombus_keep_their_momentum(steer: Steer, prototype: Mechanism) -> None:
    """Without friction each pair conserves its momentum; encoders lag by half a tick."""
    steered = steer(prototype, InitialState(), setpoint_duration=2.0)
    steered.controller.setpoint(['link_a', 'link_b'], [0.4, 1.2])
    held = largest = 0.0
    for _ in range(600):
        torques = steered.tick().torques
        largest = max(largest, np.abs(torques).max())
        found = momentum_of(steered.controller)
        # The torques also change between two ticks, by less than 5 %.
        late = 1.05 * 0.5 * 4e-3 * largest
        assert abs(found['axis_a_n_m_s']) <= 2.0 * late + 1e-12
        assert abs(found['axis_b_n_m_s']) <= 2.0 * late + 1e-12
        assert abs(found['total_n_m_s']) <= 4.0 * late + 1e-12
        held = max(held, 2.0 * prototype.flywheel_inertias[0] * np.abs(
            steered.plant.truth().wheel_speeds).max())
    assert held > 50.0 * 2.0 * late


def test_axes_of_another_branch_are_its_pairs(paper: Mechanism) -> None:
    """On the folded branch a turns with b: `T^T (M omega + If (omega + Omega))` of the pairs."""
    angles, rates = np.array([0.1, 0.1, 0.9, 0.9]), np.array([0.2, 0.2, -0.3, -0.3])
    speeds = np.array([10.0, -20.0, 30.0, 5.0])
    controller = ticked(paper, angles, rates, speeds, change_points='choose')
    assert controller.branch == 'folded'
    found = momentum_of(controller)
    momenta = (mass_matrix(angles, paper.constants) @ rates
               + paper.flywheel_inertias * (speeds + rates))
    np.testing.assert_allclose([found['axis_a_n_m_s'], found['axis_b_n_m_s']],
                               [momenta[:2].sum(), momenta[2:].sum()], rtol=1e-12)


def test_scale_and_saturated_wheels(uneven: Mechanism) -> None:
    angles = assemble(uneven, 0.0, 1.0)
    controller = Controller(uneven, ControllerSettings())
    controller.device_armed(True)
    controller.tick(10 ** 9, angles, NONE, QUIET, NONE, NONE)
    assert allocation_of(controller)['scale'] == 1.0
    controller.tick(10 ** 9 + 4_000_000, assemble(uneven, 0.8, 1.2), NONE, QUIET, NONE, NONE)
    found, output = allocation_of(controller), controller.law.output
    assert found['scale'] == output.scale < 1.0
    at_bound = [found[f'saturated_{link}'] for link in LINKS]
    # All torques are scaled; one wheel at its bound limits them.
    assert sum(at_bound) == 1.0
    wheel = at_bound.index(1.0)
    assert abs(output.torques[wheel]) == pytest.approx(
        MOTOR_SHARE['effort'] * 1e-4, rel=1e-6)
    assert found['branch_hold'] == 0.0
    form = reduced_form(uneven, assemble(uneven, 0.8, 1.2), NONE)
    assert found['condition_number'] == pytest.approx(np.linalg.cond(form.mass_matrix), rel=1e-9)
    assert [found[f'verdict_{link}'] for link in LINKS] == [0.0] * 4


@pytest.mark.parametrize('theta', [0.0, 0.02, 3.14])
def test_hold_at_a_change_point_is_reported(theta: float, paper: Mechanism) -> None:
    angles = np.array([0.0, theta, 0.0, theta])
    found = allocation_of(ticked(paper, angles, NONE, NONE))
    assert found['branch_hold'] == 1.0
    assert np.isfinite(list(found.values())).all()


def test_null_speeds_move_no_axis(paper: Mechanism, uneven: Mechanism) -> None:
    """For equal wheels on a rhombus they are half of the difference within each pair."""
    angles = assemble(paper, 0.0, 1.0)
    found = allocation_of(ticked(paper, angles, NONE, np.array([100.0, -20.0, 40.0, 60.0])))
    np.testing.assert_allclose(
        [found[f'null_speed_{link}_rad_s'] for link in LINKS], [30.0, -40.0, -30.0, 40.0],
        rtol=1e-12)
    angles = assemble(uneven, 0.0, 1.2)
    speeds = np.array([100.0, -20.0, 40.0, 60.0])
    found = allocation_of(ticked(uneven, angles, NONE, speeds))
    null = np.array([found[f'null_speed_{link}_rad_s'] for link in LINKS])
    wheel_map = reduced_form(uneven, angles, NONE).wheel_map
    momenta = uneven.flywheel_inertias * null
    np.testing.assert_allclose(wheel_map @ momenta, 0.0, atol=1e-12 * np.abs(momenta).max())
    assert np.abs(null).max() > 1.0


def test_time_left_is_present_only_if_it_is_finite(prototype: Mechanism) -> None:
    speeds = np.full(4, 50.0)
    controller = ticked(prototype, assemble(prototype, 0.0, 1.0), NONE, speeds)
    assert 'time_left_s' not in momentum_of(controller)
    # One long period at rest settles the mean.
    controller.momentum.reset(speeds)
    controller.momentum.update(100.0, speeds, NONE, NONE)
    controller.momentum.drift[:] = [5.0, 0.0, 0.0, 0.0]
    assert momentum_of(controller)['time_left_s'] == pytest.approx(50.0)
