# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The linkage and its process noise as one record that the kernels of the filter take."""

from __future__ import annotations

from math import inf
from typing import Any, NamedTuple

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.closure import SIGNS
from fourbar_ros.mechanism.constants import Array
import numpy as np

Records = Any
"""An array of a structured type: a kernel reads the fields of its elements by name."""

Model = np.record
"""The only element of what :func:`make_model` returns."""

# Random walk of the lengths relative to their tolerance [1/sqrt(s)]: lengths hardly change.
LENGTH_WALK = 0.01

# White torques that rotate opposite links against each other, over the random walk of the
# disturbance torques [s]: the time for which such a torque stays about constant.
OPPOSING_TIME = 0.3

# Relative standard deviation of the force of compliant joints. The stiffness of a joint is rarely
# known better, and mass centres off the line of their link are neglected.
FORCE_UNCERTAINTY = 0.2


class ProcessNoise(NamedTuple):
    """
    Process noise, as densities.

    :param torque: white torque on each link [N m/sqrt(Hz)].
    :param torque_walk: random walk of the disturbance torques on links a and b [N m/sqrt(s)].
    :param gyro_walk: random walk of the biases of the gyros [rad/s/sqrt(s)].
    :param closure_tolerance: standard deviation of the closure error with the nominal lengths
        [m]; 0 for exact lengths.
    """

    torque: float
    torque_walk: float = 0.0
    gyro_walk: float = 0.0
    closure_tolerance: float = 0.0


# Fields of the model of the linkage that the kernels take. Those from `length_walk` on matter for
# uncertain lengths only; estimation.compliant_closure explains them.
_MODEL: list[tuple[str, Any]] = [
    ('torque', float),              # N m/sqrt(Hz), as of ProcessNoise
    ('torque_walk', float),         # N m/sqrt(s)
    ('gyro_walk', float),           # rad/s/sqrt(s)
    ('uncertain_lengths', np.int64),    # 1 if the lengths of links b, c and d are states, else 0
    ('length_walk', float),         # m/sqrt(s), random walk of these lengths
    ('stiffness', float),           # N/m, of the four joints in series
    ('damping', float),             # N s/m, of the four joints in series
    ('mass_reduction', float),      # kg, see _mass_reduction
    ('force_uncertainty', float),   # standard deviation of the force of the joints, relative
    ('opposing_torque', float),     # N m/sqrt(Hz), white, rotates opposite links apart
    ('opposite_share', float),      # of a disturbance torque that acts on the opposite link
]


def make_model(mechanism: Mechanism, noise: ProcessNoise) -> Records:
    """
    Work out what the kernels of the filter need to know.

    :returns: (1,) fields of _MODEL and `constants` of the mechanism with locked wheels. An array
        of one, since numba takes longer to unpack a single record than a kernel runs.
    """
    constants = mechanism.with_rigid_joints().constants_with(np.ones(4, dtype=bool))
    model = np.zeros(1, np.dtype((np.record, [*_MODEL, ('constants', constants.dtype)])))
    values: dict[str, Any] = {
        'torque': noise.torque, 'torque_walk': noise.torque_walk, 'gyro_walk': noise.gyro_walk,
        'constants': constants}
    if tolerance := noise.closure_tolerance:
        lengths = mechanism.link_lengths
        parallelogram = np.abs(lengths[:2] - lengths[2:]).max() <= tolerance
        values |= {
            'uncertain_lengths': 1, 'length_walk': LENGTH_WALK * tolerance,
            # Rigid joints: only the sign of their force is known.
            'stiffness': inf, 'force_uncertainty': 1.0,
            'opposing_torque': OPPOSING_TIME * noise.torque_walk,
            'opposite_share': 0.5 if parallelogram else 0.0}
        if np.isfinite(mechanism.joint_stiffness).all():
            stiffness = 1.0 / float((1.0 / mechanism.joint_stiffness).sum())
            # The same force acts in all joints: each opens by this share of the gap.
            shares = stiffness / mechanism.joint_stiffness
            values |= {
                'stiffness': stiffness, 'force_uncertainty': FORCE_UNCERTAINTY,
                'damping': float(mechanism.joint_damping @ shares ** 2),
                'mass_reduction': _mass_reduction(mechanism, shares)}
    for name, value in values.items():
        model[name] = value
    return model


def _mass_reduction(mechanism: Mechanism, shares: Array) -> float:
    """
    Return how much less mass moves if the joints share the gap than with it in joint 3 alone [kg].

    All links except a move by their share of the rate of the gap, in addition to the motion from
    the rates of the links. Of the impulse that this adds to each link angle only the component
    along the gap, `s_i l_i`, matters: the rest drives motions that leave the gap alone.

    :param shares: (4,) of the joints in the gap.
    """
    masses = mechanism.link_masses
    # Displacement of each link over the gap. Joint 1 is between a and b, joint 2 between b and c,
    # joint 4 between d and a.
    moved = np.array([0.0, -shares[0], -shares[0] - shares[1], shares[3]])
    moved -= masses @ moved / masses.sum()
    signed = np.array(SIGNS) * mechanism.link_lengths
    added = (masses * moved) @ mechanism.constants.arms[:, :, 0]
    return float(-2.0 * added @ signed / (signed @ signed) - masses @ moved ** 2)
