# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Record topics into a rosbag2 directory, without ``ros2 bag``."""

import argparse
from pathlib import Path
import sys
import time

from fourbar_ros.cli.ros import add_ros_arguments
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.output_files import check_new_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        'topics', nargs='*', metavar='TOPIC',
        help='names, absolute or relative to the namespace (default: all, also later ones)')
    parser.add_argument(
        '-o', '--output', metavar='DIR',
        help='directory to make (default: rosbag2_ and the time, as ros2 bag names it)')
    parser.add_argument(
        '--exclude-internal', action='store_true',
        help='leave out /rosout and /parameter_events')
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Record until SIGINT or SIGTERM; say how much."""
    directory = Path(args.output or time.strftime('rosbag2_%Y_%m_%d-%H_%M_%S'))
    check_new_folder(directory)
    from fourbar_ros.ros.environment import check_environment
    check_environment()
    try:
        from fourbar_ros.operator.recorder import record
    except ImportError as error:
        raise FourbarError(
            f'{error.name} is missing: pip install fourbar_ros[analysis]') from error
    counts = record(
        directory, args.topics, exclude_internal=args.exclude_internal,
        ros_args=args.ros_args, live=sys.stdout.isatty())
    print(f'{sum(counts.values())} messages of {len(counts)} topics in {directory}', flush=True)
    return 0
