# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The tracking law in one kernel: estimate and reference of the links in, wheel torques out."""

from __future__ import annotations

from fourbar_ros.control.allocation import Allocation, make_allocation
from fourbar_ros.control.allocation_solver import allocate, controllable, MotorState
from fourbar_ros.control.branch import Branch, UNPAIRED_AXES
from fourbar_ros.control.computed_torque import (
    AXES_FIELDS,
    demanded,
    ETA,
    evaluate_axes,
    Feedback,
    MOTION_FIELDS,
)
from fourbar_ros.control.null_space import null_torques, target_speeds, towards
from fourbar_ros.control.records import Fields, Record, records
from fourbar_ros.control.reference_generator import ReferenceGenerator
from fourbar_ros.control.settings import ControllerSettings
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.motors import available_torque, Motors, motors_of
import numpy as np
from numpy.typing import NDArray

# Names of the axes by link: a and b, or the first link of each pair.
AXES = ('a', 'b', 'c', 'd')

# Share of the motor limit that is available to the allocator, by kind of command.
#
# The speed loop in the motor's electronics needs a reserve: at the limit its integral is reset.
MOTOR_SHARE = {'effort': 0.98, 'velocity': 0.85}

# Shortest time in which a held torque may bring a wheel to its speed limit [s].
#
# It is far above the control period and the motor lag, so that the limit is not overrun.
HORIZON = 0.1

# Fields of the record of the inputs of a tick.
INPUT_FIELDS: Fields = [
    *MOTION_FIELDS,
    ('reference_accelerations', float, (4,)),   # rad/s^2, only those of the axes count
    ('disturbance', float, (2,)),               # N m, on links a and b besides the wheels
    ('wheel_speeds', float, (4,)),              # rad/s, relative to the links
    ('bearing_friction', float, (4,)),          # N m, against the speeds
    ('target_speeds', float, (4,)),             # rad/s, absolute, of the null-space control
    ('sticking', float, ()),                    # 0 in motion to 1 at rest, see Feedback
]

# Fields of the record of the gains.
GAIN_FIELDS: Fields = [
    ('stiffness', float, ()),                   # 1/s^2
    ('damping', float, ()),                     # 1/s
    ('rest_band', float, ()),                   # rad
    ('disturbance_compensation', float, ()),    # share
    ('branch_stiffness', float, ()),            # 1/s^2
    ('branch_damping', float, ()),              # 1/s
    ('wheel_bandwidth', float, ()),             # rad/s, 0 without a target of the wheel speeds
    ('motor_share', float, ()),                 # see MOTOR_SHARE
    ('null_weights_inv', float, (4,)),          # inverse weights of the null-space control
]

# Fields of the record of the outputs.
OUTPUT_FIELDS: Fields = [
    ('torques', float, (4,)),                   # N m, on wheels and links, bearings apart
    ('planned', float, (4,)),                   # N m, part of the reference acceleration alone
    ('lower', float, (4,)),                     # N m, bounds of the torques
    ('upper', float, (4,)),
    ('scale', float, ()),                       # share of the demand that the motors can meet
]


class LawOutput:
    """
    Output of the law at the last tick; the arrays are overwritten at each tick.

    :ivar axes: the record of the axes, see `computed_torque.AXES_FIELDS`.
    :ivar torques: (4,) on wheels and links, bearings apart [N m].
    :ivar planned: (4,) torques for the reference acceleration alone [N m].
    :ivar lower, upper: (4,) bounds of the torques [N m].
    """

    def __init__(self) -> None:
        self.records, self.axes_records = records(OUTPUT_FIELDS), records(AXES_FIELDS)
        self.axes: Record = self.axes_records[0]
        self.torques: Array = self.records['torques'][0]
        self.planned: Array = self.records['planned'][0]
        self.lower: Array = self.records['lower'][0]
        self.upper: Array = self.records['upper'][0]
        self._scale: Array = self.records['scale']

    @property
    def scale(self) -> float:
        """Share of the demand that the motors can meet."""
        return float(self._scale.item())


@kernel
def motor_bounds(speeds: Array, friction: Array, share: float, motors: Motors, lower: Array,
                 upper: Array) -> None:
    """
    Evaluate the torques that the motors can give now, bearing friction deducted.

    :param speeds: (4,) relative to the links [rad/s].
    :param friction: (4,) of the bearings, against the speed [N m].
    :param share: share of the motor limits that is available.
    :param lower, upper: (4,) receive the bounds, `lower <= 0 <= upper` [N m].
    """
    for j in range(4):
        limit = motors.torque_limit[j]
        low = share * available_torque(j, -limit, speeds[j], motors) - friction[j]
        high = share * available_torque(j, limit, speeds[j], motors) - friction[j]
        gain = motors.inertia[j] / HORIZON
        lower[j] = min(max(low, gain * (-motors.speed_limit[j] - speeds[j])), 0.0)
        upper[j] = max(min(high, gain * (motors.speed_limit[j] - speeds[j])), 0.0)


@kernel
def track(inputs: Record, gains: Record, rule: Record, plan_rule: Record,
          constants: Constants, motors: Motors, axes: Record, output: Record) -> None:
    """
    Evaluate the law.

    :param inputs: see `INPUT_FIELDS`.
    :param gains: see `GAIN_FIELDS`.
    :param rule: of the allocation, see `allocation_solver.RULE_FIELDS`.
    :param plan_rule: likewise, for the torques of the reference alone.
    :param axes: receives `computed_torque.AXES_FIELDS`.
    :param output: receives `OUTPUT_FIELDS`.
    """
    speeds = inputs.wheel_speeds
    motor_bounds(
        speeds, inputs.bearing_friction, gains.motor_share, motors, output.lower, output.upper)
    bounds = MotorState(output.lower, output.upper, speeds)
    evaluate_axes(inputs, constants, axes)
    demand, acceleration, disturbance = np.empty(3), np.empty(2), np.zeros(2)
    for axis in range(2):
        acceleration[axis] = inputs.reference_accelerations[inputs.paired_links[axis]]
        # Links a and b are on different axes, or both in the first pair.
        disturbance[0 if inputs.paired_links[2] == axis else axis] += (
            gains.disturbance_compensation * inputs.disturbance[axis])
    two_axes, torques = axes.wheel_map[:2], output.torques
    demanded(acceleration, Feedback(np.zeros((2, 2)), 0.0, 0.0, 0.0, 0.0, np.zeros(2)), axes,
             demand)
    allocate(plan_rule, two_axes, demand[:2], bounds, output.planned)
    demanded(acceleration, Feedback(axes.errors, gains.stiffness, gains.damping, gains.rest_band,
                                    inputs.sticking, disturbance), axes, demand)
    usable = 0
    for j in range(4):
        usable += rule.weights_inv[j] > 0.0
    hold = axes.hold if usable > 2 else 0.0
    output.scale = allocate(rule, two_axes, demand[:2], bounds, torques)
    if hold > 0.0:
        present = 0.0
        for j in range(4):
            present += axes.wheel_map[ETA, j] * torques[j]
        eta = -(gains.branch_stiffness * axes.eta + gains.branch_damping * axes.eta_rate)
        full = demand[ETA] + axes.eta_row[ETA] * eta
        demand[0] += hold * axes.eta_row[0] * eta
        demand[1] += hold * axes.eta_row[1] * eta
        demand[ETA] = hold * full - (1.0 - hold) * present
        output.scale = allocate(rule, axes.wheel_map, demand, bounds, torques)
    if gains.wheel_bandwidth > 0.0:
        free, held = np.zeros(4), np.zeros(4)
        desired = towards(speeds + inputs.rates, inputs.target_speeds,
                          constants.flywheel_inertias, gains.wheel_bandwidth)
        null_torques(two_axes, gains.null_weights_inv, desired, bounds, torques, free)
        if hold > 0.0:
            null_torques(axes.wheel_map, gains.null_weights_inv, desired, bounds, torques, held)
        for j in range(4):
            torques[j] += (1.0 - hold) * free[j] + hold * held[j]


@kernel
def _track(inputs: NDArray[np.record], gains: NDArray[np.record], rule: NDArray[np.record],
           plan_rule: NDArray[np.record], constants: NDArray[np.record],
           motors: NDArray[np.record], axes: NDArray[np.record], output: NDArray[np.record]
           ) -> None:
    track(inputs[0], gains[0], rule[0], plan_rule[0], constants[0], motors[0], axes[0],
          output[0])


@kernel
def _fill_inputs(packed: NDArray[np.record], reference: Array, angles: Array, rates: Array,
                 disturbance: Array, wheel_speeds: Array, friction: Array, sticking: float
                 ) -> None:
    """
    Fill the inputs except the pairs and the target speeds.

    :param packed: (1,) of `INPUT_FIELDS`.
    :param reference: (3, 4) see `ReferenceGenerator.links`.
    """
    inputs = packed[0]
    for j in range(4):
        inputs.angles[j], inputs.rates[j] = angles[j], rates[j]
        inputs.reference_angles[j], inputs.reference_rates[j] = reference[0, j], reference[1, j]
        inputs.reference_accelerations[j] = reference[2, j]
        inputs.wheel_speeds[j], inputs.bearing_friction[j] = wheel_speeds[j], friction[j]
    inputs.disturbance[0], inputs.disturbance[1] = disturbance[0], disturbance[1]
    inputs.sticking = sticking


class TrackingLaw:
    """
    The law with its gains and records.

    :param mechanism: the model of the linkage.
    :ivar output: of the last tick.
    :ivar usable: (4,) bool, wheels that may be used; see :meth:`tune`.
    :ivar allocation: the rule, with these wheels.
    :ivar motor_share: share of the motor limits that is available to the allocator.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.output = LawOutput()
        self.usable = np.ones(4, dtype=bool)
        self.allocation: Allocation
        self.motor_share = 1.0
        self._mechanism = mechanism
        self._constants = np.array([mechanism.with_rigid_joints().constants])
        self._motors = np.array([motors_of(mechanism)])
        self._gains = records(GAIN_FIELDS)
        self._inputs = records(INPUT_FIELDS)
        self._paired_links: NDArray[np.int64] = self._inputs['paired_links'][0]
        self._target_speeds: Array = self._inputs['target_speeds'][0]
        self._branch: Branch | None
        self._set_branch(None)
        self._plan_rule: NDArray[np.record]
        self._target = 'free'
        self._bias = 0.0

    def tune(self, settings: ControllerSettings, usable: NDArray[np.bool_]) -> None:
        """
        Apply gains, and the wheels that may be used (4,).

        :raises AllocationError: the allocation is unknown.
        """
        inertias = self._mechanism.flywheel_inertias
        self.allocation = make_allocation(settings.allocation, inertias, usable)
        self._plan_rule = self.allocation.for_plan(0.0, np.full(4, np.inf)).rule
        self.motor_share = MOTOR_SHARE[settings.command]
        self.usable = usable
        self._target, self._bias = settings.wheel_target, settings.wheel_bias
        self._target_speeds[:] = 0.0
        self._gains[0] = (
            settings.bandwidth ** 2, 2.0 * settings.damping * settings.bandwidth,
            settings.rest_band, settings.disturbance_compensation, settings.branch_bandwidth ** 2,
            2.0 * settings.branch_bandwidth,
            settings.wheel_bandwidth if self._target != 'free' else 0.0, self.motor_share,
            make_allocation('min_energy', inertias, usable).weights_inv)

    def update(self, reference: ReferenceGenerator, angles: Array, rates: Array,
               disturbance: Array, wheel_speeds: Array, friction: Array, sticking: float
               ) -> LawOutput:
        """
        Evaluate the law at a tick.

        :param reference: of the links.
        :param angles, rates: (4,) of the links, estimated [rad], [rad/s].
        :param disturbance: (2,) torques on links a and b besides those of the wheels [N m].
        :param wheel_speeds: (4,) relative to the links [rad/s].
        :param friction: (4,) of the bearings [N m].
        :param sticking: from 0, in motion, to 1, at rest; see `computed_torque.Feedback`.
        :returns: the output, whose arrays are overwritten at the next tick.
        """
        _fill_inputs(self._inputs, reference.links, angles, rates, disturbance, wheel_speeds,
                     friction, sticking)
        if reference.branch is not self._branch:
            self._set_branch(reference.branch)
        if self._target in ('zero', 'bias'):
            self._target_speeds[:] = target_speeds(self._target, rates, self._bias)
        _track(self._inputs, self._gains, self.allocation.rule, self._plan_rule, self._constants,
               self._motors, self.output.axes_records, self.output.records)
        return self.output

    @property
    def axes(self) -> NDArray[np.int64]:
        """Links that the axes of the last tick are named after (2,)."""
        return self._paired_links[:2]

    def lost_axes(self) -> list[str]:
        """Return the names of the axes that the wheels cannot drive."""
        directions, shares = controllable(
            self.output.axes.wheel_map[:2], self.allocation.weights_inv)
        return [AXES[self.axes[int(np.argmax(np.abs(direction)))]]
                for direction, share in zip(directions, shares) if share < 1.0]

    def _set_branch(self, branch: Branch | None) -> None:
        self._branch = branch
        self._inputs['paired'] = branch is not None
        self._paired_links[:] = UNPAIRED_AXES if branch is None else branch.paired_links
