# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
    from fourbar_ros.analysis.benchmark import checks_of, measure, table
    from fourbar_ros.analysis.checks import checks_as_json, print_checks
    from fourbar_ros.commands.files import write_whole
    from fourbar_ros.commands.progress import show_progress
    from fourbar_ros.mechanism.compiled import announced

    with ExitStack() as stack:
        # Opened before the work: a file that cannot be written is no news for its end.
        file = stack.enter_context(write_whole(args.json)) if args.json else None
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
