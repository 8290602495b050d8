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

import sys

from fourbar_ros.control import Controller, ControllerSettings
from fourbar_ros.device import SimulatedTable, Testbed, TestbedSettings
from fourbar_ros.estimation import Estimator, EstimatorSettings
from fourbar_ros.loop.closed_loop import ClosedLoop
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.mechanism.compiled import announced
from fourbar_ros.plant import InitialState, load_table, Plant
import numpy as np


def warm_up() -> None:
    """Go through a few ticks of a closed loop; the compiled code stays in the cache."""
    mechanism = load_mechanism('paper')
    plant = Plant(mechanism, load_table('ideal'), InitialState(), 1e-3, np.random.default_rng(0))
    loop = ClosedLoop(
        Testbed(SimulatedTable(plant, 1_000_000), TestbedSettings()),
        Estimator(mechanism, EstimatorSettings()), Controller(mechanism, ControllerSettings()))
    for _ in range(3):
        loop.step()


def main() -> None:
    """Compile, and say so if there is something to compile."""
    with announced(sys.stdout):
        warm_up()


if __name__ == '__main__':
    main()
