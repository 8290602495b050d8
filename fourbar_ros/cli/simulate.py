# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar simulate`: one motion, or a scenario in closed loop, without ROS."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.output_files import atomic_file

EPILOG = """\
CASE.json holds mechanism, initial (link_angles, link_rates [rad, rad/s],
flywheel_speeds_absolute [rad/s]), motor_torque (amplitude [N m], frequency_hz [Hz], phase [rad];
torque = amplitude cos(2 pi frequency_hz t + phase), sampled at every stage of the integration
step) and t [s]. With wheel_angle (flywheels: names; amplitude [rad], frequency_hz, phase for each)
some wheels move relative to their links as prescribed, and need no torque.
Prints on which branch (open, crossed, folded) the linkage was, from when on.
OUT.csv gets, at the times t, the columns t, link_a..link_d [rad], rate_a..rate_d [rad/s],
flywheel_a..flywheel_d [rad/s] (absolute wheel speeds).

With --closed-loop the simulated table, the estimator and the controller run a scenario (preset
or YAML file) together, tick by tick. OUT.csv gets one row per tick: t [s] since the first one, and
all that the nodes would publish then, in rad, rad/s, N m; no number where there was nothing.
The same seed gives the same bytes.
"""


class SimulateError(FourbarError):
    """Arguments that do not go together."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('case', metavar='CASE.json', type=Path, nargs='?',
                        help='the motion to simulate')
    parser.add_argument('--closed-loop', metavar='SCENARIO',
                        help='run this scenario instead: paper, prototype or a file')
    parser.add_argument('-o', '--output', metavar='OUT.csv', type=Path, required=True,
                        help='table to write (replaced if it exists)')
    parser.add_argument('--step', metavar='S', type=float,
                        help='longest integration step of a motion [s] (default 0.001)')
    parser.add_argument('--seed', metavar='N', type=int,
                        help='of all random numbers, instead of that of the scenario')
    parser.add_argument('--duration', metavar='S', type=float,
                        help='how long to run, instead of what the scenario says [s]')


def run(args: argparse.Namespace) -> int:
    """Simulate and write the table."""
    if (args.case is None) == (args.closed_loop is None):
        raise SimulateError('give either CASE.json or --closed-loop SCENARIO')
    return _run_motion(args) if args.closed_loop is None else _run_closed_loop(args)


def _run_motion(args: argparse.Namespace) -> int:
    from fourbar_ros.kernels.compiler import announced
    from fourbar_ros.mechanism.case import CaseError, DEFAULT_STEP, load_case, simulate
    import numpy as np

    for name in ('seed', 'duration'):
        if getattr(args, name) is not None:
            raise SimulateError(f'--{name} goes with --closed-loop only')
    step = DEFAULT_STEP if args.step is None else args.step
    if not 0.0 < step < float('inf'):
        raise CaseError(f'--step must be a positive number of seconds, got {step:g}')
    case = load_case(args.case)
    with announced():
        motion = simulate(case, step)
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
    from fourbar_ros.cli.progress import show_progress
    from fourbar_ros.kernels.compiler import announced
    from fourbar_ros.loop import load_scenario, record_run
    from fourbar_ros.loop.warm_up import warm_up

    if args.step is not None:
        raise SimulateError('--step goes with CASE.json only, a scenario has plant.step')
    changes = {name: value for name in ('seed', 'duration')
               if (value := getattr(args, name)) is not None}
    scenario = replace(load_scenario(args.closed_loop), **changes)
    with atomic_file(args.output) as file:
        # Not while the bar is there, and not in the numbers per second that it shows.
        with announced():
            warm_up()
        file.writelines(record_run(scenario, show_progress).lines())
    return 0
