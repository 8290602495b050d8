# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The linkage by Kane's method, derived by SymPy and integrated by SciPy.

As in section 2 of the paper the bodies follow one another, a, b, c, d, from the mass centre of
link a; the loop is closed between d and a by velocity constraints, which make omega_c and omega_d
dependent. Our own equations are written the other way round (docs/mechanics.md): in four angles
about the mass centre of the whole, with d hung on a. Nothing is shared but the conventions.

Each wheel is a body without mass (its mass counts in the link's). It is either free, and a motor
torque acts between link and wheel, or its angle relative to the link is a given function of time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism.case import Case
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.mechanism import Mechanism
import numpy as np

LETTERS = 'abcd'

# What is left at these is rounding; SciPy takes no less than 2.3e-14.
RELATIVE_TOLERANCE = 1e-12
ABSOLUTE_TOLERANCE = 1e-13
# Nothing pulls the loop together again: a motion that opened it further has gone wrong (relative
# to the longest link). Those of 10 s in the tests stay below 1e-13.
CLOSURE_LIMIT = 1e-9
# Next to such a line the step shrinks without end. Motions of the tests need a few hundred
# evaluations from one time to the next.
MOST_EVALUATIONS = 20_000


class KaneError(FourbarError):
    """A motion lost to these equations, which divide by sin(phi_d - phi_c)."""


@dataclass(frozen=True, eq=False)
class KaneMotion:
    """
    An integrated motion.

    :param times: (n,) [s].
    :param link_angles: (n, 4) continuous [rad].
    :param link_rates: (n, 4) [rad/s].
    :param flywheel_speeds_absolute: (n, 4) link rate plus speed of the wheel on it [rad/s].
    :param closure_error: (n,) gap at joint 4, between link d and link a [m].
    """

    times: Array
    link_angles: Array
    link_rates: Array
    flywheel_speeds_absolute: Array
    closure_error: Array


@dataclass(frozen=True, eq=False)
class Equations:
    """
    Kane's equations `mass_matrix d(speeds)/dt = forcing` for one choice of prescribed wheels.

    The speeds are v_ax, v_ay, omega_a, omega_b, then those of the free wheels relative to their
    links, then the dependent omega_c, omega_d; the last two rows are the closure, differentiated
    twice.

    :param evaluate: maps link angles (4,), link rates (4,), per wheel its motor torque [N m] or,
        if it is prescribed, its acceleration relative to the link [rad/s^2] (4,), and parameters
        (24,) to mass matrix and forcing.
    :param gap: maps link angles and parameters to the gap (2,) at joint 4 [m].
    :param free: indices of the wheels that are not prescribed.
    """

    evaluate: Callable[..., tuple[Any, Any]]
    gap: Callable[..., Any]
    free: tuple[int, ...]


def simulate(case: Case) -> KaneMotion:
    """
    Integrate the motion of a case, torques and wheel angles being continuous functions of time.

    :raises KaneError: the loop opened, or links c and d lay on a line at some step, where these
        equations do not exist, or so close to one that no step is short enough. Steps across such
        a line need not touch it.
    """
    from scipy.integrate import solve_ivp

    equations = derive_equations(tuple(bool(given) for given in case.prescribed))
    free = list(equations.free)
    parameters = _parameters(case.mechanism)
    turn = 2.0 * np.pi * case.frequency_hz

    def law(t: float) -> Array:
        """Return motor torques, and the accelerations of prescribed wheels."""
        wave: Array = case.amplitude * np.cos(turn * t + case.phase)
        return np.where(case.prescribed, -turn**2 * wave, wave)

    # The state: link angles, link rates, speeds of the free wheels relative to their links.
    # Where the linkage is on the table decides nothing, so that is left out.
    evaluations = 0

    def derivative(t: float, state: Array) -> Array:
        nonlocal evaluations
        evaluations += 1
        if evaluations > MOST_EVALUATIONS:
            raise _lost(t)
        mass_matrix, forcing = equations.evaluate(state[:4], state[4:8], law(t), parameters)
        change = np.linalg.solve(np.array(mass_matrix), np.array(forcing))
        return np.concatenate([state[4:8], change[2:4], change[-2:], change[4:-2]])

    start = np.concatenate([case.link_angles, case.link_rates,
                            (case.flywheel_speeds_absolute - case.link_rates)[free]])
    states = [start]
    # From one time to the next, in a single step where it is short enough, because interpolation
    # between steps is of lower order.
    for begin, end in zip(case.times, case.times[1:]):
        evaluations = 0
        try:
            piece = solve_ivp(derivative, (begin, end), states[-1], method='DOP853',
                              rtol=RELATIVE_TOLERANCE, atol=ABSOLUTE_TOLERANCE,
                              first_step=end - begin)
        except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
            raise _lost(begin) from None
        if not piece.success:
            raise _lost(begin)
        states.append(piece.y[:, -1])
    table = np.array(states)
    angles, rates = table[:, :4], table[:, 4:8]
    gap = np.array([np.hypot(*equations.gap(row, parameters)) for row in angles])
    if not gap.max() <= CLOSURE_LIMIT * case.mechanism.link_lengths.max():
        raise _lost(float(case.times[np.argmax(gap)]))

    relative = -turn * case.amplitude * np.sin(np.outer(case.times, turn) + case.phase)
    relative[:, free] = table[:, 8:]
    return KaneMotion(case.times, angles, rates, rates + relative, gap)


@lru_cache(maxsize=None)
def derive_equations(prescribed: tuple[bool, ...]) -> Equations:
    """
    Derive the equations of motion: a second or two, once per process and choice.

    :param prescribed: (4,) wheels whose angle relative to their link is a function of time.
    """
    import sympy  # type: ignore[import-untyped]
    from sympy.physics import mechanics  # type: ignore[import-untyped]

    time = mechanics.dynamicsymbols._t
    x, y, v_x, v_y = mechanics.dynamicsymbols('x y v_x v_y')
    phi, psi = (mechanics.dynamicsymbols(f'{name}_a:d') for name in ('phi', 'psi'))
    omega, spin = (mechanics.dynamicsymbols(f'{name}_a:d') for name in ('omega', 'Omega'))
    length, mass, inertia, com_x, com_y, wheel_inertia = parameters = [
        sympy.symbols(f'{name}_a:d') for name in ('l', 'm', 'I', 'c_x', 'c_y', 'I_f')]
    command = sympy.symbols('command_a:d')

    table = mechanics.ReferenceFrame('table')
    links, wheels, com = [], [], []
    for i, letter in enumerate(LETTERS):
        link = table.orientnew(f'link_{letter}', 'Axis', (phi[i], table.z))
        link.set_ang_vel(table, omega[i] * table.z)
        # A wheel is round: that it turns shows in its angular velocity alone.
        wheel = link.orientnew(f'wheel_{letter}', 'Axis', (0, link.z))
        wheel.set_ang_vel(
            link, (psi[i].diff(time) if prescribed[i] else spin[i]) * link.z)
        links.append(link)
        wheels.append(wheel)
        com.append(com_x[i] * link.x + com_y[i] * link.y)

    def fixed(near: Any, name: str, position: Any, link: Any) -> Any:
        """Return the point at a position from another one of the same link."""
        point = near.locatenew(name, position)
        point.v2pt_theory(near, table, link)
        return point

    origin = mechanics.Point('origin')
    origin.set_vel(table, 0)
    a, b, c, d = links
    centre_a = origin.locatenew('A', x * table.x + y * table.y)
    centre_a.set_vel(table, v_x * table.x + v_y * table.y)
    joint_1 = fixed(centre_a, 'joint 1', -com[0], a)
    joint_4 = fixed(centre_a, 'joint 4', length[0] * a.x - com[0], a)
    centre_b = fixed(joint_1, 'B', com[1], b)
    joint_2 = fixed(joint_1, 'joint 2', length[1] * b.x, b)
    centre_c = fixed(joint_2, 'C', com[2], c)
    joint_3 = fixed(joint_2, 'joint 3', length[2] * c.x, c)
    centre_d = fixed(joint_3, 'D', com[3] - length[3] * d.x, d)
    end_of_d = fixed(joint_3, 'end of d', -length[3] * d.x, d)

    gap, slip = end_of_d.pos_from(joint_4), end_of_d.vel(table) - joint_4.vel(table)
    closure = [gap.dot(table.x), gap.dot(table.y)]

    free = tuple(i for i in range(4) if not prescribed[i])
    bodies, torques = [], []
    for i, centre in enumerate((centre_a, centre_b, centre_c, centre_d)):
        bodies += [
            mechanics.RigidBody(f'link {LETTERS[i]}', centre, links[i], mass[i], (
                mechanics.inertia(links[i], 0, 0, inertia[i]), centre)),
            mechanics.RigidBody(f'wheel {LETTERS[i]}', centre, wheels[i], 0, (
                mechanics.inertia(wheels[i], 0, 0, wheel_inertia[i]), centre))]
        if i in free:
            torques += [(wheels[i], command[i] * table.z), (links[i], -command[i] * table.z)]
    free_psi, free_spin = [psi[i] for i in free], [spin[i] for i in free]
    method = mechanics.KanesMethod(
        table,
        q_ind=[x, y, phi[0], phi[1], *free_psi], q_dependent=phi[2:],
        u_ind=[v_x, v_y, omega[0], omega[1], *free_spin], u_dependent=omega[2:],
        kd_eqs=[rate.diff(time) - speed for rate, speed in zip(
            (x, y, *phi, *free_psi), (v_x, v_y, *omega, *free_spin))],
        configuration_constraints=closure,
        velocity_constraints=[slip.dot(table.x), slip.dot(table.y)],
        # Elimination would divide by sin(phi_c), which is nothing special; Cramer's rule
        # divides by sin(phi_d - phi_c) alone.
        constraint_solver='CRAMER')
    method.kanes_equations(bodies, torques)

    given = {psi[i].diff(time, 2): command[i] for i in range(4) if prescribed[i]}
    numbers = [symbol for group in parameters for symbol in group]
    evaluate = sympy.lambdify(
        [phi, omega, command, numbers],
        [method.mass_matrix.xreplace(given).tolist(), list(method.forcing.xreplace(given))],
        modules='math', cse=True)
    return Equations(evaluate, sympy.lambdify([phi, numbers], closure, modules='math'), free)


def _parameters(mechanism: Mechanism) -> list[float]:
    """Return lengths, masses, inertias, mass centres x and y, wheel inertias in one list."""
    return [float(value) for group in (
        mechanism.link_lengths, mechanism.link_masses, mechanism.link_inertias,
        mechanism.com_positions[:, 0], mechanism.com_positions[:, 1],
        mechanism.flywheel_inertias) for value in group]


def _lost(time: float) -> KaneError:
    return KaneError(
        f'the closure of the Kane equations is lost at t = {time:g} s: links c and d lie on a '
        'line there, where omega_c and omega_d do not follow from omega_a and omega_b')
