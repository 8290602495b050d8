# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Statistics of the consistency of an estimator: NEES, NIS, whiteness, Cramer-Rao bound.

Y. Bar-Shalom, X.-R. Li and T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, Wiley 2001, section 5.4.
"""

from __future__ import annotations

from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv, ndtri

CONFIDENCE = 0.95


def normalised_squares(errors: Array, covariances: Array) -> Array:
    """
    Evaluate e' P^-1 e: chi-square with n degrees of freedom if P is the covariance of e.

    :param errors: (..., n).
    :param covariances: (..., n, n).
    :returns: (...).
    """
    weighted = np.linalg.solve(covariances, errors[..., np.newaxis])[..., 0]
    squares: Array = np.sum(errors * weighted, axis=-1)
    return squares


def chi_square_bounds(degrees: ArrayLike, confidence: float = CONFIDENCE) -> tuple[Array, Array]:
    """
    Return the central interval of a chi-square distribution.

    :param degrees: of freedom, any shape; the sum over independent runs has the sum of theirs.
    :returns: lower and upper bound, in that shape; NaN for no degrees of freedom.
    """
    half = 0.5 * np.asarray(degrees, dtype=float)
    half = np.where(half > 0.0, half, np.nan)
    tail = 0.5 * (1.0 - confidence)
    low, high = (2.0 * gammaincinv(half, share) for share in (tail, 1.0 - tail))
    return low, high


def share_inside(values: Array, low: Array, high: Array) -> float:
    """Return the share of the values from low to high; values without bounds are ignored."""
    known = np.isfinite(low) & np.isfinite(high) & np.isfinite(values)
    if not known.any():
        return float('nan')
    return float(np.mean((values[known] >= low[known]) & (values[known] <= high[known])))


def lagged_products(innovations: Array, lags: int) -> tuple[Array, NDArray[np.int64]]:
    """
    Sum the products of a sensor's normalised innovations with later ones.

    The sums and counts of several runs may be added before the division.

    :param innovations: (steps, sensors), NaN without a sample; its products are left out.
    :param lags: largest lag.
    :returns: sums and numbers of products, (lags + 1, sensors), from lag 0 on.
    """
    known = np.isfinite(innovations)
    values = np.where(known, innovations, 0.0)
    steps, sensors = innovations.shape
    sums, counts = np.zeros((lags + 1, sensors)), np.zeros((lags + 1, sensors), np.int64)
    for lag in range(min(lags + 1, steps)):
        sums[lag] = np.sum(values[:steps - lag] * values[lag:], axis=0)
        counts[lag] = np.sum(known[:steps - lag] & known[lag:], axis=0)
    return sums, counts


def autocorrelation(sums: Array, counts: NDArray[np.int64], confidence: float = CONFIDENCE
                    ) -> tuple[Array, Array]:
    """
    Return the autocorrelation from the sums of :func:`lagged_products`, and its bound.

    For white innovations the products at a lag have mean 0 and are uncorrelated: their mean over
    N pairs has the variance 1 / N, in units of the square at lag 0. A lost sample only reduces the
    number of pairs.

    :returns: autocorrelation at lags 1 to n, (lags, sensors), and the bound of its absolute value
        for white innovations at this confidence, in that shape. NaN without a pair.
    """
    with np.errstate(invalid='ignore', divide='ignore'):
        means = sums / counts
        found: Array = means[1:] / means[0]
        bounds: Array = ndtri(0.5 + 0.5 * confidence) / np.sqrt(
            np.where(counts[1:] > 0, counts[1:], np.nan))
    return found, bounds


def posterior_bound(start: Array, carried: Array, crossed: Array, driven: Array, seen: Array,
                    late: int = 0) -> Array:
    """
    Evaluate the posterior Cramer-Rao bound: no estimator has a smaller mean square error.

    P. Tichavsky, C. Muravchik, A. Nehorai, Posterior Cramer-Rao bounds for discrete-time
    nonlinear filtering, IEEE Trans. Signal Processing 46, 1998, p. 1386, eq. 21, for additive
    Gaussian noise: with the expectations over trajectories D11 = E[F' Q^-1 F],
    D12 = -E[F' Q^-1] and D22 = E[Q^-1] + E[H' R^-1 H],

        J(k + 1) = D22 - D12' (J(k) + D11)^-1 D12 .

    With delayed measurements J is predicted over the delay.

    :param start: (n, n) information before the first measurement, the inverse of the prior.
    :param carried: (steps - 1, n, n) E[F' Q^-1 F] from each step to the next.
    :param crossed: (steps - 1, n, n) E[F' Q^-1].
    :param driven: (steps - 1, n, n) E[Q^-1].
    :param seen: (steps, n, n) E[H' R^-1 H] at each step.
    :param late: delay of the measurements [steps].
    :returns: (steps, n, n) covariances, NaN for steps without a measurement so far.
    """
    steps = len(seen)
    bounds = np.full(seen.shape, np.nan)
    information = start + seen[0]
    for step in range(steps - late):
        if step:
            information = seen[step] + _carry(information, step - 1, carried, crossed, driven)
        known = information
        for ahead in range(late):
            known = _carry(known, step + ahead, carried, crossed, driven)
        bounds[step + late] = np.linalg.inv(known)
    return bounds


def _carry(information: Array, step: int, carried: Array, crossed: Array, driven: Array) -> Array:
    """Predict the information by one step."""
    gain = np.linalg.solve(information + carried[step], crossed[step])
    predicted = driven[step] - crossed[step].T @ gain
    symmetric: Array = 0.5 * (predicted + predicted.T)
    return symmetric
