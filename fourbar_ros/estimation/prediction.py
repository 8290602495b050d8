# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Kernels of the prediction: where the linkage goes, and what becomes of what is known.

Away from change points links c and d follow a and b, and the transition has columns for these
alone. Near them (below `REDUCED_FORM_LIMIT`) all four links are states in their own right,
the transition is that of free links, and the closure and its rate come as measurements without
noise. Where the links cannot be told from a line, by what is known of them, the constraint that is
lost there holds nothing.

A loop that may fail to close does so with the lengths that are in the state, and near change
points its joints are springs along the constraint that is lost (estimation.elastic).
"""

from __future__ import annotations

from math import ceil, sin

from fourbar_ros.estimation.bias_detection import carry_suspicion, SCALARS
from fourbar_ros.estimation.compliant_closure import (
    add_elasticity,
    FASTEST,
    lighten,
    move_elastic,
    SHARED,
    take_lengths,
    turned_by_lengths,
    WALK,
)
from fourbar_ros.estimation.filter_state import LOOSE_BIASES
from fourbar_ros.kernels.compiler import kernel
from fourbar_ros.kernels.linear_algebra import combine, dot, solve_lower, solve_upper
from fourbar_ros.mechanism.change_points import (
    DISTINCT_SIGMAS_SQUARED,
    REDUCED_FORM_LIMIT,
    RIGID_CONSTRAINT_RATIO,
)
from fourbar_ros.mechanism.constants import Array, Constants
from fourbar_ros.mechanism.constrained import (
    advance_constrained,
    directions,
    factored_inertia,
    orthogonal_columns,
    project_onto_closure,
    signed_links,
)
from fourbar_ros.mechanism.dynamics import gamma_matrix, mass_matrix
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import advance_state
from fourbar_ros.mechanism.reduced import close_reduced
import numpy as np
from numpy.typing import NDArray

# Half width of the central differences for the transition matrix [rad], [rad/s], and width of the
# one-sided one, in which the motion is linear but for the length of a step [N m].
DIFFERENCE = 1e-6

# To what the closure is known, in links' lengths [rad] and [rad/s]: the covariance must not become
# singular by more than rounding allows.
CLOSED_TO = 1e-8
STOPPED_TO = 1e-6

# The same across the line for a loop that may fail to close, whose joints give a little in every
# direction. Where the line is follows from angles that are estimates: without noise, again and
# again, the closure across it would seem to tell that along it, too.
GIVES_TO = 1e-5
GIVES_AT = 1e-3


@kernel
def near_change_point(x: Array) -> bool:
    """Tell whether links c and d are so close to one line that all four are states."""
    return not abs(sin(x[3] - x[2])) > REDUCED_FORM_LIMIT


@kernel
def predict(x: Array, covariance: Array, suspicions: Array, wheel_torques: Array,
            duration: float, densities: Array, slack: Array, boxed: NDArray[np.record],
            state: Array, transition: Array, noise: Array) -> None:
    """
    Predict in place: filterpy's `predict` with the linkage as the model.

    :param x, covariance: (n,) and (n, n), see estimation.layout.
    :param suspicions: (2 sensors, SCALARS + n), see estimation.suspicion.
    :param wheel_torques: (4,) If dOmega/dt of the wheels, relative to their links [N m].
    :param duration: [s].
    :param densities: (3,) of random torques on each link [N m/sqrt(Hz)], and of the random walks
        of the disturbance torques [N m/sqrt(s)] and of the biases of gyros [rad/s/sqrt(s)].
    :param slack: what is known of a loop that may fail to close, see estimation.elastic, or
        nothing (0,).
    :param boxed: (1,) constants of the mechanism, wheels locked.
    :param state: (STATE_SIZE,) to work in.
    :param transition, noise: (n, n) receive F and Q, of the last part where the motion along the
        weak direction is too fast for one step.
    """
    constants = boxed[0]
    parts = 1
    if slack.size > 0:
        take_lengths(x, constants)
        if near_change_point(x):
            parts = max(1, int(ceil(duration * FASTEST)))
    for _ in range(parts):
        _predict_part(x, covariance, suspicions, wheel_torques, duration / parts, densities,
                      slack, constants, state, transition, noise)


@kernel
def _predict_part(x: Array, covariance: Array, suspicions: Array, wheel_torques: Array,
                  duration: float, densities: Array, slack: Array, constants: Constants,
                  state: Array, transition: Array, noise: Array) -> None:
    size, loose = x.size, slack.size > 0
    transition[:] = 0.0
    noise[:] = 0.0
    for i in range(8, size):
        transition[i, i] = 1.0
    for i in range(10, size):
        walk = slack[WALK] if loose and i < LOOSE_BIASES else densities[2]
        noise[i, i] = walk * walk * duration
    near = near_change_point(x)
    if near:
        held = weak_is_held(x, covariance, loose, constants)
        mobility = _mobility(x, held, constants)
        if held or not loose:
            _linearise_four(mobility, 0.0, duration, densities, transition, noise)
            _move(x, wheel_torques, duration, held, constants, state)
        else:
            lighten(x, mobility, constants, slack)
            _linearise_four(mobility, slack[SHARED], duration, densities, transition, noise)
            add_elasticity(
                x, covariance, mobility, duration, constants, slack, transition, noise)
            move_elastic(x, wheel_torques, duration, constants, slack, state)
    else:
        if loose:
            _linearise_lengths(x, wheel_torques, duration, constants, state, transition)
        _linearise_two(x, wheel_torques, duration, constants, state, transition)
        _noise_of_two(x, state, duration, densities, constants, noise)
    _carry(covariance, transition, noise, near)
    for n in range(suspicions.shape[0]):
        carry_suspicion(suspicions[n], transition, duration)
    x[0:8] = state[0:8]
    if near:
        condition(x, covariance, suspicions, loose, constants)


@kernel
def meet(state: Array, covariance: Array, loose: bool, constants: Constants) -> None:
    """
    Bring angles and rates that are close to the closure onto it, in place.

    :param loose: whether the loop may fail to close.
    """
    if loose and near_change_point(state) or not close_reduced(state, constants):
        angles, rates = project_onto_closure(
            (state[0], state[1], state[2], state[3]), (state[4], state[5], state[6], state[7]),
            constants, weak_is_held(state, covariance, loose, constants))
        for j in range(4):
            state[j], state[4 + j] = angles[j], rates[j]


@kernel
def weak_is_held(x: Array, covariance: Array, loose: bool, constants: Constants) -> bool:
    """
    Tell whether the closure constrains its weak direction, as far as anybody knows.

    At a change point it does not, and within the uncertainty of the angles the linkage might be
    at one. In a loop that may fail to close it does so where the links have leverage.
    """
    cosines, sines = directions((x[0], x[1], x[2], x[3]))
    factor, _ = factored_inertia(cosines, sines, (0.0, 0.0, 0.0, 0.0), constants)
    px, py = signed_links(cosines, sines, constants.lengths)
    strong, weak, c, s = orthogonal_columns(factor, px, py)
    size = dot(strong, strong)
    if loose:
        return dot(weak, weak) > RIGID_CONSTRAINT_RATIO * RIGID_CONSTRAINT_RATIO * size
    # How the weak column changes with the angles relative to link a, the strong one taken out.
    changes = np.zeros((4, 4))
    for i in range(1, 4):
        slope = s * px[i] - c * py[i]
        unit = (0.0, slope if i == 1 else 0.0, slope if i == 2 else 0.0, slope if i == 3 else 0.0)
        column = solve_lower(factor, unit)
        along = dot(column, strong) / size
        for j in range(4):
            changes[i, j] = column[j] - along * strong[j]
    spread = 0.0
    for i in range(1, 4):
        for k in range(1, 4):
            relative = covariance[i, k] - covariance[i, 0] - covariance[0, k] + covariance[0, 0]
            for j in range(4):
                spread += changes[i, j] * relative * changes[k, j]
    return dot(weak, weak) > DISTINCT_SIGMAS_SQUARED * spread


@kernel
def condition(x: Array, covariance: Array, suspicions: Array, loose: bool, constants: Constants
              ) -> None:
    """
    Take the closure and its rate as measured, in place: the covariance of what they allow.

    What the closure bends within the covariance counts as noise of that measurement. It tells
    nothing of lengths, by whose error it may be off (S. F. Schmidt's consider states): a
    measurement without noise, made again and again at angles that are estimates, would seem to
    tell all of them. They follow from the sensors.
    """
    cosines, sines = directions((x[0], x[1], x[2], x[3]))
    factor, _ = factored_inertia(cosines, sines, (0.0, 0.0, 0.0, 0.0), constants)
    px, py = signed_links(cosines, sines, constants.lengths)
    _, _, c, s = orthogonal_columns(factor, px, py)
    length = constants.lengths[2]
    size = x.size
    concerned = LOOSE_BIASES if loose else 8
    row, known = np.empty(concerned), np.empty(size)
    slopes = np.empty(4)
    count = 4 if weak_is_held(x, covariance, loose, constants) else 2
    for n in range(count):
        p, q = (c, s) if n < 2 else (-s, c)
        of_rates = n % 2 == 1
        row[:] = 0.0
        for i in range(4):
            slopes[i] = -(p * px[i] + q * py[i])
            along = q * px[i] - p * py[i]
            if of_rates:
                row[i], row[4 + i] = slopes[i] * x[4 + i], along
            else:
                row[i] = along
        if loose:
            for i in range(1, 4):
                grown = row[4 + i] * x[4 + i] if of_rates else -slopes[i]
                row[9 + i] = grown / constants.lengths[i]
        if loose:
            floor = length * (GIVES_AT if of_rates else GIVES_TO)
        else:
            floor = length * (STOPPED_TO if of_rates else CLOSED_TO)
        variance = floor * floor
        for i in range(4):
            for k in range(4):
                bent = 0.5 * covariance[i, k] * covariance[i, k]
                if of_rates:
                    bent = (covariance[i, k] * covariance[4 + i, 4 + k]
                            + covariance[i, 4 + k] * covariance[4 + i, k])
                variance += slopes[i] * slopes[k] * bent
        for i in range(size):
            known[i] = 0.0
            for k in range(concerned):
                known[i] += covariance[i, k] * row[k]
        for k in range(concerned):
            variance += row[k] * known[k]
        for i in range(size):
            for k in range(size):
                if min(i, k) < 10 or max(i, k) >= concerned:
                    covariance[i, k] -= known[i] * known[k] / variance
        for suspicion in suspicions:
            effect = suspicion[SCALARS:]
            seen = 0.0
            for k in range(concerned):
                seen += row[k] * effect[k]
            for i in range(size):
                effect[i] -= known[i] * seen / variance


@kernel
def _move(x: Array, wheel_torques: Array, duration: float, weak_held: bool,
          constants: Constants, state: Array) -> None:
    """
    Integrate the links, wheels locked, under minus the torques that moved the wheels.

    :param state: (STATE_SIZE,) receives angles and rates of the links.
    """
    state[:] = 0.0
    state[0:8] = x[0:8]
    drive = wheel_torques.copy()
    drive[0] -= x[8]
    drive[1] -= x[9]
    if weak_held:
        advance_state(state, drive, drive, drive, duration, constants, NOTHING)
    else:
        advance_constrained(state, drive, drive, drive, duration, constants, NOTHING, False)


@kernel
def _linearise_two(x: Array, wheel_torques: Array, duration: float, constants: Constants,
                   state: Array, transition: Array) -> None:
    """
    Evaluate the transition of all links after links a and b, where c and d follow these.

    :param state: (STATE_SIZE,) receives the end of the motion.
    """
    gamma = gamma_matrix(x, constants.lengths)
    trial = np.empty(10)
    width = 0.5 / DIFFERENCE
    # Up and down in each of four columns, up in those of the torques, and as it is.
    for n in range(11):
        trial[:] = x[:10]
        column, sign = n, 1.0
        if n < 8:
            column, sign = (n // 2) % 2 + 4 * (n // 4), 1.0 - 2.0 * (n % 2)
        if n < 10:
            trial[column] += sign * DIFFERENCE
        g = gamma
        if column < 2:
            trial[2] += sign * DIFFERENCE * gamma[0, column]
            trial[3] += sign * DIFFERENCE * gamma[1, column]
            g = gamma_matrix(trial, constants.lengths)
        trial[6] = g[0, 0] * trial[4] + g[0, 1] * trial[5]
        trial[7] = g[1, 0] * trial[4] + g[1, 1] * trial[5]
        _move(trial, wheel_torques, duration, True, constants, state)
        for row in range(8):
            if n < 8:
                transition[row, column] += sign * width * state[row]
            elif n < 10:
                transition[row, column] = state[row]
            else:
                for torque in range(8, 10):
                    transition[row, torque] = (transition[row, torque] - state[row]) / DIFFERENCE


@kernel
def _linearise_lengths(x: Array, wheel_torques: Array, duration: float, constants: Constants,
                       state: Array, transition: Array) -> None:
    """
    Evaluate the transition of all links after the lengths of links b, c and d.

    :param state: (STATE_SIZE,) to work in.
    """
    turned = turned_by_lengths(x, constants.lengths)
    trial = np.empty(10)
    for n in range(3):
        width = DIFFERENCE * constants.lengths[1 + n]
        for sign in (1.0, -1.0):
            trial[:] = x[:10]
            constants.lengths[1 + n] = x[10 + n] + sign * width
            trial[2] += sign * width * turned[0, n]
            trial[3] += sign * width * turned[1, n]
            g = gamma_matrix(trial, constants.lengths)
            trial[6] = g[0, 0] * trial[4] + g[0, 1] * trial[5]
            trial[7] = g[1, 0] * trial[4] + g[1, 1] * trial[5]
            _move(trial, wheel_torques, duration, True, constants, state)
            for row in range(8):
                transition[row, 10 + n] += 0.5 * sign / width * state[row]
        constants.lengths[1 + n] = x[10 + n]


@kernel
def _noise_of_two(x: Array, end: Array, duration: float, densities: Array, constants: Constants,
                  noise: Array) -> None:
    """
    Evaluate the covariance that random torques leave, where links c and d follow a and b.

    White ones on each link, and the random walk of the disturbance torques on links a and b.

    :param end: angles of the links at the end [rad].
    """
    gamma, last = gamma_matrix(x, constants.lengths), gamma_matrix(end, constants.lengths)
    a00, a01, a11 = _reduced_mass(x, gamma, constants)
    scale = 1.0 / (a00 * a11 - a01 * a01)
    inverse = np.array([[a11 * scale, -a01 * scale], [-a01 * scale, a00 * scale]])
    forces = np.empty((2, 2))
    for i in range(2):
        for k in range(2):
            forces[i, k] = ((i == k) + gamma[0, i] * gamma[0, k] + gamma[1, i] * gamma[1, k])
    white, walk = densities[0] * densities[0], densities[1] * densities[1]
    shares = np.zeros((4, 2))
    shares[0, 0] = shares[1, 1] = 1.0
    shares[2:] = last
    t = duration
    # Of the accelerations of links a and b, by white torques and by the walk.
    fast, slow, cross = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((4, 2))
    for i in range(2):
        for k in range(2):
            for m in range(2):
                slow[i, k] += walk * inverse[i, m] * inverse[m, k]
                for n in range(2):
                    fast[i, k] += white * inverse[i, m] * forces[m, n] * inverse[n, k]
    for i in range(4):
        for k in range(2):
            cross[i, k] = walk * (shares[i, 0] * inverse[0, k] + shares[i, 1] * inverse[1, k])
            noise[i, 8 + k] = noise[8 + k, i] = cross[i, k] * t ** 3 / 6.0
            noise[4 + i, 8 + k] = noise[8 + k, 4 + i] = cross[i, k] * t ** 2 / 2.0
        for k in range(4):
            first = second = 0.0
            for m in range(2):
                for n in range(2):
                    share = shares[i, m] * shares[k, n]
                    first += share * fast[m, n]
                    second += share * slow[m, n]
            noise[i, k] = first * t ** 3 / 3.0 + second * t ** 5 / 20.0
            noise[i, 4 + k] = noise[4 + k, i] = first * t ** 2 / 2.0 + second * t ** 4 / 8.0
            noise[4 + i, 4 + k] = first * t + second * t ** 3 / 3.0
    noise[8, 8] = noise[9, 9] = walk * t


@kernel
def _linearise_four(mobility: Array, share: float, duration: float, densities: Array,
                    transition: Array, noise: Array) -> None:
    """
    Evaluate transition and noise of all four links.

    That rates change with angles and rates is left out: over a step it is less than what the
    closure says afterwards.

    :param mobility: (4, 4) accelerations per torque on each link [1/(kg m^2)].
    :param share: of the disturbance torques of links a and b that acts on c and d.
    """
    disturbed = np.empty((4, 2))
    for i in range(4):
        for k in range(2):
            disturbed[i, k] = (1.0 - share) * mobility[i, k] + share * mobility[i, 2 + k]
    white, walk = densities[0] * densities[0], densities[1] * densities[1]
    t = duration
    for i in range(4):
        transition[i, i] = transition[4 + i, 4 + i] = 1.0
        transition[i, 4 + i] = t
        for k in range(2):
            transition[i, 8 + k] = 0.5 * t * t * disturbed[i, k]
            transition[4 + i, 8 + k] = t * disturbed[i, k]
            cross = walk * disturbed[i, k]
            noise[i, 8 + k] = noise[8 + k, i] = cross * t ** 3 / 6.0
            noise[4 + i, 8 + k] = noise[8 + k, 4 + i] = cross * t ** 2 / 2.0
        for k in range(4):
            first = second = 0.0
            for m in range(4):
                first += white * mobility[i, m] * mobility[k, m]
            for m in range(2):
                second += walk * disturbed[i, m] * disturbed[k, m]
            noise[i, k] = first * t ** 3 / 3.0 + second * t ** 5 / 20.0
            noise[i, 4 + k] = noise[4 + k, i] = first * t ** 2 / 2.0 + second * t ** 4 / 8.0
            noise[4 + i, 4 + k] = first * t + second * t ** 3 / 3.0
    noise[8, 8] = noise[9, 9] = walk * t


@kernel
def _mobility(x: Array, weak_held: bool, constants: Constants) -> Array:
    """Evaluate accelerations of the links per torque on each (4, 4) [1/(kg m^2)]."""
    cosines, sines = directions((x[0], x[1], x[2], x[3]))
    factor, _ = factored_inertia(cosines, sines, (0.0, 0.0, 0.0, 0.0), constants)
    px, py = signed_links(cosines, sines, constants.lengths)
    strong, weak, _, _ = orthogonal_columns(factor, px, py)
    mobility = np.empty((4, 4))
    for link in range(4):
        unit = (1.0 if link == 0 else 0.0, 1.0 if link == 1 else 0.0,
                1.0 if link == 2 else 0.0, 1.0 if link == 3 else 0.0)
        free = solve_lower(factor, unit)
        allowed = combine(1.0, free, -dot(free, strong) / dot(strong, strong), strong)
        if weak_held:
            allowed = combine(1.0, allowed, -dot(free, weak) / dot(weak, weak), weak)
        column = solve_upper(factor, allowed)
        for j in range(4):
            mobility[j, link] = column[j]
    return mobility


@kernel
def _carry(covariance: Array, transition: Array, noise: Array, all_columns: bool) -> None:
    """Set P = F P F' + Q, in place, F being zero for links c and d unless all columns count."""
    size = covariance.shape[0]
    columns = np.empty(size, np.int64)
    count = 0
    for column in range(size):
        if all_columns or column not in (2, 3, 6, 7):
            columns[count] = column
            count += 1
    carried = np.zeros((size, count))
    for i in range(size):
        for k in range(count):
            share = transition[i, columns[k]]
            if share != 0.0:
                for m in range(count):
                    carried[i, m] += share * covariance[columns[k], columns[m]]
    for i in range(size):
        for k in range(i + 1):
            total = noise[i, k]
            for m in range(count):
                total += carried[i, m] * transition[k, columns[m]]
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
