# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What a motion costs by how the wheels share it.

Wheel energy of paper eq. 7, the sum of eq. 9 as it is printed, the work that motors do, and the
heat in their windings; along a planned way, by inverse dynamics, with the friction of a table or
without.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.control.branch import branch_at, LINKS_ALONE
from fourbar_ros.control.feasibility import wheel_loads
from fourbar_ros.control.setpoint import angles_along
from fourbar_ros.control.soft_step import TrajectorySegment
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import gamma_matrix
from fourbar_ros.mechanism.forces import forces_along, NOTHING
from fourbar_ros.mechanism.integration import advance_state
from fourbar_ros.mechanism.state import LINK_ANGLES
from fourbar_ros.plant import Table
from fourbar_ros.plant.bearings import bearing_torque, drives_of
from fourbar_ros.plant.table import surroundings_of
import numpy as np
from scipy.integrate import cumulative_trapezoid

# Instants at which a way is looked at. Sums by the trapezoid are good to 1e-8 of their size.
SAMPLES = 4001

# Of the largest demand, what wheels may leave unmet.
UNMET = 1e-9


class SpendingError(FourbarError):
    """A motion that the wheels cannot make."""


@dataclass(frozen=True, eq=False)
class Spending:
    """
    Wheels along a motion.

    :param mechanism: the linkage.
    :param times: (n,) [s].
    :param angles: (n, 4) of the links [rad].
    :param link_rates: (n, 4) [rad/s].
    :param torques: (n, 4) that motors and bearings give the wheels together [N m].
    :param speeds: (n, 4) of the wheels, absolute [rad/s].
    :param bearings: (n, 4) friction of the bearings, which the motors overcome [N m].
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
        found: Array = 0.5 * (self.speeds ** 2) @ self.mechanism.flywheel_inertias
        return found

    @cached_property
    def eq9(self) -> Array:
        """Paper eq. 9 as printed, the integral of twice the kinetic energy (n,) [J s]."""
        return self._summed(2.0 * self.energy)

    @cached_property
    def work(self) -> Array:
        """Work of the motors so far, without regard to sign (n,) [J]."""
        return self._summed(np.abs(self.motor_torques * self.motor_speeds).sum(axis=1))

    @cached_property
    def copper(self) -> Array:
        """Heat in the windings so far, 0 where none are described (n,) [J]."""
        return self._summed((self.currents ** 2) @ self.mechanism.motor_resistances)

    @cached_property
    def drawn(self) -> Array:
        """Energy taken from the supplies so far, what braking motors give back lost (n,) [J]."""
        power = (self.motor_torques * self.motor_speeds
                 + self.currents ** 2 * self.mechanism.motor_resistances)
        return self._summed(np.maximum(power, 0.0).sum(axis=1))

    @property
    def motor_torques(self) -> Array:
        """Torques of the motors, bearings included (n, 4) [N m]."""
        return self.torques + self.bearings

    @property
    def currents(self) -> Array:
        """Currents in the windings, 0 where none are described (n, 4) [A]."""
        found: Array = self.motor_torques / self.mechanism.motor_torque_constants
        return found

    @property
    def motor_speeds(self) -> Array:
        """Speeds of the wheels relative to their links (n, 4) [rad/s]."""
        return self.speeds - self.link_rates

    def totals(self) -> dict[str, Any]:
        """Return the numbers that stand for the whole motion, for JSON."""
        return {
            'peak_speed_rad_s': float(np.abs(self.speeds).max()),
            'peak_motor_speed_rad_s': float(np.abs(self.motor_speeds).max()),
            'peak_torque_n_m': float(np.abs(self.motor_torques).max()),
            'peak_power_w': float(np.abs(self.motor_torques * self.motor_speeds).max()),
            'peak_energy_j': float(self.energy.max()),
            'eq9_j_s': float(self.eq9[-1]), 'work_j': float(self.work[-1]),
            'copper_j': float(self.copper[-1]), 'drawn_j': float(self.drawn[-1]),
            'peak_speeds_rad_s': np.abs(self.speeds).max(axis=0).tolist(),
            'end_speeds_rad_s': self.speeds[-1].tolist()}

    def _summed(self, rates: Array) -> Array:
        found: Array = cumulative_trapezoid(rates, self.times, initial=0.0)
        return found


def spend(mechanism: Mechanism, way: TrajectorySegment, present: Array, mobilities: Array,
          speeds: Array | None = None, table: Table | None = None, samples: int = SAMPLES
          ) -> Spending:
    """
    Work out what a motion takes.

    :param present: (4,) link angles where it begins, which tell the branch [rad].
    :param mobilities: V (4,): wheels share for the least sum of `tau_i^2 / V_i`, see
        `control.allocation.mobilities`.
    :param speeds: (4,) absolute speeds of the wheels at the begin, default 0 [rad/s].
    :param table: whose friction and drag the wheels work against, default none.
    :param samples: instants to look at.
    :raises ClosureError: the loop cannot close on the way.
    :raises SpendingError: the wheels that may be used cannot meet the demand.
    """
    times = way.instants(samples)
    states = way.sample(times)
    branch = branch_at(mechanism, present)
    angles = angles_along(mechanism, states[:, 0], present, branch)
    twins = LINKS_ALONE if branch is None else branch.twins
    constants = np.array([mechanism.constants])
    metric = np.asarray(mobilities, dtype=float)
    torques, gained, unmet = wheel_loads(
        times, angles, states[:, 1:], branch is not None, twins, metric, constants)
    if not unmet <= UNMET:
        raise SpendingError(f'these wheels leave {100.0 * unmet:.3g} % of the torque unmet')
    wheel_maps = np.zeros((len(times), 2, 4))
    if branch is not None:
        for axis in range(2):
            wheel_maps[:, axis, [twins[axis], twins[axis + 2]]] = 1.0
    else:
        wheel_maps[:, 0, 0] = wheel_maps[:, 1, 1] = 1.0
        wheel_maps[:, :, 2:] = [gamma_matrix(four, mechanism.link_lengths).T for four in angles]
    link_rates = np.einsum('nki,nk->ni', wheel_maps, states[:, 1])
    # What a wheel gains is relative to its link.
    absolute = gained + link_rates - link_rates[0] + (np.zeros(4) if speeds is None else speeds)
    bearings = np.zeros_like(torques)
    if table is not None:
        shared = metric * wheel_maps
        on_axes = np.einsum('nki,ni->nk', wheel_maps, forces_along(
            angles, link_rates, constants, np.array([surroundings_of(table)])))
        against = np.einsum('nki,nk->ni', shared, np.linalg.solve(
            np.einsum('nki,nmi->nkm', shared, wheel_maps), on_axes[..., None])[..., 0])
        torques += against
        absolute += cumulative_trapezoid(against, times, axis=0, initial=0.0
                                         ) / mechanism.flywheel_inertias
        drives = drives_of(mechanism, table.wheel_bearings)
        relative = absolute - link_rates
        bearings[:] = [[bearing_torque(speed, 0.0, drives) for speed in four]
                       for four in relative.tolist()]
    return Spending(mechanism, times, angles, link_rates, torques, absolute, bearings)


def fly(mechanism: Mechanism, state: Array, torques: Array, step: float) -> Array:
    """
    Let torques drive the linkage through the integrator, without friction.

    :param state: at the begin, see mechanism.layout; not changed.
    :param torques: (2 m + 1, 4) on the wheels, at the begin, middle and end of m steps [N m].
    :param step: [s].
    :returns: (m + 1, 4) link angles at the begin and after each step [rad].
    """
    state = state.copy()
    angles = [state[LINK_ANGLES].copy()]
    for n in range(0, len(torques) - 2, 2):
        advance_state(state, torques[n], torques[n + 1], torques[n + 2], step,
                      mechanism.constants, NOTHING)
        angles.append(state[LINK_ANGLES].copy())
    return np.array(angles)
