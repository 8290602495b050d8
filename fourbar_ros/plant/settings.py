# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The settings of a simulation: where the linkage starts, and how its motion is integrated."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from fourbar_ros.common.settings import setting, Settings
from fourbar_ros.mechanism.closure import BRANCHES


@dataclass(frozen=True)
class InitialState(Settings):
    """
    The configuration at start and reset, wheels at rest relative to their links.

    Links c and d follow from the closure (docs/mechanics.md).
    """

    section = 'initial'

    link_a: float = setting(0.0, 'rad', 'orientation of link a at start and reset',
                            low=-1e6, high=1e6, live=True)
    link_b: float = setting(pi / 3, 'rad', 'orientation of link b at start and reset',
                            low=-1e6, high=1e6, live=True)
    branch: str = setting('open', '', 'assembly at start and reset', choices=BRANCHES, live=True)
    rate_a: float = setting(0.0, 'rad/s', 'rate of link a at start and reset',
                            low=-100.0, high=100.0, live=True)
    rate_b: float = setting(0.0, 'rad/s', 'rate of link b at start and reset',
                            low=-100.0, high=100.0, live=True)


@dataclass(frozen=True)
class SimulationSettings(Settings):
    """The integration step of the plant, and the seed of its random numbers."""

    step: float = setting(
        5e-4, 's', 'integration step; the period is a whole multiple of it', low=1e-6, high=0.1)
    seed: int = setting(0, '', 'of all random numbers', low=0, high=2**63 - 1)
