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

"""Device, estimator and controller stepped in one process, without ROS."""

from fourbar_ros.loop.closed_loop import ClosedLoop, Step
from fourbar_ros.loop.recording import Recording
from fourbar_ros.loop.run import make_loop, record_run, run_scenario, RunError
from fourbar_ros.loop.scenario import load_scenario, Scenario, ScenarioError, ScriptedSetpoint

__all__ = [
    'ClosedLoop', 'load_scenario', 'make_loop', 'record_run', 'Recording', 'run_scenario',
    'RunError', 'Scenario', 'ScenarioError', 'ScriptedSetpoint', 'Step',
]
