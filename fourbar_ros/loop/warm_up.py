# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Compile every kernel before anything runs in real time."""

from __future__ import annotations

import sys

from fourbar_ros.control import Controller, ControllerSettings
from fourbar_ros.device import DeviceSupervisor, SupervisorSettings
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.estimation import Estimator, EstimatorSettings
from fourbar_ros.kernels.compiler import announced
from fourbar_ros.loop.closed_loop import ClosedLoop
from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.plant import InitialState, load_table, Plant
import numpy as np


def warm_up() -> None:
    """Run a few ticks of a closed loop; the compiled code stays in the cache."""
    mechanism = load_mechanism('paper')
    plant = Plant(mechanism, load_table('ideal'), InitialState(), 1e-3, np.random.default_rng(0))
    loop = ClosedLoop(
        DeviceSupervisor(SimulatedTable(plant, 1_000_000), SupervisorSettings()),
        Estimator(mechanism, EstimatorSettings()), Controller(mechanism, ControllerSettings()))
    for _ in range(3):
        loop.step()


def main() -> None:
    """Compile the kernels, and print a line if that takes long."""
    with announced(sys.stdout):
        warm_up()


if __name__ == '__main__':
    main()
