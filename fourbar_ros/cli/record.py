# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar record`: record topics into a rosbag2 directory, without `ros2 bag`."""

import argparse
from pathlib import Path
import sys
import time

from fourbar_ros.cli.options import add_ros_arguments, analysis_extra
from fourbar_ros.common.output_files import check_new_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.epilog = 'Records until SIGINT (Ctrl-C) or SIGTERM.'
    parser.add_argument(
        'topics', nargs='*', metavar='TOPIC',
        help='names, absolute or relative to the namespace (default: all, also new ones)')
    parser.add_argument(
        '-o', '--output', metavar='DIR',
        help='directory to create (default: rosbag2_ and date and time, as ros2 bag names it)')
    parser.add_argument(
        '--exclude-internal', action='store_true',
        help='do not record /rosout and /parameter_events')
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Record until a signal; print the number of messages."""
    directory = Path(args.output or time.strftime('rosbag2_%Y_%m_%d-%H_%M_%S'))
    check_new_folder(directory)
    from fourbar_ros.ros.environment import check_environment
    check_environment()
    with analysis_extra():
        from fourbar_ros.operator.recorder import record
    counts = record(
        directory, args.topics, exclude_internal=args.exclude_internal,
        ros_args=args.ros_args, live=sys.stdout.isatty())
    print(f'{sum(counts.values())} messages of {len(counts)} topics in {directory}', flush=True)
    return 0
