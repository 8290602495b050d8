# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar study`: run a study and check its results."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
import json
from pathlib import Path
import sys

from fourbar_ros.cli.options import FAILED, show_progress
from fourbar_ros.studies import load_study, OPTIONS, STUDIES


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    known = '\n'.join(f'  {name:<14}{study.summary}' for name, study in STUDIES.items())
    parser.epilog = (f'studies:\n{known}\n\n'
                     'Exit code 0: all checks passed; 1: a check failed.')
    parser.add_argument('name', metavar='NAME', help='name of the study')
    parser.add_argument(
        '-o', '--output', metavar='FOLDER', type=Path,
        help='folder for figures and tables (created if missing, default study_NAME)')
    parser.add_argument(
        '--json', metavar='FILE', type=Path,
        help='file to write: checks and results, with units in names (also FOLDER/NAME.json)')
    group = parser.add_argument_group('options of some studies')
    for name, option in OPTIONS.items():
        used_by = ', '.join(study for study, entry in STUDIES.items() if name in entry.options)
        meaning = f'{option.meaning}; {used_by}'
        if option.positional:
            parser.add_argument(name, metavar=option.metavar, nargs='?', type=option.kind,
                                help=meaning)
        else:
            group.add_argument(f'--{name}', metavar=option.metavar, type=option.kind, help=meaning)


def run(args: argparse.Namespace) -> int:
    """Run the study, print and write its results."""
    from fourbar_ros.common.checks import checks_as_json, print_checks
    from fourbar_ros.common.output_files import check_file, output_folder, write_files
    from fourbar_ros.kernels.compiler import announced

    folder = args.output or Path(f'study_{args.name}')
    study = load_study(args.name, folder, **{
        name: value for name in OPTIONS if (value := getattr(args, name)) is not None})
    # Created before the work, so that an error is reported before it.
    with output_folder(folder):
        if args.json:
            check_file(args.json)
        with announced():
            result = study(show_progress)
        document = {'study': args.name, 'checks': checks_as_json(result.checks),
                    'skipped': list(result.skipped), **result.data}
        text = json.dumps(document, indent=2, allow_nan=False) + '\n'
        files: Mapping[Path, str | bytes] = {
            **{folder / name: content for name, content in result.files.items()},
            folder / (result.document or f'{args.name}.json'): text,
            **({args.json: text} if args.json else {})}
        write_files(files)

    print(result.text)
    print_checks(result.checks)
    print('\n'.join(str(path) for path in files))
    for reason in result.skipped:
        print(f'fourbar study: {reason}', file=sys.stderr)
    return 0 if all(check.passed for check in result.checks) else FAILED
