# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar demo`: a scenario's nodes in processes of their own, one move, a bag, a report."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, ExitStack
import fcntl
import gc
from math import degrees
import os
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

from fourbar_ros.cli.processes import Processes
from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.output_files import atomic_file, OutputError
import yaml

if TYPE_CHECKING:
    from fourbar_ros.loop import Scenario

# What is started for each device, before estimator and controller.
DEVICES = {'simulated': ('plant',), 'prototype': ('prototype_emulator', 'hardware')}
PRESETS = {'simulated': 'paper', 'prototype': 'prototype'}

STATUSES = (names.DEVICE_STATUS, names.CONTROLLER_STATUS)
JOINTS = (
    names.LINK_ANGLES, names.FLYWHEEL_STATES, names.FLYWHEEL_COMMAND, names.TIMING,
    names.SIM_LINK_STATES, names.SIM_FLYWHEEL_STATES, names.ESTIMATE_LINK_STATES,
    names.ESTIMATE_SIGMA, names.ESTIMATE_INNOVATION,
    names.REFERENCE, names.TRACKING_ERROR, names.ENERGY, names.ALLOCATION, names.MOMENTUM,
)

WATCHED = (names.FLYWHEEL_STATES, names.ESTIMATE_LINK_STATES)

PROGRESS = '|{bar:40}| {n:4.1f} of {total:.1f} s{postfix}'
TABLE = (
    ('tracking, rms', 'tracking.rms_rad', degrees(1), 'deg'),
    ('tracking, error at the end', 'tracking.final_error_rad', degrees(1), 'deg'),
    ('estimate, rms error', 'estimate.rms_error_rad', degrees(1), 'deg'),
    ('wheels, peak speed', 'flywheel.peak_speed_rad_s', 1.0, 'rad/s'),
    ('wheels, peak energy (eq. 7)', 'flywheel.peak_energy_j', 1e3, 'mJ'),
    ('loop, rate', 'loop.rate_hz', 1.0, 'Hz'),
    ('loop, round trip, median', 'loop.round_trip_p50_ms', 1.0, 'ms'),
    ('loop, round trip, 99th percentile', 'loop.round_trip_p99_ms', 1.0, 'ms'),
    ('loop, lost ticks', 'loop.lost', 1.0, ''),
)

# No wheel breaks here, and a laptop that also shows films holds a node up for longer than a real
# table should bear.
PATIENCE = 1.0

# Times [s]: to look for another plant, for everything to come up, to settle before and after.
LOOK_AROUND = 0.5
START_UP = 30.0
SETTLE_BEFORE = 0.3
SETTLE_AFTER = 1.1

EPILOG = """\
Uses the ROS_DOMAIN_ID of the environment (default 0) with discovery on this machine alone.
Writes DIR/bag (rosbag2, MCAP), DIR/report.html, DIR/metrics.json, DIR/parameters.yaml (of the
nodes) and DIR/logs; what a former demo left there is replaced. Arming and setpoint come from the
scenario, in its order but not to the tick.
"""


class DemoError(FourbarError):
    """The demo cannot run, or something in it went wrong."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('--output', metavar='DIR', type=Path, default=Path('demo_output'),
                        help='folder for bag, report and metrics (default demo_output)')
    parser.add_argument('--device', choices=tuple(DEVICES), default='simulated',
                        help='simulated (default): the plant; prototype: the hardware node, over '
                             'a bus on this machine to emulated links')
    parser.add_argument('--preset', metavar='NAME',
                        help='scenario with one setpoint: paper (default), prototype (default of '
                             'device prototype) or a file')


def run(args: argparse.Namespace) -> int:
    """Run the whole loop once."""
    write_report, progress_bar = _analysis()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    from fourbar_ros.common.config_files import share_directory
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE',
                          str(share_directory() / 'config' / 'fastdds_loopback.xml'))
    from fourbar_ros.ros.environment import check_environment
    check_environment()
    from fourbar_ros.operator.client import TestbedClient

    with TestbedClient() as testbed, ExitStack() as stack:
        # At once, because what comes next takes seconds where somebody else computes.
        _refuse_second_plant(testbed)
        scenario = _one_move(args.preset or PRESETS[args.device])
        # Once here, or three nodes would do it side by side.
        from fourbar_ros.loop.warm_up import main as compile_kernels
        compile_kernels()
        _refuse_second_plant(testbed)
        stack.enter_context(_locked(args.output))
        _prepare(args.output)
        parameters = _write_parameters(
            scenario, args.device, args.output / 'parameters.yaml')
        nodes = (*DEVICES[args.device], 'estimator', 'controller')
        with Processes(args.output / 'logs', os.environ) as processes:
            _start(processes, nodes, args.output / 'bag', parameters)
            _move(testbed, processes, scenario, progress_bar)
            processes.stop(*nodes)
            processes.stop('record')
    print('Writing the report')
    metrics = write_report(args.output / 'bag', args.output / 'report.html',
                           args.output / 'metrics.json')
    _print_table(metrics)
    # What is left is the interpreter's end: it need not look for garbage in all of matplotlib.
    gc.freeze()
    print(f'Report   {args.output / "report.html"}')
    return 0


def _one_move(preset: str) -> Scenario:
    """Read the scenario."""
    from fourbar_ros.loop import load_scenario
    scenario = load_scenario(preset)
    if len(scenario.setpoints) != 1:
        raise DemoError(f'--preset {preset}: the demo makes one move, this scenario has '
                        f'{len(scenario.setpoints)} setpoints')
    return scenario


def _analysis() -> tuple[Callable[..., dict[str, Any]], Any]:
    try:
        from fourbar_ros.analysis.report import write_report
        from tqdm import tqdm
    except ImportError as error:
        raise DemoError(
            f'{error.name} is missing: pip install fourbar_ros[analysis]') from None
    return write_report, tqdm


def _refuse_second_plant(testbed: Any) -> None:
    """Make sure that nobody is driven by accident, neither a real table nor another demo."""
    if testbed.wait(testbed.has_device, LOOK_AROUND):
        domain = os.environ.get('ROS_DOMAIN_ID', '0')
        raise DemoError(f'a device already runs on ROS_DOMAIN_ID {domain}: stop it, or set '
                        'another ROS_DOMAIN_ID')


@contextmanager
def _locked(output: Path) -> Iterator[None]:
    """Keep two demos on different domains out of one folder."""
    try:
        output.mkdir(parents=True, exist_ok=True)
        folder = os.open(output, os.O_RDONLY)
    except OSError as error:
        raise OutputError(f'cannot write to {output}: {error.strerror}') from None
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError:
        raise DemoError(f'another demo is writing to {output}') from None
    finally:
        os.close(folder)


def _prepare(output: Path) -> None:
    """Empty the output folder, leaving alone what is not the demo's."""
    try:
        for name in ('bag', 'logs'):
            if (output / name).exists():
                shutil.rmtree(output / name)
        for name in ('report.html', 'metrics.json', 'parameters.yaml'):
            (output / name).unlink(missing_ok=True)
        (output / 'logs').mkdir()
    except OSError as error:
        raise OutputError(
            f'cannot write to {error.filename or output}: {error.strerror}') from None


def _write_parameters(scenario: Scenario, device: str, path: Path) -> list[str]:
    """
    Write the parameters of the nodes.

    :returns: the arguments with which a node takes them.
    """
    parameters = scenario.parameters()
    parameters['plant']['command_timeout'] = PATIENCE
    if device == 'prototype':
        parameters.update(_on_a_bus(parameters.pop('plant')))
    parameters['controller']['setpoint_duration'] = _duration(scenario)
    with atomic_file(path) as file:
        yaml.safe_dump({f'/**/{node}': {'ros__parameters': values}
                        for node, values in parameters.items()}, file, sort_keys=False)
    return ['--ros-args', '--params-file', str(path.absolute())]


def _on_a_bus(plant: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Share the parameters of a plant out between the hardware node and the emulated links."""
    of_the_table = {name: plant[name] for name in plant
                    if name in ('mechanism', 'table', 'seed', 'step')
                    or name.startswith('initial.')}
    of_the_device = {name: plant[name] for name in (
        'mechanism', 'rate', 'command_timeout', 'sensor_timeout', 'timeout_action')}
    from fourbar_ros.hardware.bus_settings import free_addresses
    host, links = free_addresses(2)
    bus = {'bus.interface': 'fourbar_udp'}
    return {
        'prototype_emulator': {
            **of_the_table, **bus, 'bus.channel': links, 'bus.options': f'peers={host}',
            'command_timeout': PATIENCE},
        'hardware': {
            **of_the_device, **bus, 'bus.channel': host, 'bus.options': f'peers={links}'},
    }


def _duration(scenario: Scenario) -> float:
    """Return the time in which the setpoint is reached [s]."""
    return scenario.setpoints[0].duration or scenario.controller.setpoint_duration


def _start(processes: Processes, nodes: Sequence[str], bag: Path, parameters: Sequence[str]
           ) -> None:
    domain = os.environ.get('ROS_DOMAIN_ID', '0')
    print(f'Starting {", ".join(nodes)}. Watch them from another terminal:\n'
          f'  ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST '
          'ros2 topic echo /estimate/link_states', flush=True)
    processes.start('record', ['-o', str(bag)])
    for name in nodes:
        processes.start(name, parameters)


def _move(testbed: Any, processes: Processes, scenario: Scenario, progress_bar: Any) -> None:
    """Wait for everything, arm, move, and stop everything again."""
    # What the report needs, loaded while there is nothing to do but wait.
    import fourbar_ros.analysis.report_figures  # noqa: F401
    from fourbar_ros.ros.environment import lower_priority

    def until(condition: Callable[[], bool], missing: str, seconds: float = START_UP) -> None:
        def checked() -> bool:
            processes.check()
            return condition()
        testbed.wait(checked, seconds, missing)

    lower_priority()
    testbed.advertise_setpoints()
    testbed.subscribe_statuses(*STATUSES)
    testbed.subscribe_joint_states(*JOINTS)
    until(lambda: len(testbed.statuses) == len(STATUSES)
          and len(testbed.joint_states) == len(JOINTS)
          and testbed.is_recorded((names.SETPOINT, *STATUSES, *JOINTS)),
          'the nodes did not find each other')
    # Watching everything would cost the loop as much as a node does.
    testbed.unsubscribe(*(set(JOINTS) - set(WATCHED)))
    settled_ns = testbed.stamp_ns() + SETTLE_BEFORE * 1e9
    until(lambda: bool(testbed.stamp_ns() >= settled_ns), 'no ticks came')
    _demand(*testbed.call_set_bool(names.ARM, True))
    until(lambda: testbed.statuses[names.DEVICE_STATUS]['state'] == 'armed',
          'no word of the arming')
    until(lambda: _armed(testbed) and testbed.statuses[names.CONTROLLER_STATUS]['mode'] == 'hold',
          'the controller did not notice the arming')
    setpoint = scenario.setpoints[0]
    accepted, reason = testbed.send_setpoint(setpoint.names, setpoint.positions)
    _demand(accepted or not _armed(testbed), f'setpoint refused: {reason}')

    start_ns = testbed.stamp_ns()
    duration = _duration(scenario) + SETTLE_AFTER
    goal = ', '.join(f'{name} to {degrees(angle):g} deg'
                     for name, angle in zip(setpoint.names, setpoint.positions))
    print(f'Turning {goal}, {duration:.1f} s', flush=True)
    # disable=None: a bar only where stderr is a terminal.
    with progress_bar(total=duration, bar_format=PROGRESS, disable=None) as bar:
        def arrived() -> bool:
            _armed(testbed)
            elapsed = (testbed.stamp_ns() - start_ns) * 1e-9
            link = setpoint.names[0]
            angle = degrees(testbed.positions(names.ESTIMATE_LINK_STATES, [link])[0])
            bar.set_postfix_str(f'{link} at {angle:.1f} deg', refresh=False)
            bar.update(min(elapsed, duration) - bar.n)
            return bool(elapsed >= duration)
        until(arrived, 'the motion did not end', 3.0 * duration)
    testbed.call_set_bool(names.ARM, False)


def _armed(testbed: Any) -> bool:
    """Make sure that the device is still armed, or say why not."""
    device = testbed.statuses[names.DEVICE_STATUS]
    _demand(device['state'] == 'armed', f'the device is {device["state"]}: {device["reason"]}')
    return True


def _demand(success: bool, message: str) -> None:
    if not success:
        raise DemoError(message)


def _print_table(metrics: dict[str, Any]) -> None:
    """Print what a person wants to know first; everything is in metrics.json."""
    print()
    for text, name, factor, unit in TABLE:
        group, _, key = name.partition('.')
        value = metrics.get(group, {}).get(key)
        shown = 'not recorded' if value is None else f'{value * factor:10.4g} {unit}'
        print(f'  {text:34} {shown}'.rstrip())
    print()
