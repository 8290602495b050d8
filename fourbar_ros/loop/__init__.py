# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Device, estimator and controller stepped in one process, without ROS."""

from fourbar_ros.loop.closed_loop import ClosedLoop, Step
from fourbar_ros.loop.run import make_loop, record_run, run_scenario, RunError
from fourbar_ros.loop.run_record import RunRecord
from fourbar_ros.loop.scenario import load_scenario, Scenario, ScenarioError, ScriptedSetpoint

__all__ = [
    'ClosedLoop', 'load_scenario', 'make_loop', 'record_run', 'run_scenario',
    'RunError', 'RunRecord', 'Scenario', 'ScenarioError', 'ScriptedSetpoint', 'Step',
]
