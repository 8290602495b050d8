# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
What the linkage is: parameters, closure and branches, Kane dynamics, momentum, energy.

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
from fourbar_ros.mechanism.dynamics import (
    angular_momentum,
    kinetic_energy,
    reduced_form,
    ReducedForm,
)
from fourbar_ros.mechanism.geometry import com_positions_in_table, joint_positions
from fourbar_ros.mechanism.parameters import (
    FLYWHEEL_NAMES,
    JOINT_LINKS,
    JOINT_NAMES,
    LINK_NAMES,
    load_mechanism,
    Mechanism,
    MechanismError,
    SENSOR_NAMES,
)

__all__ = [
    'angular_momentum', 'assemble', 'branch_of', 'closure_error', 'ClosureError',
    'com_positions_in_table', 'FLYWHEEL_NAMES', 'JOINT_LINKS', 'JOINT_NAMES', 'joint_positions',
    'kinetic_energy', 'LINK_NAMES', 'load_mechanism', 'Mechanism', 'MechanismError',
    'nearest_assembly', 'reduced_form', 'ReducedForm', 'SENSOR_NAMES',
]
