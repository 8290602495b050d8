# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar calibrate`: encoders, wheels and links of a device, over its topics or from a bag."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
from math import isfinite
from pathlib import Path
import sys
import time
from typing import Any

from fourbar_ros.cli.options import (
    add_bag_options,
    add_number,
    add_ros_arguments,
    analysis_extra,
    FAILED,
    show_progress,
    testbed_client,
)
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
encoders  offsets of the link encoders: links at rest in a jig at a known pose, device disarmed
wheels    inertia and bearing friction of each wheel: spin-up and coast-down in both directions
links     inertias and mass centres of the links: multi-sine of all wheels, links free to move
Use this order: links requires the inertias of the wheels, and both require true angles. Wheels
and links drive the device after a confirmation; no controller may run. The measurements are
recorded. --bag evaluates such a recording, or any bag with link_angles and flywheel_states.
Exit code 1: an interval is wider than 1 %.
"""


class CalibrateError(FourbarError):
    """Arguments that do not allow a calibration; `values` hold `name`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the three calibrations and their options."""
    parser.epilog = EPILOG
    kinds = parser.add_subparsers(dest='kind', metavar='KIND', required=True, title='kinds')
    encoders = kinds.add_parser('encoders', help='offsets of the link encoders')
    encoders.add_argument(
        '--pose', metavar='LINK=ANGLE', nargs='+', required=True,
        help='angles of at least two links [rad] or with suffix deg; closure gives the others')
    add_number(encoders, '--duration', 'S', 's', 'duration of the recording', 10.0, above=0.0)
    wheels = kinds.add_parser('wheels', help='inertia and bearing friction of the wheels')
    wheels.add_argument('--wheels', metavar='WHEEL', nargs='+', choices=FLYWHEEL_NAMES,
                        help='wheels to identify, one after the other (default all)')
    add_number(wheels, '--speed', 'RAD/S', 'rad/s', 'speed after a spin-up', 100.0, above=0.0)
    add_number(wheels, '--coast', 'S', 's', 'longest coast-down', 10.0, above=0.0)
    wheels.add_argument('--report', metavar='YAML', type=Path,
                        default=Path('calibration_report.yaml'),
                        help='report to write (default calibration_report.yaml)')
    links = kinds.add_parser('links', help='inertias and mass centres of the links')
    add_number(links, '--duration', 'S', 's', 'duration of the excitation', 30.0, above=0.0)
    for kind in (wheels, links):
        add_number(kind, '--torque', 'N_M', 'N m', 'largest torque of a wheel, default 40 %% of '
                   'its limit', above=0.0)
        kind.add_argument('--yes', action='store_true',
                          help='drive the wheels without confirmation')
        kind.add_argument('--figure', metavar='FILE', type=Path,
                          help='figure of fit and residuals to write (.png or .svg)')
    for kind in (encoders, wheels, links):
        kind.add_argument('--bag', metavar='DIR', type=Path,
                          help='evaluate this rosbag2 directory, drive nothing')
        kind.add_argument('--record', metavar='DIR', type=Path, help='rosbag2 directory to '
                          'create (default calibrate_KIND_ and date and time)')
        add_bag_options(kind, 'that of device_status')
        kind.add_argument('-o', '--output', metavar='FILE', type=Path,
                          help='mechanism file to write, with the estimates')
        kind.add_argument('--force', action='store_true', help='overwrite existing files')
        kind.add_argument('--json', metavar='FILE', type=Path,
                          help='file to write: checks and estimates, with units in names')
        add_ros_arguments(kind)
    encoders.set_defaults(figure=None, report=None)
    links.set_defaults(report=None)


def run(args: argparse.Namespace) -> int:
    """Drive or read, estimate, print, write; exit code 1 if an interval is too wide."""
    with analysis_extra():
        import matplotlib  # noqa: F401
        import rosbags  # noqa: F401
        import tqdm  # noqa: F401
    from fourbar_ros.analysis.bags import read_bag
    from fourbar_ros.analysis.calibration import evaluation
    from fourbar_ros.common.checks import print_checks
    from fourbar_ros.kernels.compiler import announced

    # Check all inputs before the work.
    pose = _pose(args.pose) if args.kind == 'encoders' else {}
    _check_outputs(args)
    if args.mechanism is not None:
        load_mechanism(args.mechanism)
    path = args.bag
    if path is None:
        path = _run_experiment(args)
        print(f'recorded in {path}', file=sys.stderr)
    bag = read_bag(path, args.namespace, show_progress)
    name = args.mechanism or evaluation.recorded_mechanism(bag)
    mechanism = load_mechanism(name)
    with announced():
        if args.kind == 'encoders':
            result = evaluation.calibrate_encoders(bag, mechanism, pose)
        elif args.kind == 'wheels':
            result = evaluation.calibrate_wheels(bag, mechanism, _indices(args.wheels))
        else:
            result = evaluation.calibrate_links(bag, mechanism)
    print(result.text)
    print_checks(result.checks)
    for file in _write(args, result, name, path):
        print(file)
    return 0 if all(check.passed for check in result.checks) else FAILED


def _indices(wheels: list[str] | None) -> list[int] | None:
    return None if wheels is None else [FLYWHEEL_NAMES.index(name) for name in wheels]


def _pose(goals: list[str]) -> dict[str, float]:
    """Return the pose of the jig, orientation by link [rad]."""
    from fourbar_ros.analysis.calibration.encoder_offsets import check_links

    pose: dict[str, float] = {}
    for name, angle in map(parse_goal, goals):
        if name in pose:
            raise CalibrateError(f'{name} occurs twice in the pose', name=name)
        pose[name] = angle
    check_links(pose)
    return pose


def _check_outputs(args: argparse.Namespace) -> None:
    for path in filter(None, (args.output, args.json, args.figure, args.report)):
        if path.exists() and not args.force:
            raise OutputError(f'{path} exists already: choose another name or give --force',
                              path=path)
        check_file(path)
    if args.figure is not None and args.figure.suffix not in ('.png', '.svg'):
        raise OutputError(f'cannot write {args.figure}: a figure is .png or .svg',
                          path=args.figure, limit=('.png', '.svg'))
    if args.bag is None:
        if args.record is None:
            args.record = Path(time.strftime(f'calibrate_{args.kind}_%Y_%m_%d-%H_%M_%S'))
        check_new_folder(args.record)


def _run_experiment(args: argparse.Namespace) -> Path:
    """
    Run the experiment on the device, and record it.

    :returns: the bag.
    :raises FourbarError: no confirmation, or the device did not complete the experiment.
    """
    if args.kind != 'encoders':
        _confirm(args.yes)
    # The client first: it checks ROS before any ROS module is imported.
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


def _confirm(confirmed: bool) -> None:
    if confirmed:
        return
    if not sys.stdin.isatty():
        raise CalibrateError('the wheels will turn: confirm with --yes', name='yes')
    answer = input('The device will be armed and its wheels will turn. Type yes to continue: ')
    if answer.strip().lower() != 'yes':
        raise CalibrateError('not confirmed, no wheel was driven', name='yes')


def _excitation(args: argparse.Namespace, mechanism: Mechanism) -> Any:
    from fourbar_ros.analysis.calibration.excitation import (
        MultiSine,
        SpinAndCoast,
        TORQUE_SHARE,
    )

    torque = args.torque or TORQUE_SHARE * float(mechanism.motor_torque_limits.min())
    if not isfinite(torque):
        raise CalibrateError('the mechanism file has no motor_torque_limits: give --torque',
                             name='torque')
    if args.kind == 'links':
        return MultiSine(mechanism, args.duration, torque)
    wheels = _indices(args.wheels) or list(range(len(FLYWHEEL_NAMES)))
    return SpinAndCoast(mechanism, wheels, args.speed, torque, args.coast)


@contextmanager
def _progress(total_s: float) -> Iterator[Callable[[float], None]]:
    """Show the elapsed seconds on stderr if it is a terminal."""
    from tqdm import tqdm

    with tqdm(total=round(total_s, 1), unit='s', disable=None, leave=False, file=sys.stderr,
              bar_format='{l_bar}{bar}| {n:.1f}/{total:.1f} s') as bar:
        def show(elapsed_s: float) -> None:
            bar.update(min(elapsed_s, total_s) - bar.n)
        yield show


def _write(args: argparse.Namespace, result: Any, name: str, bag: Path) -> list[Path]:
    """Write the requested files, each atomically."""
    from fourbar_ros.analysis.calibration.mechanism_file import calibration_notes, mechanism_text
    from fourbar_ros.common.checks import checks_as_json
    from fourbar_ros.common.config_files import config_file
    from fourbar_ros.plotting.style import render
    import yaml

    date = time.strftime('%Y-%m-%d %H:%M')
    bag_name = bag.absolute().name
    contents: dict[Path, str | bytes] = {}
    if args.output is not None:
        contents[args.output] = mechanism_text(result.mechanism, [
            *calibration_notes(config_file('mechanism', name)),
            f'{result.note}, {date}, from {bag_name}'])
    if result.report:
        contents[args.report] = yaml.safe_dump(
            {'calibrated': date, 'bag': bag_name, 'mechanism': name, **result.report},
            sort_keys=False)
    if args.json is not None:
        document = {'calibration': args.kind, 'bag': str(bag), 'mechanism': name,
                    'checks': checks_as_json(result.checks), **result.data}
        contents[args.json] = json.dumps(document, indent=2, allow_nan=False) + '\n'
    if args.figure is not None and result.figure is not None:
        contents[args.figure] = render(result.figure, args.figure.suffix[1:], 'calibration')
    write_files(contents)
    return list(contents)
