# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar calibrate`: encoders, wheels and links of a device, over its topics or from a bag."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
from pathlib import Path
import sys
import time
from typing import Any

from fourbar_ros.cli.progress import show_progress
from fourbar_ros.cli.ros import add_ros_arguments, testbed_client
from fourbar_ros.cli.setpoint import parse_goal
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.output_files import (
    atomic_folder,
    check_file,
    check_new_folder,
    OutputError,
    write_files,
)
from fourbar_ros.mechanism import FLYWHEEL_NAMES, load_mechanism, Mechanism

EPILOG = """\
encoders  zeros of the link encoders: links rest in a jig at a known pose, device disarmed
wheels    inertia and bearing friction of each wheel: spun up both ways and let coast
links     inertias and mass centres of the links: all wheels to and fro, links free on the table
In this order: links needs the inertias of the wheels, and both want true angles. Wheels and links
drive the device themselves: no controller may run, and they ask before. What comes is recorded;
--bag evaluates such a recording, or any that holds link_angles and flywheel_states.
Exits with 1 when an interval is wider than 1 %.
"""


class CalibrateError(FourbarError):
    """A calibration that is not asked for in a way that can be done."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the three calibrations and their options."""
    parser.epilog = EPILOG
    kinds = parser.add_subparsers(dest='kind', metavar='KIND', required=True, title='kinds')
    encoders = kinds.add_parser('encoders', help='zeros of the link encoders')
    encoders.add_argument(
        '--pose', metavar='LINK=ANGLE', nargs='+', required=True,
        help='where the links are, two at least [rad] or with suffix deg; closure gives the '
             'others')
    encoders.add_argument('--duration', metavar='S', type=_positive, default=10.0,
                          help='how long to listen [s] (default 10)')
    wheels = kinds.add_parser('wheels', help='inertia and bearing friction of the wheels')
    wheels.add_argument('--wheels', metavar='WHEEL', nargs='+', choices=FLYWHEEL_NAMES,
                        help='which, one after the other (default all)')
    wheels.add_argument('--speed', metavar='RAD/S', type=_positive, default=100.0,
                        help='up to which they are spun [rad/s] (default 100)')
    wheels.add_argument('--coast', metavar='S', type=_positive, default=10.0,
                        help='longest coast-down [s] (default 10)')
    wheels.add_argument('--report', metavar='YAML', type=Path,
                        help='report to write (default calibration_report.yaml)')
    links = kinds.add_parser('links', help='inertias and mass centres of the links')
    links.add_argument('--duration', metavar='S', type=_positive, default=30.0,
                       help='of the excitation [s] (default 30)')
    for drives in (wheels, links):
        drives.add_argument('--torque', metavar='N_M', type=_positive,
                            help='largest torque of a wheel [N m] (default 40 %% of its limit)')
        drives.add_argument('--yes', action='store_true',
                            help='the wheels may turn, do not ask')
        drives.add_argument('--figure', metavar='FILE', type=Path,
                            help='picture of fit and residuals to write (.png or .svg)')
    for kind in (encoders, wheels, links):
        kind.add_argument('--bag', metavar='DIR', type=Path,
                          help='evaluate this rosbag2 directory, and drive nothing')
        kind.add_argument('--record', metavar='DIR', type=Path,
                          help='rosbag2 directory to make (default calibrate_KIND_ and the time)')
        kind.add_argument('--mechanism', metavar='NAME_OR_PATH',
                          help='mechanism preset or file (default: what the device says)')
        kind.add_argument('--namespace', metavar='NS',
                          help='namespace of the suite in the bag, where it holds more than one')
        kind.add_argument('-o', '--output', metavar='FILE', type=Path,
                          help='mechanism file to write, with what was found')
        kind.add_argument('--force', action='store_true', help='overwrite files')
        kind.add_argument('--json', metavar='FILE', type=Path,
                          help='checks and numbers to write, units in their names')
        add_ros_arguments(kind)


def run(args: argparse.Namespace) -> int:
    """Drive or read, estimate, print, write; exit code 1 where an interval is too wide."""
    try:
        import matplotlib  # noqa: F401
        import rosbags  # noqa: F401
        import tqdm  # noqa: F401
    except ImportError as error:
        raise FourbarError(
            f'{error.name} is missing: pip install fourbar_ros[analysis]') from error
    from fourbar_ros.analysis.bags import read_bag
    from fourbar_ros.analysis.calibration.outcome import mechanism_name_in
    from fourbar_ros.common.checks import print_checks
    from fourbar_ros.kernels.compiler import announced

    # Before the work, not after it.
    pose = _pose(args)
    _check_outputs(args)
    if args.mechanism is not None:
        load_mechanism(args.mechanism)
    bag = args.bag
    if bag is None:
        bag = _experiment(args)
        print(f'recorded in {bag}', file=sys.stderr)
    recording = read_bag(bag, args.namespace, show_progress)
    name = args.mechanism or mechanism_name_in(recording)
    mechanism = load_mechanism(name)
    with announced():
        outcome = _evaluate(args, recording, mechanism, pose)
    print(outcome.text)
    print_checks(outcome.checks)
    for path in _write(args, outcome, name, bag):
        print(path)
    return 0 if all(check.passed for check in outcome.checks) else 1


def _evaluate(args: argparse.Namespace, recording: Any, mechanism: Mechanism,
              pose: dict[str, float]) -> Any:
    from fourbar_ros.analysis.calibration import outcome

    if args.kind == 'encoders':
        return outcome.encoders_outcome(recording, mechanism, pose)
    if args.kind == 'wheels':
        chosen = args.wheels and [FLYWHEEL_NAMES.index(name) for name in args.wheels]
        return outcome.wheels_outcome(recording, mechanism, chosen)
    return outcome.links_outcome(recording, mechanism)


def _pose(args: argparse.Namespace) -> dict[str, float]:
    """Read the pose of the jig; each link once."""
    pose: dict[str, float] = {}
    for name, angle in map(parse_goal, args.pose if args.kind == 'encoders' else ()):
        if name in pose:
            raise CalibrateError(f'{name} is named twice in the pose')
        pose[name] = angle
    if args.kind == 'encoders':
        from fourbar_ros.analysis.calibration.encoders import check_names
        check_names(pose)
    return pose


def _files(args: argparse.Namespace) -> list[Path]:
    """Return the files that are going to be written, the report by its default name."""
    if args.kind == 'wheels' and args.report is None:
        args.report = Path('calibration_report.yaml')
    return [path for path in (
        args.output, args.json, getattr(args, 'figure', None), getattr(args, 'report', None))
        if path is not None]


def _check_outputs(args: argparse.Namespace) -> None:
    for path in _files(args):
        if path.exists() and not args.force:
            raise OutputError(f'{path} exists already: choose another name or give --force')
        check_file(path)
    figure = getattr(args, 'figure', None)
    if figure is not None and figure.suffix not in ('.png', '.svg'):
        raise OutputError(f'cannot write {figure}: a picture is .png or .svg')
    if args.bag is None:
        if args.record is None:
            args.record = Path(time.strftime(f'calibrate_{args.kind}_%Y_%m_%d-%H_%M_%S'))
        check_new_folder(args.record)


def _experiment(args: argparse.Namespace) -> Path:
    """
    Let the device do what is to be recorded.

    :returns: the bag.
    :raises FourbarError: nobody said yes, or the device did not do it.
    """
    if args.kind != 'encoders':
        _confirm(args)
    # A client first: it tells what is wrong with ROS before anything of it is imported.
    with testbed_client(args) as testbed:
        from fourbar_ros.operator.experiment import Experiment

        experiment = Experiment(testbed)
        name = experiment.wait_for_device()
        if args.kind == 'encoders':
            with _progress(args.duration) as progress:
                experiment.record_at_rest(args.duration, progress)
        else:
            excitation = _excitation(args, load_mechanism(args.mechanism or name))
            with _progress(excitation.duration_s) as progress:
                experiment.drive(excitation, progress)
        with atomic_folder(args.record) as folder:
            experiment.write(folder)
    return Path(args.record)


def _confirm(args: argparse.Namespace) -> None:
    if args.yes:
        return
    if not sys.stdin.isatty():
        raise CalibrateError('the wheels are going to turn: say so with --yes')
    answer = input('The device will be armed and its wheels will turn. Write yes to go on: ')
    if answer.strip().lower() != 'yes':
        raise CalibrateError('nothing was driven')


def _excitation(args: argparse.Namespace, mechanism: Mechanism) -> Any:
    from fourbar_ros.analysis.calibration.excitation import (
        MultiSine,
        SpinAndCoast,
        TORQUE_SHARE,
    )

    limit = float(mechanism.motor_torque_limits.min())
    torque = TORQUE_SHARE * limit if args.torque is None else args.torque
    if not torque < float('inf'):
        raise CalibrateError('the mechanism file has no motor_torque_limits: give --torque')
    if args.kind == 'links':
        return MultiSine(mechanism, args.duration, torque)
    wheels = [FLYWHEEL_NAMES.index(name) for name in args.wheels or FLYWHEEL_NAMES]
    return SpinAndCoast(mechanism, wheels, args.speed, torque, args.coast)


@contextmanager
def _progress(total_s: float) -> Iterator[Callable[[float], None]]:
    """Show seconds on stderr, where that is a terminal."""
    from tqdm import tqdm

    with tqdm(total=round(total_s, 1), unit='s', disable=None, leave=False, file=sys.stderr,
              bar_format='{l_bar}{bar}| {n:.1f}/{total:.1f} s') as bar:
        def show(elapsed_s: float) -> None:
            bar.update(min(elapsed_s, total_s) - bar.n)
        yield show


def _write(args: argparse.Namespace, outcome: Any, name: str, bag: Path) -> list[Path]:
    """Write the files that are asked for, each whole or not at all."""
    from fourbar_ros.analysis.calibration.mechanism_file import mechanism_text, notes_of
    from fourbar_ros.common.checks import checks_as_json
    from fourbar_ros.common.config_files import config_file

    when = time.strftime('%Y-%m-%d %H:%M')
    contents: dict[Path, str | bytes] = {}
    if args.output is not None:
        note = f'{outcome.note}, {when}, from {bag.absolute().name}'
        contents[args.output] = mechanism_text(
            outcome.mechanism, [*notes_of(config_file('mechanism', name)), note])
    if outcome.report:
        import yaml

        contents[args.report] = yaml.safe_dump(
            {'calibrated': when, 'bag': bag.absolute().name, 'mechanism': name,
             **outcome.report}, sort_keys=False)
    if args.json is not None:
        document = {'calibration': args.kind, 'bag': str(bag), 'mechanism': name,
                    'checks': checks_as_json(outcome.checks), **outcome.data}
        contents[args.json] = json.dumps(document, indent=2, allow_nan=False) + '\n'
    if getattr(args, 'figure', None) is not None and outcome.figure is not None:
        from fourbar_ros.analysis.calibration.figure import rendered

        contents[args.figure] = rendered(outcome.figure, args.figure.suffix[1:])
    write_files(contents)
    return list(contents)


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'must be a positive number, got {text}')
    return value
