# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar bench`: time the mechanics beside MuJoCo, and hold the times to their limits."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
import json
from pathlib import Path
import sys

MISSED = 1

EPILOG = """\
Times are in nanoseconds for one step of 1 ms [ns] unless their name says otherwise, errors in
radians [rad]. Exits with 0 when every check is kept, with 1 when one is missed. Without MuJoCo
only our own numbers are checked.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('--json', metavar='FILE', type=Path,
                        help='write numbers and checks there, units in their names')
    parser.add_argument('--repeats', metavar='N', type=int, default=60,
                        help='how often each is timed, the least time counts (default 60; more '
                        'on a machine that does other things too)')


def run(args: argparse.Namespace) -> int:
    """Measure, print and write."""
    from fourbar_ros.benchmarks.mechanics import checks_of, measure, table
    from fourbar_ros.cli.progress import show_progress
    from fourbar_ros.common.checks import checks_as_json, print_checks
    from fourbar_ros.common.output_files import atomic_file
    from fourbar_ros.kernels.compiler import announced

    with ExitStack() as stack:
        # Opened before the work: a file that cannot be written is no news for its end.
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
    return 0 if all(check.passed for check in checks) else MISSED
