# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Kernel of the correction: what measured angles and rates make of the state."""

from __future__ import annotations

from math import pi, sqrt

from fourbar_ros.estimation.bias_detection import FAULTY, judge, seen_again, VERDICT, weigh
from fourbar_ros.estimation.compliant_closure import take_lengths
from fourbar_ros.estimation.prediction import meet
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

# What became of a sample.
USED, REFUSED, LEFT_OUT = 0, 1, 2

# From so many times the gate on, as the square of the innovation, a sample is too far off to be
# let in by noise.
BEYOND = 4.0


@kernel
def correct(x: Array, covariance: Array, suspicions: Array, sensors: NDArray[np.int64],
            rows: Array, measured: Array, variances: Array, gate: float,
            spared: NDArray[np.bool_], loose: bool, boxed: NDArray[np.record], state: Array,
            ) -> tuple[Array, Array, Array, Array, Array, float, NDArray[np.int64]]:
    """
    Correct in place: filterpy's `update`, with wrapped innovations and a gate for each sample.

    :param x, covariance: (n,) and (n, n), see estimation.layout.
    :param suspicions: (2 sensors, SCALARS + n), see estimation.suspicion.
    :param sensors: (m,) of which sensor each sample is, below zero for a gyro's.
    :param rows: (m, n) H.
    :param measured: (m,) angles, any turn [rad], and rates [rad/s].
    :param variances: (m,) of each.
    :param gate: largest normalised square of an innovation that is used.
    :param spared: (sensors,) those that are used even if found at fault.
    :param loose: whether the loop may fail to close.
    :param boxed: (1,) constants of the mechanism, wheels locked.
    :param state: (STATE_SIZE,) to work in.
    :returns: y (m,), and the square of each over its variance (m,); of the k samples that were
        used S (k, k), its inverse, K (n, k) and the normalised innovation squared; and what
        became of each sample (m,).
    """
    count, size = rows.shape
    y, squares, fate = np.empty(count), np.empty(count), np.zeros(count, np.int64)
    spread = np.zeros((size, count))
    used = 0
    for m in range(count):
        # P H', and the diagonal of S = H P H' + R.
        predicted, variance = 0.0, variances[m]
        for k in range(size):
            share = rows[m, k]
            if share != 0.0:
                predicted += share * x[k]
                for i in range(size):
                    spread[i, m] += share * covariance[i, k]
        for i in range(size):
            variance += rows[m, i] * spread[i, m]
        y[m] = measured[m] - predicted
        if sensors[m] >= 0:
            y[m] = pi - (pi - y[m]) % (2.0 * pi)
        squares[m] = y[m] * y[m] / variance
        if sensors[m] >= 0 and suspicions[sensors[m], VERDICT] == FAULTY:
            fate[m] = LEFT_OUT
            seen_again(suspicions, sensors[m], squares[m])
        elif not squares[m] <= gate:
            fate[m] = REFUSED
        else:
            used += 1
    s = np.empty((used, used))
    if used == 0:
        return y, squares, s, s, np.zeros((size, 0)), 0.0, fate
    h, b = np.empty((used, size)), np.empty((size, used))
    good, noise = np.empty(used), np.empty(used)
    n = 0
    for m in range(count):
        if fate[m] == USED:
            good[n], noise[n] = y[m], variances[m]
            h[n] = rows[m]
            b[:, n] = spread[:, m]
            n += 1
    for m in range(used):
        for n in range(used):
            s[m, n] = noise[m] if m == n else 0.0
            for i in range(size):
                s[m, n] += h[m, i] * b[i, n]
    inverse = np.empty_like(s)
    inverse[:] = np.linalg.inv(s)
    gain = np.zeros((size, used))
    for i in range(size):
        for m in range(used):
            for n in range(used):
                gain[i, m] += b[i, n] * inverse[n, m]
            x[i] += gain[i, m] * good[m]
    before = covariance if used == count else covariance.copy()
    _joseph(covariance, h, b, gain, noise)
    nis = 0.0
    for m in range(used):
        for n in range(used):
            nis += good[m] * inverse[m, n] * good[n]
    if used == count:
        weigh(suspicions, sensors, h, good, inverse, gain)
    else:
        _weigh_refused(suspicions, sensors, rows, y, squares, variances, gate, fate, before, gain)
    judge(x, covariance, suspicions, spared)
    if loose:
        take_lengths(x, boxed[0])
    state[0:8] = x[0:8]
    meet(state, covariance, loose, boxed[0])
    x[0:8] = state[0:8]
    return y, squares, s, inverse, gain, nis, fate


@kernel
def _joseph(covariance: Array, h: Array, b: Array, gain: Array, noise: Array) -> None:
    """
    Set P = (I - K H) P (I - K H)' + K R K', in place.

    :param b: (n, k) P H'.
    :param noise: (k,) the diagonal of R.
    """
    size, used = b.shape
    rest, back = np.empty((size, size)), np.zeros((size, used))
    for i in range(size):
        for k in range(size):
            rest[i, k] = covariance[i, k]
            for m in range(used):
                rest[i, k] -= gain[i, m] * b[k, m]
    for i in range(size):
        for m in range(used):
            for k in range(size):
                back[i, m] += rest[i, k] * h[m, k]
            back[i, m] -= gain[i, m] * noise[m]
    for i in range(size):
        for k in range(i + 1):
            total = rest[i, k]
            for m in range(used):
                total -= back[i, m] * gain[k, m]
            covariance[i, k] = covariance[k, i] = total


@kernel
def _weigh_refused(suspicions: Array, sensors: NDArray[np.int64], rows: Array, y: Array,
                   squares: Array, variances: Array, gate: float, fate: NDArray[np.int64],
                   covariance: Array, gain: Array) -> None:
    """
    Weigh suspicions by all samples but those left out, though only some moved the filter.

    What the gate refuses speaks of its sensor, too, but as loudly as a sample at the gate. What
    is so far off that the gate will always refuse it does not: it does no harm, and is of use as
    soon as it agrees again.

    :param covariance: before the correction.
    :param gain: of the samples that were used.
    """
    heard = np.flatnonzero((fate == USED) | (fate == REFUSED) & (squares < BEYOND * gate))
    many, size = heard.size, rows.shape[1]
    h, innovation, full = rows[heard], y[heard], np.zeros((size, many))
    s = h @ covariance @ h.T
    column = 0
    for n in range(many):
        m = heard[n]
        s[n, n] += variances[m]
        if fate[m] == USED:
            full[:, n] = gain[:, column]
            column += 1
        else:
            innovation[n] *= sqrt(gate / squares[m])
    weigh(suspicions, sensors[heard], h, innovation, np.linalg.inv(s), full)
