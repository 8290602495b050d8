# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar setpoint`: move links to new angles, and tell whether the controller accepts."""

from __future__ import annotations

import argparse
from math import isfinite, radians

from fourbar_ros.cli.ros import add_ros_arguments, report_verdict, testbed_client
from fourbar_ros.common.errors import FourbarError

EPILOG = """\
Angles are orientations in frame `table`, in rad or, with the suffix `deg`, in degrees:
    fourbar setpoint link_a=0 link_b=90deg
Two links determine the configuration. A link that is not named holds or follows. The command
waits for the controller's verdict, not for the motion, and exits with 1 if it is a refusal.
"""


class SetpointSyntaxError(FourbarError):
    """A setpoint that cannot be read."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('goals', metavar='LINK=ANGLE', nargs='+',
                        help='link_a to link_d, and an angle [rad] or with suffix deg')
    add_ros_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Send the setpoint and tell the verdict."""
    goals = [parse_goal(text) for text in args.goals]
    with testbed_client(args) as testbed:
        accepted, reason = testbed.send_setpoint(*zip(*goals))
    return report_verdict(accepted, 'accepted' if accepted else f'refused: {reason}')


def parse_goal(text: str) -> tuple[str, float]:
    """
    Read `link_b=90deg`.

    :returns: name and angle [rad]; whether the link exists is for the controller to say.
    :raises SetpointSyntaxError: not of that form, or not a finite number.
    """
    name, separator, value = text.partition('=')
    number, unit = (value[:-3], value[-3:]) if value.endswith(('deg', 'rad')) else (value, 'rad')
    try:
        angle = float(number)
    except ValueError:
        angle = float('nan')
    if not name or not separator or not isfinite(angle):
        raise SetpointSyntaxError(
            f'cannot read {text!r}: write link_a=0.5 [rad] or link_a=30deg')
    return name, radians(angle) if unit == 'deg' else angle
