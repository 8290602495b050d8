# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar status`: show the states of device and controller."""

from __future__ import annotations

import argparse

from fourbar_ros.cli.options import add_ros_arguments, FAILED, testbed_client
from fourbar_ros.common import names

SOURCES = {'device': names.DEVICE_STATUS, 'controller': names.CONTROLLER_STATUS}
# Time to wait for both states [s].
SEARCH_S = 3.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = 'Exit code 1: no device was found.'
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Print both states."""
    with testbed_client(args) as testbed:
        testbed.subscribe_statuses(*SOURCES.values())
        testbed.wait(lambda: len(testbed.statuses) == len(SOURCES), seconds=SEARCH_S)
        if testbed.has_device():
            # On a loaded machine discovery precedes the first message by seconds.
            testbed.wait(lambda: SOURCES['device'] in testbed.statuses)
        statuses = testbed.statuses
    for name, topic in SOURCES.items():
        print(name)
        for key, value in statuses.get(topic, {'state': 'not found'}).items():
            print(f'  {key:20} {value}')
    return 0 if SOURCES['device'] in statuses else FAILED
