# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The plant in motion: motors, bearings, linkage and edge, one small step after the other.

In each step the torque on every wheel is constant: the mean of what the motor gives, less the
friction of the bearing (`plant.bearings`). So the linkage moves as the mechanics have it, impulse
and work of every torque are exact, and only friction in joints and drag need a quadrature.
"""

from __future__ import annotations

from math import cos, isfinite, isnan, nan, sin
from typing import Any

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism.compliant import body_losses
from fourbar_ros.mechanism.constants import Array, Constants, record
from fourbar_ros.mechanism.forces import losses, Surroundings
from fourbar_ros.mechanism.integration import advance_state, evaluate
from fourbar_ros.mechanism.motors import available_torque, lagged_torque, Motors, speed_loop
from fourbar_ros.mechanism.state import CENTRE_X, CENTRE_Y, STATE_SIZE, VELOCITY_X, VELOCITY_Y
from fourbar_ros.plant.bearings import friction_over_step
from fourbar_ros.plant.edge import meet_edges
from fourbar_ros.plant.energy_budget import (
    BEARINGS,
    CONTACTS,
    COPPER,
    DISTURBANCE,
    DISTURBANCE_SPIN,
    DRAG,
    DRAG_SPIN,
    EDGE,
    EDGE_SPIN,
    ELECTRICAL,
    JOINTS,
    TILT,
)
from fourbar_ros.plant.faults import WheelFaults
import numpy as np
from numpy.typing import NDArray

FIELDS: list[tuple[str, type, tuple[int, ...]]] = [
    ('scale', float, (4,)),             # of the torque that is asked for
    ('forced', float, (4,)),            # N m, whatever a powered motor is asked for; NaN for none
    ('shorted', float, (4,)),           # N m, powered or not; NaN for none
    ('extra_coulomb', float, (4,)),     # N m
]

WheelConditions = np.record
"""What is wrong with the wheels."""

Boxed = NDArray[Any]
"""An array of one record: a record by itself takes longer to hand to a kernel than it runs."""

SOUND = np.array([record(FIELDS, scale=1.0, forced=nan, shorted=nan, extra_coulomb=0.0)])
"""The conditions, boxed, where nothing is wrong."""


def conditions_of(faults: WheelFaults) -> Boxed:
    """Turn faults of the wheels into what the kernels take; their delays act elsewhere."""
    return np.array([record(
        FIELDS, scale=faults.torque_scale, forced=faults.forced_torque,
        shorted=faults.shorted_torque, extra_coulomb=faults.extra_friction + faults.hold_torque)])


# The state of a motor: its torque now [N m], and what its speed loop has learnt [N m].
MOTOR_STATE_SIZE = 8


@kernel
def advance_plant(
    state: Array, motor_state: Array, commands: Array, by_speed: NDArray[np.bool_],
    powered: NDArray[np.bool_], step: float, boxed_constants: Boxed, boxed_around: Boxed,
    boxed_motors: Boxed, boxed_conditions: Boxed, half_sizes: Array, restitution: float,
    efforts: Array, added: Array,
) -> None:
    """
    Advance the plant by as many steps as there are commands, in place.

    :param state: (STATE_SIZE,), see mechanism.layout.
    :param motor_state: (8,).
    :param commands: (n, 4) torques [N m], or speeds relative to the links [rad/s].
    :param by_speed: (4,) bool, which of both for each wheel.
    :param powered: (4,) bool, whose power stage is on.
    :param half_sizes: (2,) from the middle of the table to its edges [m].
    :param restitution: of the edge.
    :param efforts: (4,) receives the mean torque of the motors [N m].
    :param added: (SIZE,) of plant.ledger, is added to.
    """
    constants, around = boxed_constants[0], boxed_around[0]
    motors, conditions = boxed_motors[0], boxed_conditions[0]
    steps = commands.shape[0]
    given, torques, recoil = np.empty(4), np.empty(4), np.zeros(STATE_SIZE)
    before, lever = np.empty(10), np.empty((4, 2))
    efforts[:] = 0.0
    for j in range(4):
        if not (by_speed[j] and powered[j]):
            motor_state[4 + j] = nan    # its speed loop starts anew, whenever that is
    lost = _losses(state, constants, around)
    bounded = isfinite(half_sizes[0]) or isfinite(half_sizes[1])
    for n in range(steps):
        rubbing = False
        for j in range(4):
            given[j] = _motor_torque(
                j, commands[n, j], by_speed[j], powered[j], state[12 + j] - state[4 + j],
                motor_state, step, motors, conditions)
            efforts[j] += given[j] / steps
            friction = friction_over_step(
                j, state[12 + j] - state[4 + j], given[j], 0.0, conditions.extra_coulomb[j],
                step, motors)
            rubbing = rubbing or friction != 0.0
            torques[j] = given[j] - friction
        if rubbing:
            # What friction does depends a little on how the links give way.
            evaluate(state, torques, constants, around, recoil)
            for j in range(4):
                torques[j] = given[j] - friction_over_step(
                    j, state[12 + j] - state[4 + j], given[j], recoil[4 + j],
                    conditions.extra_coulomb[j], step, motors)
        before[0:4] = state[0:4]
        before[4:8] = state[8:12]
        before[8:10] = state[CENTRE_X:CENTRE_Y + 1]
        advance_state(state, torques, torques, torques, step, constants, around)
        for j in range(4):
            turned = state[8 + j] - before[4 + j]
            current = given[j] / motors.torque_constant[j]
            heat = motors.resistance[j] * current * current * step
            added[COPPER] += heat
            added[ELECTRICAL] += given[j] * turned + heat
            added[BEARINGS] += (given[j] - torques[j]) * turned
        if around.acting:
            earlier, lost = lost, _losses(state, constants, around)
            _add_effects(state, before, earlier, lost, step, constants, around, added)
        if bounded:
            count, heat, turn = meet_edges(
                state, half_sizes[0], half_sizes[1], restitution, constants, lever)
            if count:
                added[CONTACTS] += count
                added[EDGE] += heat
                added[EDGE_SPIN] += turn
                lost = _losses(state, constants, around)


@kernel
def _motor_torque(wheel: int, command: float, by_speed: bool, powered: bool, speed: float,
                  motor_state: Array, step: float, motors: Motors,
                  conditions: WheelConditions) -> float:
    """Return the mean torque that a motor gives over a step [N m]."""
    asked = conditions.forced[wheel] if powered else 0.0
    if not isnan(conditions.shorted[wheel]):
        asked = conditions.shorted[wheel]
    if isnan(asked):
        asked = command
        if by_speed:
            asked, motor_state[4 + wheel] = speed_loop(
                wheel, command, speed, motor_state[4 + wheel], step, motors)
        asked *= conditions.scale[wheel]
    target = available_torque(wheel, asked, speed, motors)
    mean, motor_state[wheel] = lagged_torque(wheel, motor_state[wheel], target, step, motors)
    if abs(speed) >= motors.speed_limit[wheel] and mean * speed > 0.0:
        mean = motor_state[wheel] = 0.0
    return mean


@kernel
def _losses(state: Array, constants: Constants, around: Surroundings
            ) -> tuple[float, float, float]:
    if not around.acting:
        return 0.0, 0.0, 0.0
    if constants.compliant:
        return body_losses(state, constants, around)
    return losses(
        (cos(state[0]), cos(state[1]), cos(state[2]), cos(state[3])),
        (sin(state[0]), sin(state[1]), sin(state[2]), sin(state[3])),
        (state[4], state[5], state[6], state[7]), (state[VELOCITY_X], state[VELOCITY_Y]),
        constants, around)


@kernel
def _add_effects(state: Array, before: Array, earlier: tuple[float, float, float],
                 later: tuple[float, float, float], step: float,
                 constants: Constants, around: Surroundings, added: Array) -> None:
    """Book what acted in a step: work of constant forces exactly, losses by the trapezoid."""
    half = 0.5 * step
    added[JOINTS] += half * (earlier[0] + later[0])
    added[DRAG] += half * (earlier[1] + later[1])
    added[DRAG_SPIN] += half * (earlier[2] + later[2])
    for axis in range(2):
        added[TILT] += constants.total_mass * around.gravity[axis] * (
            state[CENTRE_X + axis] - before[8 + axis])
    for j in range(4):
        added[DISTURBANCE] += around.link_torques[j] * (state[j] - before[j])
        added[DISTURBANCE_SPIN] += around.link_torques[j] * step
