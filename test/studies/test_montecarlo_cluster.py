# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Campaigns on a Dask cluster of processes over loopback, and its faults."""

from collections.abc import Callable, Generator, Iterator
import contextlib
import errno
from functools import partial
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
from typing import Any

import dask
import distributed
from fourbar_ros.cli.main import main
from fourbar_ros.studies import montecarlo
from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns import cluster as campaign_cluster
from fourbar_ros.studies.campaigns.campaign import Campaign, load_campaign
from fourbar_ros.studies.campaigns.campaign_run import empty_row, execute_run, Row
from fourbar_ros.studies.campaigns.cluster import ClusterWorkers
from fourbar_ros.studies.campaigns.versions import difference, versions
from fourbar_ros.studies.campaigns.workers import completed
import pyarrow.parquet
import pytest

LOCAL = ['--host', '127.0.0.1', '--no-dashboard']
Wait = Callable[[Callable[[], Any], str], None]

pytestmark = pytest.mark.slow


class Cluster:
    """A scheduler and workers in their own processes, on loopback only."""

    def __init__(self, folder: Path, wait_until: Wait) -> None:
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        file = folder / 'scheduler.json'
        self.scheduler = self.start(
            'scheduler', '--port', '0', '--scheduler-file', str(file), '--no-show',
            # No retries on other workers, which would take time.
            DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES='0')

        def address() -> str:
            with contextlib.suppress(OSError, ValueError):
                return str(json.loads(file.read_text())['address'])
            return ''
        wait_until(address, 'scheduler')
        self.address = address()
        assert self.address.startswith('tcp://127.0.0.1:')

    def start(self, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        """Start a part of the cluster."""
        with open(self.folder / f'{len(self.processes)}.log', 'wb') as log:
            process = subprocess.Popen(
                [sys.executable, '-m', 'dask', *arguments, *LOCAL], cwd=self.folder,
                stdout=log, stderr=log, env={**os.environ, **environment})
        self.processes.append(process)
        return process

    def worker(self, **environment: str) -> subprocess.Popen[bytes]:
        """Start a worker with one thread."""
        return self.start('worker', self.address, '--nthreads', '1', '--no-nanny',
                          '--local-directory', str(self.folder), **environment)

    def stop(self) -> None:
        """End all processes."""
        for process in self.processes:
            # A regular shutdown takes ten seconds.
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path, wait_until: Wait) -> Iterator[Cluster]:
    """Start a scheduler without workers; the test may start some."""
    folder = tmp_path / 'cluster'
    folder.mkdir()
    made = Cluster(folder, wait_until)
    yield made
    made.stop()


def rows_of(campaign: Campaign, batches: list[list[int]], address: str,
            execute: Callable[[Campaign, int], Row] = execute_run
            ) -> Generator[list[Row], None, None]:
    """Execute runs on a cluster."""
    return completed(ClusterWorkers(address, campaign.versions), partial(execute, campaign),
                     batches, lambda run: empty_row(campaign, run, 'lost'))


@pytest.fixture
def study(campaign_file: Callable[..., str], tmp_path: Path) -> Callable[..., int]:
    """Return a function that runs the campaign by its command."""
    def run(name: str, *more: str) -> int:
        return main(['study', 'montecarlo', campaign_file(), '-o', str(tmp_path / name), *more])
    return run


def parts(folder: Path) -> list[Path]:
    """Return the files with rows."""
    return sorted((folder / 'parts').glob('*.parquet'))


def free_port() -> int:
    """Return a free port of loopback."""
    with socket.socket() as found:
        found.bind(('127.0.0.1', 0))
        return int(found.getsockname()[1])


def test_two_workers_make_the_same_bytes_as_this_process(
    cluster: Cluster, study: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(montecarlo, 'MOST_IN_BATCH', 2)
    # The second worker may join before or during the work of the first.
    cluster.worker()
    cluster.worker()
    assert study('cluster', '--scheduler', cluster.address) == 0
    assert study('here', '--jobs', '1') == 0
    assert (tmp_path / 'cluster' / 'runs.parquet').read_bytes() == (
        tmp_path / 'here' / 'runs.parquet').read_bytes()


def test_missing_scheduler_is_reported(
    study: Callable[..., int], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(campaign_cluster, 'CONNECT_TIMEOUT', 1.0)
    for address in (f'tcp://127.0.0.1:{free_port()}', 'nonsense://here'):
        assert study('out', '--scheduler', address) == 2
        error = capsys.readouterr().err.splitlines()
        assert address in error[-1] and 'dask scheduler' in error[-1]
        assert 'Traceback' not in '\n'.join(error)


TLS = 'tls://127.0.0.1:8786'
NOWHERE = {f'distributed.comm.tls.{name}': '/nowhere/a.pem'
           for name in ('ca-file', 'client.cert', 'client.key')}


@pytest.mark.parametrize(('address', 'configured', 'part'), [
    ('', {}, 'port'),
    ('127.0.0.1', {}, 'port'),
    ('tcp://127.0.0.1', {}, 'port'),
    ('tcp://127.0.0.1:port', {}, 'port'),
    (TLS, {}, 'tls'),
    (TLS, NOWHERE, os.strerror(errno.ENOENT)),
    ('tcp://127.0.0.1:1', {'distributed.comm.require-encryption': True}, 'encryption'),
])
def test_wrong_address_is_refused_before_a_client_is_made(
    study: Callable[..., int], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, address: str, configured: dict[str, Any], part: str,
) -> None:
    """A client would wait, and print a traceback when it is deleted. No folder is left."""
    def fail(*_: Any, **__: Any) -> None:
        raise AssertionError('a client was made')
    monkeypatch.setattr(distributed, 'Client', fail)
    with dask.config.set(configured):
        assert study('out', '--scheduler', address) == 2
    error, = capsys.readouterr().err.splitlines()
    assert f'no scheduler at {address} (' in error and part in error
    assert '--scheduler' in error
    assert not (tmp_path / 'out').exists()


def test_scheduler_without_workers_is_reported(
        cluster: Cluster, study: Callable[..., int], capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign_cluster, 'FIRST_WORKER_TIMEOUT', 0.5)
    assert study('out', '--scheduler', cluster.address) == 2
    assert f'`dask worker {cluster.address}' in capsys.readouterr().err


def test_finished_runs_are_stored_when_the_scheduler_dies(
    cluster: Cluster, campaign_file: Callable[..., str], tmp_path: Path, wait_until: Wait,
) -> None:
    """Afterwards the same command continues without it."""
    cluster.worker()
    path, folder = campaign_file(), tmp_path / 'out'
    script = tmp_path / 'script.py'
    script.write_text('import sys\nfrom fourbar_ros.studies import montecarlo\n'
                      'from fourbar_ros.cli.main import main\n'
                      'montecarlo.MOST_IN_BATCH = 1\nsys.exit(main(sys.argv[1:]))\n')
    process = subprocess.Popen(
        [sys.executable, str(script), 'study', 'montecarlo', path, '-o', str(folder), '--runs',
         '200', '--scheduler', cluster.address], stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: len(parts(folder)) >= 2 or process.poll() is not None, 'second part')
        cluster.scheduler.kill()
        _, error = process.communicate(timeout=300.0)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 2
    kept = sum(pyarrow.parquet.read_table(part).num_rows for part in parts(folder))
    assert 2 <= kept < 200
    line, = error.splitlines()
    assert cluster.address in line and f'{kept} of 200 runs' in line
    assert main(['study', 'montecarlo', path, '-o', str(folder), '--runs', str(kept + 1),
                 '--jobs', '1']) == 0


@pytest.mark.parametrize('stage', ['begin', 'work'])
def test_cluster_that_stops_answering_is_reported(
    cluster: Cluster, campaign_file: Callable[..., str], monkeypatch: pytest.MonkeyPatch,
    stage: str,
) -> None:
    """A stopped process leaves connections open without an answer, as an unplugged cable does."""
    monkeypatch.setattr(campaign_cluster, 'ANSWER_TIMEOUT', 1.0 if stage == 'begin' else 300.0)
    made = load_campaign(campaign_file())
    worker = cluster.worker()
    if stage == 'begin':
        # The scheduler does not detect that the worker is stopped.
        with distributed.Client(cluster.address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=300.0)
        worker.send_signal(signal.SIGSTOP)
        with pytest.raises(CampaignError) as caught:
            rows_of(made, [[0]], cluster.address)
    else:
        with contextlib.closing(rows_of(made, [[0], *[[1]] * 50], cluster.address)) as found:
            next(found)
            monkeypatch.setattr(campaign_cluster, 'ANSWER_TIMEOUT', 1.0)
            cluster.scheduler.send_signal(signal.SIGSTOP)
            with pytest.raises(CampaignError) as caught:
                list(found)
    assert caught.value.values == {'address': cluster.address, 'limit': 1.0}


def test_worker_of_another_version_is_named(
    cluster: Cluster, study: Callable[..., int], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The package there has another version, or is missing."""
    other = tmp_path / 'other' / 'fourbar_ros' / 'studies' / 'campaigns'
    other.mkdir(parents=True)
    for package in (other.parent.parent, other.parent, other):
        (package / '__init__.py').touch()
    (other / 'versions.py').write_text(
        f'def versions():\n    return {({**versions(), "fourbar_ros": "9.9.9"})!r}\n')
    cluster.worker(PYTHONPATH=str(tmp_path / 'other'))
    assert study('out', '--scheduler', cluster.address) == 2
    error = capsys.readouterr().err
    assert f'fourbar_ros 9.9.9, here {versions()["fourbar_ros"]}' in error
    (other / 'versions.py').unlink()
    cluster.processes.pop().kill()
    cluster.worker(PYTHONPATH=str(tmp_path / 'other'))
    assert study('out', '--scheduler', cluster.address) == 2
    assert f'install {versions()["fourbar_ros"]}' in capsys.readouterr().err


def test_run_that_kills_workers_is_a_row(
        cluster: Cluster, campaign_file: Callable[..., str]) -> None:
    """Two workers die of run 1, with its batch and by itself; the third executes the rest."""
    made = load_campaign(campaign_file())
    for _ in range(3):
        cluster.worker()
    with contextlib.closing(
            rows_of(made, [[0, 1], [2]], cluster.address, deadly())) as found:
        rows = {row['run']: row for batch in found for row in batch}
    assert sorted(rows) == [0, 1, 2]
    assert rows[1]['failure'] == 'lost'
    assert rows[1]['tracking_rms_rad'] is None and rows[1]['seed'] == made.seed_of(1)
    assert rows[0]['failure'] == rows[2]['failure'] == ''


def deadly() -> Callable[[Campaign, int], Row]:
    """Return a function that kills its process at run 1; it is pickled by value."""
    def execute(campaign: Campaign, run: int) -> Row:
        import os

        from fourbar_ros.studies.campaigns.campaign_run import execute_run
        if run == 1:
            os._exit(1)
        return execute_run(campaign, run)
    return execute


def test_difference_names_the_versions() -> None:
    here = versions()
    assert difference(here, dict(here)) == ''
    assert difference(here, {**here, 'numpy': '0.1'}) == f'numpy 0.1, here {here["numpy"]}'
    assert 'sources none' in difference(here, {'fourbar_ros': here['fourbar_ros']})


def test_missing_library_is_reported(
        monkeypatch: pytest.MonkeyPatch, refuses: Callable[..., Any]) -> None:
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with refuses(CampaignError, name='distributed'):
        ClusterWorkers('tcp://127.0.0.1:1', versions())
