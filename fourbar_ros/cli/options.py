# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Options, progress bar and exit codes that commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
import sys
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import Setting

FAILED = 1
"""Exit code of a refused request or a failed check."""


def number(row: Setting) -> Callable[[str], Any]:
    """
    Return an argparse type for the number of a setting.

    :raises SettingError: from the type, if the text is no number or the number is out of range.
    """
    def parse(text: str) -> Any:
        for kind in (int, float):
            try:
                return row.check(kind(text))
            except ValueError:
                continue
        return row.check(text)
    return parse


def add_number(parser: argparse._ActionsContainer, name: str, metavar: str, unit: str,
               text: str, default: float | None = None, **declared: Any) -> None:
    """
    Declare an option with a number.

    :param name: of the option, such as `--skip`.
    :param text: for --help, without unit and default.
    :param declared: limits and `kind` of :class:`Setting`.
    """
    suffix = '' if default is None else f' (default {default:g})'
    declared.setdefault('kind', float)
    parser.add_argument(
        name, metavar=metavar, default=default, help=f'{text} [{unit}]{suffix}',
        type=number(Setting(name, default, unit, text, **declared)))


def add_bag_options(parser: argparse.ArgumentParser, mechanism: str) -> None:
    """
    Declare --mechanism and --namespace.

    :param mechanism: default mechanism, for --help.
    """
    parser.add_argument('--mechanism', metavar='NAME_OR_PATH',
                        help=f'mechanism preset or file (default: {mechanism})')
    parser.add_argument('--namespace', metavar='NS',
                        help='namespace of the suite, for a bag with more than one')


def beside(bag: Path, suffix: str) -> Path:
    """Return the default path of an output: beside the bag, with its name and a suffix."""
    path = bag.absolute()
    return path.with_name(f'{path.name if path.is_dir() else path.stem}{suffix}')


@contextmanager
def analysis_extra() -> Iterator[None]:
    """
    Name the extra to install if an import fails.

    :raises FourbarError: a library of the extra `analysis` is missing.
    """
    try:
        yield
    except ImportError as error:
        raise FourbarError(f'{error.name} is missing: pip install fourbar_ros[analysis]',
                           name=error.name) from error


def show_progress(items: Iterable[Any], total: int) -> Iterable[Any]:
    """Show a progress bar on stderr if it is a terminal and tqdm is installed."""
    try:
        from tqdm import tqdm
    except ImportError:
        return items
    # disable=None: only if stderr is a terminal.
    bar: Iterable[Any] = tqdm(items, total=total, disable=None, leave=False, file=sys.stderr)
    return bar


def add_ros_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--ros-args`."""
    parser.add_argument(
        '--ros-args', nargs=argparse.REMAINDER, default=[],
        help='ROS arguments, for instance -r __ns:=/lab')


def testbed_client(args: argparse.Namespace) -> Any:
    """
    Create the ROS node of an operator.

    :raises RosError: ROS is not usable.
    """
    from fourbar_ros.ros.environment import check_environment
    check_environment()
    from fourbar_ros.operator.client import TestbedClient
    return TestbedClient(['--ros-args', *args.ros_args] if args.ros_args else [])


def print_response(success: bool, message: str) -> int:
    """Print a response, on stderr if it is a refusal, and return the exit code."""
    print(message, file=sys.stdout if success else sys.stderr)
    return 0 if success else FAILED
