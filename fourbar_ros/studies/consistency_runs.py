# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Runs of the closed loop, and what of them tells whether the estimator is consistent.

A run is reduced to sums over its steps, which add up over runs whatever their number.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import ceil, sqrt

from fourbar_ros.estimation.estimator import INITIAL_ANGLE_SIGMA, INITIAL_RATE_SIGMA
from fourbar_ros.estimation.filter import LinkageFilter, WALKED_BEFORE
from fourbar_ros.loop import make_loop, run_scenario, Scenario, Step
from fourbar_ros.mechanism import JOINT_LINKS, LINK_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.studies.estimator_statistics import (
    lagged_products,
    normalised_squares,
    posterior_bound,
)
import numpy as np
from numpy.typing import NDArray

# phi_a, phi_b, omega_a, omega_b and the two disturbance torques, in the state of the filter.
KEPT = np.array([0, 1, 4, 5, 8, 9])
FREE = 4

# Innovations are compared with those up to so many measurements later.
LAGS = 25

# How long friction in the joints keeps the estimate busy after it has changed its direction [s].
AFTER_REVERSAL = 0.25


@dataclass(frozen=True, eq=False)
class Tally:
    """
    Sums over runs, step by step.

    :param runs: how many.
    :param named: in how many of them a sensor was named faulty at any time.
    :param estimates: (steps,) in how many there was an estimate.
    :param squares: (steps, 6) squared errors of phi_a, phi_b [rad^2], omega_a, omega_b
        [rad^2/s^2] and the disturbance torques, beside those that walk [(N m)^2].
    :param link_squares: (steps, 8) squared errors of angles and rates of the four links.
    :param nees: (steps,) of the first four of the six.
    :param calm: (steps,) in how many runs there was an estimate, and no reversal of friction.
    :param calm_nees: (steps,) NEES in these.
    :param nis, degrees: (steps,) and its degrees of freedom.
    :param products, pairs: (LAGS + 1, 4) of innovations, see `consistency.lagged_products`.
    :param carried, crossed, driven, seen: see `consistency.posterior_bound`, of all six.
    """

    runs: int
    named: int
    estimates: NDArray[np.int64]
    squares: Array
    link_squares: Array
    nees: Array
    calm: NDArray[np.int64]
    calm_nees: Array
    nis: Array
    degrees: NDArray[np.int64]
    products: Array
    pairs: NDArray[np.int64]
    carried: Array
    crossed: Array
    driven: Array
    seen: Array

    def __add__(self, other: Tally) -> Tally:
        """Add the runs of another one, of the same steps."""
        return Tally(*(getattr(self, item.name) + getattr(other, item.name)
                       for item in fields(Tally)))


def follow(scenario: Scenario) -> Tally:
    """
    Run a scenario, once.

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
    walked = np.array([truth.walked_torques for truth in truths if truth is not None])

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
                    seen.sensors, seen.values, seen.squares, seen.used):
                if used and sensor < len(LINK_NAMES):
                    innovations[n, sensor] = np.copysign(sqrt(square), value)
    known = np.isfinite(errors[:, 0])
    nees = np.zeros(len(steps))
    nees[known] = normalised_squares(errors[known, :FREE], covariances[known])
    window = round(AFTER_REVERSAL * scenario.plant.rate)
    calm = known & ~near_reversals(rates, scenario.table.joints.smoothing, window)
    products, pairs = lagged_products(innovations, LAGS)
    return Tally(
        1, int(named), known.astype(np.int64), np.nan_to_num(errors) ** 2,
        np.nan_to_num(link_errors) ** 2, nees, calm.astype(np.int64), np.where(calm, nees, 0.0),
        nis, degrees, products, pairs,
        *information(scenario, np.hstack([angles, rates, walked]), speeds))


def near_reversals(link_rates: Array, slip: float, window: int) -> NDArray[np.bool_]:
    """
    Tell which steps follow soon upon a change of friction in a joint.

    A joint slides one way, or the other, or it sticks. Friction is torn from one value to another
    when it goes from one of these to another. A joint that goes on sticking gives no such jolt
    however often its creep changes sign, and so does not count.

    :param link_rates: (steps, 4) [rad/s].
    :param slip: a joint that turns more slowly sticks [rad/s].
    :param window: for so many steps from the change on.
    :returns: (steps,).
    """
    relative = np.stack([link_rates[:, second] - link_rates[:, first]
                         for first, second in JOINT_LINKS], axis=1)
    way = np.where(np.abs(relative) > slip, np.sign(relative), 0.0)
    changed = np.zeros(len(way), np.int64)
    changed[1:] = (np.diff(way, axis=0) != 0.0).any(axis=1)
    so_far = np.cumsum(changed)
    before = np.concatenate([np.zeros(window, np.int64), so_far])[:len(so_far)]
    near: NDArray[np.bool_] = so_far > before
    return near


def information(scenario: Scenario, states: Array, wheel_speeds: Array
                ) -> tuple[Array, Array, Array, Array]:
    """
    Evaluate what a trajectory lets be known, as the filter has it.

    :param states: (steps, 10) true angles and rates of the links, and disturbance torques.
    :param wheel_speeds: (steps, 4) true, relative to the links [rad/s].
    :returns: F' Q^-1 F, F' Q^-1 and Q^-1 from step to step, H' R^-1 H at each step, of
        phi_a, phi_b, omega_a, omega_b and both torques.
    """
    mechanism, settings = scenario.mechanism, scenario.estimator
    period = scenario.plant.period_ns * 1e-9
    linkage = LinkageFilter(mechanism, states[0, :4], 1e-6, 1e-6, settings.randomness)
    torques = mechanism.flywheel_inertias * np.diff(wheel_speeds, axis=0) / period
    some_covariance = linkage.P.copy()
    steps, kept = len(states), np.ix_(KEPT, KEPT)
    transitions, noises = np.empty((steps - 1, 6, 6)), np.empty((steps - 1, 6, 6))
    seen = np.zeros((steps, 6, 6))
    # Independent of each other, so the share that is not lost is what they tell on the mean.
    weight = (1.0 - scenario.table.link_sensors.dropout) / settings.angle_variance
    for n, state in enumerate(states):
        gamma = gamma_matrix(state[:4], mechanism.constants.lengths)
        seen[n, :2, :2] = weight * (np.eye(2) + gamma.T @ gamma)
        if n < steps - 1:
            linkage.x, linkage.P = state.copy(), some_covariance.copy()
            linkage.move(period, torques[n])
            transitions[n], noises[n] = linkage.F[kept], linkage.Q[kept]
    driven: Array = np.asarray(np.linalg.inv(noises), dtype=np.float64)
    crossed: Array = np.swapaxes(transitions, 1, 2) @ driven
    carried: Array = crossed @ transitions
    return carried, crossed, driven, seen


def bound_of(scenario: Scenario, tally: Tally) -> Array:
    """
    Evaluate the bound of the mean square errors: (steps, 6, 6), NaN before there is any.

    It begins where the filter does, at the first measurement.
    """
    settings = scenario.estimator
    start = np.diag(1.0 / np.repeat([
        INITIAL_ANGLE_SIGMA ** 2, INITIAL_RATE_SIGMA ** 2,
        WALKED_BEFORE * settings.disturbance_walk ** 2], 2))
    late = ceil(scenario.table.link_sensors.latency * scenario.plant.rate - 1e-6)
    carried, crossed, driven, seen = (sums / tally.runs for sums in (
        tally.carried, tally.crossed, tally.driven, tally.seen))
    return posterior_bound(start, carried, crossed, driven, seen, late)
