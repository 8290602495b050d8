# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A run of a campaign: a closed loop, reduced to a row of the metrics of `campaign_metrics`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import nan
import time
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control.actuation_cost_sums import COPPER, EQ9, WORK
from fourbar_ros.loop import make_loop, run_scenario, Scenario, Step
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns.campaign import Campaign
from fourbar_ros.studies.campaigns.campaign_metrics import METRICS
from fourbar_ros.studies.campaigns.versions import difference, versions
from fourbar_ros.studies.estimator_statistics import normalised_squares
import numpy as np

# Number, seed, drawn values, metrics and failure of a run, by column.
Row = dict[str, Any]

# Length of the interval at the end over which the final error is averaged [s].
FINAL_WINDOW = 1.0
# Column of the duration of the computation, the only one that differs between repetitions.
WALL = 'wall_s'


_COSTS = {'work_j': WORK, 'copper_loss_j': COPPER, 'eq9_j_s': EQ9}


@lru_cache(maxsize=None)
def compile_kernels() -> None:
    """Compile the kernels that runs need, once per process."""
    warm_up()


def execute_run(campaign: Campaign, run: int) -> Row:
    """
    Execute a run; a failed one is a row as well.

    :returns: every column; an undefined metric is None.
    :raises CampaignError: this process has other versions than the campaign, as a worker of a
        cluster that came after the check.
    """
    if differs := difference(campaign.versions, versions()):
        raise CampaignError(f'a worker that came later has other versions: {differs}')
    compile_kernels()
    begin = time.perf_counter()
    row = empty_row(campaign, run)
    try:
        metrics, armed, reason = measure(campaign.scenario(run))
        row |= {**metrics, 'armed_at_end': armed, 'failure': reason}
    except (FourbarError, ArithmeticError, np.linalg.LinAlgError) as error:
        row['failure'] = ' '.join(str(error).split()) or type(error).__name__
    row[WALL] = time.perf_counter() - begin
    return row


def empty_row(campaign: Campaign, run: int, failure: str = '') -> Row:
    """Return the row of a run without metrics."""
    return {**campaign.drawn_row(run), **dict.fromkeys(METRICS), 'armed_at_end': False,
            'failure': failure, WALL: None}


def measure(scenario: Scenario) -> tuple[dict[str, float | None], bool, str]:
    """
    Run a scenario and compute its metrics.

    :returns: metrics, None where undefined; whether the device was armed at the end; why it was
        not, '' if the scenario never arms it.
    :raises FourbarError: the run ended early.
    """
    loop = make_loop(scenario)
    steps = list(run_scenario(scenario, loop))
    gate = loop.supervisor.arming
    expected = scenario.arm_at is not None
    return (_metrics(scenario, steps), gate.armed,
            gate.reason if expected and not gate.armed else '')


def _metrics(scenario: Scenario, steps: Sequence[Step]) -> dict[str, float | None]:
    truths = [truth for step in steps if (truth := step.samples.truth) is not None]
    angles = np.array([truth.link_angles for truth in truths])
    rates = np.array([truth.link_rates for truth in truths])
    speeds = np.array([truth.wheel_speeds for truth in truths])
    efforts = np.array([truth.efforts for truth in truths])
    first = scenario.tick_at(scenario.setpoints[0].at) if scenario.setpoints else 0
    metrics: dict[str, float] = dict.fromkeys(METRICS, nan)

    controlled = [(tick, step.control) for tick, step in enumerate(steps)
                  if tick >= first and step.control is not None]
    if controlled:
        ticks = [tick for tick, _ in controlled]
        references = np.array([control.reference_angles for _, control in controlled])
        metrics['tracking_rms_rad'], metrics['tracking_peak_rad'] = _rms_and_peak(
            wrap_angles(angles[ticks, :2] - references[:, :2]))
        costs = np.array([control.energies for _, control in controlled])
        for name, column in _COSTS.items():
            # A sum restarts from zero at each setpoint.
            metrics[name] = float(np.maximum(np.diff(costs[:, column]), 0.0).sum())
    metrics['final_error_rad'] = _final_error(scenario, angles)

    estimated = [(tick, step.estimate) for tick, step in enumerate(steps)
                 if tick >= first and step.estimate is not None]
    if estimated:
        ticks = [tick for tick, _ in estimated]
        angle_errors = wrap_angles(np.array(
            [estimate.link_angles for _, estimate in estimated]) - angles[ticks])
        rate_errors = np.array([estimate.link_rates for _, estimate in estimated]) - rates[ticks]
        metrics['estimate_rms_rad'], metrics['estimate_peak_rad'] = _rms_and_peak(angle_errors)
        nees = normalised_squares(
            np.hstack([angle_errors[:, :2], rate_errors[:, :2]]),
            np.array([estimate.covariance for _, estimate in estimated]))
        metrics['nees_per_degree_of_freedom'] = float(nees.mean()) / 4.0
        innovations = [estimate.innovation for _, estimate in estimated
                       if estimate.innovation is not None]
        if degrees := sum(innovation.degrees_of_freedom for innovation in innovations):
            metrics['nis_per_degree_of_freedom'] = sum(
                innovation.nis for innovation in innovations) / degrees

    metrics['peak_wheel_speed_rad_s'] = float(np.abs(speeds).max())
    metrics['peak_torque_n_m'] = float(np.abs(efforts).max())
    metrics['speed_margin'] = float(
        (1.0 - np.abs(speeds) / scenario.mechanism.motor_speed_limits).min())
    return {name: value if np.isfinite(value) else None for name, value in metrics.items()}


def _final_error(scenario: Scenario, angles: Array) -> float:
    if not scenario.setpoints:
        return nan
    last = scenario.setpoints[-1]
    end_of_motion = last.at + (last.duration or scenario.controller.setpoint_duration)
    begin = max(scenario.tick_at(end_of_motion),
                scenario.tick_at(scenario.duration - FINAL_WINDOW))
    if begin >= len(angles):
        return nan
    links = [LINK_NAMES.index(name) for name in last.names]
    errors = wrap_angles(angles[begin:, links] - np.array(last.positions))
    return float(np.abs(errors.mean(axis=0)).max())


def _rms_and_peak(errors: Array) -> tuple[float, float]:
    return float(np.sqrt(np.mean(errors ** 2))), float(np.abs(errors).max())
