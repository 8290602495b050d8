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

"""Linkages and controllers that wait for something to do."""

from __future__ import annotations

from collections.abc import Callable

from fourbar_ros.control import Control, Controller, ControllerSettings
from fourbar_ros.mechanism import assemble, Mechanism
import numpy as np
from numpy.typing import NDArray
import pytest

Array = NDArray[np.float64]
PERIOD_NS = 4_000_000


class Driven:
    """A controller on a linkage that follows its reference without error."""

    def __init__(self, mechanism: Mechanism, phi_a: float, phi_b: float, branch: str,
                 settings: ControllerSettings) -> None:
        self.controller = Controller(mechanism, settings)
        self.angles: Array = assemble(mechanism, phi_a, phi_b, branch)
        self.rates: Array = np.zeros(4)
        self.stamp_ns = 1_000_000_000

    def tick(self) -> Control:
        """Go on by one tick, and let the links do what they are told."""
        self.stamp_ns += PERIOD_NS
        control = self.controller.tick(
            self.stamp_ns, self.angles, self.rates, np.zeros(2), np.zeros(4), np.zeros(4))
        self.angles, self.rates = control.reference_angles, control.reference_rates
        return control


@pytest.fixture(scope='session')
def drive(paper: Mechanism) -> Callable[..., Driven]:
    """Return a function that makes a controller, armed and ticked once unless told."""
    def make(mechanism: Mechanism = paper, phi_a: float = 0.0, phi_b: float = np.pi / 3,
             branch: str = 'open', armed: bool = True, **settings: float) -> Driven:
        driven = Driven(mechanism, phi_a, phi_b, branch, ControllerSettings(**settings))
        if armed:
            driven.controller.device_armed(True)
            driven.tick()
        return driven
    return make
