# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The linkage by Kane's method, derived with SymPy and integrated with SciPy.

The bodies form a chain a, b, c, d from the mass centre of link a (paper section 2). Joint 4 closes
the chain by velocity constraints, which make omega_c and omega_d dependent.
`fourbar_ros.mechanism` is derived differently (docs/mechanics.md): four link angles about the mass
centre of the whole linkage, with d attached to a. Both share the conventions and no equation, so
that this derivation is the oracle of the tests and an engine of `study validation`.

Each wheel is a body of zero mass; the mass of its link includes it. A wheel is free, and a motor
torque acts between link and wheel, or its angle relative to the link is prescribed.
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

# Tolerances at which only rounding remains; SciPy accepts a relative one of at least 2.3e-14.
RELATIVE_TOLERANCE = 1e-12
ABSOLUTE_TOLERANCE = 1e-13
# Largest accepted gap of joint 4, relative to the longest link. The velocity constraints do not
# correct a gap; motions of 10 s stay below 1e-13.
CLOSURE_LIMIT = 1e-9
# Evaluations from one output time to the next. Regular motions need a few hundred; near a
# singularity the step size shrinks without bound.
MOST_EVALUATIONS = 20_000


class KaneError(FourbarError):
    """A motion that reaches the singularity of these equations, sin(phi_d - phi_c) = 0."""


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
    links, then omega_c, omega_d, which depend on the others: the last two rows are the second time
    derivative of the closure. With compliant joints nothing is dependent, and the rates of the
    gaps of joints 1 to 3 (x and y each) follow.

    :param evaluate: maps link angles (4,), link rates (4,), per wheel its motor torque [N m] or,
        if it is prescribed, its acceleration relative to the link [rad/s^2] (4,), and parameters
        (24,) to mass matrix and forcing. Derived with loads it takes also the velocity of the mass
        centre of link a (2,) and one sequence for each of `LOADS`; derived with compliant joints
        also gaps (6,), their rates (6,), stiffness (4,) and damping (4,) of the joints.
    :param gap: maps link angles and parameters to the gap (2,) at joint 4 [m].
    :param free: indices of the wheels that are not prescribed.
    """

    evaluate: Callable[..., tuple[Any, Any]]
    gap: Callable[..., Any]
    free: tuple[int, ...]


LOADS = {'joint_coulomb': 4, 'joint_viscous': 4, 'link_drag': 4, 'link_spin_drag': 4,
         'link_torques': 4, 'gravity': 2, 'smoothing': 1}
"""Loads beside the motors, as in `mechanism.forces`, and the number of values of each."""


def simulate(case: Case) -> KaneMotion:
    """
    Integrate the motion of a case, torques and wheel angles being continuous functions of time.

    :raises KaneError: joint 4 opened, or links c and d became collinear or came too close to that.
        Steps may cross such a configuration without evaluating it.
    """
    from scipy.integrate import solve_ivp

    equations = derive_equations(tuple(bool(value) for value in case.prescribed))
    free = list(equations.free)
    parameters = parameters_of(case.mechanism)
    turn = 2.0 * np.pi * case.frequency_hz

    def command(t: float) -> Array:
        """Return the torques of free wheels and the accelerations of prescribed wheels."""
        wave: Array = case.amplitude * np.cos(turn * t + case.phase)
        return np.where(case.prescribed, -turn**2 * wave, wave)

    # State: link angles, link rates, speeds of the free wheels relative to their links. The
    # position of the linkage has no influence and is left out.
    evaluations = 0

    def derivative(t: float, state: Array) -> Array:
        nonlocal evaluations
        evaluations += 1
        if evaluations > MOST_EVALUATIONS:
            raise _singular(t)
        mass_matrix, forcing = equations.evaluate(state[:4], state[4:8], command(t), parameters)
        change = np.linalg.solve(np.array(mass_matrix), np.array(forcing))
        return np.concatenate([state[4:8], change[2:4], change[-2:], change[4:-2]])

    states = [np.concatenate([case.link_angles, case.link_rates,
                              (case.flywheel_speeds_absolute - case.link_rates)[free]])]
    # One call for each output time, if possible in a single step, because interpolation between
    # steps is of lower order.
    for begin, end in zip(case.times, case.times[1:]):
        evaluations = 0
        try:
            piece = solve_ivp(derivative, (begin, end), states[-1], method='DOP853',
                              rtol=RELATIVE_TOLERANCE, atol=ABSOLUTE_TOLERANCE,
                              first_step=end - begin)
        except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
            raise _singular(begin) from None
        if not piece.success:
            raise _singular(begin)
        states.append(piece.y[:, -1])
    table = np.array(states)
    angles, rates = table[:, :4], table[:, 4:8]
    gap = np.array([np.hypot(*equations.gap(row, parameters)) for row in angles])
    if not gap.max() <= CLOSURE_LIMIT * case.mechanism.link_lengths.max():
        raise _singular(float(case.times[np.argmax(gap)]))

    relative = -turn * case.amplitude * np.sin(np.outer(case.times, turn) + case.phase)
    relative[:, free] = table[:, 8:]
    return KaneMotion(case.times, angles, rates, rates + relative, gap)


@lru_cache(maxsize=None)
def derive_equations(prescribed: tuple[bool, ...], loads: bool = False, compliant: bool = False
                     ) -> Equations:
    """
    Derive the equations of motion: a few seconds, once per process and choice.

    :param prescribed: (4,) wheels whose angle relative to their link is a function of time.
    :param loads: include friction, drag, slope and torques on the links, see `LOADS`.
    :param compliant: joints are springs and dampers instead of constraints; needs loads.
    """
    import sympy  # type: ignore[import-untyped]
    from sympy.physics import mechanics  # type: ignore[import-untyped]

    time = mechanics.dynamicsymbols._t
    x, y, v_x, v_y = mechanics.dynamicsymbols('x y v_x v_y')
    phi, psi = (mechanics.dynamicsymbols(f'{name}_a:d') for name in ('phi', 'psi'))
    omega, spin = (mechanics.dynamicsymbols(f'{name}_a:d') for name in ('omega', 'Omega'))
    gaps, gap_rates = (mechanics.dynamicsymbols(f'{name}:6') if compliant else ()
                       for name in ('gap', 'gap_rate'))
    length, mass, inertia, com_x, com_y, wheel_inertia = parameters = [
        sympy.symbols(f'{name}_a:d') for name in ('l', 'm', 'I', 'c_x', 'c_y', 'I_f')]
    command = sympy.symbols('command_a:d')

    table = mechanics.ReferenceFrame('table')
    links, wheels, com = [], [], []
    for i, letter in enumerate(LETTERS):
        link = table.orientnew(f'link_{letter}', 'Axis', (phi[i], table.z))
        link.set_ang_vel(table, omega[i] * table.z)
        # A wheel is rotationally symmetric: only its angular velocity matters.
        wheel = link.orientnew(f'wheel_{letter}', 'Axis', (0, link.z))
        wheel.set_ang_vel(
            link, (psi[i].diff(time) if prescribed[i] else spin[i]) * link.z)
        links.append(link)
        wheels.append(wheel)
        com.append(com_x[i] * link.x + com_y[i] * link.y)

    def fixed(near: Any, name: str, position: Any, link: Any) -> Any:
        """Return a point by its position from another point of the same link."""
        point = near.locatenew(name, position)
        point.v2pt_theory(near, table, link)
        return point

    def across_gap(near: Any, joint: int) -> Any:
        """Return the point of the second link of a joint from that of the first link."""
        if not compliant:
            return near
        place = slice(2 * joint - 2, 2 * joint)
        (g_x, g_y), (s_x, s_y) = gaps[place], gap_rates[place]
        point = near.locatenew(f'far side of joint {joint}', g_x * table.x + g_y * table.y)
        point.set_vel(table, near.vel(table) + s_x * table.x + s_y * table.y)
        return point

    origin = mechanics.Point('origin')
    origin.set_vel(table, 0)
    a, b, c, d = links
    centre_a = origin.locatenew('A', x * table.x + y * table.y)
    centre_a.set_vel(table, v_x * table.x + v_y * table.y)
    joint_1 = fixed(centre_a, 'joint 1', -com[0], a)
    joint_4 = fixed(centre_a, 'joint 4', length[0] * a.x - com[0], a)
    start_of_b = across_gap(joint_1, 1)
    centre_b = fixed(start_of_b, 'B', com[1], b)
    joint_2 = fixed(start_of_b, 'joint 2', length[1] * b.x, b)
    start_of_c = across_gap(joint_2, 2)
    centre_c = fixed(start_of_c, 'C', com[2], c)
    joint_3 = fixed(start_of_c, 'joint 3', length[2] * c.x, c)
    start_of_d = across_gap(joint_3, 3)
    centre_d = fixed(start_of_d, 'D', com[3] - length[3] * d.x, d)
    end_of_d = fixed(start_of_d, 'end of d', -length[3] * d.x, d)
    centres = (centre_a, centre_b, centre_c, centre_d)

    gap, slip = end_of_d.pos_from(joint_4), end_of_d.vel(table) - joint_4.vel(table)
    closure = [gap.dot(table.x), gap.dot(table.y)]

    free = tuple(i for i in range(4) if not prescribed[i])
    bodies, applied = [], []
    for i, centre in enumerate(centres):
        bodies += [
            mechanics.RigidBody(f'link {LETTERS[i]}', centre, links[i], mass[i], (
                mechanics.inertia(links[i], 0, 0, inertia[i]), centre)),
            mechanics.RigidBody(f'wheel {LETTERS[i]}', centre, wheels[i], 0, (
                mechanics.inertia(wheels[i], 0, 0, wheel_inertia[i]), centre))]
        if i in free:
            applied += [(wheels[i], command[i] * table.z), (links[i], -command[i] * table.z)]
    arguments = [phi, omega, command, [symbol for group in parameters for symbol in group]]
    if loads:
        values = {name: sympy.symbols(f'{name}:{count}') for name, count in LOADS.items()}
        arguments += [(v_x, v_y), *values.values()]
        slope = values['gravity'][0] * table.x + values['gravity'][1] * table.y
        for i, centre in enumerate(centres):
            applied += [
                (centre, mass[i] * slope - values['link_drag'][i] * centre.vel(table)),
                (links[i], (values['link_torques'][i] - values['link_spin_drag'][i] * omega[i])
                 * table.z)]
            rate = omega[i] - omega[(i + 1) % 4]
            friction = (values['joint_coulomb'][i] * rate
                        / sympy.sqrt(rate**2 + values['smoothing'][0]**2)
                        + values['joint_viscous'][i] * rate)
            applied += [(links[i], -friction * table.z), (links[(i + 1) % 4], friction * table.z)]
    if compliant:
        stiffness, damping = sympy.symbols('k:4'), sympy.symbols('c:4')
        arguments += [gaps, gap_rates, stiffness, damping]
        for i, (first, second) in enumerate((
                (joint_1, start_of_b), (joint_2, start_of_c), (joint_3, start_of_d),
                (end_of_d, joint_4))):
            # Spring and damper act in the middle of the gap on both links.
            opening, middles = second.pos_from(first), []
            for point, link, share in ((first, i, 0.5), (second, (i + 1) % 4, -0.5)):
                middle = point.locatenew('middle', share * opening)
                middle.set_vel(table, point.vel(table) + links[link].ang_vel_in(table).cross(
                    share * opening))
                middles.append(middle)
            force = stiffness[i] * opening + damping[i] * (
                middles[1].vel(table) - middles[0].vel(table))
            applied += [(middles[0], force), (middles[1], -force)]

    free_psi, free_spin = [psi[i] for i in free], [spin[i] for i in free]
    kinematic = [coordinate.diff(time) - speed for coordinate, speed in zip(
        (x, y, *phi, *free_psi, *gaps), (v_x, v_y, *omega, *free_spin, *gap_rates))]
    if compliant:
        method = mechanics.KanesMethod(
            table, q_ind=[x, y, phi[0], phi[1], *free_psi, *phi[2:], *gaps],
            u_ind=[v_x, v_y, omega[0], omega[1], *free_spin, *omega[2:], *gap_rates],
            kd_eqs=kinematic)
    else:
        method = mechanics.KanesMethod(
            table, q_ind=[x, y, phi[0], phi[1], *free_psi], q_dependent=phi[2:],
            u_ind=[v_x, v_y, omega[0], omega[1], *free_spin], u_dependent=omega[2:],
            kd_eqs=kinematic, configuration_constraints=closure,
            velocity_constraints=[slip.dot(table.x), slip.dot(table.y)],
            # Cramer's rule divides by sin(phi_d - phi_c) alone; elimination would divide by
            # sin(phi_c) as well, which is not singular.
            constraint_solver='CRAMER')
    method.kanes_equations(bodies, applied)

    accelerations = {psi[i].diff(time, 2): command[i] for i in range(4) if prescribed[i]}
    evaluate = sympy.lambdify(
        arguments, [method.mass_matrix.xreplace(accelerations).tolist(),
                    list(method.forcing.xreplace(accelerations))], modules='math', cse=True)
    return Equations(evaluate, sympy.lambdify([phi, arguments[3]], closure, modules='math'), free)


def parameters_of(mechanism: Mechanism) -> list[float]:
    """Return lengths, masses, inertias, mass centres x and y, wheel inertias in one list (24,)."""
    return [float(value) for group in (
        mechanism.link_lengths, mechanism.link_masses, mechanism.link_inertias,
        mechanism.com_positions[:, 0], mechanism.com_positions[:, 1],
        mechanism.flywheel_inertias) for value in group]


def _singular(time: float) -> KaneError:
    return KaneError(
        f'the Kane equations are singular at t = {time:g} s: links c and d are collinear, so that '
        'omega_c and omega_d do not follow from omega_a and omega_b', time=time)
