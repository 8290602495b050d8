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

"""A plant that stands still unless told otherwise, with perfect sensors."""

from collections.abc import Callable

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.plant import InitialState, Plant, Table
from fourbar_ros.plant.sensors import LinkSensorSettings
from fourbar_ros.plant.table import WheelEncoders
import numpy as np
import pytest

AT_REST = InitialState()
PERFECT = Table(LinkSensorSettings(), WheelEncoders(0))


@pytest.fixture(scope='session')
def make_plant(paper: Mechanism) -> Callable[..., Plant]:
    """Return a function that makes a plant, of the paper unless another linkage is given."""
    def make(mechanism: Mechanism = paper, table: Table = PERFECT,
             initial: InitialState = AT_REST, step_s: float = 5e-4, seed: int = 0) -> Plant:
        return Plant(mechanism, table, initial, step_s, np.random.default_rng(seed))
    return make
