# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

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
    from fourbar_ros.ros.environment import check_environment
    check_environment()
    from fourbar_ros.operator.client import TestbedClient
    return TestbedClient(['--ros-args', *args.ros_args] if args.ros_args else [])


def report_verdict(success: bool, message: str) -> int:
    """Print an answer, on stderr if it is a refusal, and return the exit code."""
    print(message, file=sys.stdout if success else sys.stderr)
    return 0 if success else REFUSED
