# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Search for wheel inertias and wheel motions at once, as the paper does for its Fig. 5.

The whole parallelogram follows a soft step. The search minimises the sum of eq. 9 over its least
value (the closed form at zero tracking error), the weighted mean square tracking error, and the
weighted total inertia of the wheels. Wheel speeds are polynomials that start and end at rest.

Eq. 9 has a lower bound at a given tracking error: with equal pairs it is the minimum of
`int phi'^2 dt + mu int (phi - r)^2 dt`, the solution of a linear equation.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from math import cosh, degrees, exp, pi, radians, sinh, sqrt
from typing import Any

from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.polynomial import Polynomial
from scipy.integrate import trapezoid
from scipy.optimize import brentq
from scipy.special import eval_jacobi

TURN, DURATION = pi / 2.0, 10.0
# Inertias that the paper reports for its search, relative to the nominal wheel.
PAPER = (0.88, 0.41, 1.37, 0.77)
# Unit of the tracking error in the cost [rad].
ERROR_UNIT = radians(0.1)

# The speed of a wheel is 30 s^2 (1 - s)^2 times a polynomial with this number of terms.
TERMS = 8
SAMPLES = 201
VARIABLES = 5 + 4 * TERMS
"""One variable for the total inertia, four for its distribution, and the polynomials."""

# Standard deviation of the initial distribution, in the units of the variables.
SPREAD = 0.3
GENERATIONS, POPULATION = 1500, 20

# The reference, as a share of turn and duration: 10 s^3 - 15 s^4 + 6 s^5.
SOFT_STEP = Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
# Integral of the square of its rate.
SQUARED_RATE = 10.0 / 7.0


@dataclass(frozen=True)
class Search:
    """
    Settings of one search.

    :param error_weight: of the mean square tracking error, in `ERROR_UNIT` squared.
    :param seed: of the start and of all random numbers.
    :param inertia_weight: of the total inertia, relative to four nominal wheels; None: the total
        stays that of four nominal wheels.
    :param inertias: (4,) fixed inertias relative to a nominal wheel; None: they are variables.
    """

    error_weight: float
    seed: int
    inertia_weight: float | None = None
    inertias: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class Candidate:
    """
    Wheels and their motions.

    :param inertias: (4,) relative to a nominal wheel.
    :param coefficients: (4, TERMS) of the speeds; 1 is the speed of four nominal wheels.
    """

    inertias: Array
    coefficients: Array

    @property
    def speeds(self) -> Array:
        """Speeds (4, SAMPLES), in units of turn / duration times links over wheel inertia."""
        return _product(self.coefficients, BASIS)

    @property
    def rates(self) -> Array:
        """Rates of the pairs ac and bd (2, SAMPLES), in turn / duration."""
        return self._of_pairs(BASIS)

    @property
    def errors(self) -> Array:
        """Tracking errors of the pairs (2, SAMPLES) [rad]."""
        return TURN * (self._of_pairs(INTEGRALS) - REFERENCE)

    @property
    def error_rms(self) -> float:
        """Tracking error, rms over time and links [rad]."""
        return sqrt(float(_mean(self.errors ** 2).mean()))

    @property
    def eq9(self) -> float:
        """Eq. 9 over the least value of four nominal wheels at zero tracking error."""
        return _eq9(self.inertias, self.speeds)

    @property
    def total(self) -> float:
        """Inertia of all wheels relative to four nominal wheels."""
        return float(self.inertias.sum()) / 4.0

    @property
    def eq9_without_error(self) -> float:
        """Eq. 9 likewise, of the same wheels with speeds corrected to zero tracking error."""
        missing = BASIS[0] - self.rates
        inertias = np.tile(self.inertias[:2] + self.inertias[2:], 2)[:, None]
        return _eq9(self.inertias, self.speeds + np.tile(2.0 * missing, (2, 1)) / inertias)

    def _of_pairs(self, terms: Array) -> Array:
        """Return the mean of the momenta of each pair, or of their integrals."""
        momenta = self.inertias[:, None] * (self.coefficients @ terms)
        return _product(0.5, momenta[:2] + momenta[2:])


@dataclass(frozen=True, eq=False)
class SearchResult:
    """
    Result of a search.

    :param kind: `front`, `seeds`, `total` or `paper`.
    :param search: its settings.
    :param candidate: the best candidate.
    :param evaluations: number of evaluated candidates.
    """

    kind: str
    search: Search
    candidate: Candidate
    evaluations: int

    @property
    def ratio(self) -> float:
        """Eq. 9 over the closed form for wheels of the same total inertia."""
        return self.candidate.eq9 * self.candidate.total

    @property
    def error(self) -> float:
        """Tracking error, rms [deg]."""
        return degrees(self.candidate.error_rms)

    @cached_property
    def over_bound(self) -> float:
        """Eq. 9 over its lower bound at this error."""
        return self.ratio / bound_at_error(self.candidate.error_rms)

    @property
    def ratio_without_error(self) -> float:
        """Eq. 9 without tracking error over the closed form."""
        return self.candidate.eq9_without_error * self.candidate.total

    def as_json(self) -> dict[str, Any]:
        """Return it as numbers and lists."""
        return {
            'kind': self.kind, **asdict(self.search), 'evaluations': self.evaluations,
            'error_rms_deg': self.error, 'eq9_over_closed_form': self.ratio,
            'eq9_over_least_at_error': self.over_bound,
            'eq9_over_closed_form_without_error': self.ratio_without_error,
            'eq9_over_four_nominal': self.candidate.eq9,
            'total_inertia_over_nominal': self.candidate.total,
            'inertias_over_nominal': self.candidate.inertias.tolist()}


def decode(variables: Array) -> Candidate:
    """
    Return the candidate for the variables of the search (VARIABLES,).

    The polynomials describe the momenta of the wheels, so that inertias do not change the motion
    of the links. Zero is four nominal wheels.
    """
    shares = np.exp(variables[1:5])
    inertias = 4.0 * exp(variables[0]) * shares / shares.sum()
    momenta = variables[5:].reshape(4, TERMS).copy()
    momenta[:, 0] += 1.0
    return Candidate(inertias, momenta / inertias[:, None])


def cost(candidate: Candidate, search: Search) -> float:
    """Evaluate the minimised cost."""
    value = candidate.eq9 + search.error_weight * (candidate.error_rms / ERROR_UNIT) ** 2
    if search.inertia_weight is not None:
        value += search.inertia_weight * candidate.total
    return value


def run_search(search: Search) -> tuple[Array, int]:
    """
    Search by CMA-ES.

    :returns: the best variables (VARIABLES,) and the number of evaluated candidates.
    """
    import cma

    rng = np.random.default_rng(search.seed)
    begin = SPREAD * rng.standard_normal(VARIABLES)
    free = np.ones(VARIABLES, dtype=bool)
    if search.inertia_weight is None:
        begin[0], free[0] = 0.0, False
    if search.inertias is not None:
        inertias = np.array(search.inertias)
        begin[:5] = [np.log(inertias.sum() / 4.0), *np.log(inertias)]
        free[:5] = False

    def complete(values: Array) -> Array:
        variables: Array = begin.copy()
        variables[free] = values
        return variables

    strategy = cma.CMAEvolutionStrategy(begin[free], SPREAD, {
        'popsize': POPULATION, 'maxiter': GENERATIONS, 'verbose': -9,
        # The default generator is numpy's global one.
        'seed': np.nan, 'randn': lambda *shape: rng.standard_normal(shape),
        'tolfun': 1e-12, 'tolfunhist': 1e-13, 'tolx': 1e-10})
    while not strategy.stop():
        population = strategy.ask()
        strategy.tell(population, [cost(decode(complete(values)), search)
                                   for values in population])
    return complete(np.array(strategy.result.xbest)), int(strategy.result.evaluations)


def bound_at_weight(weight: float) -> tuple[float, float]:
    """
    Return error and eq. 9 at the minimum of the cost, for a weight of the error.

    With phi = r + e, `e'' = mu e - r''`, e(0) = 0, e'(T) = 0. r'' is a cubic, so that e is the sum
    of a polynomial and exponentials. Times in durations, angles in turns.

    :returns: tracking error, rms [rad]; eq. 9 over the least of the same wheels at zero error.
    """
    # Cost: weight e^2 / unit^2 + int phi'^2 / SQUARED_RATE, e in turns.
    mu = weight * (TURN / ERROR_UNIT) ** 2 * SQUARED_RATE
    bend = SOFT_STEP.deriv(2)
    smooth = bend / mu + bend.deriv(2) / mu ** 2
    root = sqrt(mu)
    # On [0, 1]: a sinh(root s) + b sinh(root (1 - s)), each divided by sinh(root).
    s = np.linspace(0.0, 1.0, 20001)
    b = -smooth(0.0)
    slope_of_b = -root / sinh(root) if root < 300.0 else 0.0
    slope_of_a = root * cosh(root) / sinh(root) if root < 300.0 else root
    a = -(smooth.deriv()(1.0) + b * slope_of_b) / slope_of_a
    rise, fall = _sinh_share(root, s), _sinh_share(root, 1.0 - s)
    error = smooth(s) + a * rise + b * fall
    rate = (SOFT_STEP.deriv()(s) + smooth.deriv()(s) + a * root * _cosh_share(root, s)
            - b * root * _cosh_share(root, 1.0 - s))
    return (TURN * sqrt(float(trapezoid(error ** 2, s))),
            float(trapezoid(rate ** 2, s)) / SQUARED_RATE)


def bound_at_error(error_rms: float) -> float:
    """
    Return the lower bound of eq. 9 at a tracking error, over the least value at zero error.

    :param error_rms: [rad], less than the error of a linkage at rest.
    """
    if error_rms <= 0.0:
        return 1.0
    low, high = -25.0, 25.0
    weight = brentq(lambda exponent: np.log(bound_at_weight(exp(exponent))[0] / error_rms),
                    low, high, xtol=1e-12)
    return bound_at_weight(exp(weight))[1]


def _sinh_share(root: float, s: Array) -> Array:
    """Evaluate sinh(root s) / sinh(root) for s in [0, 1]."""
    return (np.exp(root * (s - 1.0)) * -np.expm1(-2.0 * root * s)) / -float(
        np.expm1(-2.0 * root))


def _cosh_share(root: float, s: Array) -> Array:
    """Evaluate cosh(root s) / sinh(root) for s in [0, 1]."""
    return (np.exp(root * (s - 1.0)) + np.exp(-root * (s + 1.0))) / -float(np.expm1(-2.0 * root))


def _product(first: Any, second: Array) -> Array:
    product: Array = np.dot(first, second)
    return product


def _mean(values: Array) -> Array:
    """Return the mean over time, along the last axis."""
    return _product(values, WEIGHTS)


def _eq9(inertias: Array, speeds: Array) -> float:
    return float(inertias @ _mean(speeds ** 2)) / 4.0 / SQUARED_RATE


def _polynomials() -> list[Polynomial]:
    """Return the terms of the speeds as functions of the share of the duration."""
    window, terms = SOFT_STEP.deriv(), []
    for order in range(TERMS):
        # Orthogonal under the square of the window: all variables have one scale.
        fitted = Polynomial.fit(TIMES, eval_jacobi(order, 4.0, 4.0, 2.0 * TIMES - 1.0), order)
        speed = window * fitted.convert()
        terms.append(speed / sqrt(float(_mean(speed(TIMES) ** 2)) / SQUARED_RATE))
    return terms


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(SAMPLES)
TIMES, WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
"""Instants as shares of the duration, and their weights in a mean (Gauss and Legendre)."""
POLYNOMIALS = _polynomials()
BASIS = np.array([speed(TIMES) for speed in POLYNOMIALS])
INTEGRALS = np.array([speed.integ()(TIMES) for speed in POLYNOMIALS])
REFERENCE = SOFT_STEP(TIMES)
