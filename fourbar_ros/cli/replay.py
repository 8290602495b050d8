# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar replay`: run the estimator over a recorded bag, with other settings."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
import json
from pathlib import Path
import sys
from typing import Any

from fourbar_ros.cli.options import (
    add_bag_options,
    add_number,
    analysis_extra,
    beside,
    number,
    show_progress,
)
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.output_files import (
    atomic_folder,
    check_file,
    check_new_folder,
    write_files,
)

EPILOG = """\
OUT is a rosbag2 directory (MCAP) with all topics of BAG and new estimate/* in place of the
recorded ones, at the log times of their ticks, with comparison.json and comparison.png. Equal
bags and settings give equal files. Settings are the parameters of the estimator, with the
defaults of the node; the settings of the recorded run are not in BAG.
"""
NODE = 'estimator'
# Parameters of every node that no estimate depends on.
COMMON_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'realtime_priority')


class SettingsError(FourbarError):
    """A parameters file that is refused; `values` hold `path`."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options; the settings of the estimator have one each."""
    from fourbar_ros.estimation.estimator_settings import SETTINGS

    parser.epilog = EPILOG
    parser.add_argument('bag', metavar='BAG', type=Path,
                        help='rosbag2 directory, or a single .mcap or .db3 file')
    parser.add_argument('-o', '--output', metavar='OUT', type=Path,
                        help='directory to create (default: BAG_replay, beside it)')
    parser.add_argument('--json', metavar='FILE', type=Path, help='copy of comparison.json')
    add_number(parser, '--skip', 'S', 's', 'time without statistics after the first estimates of '
               'both filters, whose rates have not converged yet', 1.0, low=0.0)
    parser.add_argument('--params-file', metavar='YAML', type=Path,
                        help='ROS parameters file; its section of the estimator is used')
    add_bag_options(parser, 'that of device_status in the bag, else paper')
    group = parser.add_argument_group('settings of the estimator')
    for row in SETTINGS:
        low, high = row.limits or (float('-inf'), float('inf'))
        text = (f'{row.meaning} [{row.unit or "1"}], {low:g} to {high:g} '
                f'(default {row.default:g})')
        group.add_argument(f'--{row.name.replace("_", "-")}', metavar='X', dest=row.name,
                           type=number(row), help=text.replace('%', '%%'))


def run(args: argparse.Namespace) -> int:
    """Replay, compare, write all files, print the comparison."""
    with analysis_extra():
        from fourbar_ros.analysis.replay import check_parameters, replay
        from fourbar_ros.analysis.replay_comparison import as_json, as_text, compare
        from fourbar_ros.analysis.replay_figure import comparison_figure
        from fourbar_ros.plotting.style import render
        import rosbags  # noqa: F401
    from fourbar_ros.kernels.compiler import announced

    # Check all inputs before the work.
    values = _values(args)
    check_parameters(values)
    output = args.output or beside(args.bag, '_replay')
    check_new_folder(output)
    if args.json:
        check_file(args.json)

    with atomic_folder(output) as folder:
        with announced():
            from fourbar_ros.loop.warm_up import warm_up
            warm_up()
        result = replay(args.bag, folder, values, namespace=args.namespace,
                        progress=show_progress)
        comparison = compare(result, args.skip)
        text = json.dumps(as_json(comparison), indent=2, allow_nan=False) + '\n'
        write_files({
            folder / 'comparison.json': text,
            folder / 'comparison.png': render(lambda: comparison_figure(comparison), 'png'),
            **({args.json: text} if args.json else {})})
    print(as_text(comparison))
    for warning in result.warnings:
        print(f'fourbar replay: {warning}', file=sys.stderr)
    print('\n'.join(map(str, filter(None, (
        output, output / 'comparison.json', output / 'comparison.png', args.json)))))
    return 0


def _values(args: argparse.Namespace) -> dict[str, Any]:
    """Return the given parameters; an option overrides the parameters file."""
    from fourbar_ros.estimation.estimator_settings import PARAMETERS

    names = [row.name for row in PARAMETERS]
    values = {} if args.params_file is None else _read_parameters(
        args.params_file, args.namespace or '', names)
    given = {name: value for name in names if (value := getattr(args, name)) is not None}
    return {**values, **given}


def _read_parameters(path: Path, namespace: str, names: list[str]) -> dict[str, Any]:
    """
    Read the parameters of the estimator from a ROS parameters file.

    :param namespace: of the node.
    :param names: of its parameters.
    :raises FourbarError: no parameters file, or an unknown parameter of the estimator.
    """
    from fourbar_ros.analysis.bag_reader import absolute_name
    from fourbar_ros.common.config_files import load_yaml
    from fourbar_ros.common.settings import check_keys

    values: dict[str, Any] = {}
    own = (NODE, f'/{NODE}', f'/**/{NODE}', absolute_name(namespace, NODE))
    for key, section in load_yaml(path).items():
        if key not in (*own, '/**'):
            continue
        parameters = section.get('ros__parameters') if isinstance(section, Mapping) else None
        if not isinstance(parameters, Mapping):
            raise SettingsError(f'{path}: {key} has no section ros__parameters', path=str(path),
                                missing=['ros__parameters'])
        # A section for all nodes may have parameters of other nodes.
        if key in own:
            check_keys(parameters, (), f'{path}: {key}', SettingsError,
                       optional=(*names, *COMMON_PARAMETERS))
        values.update((name, value) for name, value in parameters.items() if name in names)
    if not values:
        raise SettingsError(f'{path} has no parameter of the node {NODE}', path=str(path),
                            name=NODE)
    return values
