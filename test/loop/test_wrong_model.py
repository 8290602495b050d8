# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Tracking errors and behaviour at rest of the prototype with a model that is 5 % wrong."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from fourbar_ros.control import Controller
from fourbar_ros.estimation import Estimator
from fourbar_ros.loop import (
    ClosedLoop,
    load_scenario,
    make_loop,
    run_scenario,
    ScriptedSetpoint,
)
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]

BEGIN, DURATION, SETTLING, REST = 0.4, 10.0, 1.0, 10.0
RATE = 250.0
LARGEST_RMS, LARGEST_AT_THE_END, LARGEST_SWING = 0.15, 0.1, 0.12


def tracking(links: float, wheels: float, by: tuple[float, float]) -> Array:
    """
    Run one move and a rest on the table with friction, drag, tilt and sensor latency.

    :param links, wheels: inertias of the model as shares of the true ones.
    :param by: travel of links a and b [rad].
    :returns: reference minus true angles (ticks, 4) [deg].
    """
    scenario = load_scenario('prototype')
    true = scenario.mechanism
    start = scenario.initial.link_a, scenario.initial.link_b
    scenario = replace(
        scenario, duration=BEGIN + DURATION + SETTLING + REST,
        setpoints=(ScriptedSetpoint(BEGIN, ('link_a', 'link_b'), (
            start[0] + by[0], start[1] + by[1]), DURATION),))
    wrong = replace(true, link_inertias=links * true.link_inertias,
                    flywheel_inertias=wheels * true.flywheel_inertias)
    loop = ClosedLoop(make_loop(scenario).supervisor, Estimator(true, scenario.estimator),
                      Controller(wrong, scenario.controller))
    errors = np.full((scenario.ticks, 4), np.nan)
    for tick, step in enumerate(run_scenario(scenario, loop)):
        if step.control is not None and step.samples.truth is not None:
            errors[tick] = step.control.reference_angles - step.samples.truth.link_angles
    assert loop.controller.mode == 'hold'
    assert loop.controller.saturated == 0
    assert loop.supervisor.arming.armed
    return np.degrees(errors)


@pytest.mark.slow
@pytest.mark.parametrize('by', [(pi / 2, pi / 2), (0.0, pi / 4)], ids=['whole', 'configuration'])
@pytest.mark.parametrize(('links', 'wheels'), [(1.05, 0.95), (0.95, 1.05)])
def test_errors_stay_small_and_at_rest_there_is_no_limit_cycle(
    links: float, wheels: float, by: tuple[float, float],
) -> None:
    """The two inertias have errors of opposite signs, which is the largest torque error."""
    errors = tracking(links, wheels, by)
    begin, end = round((BEGIN + 0.01) * RATE), round((BEGIN + DURATION + SETTLING) * RATE)
    assert np.sqrt((errors[begin:end] ** 2).mean(axis=0)).max() <= LARGEST_RMS
    resting = errors[end:]
    assert len(resting) >= REST * RATE
    assert np.abs(resting).max() <= LARGEST_AT_THE_END
    assert np.ptp(resting, axis=0).max() <= LARGEST_SWING
