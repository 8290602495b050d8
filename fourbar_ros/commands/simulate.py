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

"""`fourbar simulate`: integrate the motion that a case file describes, without ROS."""

from __future__ import annotations

import argparse
from pathlib import Path

EPILOG = """\
CASE.json holds mechanism, initial (link_angles, link_rates [rad, rad/s],
flywheel_speeds_absolute [rad/s]), motor_torque (amplitude [N m], frequency_hz [Hz], phase [rad];
torque = amplitude cos(2 pi frequency_hz t + phase), sampled at every stage of the integration
step) and t [s].
OUT.csv gets, at the times t, the columns t, link_a..link_d [rad], rate_a..rate_d [rad/s],
flywheel_a..flywheel_d [rad/s] (absolute wheel speeds).
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('case', metavar='CASE.json', type=Path, help='the motion to simulate')
    parser.add_argument('-o', '--output', metavar='OUT.csv', type=Path, required=True,
                        help='table to write (replaced if it exists)')
    parser.add_argument('--step', metavar='S', type=float, default=1e-3,
                        help='longest integration step [s] (default 0.001)')


def run(args: argparse.Namespace) -> int:
    """Simulate and write the table."""
    from fourbar_ros.commands.files import write_whole
    from fourbar_ros.mechanism.case import CaseError, load_case, simulate
    import numpy as np

    if not 0.0 < args.step < float('inf'):
        raise CaseError(f'--step must be a positive number of seconds, got {args.step:g}')
    motion = simulate(load_case(args.case), args.step)
    table = np.column_stack([
        motion.times, motion.link_angles, motion.link_rates, motion.flywheel_speeds_absolute])
    header = ','.join(['t', *(f'{kind}_{link}' for kind in ('link', 'rate', 'flywheel')
                              for link in 'abcd')])
    with write_whole(args.output) as file:
        np.savetxt(file, table, fmt='%.15g', delimiter=',', header=header, comments='')
    return 0
