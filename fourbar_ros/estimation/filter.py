# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Extended Kalman filter of the linkage.

Process model: the linkage's own dynamics, driven by what the wheels were measured to do. With
the motor torque `tau = If (alpha + dOmega/dt)` eliminated, the links move as if each carried its
wheel locked to it, under the forces `-If dOmega/dt` and two disturbance torques, which walk at
random (docs/estimation.md). What is in the state tells estimation.layout.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

from filterpy.kalman import ExtendedKalmanFilter
from fourbar_ros.estimation.bias_detection import (
    BIAS,
    FAULTY,
    LIKELIHOOD,
    no_suspicions,
    SUSPECTED,
    VERDICT,
)
from fourbar_ros.estimation.compliant_closure import turned_by_lengths
from fourbar_ros.estimation.correction import correct, USED
from fourbar_ros.estimation.filter_state import (
    ANGLES,
    BIASES,
    FREE,
    LENGTHS,
    LOOSE_BIASES,
    RATES,
    TORQUES,
)
from fourbar_ros.estimation.prediction import near_change_point, predict
from fourbar_ros.mechanism import JOINT_LINKS, Mechanism, SENSOR_NAMES
from fourbar_ros.mechanism.closure import SIGNS
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.mechanism.state import STATE_SIZE
import numpy as np
from numpy.typing import ArrayLike, NDArray

# What each of SENSOR_NAMES makes of the four links, in angles and in rates.
SENSOR_ROWS = np.vstack([np.eye(4), np.zeros((4, 4))])
for _row, (_first, _second) in enumerate(JOINT_LINKS, 4):
    SENSOR_ROWS[_row, [_first, _second]] = -1.0, 1.0

GYROS = len(SENSOR_NAMES)
"""Number of the gyro of the first of SENSOR_NAMES; the others follow."""

# Of what the links of a parallelogram, the one with the least to tell, tell of a and b.
_PARTNERS = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])

# Standard deviations at the start: of the bias of a gyro [rad/s]; the disturbance torques are as
# if they had walked for so long [s].
INITIAL_BIAS_SIGMA = 0.1
WALKED_BEFORE = 10.0

# How fast lengths may change, relative to how far they may be off [1/sqrt(s)]; and for how long
# what turns opposite links apart stays the same [s].
LENGTH_WALK = 0.01
APART_FOR = 0.3

# How well the pull of joints that give is known, relative to it: stiffness is hardly known better,
# and what mass centres beside the lines of their links do is left out. Of joints that are said to
# be rigid nothing is known but that they pull.
PULL_KNOWN_TO = 0.2

Snapshot = tuple[Array, Array, Array, tuple[int, ...]]


class ProcessNoise(NamedTuple):
    """
    What acts on the linkage at random, as densities.

    :param torque: of white torques on each link [N m/sqrt(Hz)].
    :param torque_walk: of the disturbance torques on links a and b [N m/sqrt(s)].
    :param gyro_walk: of the biases of gyros [rad/s/sqrt(s)].
    :param closure: no density, but how far the loop fails to close with the lengths that are
        given, as a standard deviation [m]; 0 where these are exact.
    """

    torque: float
    torque_walk: float = 0.0
    gyro_walk: float = 0.0
    closure: float = 0.0


class Correction(NamedTuple):
    """
    What a correction saw.

    :param innovation: (m,) measured minus predicted [rad] or [rad/s].
    :param nis: normalised square of those that were used.
    :param squares: (m,) square of each over its variance.
    :param fate: (m,) what became of each: `USED`, `REFUSED` by the gate, `LEFT_OUT` as that of a
        faulty sensor (estimation.correction).
    """

    innovation: Array
    nis: float
    squares: Array
    fate: NDArray[np.int64]

    @property
    def used(self) -> NDArray[np.bool_]:
        """Tell which were used (m,)."""
        used: NDArray[np.bool_] = self.fate == USED
        return used


class _Layout(NamedTuple):
    """How a set of sensors sees the state."""

    sensors: NDArray[np.int64]
    rows: Array
    spared: NDArray[np.bool_]


def _slack(mechanism: Mechanism, randomness: ProcessNoise) -> Array:
    """Return what the kernels are told of a loop that may fail to close, see elastic."""
    if not randomness.closure:
        return np.zeros(0)
    stiffness, damping, lighter, known_to = inf, 0.0, 0.0, 1.0
    if np.isfinite(mechanism.joint_stiffness).all():
        stiffness = 1.0 / float((1.0 / mechanism.joint_stiffness).sum())
        # At one pull in all of them, each joint has this share of the gap.
        shares = stiffness / mechanism.joint_stiffness
        damping = float(mechanism.joint_damping @ shares ** 2)
        lighter, known_to = _lighter(mechanism, shares), PULL_KNOWN_TO
    lengths = mechanism.link_lengths
    parallel = np.abs(lengths[:2] - lengths[2:]).max() <= randomness.closure
    return np.array([LENGTH_WALK * randomness.closure, stiffness, damping, lighter, known_to,
                     APART_FOR * randomness.torque_walk, 0.5 if parallel else 0.0])


def _lighter(mechanism: Mechanism, shares: Array) -> float:
    """
    Work out by what mass links are lighter to joints that share a gap than with it in joint 3.

    All but link a move by their share of the gap's rate, on top of what the rates of the links
    tell. Of the impulse that this adds to each link angle only that counts which the gap itself
    has, `s_i l_i`: the rest is for motions that leave the gap alone.

    :param shares: (4,) of the joints in the gap.
    """
    masses = mechanism.link_masses
    # Joint 1 is between a and b, 2 between b and c, and 4 between d and a.
    moved = np.array([0.0, -shares[0], -shares[0] - shares[1], shares[3]])
    moved -= masses @ moved / masses.sum()
    signed = np.array(SIGNS) * mechanism.link_lengths
    added = (masses * moved) @ mechanism.constants.arms[:, :, 0]
    return float(-2.0 * added @ signed / (signed @ signed) - masses @ moved ** 2)


class LinkageFilter(ExtendedKalmanFilter):  # type: ignore[misc]
    """
    The filter proper: predict with wheel motion, correct with measured angles and rates.

    State, covariances, gain and innovation are filterpy's attributes. Its two steps are done by
    compiled kernels.

    Where the loop may fail to close, the stiffness of the mechanism's joints counts, too.

    :param mechanism: the linkage.
    :param angles: (4,) initial link angles on the closure, continuous [rad].
    :param angle_variance: of phi_a and phi_b at the start, near a change point of all [rad^2].
    :param rate_variance: of the rates, assumed zero, likewise [rad^2/s^2].
    :param randomness: what acts on the linkage.
    """

    def __init__(self, mechanism: Mechanism, angles: Array, angle_variance: float,
                 rate_variance: float, randomness: ProcessNoise) -> None:
        super().__init__(dim_x=LOOSE_BIASES if randomness.closure else BIASES, dim_z=4)
        # An array of one: a record by itself takes longer to hand to a kernel than it runs.
        self._constants = np.array(
            [mechanism.with_rigid_joints().constants_with(np.ones(4, dtype=bool))])
        self._lengths = mechanism.link_lengths
        self._densities = np.array(randomness[:3])
        self._slack = _slack(mechanism, randomness)
        self._loose = self._slack.size > 0
        self._biases = LOOSE_BIASES if self._loose else BIASES
        self._state = np.zeros(STATE_SIZE)
        self._gyros: tuple[int, ...] = ()
        self._layouts: dict[tuple[int, ...], _Layout] = {}
        self.x = np.zeros(self._biases)
        self.x[ANGLES] = angles
        self.P = np.zeros((self._biases, self._biases))
        links = np.eye(4)
        if not near_change_point(self.x):
            links = self._after_two()
        self.P[ANGLES, ANGLES] = angle_variance * links @ links.T
        self.P[RATES, RATES] = rate_variance * links @ links.T
        self.P[TORQUES, TORQUES] = WALKED_BEFORE * randomness.torque_walk ** 2 * np.eye(2)
        if self._loose:
            self._begin_lengths(0.5 * randomness.closure)
        self._suspicions = no_suspicions(len(SENSOR_NAMES), self._biases)

    @property
    def angles(self) -> Array:
        """Return the angles of all four links, continuous (4,) [rad]."""
        angles: Array = self.x[ANGLES]
        return angles

    @property
    def rates(self) -> Array:
        """Return the rates of all four links (4,) [rad/s]."""
        rates: Array = self.x[RATES]
        return rates

    @property
    def gyros(self) -> tuple[int, ...]:
        """Return the gyros whose biases are in the state, in their order."""
        return self._gyros

    @property
    def gyro_biases(self) -> Array:
        """Return the biases of the gyros, in their order [rad/s]."""
        biases: Array = self.x[self._biases:]
        return biases

    @property
    def lengths(self) -> Array:
        """Return the lengths of the links with which the loop closes (4,) [m]."""
        lengths: Array = self._lengths.copy()
        if self._loose:
            lengths[1:] = self.x[LENGTHS]
        return lengths

    @property
    def free_covariance(self) -> Array:
        """Return the covariance of (phi_a, phi_b, omega_a, omega_b): (4, 4)."""
        covariance: Array = self.P[FREE[:, None], FREE]
        return covariance

    def sigmas(self) -> Array:
        """Return one standard deviation of each number of the state (n,)."""
        sigmas: Array = np.sqrt(self.P.diagonal())
        return sigmas

    def faulty(self) -> dict[int, float]:
        """Return the errors [rad] of sensors that are left out, by index of `SENSOR_NAMES`."""
        return self._with_verdict(FAULTY)

    def suspected(self) -> dict[int, float]:
        """Return the errors [rad] of sensors of which one, at least, is wrong, likewise."""
        return self._with_verdict(SUSPECTED)

    def suspicion(self) -> Array:
        """Return by how much an error of each sensor is likelier than none (sensors,) [nats]."""
        sums: Array = self._suspicions[:, LIKELIHOOD].reshape(2, GYROS).max(axis=0)
        return sums

    def snapshot(self) -> Snapshot:
        """Return a copy of what move and correct change, for :meth:`restore`."""
        return self.x.copy(), self.P.copy(), self._suspicions.copy(), self._gyros

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot."""
        x, covariance, suspicions, gyros = snapshot
        self.x, self.P, self._suspicions = x.copy(), covariance.copy(), suspicions.copy()
        if gyros != self._gyros:
            self._gyros = gyros
            self._layouts.clear()
            self._resize()

    def move(self, duration: float, wheel_torques: Array, unknown_torque: float = 0.0) -> None:
        """
        Predict over a time in which the wheels were accelerated evenly.

        :param duration: [s].
        :param wheel_torques: (4,) If dOmega/dt, the wheels' measured relative motion [N m].
        :param unknown_torque: how much less they are known than measured ones, as a random walk
            of the disturbance torques [N m/sqrt(s)].
        """
        densities = self._densities
        if unknown_torque:
            densities = densities.copy()
            densities[1] = sqrt(densities[1] ** 2 + unknown_torque ** 2)
        predict(self.x, self.P, self._suspicions, wheel_torques, duration, densities, self._slack,
                self._constants, self._state, self.F, self.Q)

    def correct(self, sensors: tuple[int, ...], measured: Array, variance: ArrayLike,
                gate: float = inf) -> Correction:
        """
        Update with what sensors measured, samples left out that are far off.

        S, its inverse and K are those of the samples that were used; y has all.

        :param sensors: which were measured, as indices of `SENSOR_NAMES`, and from `GYROS` on
            their gyros.
        :param measured: (m,) their angles, any turn [rad], or rates [rad/s].
        :param variance: of each, (m,) or one for all [rad^2] or [rad^2/s^2].
        :param gate: largest normalised square of an innovation that is used.
        """
        layout = self._layouts.get(sensors)
        if layout is None:
            layout = self._layouts[sensors] = self._layout(sensors)
        variances = np.empty(len(sensors))
        variances[:] = variance
        self.y, squares, self.S, self.SI, self.K, nis, fate = correct(
            self.x, self.P, self._suspicions, layout.sensors, layout.rows, measured, variances,
            gate, layout.spared, self._loose, self._constants, self._state)
        return Correction(self.y, nis, squares, fate)

    def _after_two(self) -> Array:
        """Return what all four rates are after those of links a and b (4, 2)."""
        return np.vstack([np.eye(2), gamma_matrix(self.x, self._lengths)])

    def _begin_lengths(self, sigma: float) -> None:
        """Take the lengths of links b, c and d into the state, by the error of each link [m]."""
        lengths = self._lengths[1:]
        self.x[LENGTHS] = lengths
        # Relative to that of link a.
        scale = lengths / self._lengths[0]
        covariance = sigma ** 2 * (np.eye(3) + np.outer(scale, scale))
        self.P[LENGTHS, LENGTHS] = covariance
        if not near_change_point(self.x):
            turned = turned_by_lengths(self.x, self._lengths)
            self.P[2:4, 2:4] += turned @ covariance @ turned.T
            self.P[2:4, LENGTHS] = turned @ covariance
            self.P[LENGTHS, 2:4] = self.P[2:4, LENGTHS].T

    def _with_verdict(self, verdict: float) -> dict[int, float]:
        table, found = self._suspicions, {}
        for sensor in np.flatnonzero(table[:GYROS, VERDICT] == verdict).tolist():
            old = table[GYROS + sensor, LIKELIHOOD] > table[sensor, LIKELIHOOD]
            found[sensor] = float(table[sensor + GYROS * old, BIAS])
        return found

    def _layout(self, sensors: tuple[int, ...]) -> _Layout:
        for gyro in sensors:
            if gyro >= GYROS and gyro not in self._gyros:
                self._add_gyro(gyro)
        rows = np.zeros((len(sensors), len(self.x)))
        for row, sensor in zip(rows, sensors):
            if sensor < GYROS:
                row[ANGLES] = SENSOR_ROWS[sensor]
            else:
                row[RATES] = SENSOR_ROWS[sensor - GYROS]
                row[self._biases + self._gyros.index(sensor)] = 1.0
        spared = np.ones(len(SENSOR_NAMES), np.bool_)
        angles = [sensor for sensor in sensors if sensor < GYROS]
        for sensor in angles:
            others = SENSOR_ROWS[[other for other in angles if other != sensor]] @ _PARTNERS
            spared[sensor] = np.linalg.matrix_rank(others) < 2 if len(others) else True
        return _Layout(np.array([sensor if sensor < GYROS else -1 for sensor in sensors]),
                       rows, spared)

    def _add_gyro(self, gyro: int) -> None:
        self._gyros += (gyro,)
        self._layouts.clear()
        self.x = np.append(self.x, 0.0)
        self.P = np.pad(self.P, (0, 1))
        self.P[-1, -1] = INITIAL_BIAS_SIGMA ** 2
        self._suspicions = np.pad(self._suspicions, ((0, 0), (0, 1)))
        self._resize()

    def _resize(self) -> None:
        """Make room for F and Q of the present state."""
        self.dim_x = len(self.x)
        self.F, self.Q = np.zeros_like(self.P), np.zeros_like(self.P)
