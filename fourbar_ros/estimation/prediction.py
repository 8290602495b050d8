# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Kernels of the prediction of the filter.

Off change points, links c and d follow a and b, and the transition has columns for a and b only.
Near change points (below `REDUCED_FORM_LIMIT`), all four links are states in their own
right: the transition is that of free links, and the closure and its rate are measurements without
noise. Where the covariance does not exclude that all links lie on one line, the closure does not
constrain its weak direction.

With uncertain lengths, the loop closes with the lengths in the state, and near change points the
joints are springs along the weak direction (estimation.compliant_closure).
"""

from __future__ import annotations

from math import ceil, sin

from fourbar_ros.estimation.bias_detection import predict_hypotheses
from fourbar_ros.estimation.compliant_closure import (
    add_mass_reduction,
    angles_by_lengths,
    closure_basis,
    ClosureBasis,
    FASTEST,
    four,
    integrate_compliant,
    linearize_compliant,
    set_lengths,
)
from fourbar_ros.estimation.filter_model import Model, Records
from fourbar_ros.estimation.filter_state import (
    ANGLES,
    LENGTHS,
    MOTION,
    RATES,
    SIZE_EXACT,
    SIZE_WITH_LENGTHS,
    TORQUES,
)
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import combine, dot, solve_lower, solve_upper
from fourbar_ros.kernels.runge_kutta import Drive
from fourbar_ros.mechanism.change_points import (
    DISTINCT_SIGMAS_SQUARED,
    REDUCED_FORM_LIMIT,
    RIGID_CONSTRAINT_RATIO,
)
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import (
    advance_constrained,
    directions,
    project_onto_closure,
)
from fourbar_ros.mechanism.dynamics import gamma_matrix, mass_matrix
from fourbar_ros.mechanism.forces import NOTHING, System
from fourbar_ros.mechanism.integration import advance_state
from fourbar_ros.mechanism.reduced import close_reduced
from fourbar_ros.mechanism.state import STATE_SIZE
import numpy as np

# Half width of the central differences of the transition [rad], [rad/s] and relative to a length,
# and width of the one-sided difference by torques [N m], in which the motion is almost linear.
DIFFERENCE = 1e-6

# Standard deviation of the closure [rad] and of its rate [rad/s] as measurements, over the length
# of a link: rounding must not make the covariance singular.
CLOSURE_SIGMA = 1e-8
CLOSURE_RATE_SIGMA = 1e-6

# The same with uncertain lengths, where the joints give a little in all directions. The line of
# alignment follows from estimated angles: a repeated measurement without noise across it would
# also seem to determine the state along it.
COMPLIANT_SIGMA = 1e-5
COMPLIANT_RATE_SIGMA = 1e-3


@kernel
def near_change_point(x: Array) -> bool:
    """Tell whether links c and d are so close to one line that all four links are states."""
    angles = x[ANGLES]
    return not abs(sin(angles[3] - angles[2])) > REDUCED_FORM_LIMIT


@kernel
def predict(x: Array, covariance: Array, hypotheses: Records, models: Records,
            wheel_torques: Array, duration: float, transition: Array, noise: Array) -> None:
    """
    Predict in place: filterpy's `predict` with the linkage as the process model.

    :param x, covariance: (n,) and (n, n), see estimation.filter_state.
    :param hypotheses: (2, sensors), see estimation.bias_detection.
    :param models: (1,) of make_model.
    :param wheel_torques: (4,) If dOmega/dt of the wheels, relative to their links [N m].
    :param duration: [s].
    :param transition, noise: (n, n) receive F and Q; those of the last part where the motion along
        the weak direction is too fast for one step.
    """
    model = models[0]
    parts = 1
    if model.uncertain_lengths:
        set_lengths(x, model)
        if near_change_point(x):
            parts = max(1, int(ceil(duration * FASTEST)))
    for _ in range(parts):
        _predict_part(
            x, covariance, hypotheses, model, wheel_torques, duration / parts, transition, noise)


@kernel
def _predict_part(x: Array, covariance: Array, hypotheses: Records, model: Model,
                  wheel_torques: Array, duration: float, transition: Array, noise: Array) -> None:
    end = np.empty(STATE_SIZE)
    transition[:] = 0.0
    noise[:] = 0.0
    for i in range(TORQUES.start, x.size):
        transition[i, i] = 1.0
    for i in range(SIZE_EXACT, x.size):
        is_length = model.uncertain_lengths and i < SIZE_WITH_LENGTHS
        walk = model.length_walk if is_length else model.gyro_walk
        noise[i, i] = walk * walk * duration
    near = near_change_point(x)
    if near:
        _predict_free(x, covariance, model, wheel_torques, duration, transition, noise, end)
    else:
        if model.uncertain_lengths:
            _linearize_lengths(x, wheel_torques, duration, model.constants, transition, end)
        _linearize_reduced(x, wheel_torques, duration, model.constants, transition, end)
        _reduced_noise(x, end, duration, model, noise)
    _propagate(covariance, transition, noise, near)
    predict_hypotheses(hypotheses, transition, duration)
    x[MOTION] = end[MOTION]
    if near:
        _condition_on_closure(x, covariance, hypotheses, model)


@kernel
def _predict_free(x: Array, covariance: Array, model: Model, wheel_torques: Array,
                  duration: float, transition: Array, noise: Array, end: Array) -> None:
    """Predict the links near a change point: evaluate F, Q and the end of the motion."""
    held = _weak_is_held(x, covariance, model)
    mobility = _mobility(x, held, model.constants)
    if held or not model.uncertain_lengths:
        _linearize_free(mobility, 0.0, duration, model, transition, noise)
        _integrate(x, wheel_torques, duration, held, model.constants, end)
    else:
        add_mass_reduction(x, mobility, model)
        _linearize_free(mobility, model.opposite_share, duration, model, transition, noise)
        linearize_compliant(x, covariance, mobility, duration, model, transition, noise)
        integrate_compliant(x, wheel_torques, duration, model, end)


@kernel
def enforce_closure(x: Array, covariance: Array, model: Model) -> None:
    """Move angles and rates that are close to the closure onto it, in place."""
    # The kernels of the mechanism take x as a state: both begin with angles and rates.
    if model.uncertain_lengths and near_change_point(x) or not close_reduced(x, model.constants):
        angles, rates = project_onto_closure(
            four(x[ANGLES]), four(x[RATES]), model.constants, _weak_is_held(x, covariance, model))
        x[ANGLES], x[RATES] = angles, rates


@kernel
def _weak_is_held(x: Array, covariance: Array, model: Model) -> bool:
    """
    Tell whether the closure constrains its weak direction.

    It does not at a change point. Within the uncertainty of the angles, the linkage may be at one.
    With uncertain lengths, the closure constrains it where the links have leverage.
    """
    cosines, sines = directions(four(x[ANGLES]))
    basis = closure_basis(cosines, sines, model.constants)
    strong, weak, px, py = basis.strong, basis.weak, basis.x, basis.y
    size = dot(strong, strong)
    if model.uncertain_lengths:
        return dot(weak, weak) > RIGID_CONSTRAINT_RATIO * RIGID_CONSTRAINT_RATIO * size
    # Derivative of the weak column by the angles relative to link a, without its strong part.
    changes = np.zeros((4, 4))
    for i in range(1, 4):
        slope = basis.sine * px[i] - basis.cosine * py[i]
        unit = (0.0, slope if i == 1 else 0.0, slope if i == 2 else 0.0, slope if i == 3 else 0.0)
        column = solve_lower(basis.factor, unit)
        along = dot(column, strong) / size
        for j in range(4):
            changes[i, j] = column[j] - along * strong[j]
    variance = 0.0
    for i in range(1, 4):
        for k in range(1, 4):
            relative = covariance[i, k] - covariance[i, 0] - covariance[0, k] + covariance[0, 0]
            for j in range(4):
                variance += changes[i, j] * relative * changes[k, j]
    return dot(weak, weak) > DISTINCT_SIGMAS_SQUARED * variance


@kernel
def _condition_on_closure(x: Array, covariance: Array, hypotheses: Records, model: Model) -> None:
    """
    Take the closure and its rate as measurements, in place.

    The curvature of the closure within the covariance counts as noise of the measurement. The
    lengths are consider states of it (S. F. Schmidt): they contribute to its variance but are not
    updated. A repeated measurement without noise, at estimated angles, would seem to determine
    all of them; the sensors determine them.
    """
    cosines, sines = directions(four(x[ANGLES]))
    basis = closure_basis(cosines, sines, model.constants)
    row = np.empty(SIZE_WITH_LENGTHS if model.uncertain_lengths else MOTION.stop)
    curvature = np.empty(4)
    directions_held = 2 if _weak_is_held(x, covariance, model) else 1
    for weak in range(directions_held):
        for of_rates in (False, True):
            _fill_closure_row(x, basis, weak == 1, of_rates, model, row, curvature)
            if model.uncertain_lengths:
                sigma = COMPLIANT_RATE_SIGMA if of_rates else COMPLIANT_SIGMA
            else:
                sigma = CLOSURE_RATE_SIGMA if of_rates else CLOSURE_SIGMA
            sigma *= model.constants.lengths[2]
            variance = _curvature_variance(sigma * sigma, covariance, curvature, of_rates)
            _condition(covariance, hypotheses, row, variance)


@kernel
def _fill_closure_row(x: Array, basis: ClosureBasis, weak: bool, of_rates: bool, model: Model,
                      row: Array, curvature: Array) -> None:
    """
    Evaluate the derivatives of the closure, or of its rate, along one direction.

    :param row: receives the first derivatives by the state.
    :param curvature: (4,) receives the second derivatives by the angles.
    """
    p, q = (-basis.sine, basis.cosine) if weak else (basis.cosine, basis.sine)
    rates = x[RATES]
    row[:] = 0.0
    by_angles, by_rates = row[ANGLES], row[RATES]
    for i in range(4):
        curvature[i] = -(p * basis.x[i] + q * basis.y[i])
        along = q * basis.x[i] - p * basis.y[i]
        if of_rates:
            by_angles[i], by_rates[i] = curvature[i] * rates[i], along
        else:
            by_angles[i] = along
    if model.uncertain_lengths:
        by_lengths = row[LENGTHS]
        for i in range(1, 4):
            grown = by_rates[i] * rates[i] if of_rates else -curvature[i]
            by_lengths[i - 1] = grown / model.constants.lengths[i]


@kernel
def _curvature_variance(variance: float, covariance: Array, curvature: Array, of_rates: bool
                        ) -> float:
    """Add to a variance that of the closure, or of its rate, from its curvature."""
    angles, cross = covariance[ANGLES, ANGLES], covariance[ANGLES, RATES]
    cross_t, rates = covariance[RATES, ANGLES], covariance[RATES, RATES]
    for i in range(4):
        for k in range(4):
            bent = 0.5 * angles[i, k] * angles[i, k]
            if of_rates:
                bent = angles[i, k] * rates[i, k] + cross[i, k] * cross_t[i, k]
            variance += curvature[i] * curvature[k] * bent
    return variance


@kernel
def _condition(covariance: Array, hypotheses: Records, row: Array, variance: float) -> None:
    """
    Update covariance and bias hypotheses by a scalar measurement that is fulfilled, in place.

    :param row: (m,) of H; the remaining elements are zero. Lengths, if any, are consider states.
    :param variance: of the measurement.
    """
    size, count = covariance.shape[0], row.size
    cross = np.empty(size)
    for i in range(size):
        cross[i] = 0.0
        for k in range(count):
            cross[i] += covariance[i, k] * row[k]
    for k in range(count):
        variance += row[k] * cross[k]
    for i in range(size):
        for k in range(size):
            if min(i, k) < SIZE_EXACT or max(i, k) >= count:
                covariance[i, k] -= cross[i] * cross[k] / variance
    for kind in range(hypotheses.shape[0]):
        for sensor in range(hypotheses.shape[1]):
            effect = hypotheses[kind, sensor].effect
            change = 0.0
            for k in range(count):
                change += row[k] * effect[k]
            for i in range(size):
                effect[i] -= cross[i] * change / variance


@kernel
def _integrate(x: Array, wheel_torques: Array, duration: float, weak_held: bool,
               constants: Constants, end: Array) -> None:
    """
    Integrate the links with locked wheels, driven by the reaction to the wheels' motion.

    :param end: (STATE_SIZE,) receives angles and rates of the links.
    """
    end[:] = 0.0
    end[MOTION] = x[MOTION]
    drive, disturbances = wheel_torques.copy(), x[TORQUES]
    drive[0] -= disturbances[0]
    drive[1] -= disturbances[1]
    if weak_held:
        advance_state(end, Drive(drive, drive, drive), duration, System(constants, NOTHING))
    else:
        advance_constrained(
            end, Drive(drive, drive, drive), duration, System(constants, NOTHING), False)


@kernel
def _integrate_reduced(trial: Array, gamma: Array, wheel_torques: Array, duration: float,
                       constants: Constants, end: Array) -> None:
    """
    Integrate as _integrate; the rates of links c and d follow a and b.

    :param trial: its rates of links c and d are set.
    :param gamma: (2, 2) rates of links c and d by those of a and b.
    """
    rates = trial[RATES]
    rates[2] = gamma[0, 0] * rates[0] + gamma[0, 1] * rates[1]
    rates[3] = gamma[1, 0] * rates[0] + gamma[1, 1] * rates[1]
    _integrate(trial, wheel_torques, duration, True, constants, end)


@kernel
def _linearize_reduced(x: Array, wheel_torques: Array, duration: float, constants: Constants,
                       transition: Array, end: Array) -> None:
    """
    Evaluate the transition of all links by links a and b, where c and d follow these.

    :param end: (STATE_SIZE,) receives the end of the motion.
    """
    gamma = gamma_matrix(x, constants.lengths)
    trial = np.empty(SIZE_EXACT)
    width = 0.5 / DIFFERENCE
    for link in range(2):
        for column in (ANGLES.start + link, RATES.start + link):
            for sign in (1.0, -1.0):
                trial[:] = x[:SIZE_EXACT]
                trial[column] += sign * DIFFERENCE
                moved_gamma = gamma
                if column < ANGLES.stop:
                    trial[2] += sign * DIFFERENCE * gamma[0, link]
                    trial[3] += sign * DIFFERENCE * gamma[1, link]
                    moved_gamma = gamma_matrix(trial, constants.lengths)
                _integrate_reduced(trial, moved_gamma, wheel_torques, duration, constants, end)
                for row in range(MOTION.stop):
                    transition[row, column] += sign * width * end[row]
    for column in range(TORQUES.start, TORQUES.stop):
        trial[:] = x[:SIZE_EXACT]
        trial[column] += DIFFERENCE
        _integrate_reduced(trial, gamma, wheel_torques, duration, constants, end)
        for row in range(MOTION.stop):
            transition[row, column] = end[row]
    trial[:] = x[:SIZE_EXACT]
    _integrate_reduced(trial, gamma, wheel_torques, duration, constants, end)
    for row in range(MOTION.stop):
        for column in range(TORQUES.start, TORQUES.stop):
            transition[row, column] = (transition[row, column] - end[row]) / DIFFERENCE


@kernel
def _linearize_lengths(x: Array, wheel_torques: Array, duration: float, constants: Constants,
                       transition: Array, end: Array) -> None:
    """
    Evaluate the transition of all links by the lengths of links b, c and d.

    :param end: (STATE_SIZE,) workspace.
    """
    slopes, lengths = angles_by_lengths(x[ANGLES], constants.lengths), x[LENGTHS]
    trial = np.empty(SIZE_EXACT)
    for n in range(3):
        width = DIFFERENCE * constants.lengths[1 + n]
        for sign in (1.0, -1.0):
            trial[:] = x[:SIZE_EXACT]
            constants.lengths[1 + n] = lengths[n] + sign * width
            trial[2] += sign * width * slopes[0, n]
            trial[3] += sign * width * slopes[1, n]
            gamma = gamma_matrix(trial, constants.lengths)
            _integrate_reduced(trial, gamma, wheel_torques, duration, constants, end)
            for row in range(MOTION.stop):
                transition[row, LENGTHS.start + n] += 0.5 * sign / width * end[row]
        constants.lengths[1 + n] = lengths[n]


@kernel
def _reduced_noise(x: Array, end: Array, duration: float, model: Model, noise: Array) -> None:
    """
    Evaluate the process noise where links c and d follow a and b.

    White torques act on each link, and the random walk of the disturbance torques on a and b.

    :param end: angles of the links at the end [rad].
    """
    lengths = model.constants.lengths
    gamma, last = gamma_matrix(x, lengths), gamma_matrix(end, lengths)
    a00, a01, a11 = _reduced_mass(x, gamma, model.constants)
    scale = 1.0 / (a00 * a11 - a01 * a01)
    inverse = np.array([[a11 * scale, -a01 * scale], [-a01 * scale, a00 * scale]])
    forces = np.empty((2, 2))
    for i in range(2):
        for k in range(2):
            forces[i, k] = ((i == k) + gamma[0, i] * gamma[0, k] + gamma[1, i] * gamma[1, k])
    white, walk = model.torque * model.torque, model.torque_walk * model.torque_walk
    # Rates of all links by those of links a and b.
    shares = np.zeros((4, 2))
    shares[0, 0] = shares[1, 1] = 1.0
    shares[2:] = last
    # Noise of the accelerations of links a and b, by white torques and by the walk.
    fast, slow, cross = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((4, 2))
    for i in range(2):
        for k in range(2):
            for m in range(2):
                slow[i, k] += walk * inverse[i, m] * inverse[m, k]
                for n in range(2):
                    fast[i, k] += white * inverse[i, m] * forces[m, n] * inverse[n, k]
    fast_links, slow_links = np.zeros((4, 4)), np.zeros((4, 4))
    for i in range(4):
        for k in range(2):
            cross[i, k] = walk * (shares[i, 0] * inverse[0, k] + shares[i, 1] * inverse[1, k])
        for k in range(4):
            for m in range(2):
                for n in range(2):
                    share = shares[i, m] * shares[k, n]
                    fast_links[i, k] += share * fast[m, n]
                    slow_links[i, k] += share * slow[m, n]
    _integrate_noise(fast_links, slow_links, cross, walk, duration, noise)


@kernel
def _integrate_noise(white: Array, walk: Array, cross: Array, torque_walk: float,
                     duration: float, noise: Array) -> None:
    """
    Integrate the noise of the accelerations over the duration.

    :param white, walk: (4, 4) of the links, by white torques and by the walk of the disturbance.
    :param cross: (4, 2) of the links with the disturbance torques.
    :param torque_walk: squared density of the walk.
    :param noise: (n, n) receives Q of angles, rates and disturbance torques.
    """
    t = duration
    angle_angle, angle_rate = noise[ANGLES, ANGLES], noise[ANGLES, RATES]
    rate_angle, rate_rate = noise[RATES, ANGLES], noise[RATES, RATES]
    angle_torque, torque_angle = noise[ANGLES, TORQUES], noise[TORQUES, ANGLES]
    rate_torque, torque_rate = noise[RATES, TORQUES], noise[TORQUES, RATES]
    torque_torque = noise[TORQUES, TORQUES]
    for i in range(4):
        for k in range(2):
            angle_torque[i, k] = torque_angle[k, i] = cross[i, k] * t ** 3 / 6.0
            rate_torque[i, k] = torque_rate[k, i] = cross[i, k] * t ** 2 / 2.0
        for k in range(4):
            first, second = white[i, k], walk[i, k]
            angle_angle[i, k] = first * t ** 3 / 3.0 + second * t ** 5 / 20.0
            angle_rate[i, k] = rate_angle[k, i] = (
                first * t ** 2 / 2.0 + second * t ** 4 / 8.0)
            rate_rate[i, k] = first * t + second * t ** 3 / 3.0
    torque_torque[0, 0] = torque_torque[1, 1] = torque_walk * t


@kernel
def _linearize_free(mobility: Array, opposite_share: float, duration: float, model: Model,
                    transition: Array, noise: Array) -> None:
    """
    Evaluate transition and noise of four free links.

    The dependence of the accelerations on angles and rates is neglected: over a step it is less
    than what conditioning on the closure changes afterwards.

    :param mobility: (4, 4) accelerations per torque on each link [1/(kg m^2)].
    :param opposite_share: of the disturbance torques of links a and b that acts on c and d.
    """
    disturbed = np.empty((4, 2))
    for i in range(4):
        for k in range(2):
            disturbed[i, k] = (
                (1.0 - opposite_share) * mobility[i, k] + opposite_share * mobility[i, 2 + k])
    t = duration
    white, walk = model.torque * model.torque, model.torque_walk * model.torque_walk
    angle_rate = transition[ANGLES, RATES]
    angle_torque, rate_torque = transition[ANGLES, TORQUES], transition[RATES, TORQUES]
    fast, slow, cross = np.zeros((4, 4)), np.zeros((4, 4)), np.empty((4, 2))
    for i in range(MOTION.stop):
        transition[i, i] = 1.0
    for i in range(4):
        angle_rate[i, i] = t
        for k in range(2):
            angle_torque[i, k] = 0.5 * t * t * disturbed[i, k]
            rate_torque[i, k] = t * disturbed[i, k]
            cross[i, k] = walk * disturbed[i, k]
        for k in range(4):
            for m in range(4):
                fast[i, k] += white * mobility[i, m] * mobility[k, m]
            for m in range(2):
                slow[i, k] += walk * disturbed[i, m] * disturbed[k, m]
    _integrate_noise(fast, slow, cross, walk, duration, noise)


@kernel
def _mobility(x: Array, weak_held: bool, constants: Constants) -> Array:
    """Evaluate the accelerations of the links per torque on each (4, 4) [1/(kg m^2)]."""
    cosines, sines = directions(four(x[ANGLES]))
    basis = closure_basis(cosines, sines, constants)
    strong, weak = basis.strong, basis.weak
    mobility = np.empty((4, 4))
    for link in range(4):
        unit = (1.0 if link == 0 else 0.0, 1.0 if link == 1 else 0.0,
                1.0 if link == 2 else 0.0, 1.0 if link == 3 else 0.0)
        free = solve_lower(basis.factor, unit)
        allowed = combine(1.0, free, -dot(free, strong) / dot(strong, strong), strong)
        if weak_held:
            allowed = combine(1.0, allowed, -dot(free, weak) / dot(weak, weak), weak)
        column = solve_upper(basis.factor, allowed)
        for j in range(4):
            mobility[j, link] = column[j]
    return mobility


@kernel
def _propagate(covariance: Array, transition: Array, noise: Array, all_columns: bool) -> None:
    """
    Set P = F P F' + Q, in place.

    :param all_columns: False where F is zero in the columns of links c and d.
    """
    size = covariance.shape[0]
    columns = np.empty(size, np.int64)
    count = 0
    for column in range(size):
        of_link = column % 4
        if all_columns or of_link < 2 or column >= MOTION.stop:
            columns[count] = column
            count += 1
    partial = np.zeros((size, count))
    for i in range(size):
        for k in range(count):
            share = transition[i, columns[k]]
            if share != 0.0:
                for m in range(count):
                    partial[i, m] += share * covariance[columns[k], columns[m]]
    for i in range(size):
        for k in range(i + 1):
            total = noise[i, k]
            for m in range(count):
                total += partial[i, m] * transition[k, columns[m]]
            covariance[i, k] = covariance[k, i] = total


@kernel
def _reduced_mass(angles: Array, gamma: Array, constants: Constants
                  ) -> tuple[float, float, float]:
    """Evaluate A = W^T M W with the given Gamma."""
    matrix = mass_matrix(angles, constants)
    a = np.zeros((2, 2))
    for i in range(2):
        for j in range(2):
            a[i, j] = matrix[i, j]
            for k in range(2):
                a[i, j] += (matrix[i, 2 + k] * gamma[k, j] + matrix[j, 2 + k] * gamma[k, i])
                for m in range(2):
                    a[i, j] += gamma[k, i] * matrix[2 + k, 2 + m] * gamma[m, j]
    return a[0, 0], a[0, 1], a[1, 1]
