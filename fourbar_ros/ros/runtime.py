# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""rclpy of one process: context, executor, signals and shutdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import gc
import signal
import time
from typing import Any

from fourbar_ros.ros.environment import RosError
import rclpy
from rclpy.duration import Duration
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import try_shutdown

# Longest wait of the executor for a callback [s]; the one of Jazzy hangs in endless waits.
SPIN_TIMEOUT = 0.2
# Longest wait at the end for subscribers to acknowledge the last messages [s].
FLUSH_TIMEOUT = 0.5


class Runtime:
    """
    Context and executor of one process, with signal handlers that only set a flag.

    The signal handlers of rclpy shut the context down before a node can publish a last zero
    torque.

    :param ros_args: arguments of ROS, `--ros-args` included.
    :ivar stopping: whether SIGINT, SIGTERM or SIGHUP arrived.
    :ivar failure: first exception that a guarded callback raised, or None.
    :raises RosError: rcl refuses the arguments.
    """

    def __init__(self, ros_args: Sequence[str] = ()) -> None:
        self.stopping = False
        self.failure: Exception | None = None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._stop)
        try:
            rclpy.init(args=list(ros_args), signal_handler_options=SignalHandlerOptions.NO)
        except Exception as error:  # noqa: BLE001 - the errors of rcl have no common class
            raise RosError(one_line(error)) from None
        self.executor: Any = EventsExecutor()

    def _stop(self, _number: int, _frame: object) -> None:
        self.stopping = True

    def guard(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """
        Return a callback that keeps an exception in `failure`.

        An exception that leaves a callback makes rclpy print FATAL and a traceback. A guarded
        service callback returns its response unchanged then.
        """
        def guarded(*args: Any) -> Any:
            try:
                return callback(*args)
            except Exception as error:  # noqa: BLE001 - the node must end cleanly after any error
                self.failure = self.failure or error
                return args[1] if len(args) > 1 else None
        return guarded

    def spin_once(self, timeout: float = SPIN_TIMEOUT) -> None:
        """
        Run the next callback.

        :param timeout: longest wait for it [s].
        """
        self.executor.spin_once(timeout_sec=timeout)

    def spin(self, run_once: Callable[[], None]) -> None:
        """
        Call a function until a signal arrives or a callback fails.

        :param run_once: returns within a fraction of a second.
        :raises Exception: the failure of a guarded callback.
        """
        exempt_from_garbage_collection()
        while not self.stopping and self.failure is None:
            run_once()
        if self.failure is not None:
            raise self.failure

    def shut_down(self, node: Node | None = None) -> None:
        """
        Destroy executor, node and context, in this order.

        The executor holds references to the parts of the node. A participant of Fast DDS that
        lives until the end of the process may wait there for its own callbacks for ever.
        """
        self.executor.shutdown()
        if node is not None:
            node.destroy_node()
        try_shutdown()


def exempt_from_garbage_collection() -> None:
    """
    Exempt all present objects from garbage collection.

    With the objects of numba and matplotlib one full collection takes longer than several ticks.
    """
    gc.collect()
    gc.freeze()


def flush(publishers: Iterable[Publisher]) -> None:
    """
    Wait until the reliable subscribers have acknowledged all messages, at most FLUSH_TIMEOUT.

    A message that is still on its way when its publisher is destroyed is lost; the last zero
    torque must not be.
    """
    end = time.monotonic() + FLUSH_TIMEOUT
    for publisher in publishers:
        publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))


def one_line(error: BaseException) -> str:
    """Return the message of an error in one line."""
    return ' '.join(str(error).split()) or type(error).__name__
