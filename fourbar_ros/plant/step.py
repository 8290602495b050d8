# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The plant in motion: motors, bearings, linkage and edge, one small step after the other.

In each step the torque on every wheel is constant: the mean motor torque less the friction of the
bearing (`plant.bearings`). So impulse and work of every torque are exact, and only friction in
joints and drag need a quadrature.
"""

from __future__ import annotations

from math import cos, isfinite, isnan, nan, sin
from typing import Any

from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.runge_kutta import Drive
from fourbar_ros.mechanism.compliant import compliant_losses
from fourbar_ros.mechanism.constants import Array, Fields, record
from fourbar_ros.mechanism.constants import FIELDS as CONSTANTS
from fourbar_ros.mechanism.forces import FIELDS as SURROUNDINGS
from fourbar_ros.mechanism.forces import Losses, losses, System
from fourbar_ros.mechanism.integration import advance_state, evaluate
from fourbar_ros.mechanism.motors import available_torque, lagged_torque, Motors, speed_loop
from fourbar_ros.mechanism.state import (
    ANGLE,
    angles_of,
    CENTRE_X,
    RATE,
    rates_of,
    STATE_SIZE,
    VELOCITY_X,
    VELOCITY_Y,
    WHEEL_ANGLE,
    WHEEL_SPEED,
)
from fourbar_ros.plant.bearings import FIELDS as DRIVES
from fourbar_ros.plant.bearings import friction_over_step
from fourbar_ros.plant.edge import meet_edges
from fourbar_ros.plant.faults import WheelFaults
import numpy as np
from numpy.typing import NDArray

CONDITIONS: Fields = [
    ('scale', float, (4,)),             # of the commanded torque
    ('forced', float, (4,)),            # N m, of a powered motor whatever its command; NaN: none
    ('shorted', float, (4,)),           # N m, powered or not; NaN for none
    ('extra_coulomb', float, (4,)),     # N m
]
# The effects of faults on the wheels, a scalar of `CONDITIONS`.
WheelConditions = np.record

# The parameters of the plant, for its kernel.
PARAMETERS: Fields = [
    ('constants', np.dtype((np.record, CONSTANTS)), ()),
    ('around', np.dtype((np.record, SURROUNDINGS)), ()),
    ('motors', np.dtype((np.record, DRIVES)), ()),
    ('step', float, ()),                # s
    ('half_sizes', float, (2,)),        # m, from the middle of the table to its edges
    ('restitution', float, ()),         # of the edge
]

# How a wheel is driven: by a commanded speed or torque, with or without power.
MODES = np.dtype([('by_speed', bool), ('powered', bool)])

# State of a motor: its torque [N m], and the integral of its speed loop [N m], NaN at rest.
MOTOR_STATES = np.dtype([('torque', float), ('integral', float)])

# An array of one record: numba takes longer to receive a record by itself than to use it.
Packed = NDArray[Any]

# The conditions of wheels without a fault.
SOUND: Packed = np.array([record(
    CONDITIONS, scale=1.0, forced=nan, shorted=nan, extra_coulomb=0.0)])


def conditions_of(faults: WheelFaults) -> Packed:
    """Return the conditions for the kernels; delays of commands act in the device."""
    return np.array([record(
        CONDITIONS, scale=faults.torque_scale, forced=faults.forced_torque,
        shorted=faults.shorted_torque, extra_coulomb=faults.extra_friction + faults.hold_torque)])


@kernel
def advance_plant(
    state: Array, motor_states: NDArray[Any], commands: Array, modes: NDArray[Any],
    parameters: Packed, conditions: Packed, efforts: Array, sums: Packed,
) -> None:
    """
    Advance the plant by one step for each command, in place.

    :param state: (STATE_SIZE,).
    :param motor_states: (4,) of `MOTOR_STATES`.
    :param commands: (n, 4) torques [N m], or speeds relative to the links [rad/s].
    :param modes: (4,) of `MODES`.
    :param parameters, conditions: (1,) of `PARAMETERS` and `CONDITIONS`.
    :param efforts: (4,) receives the mean torque of the motors [N m].
    :param sums: (1,) of `energy_budget.SUMS`, is added to.
    """
    plant, faults, budget = parameters[0], conditions[0], sums[0]
    constants, around, motors, step = plant.constants, plant.around, plant.motors, plant.step
    system = System(constants, around)
    steps = commands.shape[0]
    motor_torques, torques, recoil = np.empty(4), np.empty(4), np.zeros(STATE_SIZE)
    before, lever = np.empty(STATE_SIZE), np.empty((4, 2))
    drive = Drive(torques, torques, torques)
    efforts[:] = 0.0
    for j in range(4):
        if not (modes[j].by_speed and modes[j].powered):
            motor_states[j].integral = nan      # its speed loop starts anew
    lost = _losses(state, system)
    bounded = isfinite(plant.half_sizes[0]) or isfinite(plant.half_sizes[1])
    for n in range(steps):
        rubbing = False
        for j in range(4):
            speed = state[WHEEL_SPEED + j] - state[RATE + j]
            motor_torques[j] = _motor_torque(
                j, commands[n, j], modes[j], speed, motor_states[j], step, motors, faults)
            efforts[j] += motor_torques[j] / steps
            friction = friction_over_step(
                j, speed, motor_torques[j], 0.0, faults.extra_coulomb[j], step, motors)
            rubbing = rubbing or friction != 0.0
            torques[j] = motor_torques[j] - friction
        if rubbing:
            # Friction depends a little on the acceleration of the links.
            evaluate(state, torques, constants, around, recoil)
            for j in range(4):
                torques[j] = motor_torques[j] - friction_over_step(
                    j, state[WHEEL_SPEED + j] - state[RATE + j], motor_torques[j],
                    recoil[RATE + j], faults.extra_coulomb[j], step, motors)
        before[:] = state
        advance_state(state, drive, step, system)
        for j in range(4):
            turned = state[WHEEL_ANGLE + j] - before[WHEEL_ANGLE + j]
            current = motor_torques[j] / motors.torque_constant[j]
            heat = motors.resistance[j] * current * current * step
            budget.copper += heat
            budget.supplied += motor_torques[j] * turned + heat
            budget.bearings += (motor_torques[j] - torques[j]) * turned
        if around.acting:
            earlier, lost = lost, _losses(state, system)
            _add_effects(state, before, earlier, lost, step, system, sums)
        if bounded:
            count, heat, turn = meet_edges(
                state, plant.half_sizes[0], plant.half_sizes[1], plant.restitution, constants,
                lever)
            if count:
                budget.contacts += count
                budget.edge += heat
                budget.edge_spin += turn
                lost = _losses(state, system)


@kernel
def _motor_torque(wheel: int, command: float, mode: Any, speed: float, motor_state: Any,
                  step: float, motors: Motors, faults: WheelConditions) -> float:
    """Return the mean torque of a motor over a step [N m]."""
    asked = faults.forced[wheel] if mode.powered else 0.0
    if not isnan(faults.shorted[wheel]):
        asked = faults.shorted[wheel]
    if isnan(asked):
        asked = command
        if mode.by_speed:
            asked, motor_state.integral = speed_loop(
                wheel, command, speed, motor_state.integral, step, motors)
        asked *= faults.scale[wheel]
    target = available_torque(wheel, asked, speed, motors)
    mean, motor_state.torque = lagged_torque(wheel, motor_state.torque, target, step, motors)
    if abs(speed) >= motors.speed_limit[wheel] and mean * speed > 0.0:
        mean = motor_state.torque = 0.0
    return mean


@kernel
def _losses(state: Array, system: System) -> Losses:
    if not system.around.acting:
        return Losses(0.0, 0.0, 0.0)
    if system.constants.compliant:
        return compliant_losses(state, system)
    a, b, c, d = angles_of(state)
    return losses(
        (cos(a), cos(b), cos(c), cos(d)), (sin(a), sin(b), sin(c), sin(d)), rates_of(state),
        (state[VELOCITY_X], state[VELOCITY_Y]), system)


@kernel
def _add_effects(state: Array, before: Array, earlier: Losses, later: Losses, step: float,
                 system: System, sums: Packed) -> None:
    """Add the effects of a step: work of constant forces exactly, losses by the trapezoid."""
    constants, around, budget, half = system.constants, system.around, sums[0], 0.5 * step
    budget.joints += half * (earlier.joint_power + later.joint_power)
    budget.drag += half * (earlier.drag_power + later.drag_power)
    budget.drag_spin += half * (earlier.drag_torque + later.drag_torque)
    for axis in range(2):
        budget.tilt += constants.total_mass * around.gravity[axis] * (
            state[CENTRE_X + axis] - before[CENTRE_X + axis])
    for j in range(4):
        budget.disturbance += around.link_torques[j] * (state[ANGLE + j] - before[ANGLE + j])
        budget.disturbance_spin += around.link_torques[j] * step
