# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
A server that forks processes of the package after all imports.

The imports of a node take more than a second, and the tests start hundreds of nodes. Run as a
script, this module is the parent of these processes. It never initialises ROS and has no threads
but the idle tracers of the middleware, so a child starts where `python -m fourbar_ros` is after
its imports, and ends like it.
"""

import ctypes
import gc
import json
import os
import signal
import subprocess
import sys
import time

# Option of prctl: signal that the process gets when its parent ends.
PR_SET_PDEATHSIG = 1


class ForkServer:
    """The parent of forked processes; the first request starts it and `close` ends it."""

    def __init__(self):
        self._process = None

    def ask(self, **request):
        """Send a request and return the answer."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                text=True,
                # A fork would lose further threads of BLAS; no array here is large.
                env={**os.environ, 'OPENBLAS_NUM_THREADS': '1'})
        self._process.stdin.write(json.dumps(request) + '\n')
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        assert answer, 'the fork server has ended'
        return json.loads(answer)

    def start(self, arguments, folder, out, err, environment):
        """Start `fourbar ARGUMENTS` in a folder, with files for what it prints."""
        return Forked(self, self.ask(
            arguments=arguments, folder=str(folder), out=str(out), err=str(err),
            environment=environment))

    def close(self):
        """End the parent; the children end by themselves."""
        if self._process is None:
            return
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


class Forked:
    """
    A forked process with the interface of subprocess.Popen.

    :ivar returncode: exit code as of Popen, None until `poll` has found the end of the process.
    """

    def __init__(self, fork_server, pid):
        self._fork_server = fork_server
        self.pid = pid
        self.returncode = None

    def poll(self):
        """Return the exit code, None while it runs."""
        if self.returncode is None:
            self.returncode = self._fork_server.ask(poll=self.pid)
        return self.returncode

    def wait(self, timeout=None):
        """Wait for the end and return the exit code."""
        end = None if timeout is None else time.monotonic() + timeout
        while self.poll() is None:
            if end is not None and time.monotonic() > end:
                raise subprocess.TimeoutExpired(['forked', str(self.pid)], timeout)
            time.sleep(0.01)
        return self.returncode

    def send_signal(self, number):
        """Send a signal unless it has ended."""
        # A process keeps its number until it is polled after its end.
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        """Kill the process."""
        self.send_signal(signal.SIGKILL)


def _serve():
    """Fork at every request, and return in the child, with its arguments."""
    from fourbar_ros.cli import main  # noqa: F401
    from fourbar_ros.loop.warm_up import warm_up
    from fourbar_ros.operator import recorder  # noqa: F401
    from fourbar_ros.ros import controller, estimator, plant  # noqa: F401
    warm_up()
    # Without this every child would copy these objects at its end for the garbage collection.
    gc.collect()
    gc.freeze()
    for line in sys.stdin:
        request = json.loads(line)
        if 'poll' in request:
            pid, status = os.waitpid(request['poll'], os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if pid else None
        else:
            answer = os.fork()
            if answer == 0:
                return _become(**request)
        print(json.dumps(answer), flush=True)
    return None


def _become(arguments, folder, out, err, environment):
    """Put this process where a new one would be started, and end it with its parent."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    for number, (path, mode) in enumerate(
            ((os.devnull, os.O_RDONLY), (out, flags), (err, flags))):
        file = os.open(path, mode, 0o666)
        os.dup2(file, number)
        os.close(file)
    return arguments


if __name__ == '__main__':
    if (given := _serve()) is not None:
        from fourbar_ros.cli.main import main as run
        sys.argv = ['fourbar', *given]
        sys.exit(run())
