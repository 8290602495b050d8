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

"""What the commands that talk to running nodes have in common."""

from __future__ import annotations

import argparse
import sys
from typing import Any

REFUSED = 1


def add_ros_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--ros-args`."""
    parser.add_argument(
        '--ros-args', nargs=argparse.REMAINDER, default=[],
        help='ROS arguments, for instance -r __ns:=/lab')


def testbed_client(args: argparse.Namespace) -> Any:
    """
    Make the operator's node.

    :raises RosError: there is no usable ROS.
    """
    from fourbar_ros.nodes.environment import check_environment
    check_environment()
    from fourbar_ros.nodes.client import TestbedClient
    return TestbedClient(['--ros-args', *args.ros_args] if args.ros_args else [])


def report_verdict(success: bool, message: str) -> int:
    """Print an answer, on stderr if it is a refusal, and return the exit code."""
    print(message, file=sys.stdout if success else sys.stderr)
    return 0 if success else REFUSED
