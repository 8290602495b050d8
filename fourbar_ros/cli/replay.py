# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar replay`: the estimator over a recorded bag, with other settings."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
import json
from pathlib import Path
import sys
from typing import Any

from fourbar_ros.cli.progress import show_progress
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.output_files import (
    atomic_file,
    atomic_folder,
    check_new_folder,
    OutputError,
)

EPILOG = """\
OUT is a rosbag2 directory (MCAP) with all topics of BAG and new estimate/* in place of those that
were recorded, at the log times of the ticks; beside them comparison.json and comparison.png. The
same bag and settings give the same bytes. Settings are the estimator's parameters, by default
those that the node has by default, and not those that it had when BAG was recorded.
"""
NODE = 'estimator'
# What any node has besides its table.
OF_ROS = ('use_sim_time', 'start_type_description_service')


class SettingsError(FourbarError):
    """Settings that are refused."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options, one for each row of the estimator's table among them."""
    from fourbar_ros.estimation.estimator_settings import SETTINGS

    parser.epilog = EPILOG
    parser.add_argument('bag', metavar='BAG', type=Path,
                        help='rosbag2 directory, or a single .mcap or .db3 file')
    parser.add_argument('-o', '--output', metavar='OUT', type=Path,
                        help='directory to make (default: BAG_replay, beside it)')
    parser.add_argument('--json', metavar='FILE', type=Path,
                        help='write comparison.json here, too')
    parser.add_argument('--namespace', metavar='NS',
                        help='namespace of the suite in the bag, where it holds more than one')
    parser.add_argument('--skip', metavar='S', type=float,
                        help='leave out so much after the first estimates in the comparison, '
                             'while the filter finds the rates [s] (default 1)')
    parser.add_argument('--params-file', metavar='YAML', type=Path,
                        help='parameters of nodes, of which those of the estimator count')
    parser.add_argument('--mechanism', metavar='NAME_OR_PATH',
                        help='mechanism preset or file (default: what the device said in the '
                             'bag, else paper)')
    group = parser.add_argument_group('settings of the estimator')
    for row in SETTINGS:
        low, high = row.limits or (float('-inf'), float('inf'))
        text = (f'{row.meaning} [{row.unit or "1"}], {low:g} to {high:g} '
                f'(default {row.default:g})')
        group.add_argument(f'--{row.name.replace("_", "-")}', metavar='X', dest=row.name,
                           help=text.replace('%', '%%'))


def run(args: argparse.Namespace) -> int:
    """Replay, compare, write everything, print the comparison."""
    try:
        from fourbar_ros.analysis.replay import checked_values, replay
        from fourbar_ros.analysis.replay_comparison import as_json, as_text, compare, SKIP_S
        from fourbar_ros.analysis.replay_figure import png
        import rosbags  # noqa: F401
    except ImportError as error:
        raise FourbarError(
            f'{error.name} is missing: pip install fourbar_ros[analysis]') from error
    from fourbar_ros.kernels.compiler import announced

    # Before the work, not after it.
    values = _values(args)
    checked_values(values)
    skip = SKIP_S if args.skip is None else args.skip
    if not 0.0 <= skip < float('inf'):
        raise SettingsError(f'--skip must be a number of seconds from 0, got {skip:g}')
    output = args.output or _beside(args.bag)
    check_new_folder(output)
    if args.json and not args.json.absolute().parent.is_dir():
        raise OutputError(f'cannot write {args.json}: no such folder')

    with atomic_folder(output) as folder:
        with announced():
            from fourbar_ros.loop.warm_up import warm_up
            warm_up()
        found = replay(args.bag, folder, values, namespace=args.namespace,
                       progress=show_progress)
        comparison = compare(found, skip)
        text = json.dumps(as_json(comparison), indent=2, allow_nan=False) + '\n'
        (folder / 'comparison.json').write_text(text, encoding='utf-8')
        (folder / 'comparison.png').write_bytes(png(comparison))
        if args.json:
            with atomic_file(args.json) as file:
                file.write(text)
    print(as_text(comparison))
    for warning in found.warnings:
        print(f'fourbar replay: {warning}', file=sys.stderr)
    print('\n'.join(map(str, filter(None, (
        output, output / 'comparison.json', output / 'comparison.png', args.json)))))
    return 0


def _beside(bag: Path) -> Path:
    """Return where the new bag goes if nobody says."""
    whole = bag.absolute()
    name = whole.name if whole.is_dir() else whole.stem
    return whole.with_name(f'{name}_replay')


def _values(args: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters that are given: of the options, and of the file where they are not."""
    from fourbar_ros.estimation.estimator_settings import PARAMETERS, SETTINGS

    values = {} if args.params_file is None else _from_file(
        args.params_file, args.namespace or '', {row.name for row in PARAMETERS})
    for row in SETTINGS:
        if (text := getattr(args, row.name)) is not None:
            values[row.name] = _number(row.name, text)
    if args.mechanism is not None:
        values['mechanism'] = args.mechanism
    return values


def _number(name: str, text: str) -> int | float:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    raise SettingsError(f'parameter {name} must be a number, got {text!r}')


def _from_file(path: Path, namespace: str, known: set[str]) -> dict[str, Any]:
    """
    Read what a parameters file of ROS has for the estimator.

    :param namespace: of the node.
    :param known: names of its parameters.
    :raises FourbarError: not such a file, or a parameter that the estimator has not.
    """
    from fourbar_ros.common.config_files import load_yaml

    values: dict[str, Any] = {}
    space = '/'.join(['', *filter(None, namespace.split('/'))]).rstrip('/')
    own = (NODE, f'/{NODE}', f'/**/{NODE}', f'{space}/{NODE}')
    for key, section in load_yaml(path).items():
        if key not in (*own, '/**'):
            continue
        parameters = section.get('ros__parameters') if isinstance(section, Mapping) else None
        if not isinstance(parameters, Mapping):
            raise SettingsError(f'{path}: {key} has no section ros__parameters')
        unknown = sorted(set(map(str, parameters)) - known - set(OF_ROS))
        # In a section for all nodes are the parameters of others, too.
        if unknown and key in own:
            raise SettingsError(f'{path}: {key}: unknown setting {", ".join(unknown)} (known are '
                                f'{", ".join(sorted(known))})')
        values.update((name, value) for name, value in parameters.items() if name in known)
    if not values:
        raise SettingsError(f'{path} has no parameter of the node {NODE}')
    return values
