# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar status`: what the device and the controller say of themselves."""

from __future__ import annotations

import argparse

from fourbar_ros.cli.ros import add_ros_arguments, REFUSED, testbed_client
from fourbar_ros.common import names

SOURCES = {'device': names.DEVICE_STATUS, 'controller': names.CONTROLLER_STATUS}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = 'Exits with 1 if no device is found.'
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print both states."""
    with testbed_client(args) as testbed:
        testbed.subscribe_statuses(*SOURCES.values())
        testbed.wait(lambda: len(testbed.statuses) == len(SOURCES), seconds=3.0)
        if testbed.has_device():
            # On a busy machine it may be seen before it is heard.
            testbed.wait(lambda: SOURCES['device'] in testbed.statuses)
        statuses = testbed.statuses
    for name, topic in SOURCES.items():
        print(name)
        for key, value in statuses.get(topic, {'state': 'not found'}).items():
            print(f'  {key:20} {value}')
    return 0 if SOURCES['device'] in statuses else REFUSED
