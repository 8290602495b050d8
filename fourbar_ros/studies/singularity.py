# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The collapsed four-bar of paper sections 1 and 5, driven at its joints, and driven by flywheels.

Where all links lie on a line (theta = 0) the closure loses rank and opposite links may turn apart,
eta = omega_c - omega_a. A joint that is locked no longer holds the others, and the motor in it
does nothing about it: the Type 2 singularity. Opposite torques of flywheels act on that motion as
they act on the others. All in the four link angles, in which nothing is undefined at theta = 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
from dataclasses import replace
import io
from math import nan

from fourbar_ros.common.checks import at_most, Check, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.control.computed_torque import hold_on_branch
from fourbar_ros.loop.scenario import load_scenario
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import load_mechanism, Mechanism
from fourbar_ros.mechanism.closure import SIGNS
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import mass_matrix
from fourbar_ros.mechanism.forces import NOTHING, Surroundings, surroundings
from fourbar_ros.mechanism.integration import move_held
from fourbar_ros.mechanism.mechanism import JOINT_LINKS
from fourbar_ros.mechanism.state import LINK_ANGLES, make_state
from fourbar_ros.studies import cores, figures, Result
from fourbar_ros.studies.campaigns.workers import map_ordered
from fourbar_ros.studies.crossing import CROSSINGS
from fourbar_ros.studies.crossing_runs import go, Passage, Run
import numpy as np

THETAS = np.radians(np.linspace(-40.0, 40.0, 321))
AWAY = float(THETAS[-1])

# Rates of links a, b, c, d when phi_a, phi_b and eta move, one a column; at theta = 0.
MODES = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])
MODE_NAMES = ('phi_a', 'phi_b', 'eta')
ETA = MODES[:, 2]

# A singular value below this share of the largest is none.
RANK = 1e-9

# The manoeuvre of study crossing up to the end of its first stop.
PARKING = replace(CROSSINGS['parking'], script=CROSSINGS['parking'].script[:1], duration=9.5)
STIFFNESS = 1e4     # of joints that give, as in study crossing [N/m]
MOST_APART = 1.0    # with four wheels [deg]

# How eta is driven from rest at theta = 0, to see whether it goes: by 3e-5 rad, so little that
# its square, by which the inertia changes on the way, is below the limit.
TORQUE, DRIVEN_FOR, STEP = 1e-5, 0.2, 1e-3      # N m, s, s
ROUNDING = 1e-9


def joint_motor(joint: int) -> Array:
    """Return what a unit torque of a motor between the links of a joint (0 to 3) does to them."""
    first, second = JOINT_LINKS[joint]
    torques = np.zeros(4)
    torques[first], torques[second] = -1.0, 1.0
    return torques


def wheel_motor(wheel: int) -> Array:
    """Return what a unit torque on a wheel does to the links: the opposite to its own."""
    torques = np.zeros(4)
    torques[wheel] = -1.0
    return torques


DRIVES: dict[str, Array] = {
    'joint_1': np.column_stack([joint_motor(0)]),
    'joints_1_2': np.column_stack([joint_motor(joint) for joint in (0, 1)]),
    'four_joints': np.column_stack([joint_motor(joint) for joint in range(4)]),
    'wheels_a_b': np.column_stack([wheel_motor(wheel) for wheel in (0, 1)]),
    'four_wheels': np.column_stack([wheel_motor(wheel) for wheel in range(4)])}
"""Torques on the links (4, n) of the motors of each way to drive the linkage."""

TITLES = {'joint_1': 'a motor in joint 1', 'joints_1_2': 'motors in joints 1, 2',
          'four_joints': 'motors in all joints', 'wheels_a_b': 'wheels a and b',
          'four_wheels': 'four wheels'}

# Rank at theta = 0 and away from it.
RANKS = {'joint_1': (1, 1), 'joints_1_2': (2, 1), 'four_joints': (2, 1), 'wheels_a_b': (2, 2),
         'four_wheels': (3, 2)}
# Motions of the closed linkage, and with joints locked, likewise.
LOCKS: dict[tuple[int, ...], tuple[int, int]] = {(): (3, 2), (0,): (2, 1), (0, 1): (1, 1)}


def run(progress: Progress) -> Result:
    """
    Work out who drives what, and let a linkage park at theta = 0 in the closed loop.

    :raises FourbarError: a preset is broken, or a process died.
    """
    warm_up()
    mechanism = load_mechanism('prototype')
    methods = ('four_held', 'two')
    runs = [Run(PARKING, method, 0) for method in methods]
    with contextlib.closing(map_ordered(go, runs, min(cores(), len(runs)))) as found:
        parked = dict(zip(methods, progress(found, len(runs))))
    numbers = over_theta(mechanism)
    opened = {'opposite_wheels': driven_apart(mechanism, np.array([1.0, 0.0, -1.0, 0.0]), NOTHING),
              'joint_1': driven_apart(mechanism, np.zeros(4), surroundings(
                  link_torques=TORQUE * joint_motor(0)))}
    expected = 0.5 * TORQUE / eta_inertia(mechanism, 0.0) * DRIVEN_FOR ** 2
    files: dict[str, str | bytes] = {'singularity.csv': _csv(numbers)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.singularity_figure import png
        files['singularity.png'] = png(numbers, parked)
    data = {
        'generalized_forces': {name: _forces(drive) for name, drive in DRIVES.items()},
        'rank_at_0': {name: rank(driven(mechanism, 0.0, drive)) for name, drive in DRIVES.items()},
        'rank_at_40_deg': {name: rank(driven(mechanism, AWAY, drive))
                           for name, drive in DRIVES.items()},
        'motions_at_0': {_lock_name(locked): motions(mechanism, 0.0, locked).shape[1]
                         for locked in LOCKS},
        'motions_at_40_deg': {_lock_name(locked): motions(mechanism, AWAY, locked).shape[1]
                              for locked in LOCKS},
        'eta_inertia_kg_m2': eta_inertia(mechanism, 0.0),
        'joint_stiffness_n_m': STIFFNESS,
        'output_stiffness_at_40_deg_n_m_rad': output_stiffness(mechanism, AWAY),
        'held_stiffness_at_0_n_m_rad': held_stiffness(mechanism, 0.0),
        'eta_after_rad': opened, 'eta_expected_rad': expected,
        'parked_largest_eta_deg': {method: float(np.degrees(passage.apart))
                                   for method, passage in parked.items()},
        'parked_passed': {method: passage.passed for method, passage in parked.items()}}
    return Result(_checks(mechanism, opened, expected, parked), data, _table(mechanism, parked),
                  files, skipped)


def closure_jacobian(mechanism: Mechanism, theta: float) -> Array:
    """Return J (2, 4) of a parallelogram, `J omega = 0` [m]."""
    angles = np.tile([0.0, theta], 2)
    signed = np.array(SIGNS) * mechanism.link_lengths
    return np.array([-signed * np.sin(angles), signed * np.cos(angles)])


def motions(mechanism: Mechanism, theta: float, locked: Sequence[int] = ()) -> Array:
    """
    Return an orthonormal basis (4, n) of the link rates that closure and locked joints admit.

    :param locked: joints, 0 to 3, whose two links turn as one.
    """
    rows = np.vstack([closure_jacobian(mechanism, theta) / mechanism.link_lengths.max(),
                      *(joint_motor(joint) for joint in locked)])
    _, singular, basis = np.linalg.svd(rows)
    kept: Array = basis[np.count_nonzero(singular > RANK * singular.max()):].T
    return kept


def driven(mechanism: Mechanism, theta: float, drive: Array) -> Array:
    """Return the generalized forces (n, motors) of a drive on the motions of the linkage."""
    forces: Array = motions(mechanism, theta).T @ drive
    return forces


def rank(matrix: Array) -> int:
    """Count the singular values that are not zero."""
    singular = np.linalg.svd(matrix, compute_uv=False)
    return int(np.count_nonzero(singular > RANK * singular.max()))


def eta_inertia(mechanism: Mechanism, theta: float) -> float:
    """Return the inertia of eta [kg m^2]."""
    angles = np.tile([0.0, theta], 2)
    return float(ETA @ mass_matrix(angles, mechanism.constants) @ ETA)


def output_stiffness(mechanism: Mechanism, theta: float) -> float:
    """
    Return the stiffness of the output joint 4 with the input joint 1 locked, of a rhombus.

    Four joints that give share a gap, so they count as `k / 4`; the coupler c turns as it likes,
    so what is across it counts, `l sin(theta)` for each radian of d.

    :returns: [N m/rad].
    """
    arm = float(mechanism.link_lengths[3]) * np.sin(theta)
    return float(0.25 * STIFFNESS * arm * arm)


def joint_force(mechanism: Mechanism, theta: float) -> float:
    """Return the force in c that holds a unit torque on d with joint 1 locked [N/(N m)]."""
    arm = abs(float(mechanism.link_lengths[3]) * np.sin(theta))
    return 1.0 / arm if arm > 0.0 else nan


def held_stiffness(mechanism: Mechanism, theta: float) -> float:
    """Return with what stiffness the controller's feedback holds eta by four wheels [N m/rad]."""
    bandwidth = load_scenario('prototype').controller.branch_bandwidth
    return eta_inertia(mechanism, theta) * bandwidth ** 2 * hold_on_branch(theta)


def driven_apart(mechanism: Mechanism, shares: Array, around: Surroundings) -> float:
    """
    Drive a rigid linkage from rest at theta = 0, by the integrator.

    :param shares: (4,) of TORQUE on each wheel.
    :param around: what drives it besides.
    :returns: eta after `DRIVEN_FOR` [rad].
    """
    state = make_state(np.zeros(4))
    move_held(state, TORQUE * shares, STEP, round(DRIVEN_FOR / STEP), mechanism.constants, around)
    angles = state[LINK_ANGLES]
    return float(angles[2] - angles[0])


def over_theta(mechanism: Mechanism) -> dict[str, Array]:
    """Return what changes with theta, (n,) by name."""
    singular = np.array([np.linalg.svd(
        closure_jacobian(mechanism, theta), compute_uv=False) for theta in THETAS])
    # On the parallelogram a turns with c and b with d, at theta = 0 as elsewhere.
    pairs = MODES[:, :2]
    wheels = np.linalg.svd(pairs.T @ DRIVES['four_wheels'], compute_uv=False)
    count = len(THETAS)
    return {
        'theta_deg': np.degrees(THETAS), 'closure_larger_m': singular[:, 0],
        'closure_smaller_m': singular[:, 1],
        'closure_determinant_with_joint_1_locked_m2': np.array([
            mechanism.link_lengths[2] * mechanism.link_lengths[3] * np.sin(theta)
            for theta in THETAS]),
        'wheel_map_larger': np.full(count, wheels[0]),
        'wheel_map_smaller': np.full(count, wheels[1]),
        'opposite_wheels_on_eta': np.full(count, abs(
            ETA @ DRIVES['four_wheels'] @ np.array([1.0, 0.0, -1.0, 0.0]))),
        'joint_1_on_eta': np.full(count, abs(ETA @ joint_motor(0))),
        'output_stiffness_n_m_rad': np.array([
            output_stiffness(mechanism, theta) for theta in THETAS]),
        'held_stiffness_n_m_rad': np.array([held_stiffness(mechanism, theta) for theta in THETAS]),
        'joint_force_n_per_n_m': np.array([joint_force(mechanism, theta) for theta in THETAS])}


def _forces(drive: Array) -> dict[str, list[float]]:
    """Return the generalized force of a unit of each motor on each mode, by the mode's name."""
    return {name: [float(value) for value in row]
            for name, row in zip(MODE_NAMES, MODES.T @ drive)}


def _checks(mechanism: Mechanism, opened: Mapping[str, float], expected: float,
            parked: Mapping[str, Passage]) -> list[Check]:
    def exactly(name: str, value: float, wanted: float) -> Check:
        return within(name, value, '', wanted, wanted)

    opposite = {pair: float(ETA @ DRIVES['four_wheels'] @ np.array(torques)) for pair, torques in (
        ('a and c', [1.0, 0.0, -1.0, 0.0]), ('b and d', [0.0, 1.0, 0.0, -1.0]))}
    checks = [exactly(f'generalized force on eta, wheels {pair} opposed, per N m', value, 1.0)
              for pair, value in opposite.items()]
    checks += [
        exactly('generalized force on eta, motor in joint 1, per N m',
                float(ETA @ joint_motor(0)), 0.0),
        exactly('torque on the whole, motors in any joint, largest',
                float(np.abs(DRIVES['four_joints'].sum(axis=0)).max()), 0.0)]
    for place, theta in enumerate((0.0, AWAY)):
        at = f'at theta = {np.degrees(theta):.0f} deg'
        checks += [exactly(f'motions {at}, {_lock_name(locked).replace("_", " ")}',
                           motions(mechanism, theta, locked).shape[1], wanted[place])
                   for locked, wanted in LOCKS.items()]
        checks += [exactly(f'motions driven {at}, {TITLES[name]}',
                           rank(driven(mechanism, theta, drive)), RANKS[name][place])
                   for name, drive in DRIVES.items()]
    checks += [
        exactly('stiffness of the output joint at theta = 0, joint 1 locked',
                output_stiffness(mechanism, 0.0), 0.0),
        at_most('from rest at theta = 0: eta by opposite wheels beside torque / inertia, relative',
                abs(opened['opposite_wheels'] / expected - 1.0), '', ROUNDING),
        at_most('the same: eta by a motor in joint 1', abs(opened['joint_1']), 'rad', ROUNDING),
        at_most('closed loop, parked at theta = 0: eta with four wheels, largest',
                float(np.degrees(parked['four_held'].apart)), 'deg', MOST_APART)]
    return checks


def _lock_name(locked: Sequence[int]) -> str:
    if not locked:
        return 'nothing_locked'
    return f'joint{"s" * (len(locked) > 1)}_' + '_'.join(
        f'{joint + 1}' for joint in locked) + '_locked'


def _table(mechanism: Mechanism, parked: Mapping[str, Passage]) -> str:
    lines = [f'{"generalized force of 1 N m, theta = 0":<40}'
             + ''.join(f'{name:>8}' for name in MODE_NAMES)]
    motors = {**{f'motor in joint {joint + 1}': joint_motor(joint) for joint in range(4)},
              **{f'wheel {"abcd"[wheel]}': wheel_motor(wheel) for wheel in range(4)},
              'wheels a and c opposed': wheel_motor(0) - wheel_motor(2)}
    # Without the sign of zero.
    lines += [f'{name:<40}' + ''.join(f'{value + 0.0:>8.2g}' for value in MODES.T @ torques)
              for name, torques in motors.items()]
    lines += ['', f'{"motions":<40}{"0 deg":>8}{"40 deg":>8}']
    for locked in LOCKS:
        name = _lock_name(locked).replace('_', ' ')
        lines.append(f'{name:<40}' + ''.join(
            f'{motions(mechanism, theta, locked).shape[1]:>8}' for theta in (0.0, AWAY)))
    lines += ['', f'{"motions that are driven":<40}{"0 deg":>8}{"40 deg":>8}']
    for name, drive in DRIVES.items():
        lines.append(f'{TITLES[name]:<40}' + ''.join(
            f'{rank(driven(mechanism, theta, drive)):>8}' for theta in (0.0, AWAY)))
    lines += ['', 'closed loop, parked at theta = 0 for 5 s: largest eta '
              f'{np.degrees(parked["four_held"].apart):.3g} deg with four wheels, '
              f'{np.degrees(parked["two"].apart):.3g} deg with two (fourbar study crossing)']
    return '\n'.join([*lines, ''])


def _csv(numbers: Mapping[str, Array]) -> str:
    """Return what changes with theta; fields are empty where a number has no limit."""
    file = io.StringIO()
    file.write(','.join(numbers) + '\n')
    for row in zip(*numbers.values()):
        file.write(','.join(f'{value + 0.0:.9g}' if np.isfinite(value) else '' for value in row)
                   + '\n')
    return file.getvalue()
