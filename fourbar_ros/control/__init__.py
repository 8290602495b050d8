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

"""What we want and how the wheels share it: references, tracking law, allocation."""

from fourbar_ros.control.controller import Control, Controller
from fourbar_ros.control.drive import WheelCommand
from fourbar_ros.control.setpoint import SetpointError
from fourbar_ros.control.settings import ControllerSettings
from fourbar_ros.control.stability import GainError
from fourbar_ros.control.trajectory import Point

__all__ = [
    'Control', 'Controller', 'ControllerSettings', 'GainError', 'Point', 'SetpointError',
    'WheelCommand',
]
