# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Commands that call one service of the device, the controller or the simulated table."""

from __future__ import annotations

import argparse

from fourbar_ros.cli.options import add_ros_arguments, print_response, testbed_client
from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError

# Service of each command, and the request of a SetBool service (None: a Trigger service).
DEVICE = {
    'arm': (names.ARM, True),
    'disarm': (names.ARM, False),
    'stop': (names.EMERGENCY_STOP, None),
    'reset': (names.RESET_EMERGENCY_STOP, None),
}
CONTROLLER = {
    'enable': (names.ENABLE, True),
    'disable': (names.ENABLE, False),
    'hold': (names.HOLD, None),
    'damp': (names.DAMP, None),
}
SIM = {
    'pause': (names.SIM_PAUSE, True),
    'resume': (names.SIM_PAUSE, False),
    'step': (names.SIM_STEP, None),
    'reset': (names.SIM_RESET, None),
}

SIM_EPILOG = """\
pause    stop ticks and time; the wheels stay armed, and no timeout elapses
resume   continue
step     one tick while paused, for one control period
reset    linkage to the parameters initial.* of the plant, and disarm; time continues
Exit code 1: the table refuses. Times in responses are stamps [s].
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments; `sim` also has an action."""
    if parser.prog.split()[-1] == 'sim':
        parser.epilog = SIM_EPILOG
        parser.add_argument('action', choices=list(SIM), help='see below')
    else:
        parser.epilog = 'Exit code 1: the request is refused.'
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Call the service and print the response; exit code 1 for a refusal."""
    with testbed_client(args) as testbed:
        def call(service: str, request: bool | None, server: str = 'device') -> int:
            return print_response(*(
                testbed.call_trigger(service, server=server) if request is None
                else testbed.call_set_bool(service, request, server=server)))

        if args.command == 'sim':
            return call(*SIM[args.action])
        if args.command in DEVICE:
            return call(*DEVICE[args.command])
        try:
            return call(*CONTROLLER[args.command], server='controller')
        except FourbarError as error:
            # The device runs without a controller: a missing response is a refusal, exit code 1.
            return print_response(False, f'fourbar {args.command}: {error}')
