# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Actuation cost: kinetic energy of the wheels, and sums of work and heat of their motors."""

from __future__ import annotations

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.motors import motors_of
import numpy as np
from numpy.typing import NDArray

# Names of :attr:`ActuationCostSums.energies`.
ENERGIES = ('flywheel_energy_j', 'eq9_j_s', 'work_j', 'copper_loss_j')

FLYWHEEL_ENERGY, EQ9, WORK, COPPER = range(4)

# Longest time between two ticks that counts as motion [s]; a longer one is a gap in the data.
MAX_PERIOD = 0.1


class ActuationCostSums:
    """
    Sums the actuation cost of a run.

    :ivar energies: (4,) kinetic energy of the wheels, paper eq. 7 [J]; paper eq. 9 as printed, the
        integral of twice the kinetic energy [J s]; mechanical work of the motors, the integral of
        `|torque x relative speed|` [J]; heat in their windings, 0 where the mechanism file does
        not describe them [J]. The last three are sums.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.energies = np.zeros(len(ENERGIES))
        self._motors = np.array([motors_of(mechanism)])

    def reset(self) -> None:
        """Set the sums to zero."""
        self.energies[:] = 0.0

    def add(self, period: float, link_rates: Array, speeds: Array, efforts: Array) -> None:
        """
        Add a period.

        :param period: its length, 0 for no motion [s].
        :param link_rates: (4,) [rad/s].
        :param speeds: (4,) of the wheels, relative to the links [rad/s].
        :param efforts: (4,) of the motors [N m].
        """
        if period > MAX_PERIOD:
            period = 0.0
        _add(period, link_rates, speeds, efforts, self._motors, self.energies)


@kernel
def _add(period: float, link_rates: Array, speeds: Array, efforts: Array,
         packed: NDArray[np.record], energies: Array) -> None:
    """See :meth:`ActuationCostSums.add`."""
    motors = packed[0]
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
