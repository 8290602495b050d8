# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels of the measurement update of the filter."""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

from fourbar_ros.estimation.bias_detection import (
    check_recovery,
    FAULTY,
    isolate_fault,
    ONSET,
    update_hypotheses,
)
from fourbar_ros.estimation.compliant_closure import set_lengths
from fourbar_ros.estimation.estimate import ACCEPTED, EXCLUDED, GATED
from fourbar_ros.estimation.filter_model import Records
from fourbar_ros.estimation.filter_state import MAX_SIZE
from fourbar_ros.estimation.prediction import enforce_closure
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

SENSOR_ROW = np.dtype((np.record, [
    ('sensor', np.int64),           # index of SENSOR_NAMES, below zero for a gyro
    ('indispensable', np.int64),    # 1 if no other sensor of the update replaces it, else 0
    ('row', float, (MAX_SIZE,)),    # of H; its first n elements count
]))
"""One sensor of a measurement."""

# A sample with a NIS of more than this times the gate is no outlier of a small bias. It leaves the
# bias hypotheses alone: the gate rejects it, and the sensor is of use as soon as it agrees again.
GROSS_ERROR = 4.0


class Samples(NamedTuple):
    """
    The samples of an update.

    :param sensors: (m,) of SENSOR_ROW.
    :param variances: (m,) [rad^2] or [rad^2/s^2].
    :param innovations: (m,) measured minus predicted [rad] or [rad/s].
    :param nis: (m,) innovation squared over its variance.
    :param statuses: (m,) ACCEPTED, GATED or EXCLUDED.
    """

    sensors: Records
    variances: Array
    innovations: Array
    nis: Array
    statuses: NDArray[np.int64]


@kernel
def update(x: Array, covariance: Array, hypotheses: Records, sensors: Records, measured: Array,
           variances: Array, gate: float, models: Records
           ) -> tuple[Array, Array, Array, float, Array, Array, NDArray[np.int64]]:
    """
    Update in place: filterpy's `update` with wrapped innovations and a gate for each sample.

    :param x, covariance: (n,) and (n, n), see estimation.filter_state.
    :param hypotheses: (2, sensors), see estimation.bias_detection.
    :param sensors: (m,) of SENSOR_ROW.
    :param measured, variances: (m,) of their samples.
    :param gate: largest NIS of a sample that is accepted.
    :param models: (1,) of make_model.
    :returns: of the k accepted samples S (k, k), its inverse, K (n, k) and the NIS; innovation,
        NIS and status of each sample (m,).
    """
    model = models[0]
    count, size = sensors.size, x.size
    innovations, sample_nis = np.empty(count), np.empty(count)
    statuses = np.empty(count, np.int64)
    cross = np.zeros((count, size))     # H P
    used = 0
    for m in range(count):
        sensor = sensors[m].sensor
        innovation, nis = _innovate(
            x, covariance, sensors[m].row, measured[m], variances[m], sensor >= 0, cross[m])
        innovations[m], sample_nis[m] = innovation, nis
        if sensor >= 0 and hypotheses[ONSET, sensor].state == FAULTY:
            statuses[m] = EXCLUDED
            check_recovery(hypotheses, sensor, nis)
        elif nis <= gate:
            statuses[m] = ACCEPTED
            used += 1
        else:
            statuses[m] = GATED
    s = np.empty((used, used))
    if used == 0:
        return s, s, np.zeros((size, 0)), 0.0, innovations, sample_nis, statuses
    h, ph = np.empty((used, size)), np.empty((size, used))
    y, r, accepted = np.empty(used), np.empty(used), np.empty(used, np.int64)
    n = 0
    for m in range(count):
        if statuses[m] == ACCEPTED:
            y[n], r[n] = innovations[m], variances[m]
            accepted[n] = sensors[m].sensor
            row = sensors[m].row
            for i in range(size):
                h[n, i], ph[i, n] = row[i], cross[m, i]
            n += 1
    for m in range(used):
        for n in range(used):
            s[m, n] = r[m] if m == n else 0.0
            for i in range(size):
                s[m, n] += h[m, i] * ph[i, n]
    inverse = np.empty_like(s)
    inverse[:] = np.linalg.inv(s)
    gain = np.zeros((size, used))
    for i in range(size):
        for m in range(used):
            for n in range(used):
                gain[i, m] += ph[i, n] * inverse[n, m]
            x[i] += gain[i, m] * y[m]
    prior = covariance if used == count else covariance.copy()
    _joseph(covariance, h, ph, gain, r)
    nis = 0.0
    for m in range(used):
        for n in range(used):
            nis += y[m] * inverse[m, n] * y[n]
    if used == count:
        update_hypotheses(hypotheses, accepted, h, y, inverse, gain)
    else:
        samples = Samples(sensors, variances, innovations, sample_nis, statuses)
        _update_hypotheses_gated(hypotheses, samples, gate, prior, gain)
    indispensable = np.ones(hypotheses.shape[1], np.bool_)
    for m in range(count):
        if sensors[m].sensor >= 0:
            indispensable[sensors[m].sensor] = sensors[m].indispensable == 1
    isolate_fault(x, covariance, hypotheses, indispensable)
    if model.uncertain_lengths:
        set_lengths(x, model)
    enforce_closure(x, covariance, model)
    return s, inverse, gain, nis, innovations, sample_nis, statuses


@kernel
def _innovate(x: Array, covariance: Array, row: Array, measured: float, variance: float,
              is_angle: bool, cross: Array) -> tuple[float, float]:
    """
    Evaluate the innovation of a sample.

    :param row: of H.
    :param variance: of the sample.
    :param cross: (n,) zero, receives h P.
    :returns: innovation and its NIS.
    """
    size, predicted = x.size, 0.0
    for k in range(size):
        share = row[k]
        if share != 0.0:
            predicted += share * x[k]
            for i in range(size):
                cross[i] += share * covariance[i, k]
    for i in range(size):
        variance += row[i] * cross[i]
    innovation = measured - predicted
    if is_angle:
        innovation = pi - (pi - innovation) % (2.0 * pi)
    return innovation, innovation * innovation / variance


@kernel
def _joseph(covariance: Array, h: Array, ph: Array, gain: Array, r: Array) -> None:
    """
    Set P = (I - K H) P (I - K H)' + K R K', in place.

    :param h: (k, n) H.
    :param ph: (n, k) P H'.
    :param gain: (n, k) K.
    :param r: (k,) the diagonal of R.
    """
    size, used = ph.shape
    reduced, back = np.empty((size, size)), np.zeros((size, used))
    for i in range(size):
        for k in range(size):
            reduced[i, k] = covariance[i, k]
            for m in range(used):
                reduced[i, k] -= gain[i, m] * ph[k, m]
    for i in range(size):
        for m in range(used):
            for k in range(size):
                back[i, m] += reduced[i, k] * h[m, k]
            back[i, m] -= gain[i, m] * r[m]
    for i in range(size):
        for k in range(i + 1):
            total = reduced[i, k]
            for m in range(used):
                total -= back[i, m] * gain[k, m]
            covariance[i, k] = covariance[k, i] = total


@kernel
def _update_hypotheses_gated(hypotheses: Records, samples: Samples, gate: float, prior: Array,
                             gain: Array) -> None:
    """
    Update the bias hypotheses when only some of the samples were accepted.

    A gated sample counts like one at the gate, unless it is a gross error.

    :param prior: (n, n) covariance before the update.
    :param gain: of the accepted samples.
    """
    statuses, nis, size = samples.statuses, samples.nis, prior.shape[0]
    counted = np.flatnonzero(
        (statuses == ACCEPTED) | (statuses == GATED) & (nis < GROSS_ERROR * gate))
    many, y = counted.size, samples.innovations[counted]
    h, full, sensors = np.empty((many, size)), np.zeros((size, many)), np.empty(many, np.int64)
    column = 0
    for n in range(many):
        m = counted[n]
        sensors[n] = samples.sensors[m].sensor
        h[n] = samples.sensors[m].row[:size]
        if statuses[m] == ACCEPTED:
            full[:, n] = gain[:, column]
            column += 1
        else:
            y[n] *= sqrt(gate / nis[m])
    s = h @ prior @ h.T + np.diag(samples.variances[counted])
    inverse = np.ascontiguousarray(np.linalg.inv(s))
    update_hypotheses(hypotheses, sensors, h, y, inverse, full)
