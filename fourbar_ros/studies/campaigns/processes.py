# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Runs that do not need each other, spread over processes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
import contextlib
from multiprocessing import get_context, parent_process, resource_tracker
import os
import signal
import threading
from typing import TypeVar

from fourbar_ros.common.errors import FourbarError

_Item = TypeVar('_Item')
_Found = TypeVar('_Found')


# What tells the usual libraries of linear algebra how many threads to take.
THREADS = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


# A process that dies is replaced so often before any work is done again.
REPLACED = 3

# How often to look whether an interrupt came [s].
LOOK = 0.2


class CampaignError(FourbarError):
    """Runs that came to an end by themselves."""


def in_processes(work: Callable[[_Item], _Found], items: Sequence[_Item], jobs: int
                 ) -> Generator[_Found, None, None]:
    """
    Do some work for each item, in as many processes as there are jobs.

    An interrupt reaches this process alone: runs that have begun are finished, the others are not
    begun.

    :param work: a function of a module, which other processes can import.
    :param items: what it is given.
    :param jobs: 1 for this process alone.
    :returns: what it returned, in the order of the items whichever was ready first.
    :raises CampaignError: a process died.
    """
    if jobs == 1 or len(items) < 2:
        yield from map(work, items)
        return
    pool = _pool(min(jobs, len(items)))
    try:
        with _interrupts_ignored(), _one_thread_each():
            waiting = deque(pool.submit(work, item) for item in items)
        while waiting:
            _first_of([waiting[0]])
            yield waiting.popleft().result()
    except BrokenProcessPool:
        raise CampaignError('a process of the campaign died, by lack of memory perhaps: take '
                            'fewer --jobs') from None
    finally:
        pool.shutdown(cancel_futures=True)


def as_ready(work: Callable[[_Item], _Found], items: Sequence[_Item], jobs: int
             ) -> Generator[_Found, None, None]:
    """
    Do some work for each item as :func:`in_processes`, and return it as soon as it is done.

    Few items are given away beforehand, so there may be any number of them. What was under way
    when a process died is done again in others: at last, and one by one until something is done,
    since nobody knows which of it is to blame.

    :returns: what the work returned, in the order in which it was ready.
    :raises CampaignError: processes died again and again.
    """
    if jobs == 1 or len(items) < 2:
        yield from map(work, items)
        return
    waiting, died = deque(items), 0
    while waiting:
        running: dict[Future[_Found], _Item] = {}
        pool = _pool(min(jobs, len(items)))
        try:
            while waiting or running:
                with _interrupts_ignored(), _one_thread_each():
                    while waiting and len(running) < (1 if died else jobs + 1):
                        future = pool.submit(work, waiting[0])
                        running[future] = waiting.popleft()
                for future in _first_of(running):
                    found = future.result()
                    del running[future]
                    died = 0
                    yield found
        except BrokenProcessPool:
            died += 1
            if died > REPLACED:
                raise CampaignError('processes of the campaign died, by lack of memory perhaps: '
                                    'take fewer --jobs') from None
            waiting.extend(running.values())
        finally:
            pool.shutdown(cancel_futures=True)


def _pool(jobs: int) -> ProcessPoolExecutor:
    """Make processes, not by fork: whoever calls may have threads."""
    return ProcessPoolExecutor(jobs, mp_context=get_context('spawn'), initializer=_end_together)


def _end_together() -> None:
    """Let this process end when its parent is killed, instead of waiting for work for ever."""
    parent = parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)
    threading.Thread(target=watch, daemon=True).start()


def _first_of(futures: Collection[Future[_Found]]) -> set[Future[_Found]]:
    """
    Wait until some of them are done, and return these.

    :raises KeyboardInterrupt: a moment after it came.
    """
    with _interrupts_deferred() as came:
        while True:
            done = wait(futures, LOOK, FIRST_COMPLETED).done
            if done or came:
                return done


@contextlib.contextmanager
def _interrupts_deferred() -> Iterator[list[int]]:
    """
    Let interrupts wait for the end of this block.

    One that comes while this thread takes a lock may leave it locked, and with it the thread of
    the pool that hands on results: neither of them ever ends then.

    :returns: those that came so far.
    """
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """
    Let the processes that are started in this block never see an interrupt.

    They inherit that it is blocked. One that comes meanwhile reaches this process at the end.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # It unblocks interrupts when it starts, so it has to be there before.
    resource_tracker.ensure_running()
    # Blocked in this thread alone: another one of this process may still take it.
    with _interrupts_deferred():
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let linear algebra take one thread in the processes started here: they share the cores."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update({name: value or '1' for name, value in before.items()})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
