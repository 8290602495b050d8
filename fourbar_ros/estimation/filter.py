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
Extended Kalman filter of the linkage, x = (phi_a, phi_b, omega_a, omega_b).

Process model: the linkage's own dynamics, driven by what the wheels were measured to do. With
the motor torque `tau = If (alpha + dOmega/dt)` eliminated, the links move as if each carried its
wheel locked to it, under the forces `-If dOmega/dt` (docs/estimation.md).

Phi_c and phi_d follow by closure, continuously, on the branch that the filter was started on.
Gamma, which links them to the state, does not exist at a change point; close to one the last
good Gamma is kept, which is exact for a parallelogram.
"""

from __future__ import annotations

from math import inf, pi, sin, sqrt

from filterpy.kalman import ExtendedKalmanFilter
from fourbar_ros.mechanism import JOINT_LINKS, Mechanism
from fourbar_ros.mechanism.compiled import kernel
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.dynamics import gamma_matrix, mass_matrix
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.layout import STATE_SIZE
from fourbar_ros.mechanism.motion import advance_state, meet_closure
import numpy as np
from numpy.typing import NDArray

# Below this |sin(phi_d - phi_c)| the last good Gamma is kept: it divides by that sine.
GAMMA_IS_LOST = 0.05

# Half width of the central differences for the transition matrix [rad], [rad/s].
DIFFERENCE = 1e-6


# What each of SENSOR_NAMES makes of the four link angles.
SENSOR_ROWS = np.vstack([np.eye(4), np.zeros((4, 4))])
for _row, (_first, _second) in enumerate(JOINT_LINKS, 4):
    SENSOR_ROWS[_row, [_first, _second]] = -1.0, 1.0

Snapshot = tuple[Array, Array, Array, Array]


class LinkageFilter(ExtendedKalmanFilter):  # type: ignore[misc]
    """
    The filter proper: predict with wheel motion, correct with link angles.

    State, covariances, gain and innovation are filterpy's attributes. Its two steps are done by
    compiled kernels, which take a third of the time.

    :ivar angles: (4,) link angles that belong to x, continuous [rad].
    :param mechanism: the linkage.
    :param angles: (4,) initial link angles on the closure [rad].
    :param angle_variance: of phi_a and phi_b at the start [rad^2].
    :param rate_variance: of the rates, assumed zero, at the start [rad^2/s^2].
    :param disturbance: density of the random torque on each link [N m/sqrt(Hz)].
    """

    def __init__(self, mechanism: Mechanism, angles: Array, angle_variance: float,
                 rate_variance: float, disturbance: float) -> None:
        super().__init__(dim_x=4, dim_z=4)
        # An array of one: a record by itself takes longer to hand to a kernel than it runs.
        self._constants = np.array(
            [mechanism.with_rigid_joints().constants_with(np.ones(4, dtype=bool))])
        self._disturbance = disturbance
        self._state = np.zeros(STATE_SIZE)
        self.angles = np.array(angles)
        self._to_links = np.vstack([np.eye(2), np.eye(2)])
        if abs(sin(angles[3] - angles[2])) > GAMMA_IS_LOST:
            self._to_links[2:] = gamma_matrix(self.angles, mechanism.link_lengths)
        self.x = np.array([angles[0], angles[1], 0.0, 0.0])
        self.P = np.diag([angle_variance, angle_variance, rate_variance, rate_variance])

    @property
    def gamma(self) -> Array:
        """Return Gamma in use (2, 2): (omega_c, omega_d) = Gamma (omega_a, omega_b)."""
        return self._to_links[2:]

    @property
    def rates(self) -> Array:
        """Return the rates of all four links (4,) [rad/s]."""
        rates: Array = self._to_links @ self.x[2:]
        return rates

    def sigmas(self) -> tuple[Array, Array]:
        """Return one standard deviation of the four angles [rad] and rates [rad/s]: two (4,)."""
        return link_sigmas(self.P, self._to_links)

    def snapshot(self) -> Snapshot:
        """Return a copy of what move and correct change, for :meth:`restore`."""
        return self.x.copy(), self.P.copy(), self.angles.copy(), self._to_links.copy()

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot."""
        self.x, self.P, self.angles, self._to_links = (array.copy() for array in snapshot)

    def move(self, duration: float, wheel_torques: Array) -> None:
        """
        Predict over a time in which the wheels were accelerated evenly.

        :param duration: [s].
        :param wheel_torques: (4,) If dOmega/dt, the wheels' measured relative motion [N m].
        """
        predict(self.x, self.P, self.angles, self._to_links, wheel_torques, duration,
                self._disturbance, self._constants, self._state, self.F, self.Q)

    def correct(self, sensors: tuple[int, ...], measured: Array, variance: float,
                gate: float = inf) -> tuple[Array, float, NDArray[np.bool_]]:
        """
        Update with measured angles of links and joints, those left out that are far off.

        S, its inverse and K are those of the sensors that were used; y has all.

        :param sensors: which were measured, as indices of `SENSOR_NAMES`.
        :param measured: (n,) their angles, any turn [rad].
        :param variance: of each [rad^2].
        :param gate: largest normalised square of a sensor's innovation that is used.
        :returns: the wrapped innovations (n,) [rad], the normalised square (NIS) of those that
            were used, and which were (n,).
        """
        self.y, self.S, self.SI, self.K, nis, used = correct(
            self.x, self.P, self.angles, self._to_links, np.array(sensors), measured, variance,
            gate, self._constants, self._state)
        return self.y, nis, used


@kernel
def predict(x: Array, covariance: Array, angles: Array, to_links: Array, wheel_torques: Array,
            duration: float, disturbance: float, boxed: NDArray[np.record], state: Array,
            transition: Array, noise: Array) -> None:
    """
    Predict in place: filterpy's `predict` with the linkage as the model.

    :param x, covariance: (4,) and (4, 4), the filter's.
    :param angles: (4,) link angles that belong to x [rad].
    :param to_links: (4, 2) from links a, b to all four; its lower half is Gamma.
    :param boxed: (1,) constants of the mechanism.
    :param transition, noise: (4, 4) receive F and Q.
    """
    constants = boxed[0]
    gamma = to_links[2:]
    linearise(angles, x[2:], gamma, wheel_torques, duration, disturbance, constants,
              state, transition, noise)
    move_links(angles, x[2:], gamma, wheel_torques, duration, constants, state)
    # P = F P F' + Q
    covariance[:] = transition @ covariance @ transition.T + noise
    _take_over(state, x, angles, to_links, constants.lengths)


@kernel
def correct(x: Array, covariance: Array, angles: Array, to_links: Array,
            sensors: NDArray[np.int64], measured: Array, variance: float, gate: float,
            boxed: NDArray[np.record], state: Array
            ) -> tuple[Array, Array, Array, Array, float, NDArray[np.bool_]]:
    """
    Correct in place: filterpy's `update`, with wrapped innovations.

    Parameters as in :func:`predict` and :meth:`LinkageFilter.correct`.

    :returns: y (n,); of the m sensors within the gate S (m, m), its inverse, K (4, m) and the
        normalised innovation squared; and which they are (n,).
    """
    constants = boxed[0]
    count = sensors.size
    jacobian = np.zeros((count, 4))
    y = np.empty(count)
    for row in range(count):
        predicted = 0.0
        for link in range(4):
            share = SENSOR_ROWS[sensors[row], link]
            predicted += share * angles[link]
            jacobian[row, 0] += share * to_links[link, 0]
            jacobian[row, 1] += share * to_links[link, 1]
        y[row] = pi - (pi - measured[row] + predicted) % (2.0 * pi)
    # S = H P H' + R, K = P H' S^-1
    s = jacobian @ covariance @ jacobian.T + variance * np.eye(count)
    used = np.empty(count, np.bool_)
    many = 0
    for row in range(count):
        used[row] = y[row] * y[row] <= gate * s[row, row]
        many += used[row]
    if many == 0:
        nothing = np.zeros((0, 0))
        return y, nothing, nothing, np.zeros((4, 0)), 0.0, used
    good = y
    if many < count:
        good, jacobian = y[used], jacobian[used]
        s = jacobian @ covariance @ jacobian.T + variance * np.eye(many)
    noise = variance * np.eye(many)
    inverse = np.linalg.inv(s)
    gain = covariance @ jacobian.T @ inverse
    change = gain @ good
    x += change
    # P = (I - K H) P (I - K H)' + K R K'
    rest = np.eye(4) - gain @ jacobian
    covariance[:] = rest @ covariance @ rest.T + gain @ noise @ gain.T
    state[0:4] = angles + to_links @ change[:2]
    state[4:8] = to_links @ x[2:]
    meet_closure(state, constants)
    _take_over(state, x, angles, to_links, constants.lengths)
    return y, s, inverse, gain, float(good @ inverse @ good), used


@kernel
def link_sigmas(covariance: Array, to_links: Array) -> tuple[Array, Array]:
    """Evaluate one standard deviation of angles and rates of the four links: two (4,)."""
    sigmas = np.empty((2, 4))
    for half in range(2):
        first = 2 * half
        for link in range(4):
            a, b = to_links[link, 0], to_links[link, 1]
            sigmas[half, link] = sqrt(
                a * a * covariance[first, first] + b * b * covariance[first + 1, first + 1]
                + a * b * (covariance[first, first + 1] + covariance[first + 1, first]))
    return sigmas[0], sigmas[1]


@kernel
def _take_over(state: Array, x: Array, angles: Array, to_links: Array, lengths: Array) -> None:
    """Set x and what belongs to it from angles and rates of the links."""
    angles[:] = state[0:4]
    x[:2] = state[0:2]
    x[2:] = state[4:6]
    if abs(sin(angles[3] - angles[2])) > GAMMA_IS_LOST:
        to_links[2:] = gamma_matrix(angles, lengths)


@kernel
def move_links(angles: Array, rates: Array, gamma: Array, wheel_torques: Array, duration: float,
               constants: Constants, state: Array) -> None:
    """
    Integrate the links, wheels locked, under minus the torques that moved the wheels.

    :param angles: (4,) [rad].
    :param rates: (2,) of links a and b [rad/s].
    :param state: (STATE_SIZE,) receives angles and rates of the links.
    """
    state[:] = 0.0
    state[0:4] = angles
    state[4:6] = rates
    state[6] = gamma[0, 0] * rates[0] + gamma[0, 1] * rates[1]
    state[7] = gamma[1, 0] * rates[0] + gamma[1, 1] * rates[1]
    advance_state(state, wheel_torques, wheel_torques, wheel_torques, duration, constants, NOTHING)


@kernel
def linearise(
    angles: Array, rates: Array, gamma: Array, wheel_torques: Array, duration: float,
    disturbance: float, constants: Constants, state: Array, transition: Array, noise: Array,
) -> None:
    """
    Evaluate transition matrix and process noise of :func:`move_links`.

    :param transition: (4, 4) receives d x(end) / d x(start).
    :param noise: (4, 4) receives the covariance that random link torques of density
        `disturbance` [N m/sqrt(Hz)] leave after `duration`.
    """
    trial_angles, trial_rates, trial_gamma = np.empty(4), np.empty(2), gamma.copy()
    for column in range(4):
        for sign in (1.0, -1.0):
            trial_angles[:] = angles
            trial_rates[:] = rates
            if column < 2:
                trial_angles[column] += sign * DIFFERENCE
                trial_angles[2] += sign * DIFFERENCE * gamma[0, column]
                trial_angles[3] += sign * DIFFERENCE * gamma[1, column]
                if abs(sin(angles[3] - angles[2])) > GAMMA_IS_LOST:
                    trial_gamma[:] = gamma_matrix(trial_angles, constants.lengths)
            else:
                trial_gamma[:] = gamma
                trial_rates[column - 2] += sign * DIFFERENCE
            move_links(trial_angles, trial_rates, trial_gamma, wheel_torques, duration, constants,
                       state)
            for row in range(4):
                # Angles a, b are state[0:2], rates a, b are state[4:6].
                end = state[row] if row < 2 else state[row + 2]
                if sign > 0.0:
                    transition[row, column] = end
                else:
                    transition[row, column] -= end
                    transition[row, column] /= 2.0 * DIFFERENCE
    _process_noise(angles, gamma, duration, disturbance, constants, noise)


@kernel
def _process_noise(angles: Array, gamma: Array, duration: float,
                   disturbance: float, constants: Constants, noise: Array) -> None:
    a00, a01, a11 = _reduced_mass(angles, gamma, constants)
    # Covariance density of G tau for independent link torques, then of the accelerations.
    density = disturbance * disturbance
    f00 = density * (1.0 + gamma[0, 0] ** 2 + gamma[1, 0] ** 2)
    f01 = density * (gamma[0, 0] * gamma[0, 1] + gamma[1, 0] * gamma[1, 1])
    f11 = density * (1.0 + gamma[0, 1] ** 2 + gamma[1, 1] ** 2)
    scale = 1.0 / (a00 * a11 - a01 * a01)
    i00, i01, i11 = a11 * scale, -a01 * scale, a00 * scale
    l00, l01 = i00 * f00 + i01 * f01, i00 * f01 + i01 * f11
    l10, l11 = i01 * f00 + i11 * f01, i01 * f01 + i11 * f11
    q00 = l00 * i00 + l01 * i01
    q01 = l00 * i01 + l01 * i11
    q11 = l10 * i01 + l11 * i11
    for row in range(4):
        for column in range(4):
            axis_row, axis_column = row % 2, column % 2
            value = q01 if axis_row != axis_column else (q11 if axis_row else q00)
            order = (row < 2) + (column < 2)
            if order == 2:
                value *= duration ** 3 / 3.0
            elif order == 1:
                value *= duration ** 2 / 2.0
            else:
                value *= duration
            noise[row, column] = value


@kernel
def _reduced_mass(angles: Array, gamma: Array, constants: Constants
                  ) -> tuple[float, float, float]:
    """Evaluate A = W^T M W with the given Gamma."""
    matrix = mass_matrix(angles, constants)
    a = np.zeros((2, 2))
    for i in range(2):
        for j in range(2):
            a[i, j] = matrix[i, j]
            for k in range(2):
                a[i, j] += (matrix[i, 2 + k] * gamma[k, j] + matrix[j, 2 + k] * gamma[k, i])
                for m in range(2):
                    a[i, j] += gamma[k, i] * matrix[2 + k, 2 + m] * gamma[m, j]
    return a[0, 0], a[0, 1], a[1, 1]
