# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Child processes that never outlive their parent and are stopped in order."""

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

# From <sys/prctl.h>: ask the kernel for a signal when the parent dies, however it dies.
PR_SET_PDEATHSIG = 1

# How long a process may take to end after a signal [s].
PATIENCE = 5.0

LIBC = ctypes.CDLL(None)


class ProcessError(FourbarError):
    """A child process that ended when it should not."""


class Processes:
    """
    Commands of this package in processes of their own; use as a context manager.

    They get their own process group, so that Ctrl-C reaches the parent alone and everything can
    be stopped in order, and end with the parent even if it is killed.

    :param logs: folder for what they print, one file per process.
    :param environment: of all of them.
    """

    def __init__(self, logs: Path, environment: Mapping[str, str]) -> None:
        self._logs = logs
        self._environment = dict(environment)
        if not Path(fourbar_ros.__file__).parents[1].samefile(Path.cwd()):
            # Or they would run the checkout that somebody stands in, instead of this package,
            # and compile its kernels, each for itself. (Python 3.10 does not know it.)
            self._environment['PYTHONSAFEPATH'] = '1'
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Stop whatever still runs, the first started last."""
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
        Make sure that all still run.

        :raises ProcessError: one ended, with the last line that it printed.
        """
        for name, process in self._running.items():
            code = process.poll()
            if code is not None:
                raise ProcessError(f'{name} ended with exit code {code}: {self._last_line(name)}')

    def stop(self, *names: str) -> None:
        """Ask some to end, insist if they do not, and wait until they have."""
        processes = [self._running.pop(name) for name in names]
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            for process in processes:
                if process.poll() is None:
                    process.send_signal(number)
            deadline = time.monotonic() + PATIENCE
            for process in processes:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.0, deadline - time.monotonic()))

    def _last_line(self, name: str) -> str:
        time.sleep(0.05)    # its last words may still be on their way
        lines = (self._logs / f'{name}.log').read_text(errors='replace').strip().splitlines()
        return lines[-1] if lines else 'it said nothing'


def _end_with_parent() -> None:
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
