# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

# PYTHON_ARGCOMPLETE_OK

"""
Dispatch `fourbar NAME ...`, and `ros2 run fourbar_ros NAME ...`, to the module behind the name.

A command is a module with `add_arguments(parser)` and `run(args)`. A node takes ROS arguments:
`fourbar_ros.ros.NAME.main` parses them. A module is imported only when its command is used, so
that no command loads the libraries of another one.
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
    'plant': 'simulated air table with the linkage',
    'hardware': 'prototype, connected over a bus to its links',
    'prototype_emulator': 'emulator of the prototype links on the bus',
    'estimator': 'Kalman filter for link angles and wheel motion',
    'controller': 'tracking law and wheel allocation',
}
GROUPS = {
    'nodes (ROS arguments: --ros-args ...)': NODES,
    'operate a device': {
        'arm': 'allow the device to drive the wheels',
        'disarm': 'stop driving the wheels, which coast',
        'stop': 'emergency stop, latched',
        'reset': 'release the emergency stop',
        'status': 'show the states of device and controller',
        'setpoint': 'move links to new angles',
        'hold': 'stop the links and hold them there',
        'damp': 'damp all rates without holding a position',
        'enable': 'enable the controller',
        'disable': 'disable the controller, which commands zero torque',
        'sim': 'pause, resume, step or reset the simulated table',
    },
    'record and analyse': {
        'demo': 'run the complete loop, from start to report',
        'record': 'record topics into a rosbag2 directory',
        'report': 'write an HTML report and metrics from a bag',
        'replay': 'run the estimator over a bag, with other settings',
        'calibrate': 'identify encoder offsets, wheel and link parameters of a device',
    },
    'compute without ROS': {
        'simulate': 'simulate one motion, or a scenario in closed loop',
        'study': 'run a study and check its results',
        'bench': 'time the mechanics and MuJoCo',
    },
}
COMMANDS = {name: text for group in GROUPS.values() for name, text in group.items()}

# Module of the commands that share one; the module of another command has its name.
MODULES = dict.fromkeys(
    ('arm', 'disarm', 'stop', 'reset', 'enable', 'disable', 'hold', 'damp', 'sim'), 'services')

USAGE_ERROR = 2
INTERRUPTED = 130


def main(argv: list[str] | None = None) -> int:
    """
    Run one command.

    :param argv: name and arguments of the command, by default those of the process.
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
        # The reader of stdout ended (`| head`); suppress the error of the flush at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _module(command: str) -> ModuleType:
    return import_module(f'fourbar_ros.cli.{MODULES.get(command, command)}')


def _parser(name: str) -> argparse.ArgumentParser:
    """Create the parser; only the arguments of the named command are declared, for speed."""
    parser = argparse.ArgumentParser(
        prog='fourbar', formatter_class=argparse.RawDescriptionHelpFormatter, epilog=_listing(),
        description='A free-floating four-bar linkage with flywheels: simulation, estimation, '
        'control and\noperation over ROS 2 topics. `fourbar COMMAND --help` describes a command.')
    parser.add_argument('--version', action='version', version=f'fourbar_ros {__version__}')
    subparsers = parser.add_subparsers(dest='command', metavar='COMMAND',
                                       help='one of the following')
    completing = '_ARGCOMPLETE' in os.environ
    named = os.environ.get('COMP_LINE', '').split() if completing else [name]
    for command, text in COMMANDS.items():
        subparser = subparsers.add_parser(
            command, description=f'{text[0].upper()}{text[1:]}.',
            formatter_class=argparse.RawDescriptionHelpFormatter)
        if command not in NODES and command in named:
            _module(command).add_arguments(subparser)
    if completing:
        import argcomplete
        argcomplete.autocomplete(parser)
    return parser


def _listing() -> str:
    """Return all commands in groups, for --help."""
    width = max(map(len, COMMANDS)) + 2
    return '\n\n'.join(
        f'{title}:\n' + '\n'.join(f'  {name:<{width}}{text}' for name, text in group.items())
        for title, group in GROUPS.items())
