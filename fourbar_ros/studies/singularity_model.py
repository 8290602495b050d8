# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Mechanics of the collapsed four-bar: admissible motions, generalized forces of drives, stiffness.

All quantities are in the four link angles, in which none is undefined at theta = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import nan

from fourbar_ros.control.computed_torque import hold_on_branch
from fourbar_ros.loop.scenario import load_scenario
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.closure import SIGNS
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.dynamics import mass_matrix
from fourbar_ros.mechanism.forces import Surroundings
from fourbar_ros.mechanism.integration import move_held
from fourbar_ros.mechanism.mechanism import JOINT_LINKS
from fourbar_ros.mechanism.state import LINK_ANGLES, make_state
from fourbar_ros.studies.crossing_runs import MANOEUVRES, STIFFNESS
import numpy as np

# Angles between links a and b in tables and figure [rad].
THETAS = np.radians(np.linspace(-40.0, 40.0, 321))
# Angle away from the singularity at which ranks are compared [rad].
AWAY = float(THETAS[-1])
# Rates of links a, b, c, d per unit rate of phi_a, phi_b and eta (4, 3), at theta = 0.
MODES = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [1.0, 0.0, 0.5], [0.0, 1.0, 0.5]])
MODE_NAMES = ('phi_a', 'phi_b', 'eta')
ETA = MODES[:, 2]
# Singular values below this share of the largest count as zero.
RANK_TOLERANCE = 1e-9
# The parking manoeuvre of study crossing up to the end of its first stop.
PARKING = replace(MANOEUVRES['parking'], script=MANOEUVRES['parking'].script[:1], duration=9.5)
# Torque [N m], duration [s] and integration step [s] that drive eta from rest at theta = 0.
# eta reaches 3e-5 rad; its square, by which the inertia changes, is below `ROUNDING`.
TORQUE, PUSH_TIME, STEP = 1e-5, 0.2, 1e-3
# Largest error of the integrated eta, relative or [rad].
ROUNDING = 1e-9


def joint_motor(joint: int) -> Array:
    """Return the torques on the links (4,) of a motor in a joint (0 to 3) per unit torque."""
    first, second = JOINT_LINKS[joint]
    torques = np.zeros(4)
    torques[first], torques[second] = -1.0, 1.0
    return torques


def wheel_motor(wheel: int) -> Array:
    """Return the torques on the links (4,) of a wheel motor per unit torque on the wheel."""
    torques = np.zeros(4)
    torques[wheel] = -1.0
    return torques


# Torques on the links (4, motors) per unit torque of each motor, by drive.
DRIVES: dict[str, Array] = {
    'joint_1': np.column_stack([joint_motor(0)]),
    'joints_1_2': np.column_stack([joint_motor(joint) for joint in (0, 1)]),
    'four_joints': np.column_stack([joint_motor(joint) for joint in range(4)]),
    'wheels_a_b': np.column_stack([wheel_motor(wheel) for wheel in (0, 1)]),
    'four_wheels': np.column_stack([wheel_motor(wheel) for wheel in range(4)])}

TITLES = {'joint_1': 'a motor in joint 1', 'joints_1_2': 'motors in joints 1, 2',
          'four_joints': 'motors in all joints', 'wheels_a_b': 'wheels a and b',
          'four_wheels': 'four wheels'}

# Expected number of driven motions at theta = 0 and away from it, by drive.
RANKS = {'joint_1': (1, 1), 'joints_1_2': (2, 1), 'four_joints': (2, 1), 'wheels_a_b': (2, 2),
         'four_wheels': (3, 2)}
# Expected number of admissible motions, likewise, by locked joints.
LOCKS: dict[tuple[int, ...], tuple[int, int]] = {(): (3, 2), (0,): (2, 1), (0, 1): (1, 1)}


def closure_jacobian(mechanism: Mechanism, theta: float) -> Array:
    """Return J (2, 4) of a parallelogram, `J omega = 0` [m]."""
    angles = np.tile([0.0, theta], 2)
    signed = np.array(SIGNS) * mechanism.link_lengths
    return np.array([-signed * np.sin(angles), signed * np.cos(angles)])


def motions(mechanism: Mechanism, theta: float, locked: Sequence[int] = ()) -> Array:
    """
    Return an orthonormal basis (4, n) of the link rates that closure and locked joints admit.

    :param locked: joints (0 to 3) whose two links rotate together.
    """
    rows = np.vstack([closure_jacobian(mechanism, theta) / mechanism.link_lengths.max(),
                      *(joint_motor(joint) for joint in locked)])
    _, singular, basis = np.linalg.svd(rows)
    kept: Array = basis[np.count_nonzero(singular > RANK_TOLERANCE * singular.max()):].T
    return kept


def generalized_forces(mechanism: Mechanism, theta: float, drive: Array) -> Array:
    """Return the generalized forces (n, motors) of a drive on the admissible motions."""
    forces: Array = motions(mechanism, theta).T @ drive
    return forces


def rank(matrix: Array) -> int:
    """Count the singular values that are not zero."""
    singular = np.linalg.svd(matrix, compute_uv=False)
    return int(np.count_nonzero(singular > RANK_TOLERANCE * singular.max()))


def eta_inertia(mechanism: Mechanism, theta: float) -> float:
    """Return the inertia of eta [kg m^2]."""
    angles = np.tile([0.0, theta], 2)
    return float(ETA @ mass_matrix(angles, mechanism.constants) @ ETA)


def output_stiffness(mechanism: Mechanism, theta: float) -> float:
    """
    Return the stiffness of the output joint 4 with the input joint 1 locked, of a rhombus.

    The gap of the loop is shared by four compliant joints, which gives `k / 4`. The coupler c
    rotates freely, so only the gap across it matters, `l sin(theta)` per radian of d.

    :returns: [N m/rad].
    """
    arm = float(mechanism.link_lengths[3]) * np.sin(theta)
    return float(0.25 * STIFFNESS * arm * arm)


def joint_force(mechanism: Mechanism, theta: float) -> float:
    """Return the force in link c per unit torque on link d with joint 1 locked [N/(N m)]."""
    arm = abs(float(mechanism.link_lengths[3]) * np.sin(theta))
    return 1.0 / arm if arm > 0.0 else nan


def held_stiffness(mechanism: Mechanism, theta: float) -> float:
    """Return the stiffness of eta by the controller's feedback with four wheels [N m/rad]."""
    bandwidth = load_scenario('prototype').controller.branch_bandwidth
    return eta_inertia(mechanism, theta) * bandwidth ** 2 * hold_on_branch(theta)


def integrate_eta(mechanism: Mechanism, shares: Array, around: Surroundings) -> float:
    """
    Drive a rigid linkage from rest at theta = 0, by the integrator.

    :param shares: (4,) torques on the wheels, relative to TORQUE.
    :param around: external torques.
    :returns: eta after `PUSH_TIME` [rad].
    """
    state = make_state(np.zeros(4))
    move_held(state, TORQUE * shares, STEP, round(PUSH_TIME / STEP), mechanism.constants, around)
    angles = state[LINK_ANGLES]
    return float(angles[2] - angles[0])


def over_theta(mechanism: Mechanism) -> dict[str, Array]:
    """Return the quantities that depend on theta, (n,) by name."""
    singular = np.array([np.linalg.svd(
        closure_jacobian(mechanism, theta), compute_uv=False) for theta in THETAS])
    # On the parallelogram branch a rotates with c and b with d, at any theta.
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
