# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The linkage: parameters, closure and branches, Kane dynamics, momentum, energy.

Conventions are those of docs/mechanics.md: links a, b, c, d in this order, link angle = angle of
the link's x axis in the table frame, wheel speed relative to its link unless called absolute.
"""

from fourbar_ros.mechanism.closure import (
    assemble,
    branch_of,
    closure_error,
    ClosureError,
    nearest_assembly,
)
from fourbar_ros.mechanism.dynamics import reduced_form, ReducedForm
from fourbar_ros.mechanism.geometry import com_positions_in_table, joint_positions
from fourbar_ros.mechanism.mechanism import (
    FLYWHEEL_NAMES,
    JOINT_LINKS,
    JOINT_NAMES,
    LINK_NAMES,
    load_mechanism,
    Mechanism,
    MechanismError,
    SENSOR_NAMES,
)
from fourbar_ros.mechanism.momentum import angular_momentum, kinetic_energy

__all__ = [
    'angular_momentum', 'assemble', 'branch_of', 'closure_error', 'ClosureError',
    'com_positions_in_table', 'FLYWHEEL_NAMES', 'JOINT_LINKS', 'JOINT_NAMES', 'joint_positions',
    'kinetic_energy', 'LINK_NAMES', 'load_mechanism', 'Mechanism', 'MechanismError',
    'nearest_assembly', 'reduced_form', 'ReducedForm', 'SENSOR_NAMES',
]
