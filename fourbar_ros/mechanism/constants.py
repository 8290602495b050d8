# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The constants of a mechanism for the kernels, evaluated once in numpy."""

from __future__ import annotations

from itertools import combinations
from typing import Any, cast, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from fourbar_ros.mechanism.mechanism import Mechanism

Array = NDArray[np.float64]

# Links in the order of the pairs ab, ac, ad, bc, bd, cd.
PAIRS = tuple(combinations(range(4), 2))

# The two links of each joint, and whether the joint is at the far end of each.
JOINTS = (((0, False), (1, False)), ((1, True), (2, False)),
          ((3, True), (2, True)), ((0, True), (3, False)))

# Name, type and shape of the fields of a record.
Fields = list[tuple[str, Any, tuple[int, ...]]]

# The constants of the equations of motion (SI units), one record that kernels take as a whole.
#
# The position of every mass centre, relative to that of the whole, is linear in the four
# rotations of the links, `r_i = sum_j R(phi_j) arms[i, j]`. Hence the mass matrix of the four link
# angles is `M_jk = cosine_jk cos(phi_k - phi_j) + sine_jk sin(phi_k - phi_j)` with constant
# `cosine` (symmetric, link inertias on the diagonal) and `sine` (antisymmetric).
#
# A wheel with a prescribed motion relative to its link adds its axial inertia to the link: it is
# in `cosine`, and `prescribed` is 1.
FIELDS: Fields = [
    ('lengths', float, (4,)),               # m
    ('cosine', float, (4, 4)),              # kg m^2
    ('sine', float, (4, 4)),                # kg m^2
    ('pair_cosine', float, (6,)),           # of PAIRS, over l_c and l_d where these occur
    ('pair_sine', float, (6,)),             # likewise
    ('own_inertias', float, (4,)),          # kg m^2, the diagonal of cosine
    ('arms', float, (4, 4, 2)),             # m
    ('masses', float, (4,)),                # kg
    ('inertias', float, (4,)),              # kg m^2, about each link's own mass centre
    ('com_positions', float, (4, 2)),       # m
    ('total_mass', float, ()),              # kg
    ('flywheel_inertias', float, (4,)),     # kg m^2
    ('prescribed', float, (4,)),            # 1 where the wheel's motion is prescribed, else 0
    ('joint_stiffness', float, (4,)),       # N/m
    ('joint_damping', float, (4,)),         # N s/m
    ('fastest_joint_mode', float, ()),      # rad/s, upper bound
    ('compliant', bool, ()),                # whether the joints are compliant
]

# A scalar of `FIELDS`; numba knows its fields by name.
Constants = np.record


def record(fields: Fields, **values: Any) -> np.record:
    """Return a read-only record with these values."""
    filled = np.zeros((), np.dtype((np.record, fields)))
    for name, value in values.items():
        filled[name] = value
    filled.flags.writeable = False
    return cast(np.record, filled[()])


def constants_of(mechanism: Mechanism, prescribed: Array) -> Constants:
    """
    Evaluate the constants of a mechanism.

    :param prescribed: (4,) bool, wheels whose motion relative to their links is prescribed.
    """
    masses = mechanism.link_masses
    lengths = mechanism.link_lengths
    inertias = mechanism.link_inertias + np.where(prescribed, mechanism.flywheel_inertias, 0.0)
    # Relative to joint 1; c is attached to b (joint 2), d to a (joint 4).
    arms = np.zeros((4, 4, 2))
    arms[range(4), range(4)] = mechanism.com_positions
    arms[2, 1, 0] = lengths[1]
    arms[3, 0, 0] = lengths[0]
    arms -= np.einsum('i,ijx->jx', masses / masses.sum(), arms)
    x, y = arms[..., 0], arms[..., 1]
    cosine = np.einsum('i,ij,ik->jk', masses, x, x) + np.einsum('i,ij,ik->jk', masses, y, y)
    sine = np.einsum('i,ij,ik->jk', masses, y, x) - np.einsum('i,ij,ik->jk', masses, x, y)
    cosine[range(4), range(4)] += inertias
    scale = np.array([1.0, 1.0, lengths[2], lengths[3]])
    pairs = tuple(zip(*PAIRS))
    compliant = bool(np.isfinite(mechanism.joint_stiffness).all())
    return record(
        FIELDS, lengths=lengths, cosine=cosine, sine=sine,
        pair_cosine=(cosine / np.outer(scale, scale))[pairs],
        pair_sine=(sine / np.outer(scale, scale))[pairs], own_inertias=np.diag(cosine), arms=arms,
        masses=masses, inertias=inertias, com_positions=mechanism.com_positions,
        total_mass=masses.sum(), flywheel_inertias=mechanism.flywheel_inertias,
        prescribed=prescribed, joint_stiffness=mechanism.joint_stiffness,
        joint_damping=mechanism.joint_damping, compliant=compliant,
        fastest_joint_mode=_fastest_joint_mode(mechanism) if compliant else 0.0)


def _fastest_joint_mode(mechanism: Mechanism) -> float:
    """
    Bound the fastest motion that the springs and dampers of the joints can cause [rad/s].

    By Gershgorin's theorem on the blocks of J M^-1 J^T, two rows for each joint, weighted with
    the stiffness: the square of a frequency. Likewise with the damping: a decay rate.
    """
    radii = np.hypot(
        mechanism.com_positions[:, :1] - np.column_stack([np.zeros(4), mechanism.link_lengths]),
        mechanism.com_positions[:, 1:])
    mobility = np.zeros((4, 4))
    for row, first in enumerate(JOINTS):
        for column, second in enumerate(JOINTS):
            for link, far in first:
                for other, other_far in second:
                    if link == other:
                        mobility[row, column] += (
                            1.0 / mechanism.link_masses[link]
                            + radii[link, int(far)] * radii[link, int(other_far)]
                            / mechanism.link_inertias[link])
    stiffness, damping = (
        float((np.sqrt(np.outer(weight, weight)) * mobility).sum(axis=1).max())
        for weight in (mechanism.joint_stiffness, mechanism.joint_damping))
    return max(float(np.sqrt(stiffness)), damping)
