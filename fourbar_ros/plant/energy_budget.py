# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The budget of energy and angular momentum since the start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.compliant import link_energy_and_momentum
from fourbar_ros.mechanism.constants import Array, Fields
from fourbar_ros.mechanism.momentum import mechanical_energy
from fourbar_ros.mechanism.state import JOINT_LOSS, WHEEL_SPEEDS
import numpy as np
from numpy.typing import NDArray

# What the kernels sum, in one record.
SUMS: Fields = [(name, float, ()) for name in (
    # Energies [J]: supplied, heat in windings, bearings and joints, taken by drag and at the edge,
    # work of the tilt and of random torques.
    'supplied', 'copper', 'bearings', 'joints', 'drag', 'edge', 'tilt', 'disturbance',
    # Angular momentum about the mass centre [N m s], by drag, edge and random torques.
    'drag_spin', 'edge_spin', 'disturbance_spin',
    # Number of contacts of a joint with the edge.
    'contacts')]


@dataclass(frozen=True)
class EnergyBudget:
    """
    The budget of energy and angular momentum since the start.

    Energies [J]: `links` and `wheels` are kinetic, with the motion of the mass centre in `links`;
    `springs` is in compliant joints. `supplied`, `tilt` and `disturbance` came from outside, the
    others became heat. `unaccounted` is the error of the balance.

    Angular momenta about the mass centre [N m s]: `links_spin` and `wheels_spin` of the bodies,
    the others the impulses of drag, edge and random torques.
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
        """Sum of all energies, to which the error of the balance is relative [J]."""
        return (self.links + self.wheels + self.springs + abs(self.supplied) + abs(self.tilt)
                + abs(self.disturbance) + self.copper + self.bearings + self.joints + self.drag
                + self.edge)


def empty_sums() -> NDArray[Any]:
    """Return one record of `SUMS`, all zero, in an array (1,)."""
    return np.zeros(1, np.dtype((np.record, SUMS)))


def energy_budget(mechanism: Mechanism, state: Array, start: Array, sums: NDArray[Any]
                  ) -> EnergyBudget:
    """
    Evaluate the budget.

    :param state, start: (STATE_SIZE,) now and when the sums were zero.
    :param sums: (1,) of the kernels.
    """
    added = {name: float(sums[name][0]) for name, _, _ in SUMS}
    added['joints'] = float(added['joints'] + state[JOINT_LOSS] - start[JOINT_LOSS])
    links, wheels, springs, links_spin, wheels_spin = _stored(mechanism, state)
    before = _stored(mechanism, start)
    inflow = added['supplied'] + added['tilt'] + added['disturbance']
    heat = (added['copper'] + added['bearings'] + added['drag'] + added['edge']
            + added['joints'])
    impulses = added['drag_spin'] + added['edge_spin'] + added['disturbance_spin']
    contacts = int(added.pop('contacts'))
    return EnergyBudget(
        links=links, wheels=wheels, springs=springs,
        unaccounted=links + wheels + springs - sum(before[:3]) - inflow + heat,
        links_spin=links_spin, wheels_spin=wheels_spin,
        unaccounted_spin=links_spin + wheels_spin - sum(before[3:]) - impulses,
        contacts=contacts, **added)


def _stored(mechanism: Mechanism, state: Array) -> tuple[float, float, float, float, float]:
    """Return energy of links, wheels and springs [J], momentum of links and wheels [N m s]."""
    links, link_momentum = link_energy_and_momentum(state, mechanism.constants)
    speeds = state[WHEEL_SPEEDS]
    momenta = mechanism.flywheel_inertias * speeds
    wheels = 0.5 * float(momenta @ speeds)
    springs = (mechanical_energy(mechanism, state) - links - wheels
               if mechanism.constants.compliant else 0.0)
    return links, wheels, springs, link_momentum, float(momenta.sum())
