# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Which sensor has a constant error: one suspicion each, that everything is as it seems but for it.

A suspicion is the filter with a bias of one sensor as a further state, split into the filter
without it and what the bias does to that (B. Friedland, Treatment of bias in recursive filtering,
IEEE Trans. Automatic Control 14, 1969, p. 359): `effect` is the error of the filter's state per
bias. The likelihood of what was measured, with that bias over without it, is added up as a
cumulative sum (E. S. Page, Continuous inspection schemes, Biometrika 41, 1954, p. 100): where it
would fall below zero the suspicion begins anew, with a filter that has seen no error yet.

White noise is the same in both likelihoods, so a sensor's noise raises no suspicion, and neither
does what the linkage does: partners differ in what they say about it. Where the sums of several
sensors rise together, they cannot be told apart.
"""

from __future__ import annotations

from math import log

from fourbar_ros.mechanism.compiled import kernel
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

# A faulty sensor is used again when its samples, over the last so many, are as near to what was
# expected as noise has them: the mean normalised square of their innovations, 1 in health.
AGREES_OVER = 50.0
AGREES_BELOW = 1.6
LARGEST_SQUARE = 9.0


def no_suspicions(sensors: int, size: int) -> Array:
    """Return the table (sensors, SCALARS + size) that suspects nobody."""
    table = np.zeros((sensors, SCALARS + size))
    table[:, VARIANCE] = BIAS_SIGMA ** 2
    return table


@kernel
def begin_anew(suspicion: Array) -> None:
    """Suspect nothing, but keep the verdict."""
    suspicion[BIAS] = suspicion[LIKELIHOOD] = 0.0
    suspicion[VARIANCE] = BIAS_SIGMA * BIAS_SIGMA
    suspicion[SCALARS:] = 0.0


@kernel
def carry_suspicion(suspicion: Array, transition: Array, duration: float) -> None:
    """Let the effect of a suspected bias move on with the state, and the bias walk."""
    if suspicion[LIKELIHOOD] == 0.0:
        return
    size = transition.shape[0]
    effect = suspicion[SCALARS:]
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

    :param suspicions: (sensors, SCALARS + n).
    :param sensors: (m,) which sensor each innovation is of, below zero for a gyro's.
    :param rows: (m, n) H.
    :param innovation: (m,) of the samples that were used.
    :param inverse: (m, m) of the innovation's covariance.
    :param gain: (n, m) K.
    """
    many, size = rows.shape
    signature, weighted = np.empty(many), np.empty(many)
    for sensor in range(suspicions.shape[0]):
        suspicion = suspicions[sensor]
        if suspicion[VERDICT] == FAULTY:
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
            + 0.5 * (rest * rest * variance / growth - log(growth)))
        if not likelihood > 0.0:
            begin_anew(suspicion)
            continue
        suspicion[LIKELIHOOD] = likelihood
        suspicion[VARIANCE] = variance / growth
        suspicion[BIAS] = bias + suspicion[VARIANCE] * rest
        for i in range(size):
            for m in range(many):
                effect[i] += gain[i, m] * signature[m]


@kernel
def judge(x: Array, covariance: Array, suspicions: Array, spared: NDArray[np.bool_]) -> bool:
    """
    Name who is at fault, and undo what the error of one that is left out did, in place.

    :param spared: (sensors,) those that cannot be done without.
    :returns: whether the state was changed.
    """
    worst = 0
    for sensor in range(suspicions.shape[0]):
        if suspicions[sensor, LIKELIHOOD] > suspicions[worst, LIKELIHOOD]:
            worst = sensor
    highest = suspicions[worst, LIKELIHOOD]
    alone = highest > ALARM
    for sensor in range(suspicions.shape[0]):
        suspicion = suspicions[sensor]
        if suspicion[VERDICT] == FAULTY:
            continue
        close = suspicion[LIKELIHOOD] > highest - LEAD
        if highest > ALARM and close:
            suspicion[VERDICT] = SUSPECTED
        elif suspicion[LIKELIHOOD] == 0.0 or highest > ALARM:
            suspicion[VERDICT] = HEALTHY
        alone &= sensor == worst or not close
    if not alone or spared[worst]:
        return False
    suspicion = suspicions[worst]
    bias, variance = suspicion[BIAS], suspicion[VARIANCE]
    for i in range(x.size):
        x[i] -= suspicion[SCALARS + i] * bias
        for k in range(x.size):
            covariance[i, k] += (variance * suspicion[SCALARS + i] * suspicion[SCALARS + k])
    suspicion[VERDICT], suspicion[MISFIT] = FAULTY, LARGEST_SQUARE
    # The others' sums are about a filter that believed this one.
    for sensor in range(suspicions.shape[0]):
        if suspicions[sensor, VERDICT] != FAULTY:
            begin_anew(suspicions[sensor])
    begin_anew(suspicion)
    suspicion[BIAS] = bias
    return True


@kernel
def seen_again(suspicion: Array, square: float) -> None:
    """
    Take note of a sample of a faulty sensor that was not used; it may have come back.

    :param square: of its innovation, normalised.
    """
    suspicion[MISFIT] += (min(square, LARGEST_SQUARE) - suspicion[MISFIT]) / AGREES_OVER
    if suspicion[MISFIT] < AGREES_BELOW:
        suspicion[VERDICT] = HEALTHY
        begin_anew(suspicion)
