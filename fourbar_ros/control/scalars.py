# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What the controller tells besides its commands, as named scalars."""

from __future__ import annotations

from math import isfinite

from fourbar_ros.control.computed_torque import A00, A01, A11, CONDITION
from fourbar_ros.control.controller import Controller
from fourbar_ros.control.null_space import null_torques
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.momentum import angular_momentum
import numpy as np

LINKS = tuple('abcd')

ALLOCATION = (
    'scale', 'condition_number', 'branch_hold', *(f'saturated_{link}' for link in LINKS),
    *(f'verdict_{link}' for link in LINKS), *(f'null_speed_{link}_rad_s' for link in LINKS))
"""
Names of what :func:`allocation_scalars` returns: share of what was asked for that the motors can
give; cond(A); how much of the hold on the branch there is; which motors are at a bound; what is
the matter with each wheel, as index of `wheel_watch.VERDICTS`; and the part of the speed of each
wheel that moves no link.
"""

MOMENTUM = ('total_n_m_s', 'axis_a_n_m_s', 'axis_b_n_m_s', 'margin', 'time_left_s')
"""
Names of what :func:`momentum_scalars` returns: angular momentum of the whole; of the axes; the
least share of a speed limit that is left; and when the first wheel meets its limit.
"""

# A torque as near to its bound as this, as a share, is at it.
AT_BOUND = 1e-6


def allocation_scalars(controller: Controller) -> Array:
    """Return the scalars of `ALLOCATION` at the last tick."""
    found = controller.law.decision
    inertias = controller.mechanism.flywheel_inertias
    reach = AT_BOUND * (found.upper - found.lower)
    saturated = (found.torques > found.upper - reach) | (found.torques < found.lower + reach)
    momenta, free, unlimited = inertias * controller.speeds, np.zeros(4), np.full(4, np.inf)
    null_torques(found.rows[:2], inertias, momenta, -unlimited, unlimited, np.zeros(4), free)
    return np.array([
        found.scale, found.terms[CONDITION], found.hold, *(saturated & controller.wheels.usable),
        *controller.wheels.verdicts, *(free / inertias)])


def momentum_scalars(controller: Controller) -> tuple[tuple[str, ...], Array]:
    """Return names and values of `MOMENTUM` at the last tick, without what never comes."""
    mechanism, found = controller.mechanism, controller.law.decision
    absolute = controller.speeds + controller.rates
    held = found.rows[:2] @ (mechanism.flywheel_inertias * absolute)
    a00, a01, a11 = found.terms[[A00, A01, A11]]
    axes = held + np.array([[a00, a01], [a01, a11]]) @ controller.rates[controller.law.axes]
    left = controller.momentum.time_left(controller.speeds)
    values = np.array([
        angular_momentum(mechanism, controller.angles, controller.rates, absolute), *axes,
        controller.momentum.margins(controller.speeds).min(), left])
    return (MOMENTUM, values) if isfinite(left) else (MOMENTUM[:-1], values[:-1])
