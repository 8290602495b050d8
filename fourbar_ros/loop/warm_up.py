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

"""Compile every kernel before anything runs in real time."""

from __future__ import annotations

import numpy as np

from ..control import Controller, ControllerSettings
from ..device import SimulatedTable, Testbed, TestbedSettings
from ..estimation import Estimator, EstimatorSettings
from ..mechanism import Mechanism
from ..mechanism.compiled import cache_directory
from ..plant import InitialState, Plant
from ..plant.table import LinkSensors, Table, WheelEncoders
from .closed_loop import ClosedLoop


def is_cold() -> bool:
    """Tell whether the kernels are still to be compiled, which takes some ten seconds."""
    directory = cache_directory()
    return directory is None or not any(directory.rglob('*linearise*.nbi'))


def warm_up() -> None:
    """Go through a few ticks of a closed loop; the compiled code stays in the cache."""
    mechanism = Mechanism(  # type: ignore[arg-type]
        [0.1] * 4, [0.02] * 4, [2.2e-5] * 4, [[0.05, 0.0]] * 4, [3.4e-7] * 4)
    plant = Plant(mechanism, Table(LinkSensors(0.0, 0), WheelEncoders(0)), InitialState(), 1e-3,
                  np.random.default_rng(0))
    loop = ClosedLoop(
        Testbed(SimulatedTable(plant, 1_000_000), TestbedSettings()),
        Estimator(mechanism, EstimatorSettings()), Controller(mechanism, ControllerSettings()))
    for _ in range(3):
        loop.step()
