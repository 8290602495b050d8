# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A plant with perfect sensors, at rest by default."""

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
    """Return a function that makes a plant, by default of the linkage of the paper."""
    def make(mechanism: Mechanism = paper, table: Table = PERFECT,
             initial: InitialState = AT_REST, step_s: float = 5e-4, seed: int = 0) -> Plant:
        return Plant(mechanism, table, initial, step_s, np.random.default_rng(seed))
    return make
