# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar setpoint`: move links to new angles, and report whether the controller accepts."""

from __future__ import annotations

import argparse
from math import isfinite, radians

from fourbar_ros.cli.options import add_ros_arguments, print_response, testbed_client
from fourbar_ros.common.errors import FourbarError

EPILOG = """\
Angles are orientations in frame `table`, in rad or, with the suffix `deg`, in degrees:
    fourbar setpoint link_a=0 link_b=90deg
Two links determine the configuration. A link without a setpoint holds or follows. The command
waits for the response of the controller, not for the motion. Exit code 1: the setpoint is refused.
"""


class SetpointSyntaxError(FourbarError):
    """A setpoint that is not of the form LINK=ANGLE; `values` hold `value`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('goals', metavar='LINK=ANGLE', nargs='+',
                        help='link_a to link_d, and an angle [rad] or with suffix deg')
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Send the setpoint and print the response."""
    goals = [parse_goal(text) for text in args.goals]
    with testbed_client(args) as testbed:
        accepted, reason = testbed.send_setpoint(*zip(*goals))
    return print_response(accepted, 'accepted' if accepted else f'refused: {reason}')


def parse_goal(text: str) -> tuple[str, float]:
    """
    Parse a goal such as `link_b=90deg`.

    :returns: name and angle [rad]; the controller checks the name.
    :raises SetpointSyntaxError: another form, or no finite number.
    """
    name, separator, value = text.partition('=')
    digits, unit = (value[:-3], value[-3:]) if value.endswith(('deg', 'rad')) else (value, 'rad')
    try:
        angle = float(digits)
    except ValueError:
        angle = float('nan')
    if not name or not separator or not isfinite(angle):
        raise SetpointSyntaxError(
            f'cannot read {text!r}: write link_a=0.5 [rad] or link_a=30deg', value=text)
    return name, radians(angle) if unit == 'deg' else angle
