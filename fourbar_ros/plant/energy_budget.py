# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Where every joule and every newton metre second went."""

from __future__ import annotations

from dataclasses import dataclass

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.compliant import links_energy_and_spin
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.state import JOINT_LOSS, WHEEL_SPEEDS
from fourbar_ros.mechanism.totals import mechanical_energy
import numpy as np

# What the kernels add up, in one vector. Energies [J]: given by the supply; turned into heat in
# windings, bearings and joints, by drag, at the edge; work of the tilt and of random torques.
(ELECTRICAL, COPPER, BEARINGS, JOINTS, DRAG, EDGE, TILT, DISTURBANCE,
 # Angular momentum about the mass centre that the whole was given [N m s].
 DRAG_SPIN, EDGE_SPIN, DISTURBANCE_SPIN,
 # How often a joint met the edge.
 CONTACTS) = range(12)
SIZE = 12


@dataclass(frozen=True)
class EnergyBudget:
    """
    The accounts of energy and angular momentum since the start.

    Energies [J]: `links` and `wheels` are kinetic, the motion of the mass centre counts with the
    links; `springs` is in joints that give. `supplied`, `tilt` and `disturbance` came from
    outside, the rest became heat. `unaccounted` is what the balance misses.

    Angular momenta about the mass centre [N m s]: in `links_spin` and `wheels_spin`, and what
    drag, edge and random torques gave.
    """

    links: float
    wheels: float
    springs: float
    supplied: float
    tilt: float
    disturbance: float
    copper: float
    bearings: float
    joints: float
    drag: float
    edge: float
    unaccounted: float
    links_spin: float
    wheels_spin: float
    drag_spin: float
    edge_spin: float
    disturbance_spin: float
    unaccounted_spin: float
    contacts: int

    @property
    def turnover(self) -> float:
        """Sum of all that changed hands, which the balance is relative to [J]."""
        return (self.links + self.wheels + self.springs + abs(self.supplied) + abs(self.tilt)
                + abs(self.disturbance) + self.copper + self.bearings + self.joints + self.drag
                + self.edge)


def balance(mechanism: Mechanism, state: Array, start: Array, added: Array) -> EnergyBudget:
    """
    Draw up the accounts.

    :param state, start: (STATE_SIZE,) now and when the sums were zero.
    :param added: (SIZE,) what the kernels added up.
    """
    links, wheels, springs, links_spin, wheels_spin = holdings(mechanism, state)
    before = holdings(mechanism, start)
    given = float(added[ELECTRICAL] + added[TILT] + added[DISTURBANCE])
    joints = float(added[JOINTS] + state[JOINT_LOSS] - start[JOINT_LOSS])
    heat = float(added[COPPER] + added[BEARINGS] + added[DRAG] + added[EDGE]) + joints
    turned = float(added[DRAG_SPIN] + added[EDGE_SPIN] + added[DISTURBANCE_SPIN])
    return EnergyBudget(
        links, wheels, springs, float(added[ELECTRICAL]), float(added[TILT]),
        float(added[DISTURBANCE]), float(added[COPPER]), float(added[BEARINGS]), joints,
        float(added[DRAG]), float(added[EDGE]),
        links + wheels + springs - sum(before[:3]) - given + heat,
        links_spin, wheels_spin, float(added[DRAG_SPIN]), float(added[EDGE_SPIN]),
        float(added[DISTURBANCE_SPIN]),
        links_spin + wheels_spin - sum(before[3:]) - turned, int(added[CONTACTS]))


def holdings(mechanism: Mechanism, state: Array) -> tuple[float, float, float, float, float]:
    """Return energy of links, wheels and springs [J], spin of links and wheels [N m s]."""
    links, links_spin = links_energy_and_spin(state, mechanism.constants)
    speeds = state[WHEEL_SPEEDS]
    spins = mechanism.flywheel_inertias * speeds
    wheels = 0.5 * float(spins @ speeds)
    springs = (mechanical_energy(mechanism, state) - links - wheels
               if mechanism.constants.compliant else 0.0)
    return links, wheels, springs, links_spin, float(spins.sum())


def nothing_added() -> Array:
    """Return sums of zero, for the kernels to add to."""
    return np.zeros(SIZE)
