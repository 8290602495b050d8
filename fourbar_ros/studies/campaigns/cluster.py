# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Workers of a Dask cluster that already runs.

Every program that reaches a scheduler can execute code on its workers and clients, so the cluster
must be in a trusted network (docs/campaigns.md).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping
import contextlib
import logging
import time
from typing import Any

from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns.versions import difference
from fourbar_ros.studies.campaigns.workers import WorkerLostError

# Longest wait for the connection to the scheduler [s].
CONNECT_TIMEOUT = 5.0
# Longest wait for the first worker [s].
FIRST_WORKER_TIMEOUT = 15.0
# Longest time without workers after the first one [s].
NO_WORKER_TIMEOUT = 60.0
# Longest wait for an answer of a scheduler or worker that is connected [s].
ANSWER_TIMEOUT = 30.0
# Batches submitted at a time per thread of the workers; hides the latency of the network.
BATCHES_PER_THREAD = 3
# In Python 3.10 asyncio's error, which Dask raises, is a type of its own.
_TIMED_OUT = (TimeoutError, asyncio.TimeoutError)


class ClusterWorkers:
    """
    Workers of a scheduler.

    :param address: of the scheduler, `tcp://HOST:PORT`.
    :param versions: that the workers must have, see `campaigns.versions`.
    :raises CampaignError: no scheduler or worker there, a worker has other versions, or
        `distributed` is not installed.
    """

    def __init__(self, address: str, versions: Mapping[str, str]) -> None:
        try:
            import distributed
            from distributed.comm.core import CommClosedError
        except ImportError as error:
            raise CampaignError(f'--scheduler needs {error.name}: pip install '
                                'fourbar_ros[analysis]', name=error.name) from None
        self._killed = distributed.KilledWorker
        self._gone = (OSError, distributed.CancelledError, CommClosedError)
        self._address = address
        self._last_seen = time.monotonic()
        with contextlib.ExitStack() as opened:
            opened.enter_context(_dask_silenced())
            try:
                _check_address(address)
                self._client: Any = distributed.Client(
                    address, timeout=CONNECT_TIMEOUT, set_as_default=False)
            except (OSError, *_TIMED_OUT, ValueError, ImportError) as error:
                reason = (f'within {CONNECT_TIMEOUT:g} s'
                          if isinstance(error, (OSError, *_TIMED_OUT))
                          else f'({_one_line(error)})')
                raise CampaignError(
                    f'no scheduler at {address} {reason}: start one with `dask scheduler`, or '
                    'omit --scheduler', address=address) from None
            opened.callback(self._disconnect)
            self._check_workers(versions)
            self._opened = opened.pop_all()

    def capacity(self) -> int:
        """
        Return the number of batches to submit at a time.

        :raises CampaignError: the scheduler or all workers disappeared or do not answer.
        """
        with self._errors_translated():
            threads = sum(self._client.sync(
                self._client.scheduler.ncores, workers=None,
                callback_timeout=ANSWER_TIMEOUT).values())
        if self._client.status != 'running':
            raise self._error('is gone')
        if threads:
            self._last_seen = time.monotonic()
        elif time.monotonic() - self._last_seen > NO_WORKER_TIMEOUT:
            raise self._error(f'has had no workers for {NO_WORKER_TIMEOUT:g} s')
        return BATCHES_PER_THREAD * max(int(threads), 1)

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Return a future of `work(*arguments)`."""
        with self._errors_translated():
            return self._client.submit(work, *arguments, pure=False)

    def result(self, future: Any) -> Any:
        """Return the result of a future that is done."""
        try:
            with self._errors_translated():
                return future.result(timeout=ANSWER_TIMEOUT)
        except self._killed:
            raise WorkerLostError from None

    def close(self) -> None:
        """Disconnect; the scheduler cancels what is not finished."""
        self._opened.close()

    def _disconnect(self) -> None:
        with contextlib.suppress(*self._gone, *_TIMED_OUT):
            self._client.close(timeout=2.0)

    def _check_workers(self, versions: Mapping[str, str]) -> None:
        """Refuse workers that compute other numbers than this process."""
        try:
            self._client.wait_for_workers(1, timeout=FIRST_WORKER_TIMEOUT)
        except _TIMED_OUT:
            raise self._error('has no workers: start some with '
                              f'`dask worker {self._address} --nthreads 1`') from None
        try:
            answers = self._client.run(
                _versions_query(), on_error='return', callback_timeout=ANSWER_TIMEOUT)
        except _TIMED_OUT:
            raise self._error('or one of its workers does not answer within '
                              f'{ANSWER_TIMEOUT:g} s', limit=ANSWER_TIMEOUT) from None
        for worker, answer in answers.items():
            if isinstance(answer, BaseException):
                problem = f'cannot report its versions: {_one_line(answer)}'
            elif not answer:
                problem = (f'has no fourbar_ros: install {versions["fourbar_ros"]} there, as '
                           'here')
            elif differs := difference(versions, answer):
                problem = f'has other versions: {differs}'
            else:
                continue
            raise CampaignError(f'worker {worker} {problem}', worker=worker, versions=answer)

    @contextlib.contextmanager
    def _errors_translated(self) -> Iterator[None]:
        try:
            yield
        except _TIMED_OUT:
            raise self._error(f'has not answered for {ANSWER_TIMEOUT:g} s',
                              limit=ANSWER_TIMEOUT) from None
        except self._gone:
            raise self._error('is gone') from None

    def _error(self, problem: str, **values: Any) -> CampaignError:
        return CampaignError(f'the scheduler {self._address} {problem}',
                             address=self._address, **values)


def _check_address(address: str) -> None:
    """
    Check that a client can connect: one that cannot prints a traceback when it is deleted.

    :raises ValueError: address or TLS configuration is wrong.
    """
    from distributed import Security
    from distributed.comm.addressing import get_address_host_port

    get_address_host_port(address)
    security = Security()
    try:
        context = security.get_connection_args('client').get('ssl_context')
    except (OSError, ValueError) as error:
        raise ValueError("the certificates of Dask's configuration cannot be read: "
                         f'{_one_line(error)}') from None
    if address.startswith('tls://') and context is None:
        raise ValueError("tls needs certificate, key and CA in Dask's configuration")
    if security.require_encryption and not address.startswith('tls://'):
        raise ValueError("Dask's configuration requires encryption, tls://")


def _versions_query() -> Callable[[], dict[str, str]]:
    """Return a function that is pickled by value, since workers may lack this module."""
    def query() -> dict[str, str]:
        from importlib import import_module
        try:
            module = import_module('fourbar_ros.studies.campaigns.versions')
        except ImportError:
            return {}
        found: dict[str, str] = module.versions()
        return found
    return query


@contextlib.contextmanager
def _dask_silenced() -> Iterator[None]:
    """Silence Dask's log of lost connections: the error of the campaign reports them."""
    # Dask sets levels of its own on some of its loggers.
    loggers = [logging.getLogger(name) for name in (
        'distributed', 'distributed.client', 'distributed.core', 'distributed.comm')]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels):
            logger.setLevel(level)


def _one_line(error: BaseException) -> str:
    return ' '.join(str(error).split())[:120] or type(error).__name__
