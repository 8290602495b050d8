# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Results of the consistency study: sums over the runs of a case, and statistics of these."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from math import nan
from typing import Any

from fourbar_ros.loop import Scenario
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies.estimator_statistics import (
    autocorrelation,
    chi_square_bounds,
    share_inside,
)
import numpy as np
from numpy.typing import NDArray

# Number of mechanical states: phi_a, phi_b, omega_a, omega_b.
FREE = 4
# Largest lag of the autocorrelation of innovations [measurements].
LAGS = 25
# Time after which the initial error no longer counts in rms errors [s].
SETTLED_AT = 1.0


@dataclass(frozen=True, eq=False)
class RunSums:
    """
    Sums over runs, step by step.

    :param runs: number of runs.
    :param named: number of runs in which a sensor was reported as faulty.
    :param estimates: (steps,) number of runs with an estimate.
    :param squares: (steps, 6) squared errors of phi_a, phi_b [rad^2], omega_a, omega_b
        [rad^2/s^2] and the disturbance torques, against the random-walk torques [(N m)^2].
    :param link_squares: (steps, 8) squared errors of angles and rates of the four links.
    :param nees: (steps,) of the first four of the six.
    :param calm: (steps,) number of runs with an estimate, outside friction reversals.
    :param calm_nees: (steps,) NEES in these runs.
    :param nis, degrees: (steps,) NIS and its degrees of freedom.
    :param products, pairs: (LAGS + 1, 4) of innovations, see
        `estimator_statistics.lagged_products`.
    :param carried, crossed, driven, seen: see `estimator_statistics.posterior_bound`, of all six.
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

    def __add__(self, other: RunSums) -> RunSums:
        """Add the sums over other runs with the same steps."""
        return RunSums(*(getattr(self, item.name) + getattr(other, item.name)
                       for item in fields(RunSums)))


@dataclass(frozen=True)
class ConsistencyCase:
    """
    Runs of one kind.

    :param name: in JSON and tables.
    :param title: in figure and tables.
    :param scenario: of the runs, except for the seed.
    """

    name: str
    title: str
    scenario: Scenario

    @property
    def matched(self) -> bool:
        """Whether the torques that act follow the process noise model of the filter."""
        return self.scenario.table.disturbance.torque_walk > 0.0

    @property
    def tuned(self) -> bool:
        """Whether the tuning of the prototype has limits in this case."""
        return self.name in ('prototype', 'reshaping')


@dataclass(frozen=True, eq=False)
class CaseResult:
    """
    Statistics of the runs of a case.

    :param case: the case.
    :param sums: over its runs.
    :param bounds: (steps, 6, 6) posterior Cramer-Rao bound of the errors.
    """

    case: ConsistencyCase
    sums: RunSums
    bounds: Array

    @cached_property
    def times(self) -> Array:
        """Time of each step since the first tick (steps,) [s]."""
        times: Array = np.arange(len(self.sums.estimates)) / self.case.scenario.plant.rate
        return times

    @cached_property
    def bound(self) -> Array:
        """Posterior Cramer-Rao bound of the mean square error of each state (steps, 6)."""
        bound: Array = np.diagonal(self.bounds, axis1=1, axis2=2)
        return bound

    @cached_property
    def mean_squares(self) -> Array:
        """Mean square error of each state (steps, 6)."""
        return _per(self.sums.squares, self.sums.estimates[:, np.newaxis])

    @cached_property
    def ratios(self) -> Array:
        """Rms error over its bound (6,), all steps with equal weight."""
        shares = self.mean_squares / self.bound
        known = np.isfinite(shares).all(axis=1)
        ratios: Array = np.sqrt(np.mean(shares[known], axis=0)) if known.any() else np.full(6, nan)
        return ratios

    @cached_property
    def nees(self) -> tuple[Array, Array, Array]:
        """NEES, mean over the runs at each step, and its bounds, each (steps,)."""
        estimates = self.sums.estimates
        low, high = chi_square_bounds(FREE * estimates)
        return _per(self.sums.nees, estimates), _per(low, estimates), _per(high, estimates)

    @cached_property
    def nis(self) -> tuple[Array, Array, Array]:
        """NIS per degree of freedom, likewise."""
        degrees = self.sums.degrees
        low, high = chi_square_bounds(degrees)
        return _per(self.sums.nis, degrees), _per(low, degrees), _per(high, degrees)

    @cached_property
    def whiteness(self) -> tuple[Array, Array]:
        """Autocorrelation of the innovations at lags 1 to LAGS, and its bounds, (lags, links)."""
        return autocorrelation(self.sums.products, self.sums.pairs)

    @property
    def mean_nees(self) -> float:
        """NEES, mean over runs and steps."""
        return _mean(self.sums.nees, self.sums.estimates)

    @property
    def nis_per_degree(self) -> float:
        """NIS per degree of freedom, over runs and steps."""
        return _mean(self.sums.nis, self.sums.degrees)

    @property
    def calm_share(self) -> float:
        """Share of the steps, of all runs, that are outside friction reversals."""
        return _mean(self.sums.calm, self.sums.estimates)

    @property
    def above_when_calm(self) -> float:
        """
        Share of the steps at which NEES is above its upper bound, outside friction reversals.

        The NEES of a step is the mean over the runs that are outside a reversal.
        """
        known = self.sums.calm > 0
        if not known.any():
            return nan
        _, high = chi_square_bounds(FREE * self.sums.calm[known])
        return float(np.mean(self.sums.calm_nees[known] > high))

    @property
    def white_share(self) -> float:
        """Share of the autocorrelations, over lags and sensors, inside their bounds."""
        values, bounds = self.whiteness
        return share_inside(values, -bounds, bounds)

    def rms(self, moving: bool) -> tuple[float, float]:
        """Return the rms errors of the worst link in motion, or at rest [rad], [rad/s]."""
        scenario, times = self.case.scenario, self.times
        in_motion = np.zeros(len(times), dtype=bool)
        for setpoint in scenario.setpoints:
            duration = setpoint.duration or scenario.controller.setpoint_duration
            in_motion |= (times >= setpoint.at) & (times <= setpoint.at + duration)
        chosen: NDArray[np.bool_] = (in_motion == moving) & (times >= SETTLED_AT)
        squares = self.sums.link_squares[chosen].sum(axis=0)
        count = self.sums.estimates[chosen].sum()
        if not count:
            return nan, nan
        links = np.sqrt(squares / count)
        return float(links[:4].max()), float(links[4:].max())


def _per(sums: NDArray[Any], counts: NDArray[np.int64]) -> Array:
    """Divide by counts, NaN where the count is zero."""
    means: Array = np.where(counts > 0, sums / np.maximum(counts, 1), nan)
    return means


def _mean(sums: NDArray[Any], counts: NDArray[np.int64]) -> float:
    count = int(counts.sum())
    return float(sums.sum()) / count if count else nan
