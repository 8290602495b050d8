# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar simulate`: one motion, or a scenario in closed loop, without ROS."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from fourbar_ros.cli.options import add_number, show_progress
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.output_files import atomic_file

EPILOG = """\
CASE.json contains mechanism, initial (link_angles, link_rates [rad, rad/s],
flywheel_speeds_absolute [rad/s]), motor_torque (amplitude [N m], frequency_hz [Hz], phase [rad];
torque = amplitude cos(2 pi frequency_hz t + phase), evaluated at every stage of the integration
step) and t [s]. With wheel_angle (flywheels: names; amplitude [rad], frequency_hz, phase of each)
the motion of some wheels relative to their links is prescribed; these have no motor_torque.
The command prints the branch of the linkage (open, crossed, folded) and the times of its changes.
OUT.csv has, at the times t, the columns t, link_a..link_d [rad], rate_a..rate_d [rad/s],
flywheel_a..flywheel_d [rad/s] (absolute wheel speeds).

--closed-loop runs a scenario (preset or YAML file) with simulated table, estimator and
controller, tick by tick. OUT.csv has one row per tick: t [s] since the first tick, and the values
that the nodes would publish, in rad, rad/s, N m; a missing value is empty.
Equal seeds give equal files.
"""


class SimulateError(FourbarError):
    """Arguments that exclude each other; `values` hold `name`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('case', metavar='CASE.json', type=Path, nargs='?',
                        help='file of the motion')
    parser.add_argument('--closed-loop', metavar='SCENARIO',
                        help='run a scenario instead: paper, prototype or a file')
    parser.add_argument('-o', '--output', metavar='OUT.csv', type=Path, required=True,
                        help='table to write (an existing file is replaced)')
    add_number(parser, '--step', 'S', 's', 'largest integration step of a motion, default 0.001',
               above=0.0)
    parser.add_argument('--seed', metavar='N', type=int,
                        help='seed of all random numbers, in place of that of the scenario')
    parser.add_argument('--duration', metavar='S', type=float,
                        help='duration, in place of that of the scenario [s]')


def run(args: argparse.Namespace) -> int:
    """Simulate and write the table."""
    if (args.case is None) == (args.closed_loop is None):
        raise SimulateError('give either CASE.json or --closed-loop SCENARIO', name='case')
    return _run_motion(args) if args.closed_loop is None else _run_closed_loop(args)


def _run_motion(args: argparse.Namespace) -> int:
    from fourbar_ros.kernels.compiler import announced
    from fourbar_ros.mechanism.case import DEFAULT_STEP, load_case, simulate
    import numpy as np

    for name in ('seed', 'duration'):
        if getattr(args, name) is not None:
            raise SimulateError(f'--{name} requires --closed-loop', name=name)
    case = load_case(args.case)
    with announced():
        motion = simulate(case, DEFAULT_STEP if args.step is None else args.step)
    table = np.column_stack([
        motion.times, motion.link_angles, motion.link_rates, motion.flywheel_speeds_absolute])
    header = ','.join(['t', *(f'{kind}_{link}' for kind in ('link', 'rate', 'flywheel')
                              for link in 'abcd')])
    with atomic_file(args.output) as file:
        np.savetxt(file, table, fmt='%.15g', delimiter=',', header=header, comments='')
    print('branch: ' + ', '.join(
        f'{branch} from t = {time:g} s' for time, branch in motion.branches()))
    return 0


def _run_closed_loop(args: argparse.Namespace) -> int:
    from fourbar_ros.kernels.compiler import announced
    from fourbar_ros.loop import load_scenario, record_run
    from fourbar_ros.loop.warm_up import warm_up

    if args.step is not None:
        raise SimulateError('--step requires CASE.json; a scenario has plant.step', name='step')
    changes = {name: value for name in ('seed', 'duration')
               if (value := getattr(args, name)) is not None}
    scenario = replace(load_scenario(args.closed_loop), **changes)
    with atomic_file(args.output) as file:
        # Before the progress bar, which shows the rate.
        with announced():
            warm_up()
        file.writelines(record_run(scenario, show_progress).lines())
    return 0
