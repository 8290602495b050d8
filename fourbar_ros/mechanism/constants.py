# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The constants of a mechanism, as a record for the kernels."""

from __future__ import annotations

from itertools import combinations
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

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
