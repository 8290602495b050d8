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

"""The controller: estimates and setpoints in, wheel torques out, one set per tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sin

from fourbar_ros.control.reference import SoftStep
from fourbar_ros.control.setpoint import check_names, plan, SetpointError
from fourbar_ros.control.tracking import computed_torques
from fourbar_ros.mechanism import Mechanism, nearest_assembly
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
import numpy as np

# A setpoint with a stamp (not zero, which means now) may be this far from the last tick [s].
SETPOINT_TIMEOUT = 1.0

# Closer to a change point than this |sin(phi_d - phi_c)| the wheels get no torque.
NO_HOLD = 0.05

# A longer silence than this between two ticks does not count as motion [s].
LONGEST_PERIOD = 0.1


@dataclass(frozen=True)
class ControllerSettings:
    """
    How the controller behaves.

    :param bandwidth: of the tracking law [rad/s].
    :param damping: damping ratio of the tracking law.
    :param setpoint_duration: time in which a setpoint is reached [s].
    """

    bandwidth: float = 4.0
    damping: float = 0.9
    setpoint_duration: float = 10.0


@dataclass(frozen=True, eq=False)
class Control:
    """
    What the controller does at a tick.

    :param stamp_ns: the tick [ns].
    :param torques: (4,) on the wheels [N m].
    :param reference_angles, reference_rates: (4,) of the links [rad], [rad/s].
    :param angle_errors, rate_errors: (4,) reference minus estimate [rad], [rad/s].
    :param flywheel_energy: kinetic energy of the wheels, paper eq. 7 [J].
    :param eq9: cumulative "power" as eq. 9 is printed, since arming [J s].
    :param work: cumulative mechanical work of the motors, without regard to sign [J].
    """

    stamp_ns: int
    torques: Array
    reference_angles: Array
    reference_rates: Array
    angle_errors: Array
    rate_errors: Array
    flywheel_energy: float
    eq9: float
    work: float


class Controller:
    """
    Computed-torque tracking of (phi_a, phi_b), shared by four wheels.

    Until the device is armed, and after each disarm, the reference is the present estimate, the
    torques are zero and there is no goal.

    :ivar settings: may be replaced at any time; a move under way keeps its duration.
    :ivar mode: `disarmed`, `hold` or `track`.
    :ivar goal: (4,) last accepted goal [rad], or None.
    :ivar accepted, refused: number of setpoints.
    :ivar last_refusal: why the last refused setpoint was refused, or ''.
    :ivar saturated: number of ticks at which the motors could not give what was asked.
    """

    def __init__(self, mechanism: Mechanism, settings: ControllerSettings) -> None:
        self.settings = settings
        self.mode = 'disarmed'
        self.goal: Array | None = None
        self.accepted = 0
        self.refused = 0
        self.last_refusal = ''
        self.saturated = 0
        self._mechanism = mechanism
        self._constants = np.array([mechanism.constants])
        self._limits: list[float] = mechanism.motor_torque_limits.tolist()
        self._armed = False
        self._move: SoftStep | None = None
        self._move_start_ns = 0
        self._reference = np.zeros((3, 2))
        self._reference_angles = np.zeros(4)
        self._stamp_ns: int | None = None
        self._eq9 = 0.0
        self._work = 0.0
        # Compile the kernels now, not while time runs.
        square = np.array([0.0, pi / 2.0, 0.0, pi / 2.0])
        SoftStep(np.zeros((3, 2)), np.zeros(2), 1.0).at(0.5)
        computed_torques(square, np.zeros(4), np.zeros(2), self._constants)
        gamma_matrix(square, mechanism.link_lengths)

    def device_armed(self, armed: bool) -> None:
        """Follow the device's arming state."""
        self._armed = armed

    def setpoint(self, names: Sequence[str], positions: Sequence[float], stamp_ns: int = 0
                 ) -> None:
        """
        Accept a new goal, to be reached by a soft step that starts at the next tick.

        :param names: any of the four links; one that is not named follows or holds.
        :param positions: goal angle of each [rad].
        :param stamp_ns: when it was given, 0 for now [ns].
        :raises SetpointError: it is refused whole, and nothing changes; also counted.
        """
        try:
            self._plan(names, positions, stamp_ns)
        except SetpointError as error:
            self.refused += 1
            self.last_refusal = str(error)
            raise
        self.accepted += 1

    def tick(self, stamp_ns: int, link_angles: Array, link_rates: Array, wheel_speeds: Array,
             efforts: Array) -> Control:
        """
        Decide on the torques for one tick.

        :param link_angles: (4,) estimated [rad].
        :param link_rates: (4,) estimated [rad/s].
        :param wheel_speeds: (4,) measured, relative to the links [rad/s].
        :param efforts: (4,) torques really applied since the last tick [N m].
        """
        was = self.mode
        if not self._armed:
            self.mode, self.goal, self._move = 'disarmed', None, None
        elif was == 'disarmed':
            self.mode = 'hold'
            self._eq9 = self._work = 0.0
        if not self._armed or was == 'disarmed':
            self._reference = np.array([link_angles[:2], np.zeros(2), np.zeros(2)])
            self._reference_angles = np.array(link_angles)
        self._follow_move(stamp_ns)
        reference_rates = self._reference_rates()
        angle_errors = self._reference_angles - link_angles
        rate_errors = reference_rates - link_rates
        torques = np.zeros(4)
        if self._armed:
            torques = self._torques(link_angles, link_rates, angle_errors, rate_errors)
        energy = self._account(stamp_ns, link_rates, wheel_speeds, efforts)
        return Control(
            stamp_ns, torques, self._reference_angles.copy(), reference_rates, angle_errors,
            rate_errors, energy, self._eq9, self._work)

    def _plan(self, names: Sequence[str], positions: Sequence[float], stamp_ns: int) -> None:
        goals = check_names(names, positions)
        if not self._armed or self.mode == 'disarmed' or self._stamp_ns is None:
            raise SetpointError('the device is not armed')
        if stamp_ns and abs(stamp_ns - self._stamp_ns) > SETPOINT_TIMEOUT * 1e9:
            raise SetpointError(
                f'stamp is {(self._stamp_ns - stamp_ns) * 1e-9:.3f} s before the last tick, limit '
                f'{SETPOINT_TIMEOUT:g} s either way')
        going_to = self._reference_angles
        if self._move is not None and self.goal is not None:
            going_to = self.goal
        self._move, self.goal = plan(
            self._mechanism, goals, self._reference, self._reference_angles, going_to,
            self.settings.setpoint_duration)
        self._move_start_ns, self.mode = self._stamp_ns, 'track'

    def _follow_move(self, stamp_ns: int) -> None:
        if self._move is None:
            return
        elapsed = (stamp_ns - self._move_start_ns) * 1e-9
        self._reference = self._move.at(elapsed)
        self._reference_angles = nearest_assembly(
            self._mechanism, (0, 1), (self._reference[0, 0], self._reference[0, 1]),
            self._reference_angles)
        if elapsed >= self._move.duration:
            self._move, self.mode = None, 'hold'

    def _reference_rates(self) -> Array:
        rates = self._reference[1]
        if not rates.any():
            return np.zeros(4)
        # A planned move keeps its distance from change points, so Gamma exists here.
        gamma = gamma_matrix(self._reference_angles, self._mechanism.link_lengths)
        return np.concatenate([rates, gamma @ rates])

    def _torques(self, link_angles: Array, link_rates: Array, angle_errors: Array,
                 rate_errors: Array) -> Array:
        if abs(sin(link_angles[3] - link_angles[2])) < NO_HOLD:
            # Too close to a change point for the reduced form: coast through it.
            return np.zeros(4)
        stiffness = self.settings.bandwidth ** 2
        damping = 2.0 * self.settings.damping * self.settings.bandwidth
        acceleration = (self._reference[2] + damping * rate_errors[:2]
                        + stiffness * angle_errors[:2])
        torques = computed_torques(link_angles, link_rates, acceleration, self._constants)
        excess = max(abs(torque) / limit for torque, limit in zip(torques.tolist(), self._limits))
        if excess > 1.0:
            # Scaled together, so that the direction of the motion stays.
            self.saturated += 1
            torques = torques / excess
        return torques

    def _account(self, stamp_ns: int, link_rates: Array, wheel_speeds: Array, efforts: Array
                 ) -> float:
        inertias = self._mechanism.flywheel_inertias
        absolute = wheel_speeds + link_rates
        # Twice the energy, and what eq. 9 adds up.
        doubled = float(inertias @ (absolute * absolute))
        if self._stamp_ns is not None:
            period = (stamp_ns - self._stamp_ns) * 1e-9
            if 0.0 < period <= LONGEST_PERIOD:
                self._eq9 += doubled * period
                self._work += float(np.abs(efforts * wheel_speeds).sum()) * period
        self._stamp_ns = stamp_ns
        return 0.5 * doubled
