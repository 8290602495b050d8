# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Child processes that end with their parent and are stopped in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
import ctypes
from pathlib import Path
import signal
import subprocess
import sys
import time
from types import TracebackType

import fourbar_ros
from fourbar_ros.common.errors import FourbarError

# From <sys/prctl.h>: the kernel sends a signal when the parent ends in any way.
PR_SET_PDEATHSIG = 1
# Time for a process to end after a signal, before the next stronger signal [s].
SIGNAL_TIMEOUT_S = 5.0

LIBC = ctypes.CDLL(None)


class ProcessError(FourbarError):
    """A child process ended early; `values` hold `name` and `value`, its exit code."""


class Processes:
    """
    Commands of this package in child processes; use as a context manager.

    Each child has its own session, so that Ctrl-C reaches the parent only and the children stop
    in order. Children end with the parent, even if it is killed.

    :param logs: folder for the output of the children, one file each.
    :param environment: of the children.
    """

    def __init__(self, logs: Path, environment: Mapping[str, str]) -> None:
        self._logs = logs
        self._environment = dict(environment)
        if not Path(fourbar_ros.__file__).parents[1].samefile(Path.cwd()):
            # Otherwise a checkout in the current directory would hide this package, and each
            # child would compile its kernels. (No effect in Python 3.10.)
            self._environment['PYTHONSAFEPATH'] = '1'
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Stop all children in reverse order of their start."""
        for name in reversed(list(self._running)):
            self.stop(name)

    def start(self, name: str, arguments: Sequence[str] = ()) -> None:
        """Start `fourbar NAME ARGUMENTS`."""
        with open(self._logs / f'{name}.log', 'wb') as log:
            self._running[name] = subprocess.Popen(
                [sys.executable, '-m', 'fourbar_ros', name, *arguments],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                env=self._environment, start_new_session=True, preexec_fn=_end_with_parent)

    def check(self) -> None:
        """
        Check that all children run.

        :raises ProcessError: a child ended; the message has the last line of its log.
        """
        for name, process in self._running.items():
            code = process.poll()
            if code is not None:
                raise ProcessError(f'{name} ended with exit code {code}: {self._last_line(name)}',
                                   name=name, value=code)

    def stop(self, *names: str) -> None:
        """Stop children by SIGINT, SIGTERM and SIGKILL in turn, and wait for their end."""
        processes = [self._running.pop(name) for name in names]
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            for process in processes:
                if process.poll() is None:
                    process.send_signal(number)
            deadline = time.monotonic() + SIGNAL_TIMEOUT_S
            for process in processes:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, deadline - time.monotonic()))

    def _last_line(self, name: str) -> str:
        time.sleep(0.05)    # the log may be written after the end
        lines = (self._logs / f'{name}.log').read_text(errors='replace').strip().splitlines()
        return lines[-1] if lines else 'no output'


def _end_with_parent() -> None:
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
