# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The simulated testbed: linkage, flywheel motors and sensors, advanced in fixed small steps.

Commands are held over each control period (zero-order hold); motors, bearings and the edge of the
table act at every step.
"""

from __future__ import annotations

from math import isfinite

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import assemble, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.change_points import RATES_UNDETERMINED
from fourbar_ros.mechanism.constants import Array, record
from fourbar_ros.mechanism.dynamics import gamma_matrix, mass_matrix
from fourbar_ros.mechanism.samples import TrueState
from fourbar_ros.mechanism.state import (
    CENTRE_POSITION,
    CENTRE_VELOCITY,
    LINK_ANGLES,
    LINK_RATES,
    make_state,
    WHEEL_ANGLES,
    WHEEL_SPEEDS,
)
from fourbar_ros.plant.bearings import drives_of
from fourbar_ros.plant.edge import joint_levers, joint_motion
from fourbar_ros.plant.energy_budget import empty_sums, energy_budget, EnergyBudget
from fourbar_ros.plant.sensors import LinkSensors
from fourbar_ros.plant.settings import InitialState
from fourbar_ros.plant.step import (
    advance_plant,
    MODES,
    MOTOR_STATES,
    Packed,
    PARAMETERS,
    SOUND,
)
from fourbar_ros.plant.table import quantum, surroundings_of, Table
import numpy as np
from numpy.typing import ArrayLike

# Largest decay rate by friction times the step. Runge-Kutta of order four is stable up to 2.8; the
# margin is for other configurations.
STIFFEST = 1.0

# Age of the random-walk torques at the first draw [s]. It sets their initial variance, which an
# estimator assumes before the first measurement, too.
TORQUE_WALK_AGE = 10.0

# The relative rates in joints 1 to 4 from the rates of the links.
RELATIVE_RATES = np.array(
    [[-1.0, 1.0, 0.0, 0.0], [0.0, -1.0, 1.0, 0.0], [0.0, 0.0, -1.0, 1.0], [1.0, 0.0, 0.0, -1.0]])


class PlantError(FourbarError):
    """A plant that cannot be simulated, or whose state left the finite numbers."""


class Plant:
    """
    The linkage on its table.

    :param mechanism: the linkage, its wheels and motor limits.
    :param table: the table and the sensors.
    :param initial: state at the start.
    :param step_s: integration step [s].
    :param generator: source of all random numbers.
    :ivar link_sensors: the sensors, with the samples on their way.
    :ivar motor_states: (4,) of `step.MOTOR_STATES`.
    :ivar efforts: (4,) mean torque of each motor since the last call of `advance` [N m].
    :raises PlantError: the step is not a positive number, or too long for the friction.
    :raises ClosureError: the loop cannot close at the initial angles, or unknown branch.
    """

    def __init__(self, mechanism: Mechanism, table: Table, initial: InitialState, step_s: float,
                 generator: np.random.Generator) -> None:
        if not (isfinite(step_s) and step_s > 0.0):
            raise PlantError(f'the plant step must be a positive number of seconds, got {step_s}',
                             name='step', value=step_s)
        self.mechanism = mechanism
        self.step_s = step_s
        self._table = table
        self._generator = generator
        # Of seeds of their own, so that no sensor shifts the random numbers of the table.
        self.link_sensors = LinkSensors(
            table.link_sensors, np.random.SeedSequence(generator.integers(2**63)))
        surface = table.surface
        self._parameters = np.array([record(
            PARAMETERS, constants=mechanism.constants, around=surroundings_of(table),
            motors=drives_of(mechanism, table.wheel_bearings), step=step_s,
            half_sizes=[0.5 * surface.size_x, 0.5 * surface.size_y],
            restitution=surface.restitution)])
        self._parameters['around']['acting'] |= table.disturbance.acting
        self._constants = np.array([mechanism.constants])
        self._random_walk = np.zeros(2)
        self._random_walk_for: float | None = None
        self.efforts = np.zeros(4)
        self.reset(initial)
        self._check_friction()
        # Compile the kernels now, not while time runs.
        self.advance(1, np.zeros(4), powered=False)
        self.reset(initial)

    def _check_friction(self) -> None:
        joints = self._table.joints
        slope = joints.viscous + joints.coulomb * joints.static_ratio / joints.smoothing
        matrix = mass_matrix(self._state[LINK_ANGLES], self.mechanism.constants)
        rates = np.linalg.eigvals(np.linalg.solve(
            matrix, slope * RELATIVE_RATES.T @ RELATIVE_RATES))
        fastest = float(np.abs(rates).max())
        if fastest * self.step_s > STIFFEST:
            raise PlantError(
                f'a step of {self.step_s:g} s is too long for the friction in the joints of this '
                f'linkage, at most {STIFFEST / fastest:.2g} s: take a shorter step, less '
                'joints.coulomb, or more joints.smoothing',
                name='joints', value=self.step_s, limit=STIFFEST / fastest)
        links = self._table.links
        slowing = max(links.drag / self.mechanism.link_masses.min(),
                      links.spin_drag / self.mechanism.link_inertias.min())
        if slowing * self.step_s > STIFFEST:
            raise PlantError(
                f'a step of {self.step_s:g} s is too long for the drag on these links, at most '
                f'{STIFFEST / slowing:.2g} s: take a shorter step, less links.drag or '
                'links.spin_drag', name='links', value=self.step_s, limit=STIFFEST / slowing)

    def reset(self, initial: InitialState) -> None:
        """
        Set the state of the linkage, motors without torque; random numbers continue.

        :raises PlantError, ClosureError: the linkage cannot be there; then nothing was changed.
        """
        state = _initial_state(self.mechanism, initial)
        self._check_place(state)
        self._state = state
        self._start = self._state.copy()
        self.link_sensors.reset()
        self.motor_states = np.zeros(4, MOTOR_STATES)
        self.motor_states['integral'] = np.nan     # no wheel follows a speed yet
        self._sums = empty_sums()
        self.efforts[:] = 0.0

    def _check_place(self, state: Array) -> None:
        lever, half_sizes = np.empty((4, 2)), self._parameters['half_sizes'][0]
        for joint in range(4):
            joint_levers(joint, state, self.mechanism.constants, lever)
            beyond = np.abs(state[CENTRE_POSITION] + lever.sum(axis=0)) - half_sizes
            if beyond.max() > 0.0:
                raise PlantError(
                    f'joint {joint + 1} would start {beyond.max():.3g} m beyond the edge of the '
                    'table: take a larger surface.size_x and size_y',
                    joint=joint + 1, value=float(beyond.max()))

    def steps_in(self, duration_s: float) -> int:
        """
        Count the integration steps in a duration.

        :raises PlantError: the duration is not a whole multiple of the step, at least one.
        """
        steps = round(duration_s / self.step_s)
        if steps < 1 or abs(steps * self.step_s - duration_s) > 1e-9 * duration_s:
            raise PlantError(
                f'the control period must be a whole multiple of the plant step: '
                f'{duration_s:g} s / {self.step_s:g} s = {duration_s / self.step_s:g}',
                value=duration_s, limit=self.step_s)
        return steps

    def disturb(self, duration_s: float) -> None:
        """
        Draw new random torques on the links.

        :param duration_s: time for which they are going to be held [s].
        """
        disturbance = self._table.disturbance
        torques = np.zeros(4)
        if disturbance.torque_density:
            torques = self._generator.standard_normal(4) * (
                disturbance.torque_density / np.sqrt(duration_s))
        if disturbance.torque_walk:
            elapsed = (TORQUE_WALK_AGE if self._random_walk_for is None
                       else self._random_walk_for)
            self._random_walk = self._random_walk + self._generator.standard_normal(2) * (
                disturbance.torque_walk * np.sqrt(elapsed))
            self._random_walk_for = duration_s
            torques[:2] += self._random_walk
        if disturbance.acting:
            self.apply_link_torques(torques)

    def apply_link_torques(self, torques: ArrayLike) -> None:
        """Apply torques (4,) to the links from outside, until the next ones [N m]."""
        around = self._parameters['around']
        around['link_torques'][0] = torques
        around['acting'] = True

    def advance(self, steps: int, commands: Array, by_speed: ArrayLike = False,
                powered: ArrayLike = True, conditions: Packed = SOUND) -> None:
        """
        Advance by a number of steps.

        :param commands: (4,) torques of the motors [N m], or speeds of the wheels relative to the
            links [rad/s]; or (steps, 4), one row for each step.
        :param by_speed: whether the command is a speed, (4,) or the same for all wheels.
        :param powered: whether the power stage is on, likewise. A motor without power has a
            commanded torque of zero, and its speed loop is reset.
        :param conditions: effects of faults on the wheels.
        :raises PlantError: the state is no longer finite.
        """
        modes, held = np.empty(4, MODES), np.empty((steps, 4))
        modes['by_speed'] = by_speed
        modes['powered'] = powered
        held[:] = commands
        advance_plant(self._state, self.motor_states, held, modes, self._parameters, conditions,
                      self.efforts, self._sums)
        if not np.isfinite(self._state).all():
            raise PlantError('the state of the plant is no longer finite')

    def truth(self, efforts: Array | None = None) -> TrueState:
        """
        Return a copy of the true state.

        :param efforts: (4,) of the result, by default those of the last call of `advance` [N m].
        """
        state = self._state.copy()
        base = np.array(joint_motion(0, state, self._constants))
        return TrueState(
            state[LINK_ANGLES], state[LINK_RATES], state[WHEEL_ANGLES],
            state[WHEEL_SPEEDS] - state[LINK_RATES],
            self.efforts.copy() if efforts is None else efforts, self._random_walk.copy(),
            state[CENTRE_POSITION], state[CENTRE_VELOCITY], base[:2], base[2:])

    @property
    def contacts(self) -> int:
        """Number of contacts with the edge of the table since the start or the last reset."""
        return int(self._sums['contacts'][0])

    def ledger(self) -> EnergyBudget:
        """Return the budget of energy and momentum since the start or the last reset."""
        return energy_budget(self.mechanism, self._state, self._start, self._sums)

    def measure_links(self, stamp_ns: int) -> None:
        """Sample the link sensors now [ns], if a sample is due."""
        self.link_sensors.measure(
            stamp_ns, self._state[LINK_ANGLES], self._state[LINK_RATES])

    def sense_wheels(self) -> Array:
        """Read the four wheel encoders: (4,) unwrapped angles relative to the link [rad]."""
        return quantise(
            self._state[WHEEL_ANGLES], quantum(self._table.wheel_encoders.counts_per_turn))


def quantise(angles: Array, step: float) -> Array:
    """Round angles [rad] to multiples of a step [rad]; a step of 0 leaves them as they are."""
    return np.round(angles / step) * step if step else np.array(angles)


def _initial_state(mechanism: Mechanism, initial: InitialState) -> Array:
    angles = assemble(mechanism, initial.link_a, initial.link_b, initial.branch)
    rates = np.array([initial.rate_a, initial.rate_b, 0.0, 0.0])
    if rates.any():
        if abs(np.sin(angles[3] - angles[2])) < RATES_UNDETERMINED:
            raise PlantError(
                f'initial rates are given at a change point ({LINK_NAMES[2]} and {LINK_NAMES[3]} '
                'on a line), where they do not determine the motion', limit=RATES_UNDETERMINED)
        rates[2:] = gamma_matrix(angles, mechanism.constants.lengths) @ rates[:2]
    return make_state(angles, rates)
