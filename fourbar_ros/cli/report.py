# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Turn a rosbag2 directory into one HTML page and one JSON file of metrics."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from fourbar_ros.cli.progress import show_progress
from fourbar_ros.common.errors import FourbarError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument('bag', metavar='BAG', help='rosbag2 directory (MCAP or SQLite)')
    parser.add_argument(
        '-o', '--output', metavar='HTML',
        help='page to write (default: BAG.report.html, beside the directory)')
    parser.add_argument(
        '--metrics', metavar='JSON',
        help='metrics to write, units in their names (default: BAG.metrics.json)')
    parser.add_argument(
        '--mechanism', metavar='NAME_OR_PATH',
        help='mechanism preset or file (default: what the device said in the bag)')
    parser.add_argument(
        '--namespace', metavar='NS',
        help='namespace of the suite in the bag, where it holds more than one')


def run(args: argparse.Namespace) -> int:
    """Read the bag, write both files, say where they are."""
    try:
        from fourbar_ros.analysis.report import write_report
        import matplotlib  # noqa: F401
        import rosbags  # noqa: F401
        import tqdm  # noqa: F401
    except ImportError as error:
        raise FourbarError(
            f'{error.name} is missing: pip install fourbar_ros[analysis]') from error

    bag = Path(args.bag)
    beside = bag.absolute()
    html = Path(args.output or beside.with_name(f'{beside.name}.report.html'))
    metrics_json = Path(args.metrics or beside.with_name(f'{beside.name}.metrics.json'))
    result = write_report(bag, html, metrics_json, args.mechanism, namespace=args.namespace,
                          progress=show_progress)
    for reason in dict.fromkeys(result['missing'].values()):
        names = [name for name, why in result['missing'].items() if why == reason]
        print(f'without {", ".join(names)}: {reason}', file=sys.stderr)
    print(f'{html}\n{metrics_json}')
    return 0
