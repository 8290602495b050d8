# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Detection and isolation of a sensor with a constant error, by generalised likelihood ratios.

A bias hypothesis says that one sensor has a constant error (bias) and that all else is as the
filter assumes. It is the filter with that bias as a further state, split into the filter without
the bias and the effect of the bias (B. Friedland, Treatment of bias in recursive filtering, IEEE
Trans. Automatic Control 14, 1969, p. 359): `effect` is the error of the state per unit of bias.
The GLR statistic of a hypothesis is the sum of the log-likelihood ratios of all innovations, with
the bias over without it. It is a CUSUM (E. S. Page, Continuous inspection schemes, Biometrika 41,
1954, p. 100; M. Basseville and I. V. Nikiforov, Detection of Abrupt Changes, 1993): where the sum
falls below zero, it restarts at zero, with a filter that has seen no bias yet.

White noise is the same in both likelihoods, so it does not raise the statistic. Neither does a
motion of the linkage.

Each sensor has two hypotheses. Of the *onset* of a bias: the filter had no error before. Of a
*persistent* bias: the filter has settled to it. The sensors of paired links explain a persistent
bias equally well. Only the onset isolates the sensor. Where the filter did not see the onset, both
statistics rise together, and both sensors are suspected.
"""

from __future__ import annotations

from math import log

from fourbar_ros.estimation.filter_model import Records
from fourbar_ros.estimation.filter_state import MAX_SIZE
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import SENSOR_NAMES
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

BiasHypothesis = np.record
_HYPOTHESIS = np.dtype((np.record, [
    ('bias', float),            # rad, estimate
    ('variance', float),        # rad^2, of the estimate
    ('glr', float),             # nats, GLR statistic
    ('state', np.int64),        # of the sensor: HEALTHY, SUSPECTED, FAULTY; onset only
    ('mean_nis', float),        # of the excluded samples of a faulty sensor; onset only
    ('effect', float, (MAX_SIZE,)),     # error of the state per bias; its first n elements count
]))

ONSET, PERSISTENT = 0, 1
"""First index of the array of hypotheses; the second one is the sensor."""

HEALTHY, SUSPECTED, FAULTY = 0, 1, 2
"""Fault states of a sensor: no bias; biased, or another suspected sensor is; biased."""

# Standard deviation of a bias before it is estimated [rad]: half a degree, below the gate.
BIAS_SIGMA = 0.01

# Random walk of a bias [rad/sqrt(s)]: errors that grow are found, too.
BIAS_WALK = 0.005

# A sensor is faulty when its GLR statistic exceeds the threshold [nats], which chance does once in
# e^20, and leads the statistics of all other sensors by the margin [nats].
GLR_THRESHOLD = 20.0
GLR_MARGIN = 10.0

# When the largest statistic reaches this without a lead, all sensors within the margin are
# suspected [nats], until their statistics fall below GLR_THRESHOLD. Twice this value bounds all
# statistics.
AMBIGUITY_THRESHOLD = 50.0

# Drift of the CUSUM: this is taken off per update [nats], so that a bias that ended is forgotten
# within seconds.
DRIFT = 0.05

# Lower bound of a positive statistic when all are reduced [nats]: its hypothesis stays alive.
LEAST_GLR = 1e-3

# A faulty sensor is healthy again when the mean NIS of its samples falls below the limit (1 for a
# healthy sensor). Number of samples of the mean, limit, and largest NIS that one sample counts.
RECOVERY_SAMPLES = 50.0
RECOVERY_NIS = 1.6
LARGEST_NIS = 9.0


def initial_hypotheses() -> Records:
    """Return the bias hypotheses (2, sensors) of healthy sensors."""
    hypotheses = np.zeros((2, len(SENSOR_NAMES)), _HYPOTHESIS)
    hypotheses['variance'] = BIAS_SIGMA ** 2
    return hypotheses


@kernel
def _restart(hypothesis: BiasHypothesis, without_effect: bool) -> None:
    """
    Restart the CUSUM, but keep the fault state.

    :param without_effect: whether the filter is as if there had been no bias.
    """
    hypothesis.bias = hypothesis.glr = 0.0
    hypothesis.variance = BIAS_SIGMA * BIAS_SIGMA
    if without_effect:
        effect = hypothesis.effect
        for i in range(MAX_SIZE):
            effect[i] = 0.0


@kernel
def predict_hypotheses(hypotheses: Records, transition: Array, duration: float) -> None:
    """
    Predict all hypotheses in place: effects follow the state, biases walk.

    :param hypotheses: (2, sensors).
    :param transition: (n, n) F.
    """
    size = transition.shape[0]
    moved = np.empty(size)
    for kind in range(hypotheses.shape[0]):
        for sensor in range(hypotheses.shape[1]):
            hypothesis = hypotheses[kind, sensor]
            effect = hypothesis.effect
            for k in range(size):
                if effect[k] != 0.0:
                    break
            else:
                continue
            for i in range(size):
                moved[i] = 0.0
                for k in range(size):
                    moved[i] += transition[i, k] * effect[k]
            for i in range(size):
                effect[i] = moved[i]
            hypothesis.variance += BIAS_WALK * BIAS_WALK * duration


@kernel
def update_hypotheses(hypotheses: Records, sensors: NDArray[np.int64], rows: Array,
                      innovation: Array, inverse: Array, gain: Array) -> None:
    """
    Add the log-likelihood ratios of one update to the GLR statistics, in place.

    :param hypotheses: (2, sensors).
    :param sensors: (m,) the sensor of each innovation, below zero for a gyro.
    :param rows: (m, n) H.
    :param innovation: (m,).
    :param inverse: (m, m) of the covariance of the innovation.
    :param gain: (n, m) K, zero for samples that the gate rejected.
    """
    count, size = rows.shape
    signature, weighted = np.empty(count), np.empty(count)
    for kind in range(hypotheses.shape[0]):
        for sensor in range(hypotheses.shape[1]):
            if hypotheses[ONSET, sensor].state == FAULTY:
                continue
            hypothesis = hypotheses[kind, sensor]
            effect = hypothesis.effect
            concerned = hypothesis.glr > 0.0
            for m in range(count):
                # Effect of the bias on the innovation, per bias.
                signature[m] = 1.0 if sensors[m] == sensor else 0.0
                concerned |= sensors[m] == sensor
                for i in range(size):
                    signature[m] -= rows[m, i] * effect[i]
            if not concerned:
                continue
            precision = projection = 0.0
            for m in range(count):
                weighted[m] = 0.0
                for k in range(count):
                    weighted[m] += inverse[m, k] * signature[k]
                precision += signature[m] * weighted[m]
                projection += weighted[m] * innovation[m]
            bias, variance = hypothesis.bias, hypothesis.variance
            rest, growth = projection - bias * precision, 1.0 + variance * precision
            glr = hypothesis.glr + (
                bias * projection - 0.5 * bias * bias * precision
                + 0.5 * (rest * rest * variance / growth - log(growth)) - DRIFT)
            if glr > 0.0:
                hypothesis.glr = glr
                hypothesis.variance = variance / growth
                hypothesis.bias = bias + hypothesis.variance * rest
            else:
                _restart(hypothesis, kind == ONSET)
            if glr > 0.0 or kind == PERSISTENT:
                for i in range(size):
                    for m in range(count):
                        effect[i] += gain[i, m] * signature[m]


@kernel
def _likelier(hypotheses: Records, sensor: int) -> int:
    """Return which hypothesis of a sensor is likelier, ONSET or PERSISTENT."""
    return PERSISTENT if (
        hypotheses[PERSISTENT, sensor].glr > hypotheses[ONSET, sensor].glr) else ONSET


@kernel
def isolate_fault(x: Array, covariance: Array, hypotheses: Records,
                  indispensable: NDArray[np.bool_]) -> None:
    """
    Set the fault states, and remove the effect of a newly faulty sensor from the state, in place.

    :param indispensable: (sensors,) those that no other sensor replaces; they stay in use.
    """
    count = hypotheses.shape[1]
    worst, highest = 0, 0.0
    for sensor in range(count):
        glr = hypotheses[_likelier(hypotheses, sensor), sensor].glr
        if glr > highest:
            worst, highest = sensor, glr
    # Bound the statistics, so that each can fall again in time; differences stay.
    excess = max(0.0, highest - 2.0 * AMBIGUITY_THRESHOLD)
    if excess > 0.0:
        for kind in range(2):
            for sensor in range(count):
                hypothesis = hypotheses[kind, sensor]
                if hypothesis.glr > 0.0:
                    hypothesis.glr = max(hypothesis.glr - excess, LEAST_GLR)
        highest -= excess
    isolated = highest > GLR_THRESHOLD
    for sensor in range(count):
        hypothesis = hypotheses[ONSET, sensor]
        if hypothesis.state == FAULTY:
            continue
        glr = hypotheses[_likelier(hypotheses, sensor), sensor].glr
        close = glr > highest - GLR_MARGIN
        if highest > AMBIGUITY_THRESHOLD and close:
            hypothesis.state = SUSPECTED
        elif glr < GLR_THRESHOLD or not close:
            hypothesis.state = HEALTHY
        isolated &= sensor == worst or not close
    if not isolated:
        return
    if indispensable[worst]:
        hypotheses[ONSET, worst].state = SUSPECTED
        return
    hypothesis = hypotheses[_likelier(hypotheses, worst), worst]
    bias, variance, effect = hypothesis.bias, hypothesis.variance, hypothesis.effect[:x.size]
    x -= effect * bias
    covariance += np.outer(variance * effect, effect)
    # The other statistics belong to a filter that used this sensor.
    for kind in range(2):
        for sensor in range(count):
            if hypotheses[ONSET, sensor].state != FAULTY:
                _restart(hypotheses[kind, sensor], True)
    onset = hypotheses[ONSET, worst]
    onset.state, onset.mean_nis, onset.bias = FAULTY, LARGEST_NIS, bias


@kernel
def check_recovery(hypotheses: Records, sensor: int, nis: float) -> None:
    """
    Set a faulty sensor to healthy when its excluded samples agree with the filter again.

    :param nis: of the newest sample.
    """
    onset = hypotheses[ONSET, sensor]
    onset.mean_nis += (min(nis, LARGEST_NIS) - onset.mean_nis) / RECOVERY_SAMPLES
    if onset.mean_nis < RECOVERY_NIS:
        onset.state = HEALTHY
        _restart(onset, True)
        _restart(hypotheses[PERSISTENT, sensor], True)
