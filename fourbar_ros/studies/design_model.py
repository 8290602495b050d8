# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Design of a linkage for given manoeuvres: its demands, and variants of wheels and links."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import pi
from typing import Any

from fourbar_ros.control.allocation import Allocation, make_allocation
from fourbar_ros.mechanism import assemble, Mechanism
from fourbar_ros.plant import Table
from fourbar_ros.studies.planned_cost import (
    actuation_cost,
    ActuationCost,
    peak,
    rest_to_rest,
)
import numpy as np

DURATION, THETA = 10.0, pi / 3.0
# Angles by which links a and b turn [rad].
MANOEUVRES = {'whole': (pi / 2.0, pi / 2.0), 'configuration': (0.0, pi / 4.0)}
TITLES = {'whole': 'the whole by 90 deg', 'configuration': 'link b by 45 deg'}
SAMPLES = 801

# Shares of the motor limits available to a manoeuvre. The rest is reserved for feedback, for the
# momentum that friction leaves in the wheels, and for model errors.
SPEED_SHARE, TORQUE_SHARE, VOLTAGE_SHARE = 0.5, 0.5, 0.8

# A wheel is a rim, I = RIM m r^2, with the radius for which a link has room [m].
RIM, RADIUS = 0.7, 0.05
# Mass per length of a link [kg/m]; the rest of its mass does not depend on its length.
BEAM = 0.5


@dataclass(frozen=True)
class Design:
    """
    Demands of a linkage for the manoeuvres.

    :param mechanism: the linkage.
    :param costs: by manoeuvre.
    """

    mechanism: Mechanism
    costs: Mapping[str, ActuationCost]

    @property
    def speed(self) -> float:
        """Largest speed of a motor [rad/s]."""
        return max(peak(cost.motor_speeds) for cost in self.costs.values())

    @property
    def torque(self) -> float:
        """Largest torque of a motor [N m]."""
        return max(peak(cost.motor_torques) for cost in self.costs.values())

    @property
    def power(self) -> float:
        """Largest mechanical power of a motor [W]."""
        return max(peak(cost.motor_powers) for cost in self.costs.values())

    @property
    def voltage(self) -> float:
        """Largest voltage at a winding [V]."""
        mechanism = self.mechanism
        return max(peak(cost.currents * mechanism.motor_resistances
                        + cost.motor_speeds * mechanism.motor_torque_constants)
                   for cost in self.costs.values())

    @property
    def energy_drawn(self) -> float:
        """Energy drawn from the supplies by all manoeuvres together [J]."""
        return sum(float(cost.energy_drawn[-1]) for cost in self.costs.values())

    @property
    def mass(self) -> float:
        """Mass of all links [kg]."""
        return float(self.mechanism.link_masses.sum())

    @property
    def inertia(self) -> float:
        """Axial inertia of a wheel [kg m^2]."""
        return float(self.mechanism.flywheel_inertias[0])

    @property
    def length_ratio(self) -> float:
        """Length of link a over that of link b."""
        return float(np.divide(*self.mechanism.link_lengths[:2]))

    @property
    def residual_speed(self) -> float:
        """Largest wheel speed that friction leaves after the configuration move [rad/s]."""
        return peak(self.costs['configuration'].motor_speeds[-1])

    @property
    def within_shares(self) -> bool:
        """Whether speed, torque and voltage stay within their shares of the motor limits."""
        mechanism = self.mechanism
        return (self.speed <= SPEED_SHARE * float(mechanism.motor_speed_limits.min())
                and self.torque <= TORQUE_SHARE * float(mechanism.motor_torque_limits.min())
                and self.voltage <= VOLTAGE_SHARE * float(mechanism.motor_voltages.min()))

    def as_json(self) -> dict[str, Any]:
        """Return the demands for JSON."""
        return {
            'link_a_over_link_b': self.length_ratio, 'flywheel_inertia_kg_m2': self.inertia,
            'flywheel_mass_kg': wheel_mass(self.inertia),
            'total_mass_kg': self.mass, 'peak_speed_rad_s': self.speed,
            'peak_torque_n_m': self.torque, 'peak_power_w': self.power,
            'peak_voltage_v': self.voltage, 'drawn_j': self.energy_drawn,
            'end_speed_rad_s': self.residual_speed, 'keeps_shares': self.within_shares,
            'manoeuvres': {name: cost.totals() for name, cost in self.costs.items()}}


def least_energy(mechanism: Mechanism) -> Allocation:
    """Return the allocation `min_energy` of four wheels."""
    return make_allocation('min_energy', mechanism.flywheel_inertias, [True] * 4)


def evaluate(mechanism: Mechanism, table: Table) -> Design:
    """Evaluate the manoeuvres with four wheels that share the torque for the least energy."""
    return Design(mechanism, {name: actuation_cost(
        mechanism, rest_to_rest(THETA, turn, DURATION), assemble(mechanism, 0.0, THETA),
        least_energy(mechanism), table=table, samples=SAMPLES)
        for name, turn in MANOEUVRES.items()})


def wheel_mass(inertia: float) -> float:
    """Return the mass of a wheel of an axial inertia [kg]."""
    return inertia / (RIM * RADIUS ** 2)


def with_wheels(nominal: Mechanism, inertia: float) -> Mechanism:
    """Replace the wheels, which sit at the mass centres of the links and add to their masses."""
    change = wheel_mass(inertia) - wheel_mass(float(nominal.flywheel_inertias[0]))
    return replace(nominal, flywheel_inertias=np.full(4, inertia),
                   link_masses=nominal.link_masses + change)


def with_ratio(nominal: Mechanism, ratio: float) -> Mechanism:
    """
    Make a parallelogram of the same circumference.

    The mass of a link's beam is proportional to its length; the rest is at its mass centre.

    :param ratio: length of link a over that of link b.
    """
    length = float(nominal.link_lengths[0])
    long = 2.0 * length / (1.0 + ratio)
    lengths = np.array([ratio * long, long, ratio * long, long])
    lump = float(nominal.link_masses[0]) - BEAM * length
    turning = float(nominal.link_inertias[0]) - BEAM * length ** 3 / 12.0
    return replace(
        nominal, link_lengths=lengths, link_masses=lump + BEAM * lengths,
        link_inertias=turning + BEAM * lengths ** 3 / 12.0,
        com_positions=np.column_stack([0.5 * lengths, np.zeros(4)]))
