# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The loop where it fails to close: lengths that are not quite known, and joints that give.

Near alignment a linkage whose lengths miss by some delta is held on no line, but by its joints.
They are springs in series around the loop, so that what is missing of the closure along the weak
direction w, `r = w . sum s_i l_i e_i`, moves the links by the torques `-(k r + c dr/dt) dr/dphi`.
The gap across w is closed rigidly: there the links have leverage, along w they have none. The
lengths of links b, c and d are states of the filter; that of a sets the scale, which no angle
tells.
"""

from __future__ import annotations

from math import cos, sin, sqrt

from fourbar_ros.estimation.filter_state import LOOSE_BIASES
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import combine, dot, multiply, solve_upper, Vector4
from fourbar_ros.mechanism.change_points import RIGID_CONSTRAINT_RATIO
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import (
    constrained_accelerations,
    directions,
    factored_inertia,
    orthogonal_columns,
    project_onto_closure,
    signed_links,
)
from fourbar_ros.mechanism.forces import NOTHING
import numpy as np

# What the filter is told of a loop that may fail to close: density of the walk of lengths
# [m/sqrt(s)], stiffness [N/m] and damping [N s/m] of the joints in series, by what mass the links
# are lighter to them than with all the gap in joint 3 [kg], how well their pull is known, relative
# to it, density of white torques that turn opposite links apart [N m/sqrt(Hz)], and which share of
# a disturbance torque acts on the opposite link.
WALK, STIFFNESS, DAMPING, LIGHTER, KNOWN_TO, APART, SHARED = range(7)

# Stiffer joints than those that make the weak direction so fast there [rad/s] count as just so
# stiff. A step turns the motion by at most one radian.
FASTEST = 200.0

# Slowest motion that counts for how long an error of the joints' pull lasts [rad/s].
SLOWEST = 10.0

# What remains at least of an inertia of one that is made lighter.
LEAST_REST = 0.5

# Terms of the series of the transition matrix: over a radian, the next is one in 120.
TERMS = 4


@kernel
def take_lengths(x: Array, constants: Constants) -> None:
    """Let links b, c and d be as long as the state has them."""
    for link in range(1, 4):
        constants.lengths[link] = x[9 + link]


@kernel
def turned_by_lengths(angles: Array, lengths: Array) -> Array:
    """
    Evaluate how links c and d turn with the lengths of b, c and d, where links a and b stay.

    :param angles: (4,) on the closure, away from change points [rad].
    :returns: (2, 3) of phi_c and phi_d after l_b, l_c and l_d [rad/m].
    """
    turned = np.empty((2, 3))
    fold = sin(angles[3] - angles[2])
    for link in range(1, 4):
        sign = -1.0 if link == 3 else 1.0
        turned[0, link - 1] = -sign * cos(angles[3] - angles[link]) / (lengths[2] * fold)
        turned[1, link - 1] = -sign * cos(angles[2] - angles[link]) / (lengths[3] * fold)
    return turned


@kernel
def _weak_closure(cosines: Vector4, sines: Vector4, constants: Constants, slack: Array
                  ) -> tuple[float, Vector4, Vector4, Vector4, float, float]:
    """
    Evaluate the closure along its weak direction.

    :returns: r [m], its first and second derivatives after the angles [m/rad]; the accelerations
        of the links per force along it [1/(kg m)]; stiffness [N/m], and by what mass the links
        are lighter to it, over what remains of one [kg].
    """
    zero = (0.0, 0.0, 0.0, 0.0)
    factor, _ = factored_inertia(cosines, sines, zero, constants)
    px, py = signed_links(cosines, sines, constants.lengths)
    strong, weak, c, s = orthogonal_columns(factor, px, py)
    stiffest = (FASTEST / RIGID_CONSTRAINT_RATIO) ** 2 / dot(strong, strong)
    along, across = combine(-s, px, c, py), combine(c, px, s, py)
    rest = max(1.0 - slack[LIGHTER] * dot(weak, weak), LEAST_REST)
    return (along[0] + along[1] + along[2] + along[3], across, combine(-1.0, along, 0.0, along),
            solve_upper(factor, weak), min(slack[STIFFNESS], stiffest), slack[LIGHTER] / rest)


@kernel
def _accelerations(angles: Vector4, rates: Vector4, torques: Array, constants: Constants,
                   slack: Array, drive: Array) -> Vector4:
    """
    Solve the equations of motion, the joints pulling along the weak direction.

    :param drive: (4,) to work in.
    """
    cosines, sines = directions(angles)
    r, slopes, bends, pulled, stiffness, lighter = _weak_closure(
        cosines, sines, constants, slack)
    pull = stiffness * r + slack[DAMPING] * dot(slopes, rates)
    for i in range(4):
        drive[i] = torques[i] + pull * slopes[i]
    accelerations, _, _ = constrained_accelerations(
        angles[0], cosines, sines, rates, (0.0, 0.0), drive, constants, NOTHING, False)
    mean = 0.25 * (rates[0] + rates[1] + rates[2] + rates[3])
    w = (rates[0] - mean, rates[1] - mean, rates[2] - mean, rates[3] - mean)
    opening = dot(slopes, accelerations) + dot(bends, multiply(w, w))
    return combine(1.0, accelerations, lighter * opening, pulled)


@kernel
def move_elastic(x: Array, wheel_torques: Array, duration: float, constants: Constants,
                 slack: Array, state: Array) -> None:
    """
    Advance the links by one Runge-Kutta step of order four, joints giving in the weak direction.

    :param wheel_torques: (4,) If dOmega/dt of the wheels, relative to their links [N m].
    :param state: (STATE_SIZE,) receives angles and rates of the links.
    """
    torques, share = wheel_torques.copy(), slack[SHARED]
    for i in range(2):
        torques[i] -= (1.0 - share) * x[8 + i]
        torques[2 + i] -= share * x[8 + i]
    angles, rates = (x[0], x[1], x[2], x[3]), (x[4], x[5], x[6], x[7])
    zero = (0.0, 0.0, 0.0, 0.0)
    drive = np.empty(4)
    turned, gained = zero, zero
    stage_angles, stage_rates = angles, rates
    for stage in range(4):
        accelerations = _accelerations(
            stage_angles, stage_rates, torques, constants, slack, drive)
        weight = duration / 6.0 if stage in (0, 3) else duration / 3.0
        turned = combine(1.0, turned, weight, stage_rates)
        gained = combine(1.0, gained, weight, accelerations)
        step = duration if stage == 2 else 0.5 * duration
        stage_angles = combine(1.0, angles, step, stage_rates)
        stage_rates = combine(1.0, rates, step, accelerations)
    angles, rates = project_onto_closure(
        combine(1.0, angles, 1.0, turned), combine(1.0, rates, 1.0, gained), constants, False)
    for j in range(4):
        state[j], state[4 + j] = angles[j], rates[j]


@kernel
def lighten(x: Array, mobility: Array, constants: Constants, slack: Array) -> None:
    """Add to the accelerations per torque (4, 4) what the links are lighter, in place."""
    cosines, sines = directions((x[0], x[1], x[2], x[3]))
    _, _, _, pulled, _, lighter = _weak_closure(cosines, sines, constants, slack)
    for i in range(4):
        for k in range(4):
            mobility[i, k] += lighter * pulled[i] * pulled[k]


@kernel
def add_elasticity(x: Array, covariance: Array, mobility: Array, duration: float,
                   constants: Constants, slack: Array, transition: Array, noise: Array) -> None:
    """
    Evaluate the transition where joints give along the weak direction, and add what they shake.

    What the closure bends within the covariance counts as noise of their pull.

    :param mobility: (4, 4) accelerations per torque on each link [1/(kg m^2)].
    :param transition: (n, n) receives F of all but biases.
    :param noise: (n, n) Q, to which white torques are added that turn opposite links apart.
    """
    cosines, sines = directions((x[0], x[1], x[2], x[3]))
    r, slopes, bends, pulled, stiffness, _ = _weak_closure(cosines, sines, constants, slack)
    # Torques after angles, rates, disturbances and lengths.
    torques = np.zeros((4, LOOSE_BIASES))
    for i in range(4):
        for k in range(4):
            torques[i, k] = -stiffness * slopes[i] * slopes[k]
            torques[i, 4 + k] = -slack[DAMPING] * slopes[i] * slopes[k]
        torques[i, i] -= stiffness * r * bends[i]
        for k in range(1, 4):
            # r and its slopes are linear in the lengths.
            torques[i, 9 + k] = stiffness * bends[k] * slopes[i] / constants.lengths[k]
        if i > 0:
            torques[i, 9 + i] -= stiffness * r * slopes[i] / constants.lengths[i]
    share = slack[SHARED]
    torques[0, 8], torques[2, 8] = 1.0 - share, share
    torques[1, 9], torques[3, 9] = 1.0 - share, share
    generator = np.zeros((8, LOOSE_BIASES))
    for i in range(4):
        generator[i, 4 + i] = 1.0
        for k in range(LOOSE_BIASES):
            for m in range(4):
                generator[4 + i, k] += mobility[i, m] * torques[m, k]
    term, last = np.zeros((8, LOOSE_BIASES)), np.zeros((8, LOOSE_BIASES))
    for i in range(8):
        transition[i, :LOOSE_BIASES] = 0.0
        transition[i, i] = 1.0
        for k in range(LOOSE_BIASES):
            term[i, k] = generator[i, k] * duration
            transition[i, k] += term[i, k]
    for n in range(2, TERMS + 1):
        last[:], term[:] = term, 0.0
        for i in range(8):
            for m in range(8):
                weight = generator[i, m] * duration / n
                if weight != 0.0:
                    for k in range(LOOSE_BIASES):
                        term[i, k] += weight * last[m, k]
        for i in range(8):
            for k in range(LOOSE_BIASES):
                transition[i, k] += term[i, k]
    pull = stiffness * r + slack[DAMPING] * dot(slopes, (x[4], x[5], x[6], x[7]))
    # For as long as a radian of the motion takes the error stays the same.
    lasts = 1.0 / max(sqrt(stiffness * dot(slopes, pulled)), SLOWEST)
    variance = slack[KNOWN_TO] * slack[KNOWN_TO] * pull * pull
    for i in range(4):
        for k in range(4):
            bent = 0.5 * covariance[i, k] * covariance[i, k]
            variance += stiffness * stiffness * bends[i] * bends[k] * bent
    unknown = variance * lasts * duration
    white = slack[APART] * slack[APART] * duration
    for i in range(4):
        for k in range(4):
            size = unknown * pulled[i] * pulled[k] + white * (
                (mobility[i, 0] - mobility[i, 2]) * (mobility[k, 0] - mobility[k, 2])
                + (mobility[i, 1] - mobility[i, 3]) * (mobility[k, 1] - mobility[k, 3]))
            noise[i, k] += size * duration * duration / 3.0
            noise[i, 4 + k] += size * duration / 2.0
            noise[4 + k, i] += size * duration / 2.0
            noise[4 + i, 4 + k] += size
