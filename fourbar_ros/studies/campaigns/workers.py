# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Independent runs on worker processes: of this machine, or of a Dask cluster.

`completed` distributes the runs and recovers from lost processes, whatever the workers are. The
processes of this machine come from `loky`: they take one thread each for linear algebra, open no
port, and end when they are idle, also after their parent is killed. On two busy cores two of them
start in 2 s; those of `dask.distributed.LocalCluster` take 8 to 10 s and open ports on loopback.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import closing, contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
import os
from queue import Empty, SimpleQueue
import signal
import threading
from typing import Any, NoReturn, Protocol, TypeVar

from fourbar_ros.studies.campaigns import CampaignError

_Item = TypeVar('_Item')
_Result = TypeVar('_Result')

# Environment variables by which linear algebra libraries take their number of threads.
THREAD_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')
# Time after which an idle process ends [s]; bounds its life after its parent is killed.
IDLE_TIMEOUT = 10.0
# Period of the check that the workers still exist [s].
POLL_PERIOD = 1.0


class WorkerLostError(Exception):
    """The process that a batch of runs was submitted to died."""


class Workers(Protocol):
    """Processes that execute functions."""

    def capacity(self) -> int:
        """
        Return the number of batches to submit at a time.

        :raises CampaignError: the workers no longer exist.
        """

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Return a future of `work(*arguments)`."""

    def result(self, future: Any) -> Any:
        """
        Return the result of a future that is done.

        :raises WorkerLostError: its process died.
        :raises CampaignError: the workers no longer exist.
        """

    def close(self) -> None:
        """Cancel what is not finished."""


class LocalWorkers:
    """
    Processes of this machine.

    An interrupt reaches the main process alone: the workers start with SIGINT blocked, and ignore
    it afterwards.

    :param jobs: number of processes.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._executor: Any = None

    def capacity(self) -> int:
        """Return one batch more than there are processes, so that none waits for the next."""
        return self._jobs + 1

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Return a future; new processes replace those of an executor that lost one."""
        with interrupts_blocked():
            try:
                return self._current().submit(work, *arguments)
            except BrokenExecutor:
                return self._current().submit(work, *arguments)

    def result(self, future: Any) -> Any:
        """Return the result of a future that is done."""
        try:
            return future.result()
        except BrokenExecutor:
            raise WorkerLostError from None

    def close(self) -> None:
        """Kill the processes."""
        if self._executor is not None:
            self._executor.shutdown(kill_workers=True)

    def _current(self) -> Any:
        import loky

        self._executor = loky.get_reusable_executor(
            self._jobs, timeout=IDLE_TIMEOUT, kill_workers=True,
            initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN),
            env={name: os.environ.get(name) or '1' for name in THREAD_VARIABLES})
        return self._executor


def map_ordered(work: Callable[[_Item], _Result], items: Sequence[_Item], jobs: int
                ) -> Generator[_Result, None, None]:
    """
    Apply a function to each item, in worker processes of this machine.

    :param work: a function of a module, which other processes can import.
    :param jobs: number of processes; 1, or a missing library `loky`, for this process alone.
    :returns: results in the order of the items, whichever is ready first.
    :raises CampaignError: an item repeatedly kills its process.
    """
    ready: dict[int, _Result] = {}
    following = 0
    batches = [[pair] for pair in enumerate(items)]
    with closing(completed_locally(partial(_numbered, work), batches, jobs)) as results:
        for numbered in results:
            ready.update(numbered)
            while following in ready:
                yield ready.pop(following)
                following += 1


def completed_locally(work: Callable[[_Item], _Result], batches: Sequence[Sequence[_Item]],
                      jobs: int) -> Generator[list[_Result], None, None]:
    """
    Apply a function to each item of each batch, in worker processes of this machine.

    :param jobs: as of `map_ordered`.
    :returns: results of batches as they are ready.
    :raises CampaignError: an item repeatedly kills its process; all others are finished then.
    """
    def refuse(item: _Item) -> NoReturn:
        raise CampaignError('a worker process died repeatedly, perhaps because memory ran out: '
                            'use fewer --jobs')

    if jobs == 1 or sum(map(len, batches)) < 2 or not _has_loky():
        for batch in batches:
            yield _apply(work, batch)
    else:
        yield from completed(LocalWorkers(min(jobs, len(batches))), work, batches, refuse)


def completed(workers: Workers, work: Callable[[_Item], _Result],
              batches: Sequence[Sequence[_Item]], lost: Callable[[_Item], _Result]
              ) -> Generator[list[_Result], None, None]:
    """
    Apply a function to each item of each batch, on any workers.

    The items of a batch whose process died are suspects: which one killed it is unknown, and a
    batch beside it may be innocent. Each is executed again at the end, with nothing else running.

    :param lost: called at last with each item that killed its process again; returns its result.
    :returns: results of batches as they are ready.
    :raises CampaignError: as `Workers`, or by `lost`.
    """
    waiting, suspects = deque(map(tuple, batches)), deque[_Item]()
    running: dict[Any, tuple[_Item, ...]] = {}
    # Its get() holds no lock of Python that an interrupt could leave locked, unlike
    # concurrent.futures.wait.
    done: SimpleQueue[Any] = SimpleQueue()
    killers: list[_Item] = []
    alone = False
    try:
        while waiting or running or suspects:
            capacity = workers.capacity()
            if suspects and not waiting and not running:
                alone = True
                waiting.append((suspects.popleft(),))
            while waiting and len(running) < capacity:
                future = workers.submit(_apply, work, waiting[0])
                running[future] = waiting.popleft()
                future.add_done_callback(done.put)
            for future in _available(done):
                batch = running.pop(future)
                try:
                    yield workers.result(future)
                except WorkerLostError:
                    (killers if alone else suspects).extend(batch)
        for item in killers:
            yield [lost(item)]
    finally:
        workers.close()


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """
    Block SIGINT for processes that the block starts; this process gets it after the block.

    The mask is inherited by the processes. The handler defers a signal that the kernel delivers to
    another thread of this process, whose handlers run in the main thread.
    """
    # It unblocks SIGINT in the thread that starts it, so it must run before.
    resource_tracker.ensure_running()
    in_main = threading.current_thread() is threading.main_thread()
    deferred: list[int] = []
    handler = signal.signal(
        signal.SIGINT, lambda number, _: deferred.append(number)) if in_main else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if in_main:
            signal.signal(signal.SIGINT, handler)
            if deferred:
                signal.raise_signal(signal.SIGINT)


def _numbered(work: Callable[[_Item], _Result], pair: tuple[int, _Item]) -> tuple[int, _Result]:
    return pair[0], work(pair[1])


def _apply(work: Callable[[_Item], _Result], batch: Sequence[_Item]) -> list[_Result]:
    return list(map(work, batch))


def _available(done: SimpleQueue[Any]) -> Iterator[Any]:
    """Return the futures that are done, after at most `POLL_PERIOD`."""
    with suppress(Empty):
        yield done.get(timeout=POLL_PERIOD)
        while True:
            yield done.get_nowait()


def _has_loky() -> bool:
    try:
        import loky  # noqa: F401
    except ImportError:
        return False
    return True
