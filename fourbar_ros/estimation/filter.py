# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Extended Kalman filter of the linkage.

The process model is the dynamics of the linkage, driven by the measured motion of the wheels.
With the motor torque `tau = If (alpha + dOmega/dt)` eliminated, the links move as if each wheel
were locked to its link, under the torques `-If dOmega/dt` and two disturbance torques, which are
random walks (docs/estimation.md). :mod:`fourbar_ros.estimation.filter_state` describes the state.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

from fourbar_ros.estimation.bias_detection import (
    FAULTY,
    initial_hypotheses,
    ONSET,
    PERSISTENT,
    SUSPECTED,
)
from fourbar_ros.estimation.compliant_closure import angles_by_lengths
from fourbar_ros.estimation.estimate import Innovation
from fourbar_ros.estimation.filter_model import make_model, ProcessNoise, Records
from fourbar_ros.estimation.filter_state import (
    ANGLES,
    FREE,
    GYROS,
    LENGTHS,
    RATES,
    SENSOR_ROWS,
    SIZE_EXACT,
    SIZE_WITH_LENGTHS,
    TORQUES,
)
from fourbar_ros.estimation.filterpy_ekf import ExtendedKalmanFilter
from fourbar_ros.estimation.measurement_update import SENSOR_ROW, update
from fourbar_ros.estimation.prediction import near_change_point, predict
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
import numpy as np
from numpy.typing import ArrayLike

# Initial standard deviation of the bias of a gyro [rad/s].
INITIAL_BIAS_SIGMA = 0.1

# Age of the random walk of the disturbance torques at the start [s]; sets their initial variance.
TORQUE_WALK_AGE = 10.0

# Angles of links a and b, to which those of c and d add nothing in a parallelogram, by the angles
# of all links: whether a set of sensors observes the configuration of every linkage.
_PARALLELOGRAM = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])


class Snapshot(NamedTuple):
    """What predict and update change, for :meth:`LinkageFilter.restore`."""

    x: Array
    covariance: Array
    hypotheses: Array
    gyros: tuple[int, ...]


class LinkageFilter(ExtendedKalmanFilter):  # type: ignore[misc]
    """
    Predict with the motion of the wheels, update with measured angles and rates.

    State, covariances, gain and innovation are attributes of filterpy's filter. Compiled kernels
    replace its two steps.

    With uncertain link lengths, the stiffness of the mechanism's joints matters as well.

    :param mechanism: the linkage.
    :param angles: (4,) initial link angles on the closure, continuous [rad].
    :param angle_variance: initial variance of phi_a and phi_b; near a change point, of all link
        angles [rad^2].
    :param rate_variance: initial variance of the rates, which start at zero [rad^2/s^2].
    :param process_noise: densities of the process noise.
    """

    def __init__(self, mechanism: Mechanism, angles: Array, angle_variance: float,
                 rate_variance: float, process_noise: ProcessNoise) -> None:
        tolerance = process_noise.closure_tolerance
        self._first_bias = SIZE_WITH_LENGTHS if tolerance else SIZE_EXACT
        super().__init__(dim_x=self._first_bias, dim_z=4)
        self._nominal_lengths = mechanism.link_lengths
        self._torque_walk = process_noise.torque_walk
        self._model = make_model(mechanism, process_noise)
        self._models = {0.0: self._model}
        self._gyros: tuple[int, ...] = ()
        self._sensor_rows: dict[tuple[int, ...], Records] = {}
        self._hypotheses = initial_hypotheses()
        # The same memory as numbers: numpy copies records field by field, and numbers at once.
        self._hypotheses_memory = self._hypotheses.view(np.uint64)
        self.x = np.zeros(self._first_bias)
        self.x[ANGLES] = angles
        self.P = np.zeros((self._first_bias, self._first_bias))
        links = np.eye(4)
        if not near_change_point(self.x):
            links = np.vstack([np.eye(2), gamma_matrix(self.x, mechanism.link_lengths)])
        self.P[ANGLES, ANGLES] = angle_variance * links @ links.T
        self.P[RATES, RATES] = rate_variance * links @ links.T
        self.P[TORQUES, TORQUES] = TORQUE_WALK_AGE * process_noise.torque_walk ** 2 * np.eye(2)
        if tolerance:
            self._start_lengths(0.5 * tolerance)

    @property
    def angles(self) -> Array:
        """Angles of all four links, continuous (4,) [rad]."""
        angles: Array = self.x[ANGLES]
        return angles

    @property
    def rates(self) -> Array:
        """Rates of all four links (4,) [rad/s]."""
        rates: Array = self.x[RATES]
        return rates

    @property
    def gyro_biases(self) -> dict[int, float]:
        """Biases of the gyros in the state [rad/s], by index of `SENSOR_NAMES`."""
        return {gyro - GYROS: bias for gyro, bias in zip(
            self._gyros, self.x[self._first_bias:].tolist())}

    @property
    def lengths(self) -> Array:
        """Lengths of the links with which the loop closes (4,) [m]."""
        lengths: Array = self._nominal_lengths.copy()
        if self._first_bias == SIZE_WITH_LENGTHS:
            lengths[1:] = self.x[LENGTHS]
        return lengths

    @property
    def free_covariance(self) -> Array:
        """Covariance of (phi_a, phi_b, omega_a, omega_b): (4, 4)."""
        covariance: Array = self.P[FREE[:, None], FREE]
        return covariance

    def sigmas(self) -> Array:
        """Return the standard deviation of each element of the state (n,)."""
        sigmas: Array = np.sqrt(self.P.diagonal())
        return sigmas

    def faulty(self) -> dict[int, float]:
        """Return the biases [rad] of faulty sensors, by index of `SENSOR_NAMES`."""
        return self._biases_in_state(FAULTY)

    def suspected(self) -> dict[int, float]:
        """Return the biases [rad] of suspected sensors, of which at least one is faulty."""
        return self._biases_in_state(SUSPECTED)

    def glr_statistics(self) -> Array:
        """Return the GLR statistic of a bias of each sensor (sensors,) [nats]."""
        statistics: Array = self._hypotheses['glr'].max(axis=0)
        return statistics

    def snapshot(self) -> Snapshot:
        """Return a copy of what predict and update change."""
        return Snapshot(
            self.x.copy(), self.P.copy(), self._hypotheses_memory.copy(), self._gyros)

    def restore(self, snapshot: Snapshot) -> None:
        """Return to a snapshot."""
        self.x, self.P = snapshot.x.copy(), snapshot.covariance.copy()
        self._hypotheses_memory[:] = snapshot.hypotheses
        if snapshot.gyros != self._gyros:
            self._set_gyros(snapshot.gyros)

    def predict(self, duration: float, wheel_torques: Array, unknown_torque: float = 0.0) -> None:
        """
        Predict over a time with constant accelerations of the wheels.

        :param duration: [s].
        :param wheel_torques: (4,) If dOmega/dt, from the measured relative motion [N m].
        :param unknown_torque: additional random walk of the disturbance torques, where the motion
            of the wheels is not measured [N m/sqrt(s)].
        """
        model = self._models.get(unknown_torque)
        if model is None:
            model = self._models[unknown_torque] = self._model.copy()
            model['torque_walk'] = sqrt(self._torque_walk ** 2 + unknown_torque ** 2)
        predict(self.x, self.P, self._hypotheses, model, wheel_torques, duration, self.F, self.Q)

    def update(self, sensors: tuple[int, ...], measured: Array, variance: ArrayLike,
               gate: float = inf) -> Innovation:
        """
        Update with the samples of some sensors, except for samples outside the gate.

        S, its inverse and K are those of the accepted samples; y has all.

        :param sensors: indices of `SENSOR_NAMES`, and from `GYROS` on of their gyros.
        :param measured: (m,) angles, any turn [rad], or rates [rad/s].
        :param variance: of each sample, (m,) or one for all [rad^2] or [rad^2/s^2].
        :param gate: largest NIS of a sample that is accepted.
        """
        rows = self._sensor_rows.get(sensors)
        if rows is None:
            rows = self._sensor_rows[sensors] = self._make_sensor_rows(sensors)
        if isinstance(variance, np.ndarray):
            variances = variance
        else:
            variances = np.full(len(sensors), variance, float)
        self.S, self.SI, self.K, nis, self.y, sample_nis, statuses = update(
            self.x, self.P, self._hypotheses, rows, measured, variances, gate, self._model)
        return Innovation(sensors, self.y, sample_nis, statuses, nis, len(self.S))

    def _start_lengths(self, sigma: float) -> None:
        """
        Start the lengths of links b, c and d in the state.

        :param sigma: standard deviation of the length of each link, that of a included [m].
        """
        lengths = self._nominal_lengths[1:]
        self.x[LENGTHS] = lengths
        # The length of link a is the unit of length.
        scale = lengths / self._nominal_lengths[0]
        covariance = sigma ** 2 * (np.eye(3) + np.outer(scale, scale))
        self.P[LENGTHS, LENGTHS] = covariance
        if not near_change_point(self.x):
            slopes = angles_by_lengths(self.x[ANGLES], self._nominal_lengths)
            self.P[2:4, 2:4] += slopes @ covariance @ slopes.T
            self.P[2:4, LENGTHS] = slopes @ covariance
            self.P[LENGTHS, 2:4] = self.P[2:4, LENGTHS].T

    def _biases_in_state(self, state: int) -> dict[int, float]:
        onset, persistent = self._hypotheses[ONSET], self._hypotheses[PERSISTENT]
        likelier = np.where(persistent['glr'] > onset['glr'], persistent['bias'], onset['bias'])
        return {sensor: float(likelier[sensor])
                for sensor in np.flatnonzero(onset['state'] == state).tolist()}

    def _make_sensor_rows(self, sensors: tuple[int, ...]) -> Records:
        """Return the records of some sensors; new gyros are added to the state."""
        missing = tuple(gyro for gyro in sensors if gyro >= GYROS and gyro not in self._gyros)
        for _ in missing:
            self.x = np.append(self.x, 0.0)
            self.P = np.pad(self.P, (0, 1))
            self.P[-1, -1] = INITIAL_BIAS_SIGMA ** 2
        if missing:
            self._set_gyros(self._gyros + missing)
        rows = np.zeros(len(sensors), SENSOR_ROW)
        angles = [sensor for sensor in sensors if sensor < GYROS]
        for row, sensor in zip(rows, sensors):
            if sensor < GYROS:
                row['sensor'], row['row'][ANGLES] = sensor, SENSOR_ROWS[sensor]
                others = [other for other in angles if other != sensor]
                observed = SENSOR_ROWS[others] @ _PARALLELOGRAM
                row['indispensable'] = not others or np.linalg.matrix_rank(observed) < 2
            else:
                row['sensor'], row['row'][RATES] = -1, SENSOR_ROWS[sensor - GYROS]
                row['row'][self._first_bias + self._gyros.index(sensor)] = 1.0
        return rows

    def _set_gyros(self, gyros: tuple[int, ...]) -> None:
        """Set the gyros whose biases are in the state, and size F and Q accordingly."""
        self._gyros = gyros
        self._sensor_rows.clear()
        self.dim_x = len(self.x)
        self.F, self.Q = np.zeros_like(self.P), np.zeros_like(self.P)
