# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Actuation cost of a motion for a given allocation of the torque to the wheels.

Wheel energy of paper eq. 7, the sum of eq. 9 as printed, the work of the motors and the heat in
their windings, by inverse dynamics along a reference trajectory, with or without friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control.allocation import Allocation
from fourbar_ros.control.feasibility import loads_along, path_of
from fourbar_ros.control.soft_step import SoftStep, TrajectorySegment
from fourbar_ros.kernels.runge_kutta import Drive
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.mechanism.forces import forces_along, NOTHING, System
from fourbar_ros.mechanism.integration import advance_state
from fourbar_ros.mechanism.state import LINK_ANGLES
from fourbar_ros.plant import Table
from fourbar_ros.plant.bearings import bearing_torque, drives_of
from fourbar_ros.plant.table import surroundings_of
import numpy as np
from scipy.integrate import cumulative_trapezoid

# Instants along a trajectory. The error of the trapezoidal sums is below 1e-8, relative.
SAMPLES = 4001

# Largest share of the demanded torque that the wheels may leave unmet; covers rounding.
UNMET = 1e-9


class ActuationCostError(FourbarError):
    """A motion for which the wheels cannot provide the torque."""


@dataclass(frozen=True, eq=False)
class ActuationCost:
    """
    Wheel torques and speeds along a motion, and the cost that follows from them.

    :param mechanism: the linkage.
    :param times: (n,) [s].
    :param angles: (n, 4) of the links [rad].
    :param link_rates: (n, 4) [rad/s].
    :param torques: (n, 4) of motors and bearings together on the wheels [N m].
    :param speeds: (n, 4) of the wheels, absolute [rad/s].
    :param bearings: (n, 4) bearing friction that the motors overcome [N m].
    """

    mechanism: Mechanism
    times: Array
    angles: Array
    link_rates: Array
    torques: Array
    speeds: Array
    bearings: Array

    @cached_property
    def energy(self) -> Array:
        """Kinetic energy of the wheels, paper eq. 7 (n,) [J]."""
        return _energy(self.speeds, self.mechanism)

    @cached_property
    def eq9(self) -> Array:
        """Paper eq. 9 as printed: the integral of twice the kinetic energy (n,) [J s]."""
        return self._integral(2.0 * self.energy)

    @cached_property
    def work(self) -> Array:
        """Absolute work of the motors up to each time (n,) [J]."""
        return self._integral(np.abs(self.motor_powers).sum(axis=1))

    @cached_property
    def copper_loss(self) -> Array:
        """Heat in the windings up to each time, 0 without winding data (n,) [J]."""
        return self._integral((self.currents ** 2) @ self.mechanism.motor_resistances)

    @cached_property
    def energy_drawn(self) -> Array:
        """Energy drawn from the supplies without regeneration up to each time (n,) [J]."""
        power = self.motor_powers + self.currents ** 2 * self.mechanism.motor_resistances
        return self._integral(np.maximum(power, 0.0).sum(axis=1))

    @cached_property
    def balanced_speeds(self) -> Array:
        """
        Wheel speeds with the least energy for the momentum of each pair (n, 4) [rad/s].

        For a parallelogram: the two wheels of a pair have equal speeds, whatever their inertias.
        """
        inertias = self.mechanism.flywheel_inertias
        balanced = np.empty_like(self.speeds)
        for pair in ([0, 2], [1, 3]):
            momentum = self.speeds[:, pair] @ inertias[pair]
            balanced[:, pair] = (momentum / inertias[pair].sum())[:, None]
        return balanced

    @property
    def least_energy(self) -> Array:
        """Least kinetic energy of wheels that produce the same motion (n,) [J]."""
        return _energy(self.balanced_speeds, self.mechanism)

    @property
    def motor_torques(self) -> Array:
        """Torques of the motors, bearing friction included (n, 4) [N m]."""
        return self.torques + self.bearings

    @property
    def motor_speeds(self) -> Array:
        """Speeds of the wheels relative to their links (n, 4) [rad/s]."""
        return self.speeds - self.link_rates

    @property
    def motor_powers(self) -> Array:
        """Mechanical power of the motors (n, 4) [W]."""
        return self.motor_torques * self.motor_speeds

    @property
    def currents(self) -> Array:
        """Currents in the windings, 0 without winding data (n, 4) [A]."""
        currents: Array = self.motor_torques / self.mechanism.motor_torque_constants
        return currents

    def totals(self) -> dict[str, Any]:
        """Return the totals and peaks of the motion, for JSON."""
        return {
            'peak_speed_rad_s': peak(self.speeds),
            'peak_motor_speed_rad_s': peak(self.motor_speeds),
            'peak_torque_n_m': peak(self.motor_torques),
            'peak_power_w': peak(self.motor_powers),
            'peak_energy_j': float(self.energy.max()),
            'eq9_j_s': float(self.eq9[-1]), 'work_j': float(self.work[-1]),
            'copper_j': float(self.copper_loss[-1]), 'drawn_j': float(self.energy_drawn[-1]),
            'peak_speeds_rad_s': np.abs(self.speeds).max(axis=0).tolist(),
            'end_speeds_rad_s': self.speeds[-1].tolist()}

    def _integral(self, rates: Array) -> Array:
        integral: Array = cumulative_trapezoid(rates, self.times, initial=0.0)
        return integral


def peak(values: Array) -> float:
    """Return the largest absolute value."""
    return float(np.abs(values).max())


def rest_to_rest(theta: float, turn: Array | tuple[float, float], duration: float) -> SoftStep:
    """
    Return the soft step of links a and b from rest at (0, theta) to rest.

    :param turn: (2,) angles by which links a and b turn [rad].
    """
    start = np.zeros((3, 2))
    start[0] = 0.0, theta
    return SoftStep(start, start[0] + turn, duration)


def actuation_cost(
    mechanism: Mechanism, segment: TrajectorySegment, present: Array, allocation: Allocation,
    speeds: Array | None = None, table: Table | None = None, samples: int = SAMPLES,
) -> ActuationCost:
    """
    Compute wheel torques and speeds along a trajectory by inverse dynamics.

    :param present: (4,) link angles at the start, which select the branch [rad].
    :param allocation: rule that shares the demand among the wheels.
    :param speeds: (4,) absolute speeds of the wheels at the start, default 0 [rad/s].
    :param table: its friction and drag act on the linkage, default none.
    :param samples: number of instants.
    :raises ClosureError: the loop cannot close along the trajectory.
    :raises ActuationCostError: the permitted wheels cannot provide the torque.
    """
    path = path_of(mechanism, segment, present, samples=samples)
    times, angles, links = path.times, path.angles, path.paired_links
    torques, gained, unmet = loads_along(
        mechanism, path, allocation, np.zeros(4) if speeds is None else speeds)
    if not unmet <= UNMET:
        raise ActuationCostError(
            f'the permitted wheels leave {100.0 * unmet:.3g} % of the demanded torque unmet '
            f'(limit {100.0 * UNMET:g} %)', value=unmet, limit=UNMET)
    wheel_maps = np.zeros((len(times), 2, 4))
    if path.paired:
        for axis in range(2):
            wheel_maps[:, axis, [links[axis], links[axis + 2]]] = 1.0
    else:
        wheel_maps[:, 0, 0] = wheel_maps[:, 1, 1] = 1.0
        wheel_maps[:, :, 2:] = [gamma_matrix(four, mechanism.link_lengths).T for four in angles]
    link_rates = np.einsum('nki,nk->ni', wheel_maps, path.motion[:, 0])
    # The gained speeds are relative to the links.
    absolute = gained + link_rates - link_rates[0] + (np.zeros(4) if speeds is None else speeds)
    bearings = np.zeros_like(torques)
    if table is not None:
        shared = allocation.weights_inv * wheel_maps
        on_axes = np.einsum('nki,ni->nk', wheel_maps, forces_along(
            angles, link_rates, np.array([mechanism.constants]),
            np.array([surroundings_of(table)])))
        against = np.einsum('nki,nk->ni', shared, np.linalg.solve(
            np.einsum('nki,nmi->nkm', shared, wheel_maps), on_axes[..., None])[..., 0])
        torques += against
        absolute += cumulative_trapezoid(against, times, axis=0, initial=0.0
                                         ) / mechanism.flywheel_inertias
        drives = drives_of(mechanism, table.wheel_bearings)
        bearings[:] = [[bearing_torque(speed, 0.0, drives) for speed in four]
                       for four in (absolute - link_rates).tolist()]
    return ActuationCost(mechanism, times, angles, link_rates, torques, absolute, bearings)


def simulate_torques(mechanism: Mechanism, state: Array, torques: Array, step: float) -> Array:
    """
    Integrate the linkage under given wheel torques, without friction.

    :param state: initial state, see mechanism.state; not changed.
    :param torques: (2 m + 1, 4) at the start, middle and end of m steps [N m].
    :param step: [s].
    :returns: (m + 1, 4) link angles at the start and after each step [rad].
    """
    state = state.copy()
    angles = [state[LINK_ANGLES].copy()]
    for n in range(0, len(torques) - 2, 2):
        advance_state(state, Drive(torques[n], torques[n + 1], torques[n + 2]), step,
                      System(mechanism.constants, NOTHING))
        angles.append(state[LINK_ANGLES].copy())
    return np.array(angles)


def _energy(speeds: Array, mechanism: Mechanism) -> Array:
    energy: Array = 0.5 * (speeds ** 2) @ mechanism.flywheel_inertias
    return energy
