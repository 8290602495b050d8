# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Search for wheel inertias and wheel motions at once, as the paper does for its Fig. 5.

The whole parallelogram shall follow a soft step. Minimised is the sum of eq. 9 over its least (the
closed form at zero tracking error), of the mean square tracking error, and of the wheels' total
inertia, the last two with weights. Wheel speeds are polynomials that begin and end at rest.

How little eq. 9 may be at a tracking error is known: with both pairs alike it is the minimum of
`int phi'^2 dt + mu int (phi - r)^2 dt`, a linear equation. No search can come below that.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cosh, exp, pi, radians, sinh, sqrt

from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.polynomial import Polynomial
from scipy.integrate import trapezoid
from scipy.optimize import brentq
from scipy.special import eval_jacobi

TURN, DURATION = pi / 2.0, 10.0
# Tracking errors count in this unit [rad].
ERROR_UNIT = radians(0.1)

# Each wheel's speed is 30 s^2 (1 - s)^2 times a polynomial of so many terms.
TERMS = 8
SAMPLES = 201
VARIABLES = 5 + 4 * TERMS
"""One for the total inertia, four for how it is shared, and the polynomials."""

# Where a search begins: shares and polynomials this far off, in the units of the variables.
SPREAD = 0.3
GENERATIONS, POPULATION = 1500, 20

# The reference, as a share of turn and duration: 10 s^3 - 15 s^4 + 6 s^5.
SOFT_STEP = Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
# Integral of the square of its rate.
SQUARED_RATE = 10.0 / 7.0


@dataclass(frozen=True)
class Search:
    """
    One search.

    :param error_weight: of the mean square tracking error, in `ERROR_UNIT` squared.
    :param seed: of where it begins and of what it draws.
    :param inertia_weight: of the total inertia, in that of four wheels; None to keep it there.
    :param inertias: (4,) of the wheels where only their motions are searched for, in units of a
        nominal wheel.
    """

    error_weight: float
    seed: int
    inertia_weight: float | None = None
    inertias: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class Candidate:
    """
    Wheels and their motions.

    :param inertias: (4,) in units of a nominal wheel.
    :param coefficients: (4, TERMS) of the speeds, 1 for that of a nominal wheel of four.
    """

    inertias: Array
    coefficients: Array

    @property
    def speeds(self) -> Array:
        """Speeds (4, SAMPLES), in units of turn / duration times links over wheel inertia."""
        found: Array = self.coefficients @ BASIS
        return found

    @property
    def rates(self) -> Array:
        """Rates of the pairs ac and bd (2, SAMPLES), in turn / duration."""
        momenta = self.inertias[:, None] * self.speeds
        found: Array = 0.5 * (momenta[:2] + momenta[2:])
        return found

    @property
    def errors(self) -> Array:
        """Tracking errors of the pairs (2, SAMPLES) [rad]."""
        momenta = self.inertias[:, None] * (self.coefficients @ INTEGRALS)
        found: Array = TURN * (0.5 * (momenta[:2] + momenta[2:]) - REFERENCE)
        return found

    @property
    def error_rms(self) -> float:
        """Tracking error, rms over time and links [rad]."""
        return sqrt(float(_mean(self.errors ** 2).mean()))

    @property
    def eq9(self) -> float:
        """Eq. 9 over the least of four nominal wheels at zero tracking error."""
        return _eq9(self.inertias, self.speeds)

    @property
    def total(self) -> float:
        """Inertia of all wheels over that of four nominal ones."""
        return float(self.inertias.sum()) / 4.0

    @property
    def eq9_without_error(self) -> float:
        """Eq. 9 likewise, of the same wheels if the pairs are made to follow exactly."""
        missing = BASIS[0] - self.rates
        inertias = np.tile(self.inertias[:2] + self.inertias[2:], 2)[:, None]
        return _eq9(self.inertias, self.speeds + np.tile(2.0 * missing, (2, 1)) / inertias)


def decode(variables: Array) -> Candidate:
    """
    Make a candidate of what is searched for, (VARIABLES,).

    The polynomials are those of the wheels' momenta, so that inertias do not change what the
    links do; all zero are four nominal wheels.
    """
    shares = np.exp(variables[1:5])
    inertias = 4.0 * exp(variables[0]) * shares / shares.sum()
    momenta = variables[5:].reshape(4, TERMS).copy()
    momenta[:, 0] += 1.0
    return Candidate(inertias, momenta / inertias[:, None])


def encoded(inertias: Array) -> list[float]:
    """Return the variables that stand for wheel inertias (4,): the first five."""
    total: list[float] = [float(np.log(inertias.sum() / 4.0)), *np.log(inertias).tolist()]
    return total


def cost(candidate: Candidate, search: Search) -> float:
    """Evaluate what is minimised."""
    value = candidate.eq9 + search.error_weight * (candidate.error_rms / ERROR_UNIT) ** 2
    if search.inertia_weight is not None:
        value += search.inertia_weight * candidate.total
    return value


def find(search: Search) -> tuple[Array, int]:
    """
    Search by CMA-ES.

    :returns: the best variables (VARIABLES,), and how many candidates were looked at.
    """
    import cma

    rng = np.random.default_rng(search.seed)
    begin = SPREAD * rng.standard_normal(VARIABLES)
    free = np.ones(VARIABLES, dtype=bool)
    if search.inertia_weight is None:
        begin[0], free[0] = 0.0, False
    if search.inertias is not None:
        begin[:5], free[:5] = encoded(np.array(search.inertias)), False

    def whole(some: Array) -> Array:
        variables: Array = begin.copy()
        variables[free] = some
        return variables

    strategy = cma.CMAEvolutionStrategy(begin[free], SPREAD, {
        'popsize': POPULATION, 'maxiter': GENERATIONS, 'verbose': -9,
        # Its own default draws from what all of numpy shares.
        'seed': np.nan, 'randn': lambda *shape: rng.standard_normal(shape),
        'tolfun': 1e-12, 'tolfunhist': 1e-13, 'tolx': 1e-10})
    while not strategy.stop():
        asked = strategy.ask()
        strategy.tell(asked, [cost(decode(whole(some)), search) for some in asked])
    return whole(np.array(strategy.result.xbest)), int(strategy.result.evaluations)


def least_at_weight(weight: float) -> tuple[float, float]:
    """
    Return what no search can beat, for a weight of the error.

    With phi = r + e, `e'' = mu e - r''`, e(0) = 0, e'(T) = 0; r'' is a cubic, so e is a polynomial
    and an exponential. Times in durations, angles in turns.

    :returns: tracking error, rms [rad]; eq. 9 over the least of the same wheels at zero error.
    """
    # weight e^2 / unit^2 beside int phi'^2 / SQUARED_RATE, e in turns.
    mu = weight * (TURN / ERROR_UNIT) ** 2 * SQUARED_RATE
    bend = SOFT_STEP.deriv(2)
    smooth = bend / mu + bend.deriv(2) / mu ** 2
    root = sqrt(mu)
    # On [0, 1]: a sinh(root s) + b sinh(root (1 - s)), both over their largest value.
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


def least_at_error(error_rms: float) -> float:
    """
    Return eq. 9 that no search can beat at a tracking error, over the least at zero error.

    :param error_rms: [rad], less than that of standing still.
    """
    if error_rms <= 0.0:
        return 1.0
    low, high = -25.0, 25.0
    weight = brentq(lambda exponent: np.log(least_at_weight(exp(exponent))[0] / error_rms),
                    low, high, xtol=1e-12)
    return least_at_weight(exp(weight))[1]


def _sinh_share(root: float, s: Array) -> Array:
    """Evaluate sinh(root s) / sinh(root) for s in [0, 1]."""
    found: Array = np.exp(root * (s - 1.0)) * -np.expm1(-2.0 * root * s) / -np.expm1(-2.0 * root)
    return found


def _cosh_share(root: float, s: Array) -> Array:
    """Evaluate cosh(root s) / sinh(root) for s in [0, 1]."""
    found: Array = (np.exp(root * (s - 1.0)) + np.exp(-root * (s + 1.0))) / -np.expm1(-2.0 * root)
    return found


def _mean(values: Array) -> Array:
    """Return the mean over time, along the last axis."""
    found: Array = values @ WEIGHTS
    return found


def _eq9(inertias: Array, speeds: Array) -> float:
    return float(inertias @ _mean(speeds ** 2)) / 4.0 / SQUARED_RATE


def _polynomials() -> list[Polynomial]:
    """Return the terms of the speeds over the share of the duration."""
    window, found = SOFT_STEP.deriv(), []
    for order in range(TERMS):
        # Orthogonal under the square of the window: the search sees all of one size.
        fitted = Polynomial.fit(TIMES, eval_jacobi(order, 4.0, 4.0, 2.0 * TIMES - 1.0), order)
        speed = window * fitted.convert()
        found.append(speed / sqrt(float(_mean(speed(TIMES) ** 2)) / SQUARED_RATE))
    return found


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(SAMPLES)
TIMES, WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
"""Instants as shares of the duration, and their weights in a mean (Gauss and Legendre)."""
POLYNOMIALS = _polynomials()
BASIS = np.array([speed(TIMES) for speed in POLYNOMIALS])
INTEGRALS = np.array([speed.integ()(TIMES) for speed in POLYNOMIALS])
REFERENCE = SOFT_STEP(TIMES)
