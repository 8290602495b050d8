# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""How every node starts, runs and ends."""

import argparse
import gc
import signal
import time

from fourbar_ros.kernels.compiler import announced
from fourbar_ros.ros.environment import RosError
from fourbar_ros.ros.priority import go_first
import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidTopicNameException,
    ParameterException,
)
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

# The executor of these wheels hangs in any wait without a time limit [s].
SPIN_TIMEOUT = 0.2

# How long a node that ends waits for others to take what it said last [s].
LAST_WORDS = 0.5


class Runtime:
    """
    ROS of one process: context, executor, and signals that only raise a flag.

    rclpy's own signal handling ends the context before anybody can send a last zero torque.
    """

    def __init__(self, ros_args=()):
        self.stopping = False
        self.failure = None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._stop)
        try:
            rclpy.init(args=list(ros_args), signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # noqa: BLE001 - rcl's errors have no common class
            raise RosError(_first_line(error)) from None
        self.executor = EventsExecutor()

    def _stop(self, _number, _frame):
        self.stopping = True

    def guard(self, callback):
        """Wrap a callback: an exception that leaves one would print FATAL and a traceback."""
        def guarded(*args):
            try:
                return callback(*args)
            except Exception as error:  # noqa: BLE001 - whatever it is, the node must end cleanly
                self.failure = self.failure or error
                return args[1] if len(args) > 1 else None
        return guarded

    def spin(self, work=None, real_time=False):
        """
        Run callbacks until a signal or a failure; raises the failure.

        :param work: called again and again instead, by a node that lets ROS have its turn itself.
        :param real_time: ask for real-time priority.
        """
        # What lives until the end need not be searched for garbage: with all that numba and
        # matplotlib leave behind, one full search takes longer than several ticks.
        gc.collect()
        gc.freeze()
        if real_time:
            go_first()
        while not self.stopping and self.failure is None:
            if work is None:
                self.executor.spin_once(timeout_sec=SPIN_TIMEOUT)
            else:
                work()
        if self.failure is not None:
            raise self.failure

    def shut_down(self, node=None):
        """
        End ROS in this process, and a node first.

        The executor before it, which holds what the node is made of: a participant of Fast DDS
        that is left to the end of the process may wait there for its own callbacks, for ever.
        """
        self.executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def run_node(make_node, name, description, argv):
    """
    Run one node until a signal.

    :param make_node: called with the runtime, returns a node with a `close()`, and with a `work()`
        where it does not live on callbacks, and `simulated` where its time is, whatever its
        parameter use_sim_time says.
    :param argv: what follows the executable's name.
    :returns: exit code.
    :raises RosError: bad arguments or no usable ROS.
    """
    argv = list(argv)
    parser = argparse.ArgumentParser(
        prog=f'fourbar {name}', description=description, usage=f'fourbar {name} [--ros-args ...]',
        epilog='Parameters (-p name:=value, --params-file FILE), remapping (-r) and namespace '
               '(-r __ns:=/lab) follow --ros-args. docs/topics.md lists topics and parameters, '
               'with units.')
    try:
        ros_free = remove_ros_args(args=[name, *argv])[1:]
    except Exception as error:  # noqa: BLE001 - rcl's errors have no common class
        raise RosError(_first_line(error)) from None
    parser.parse_args(ros_free)
    runtime = Runtime(argv)
    node = None
    try:
        # Every kernel is compiled while the node is made, none while it runs.
        with announced():
            node = make_node(runtime)
        runtime.executor.add_node(node)
        # Simulated time waits; nodes that go as fast as they can would leave others no processor.
        simulated = getattr(node, 'simulated', node.get_parameter('use_sim_time').value)
        runtime.spin(getattr(node, 'work', None), real_time=not simulated)
    except (InvalidNamespaceException, InvalidNodeNameException, InvalidTopicNameException,
            ParameterException) as error:
        raise RosError(_first_line(error)) from None
    finally:
        if node is not None:
            node.close()
            deliver(node.publishers)
        runtime.shut_down(node)
    return 0


def deliver(publishers):
    """
    Wait until every reliable subscriber has what was published, the last zero torque above all.

    What is still under way when its publisher ends is lost.
    """
    end = time.monotonic() + LAST_WORDS
    for publisher in publishers:
        publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))


def _first_line(error):
    return ' '.join(str(error).split()) or type(error).__name__
