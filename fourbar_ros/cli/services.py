# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
`fourbar arm`, `disarm`, `stop`, `reset`, `enable`, `disable`, `hold`, `damp`: call one service.

The first four are the device's, the others the controller's.
"""

from __future__ import annotations

import argparse

from fourbar_ros.cli.ros import add_ros_arguments, report_verdict, testbed_client
from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError

DEVICE = {
    'arm': lambda testbed: testbed.call_set_bool(names.ARM, True),
    'disarm': lambda testbed: testbed.call_set_bool(names.ARM, False),
    'stop': lambda testbed: testbed.call_trigger(names.EMERGENCY_STOP),
    'reset': lambda testbed: testbed.call_trigger(names.RESET_EMERGENCY_STOP),
}
CONTROLLER = {
    'enable': lambda testbed: testbed.call_set_bool(names.ENABLE, True, server='controller'),
    'disable': lambda testbed: testbed.call_set_bool(names.ENABLE, False, server='controller'),
    'hold': lambda testbed: testbed.call_trigger(names.HOLD, server='controller'),
    'damp': lambda testbed: testbed.call_trigger(names.DAMP, server='controller'),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Call the service and tell the answer; exit code 1 if it is a refusal."""
    with testbed_client(args) as testbed:
        if args.command in DEVICE:
            return report_verdict(*DEVICE[args.command](testbed))
        try:
            return report_verdict(*CONTROLLER[args.command](testbed))
        except FourbarError as error:
            # The device goes on without a controller: no answer is a refusal, and not bad input.
            return report_verdict(False, f'fourbar {args.command}: {error}')
