# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Named scalars of the topics `allocation` and `momentum`."""

from __future__ import annotations

from math import isfinite

from fourbar_ros.control.allocation_solver import MotorState
from fourbar_ros.control.controller import Controller
from fourbar_ros.control.null_space import null_torques
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.momentum import angular_momentum
import numpy as np

LINKS = tuple('abcd')

# Names of :func:`allocation_scalars`: share of the demand that the motors can meet; cond(A); share
# of the branch hold; whether each motor is at a bound; fault state of each wheel, as index of
# `wheel_fault_detection.FAULT_STATES`; and the part of each wheel speed in the null space.
ALLOCATION = (
    'scale', 'condition_number', 'branch_hold', *(f'saturated_{link}' for link in LINKS),
    *(f'verdict_{link}' for link in LINKS), *(f'null_speed_{link}_rad_s' for link in LINKS))

# Names of :func:`momentum_scalars`: angular momentum of the whole linkage and of the axes; the
# least share of a speed limit that is left; and the time until drift brings a wheel to its limit.
MOMENTUM = ('total_n_m_s', 'axis_a_n_m_s', 'axis_b_n_m_s', 'margin', 'time_left_s')

# A torque within this share of the range between its bounds counts as at its bound.
AT_BOUND = 1e-6


def allocation_scalars(controller: Controller) -> Array:
    """Return the scalars of `ALLOCATION` at the last tick."""
    output, axes = controller.law.output, controller.law.output.axes
    inertias = controller.mechanism.flywheel_inertias
    reach = AT_BOUND * (output.upper - output.lower)
    saturated = (output.torques > output.upper - reach) | (output.torques < output.lower + reach)
    momenta, free, unlimited = inertias * controller.speeds, np.zeros(4), np.full(4, np.inf)
    null_torques(axes.wheel_map[:2], inertias, momenta,
                 MotorState(-unlimited, unlimited, controller.speeds), np.zeros(4), free)
    return np.array([
        output.scale, axes.condition, axes.hold, *(saturated & controller.wheels.usable),
        *controller.wheels.fault_states, *(free / inertias)])


def momentum_scalars(controller: Controller) -> tuple[tuple[str, ...], Array]:
    """Return names and values of `MOMENTUM` at the last tick, without an infinite time left."""
    mechanism, axes = controller.mechanism, controller.law.output.axes
    absolute = controller.speeds + controller.rates
    of_wheels = axes.wheel_map[:2] @ (mechanism.flywheel_inertias * absolute)
    momenta = of_wheels + np.array([[axes.a00, axes.a01], [axes.a01, axes.a11]]) @ (
        controller.rates[controller.law.axes])
    left = controller.momentum.time_left(controller.speeds)
    values = np.array([
        angular_momentum(mechanism, controller.angles, controller.rates, absolute), *momenta,
        controller.momentum.margins(controller.speeds).min(), left])
    return (MOMENTUM, values) if isfinite(left) else (MOMENTUM[:-1], values[:-1])
