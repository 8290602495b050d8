# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Runs of the consistency study, each reduced to sums over its steps.

The sums of several runs add up, so their number does not affect the memory.
"""

from __future__ import annotations

from math import ceil, sqrt

from fourbar_ros.estimation.filter import LinkageFilter, TORQUE_WALK_AGE
from fourbar_ros.estimation.retrodiction import INITIAL_ANGLE_SIGMA, INITIAL_RATE_SIGMA
from fourbar_ros.loop import make_loop, run_scenario, Scenario, Step
from fourbar_ros.mechanism import JOINT_LINKS, LINK_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.studies.consistency_results import FREE, LAGS, RunSums
from fourbar_ros.studies.estimator_statistics import (
    lagged_products,
    normalised_squares,
    posterior_bound,
)
import numpy as np
from numpy.typing import NDArray

# Indices of phi_a, phi_b, omega_a, omega_b and the disturbance torques in the filter's state.
KEPT = np.array([0, 1, 4, 5, 8, 9])
# Time after a change of the friction regime in which the estimate may lag [s].
AFTER_REVERSAL = 0.25


def execute(scenario: Scenario) -> RunSums:
    """
    Run a scenario.

    :raises FourbarError: it cannot be run.
    """
    loop = make_loop(scenario)
    named = False
    steps: list[Step] = []
    for step in run_scenario(scenario, loop):
        steps.append(step)
        named = named or bool(loop.estimator.sensor_faults())
    truths = [step.samples.truth for step in steps]
    angles = np.array([truth.link_angles for truth in truths if truth is not None])
    rates = np.array([truth.link_rates for truth in truths if truth is not None])
    speeds = np.array([truth.wheel_speeds for truth in truths if truth is not None])
    walked = np.array([truth.random_walk_torques for truth in truths if truth is not None])

    errors, link_errors = np.full((len(steps), 6), np.nan), np.full((len(steps), 8), np.nan)
    covariances = np.full((len(steps), FREE, FREE), np.nan)
    nis, degrees = np.zeros(len(steps)), np.zeros(len(steps), np.int64)
    innovations = np.full((len(steps), len(LINK_NAMES)), np.nan)
    for n, step in enumerate(steps):
        if (estimate := step.estimate) is None:
            continue
        link_errors[n, :4] = estimate.link_angles - angles[n]
        link_errors[n, 4:] = estimate.link_rates - rates[n]
        errors[n, :FREE] = link_errors[n, [0, 1, 4, 5]]
        errors[n, FREE:] = estimate.disturbance - walked[n]
        covariances[n] = estimate.covariance
        if (seen := estimate.innovation) is not None:
            nis[n], degrees[n] = seen.nis, seen.degrees_of_freedom
            for sensor, value, square, used in zip(
                    seen.sensors, seen.values, seen.sample_nis, seen.used):
                if used and sensor < len(LINK_NAMES):
                    innovations[n, sensor] = np.copysign(sqrt(square), value)
    known = np.isfinite(errors[:, 0])
    nees = np.zeros(len(steps))
    nees[known] = normalised_squares(errors[known, :FREE], covariances[known])
    window = round(AFTER_REVERSAL * scenario.plant.rate)
    calm = known & ~near_reversals(rates, scenario.table.joints.smoothing, window)
    products, pairs = lagged_products(innovations, LAGS)
    return RunSums(
        1, int(named), known.astype(np.int64), np.nan_to_num(errors) ** 2,
        np.nan_to_num(link_errors) ** 2, nees, calm.astype(np.int64), np.where(calm, nees, 0.0),
        nis, degrees, products, pairs,
        *information(scenario, np.hstack([angles, rates, walked]), speeds))


def near_reversals(link_rates: Array, slip: float, window: int) -> NDArray[np.bool_]:
    """
    Return the steps shortly after a change of the friction regime of a joint.

    A joint slides in one direction, in the other, or sticks. Friction jumps when the regime
    changes. The creep of a sticking joint may change sign without a jump, and does not count.

    :param link_rates: (steps, 4) [rad/s].
    :param slip: relative rate below which a joint sticks [rad/s].
    :param window: number of steps from the change on.
    :returns: (steps,).
    """
    relative = np.stack([link_rates[:, second] - link_rates[:, first]
                         for first, second in JOINT_LINKS], axis=1)
    regime = np.where(np.abs(relative) > slip, np.sign(relative), 0.0)
    changed = np.zeros(len(regime), np.int64)
    changed[1:] = (np.diff(regime, axis=0) != 0.0).any(axis=1)
    changes = np.cumsum(changed)
    before = np.concatenate([np.zeros(window, np.int64), changes])[:len(changes)]
    near: NDArray[np.bool_] = changes > before
    return near


def information(scenario: Scenario, states: Array, wheel_speeds: Array
                ) -> tuple[Array, Array, Array, Array]:
    """
    Evaluate the information about the states along a trajectory, by the model of the filter.

    :param states: (steps, 10) true angles and rates of the links, and disturbance torques.
    :param wheel_speeds: (steps, 4) true, relative to the links [rad/s].
    :returns: F' Q^-1 F, F' Q^-1 and Q^-1 from step to step, H' R^-1 H at each step, of
        phi_a, phi_b, omega_a, omega_b and both torques.
    """
    mechanism, settings = scenario.mechanism, scenario.estimator
    period = scenario.plant.period_ns * 1e-9
    linkage = LinkageFilter(mechanism, states[0, :4], 1e-6, 1e-6, settings.process_noise)
    torques = mechanism.flywheel_inertias * np.diff(wheel_speeds, axis=0) / period
    some_covariance = linkage.P.copy()
    steps, kept = len(states), np.ix_(KEPT, KEPT)
    transitions, noises = np.empty((steps - 1, 6, 6)), np.empty((steps - 1, 6, 6))
    seen = np.zeros((steps, 6, 6))
    # Losses are independent, so the mean information is the share that is not lost.
    weight = (1.0 - scenario.table.link_sensors.dropout) / settings.angle_variance
    for n, state in enumerate(states):
        gamma = gamma_matrix(state[:4], mechanism.constants.lengths)
        seen[n, :2, :2] = weight * (np.eye(2) + gamma.T @ gamma)
        if n < steps - 1:
            linkage.x, linkage.P = state.copy(), some_covariance.copy()
            linkage.predict(period, torques[n])
            transitions[n], noises[n] = linkage.F[kept], linkage.Q[kept]
    driven: Array = np.asarray(np.linalg.inv(noises), dtype=np.float64)
    crossed: Array = np.swapaxes(transitions, 1, 2) @ driven
    carried: Array = crossed @ transitions
    return carried, crossed, driven, seen


def bound_of(scenario: Scenario, sums: RunSums) -> Array:
    """
    Return the bound of the mean square errors (steps, 6, 6), NaN before the first one.

    It starts like the filter, at the first measurement.
    """
    settings = scenario.estimator
    start = np.diag(1.0 / np.repeat([
        INITIAL_ANGLE_SIGMA ** 2, INITIAL_RATE_SIGMA ** 2,
        TORQUE_WALK_AGE * settings.disturbance_walk ** 2], 2))
    late = ceil(scenario.table.link_sensors.latency * scenario.plant.rate - 1e-6)
    carried, crossed, driven, seen = (each / sums.runs for each in (
        sums.carried, sums.crossed, sums.driven, sums.seen))
    return posterior_bound(start, carried, crossed, driven, seen, late)
