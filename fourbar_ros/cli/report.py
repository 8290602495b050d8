# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar report`: write an HTML page and a JSON file of metrics from a bag."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

from fourbar_ros.cli.options import add_bag_options, analysis_extra, beside, show_progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument('bag', metavar='BAG', type=Path,
                        help='rosbag2 directory (MCAP or SQLite)')
    parser.add_argument('-o', '--output', metavar='HTML', type=Path,
                        help='page to write (default: BAG.report.html, beside the directory)')
    parser.add_argument(
        '--metrics', metavar='JSON', type=Path,
        help='metrics to write, with units in names (default: BAG.metrics.json)')
    add_bag_options(parser, 'that of device_status in the bag')


def run(args: argparse.Namespace) -> int:
    """Read the bag, write both files, print their paths."""
    with analysis_extra():
        from fourbar_ros.analysis.report import write_report
        import matplotlib  # noqa: F401
        import rosbags  # noqa: F401
    html = args.output or beside(args.bag, '.report.html')
    metrics_json = args.metrics or beside(args.bag, '.metrics.json')
    result = write_report(args.bag, html, metrics_json, args.mechanism, namespace=args.namespace,
                          progress=show_progress)
    for reason in dict.fromkeys(result['missing'].values()):
        names = [name for name, why in result['missing'].items() if why == reason]
        print(f'without {", ".join(names)}: {reason}', file=sys.stderr)
    print(f'{html}\n{metrics_json}')
    return 0
