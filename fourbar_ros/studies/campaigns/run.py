# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
One run of a campaign: a closed loop, reduced to a row of numbers.

What a metric means is in `METRICS`; they are those of `analysis.metrics`, over the whole script
where that looks at one setpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import nan
import time
from typing import Any, NamedTuple, TYPE_CHECKING

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control.actuation_cost import COPPER, EQ9, WORK
from fourbar_ros.loop import make_loop, run_scenario, Scenario, Step
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies.consistency_statistics import normalised_squares
import numpy as np

if TYPE_CHECKING:
    from fourbar_ros.studies.campaigns.file import Campaign

Row = dict[str, Any]
"""Number, seed, what was drawn, metrics and fate of a run, by column."""

# Over so long a time at the end the final error is averaged [s].
FINAL_WINDOW = 1.0
WALL = 'wall_s'
"""Column of what is not the same every time."""


class Metric(NamedTuple):
    """What a metric measures."""

    unit: str
    sentence: str


METRICS = {
    'tracking_rms_rad': Metric('rad', 'truth minus reference of links a and b since the first '
                               'setpoint, root mean square'),
    'tracking_peak_rad': Metric('rad', 'the largest of these'),
    'final_error_rad': Metric('rad', 'truth minus goal of the last setpoint, mean over the last '
                              'second, the link with the largest; none where the move is not '
                              'over by then'),
    'estimate_rms_rad': Metric('rad', 'estimate minus truth of the four link angles since the '
                               'first setpoint, root mean square'),
    'estimate_peak_rad': Metric('rad', 'the largest of these'),
    'nees_per_degree_of_freedom': Metric('', 'normalised squared error of angles and rates of '
                                         'links a and b, mean over 4; 1 for an estimator that '
                                         'knows its errors'),
    'nis_per_degree_of_freedom': Metric('', 'the same of the innovations'),
    'peak_wheel_speed_rad_s': Metric('rad/s', 'largest speed of a wheel relative to its link'),
    'peak_torque_n_m': Metric('N m', 'largest torque of a motor, mean over a control period'),
    'work_j': Metric('J', 'mechanical work of the motors without regard to sign, since the first '
                     'setpoint'),
    'copper_loss_j': Metric('J', 'heat in the windings, likewise'),
    'eq9_j_s': Metric('J s', 'paper eq. 9, likewise'),
    'speed_margin': Metric('', 'smallest share of its speed limit that a wheel had left'),
}
"""Every metric by the name of its column."""

_SUMS = {'work_j': WORK, 'copper_loss_j': COPPER, 'eq9_j_s': EQ9}


@lru_cache(maxsize=None)
def prepared() -> None:
    """Compile what runs need, once in a process."""
    warm_up()


def do_batch(campaign: Campaign, runs: Sequence[int]) -> list[Row]:
    """Make some runs of a campaign."""
    prepared()
    return [do_run(campaign, run) for run in runs]


def do_run(campaign: Campaign, run: int) -> Row:
    """
    Make a run; one that fails is a row as well.

    :returns: every column; a metric that there is none of is None.
    """
    begin = time.perf_counter()
    drawn = campaign.drawn(run)
    row: Row = {'run': run, 'seed': campaign.seed_of(run)}
    for parameter in campaign.parameters:
        row |= {name: parameter.shown(drawn[name]) for name in parameter.columns}
    row |= dict.fromkeys(METRICS)
    row |= {'armed_at_end': False, 'failure': ''}
    try:
        found, armed, reason = measure(campaign.scenario(run))
        row |= found
        row |= {'armed_at_end': armed, 'failure': reason}
    except (FourbarError, ArithmeticError, np.linalg.LinAlgError) as error:
        row['failure'] = ' '.join(str(error).split()) or type(error).__name__
    row[WALL] = time.perf_counter() - begin
    return row


def lost_run(campaign: Campaign, run: int, reason: str) -> Row:
    """Return the row of a run that nothing is known of but why."""
    drawn = campaign.drawn(run)
    return {'run': run, 'seed': campaign.seed_of(run),
            **{name: parameter.shown(drawn[name]) for parameter in campaign.parameters
               for name in parameter.columns},
            **dict.fromkeys(METRICS), 'armed_at_end': False, 'failure': reason, WALL: None}


def measure(scenario: Scenario) -> tuple[dict[str, float | None], bool, str]:
    """
    Run a scenario and measure it.

    :returns: metrics, None where there is nothing to measure; whether the device was armed at
        the end; why not, '' if nobody wanted it to be.
    :raises FourbarError: the run ended before its end.
    """
    loop = make_loop(scenario)
    steps = list(run_scenario(scenario, loop))
    gate = loop.supervisor.arming
    wanted = scenario.arm_at is not None
    return (_metrics(scenario, steps), gate.armed,
            gate.reason if wanted and not gate.armed else '')


def _metrics(scenario: Scenario, steps: Sequence[Step]) -> dict[str, float | None]:
    truths = [step.samples.truth for step in steps]
    angles = np.array([truth.link_angles for truth in truths if truth is not None])
    rates = np.array([truth.link_rates for truth in truths if truth is not None])
    speeds = np.array([truth.wheel_speeds for truth in truths if truth is not None])
    efforts = np.array([truth.efforts for truth in truths if truth is not None])
    first = scenario.tick_at(scenario.setpoints[0].at) if scenario.setpoints else 0
    found: dict[str, float] = dict.fromkeys(METRICS, nan)

    driven = [n for n in range(first, len(steps)) if steps[n].control is not None]
    if driven:
        controls = [control for n in driven if (control := steps[n].control) is not None]
        errors = wrap_angles(angles[driven][:, :2] - np.array(
            [control.reference_angles for control in controls])[:, :2])
        found['tracking_rms_rad'], found['tracking_peak_rad'] = _rms_and_peak(errors)
        energies = np.array([control.energies for control in controls])
        for name, column in _SUMS.items():
            # A sum that begins anew at a setpoint goes on from there.
            found[name] = float(np.maximum(np.diff(energies[:, column]), 0.0).sum())
    found['final_error_rad'] = _final_error(scenario, angles)

    known = [n for n in range(first, len(steps)) if steps[n].estimate is not None]
    if known:
        estimates = [estimate for n in known if (estimate := steps[n].estimate) is not None]
        angle_errors = wrap_angles(np.array(
            [estimate.link_angles for estimate in estimates]) - angles[known])
        rate_errors = np.array([estimate.link_rates for estimate in estimates]) - rates[known]
        found['estimate_rms_rad'], found['estimate_peak_rad'] = _rms_and_peak(angle_errors)
        squares = normalised_squares(
            np.hstack([angle_errors[:, :2], rate_errors[:, :2]]),
            np.array([estimate.covariance for estimate in estimates]))
        found['nees_per_degree_of_freedom'] = float(squares.mean()) / 4.0
        seen = [estimate.innovation for estimate in estimates
                if estimate.innovation is not None]
        if degrees := sum(innovation.degrees_of_freedom for innovation in seen):
            found['nis_per_degree_of_freedom'] = sum(
                innovation.nis for innovation in seen) / degrees

    found['peak_wheel_speed_rad_s'] = float(np.abs(speeds).max())
    found['peak_torque_n_m'] = float(np.abs(efforts).max())
    found['speed_margin'] = float(
        (1.0 - np.abs(speeds) / scenario.mechanism.motor_speed_limits).min())
    return {name: value if np.isfinite(value) else None for name, value in found.items()}


def _final_error(scenario: Scenario, angles: Array) -> float:
    if not scenario.setpoints:
        return nan
    last = scenario.setpoints[-1]
    over = last.at + (last.duration or scenario.controller.setpoint_duration)
    begin = max(scenario.tick_at(over), scenario.tick_at(scenario.duration - FINAL_WINDOW))
    if begin >= len(angles):
        return nan
    links = [LINK_NAMES.index(name) for name in last.names]
    errors = wrap_angles(angles[begin:, links] - np.array(last.positions))
    return float(np.abs(errors.mean(axis=0)).max())


def _rms_and_peak(errors: Array) -> tuple[float, float]:
    return float(np.sqrt(np.mean(errors ** 2))), float(np.abs(errors).max())
