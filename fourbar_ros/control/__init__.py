# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What we want and how the wheels share it: references, tracking law, allocation."""

from fourbar_ros.control.controller import Control, Controller
from fourbar_ros.control.setpoint import SetpointError
from fourbar_ros.control.settings import ControllerSettings
from fourbar_ros.control.stability import GainError
from fourbar_ros.control.trajectory import Point
from fourbar_ros.control.wheel_command import WheelCommand

__all__ = [
    'Control', 'Controller', 'ControllerSettings', 'GainError', 'Point', 'SetpointError',
    'WheelCommand',
]
