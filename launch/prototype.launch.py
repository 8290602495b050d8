# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Prototype, estimator and controller: `ros2 launch fourbar_ros prototype.launch.py`.

With `emulate:=true` the links are emulated on this machine. The numerical kernels are compiled
first (two minutes, once), then the nodes start. They have config/nodes_prototype.yaml.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

EMULATOR = 'prototype_emulator'
# Those after the emulated links start with any.
EXECUTABLES = (EMULATOR, 'hardware', 'estimator', 'controller')

# Arguments that set a parameter of the same name, the nodes that have it, and its type.
PARAMETERS = {
    'mechanism': (EXECUTABLES, str),
    'bus.interface': (('hardware',), str),
    'bus.channel': (('hardware',), str),
    'bus.options': (('hardware',), str),
    'codec': ((EMULATOR, 'hardware'), str),
    'dbc': ((EMULATOR, 'hardware'), str),
    'safety': (('hardware',), str),
    'rate': (('hardware',), float),
    'table': ((EMULATOR,), str),
    'setpoint_duration': (('controller',), float),
    'realtime_priority': (EXECUTABLES, int),
}

# Where host and emulated links find each other.
UDP = 'fourbar_udp'
HOST_CHANNEL = '127.0.0.1:29536'
LINKS_CHANNEL = '127.0.0.1:29537'


def generate_launch_description():
    """Describe the arguments and what starts when."""
    return LaunchDescription([
        DeclareLaunchArgument(
            'namespace', default_value='',
            description='namespace of all nodes, for instance lab'),
        DeclareLaunchArgument(
            'params_file', default_value='',
            description='parameters file of all nodes, whose values hold against those of '
                        'config/nodes_prototype.yaml'),
        DeclareLaunchArgument(
            'mechanism', default_value='',
            description='mechanism preset (prototype) or path of a mechanism file; empty: as in '
                        'params_file'),
        DeclareLaunchArgument(
            'bus.interface', default_value='',
            description='interface of python-can, as socketcan, slcan or fourbar_udp; socketcan '
                        'unless given here or in params_file, fourbar_udp if the links are '
                        'emulated'),
        DeclareLaunchArgument(
            'bus.channel', default_value='',
            description='channel of the interface, as can0 or HOST:PORT; can0 unless given here '
                        'or in params_file, 127.0.0.1:29536 if the links are emulated'),
        DeclareLaunchArgument(
            'bus.options', default_value='',
            description='more for the interface, as key=value, with spaces between; with emulated '
                        'links on fourbar_udp they are the peers'),
        DeclareLaunchArgument(
            'codec', default_value='',
            description='what is spoken on the bus: prototype or odrive; empty: as in '
                        'params_file'),
        DeclareLaunchArgument(
            'dbc', default_value='',
            description='preset (prototype) or path of the DBC file; empty: as in params_file'),
        DeclareLaunchArgument(
            'safety', default_value='',
            description='preset (prototype, emulated) or path of a table of limits and '
                        'reactions; as in params_file unless given here, emulated if the links '
                        'are emulated'),
        DeclareLaunchArgument(
            'rate', default_value='',
            description='control rate [Hz], 250.0 unless given here or in params_file'),
        DeclareLaunchArgument(
            'setpoint_duration', default_value='',
            description='time in which a setpoint is reached [s], 10.0 unless given'),
        DeclareLaunchArgument(
            'realtime_priority', default_value='',
            description='priority of all nodes under SCHED_FIFO, 1 to 99; 0, unless given, for '
                        'none'),
        DeclareLaunchArgument(
            'emulate', default_value='false',
            description='true to start emulated links too, on the same bus'),
        DeclareLaunchArgument(
            'emulator_channel', default_value='',
            description='channel of the emulated links; 127.0.0.1:29537 unless given, and that '
                        'of the host if the interface is not fourbar_udp'),
        DeclareLaunchArgument(
            'table', default_value='',
            description='table preset (prototype) or path of a table file for the emulated links; '
                        'empty: as in params_file'),
        OpaqueFunction(function=start_nodes),
    ])


def start_nodes(context):
    def argument(name):
        return LaunchConfiguration(name).perform(context)

    emulate = {'true': True, 'false': False}.get(argument('emulate').lower())
    if emulate is None:
        raise RuntimeError(f'emulate must be true or false, got {argument("emulate")}')
    buses = _buses(argument) if emulate else {}
    # Beside this file in a checkout as in an installation.
    files = [str(Path(__file__).parents[1] / 'config' / 'nodes_prototype.yaml')]
    if argument('params_file'):
        files.append(argument('params_file'))
    nodes = []
    for executable in EXECUTABLES if emulate else EXECUTABLES[1:]:
        given = {name: kind(argument(name)) for name, (owners, kind) in PARAMETERS.items()
                 if executable in owners and argument(name)}
        given.update(buses.get(executable, {}))
        if emulate and executable == 'hardware':
            given.setdefault('safety', 'emulated')
        nodes.append(Node(
            package='fourbar_ros', executable=executable, namespace=argument('namespace'),
            parameters=[*files, *([given] if given else [])], output='screen'))
    # In the Python of the nodes, which need not be that of ros2 launch.
    compiling = ExecuteProcess(
        cmd=['python3', '-m', 'fourbar_ros.loop.warm_up'], output='screen')
    return [compiling, RegisterEventHandler(
        OnProcessExit(target_action=compiling, on_exit=nodes))]


def _buses(argument):
    """Return the parameters of the bus of both ends, so that they find each other."""
    interface, options = argument('bus.interface') or UDP, argument('bus.options')
    host, links = argument('bus.channel'), argument('emulator_channel')
    if interface == UDP:
        host, links = host or HOST_CHANNEL, links or LINKS_CHANNEL
    buses = {}
    for name, own, other in (('hardware', host, links), (EMULATOR, links or host, host)):
        given = {'bus.interface': interface, 'bus.channel': own,
                 'bus.options': f'peers={other}' if interface == UDP else options}
        buses[name] = {key: value for key, value in given.items() if value}
    return buses
