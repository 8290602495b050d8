# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar demo`: run the nodes of a scenario, one move, a recording and a report."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import fcntl
import gc
from math import degrees
import os
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

from fourbar_ros.cli.options import analysis_extra
from fourbar_ros.cli.processes import Processes
from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.output_files import atomic_file, OutputError
import yaml

if TYPE_CHECKING:
    from fourbar_ros.loop import Scenario

# Nodes of each kind of device; estimator and controller start after them.
DEVICES = {'simulated': ('plant',), 'prototype': ('prototype_emulator', 'hardware')}
PRESETS = {'simulated': 'paper', 'prototype': 'prototype'}

STATUSES = (names.DEVICE_STATUS, names.CONTROLLER_STATUS)
JOINTS = (
    names.LINK_ANGLES, names.FLYWHEEL_STATES, names.FLYWHEEL_COMMAND, names.TIMING,
    names.SIM_LINK_STATES, names.SIM_FLYWHEEL_STATES, names.ESTIMATE_LINK_STATES,
    names.ESTIMATE_SIGMA, names.ESTIMATE_INNOVATION,
    names.REFERENCE, names.TRACKING_ERROR, names.ENERGY, names.ALLOCATION, names.MOMENTUM,
)
# Topics that the demo receives during the motion; all topics would load the machine.
WATCHED = (names.FLYWHEEL_STATES, names.ESTIMATE_LINK_STATES)

PROGRESS = '|{bar:40}| {n:4.1f} of {total:.1f} s{postfix}'
# Label, metric, factor and unit of the printed results.
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

# Command timeout of the device [s], longer than by default: a loaded laptop delays the nodes.
COMMAND_TIMEOUT_S = 3.0
# Time to discover another device [s].
DISCOVERY_S = 0.5
# Longest time until all nodes exchange messages [s].
START_UP_S = 30.0
SETTLE_BEFORE_S = 0.3
# Time after the motion [s]; the final error averages over 1 s.
SETTLE_AFTER_S = 1.1

EPILOG = """\
Uses the ROS_DOMAIN_ID of the environment (default 0), with discovery on this machine only.
Writes DIR/bag (rosbag2, MCAP), DIR/report.html, DIR/metrics.json, DIR/parameters.yaml (of the
nodes) and DIR/logs, and replaces those of an earlier demo. Arming and setpoint follow the order of
the scenario, but not its times.
"""


class DemoError(FourbarError):
    """The demo cannot run, or a part of it failed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = EPILOG
    parser.add_argument('--output', metavar='DIR', type=Path, default=Path('demo_output'),
                        help='folder for bag, report and metrics (default demo_output)')
    parser.add_argument('--device', choices=tuple(DEVICES), default='simulated',
                        help='simulated (default): the plant; prototype: the hardware node with '
                             'emulated links on a bus of this machine')
    parser.add_argument('--preset', metavar='NAME',
                        help='scenario with one setpoint: paper (default), prototype (default of '
                             'device prototype) or a file')


def run(args: argparse.Namespace) -> int:
    """Run the complete loop once."""
    with analysis_extra():
        from fourbar_ros.analysis.report import write_report
        import tqdm  # noqa: F401
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    from fourbar_ros.common.config_files import share_directory
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE',
                          str(share_directory() / 'config' / 'fastdds_loopback.xml'))
    from fourbar_ros.ros.environment import check_environment
    check_environment()
    from fourbar_ros.operator.client import TestbedClient

    output: Path = args.output
    with TestbedClient() as testbed:
        # Before the compilation, which takes seconds on a loaded machine, and after it.
        _refuse_other_device(testbed)
        scenario = load_one_move(args.preset or PRESETS[args.device])
        # Compile the kernels once here; otherwise three nodes would do it at the same time.
        from fourbar_ros.loop.warm_up import main as compile_kernels
        compile_kernels()
        _refuse_other_device(testbed)
        nodes = (*DEVICES[args.device], 'estimator', 'controller')
        with _locked(output):
            _clear(output)
            write_parameters(scenario, args.device, output / 'parameters.yaml')
            with Processes(output / 'logs', os.environ) as processes:
                _start(processes, nodes, output)
                _move(testbed, processes, scenario)
                processes.stop(*nodes)
                processes.stop('record')
    print('Writing the report')
    metrics = write_report(output / 'bag', output / 'report.html', output / 'metrics.json')
    _print_table(metrics)
    # No garbage collection over all objects of matplotlib at the end of the interpreter.
    gc.freeze()
    print(f'Report   {output / "report.html"}')
    return 0


def load_one_move(preset: str) -> Scenario:
    """
    Load a scenario with one setpoint.

    :raises FourbarError: the scenario is refused, or has another number of setpoints.
    """
    from fourbar_ros.loop import load_scenario
    scenario = load_scenario(preset)
    if len(scenario.setpoints) != 1:
        raise DemoError(f'--preset {preset}: the demo requires a scenario with 1 setpoint, this '
                        f'one has {len(scenario.setpoints)}', name='setpoints',
                        value=len(scenario.setpoints), limit=1)
    return scenario


def _refuse_other_device(testbed: Any) -> None:
    """Refuse to drive the device of another demo or of the laboratory by accident."""
    if testbed.wait(testbed.has_device, DISCOVERY_S):
        domain = os.environ.get('ROS_DOMAIN_ID', '0')
        raise DemoError(f'a device already runs on ROS_DOMAIN_ID {domain}: stop it, or set '
                        'another ROS_DOMAIN_ID', name='ROS_DOMAIN_ID', value=domain)


@contextmanager
def _locked(output: Path) -> Iterator[None]:
    """Create the output folder, and lock it against a demo on another domain."""
    try:
        output.mkdir(parents=True, exist_ok=True)
        folder = os.open(output, os.O_RDONLY)
    except OSError as error:
        raise OutputError(f'cannot write to {output}: {error.strerror}', path=output,
                          errno=error.errno) from None
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError:
        raise DemoError(f'another demo is writing to {output}', path=output) from None
    finally:
        os.close(folder)


def _clear(output: Path) -> None:
    """Remove the files of an earlier demo, and no others."""
    try:
        for name in ('bag', 'logs'):
            if (output / name).exists():
                shutil.rmtree(output / name)
        for name in ('report.html', 'metrics.json', 'parameters.yaml'):
            (output / name).unlink(missing_ok=True)
        (output / 'logs').mkdir()
    except OSError as error:
        raise OutputError(f'cannot write to {error.filename or output}: {error.strerror}',
                          path=output, errno=error.errno) from None


def write_parameters(scenario: Scenario, device: str, path: Path) -> None:
    """
    Write the ROS parameters file of all nodes.

    :param device: a key of `DEVICES`.
    """
    parameters = scenario.parameters()
    parameters['plant']['command_timeout'] = COMMAND_TIMEOUT_S
    if device == 'prototype':
        parameters.update(_prototype_parameters(parameters.pop('plant')))
    parameters['controller']['setpoint_duration'] = _duration_s(scenario)
    with atomic_file(path) as file:
        yaml.safe_dump({f'/**/{node}': {'ros__parameters': values}
                        for node, values in parameters.items()}, file, sort_keys=False)


def _prototype_parameters(plant: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the parameters of hardware node and emulator for those of a plant."""
    from fourbar_ros.hardware.bus_settings import free_addresses

    host, links = free_addresses(2)
    table = {name: value for name, value in plant.items()
             if name in ('mechanism', 'table', 'seed', 'step') or name.startswith('initial.')}
    device = {name: plant[name] for name in (
        'mechanism', 'rate', 'command_timeout', 'sensor_timeout', 'timeout_action')}

    def bus(own: str, peer: str) -> dict[str, Any]:
        return {'bus.interface': 'fourbar_udp', 'bus.channel': own, 'bus.options': f'peers={peer}'}
    return {
        'prototype_emulator': {
            **table, **bus(links, host), 'command_timeout': COMMAND_TIMEOUT_S},
        'hardware': {**device, **bus(host, links), 'safety': 'emulated'},
    }


def _duration_s(scenario: Scenario) -> float:
    """Return the duration of the step to the setpoint [s]."""
    return scenario.setpoints[0].duration or scenario.controller.setpoint_duration


def _start(processes: Processes, nodes: Sequence[str], output: Path) -> None:
    domain = os.environ.get('ROS_DOMAIN_ID', '0')
    print(f'Starting {", ".join(nodes)}. To watch them in another terminal:\n'
          f'  ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST '
          'ros2 topic echo /estimate/link_states', flush=True)
    processes.start('record', ['-o', str(output / 'bag')])
    for name in nodes:
        processes.start(name, ['--ros-args', '--params-file',
                               str((output / 'parameters.yaml').absolute())])


def _move(testbed: Any, processes: Processes, scenario: Scenario) -> None:
    """Wait for all nodes, arm, send the setpoint, wait for the end of the motion, disarm."""
    # Load the libraries of the report during the start of the nodes.
    import fourbar_ros.analysis.report_figures  # noqa: F401
    from fourbar_ros.ros.environment import lower_priority
    from tqdm import tqdm

    def wait_until(condition: Callable[[], Any], failure: str, seconds: float = START_UP_S
                   ) -> None:
        def checked() -> bool:
            processes.check()
            return bool(condition())
        testbed.wait(checked, seconds, failure)

    def armed() -> bool:
        status = testbed.statuses[names.DEVICE_STATUS]
        if status['state'] != 'armed':
            raise DemoError(f'the device is {status["state"]}: {status["reason"]}',
                            name='state', value=status['state'])
        return True

    def controller_mode() -> str:
        return str(testbed.statuses[names.CONTROLLER_STATUS]['mode'])

    lower_priority()
    testbed.advertise_setpoints()
    testbed.subscribe_statuses(*STATUSES)
    testbed.subscribe_joint_states(*JOINTS)
    wait_until(lambda: len(testbed.statuses) == len(STATUSES)
               and len(testbed.joint_states) == len(JOINTS)
               and testbed.is_recorded((names.SETPOINT, *STATUSES, *JOINTS)),
               'the nodes did not exchange messages')
    testbed.unsubscribe(*(set(JOINTS) - set(WATCHED)))
    settled_ns = testbed.stamp_ns() + SETTLE_BEFORE_S * 1e9
    wait_until(lambda: testbed.stamp_ns() >= settled_ns, 'the device published no ticks')
    success, message = testbed.call_set_bool(names.ARM, True)
    if not success:
        raise DemoError(message)
    wait_until(lambda: testbed.statuses[names.DEVICE_STATUS]['state'] == 'armed',
               'the device did not report that it is armed')
    wait_until(lambda: armed() and controller_mode() == 'hold',
               'the controller did not react to the arming')
    setpoint = scenario.setpoints[0]
    accepted, reason = testbed.send_setpoint(setpoint.names, setpoint.positions)
    if not accepted and armed():
        raise DemoError(f'setpoint refused: {reason}')

    start_ns, link = testbed.stamp_ns(), setpoint.names[0]
    duration_s = _duration_s(scenario) + SETTLE_AFTER_S
    goal = ', '.join(f'{name} to {degrees(angle):g} deg'
                     for name, angle in zip(setpoint.names, setpoint.positions))
    print(f'Turning {goal}, {duration_s:.1f} s', flush=True)
    # disable=None: a progress bar only if stderr is a terminal.
    with tqdm(total=duration_s, bar_format=PROGRESS, disable=None) as bar:
        def finished() -> bool:
            armed()
            elapsed_s = (testbed.stamp_ns() - start_ns) * 1e-9
            angle = degrees(testbed.positions(names.ESTIMATE_LINK_STATES, [link])[0])
            bar.set_postfix_str(f'{link} at {angle:.1f} deg', refresh=False)
            bar.update(min(elapsed_s, duration_s) - bar.n)
            return bool(elapsed_s >= duration_s)
        wait_until(finished, 'the motion did not end', 3.0 * duration_s)
    testbed.call_set_bool(names.ARM, False)


def _print_table(metrics: dict[str, Any]) -> None:
    """Print the main metrics; metrics.json has all of them."""
    print()
    for text, name, factor, unit in TABLE:
        group, _, key = name.partition('.')
        value = metrics.get(group, {}).get(key)
        shown = 'not recorded' if value is None else f'{value * factor:10.4g} {unit}'
        print(f'  {text:34} {shown}'.rstrip())
    print()
