# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""End of the nodes by signals: in time, without errors, and with coasting wheels."""

from functools import partial
from itertools import product
from pathlib import Path
import signal
import subprocess
import sys

import pytest
from sensor_msgs.msg import JointState

pytestmark = pytest.mark.node

# Time limit for the end of a node: two seconds, and a margin for a busy machine [s].
SHUTDOWN_S = 2.0 + 3.0
SIGNALS = pytest.mark.parametrize(
    'number', [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
               pytest.param(signal.SIGHUP, marks=pytest.mark.slow)],
    ids=lambda number: number.name)


@SIGNALS
def test_moving_testbed_ends_cleanly(suite, make_probe, number):
    """Controller, estimator and plant end in this order, in the middle of a move."""
    namespace = f'/{number.name.lower()}'
    nodes = suite.nodes(namespace, fresh=True)
    probe = make_probe(namespace)
    probe.follow('flywheel_command', 'sim/flywheel_states', 'flywheel_states')
    probe.newest('flywheel_command')
    probe.wait(lambda: probe.arm().success)
    probe.status('controller_status', mode='hold')
    probe.setpoint_decision(JointState(name=['link_a'], position=[0.5]),
                            probe.publisher(JointState, 'setpoint'))
    probe.wait(lambda: any(probe.received['flywheel_command'][-1].effort))

    assert nodes['controller'].end(number, SHUTDOWN_S) == 0
    nodes['controller'].check_clean()
    # The last command is without torque.
    probe.wait(lambda: not any(probe.received['flywheel_command'][-1].effort))
    count = len(probe.received['flywheel_command'])
    status = probe.status('device_status', state='disarmed')
    assert 'no flywheel_command' in status['reason']
    assert len(probe.received['flywheel_command']) == count

    probe.drive([1e-5] * 4)
    probe.wait(lambda: probe.arm().success)
    nodes['plant'].send(number)
    assert probe.status('device_status', state='disarmed')['reason'] == 'the node ends'
    for name in ('plant', 'estimator'):
        assert nodes[name].end(None if name == 'plant' else number, SHUTDOWN_S) == 0
        nodes[name].check_clean()


@pytest.fixture(scope='module')
def alone(module_suite):
    """Start nodes in parallel, each in its own namespace."""
    return {namespace: module_suite.node(name, namespace=f'/{namespace}', fresh=True)
            for namespace, name in (
                ('alone_plant', 'plant'), ('alone_estimator', 'estimator'),
                ('alone_controller', 'controller'), ('twice', 'controller'))}


@pytest.mark.parametrize('name', ['plant', 'estimator', 'controller'])
def test_node_without_other_nodes_ends_in_time(alone, make_probe, name):
    """A node without publishers and subscribers waits for none of them."""
    process = alone[f'alone_{name}']
    probe = make_probe(f'/alone_{name}')
    probe.diagnostics(f'alone_{name}/{name}')
    assert process.end(signal.SIGINT, SHUTDOWN_S) == 0
    process.check_clean()
    assert process.stdout == '' or name == 'plant'


def test_second_signal_does_no_harm(alone, make_probe):
    process = alone['twice']
    make_probe('/twice').diagnostics('twice/controller')
    for _ in range(3):
        process.send(signal.SIGINT)
    assert process.end(seconds=SHUTDOWN_S) == 0
    process.check_clean()


def test_signal_during_the_start_prints_no_error(suite, make_probe):
    """The node ends without a traceback of the package, ready or not."""
    process = suite.node('plant', namespace='/early', fresh=True)
    make_probe().wait(lambda: process.stderr)
    process.send(signal.SIGINT)
    assert process.end(seconds=SHUTDOWN_S) == 0
    process.check_clean()


# Program that runs a command and prints the threads of the middleware after the end of ROS.
WATCHED = """
import os, sys
from fourbar_ros.ros import runtime
from fourbar_ros.cli.main import main
end = runtime.Runtime.shut_down
def shut_down(self, *args):
    end(self, *args)
    names = [open(f'/proc/self/task/{task}/comm').read().strip()
             for task in os.listdir('/proc/self/task')]
    print('threads', *(name for name in names if name.startswith('dds.')), flush=True)
runtime.Runtime.shut_down = shut_down
sys.exit(main())
"""


NAMES = ('plant', 'estimator', 'controller', 'record')


def has_middleware(process):
    """Return whether a process has ended or has threads of the middleware."""
    threads = Path(f'/proc/{process.pid}/task').glob('*/comm')
    return process.poll() is not None or b'dds.' in b''.join(
        path.read_bytes() for path in threads)


@pytest.fixture(scope='module')
def watched(domain, shared_memory, tmp_path_factory, load_clock):
    """
    Run commands in parallel until they have threads of the middleware, and stop them.

    :returns: stdout by name and whether the command follows simulated time.
    """
    started = {}
    for number, (name, sim_time) in enumerate(product(NAMES, (False, True))):
        arguments = ['--ros-args', '-r', f'__ns:=/watched_{number}',
                     '-p', f'use_sim_time:={str(sim_time).lower()}']
        if name == 'record':
            arguments = ['-o', 'bag']
        started[name, sim_time] = subprocess.Popen(
            [sys.executable, '-c', WATCHED, name, *arguments],
            cwd=tmp_path_factory.mktemp('watched'),
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    printed = {}
    try:
        for process in started.values():
            # The middleware starts its threads before the node handles signals.
            load_clock.wait(partial(has_middleware, process))
            assert process.poll() is None
            shared_memory.note(process.pid)
            process.send_signal(signal.SIGINT)
        for key, process in started.items():
            printed[key], _ = process.communicate(timeout=20.0)
    finally:
        for process in started.values():
            process.kill()
            process.communicate()
    return printed


@pytest.mark.slow
@pytest.mark.parametrize('sim_time', [False, True], ids=['', 'sim_time'])
@pytest.mark.parametrize('name', NAMES)
def test_middleware_has_no_threads_at_the_end_of_a_process(watched, name, sim_time):
    """At the end of a process the middleware may wait for its own callbacks in an endless loop."""
    line, = [line for line in watched[name, sim_time].splitlines() if line.startswith('threads')]
    # This thread belongs to the process.
    assert set(line.split()[1:]) <= {'dds.shm.wdog'}
