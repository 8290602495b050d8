# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What the wheels hold and what their motors have spent."""

from __future__ import annotations

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.motors import motors_of
import numpy as np
from numpy.typing import NDArray

ENERGIES = ('flywheel_energy_j', 'eq9_j_s', 'work_j', 'copper_loss_j')
"""Names of what :attr:`Accounts.energies` holds."""

FLYWHEEL_ENERGY, EQ9, WORK, COPPER = range(4)

# A longer silence than this between two ticks does not count as motion [s].
LONGEST_PERIOD = 0.1


class Accounts:
    """
    Keeps the accounts of a run.

    :ivar energies: (4,) kinetic energy of the wheels, paper eq. 7 [J]; cumulative "power" as
        eq. 9 is printed [J s]; mechanical work of the motors without regard to sign [J]; heat in
        their windings, 0 where these are not described [J]. The last three are sums.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.energies = np.zeros(len(ENERGIES))
        self._motors = np.array([motors_of(mechanism)])

    def begin(self) -> None:
        """Begin the sums anew."""
        self.energies[:] = 0.0

    def book(self, period: float, link_rates: Array, speeds: Array, efforts: Array) -> None:
        """
        Book a period.

        :param period: its length, 0 for none [s].
        :param link_rates: (4,) [rad/s].
        :param speeds: (4,) of the wheels, relative to the links [rad/s].
        :param efforts: (4,) of the motors [N m].
        """
        if period > LONGEST_PERIOD:
            period = 0.0
        book(period, link_rates, speeds, efforts, self._motors, self.energies)


@kernel
def book(period: float, link_rates: Array, speeds: Array, efforts: Array,
         boxed: NDArray[np.record], energies: Array) -> None:
    """Book a period, see :meth:`Accounts.book`."""
    motors = boxed[0]
    doubled = work = heat = 0.0
    for j in range(4):
        absolute = speeds[j] + link_rates[j]
        doubled += motors.inertia[j] * absolute * absolute
        work += abs(efforts[j] * speeds[j])
        current = efforts[j] / motors.torque_constant[j]
        heat += motors.resistance[j] * current * current
    energies[FLYWHEEL_ENERGY] = 0.5 * doubled
    energies[EQ9] += doubled * period
    energies[WORK] += work * period
    energies[COPPER] += heat * period
