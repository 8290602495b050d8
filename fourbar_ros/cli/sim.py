# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar sim`: let the time of the simulated table stand still, go on, or start over."""

from __future__ import annotations

import argparse

from fourbar_ros.cli.ros import add_ros_arguments, report_verdict, testbed_client
from fourbar_ros.common import names

CALLS = {
    'pause': lambda testbed: testbed.call_set_bool(names.SIM_PAUSE, True),
    'resume': lambda testbed: testbed.call_set_bool(names.SIM_PAUSE, False),
    'step': lambda testbed: testbed.call_trigger(names.SIM_STEP),
    'reset': lambda testbed: testbed.call_trigger(names.SIM_RESET),
}

EPILOG = """\
pause    no more ticks, time stands still; the wheels stay armed, and nothing times out
resume   go on from there
step     one tick while paused, for one control period
reset    the linkage to the parameters initial.* of the plant, and disarm; time goes on
Exits with 1 if the table refuses. Times in the answers are stamps [s].
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('action', choices=list(CALLS), help='what to do')
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Call the service and tell the answer; exit code 1 if it is a refusal."""
    with testbed_client(args) as testbed:
        return report_verdict(*CALLS[args.action](testbed))
