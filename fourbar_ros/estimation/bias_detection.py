# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Which sensor has a constant error: one suspicion each, that everything is as it seems but for it.

A suspicion is the filter with a bias of one sensor as a further state, split into the filter
without it and what the bias does to that (B. Friedland, Treatment of bias in recursive filtering,
IEEE Trans. Automatic Control 14, 1969, p. 359): `effect` is the error of the filter's state per
bias. The likelihood of what was measured, with that bias over without it, is added up as a
cumulative sum (E. S. Page, Continuous inspection schemes, Biometrika 41, 1954, p. 100): where it
would fall below zero the suspicion begins anew, with a filter that has seen no error yet.

White noise is the same in both likelihoods, so a sensor's noise raises no suspicion, and neither
does what the linkage does: partners differ in what they say about it.

Every sensor has a second suspicion, of an error that has been there for long: what a bias does to
the filter is then what is left when it has settled. Partners explain that equally well. So it is a
sensor's beginning to err that tells it from its partner, and where nobody saw that, the two sums
rise together and both are named.
"""

from __future__ import annotations

from math import log

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

# A row of the table of suspicions: these, then the effect (n,).
BIAS, VARIANCE, LIKELIHOOD, VERDICT, MISFIT = range(5)
SCALARS = 5

# What the table says of a sensor.
HEALTHY, SUSPECTED, FAULTY = 0.0, 1.0, 2.0

# Standard deviation of a bias before anything is known of it [rad], and how it walks: errors that
# grow are biases, too [rad/sqrt(s)].
BIAS_SIGMA = 0.01
BIAS_WALK = 0.005

# A sensor is at fault when its sum reaches so much [nats], one in e^20 by chance, and no other
# sensor's comes as close as that.
ALARM = 20.0
LEAD = 10.0

# Those who come closer are all named when nobody leads by then, and until their sums fall below
# ALARM. From each sample's sum this is taken off, so that what nothing speaks for any more is
# forgotten in seconds.
TOGETHER = 50.0
FORGET = 0.05
LEAST = 1e-3

# A faulty sensor is used again when its samples, over the last so many, are as near to what was
# expected as noise has them: the mean normalised square of their innovations, 1 in health.
AGREES_OVER = 50.0
AGREES_BELOW = 1.6
LARGEST_SQUARE = 9.0


def no_suspicions(sensors: int, size: int) -> Array:
    """
    Return the table (2 sensors, SCALARS + size) that suspects nobody.

    First come the suspicions of errors that began, one for each sensor, then those of old ones;
    verdicts stand in the first.
    """
    table = np.zeros((2 * sensors, SCALARS + size))
    table[:, VARIANCE] = BIAS_SIGMA ** 2
    return table


@kernel
def begin_anew(suspicion: Array, without_effect: bool) -> None:
    """
    Suspect nothing, but keep the verdict.

    :param without_effect: whether the filter is as if there had been no error.
    """
    suspicion[BIAS] = suspicion[LIKELIHOOD] = 0.0
    suspicion[VARIANCE] = BIAS_SIGMA * BIAS_SIGMA
    if without_effect:
        suspicion[SCALARS:] = 0.0


@kernel
def carry_suspicion(suspicion: Array, transition: Array, duration: float) -> None:
    """Let the effect of a suspected bias move on with the state, and the bias walk."""
    size = transition.shape[0]
    effect = suspicion[SCALARS:]
    for k in range(size):
        if effect[k] != 0.0:
            break
    else:
        return
    moved = np.zeros(size)
    for i in range(size):
        for k in range(size):
            moved[i] += transition[i, k] * effect[k]
    effect[:] = moved
    suspicion[VARIANCE] += BIAS_WALK * BIAS_WALK * duration


@kernel
def weigh(suspicions: Array, sensors: NDArray[np.int64], rows: Array, innovation: Array,
          inverse: Array, gain: Array) -> None:
    """
    Take an update of the filter into account, in place.

    :param suspicions: (2 sensors, SCALARS + n).
    :param sensors: (m,) which sensor each innovation is of, below zero for a gyro's.
    :param rows: (m, n) H.
    :param innovation: (m,).
    :param inverse: (m, m) of the innovation's covariance.
    :param gain: (n, m) K, zero for samples that the gate refused.
    """
    many, size = rows.shape
    signature, weighted = np.empty(many), np.empty(many)
    count = suspicions.shape[0] // 2
    for n in range(2 * count):
        sensor, old = n % count, n >= count
        suspicion = suspicions[n]
        if suspicions[sensor, VERDICT] == FAULTY:
            continue
        effect = suspicion[SCALARS:]
        concerned = suspicion[LIKELIHOOD] > 0.0
        for m in range(many):
            # What the bias adds to the innovation, per bias.
            signature[m] = 1.0 if sensors[m] == sensor else 0.0
            concerned |= sensors[m] == sensor
            for i in range(size):
                signature[m] -= rows[m, i] * effect[i]
        if not concerned:
            continue
        precision = seen = 0.0
        for m in range(many):
            weighted[m] = 0.0
            for k in range(many):
                weighted[m] += inverse[m, k] * signature[k]
            precision += signature[m] * weighted[m]
            seen += weighted[m] * innovation[m]
        bias, variance = suspicion[BIAS], suspicion[VARIANCE]
        rest, growth = seen - bias * precision, 1.0 + variance * precision
        likelihood = suspicion[LIKELIHOOD] + (
            bias * seen - 0.5 * bias * bias * precision
            + 0.5 * (rest * rest * variance / growth - log(growth)) - FORGET)
        if likelihood > 0.0:
            suspicion[LIKELIHOOD] = likelihood
            suspicion[VARIANCE] = variance / growth
            suspicion[BIAS] = bias + suspicion[VARIANCE] * rest
        else:
            begin_anew(suspicion, not old)
        if likelihood > 0.0 or old:
            for i in range(size):
                for m in range(many):
                    effect[i] += gain[i, m] * signature[m]


@kernel
def _stronger(suspicions: Array, sensor: int) -> Array:
    """Return the likelier of a sensor's two suspicions."""
    old: Array = suspicions[suspicions.shape[0] // 2 + sensor]
    new: Array = suspicions[sensor]
    return old if old[LIKELIHOOD] > new[LIKELIHOOD] else new


@kernel
def judge(x: Array, covariance: Array, suspicions: Array, spared: NDArray[np.bool_]) -> bool:
    """
    Name who is at fault, and undo what the error of one that is left out did, in place.

    :param spared: (sensors,) those that cannot be done without.
    :returns: whether the state was changed.
    """
    count = suspicions.shape[0] // 2
    worst, highest = 0, 0.0
    for sensor in range(count):
        likelihood = _stronger(suspicions, sensor)[LIKELIHOOD]
        if likelihood > highest:
            worst, highest = sensor, likelihood
    # None is so high that it could not be forgotten; the differences stay.
    excess = max(0.0, highest - 2.0 * TOGETHER)
    if excess > 0.0:
        for suspicion in suspicions:
            if suspicion[LIKELIHOOD] > 0.0:
                suspicion[LIKELIHOOD] = max(suspicion[LIKELIHOOD] - excess, LEAST)
        highest -= excess
    alone = highest > ALARM
    for sensor in range(count):
        if suspicions[sensor, VERDICT] == FAULTY:
            continue
        likelihood = _stronger(suspicions, sensor)[LIKELIHOOD]
        close = likelihood > highest - LEAD
        if highest > TOGETHER and close:
            suspicions[sensor, VERDICT] = SUSPECTED
        elif likelihood < ALARM or not close:
            suspicions[sensor, VERDICT] = HEALTHY
        alone &= sensor == worst or not close
    if alone and spared[worst]:
        suspicions[worst, VERDICT] = SUSPECTED
    if not alone or spared[worst]:
        return False
    suspicion = _stronger(suspicions, worst)
    bias, variance = suspicion[BIAS], suspicion[VARIANCE]
    for i in range(x.size):
        x[i] -= suspicion[SCALARS + i] * bias
        for k in range(x.size):
            covariance[i, k] += (variance * suspicion[SCALARS + i] * suspicion[SCALARS + k])
    # The others' sums are about a filter that believed this one.
    for n in range(2 * count):
        if suspicions[n % count, VERDICT] != FAULTY:
            begin_anew(suspicions[n], True)
    suspicions[worst, VERDICT], suspicions[worst, MISFIT] = FAULTY, LARGEST_SQUARE
    suspicions[worst, BIAS] = bias
    return True


@kernel
def seen_again(suspicions: Array, sensor: int, square: float) -> None:
    """
    Take note of a sample of a faulty sensor that was not used; it may have come back.

    :param square: of its innovation, normalised.
    """
    suspicion = suspicions[sensor]
    suspicion[MISFIT] += (min(square, LARGEST_SQUARE) - suspicion[MISFIT]) / AGREES_OVER
    if suspicion[MISFIT] < AGREES_BELOW:
        suspicion[VERDICT] = HEALTHY
        begin_anew(suspicion, True)
        begin_anew(suspicions[suspicions.shape[0] // 2 + sensor], True)
