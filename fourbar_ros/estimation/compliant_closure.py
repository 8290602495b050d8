# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The loop closure with uncertain link lengths and compliant joints.

Near alignment, a linkage with a length error delta may have no closed configuration: its joints
hold it together. They are four springs in series around the loop. The gap along the weak direction
w of the closure (mechanism.constrained), `r = w . sum s_i l_i e_i`, causes the torques
`-(k r + c dr/dt) dr/dphi` on the links. The closure across w, where the links have leverage, is
rigid. The lengths of links b, c and d are states of the filter. The length of link a is the unit
of length: no angle depends on it.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import NamedTuple

from fourbar_ros.estimation.filter_model import Model
from fourbar_ros.estimation.filter_state import (
    ANGLES,
    LENGTHS,
    RATES,
    SIZE_WITH_LENGTHS,
    TORQUES,
)
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import (
    combine,
    dot,
    multiply,
    solve_upper,
    total,
    Triangle,
    Vector4,
    ZERO,
)
from fourbar_ros.mechanism.change_points import RIGID_CONSTRAINT_RATIO
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import (
    constrained_accelerations,
    directions,
    factored_inertia,
    LinkMotion,
    orthogonal_columns,
    project_onto_closure,
    signed_links,
)
from fourbar_ros.mechanism.forces import NOTHING, System
import numpy as np

# Upper bound of the natural frequency along the weak direction at RIGID_CONSTRAINT_RATIO [rad/s]:
# stiffer joints count as just so stiff, so that a step turns the motion by at most one radian.
FASTEST = 200.0

# Least natural frequency [rad/s] that bounds the correlation time of an error of the joint force.
SLOWEST = 10.0

# Least fraction of a link's inertia that remains after the mass reduction.
LEAST_INERTIA = 0.5

# Terms of the series of the transition matrix: over a radian, the next one is 1/120.
TERMS = 4


class ClosureBasis(NamedTuple):
    """
    The closure constraint, resolved along its strong and weak directions.

    :param factor: Cholesky factor of the mass matrix.
    :param x, y: signed links `s_i l_i e_i` [m].
    :param strong, weak: orthogonal columns of the constraint in the metric of the mass matrix.
    :param cosine, sine: rotation from the frame to (strong, weak).
    """

    factor: Triangle
    x: Vector4
    y: Vector4
    strong: Vector4
    weak: Vector4
    cosine: float
    sine: float


class WeakClosure(NamedTuple):
    """
    The closure along its weak direction.

    :param gap: r [m].
    :param gradient, curvature: first and second derivatives of the gap by the angles [m/rad].
    :param response: accelerations of the links per force along the gap [1/(kg m)].
    :param stiffness: of the joints along the gap, bounded by FASTEST [N/m].
    :param mass_reduction: over the remaining fraction of the inertia [kg].
    """

    gap: float
    gradient: Vector4
    curvature: Vector4
    response: Vector4
    stiffness: float
    mass_reduction: float


@kernel
def four(values: Array) -> Vector4:
    """Return the values of the four links as a tuple."""
    return (values[0], values[1], values[2], values[3])


@kernel
def closure_basis(cosines: Vector4, sines: Vector4, constants: Constants) -> ClosureBasis:
    """Resolve the closure constraint."""
    factor, _ = factored_inertia(cosines, sines, ZERO, constants)
    x, y = signed_links(cosines, sines, constants.lengths)
    strong, weak, cosine, sine = orthogonal_columns(factor, x, y)
    return ClosureBasis(factor, x, y, strong, weak, cosine, sine)


@kernel
def set_lengths(x: Array, model: Model) -> None:
    """Copy the lengths of links b, c and d from the state to the model."""
    lengths = x[LENGTHS]
    for n in range(3):
        model.constants.lengths[1 + n] = lengths[n]


@kernel
def angles_by_lengths(angles: Array, lengths: Array) -> Array:
    """
    Differentiate the angles of links c and d by the lengths of b, c and d, links a and b at rest.

    :param angles: (4,) on the closure, off change points [rad].
    :returns: (2, 3) of phi_c and phi_d by l_b, l_c and l_d [rad/m].
    """
    slopes = np.empty((2, 3))
    fold = sin(angles[3] - angles[2])
    for link in range(1, 4):
        sign = -1.0 if link == 3 else 1.0
        slopes[0, link - 1] = -sign * cos(angles[3] - angles[link]) / (lengths[2] * fold)
        slopes[1, link - 1] = -sign * cos(angles[2] - angles[link]) / (lengths[3] * fold)
    return slopes


@kernel
def _weak_closure(cosines: Vector4, sines: Vector4, model: Model) -> WeakClosure:
    """Evaluate the closure along its weak direction."""
    basis = closure_basis(cosines, sines, model.constants)
    c, s = basis.cosine, basis.sine
    stiffest = (FASTEST / RIGID_CONSTRAINT_RATIO) ** 2 / dot(basis.strong, basis.strong)
    along = combine(-s, basis.x, c, basis.y)
    across = combine(c, basis.x, s, basis.y)
    inertia = max(1.0 - model.mass_reduction * dot(basis.weak, basis.weak), LEAST_INERTIA)
    return WeakClosure(
        total(along), across, combine(-1.0, along, 0.0, along),
        solve_upper(basis.factor, basis.weak), min(model.stiffness, stiffest),
        model.mass_reduction / inertia)


@kernel
def _accelerations(angles: Vector4, rates: Vector4, torques: Array, model: Model, drive: Array
                   ) -> Vector4:
    """
    Solve the equations of motion with compliant joints along the weak direction.

    :param torques: (4,) If dOmega/dt less the disturbance torques [N m].
    :param drive: (4,) workspace.
    """
    cosines, sines = directions(angles)
    weak = _weak_closure(cosines, sines, model)
    force = weak.stiffness * weak.gap + model.damping * dot(weak.gradient, rates)
    for i in range(4):
        drive[i] = torques[i] + force * weak.gradient[i]
    accelerations = constrained_accelerations(
        LinkMotion(angles[0], cosines, sines, rates, (0.0, 0.0)), drive,
        System(model.constants, NOTHING), False).accelerations
    mean = 0.25 * total(rates)
    w = (rates[0] - mean, rates[1] - mean, rates[2] - mean, rates[3] - mean)
    opening = dot(weak.gradient, accelerations) + dot(weak.curvature, multiply(w, w))
    return combine(1.0, accelerations, weak.mass_reduction * opening, weak.response)


@kernel
def integrate_compliant(x: Array, wheel_torques: Array, duration: float, model: Model, end: Array
                        ) -> None:
    """
    Integrate by one Runge-Kutta step of order four, joints compliant in the weak direction.

    :param wheel_torques: (4,) If dOmega/dt of the wheels, relative to their links [N m].
    :param end: (STATE_SIZE,) receives angles and rates of the links.
    """
    torques, share, disturbances = wheel_torques.copy(), model.opposite_share, x[TORQUES]
    for i in range(2):
        torques[i] -= (1.0 - share) * disturbances[i]
        torques[2 + i] -= share * disturbances[i]
    angles, rates = four(x[ANGLES]), four(x[RATES])
    drive = np.empty(4)
    angle_change, rate_change = ZERO, ZERO
    stage_angles, stage_rates = angles, rates
    for stage in range(4):
        accelerations = _accelerations(stage_angles, stage_rates, torques, model, drive)
        weight = duration / 6.0 if stage in (0, 3) else duration / 3.0
        angle_change = combine(1.0, angle_change, weight, stage_rates)
        rate_change = combine(1.0, rate_change, weight, accelerations)
        step = duration if stage == 2 else 0.5 * duration
        stage_angles = combine(1.0, angles, step, stage_rates)
        stage_rates = combine(1.0, rates, step, accelerations)
    angles, rates = project_onto_closure(
        combine(1.0, angles, 1.0, angle_change), combine(1.0, rates, 1.0, rate_change),
        model.constants, False)
    end[ANGLES], end[RATES] = angles, rates


@kernel
def add_mass_reduction(x: Array, mobility: Array, model: Model) -> None:
    """Add the mass reduction of compliant joints to the mobility (4, 4), in place."""
    cosines, sines = directions(four(x[ANGLES]))
    weak = _weak_closure(cosines, sines, model)
    for i in range(4):
        for k in range(4):
            mobility[i, k] += weak.mass_reduction * weak.response[i] * weak.response[k]


@kernel
def linearize_compliant(x: Array, covariance: Array, mobility: Array, duration: float,
                        model: Model, transition: Array, noise: Array) -> None:
    """
    Evaluate the transition with compliant joints, and add the noise of their force.

    The curvature of the gap within the covariance counts as noise of the force.

    :param mobility: (4, 4) accelerations per torque on each link [1/(kg m^2)].
    :param transition: (n, n) receives F except for gyro biases.
    :param noise: (n, n) Q, to which the noise is added.
    """
    cosines, sines = directions(four(x[ANGLES]))
    weak = _weak_closure(cosines, sines, model)
    stiffness, gradient, curvature = weak.stiffness, weak.gradient, weak.curvature
    generator = np.zeros((8, SIZE_WITH_LENGTHS))
    _fill_generator(weak, mobility, model, generator)
    term = np.zeros((8, SIZE_WITH_LENGTHS))
    last = np.zeros((8, SIZE_WITH_LENGTHS))
    for i in range(8):
        transition[i, :SIZE_WITH_LENGTHS] = 0.0
        transition[i, i] = 1.0
        for k in range(SIZE_WITH_LENGTHS):
            term[i, k] = generator[i, k] * duration
            transition[i, k] += term[i, k]
    for n in range(2, TERMS + 1):
        last[:], term[:] = term, 0.0
        for i in range(8):
            for m in range(8):
                weight = generator[i, m] * duration / n
                if weight != 0.0:
                    for k in range(SIZE_WITH_LENGTHS):
                        term[i, k] += weight * last[m, k]
        for i in range(8):
            for k in range(SIZE_WITH_LENGTHS):
                transition[i, k] += term[i, k]
    force = stiffness * weak.gap + model.damping * dot(gradient, four(x[RATES]))
    # Correlation time of an error of the force: a radian of the motion.
    correlation = 1.0 / max(sqrt(stiffness * dot(gradient, weak.response)), SLOWEST)
    variance = model.force_uncertainty * model.force_uncertainty * force * force
    for i in range(4):
        for k in range(4):
            bent = 0.5 * covariance[i, k] * covariance[i, k]
            variance += stiffness * stiffness * curvature[i] * curvature[k] * bent
    density = variance * correlation * duration
    white = model.opposing_torque * model.opposing_torque * duration
    angle_angle, angle_rate = noise[ANGLES, ANGLES], noise[ANGLES, RATES]
    rate_angle, rate_rate = noise[RATES, ANGLES], noise[RATES, RATES]
    for i in range(4):
        for k in range(4):
            added = density * weak.response[i] * weak.response[k] + white * (
                (mobility[i, 0] - mobility[i, 2]) * (mobility[k, 0] - mobility[k, 2])
                + (mobility[i, 1] - mobility[i, 3]) * (mobility[k, 1] - mobility[k, 3]))
            angle_angle[i, k] += added * duration * duration / 3.0
            angle_rate[i, k] += added * duration / 2.0
            rate_angle[k, i] += added * duration / 2.0
            rate_rate[i, k] += added


@kernel
def _fill_generator(weak: WeakClosure, mobility: Array, model: Model, generator: Array) -> None:
    """
    Evaluate the derivative of angles and rates over time by the state.

    :param generator: (8, SIZE_WITH_LENGTHS) zero, receives it.
    """
    gradient, curvature, stiffness = weak.gradient, weak.curvature, weak.stiffness
    lengths, share = model.constants.lengths, model.opposite_share
    # Torques on the links by the state.
    torques = np.zeros((4, SIZE_WITH_LENGTHS))
    by_angles, by_rates = torques[:, ANGLES], torques[:, RATES]
    by_disturbances, by_lengths = torques[:, TORQUES], torques[:, LENGTHS]
    for i in range(4):
        for k in range(4):
            by_angles[i, k] = -stiffness * gradient[i] * gradient[k]
            by_rates[i, k] = -model.damping * gradient[i] * gradient[k]
        by_angles[i, i] -= stiffness * weak.gap * curvature[i]
        for k in range(1, 4):
            # The gap and its gradient are linear in the lengths.
            by_lengths[i, k - 1] = stiffness * curvature[k] * gradient[i] / lengths[k]
        if i > 0:
            by_lengths[i, i - 1] -= stiffness * weak.gap * gradient[i] / lengths[i]
    by_disturbances[0, 0], by_disturbances[2, 0] = 1.0 - share, share
    by_disturbances[1, 1], by_disturbances[3, 1] = 1.0 - share, share
    accelerations, rates_by_rates = generator[RATES], generator[ANGLES, RATES]
    for i in range(4):
        rates_by_rates[i, i] = 1.0
        for k in range(SIZE_WITH_LENGTHS):
            for m in range(4):
                accelerations[i, k] += mobility[i, m] * torques[m, k]
