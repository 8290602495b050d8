# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The collapsed four-bar of paper sections 1 and 5, driven at its joints, and driven by flywheels.

Where all links are collinear (theta = 0) the closure loses rank and opposite links may rotate
apart, eta = omega_c - omega_a. A locked joint no longer holds the others, and a motor in it has no
effect on eta: the Type 2 singularity. Opposite torques of flywheels act on eta as on the other
motions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fourbar_ros.common.checks import at_most, Check, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import load_mechanism, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.forces import NOTHING, surroundings
from fourbar_ros.studies import csv_text, figures, Result
from fourbar_ros.studies.crossing_runs import CrossingOutcome, CrossingRun, execute, STIFFNESS
from fourbar_ros.studies.singularity_model import (
    AWAY,
    DRIVES,
    ETA,
    eta_inertia,
    generalized_forces,
    held_stiffness,
    integrate_eta,
    joint_motor,
    LOCKS,
    MODE_NAMES,
    MODES,
    motions,
    output_stiffness,
    over_theta,
    PARKING,
    PUSH_TIME,
    rank,
    RANKS,
    ROUNDING,
    TITLES,
    TORQUE,
    wheel_motor,
)
import numpy as np

# Largest eta with four wheels while the linkage is parked at theta = 0 [deg].
LARGEST_PARKED_ETA = 1.0


def run(progress: Progress) -> Result:
    """
    Compare the drives, and park a linkage at theta = 0 in the closed loop.

    :raises FourbarError: a preset is broken.
    """
    warm_up()
    mechanism = load_mechanism('prototype')
    methods = ('four_held', 'two')
    runs = [CrossingRun(PARKING, method, 0) for method in methods]
    parked = dict(zip(methods, progress(map(execute, runs), len(runs))))
    numbers = over_theta(mechanism)
    reached = {
        'opposite_wheels': integrate_eta(mechanism, np.array([1.0, 0.0, -1.0, 0.0]), NOTHING),
        'joint_1': integrate_eta(mechanism, np.zeros(4), surroundings(
            link_torques=TORQUE * joint_motor(0)))}
    expected = 0.5 * TORQUE / eta_inertia(mechanism, 0.0) * PUSH_TIME ** 2
    files: dict[str, str | bytes] = {'singularity.csv': csv_text(numbers, (
        [f'{value + 0.0:.9g}' if np.isfinite(value) else '' for value in row]
        for row in zip(*numbers.values())))}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.singularity_figure import png
        files['singularity.png'] = png(numbers, parked)
    data = {
        'generalized_forces': {name: _forces(drive) for name, drive in DRIVES.items()},
        'rank_at_0': {name: rank(generalized_forces(mechanism, 0.0, drive))
                      for name, drive in DRIVES.items()},
        'rank_at_40_deg': {name: rank(generalized_forces(mechanism, AWAY, drive))
                           for name, drive in DRIVES.items()},
        'motions_at_0': {_lock_name(locked): motions(mechanism, 0.0, locked).shape[1]
                         for locked in LOCKS},
        'motions_at_40_deg': {_lock_name(locked): motions(mechanism, AWAY, locked).shape[1]
                              for locked in LOCKS},
        'eta_inertia_kg_m2': eta_inertia(mechanism, 0.0),
        'joint_stiffness_n_m': STIFFNESS,
        'output_stiffness_at_40_deg_n_m_rad': output_stiffness(mechanism, AWAY),
        'held_stiffness_at_0_n_m_rad': held_stiffness(mechanism, 0.0),
        'eta_after_rad': reached, 'eta_expected_rad': expected,
        'parked_largest_eta_deg': {method: float(np.degrees(outcome.largest_eta))
                                   for method, outcome in parked.items()},
        'parked_passed': {method: outcome.passed for method, outcome in parked.items()}}
    return Result(_checks(mechanism, reached, expected, parked), data, _table(mechanism, parked),
                  files, skipped)


def _forces(drive: Array) -> dict[str, list[float]]:
    """Return the generalized force on each mode per unit torque of each motor, by mode."""
    return {name: [float(value) for value in row]
            for name, row in zip(MODE_NAMES, MODES.T @ drive)}


def _checks(mechanism: Mechanism, reached: Mapping[str, float], expected: float,
            parked: Mapping[str, CrossingOutcome]) -> list[Check]:
    def exactly(name: str, value: float, expected_value: float) -> Check:
        return within(name, value, '', expected_value, expected_value)

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
                           motions(mechanism, theta, locked).shape[1], expected_value[place])
                   for locked, expected_value in LOCKS.items()]
        checks += [exactly(f'motions driven {at}, {TITLES[name]}',
                           rank(generalized_forces(mechanism, theta, drive)), RANKS[name][place])
                   for name, drive in DRIVES.items()]
    checks += [
        exactly('stiffness of the output joint at theta = 0, joint 1 locked',
                output_stiffness(mechanism, 0.0), 0.0),
        at_most('from rest at theta = 0: eta by opposite wheels beside torque / inertia, relative',
                abs(reached['opposite_wheels'] / expected - 1.0), '', ROUNDING),
        at_most('the same: eta by a motor in joint 1', abs(reached['joint_1']), 'rad', ROUNDING),
        at_most('closed loop, parked at theta = 0: eta with four wheels, largest',
                float(np.degrees(parked['four_held'].largest_eta)), 'deg', LARGEST_PARKED_ETA)]
    return checks


def _lock_name(locked: Sequence[int]) -> str:
    if not locked:
        return 'nothing_locked'
    return f'joint{"s" * (len(locked) > 1)}_' + '_'.join(
        f'{joint + 1}' for joint in locked) + '_locked'


def _table(mechanism: Mechanism, parked: Mapping[str, CrossingOutcome]) -> str:
    lines = [f'{"generalized force of 1 N m, theta = 0":<40}'
             + ''.join(f'{name:>8}' for name in MODE_NAMES)]
    motors = {**{f'motor in joint {joint + 1}': joint_motor(joint) for joint in range(4)},
              **{f'wheel {"abcd"[wheel]}': wheel_motor(wheel) for wheel in range(4)},
              'wheels a and c opposed': wheel_motor(0) - wheel_motor(2)}
    # Adding zero removes the sign of a negative zero.
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
            f'{rank(generalized_forces(mechanism, theta, drive)):>8}' for theta in (0.0, AWAY)))
    lines += ['', 'closed loop, parked at theta = 0 for 5 s: largest eta '
              f'{np.degrees(parked["four_held"].largest_eta):.3g} deg with four wheels, '
              f'{np.degrees(parked["two"].largest_eta):.3g} deg with two (fourbar study crossing)']
    return '\n'.join([*lines, ''])
