# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Runs of a campaign on a Dask cluster that somebody else has started.

Whoever reaches a scheduler can run code on its workers and on its clients, so it must be one of a
network that is trusted (docs/campaigns.md).
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
import contextlib
import logging
from queue import Empty, SimpleQueue
import time
from typing import Any

from fourbar_ros.studies.campaigns.file import Campaign
from fourbar_ros.studies.campaigns.processes import CampaignError
from fourbar_ros.studies.campaigns.run import do_batch, lost_run, Row
from fourbar_ros.studies.campaigns.versions import difference, versions

# How long to wait for a scheduler, for its first worker, and for one after all have gone [s].
CONNECTING, FIRST_WORKER, NO_WORKER = 5.0, 15.0, 60.0
# How long a scheduler or a worker that was there before may take to answer [s].
ANSWER = 30.0
# How often to look whether the cluster is still there [s].
LOOK = 1.0
# Batches that are given away beforehand, for each thread of the workers.
AHEAD = 3
# Dask's is that of asyncio, which is one of its own in Python 3.10.
_TIMED_OUT = (TimeoutError, asyncio.TimeoutError)


def on_cluster(campaign: Campaign, batches: Sequence[Sequence[int]], address: str
               ) -> Generator[list[Row], None, None]:
    """
    Make runs on the workers of a scheduler.

    :param batches: numbers of the runs that are made together.
    :param address: of the scheduler, `tcp://HOST:PORT`.
    :returns: rows of one batch after the other, as they are ready. A run that takes every worker
        with it on which it is tried has a row that says so; it is tried at last with nothing else
        on the cluster, since Dask blames all that a dead worker had.
    :raises CampaignError: there is no such scheduler, or not any more; it answers no more, as one
        that is halted or unplugged; workers have other versions; distributed is not installed.
    """
    try:
        import distributed
        from distributed.comm.core import CommClosedError
    except ImportError as error:
        raise CampaignError(f'--scheduler needs {error.name}: pip install '
                            'fourbar_ros[analysis]') from None
    with _quiet():
        try:
            _check_address(address)
            client = distributed.Client(address, timeout=CONNECTING, set_as_default=False)
        except (OSError, *_TIMED_OUT, ValueError, ImportError) as error:
            reason = (f'within {CONNECTING:g} s' if isinstance(error, (OSError, *_TIMED_OUT))
                      else f'({_line(error)})')
            raise CampaignError(f'no scheduler at {address} {reason}: start one with '
                                '`dask scheduler`, or leave --scheduler away') from None
        try:
            _check_workers(client, address, campaign)
            yield from _spread(client, address, campaign, batches)
        finally:
            with contextlib.suppress(OSError, *_TIMED_OUT, CommClosedError):
                client.close(timeout=2.0)


def _check_address(address: str) -> None:
    """
    See that a client can be made: one that cannot prints a traceback when it is deleted.

    :raises ValueError: it cannot; says why.
    """
    from distributed import Security
    from distributed.comm.addressing import get_address_host_port

    get_address_host_port(address)
    security = Security()
    try:
        context = security.get_connection_args('client').get('ssl_context')
    except (OSError, ValueError) as error:
        raise ValueError("the certificates of Dask's configuration cannot be read: "
                         f'{_line(error)}') from None
    if address.startswith('tls://') and context is None:
        raise ValueError("tls needs certificate, key and CA in Dask's configuration")
    if security.require_encryption and not address.startswith('tls://'):
        raise ValueError("Dask's configuration requires encryption, tls://")


def _check_workers(client: Any, address: str, campaign: Campaign) -> None:
    """See that there are workers, and that they make the same numbers as this process."""
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER)
    except _TIMED_OUT:
        raise CampaignError(f'the scheduler {address} has no workers: start some with '
                            f'`dask worker {address} --nthreads 1`') from None
    try:
        found = client.run(_asked(), on_error='return', callback_timeout=ANSWER)
    except _TIMED_OUT:
        raise CampaignError(f'the scheduler {address} or one of its workers does not answer '
                            f'within {ANSWER:g} s') from None
    for worker, there in found.items():
        if isinstance(there, BaseException):
            raise CampaignError(f'worker {worker} cannot say its versions: {_line(there)}')
        if not there:
            raise CampaignError(f'worker {worker} has no fourbar_ros: install '
                                f'{campaign.versions["fourbar_ros"]} there, as here')
        if differs := difference(dict(campaign.versions), there):
            raise CampaignError(f'worker {worker} has other versions: {differs}')


def _asked() -> Callable[[], dict[str, str]]:
    """Return a function that goes to the workers whole, since they may not know this module."""
    def ask() -> dict[str, str]:
        from importlib import import_module
        try:
            module = import_module('fourbar_ros.studies.campaigns.versions')
        except ImportError:
            return {}
        found: dict[str, str] = module.versions()
        return found
    return ask


def _spread(client: Any, address: str, campaign: Campaign, batches: Sequence[Sequence[int]]
            ) -> Generator[list[Row], None, None]:
    import distributed
    from distributed.comm.core import CommClosedError

    gone = CampaignError(f'the scheduler {address} is gone')
    waiting = deque(tuple(batch) for batch in batches)
    suspects: deque[int] = deque()
    alone = False
    running: dict[Any, tuple[int, ...]] = {}
    ready: SimpleQueue[Any] = SimpleQueue()
    seen = time.monotonic()
    try:
        while waiting or running or suspects:
            threads = sum(client.sync(
                client.scheduler.ncores, workers=None, callback_timeout=ANSWER).values())
            if threads:
                seen = time.monotonic()
            elif time.monotonic() - seen > NO_WORKER:
                raise CampaignError(f'the scheduler {address} has had no workers for '
                                    f'{NO_WORKER:g} s')
            if suspects and not waiting and not running:
                alone = True
                waiting.append((suspects.popleft(),))
            while waiting and len(running) < AHEAD * max(threads, 1):
                batch = waiting.popleft()
                future = client.submit(work, campaign, batch, pure=False)
                running[future] = batch
                future.add_done_callback(ready.put)
            for future in _next(ready):
                batch = running.pop(future)
                try:
                    yield future.result(timeout=ANSWER)
                except distributed.KilledWorker:
                    if not alone:
                        suspects.extend(batch)
                    else:
                        yield [lost_run(campaign, batch[0], 'every worker that took it died, by '
                                                            'lack of memory perhaps')]
            if client.status != 'running':
                raise gone
    except _TIMED_OUT:
        raise CampaignError(f'the scheduler {address} has not answered for {ANSWER:g} s') from None
    except (OSError, distributed.CancelledError, CommClosedError):
        raise gone from None
    finally:
        with contextlib.suppress(Exception):  # noqa: BLE001 - the scheduler may be anything now
            client.cancel(list(running))


def _next(ready: SimpleQueue[Any]) -> Iterator[Any]:
    """Return what is ready, after waiting a while for the first."""
    with contextlib.suppress(Empty):
        yield ready.get(timeout=LOOK)
        while True:
            yield ready.get_nowait()


def work(campaign: Campaign, batch: Sequence[int]) -> list[Row]:
    """Make some runs on a worker, which may have come later than the check."""
    if differs := difference(dict(campaign.versions), versions()):
        raise CampaignError(f'a worker that came later has other versions: {differs}')
    return do_batch(campaign, batch)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what Dask logs of lost connections to itself: it is said in one line."""
    # Dask gives some of its loggers levels of their own.
    loggers = [logging.getLogger(name) for name in (
        'distributed', 'distributed.client', 'distributed.core', 'distributed.comm')]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before):
            logger.setLevel(level)


def _line(error: BaseException) -> str:
    return ' '.join(str(error).split())[:120] or type(error).__name__
