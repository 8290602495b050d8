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

"""`fourbar status`: what the device and the controller say of themselves."""

from __future__ import annotations

import argparse

from fourbar_ros.commands.ros import add_ros_arguments, REFUSED, testbed_client

SOURCES = {'device': 'device_status', 'controller': 'controller_status'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = 'Exits with 1 if no device is found.'
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print both states."""
    with testbed_client(args) as testbed:
        testbed.follow(*SOURCES.values())
        testbed.wait(lambda: len(testbed.statuses) == len(SOURCES), seconds=3.0)
        if testbed.device_visible():
            # On a busy machine it may be seen before it is heard.
            testbed.wait(lambda: SOURCES['device'] in testbed.statuses)
        statuses = testbed.statuses
    for name, topic in SOURCES.items():
        print(name)
        for key, value in statuses.get(topic, {'state': 'not found'}).items():
            print(f'  {key:20} {value}')
    return 0 if SOURCES['device'] in statuses else REFUSED
