# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

# PYTHON_ARGCOMPLETE_OK

"""
Dispatch `fourbar NAME ...`, and `ros2 run fourbar_ros NAME ...`, to the module behind the name.

A command is a module with `add_arguments(parser)` and `run(args)`. A node takes ROS
arguments instead, so its name and `--ros-args ...` go to `fourbar_ros.ros.NAME.main`. Modules
are imported when their name is used, so that no command waits for another one's libraries.
"""

from __future__ import annotations

import argparse
from importlib import import_module
import logging
import os
import sys
from types import ModuleType

from fourbar_ros import __version__
from fourbar_ros.common.errors import FourbarError

NODES = {
    'plant': 'simulated air table with the linkage on it',
    'hardware': 'the prototype, over a bus to its links',
    'prototype_emulator': 'the links of the prototype, emulated on the bus',
    'estimator': 'Kalman filter on link angles and wheel motion',
    'controller': 'tracking law and wheel allocation',
}
COMMANDS = {
    **NODES,
    'setpoint': 'move links to new angles',
    'arm': 'let the wheels be driven',
    'disarm': 'stop driving the wheels, they coast',
    'stop': 'emergency stop, latched',
    'reset': 'release the emergency stop',
    'enable': 'let the controller drive the wheels',
    'disable': 'keep the controller from driving, the wheels get no torque',
    'hold': 'come to rest and stay there',
    'damp': 'stop all rates, wherever that ends',
    'sim': 'pause, resume, step or reset the simulated table',
    'status': 'show device and controller',
    'record': 'write topics to a rosbag2 directory',
    'report': 'turn a bag into an HTML report and metrics',
    'replay': 'the estimator over a bag, with other settings',
    'demo': 'the whole loop, from start to report',
    'calibrate': 'measure encoders, wheels and links of a device',
    'simulate': 'integrate one motion, without ROS',
    'bench': 'time the mechanics beside MuJoCo',
    'study': 'rerun a study and check what it finds',
}

# Commands that share a module; the others have one of their own name.
MODULES = dict.fromkeys(
    ('arm', 'disarm', 'stop', 'reset', 'enable', 'disable', 'hold', 'damp'), 'services')

USAGE_ERROR = 2
INTERRUPTED = 130


def main(argv: list[str] | None = None) -> int:
    """
    Run one command.

    :param argv: the command's name and arguments, default those of the process.
    :returns: exit code, 0 for success, 2 for bad input.
    """
    argv = sys.argv[1:] if argv is None else argv
    logging.basicConfig(format='fourbar: %(message)s', level=logging.WARNING)
    name = argv[0] if argv else ''
    try:
        if name in NODES:
            import_module('fourbar_ros.ros.environment').check_environment()
            code: int = import_module(f'fourbar_ros.ros.{name}').main(argv[1:])
            return code
        args = _parser(name).parse_args(argv)
        if not args.command:
            _parser('').print_help()
            return USAGE_ERROR
        code = _module(args.command).run(args)
        return code
    except FourbarError as error:
        print(f'fourbar {name}: {error}', file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print(f'fourbar {name}: interrupted', file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output went away (`| head`): nothing left to say, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _module(command: str) -> ModuleType:
    return import_module(f'fourbar_ros.cli.{MODULES.get(command, command)}')


def _parser(name: str) -> argparse.ArgumentParser:
    """Make the parser; only the named command brings its own arguments, which may take long."""
    parser = argparse.ArgumentParser(
        prog='fourbar', description='A free-floating four-bar linkage: simulate, estimate, '
        'control, drive and look at it over ROS 2 topics.')
    parser.add_argument('--version', action='version', version=f'fourbar_ros {__version__}')
    subparsers = parser.add_subparsers(dest='command', metavar='COMMAND', title='commands')
    completing = '_ARGCOMPLETE' in os.environ
    named = os.environ.get('COMP_LINE', '').split() if completing else [name]
    for command, text in COMMANDS.items():
        subparser = subparsers.add_parser(
            command, help=text, description=f'{text[0].upper()}{text[1:]}.',
            formatter_class=argparse.RawDescriptionHelpFormatter)
        if command not in NODES and command in named:
            _module(command).add_arguments(subparser)
    if completing:
        import argcomplete
        argcomplete.autocomplete(parser)
    return parser
