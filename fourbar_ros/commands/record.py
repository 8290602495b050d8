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

"""Record topics into a rosbag2 directory, without ``ros2 bag``."""

import argparse
from pathlib import Path
import sys
import time

from fourbar_ros.commands.files import check_new_folder
from fourbar_ros.commands.ros import add_ros_arguments
from fourbar_ros.errors import FourbarError


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
    from fourbar_ros.nodes.environment import check_environment
    check_environment()
    try:
        from fourbar_ros.nodes.recorder import record
    except ImportError as error:
        raise FourbarError(
            f'{error.name} is missing: pip install fourbar_ros[analysis]') from error
    counts = record(
        directory, args.topics, exclude_internal=args.exclude_internal,
        ros_args=args.ros_args, live=sys.stdout.isatty())
    print(f'{sum(counts.values())} messages of {len(counts)} topics in {directory}', flush=True)
    return 0
