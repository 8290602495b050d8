# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulated table, estimator and controller: `ros2 launch fourbar_ros sim.launch.py`.

The numerical kernels are compiled first (two minutes, once), then the nodes start.
"""

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

EXECUTABLES = ('plant', 'estimator', 'controller')

# Arguments that set a parameter of the same name, the nodes that have it, and its type.
PARAMETERS = {
    'mechanism': (EXECUTABLES, str),
    'table': (('plant',), str),
    'clock': (('plant',), str),
    'real_time_factor': (('plant',), float),
    'rate': (('plant',), float),
    'seed': (('plant',), int),
    'setpoint_duration': (('controller',), float),
    'realtime_priority': (EXECUTABLES, int),
}


def generate_launch_description():
    """Describe the arguments and what starts when."""
    return LaunchDescription([
        DeclareLaunchArgument(
            'namespace', default_value='',
            description='namespace of the three nodes, for instance lab'),
        DeclareLaunchArgument(
            'params_file', default_value='',
            description='parameters file of all nodes; config/nodes.yaml is one to start from'),
        DeclareLaunchArgument(
            'mechanism', default_value='',
            description='mechanism preset (paper) or path of a mechanism file; empty: as in '
                        'params_file'),
        DeclareLaunchArgument(
            'table', default_value='',
            description='table preset (ideal) or path of a table file; empty: as in params_file'),
        DeclareLaunchArgument(
            'clock', default_value='',
            description='what the ticks follow: realtime, fast or lockstep; fast and lockstep '
                        'set use_sim_time for all nodes; empty: as in params_file'),
        DeclareLaunchArgument(
            'real_time_factor', default_value='',
            description='simulated seconds per second of the fast clock, 1.0 unless given, 0.0 '
                        'for as fast as it can'),
        DeclareLaunchArgument(
            'rate', default_value='',
            description='control rate [Hz], 250.0 unless given here or in params_file'),
        DeclareLaunchArgument(
            'seed', default_value='',
            description='seed of all random numbers of the plant, 0 unless given'),
        DeclareLaunchArgument(
            'setpoint_duration', default_value='',
            description='time in which a setpoint is reached [s], 10.0 unless given'),
        DeclareLaunchArgument(
            'realtime_priority', default_value='',
            description='priority of all nodes under SCHED_FIFO, 1 to 99; 0, unless given, for '
                        'none'),
        OpaqueFunction(function=start_nodes),
    ])


def start_nodes(context):
    def argument(name):
        return LaunchConfiguration(name).perform(context)

    nodes = []
    for executable in EXECUTABLES:
        given = {name: kind(argument(name)) for name, (owners, kind) in PARAMETERS.items()
                 if executable in owners and argument(name)}
        if argument('clock'):
            given['use_sim_time'] = argument('clock') != 'realtime'
        files = [argument('params_file')] if argument('params_file') else []
        nodes.append(Node(
            package='fourbar_ros', executable=executable, namespace=argument('namespace'),
            parameters=[*files, *([given] if given else [])], output='screen'))
    # In the Python of the nodes, which need not be that of ros2 launch.
    compiling = ExecuteProcess(
        cmd=['python3', '-m', 'fourbar_ros.loop.warm_up'], output='screen')
    return [compiling, RegisterEventHandler(
        OnProcessExit(target_action=compiling, on_exit=nodes))]
