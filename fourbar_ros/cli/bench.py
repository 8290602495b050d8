# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar bench`: time the mechanics and MuJoCo, and check the times against limits."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
import json
from pathlib import Path
import sys

from fourbar_ros.cli.options import add_number, FAILED, show_progress

EPILOG = """\
Times are in nanoseconds for one step of 1 ms [ns] unless a name has another unit, errors in
radians [rad]. Exit code 0: all checks passed; 1: a check failed. Without MuJoCo only the
mechanics of this package are checked.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('--json', metavar='FILE', type=Path,
                        help='file to write: results and checks, with units in names')
    add_number(parser, '--repeats', 'N', '1', 'repetitions of each measurement, the shortest time '
               'counts; use more on a machine with other load', 60, kind=int, low=1)


def run(args: argparse.Namespace) -> int:
    """Measure, print and write."""
    from fourbar_ros.benchmarks.mechanics import checks_of, measure, table
    from fourbar_ros.common.checks import checks_as_json, print_checks
    from fourbar_ros.common.output_files import atomic_file
    from fourbar_ros.kernels.compiler import announced

    with ExitStack() as stack:
        # Opened before the work, so that an error is reported before it.
        file = stack.enter_context(atomic_file(args.json)) if args.json else None
        with announced():
            results = measure(args.repeats, show_progress)
        checks = checks_of(results)
        if file:
            json.dump({'checks': checks_as_json(checks), **results}, file, indent=2,
                      allow_nan=False)
            file.write('\n')
    print(table(results), end='\n\n')
    print_checks(checks)
    for reason in results['skipped']:
        print(f'fourbar bench: {reason}', file=sys.stderr)
    return 0 if all(check.passed for check in checks) else FAILED
