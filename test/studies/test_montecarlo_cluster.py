# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Campaigns on a Dask cluster of processes over loopback, and what goes wrong with such."""

from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import time
from typing import Any

from fourbar_ros.cli.main import main
from fourbar_ros.studies import montecarlo
from fourbar_ros.studies.campaigns import cluster as campaign_cluster
from fourbar_ros.studies.campaigns.cluster import on_cluster
from fourbar_ros.studies.campaigns.file import load_campaign
from fourbar_ros.studies.campaigns.processes import CampaignError
from fourbar_ros.studies.campaigns.versions import difference, versions
import pyarrow.parquet
import pytest

distributed = pytest.importorskip('distributed')
dask = pytest.importorskip('dask')

PATIENCE = 90.0
LOCAL = ['--host', '127.0.0.1', '--no-dashboard']


def until(condition: Callable[[], Any], what: str) -> None:
    """Wait for something."""
    give_up = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < give_up, f'{what} did not come about within {PATIENCE} s'
        time.sleep(0.05)


class Cluster:
    """A scheduler and workers in processes of their own, on loopback alone."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        file = folder / 'scheduler.json'
        self.scheduler = self.start(
            'scheduler', '--port', '0', '--scheduler-file', str(file), '--no-show',
            # Nobody is given a second chance, which takes workers and time.
            DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES='0')

        def address() -> str:
            with contextlib.suppress(OSError, ValueError):
                return str(json.loads(file.read_text())['address'])
            return ''
        until(address, 'a scheduler')
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
        """End all that was started."""
        for process in self.processes:
            # They have nothing to put in order, and politely it takes ten seconds.
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """Start a scheduler without workers; all is stopped afterwards."""
    folder = tmp_path / 'cluster'
    folder.mkdir()
    made = Cluster(folder)
    yield made
    made.stop()


@pytest.fixture
def study(campaign_file: Callable[..., str], tmp_path: Path) -> Callable[..., int]:
    """Return a function that runs the campaign as it is typed."""
    def run(name: str, *more: str) -> int:
        return main(['study', 'montecarlo', campaign_file(), '-o', str(tmp_path / name), *more])
    return run


def parts(folder: Path) -> list[Path]:
    """Return the files with rows."""
    return sorted((folder / 'parts').glob('*.parquet'))


def free_port() -> int:
    """Return a port of loopback where nobody listens."""
    with socket.socket() as found:
        found.bind(('127.0.0.1', 0))
        return int(found.getsockname()[1])


def test_two_workers_make_the_same_bytes_as_this_process(
    cluster: Cluster, study: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(montecarlo, 'MOST_IN_BATCH', 2)
    # The second one comes while the first is at work or before, which changes nothing.
    cluster.worker()
    cluster.worker()
    assert study('cluster', '--scheduler', cluster.address) == 0
    assert study('here', '--jobs', '1') == 0
    assert (tmp_path / 'cluster' / 'runs.parquet').read_bytes() == (
        tmp_path / 'here' / 'runs.parquet').read_bytes()


def test_scheduler_that_is_not_there_is_told_soon(
    study: Callable[..., int], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(campaign_cluster, 'CONNECTING', 1.0)
    begin = time.monotonic()
    for address, told in ((f'tcp://127.0.0.1:{free_port()}', 'within 1 s'),
                          ('nonsense://here', 'no scheduler at nonsense://here')):
        assert study('out', '--scheduler', address) == 2
        error = capsys.readouterr().err.splitlines()
        assert told in error[-1] and 'dask scheduler' in error[-1]
        assert 'Traceback' not in '\n'.join(error)
    assert time.monotonic() - begin < 15.0


TLS = 'tls://127.0.0.1:8786'
NOWHERE = {f'distributed.comm.tls.{name}': '/nowhere/a.pem'
           for name in ('ca-file', 'client.cert', 'client.key')}


@pytest.mark.parametrize(('address', 'configured', 'told'), [
    ('', {}, 'missing port number'),
    ('127.0.0.1', {}, 'missing port number'),
    ('tcp://127.0.0.1', {}, 'missing port number'),
    ('tcp://127.0.0.1:port', {}, 'port'),
    (TLS, {}, "tls needs certificate, key and CA in Dask's configuration"),
    (TLS, NOWHERE, 'cannot be read: [Errno 2] No such file'),
    ('tcp://127.0.0.1:1', {'distributed.comm.require-encryption': True}, 'requires encryption'),
])
def test_what_is_no_address_is_told_without_a_client(
    study: Callable[..., int], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, address: str, configured: dict[str, Any], told: str,
) -> None:
    """A client would wait and print a traceback when it is deleted. No folder is left."""
    def fail(*_: Any, **__: Any) -> None:
        raise AssertionError('a client was made')
    monkeypatch.setattr(distributed, 'Client', fail)
    with dask.config.set(configured):
        assert study('out', '--scheduler', address) == 2
    error, = capsys.readouterr().err.splitlines()
    assert error.startswith(f'fourbar study: no scheduler at {address} (') and told in error
    assert error.endswith('or leave --scheduler away')
    assert not (tmp_path / 'out').exists()


def test_scheduler_without_workers_is_told(
        cluster: Cluster, study: Callable[..., int], capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign_cluster, 'FIRST_WORKER', 0.5)
    assert study('out', '--scheduler', cluster.address) == 2
    error = capsys.readouterr().err
    assert f'has no workers: start some with `dask worker {cluster.address}' in error


def test_scheduler_that_dies_leaves_what_is_finished(
    cluster: Cluster, campaign_file: Callable[..., str], tmp_path: Path,
) -> None:
    """Then the same command goes on, without it."""
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
        until(lambda: len(parts(folder)) >= 2 or process.poll() is not None, 'a second part')
        cluster.scheduler.kill()
        _, error = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 2
    kept = sum(pyarrow.parquet.read_table(part).num_rows for part in parts(folder))
    assert 2 <= kept < 200
    line, = error.splitlines()
    assert f'the scheduler {cluster.address} is gone; {kept} of 200 runs are finished' in line
    assert 'the same command goes on' in line
    assert main(['study', 'montecarlo', path, '-o', str(folder), '--runs', str(kept + 1),
                 '--jobs', '1']) == 0


@pytest.mark.parametrize('stage', ['begin', 'work'])
def test_cluster_that_answers_no_more_is_told(
    cluster: Cluster, campaign_file: Callable[..., str], monkeypatch: pytest.MonkeyPatch,
    stage: str,
) -> None:
    """Halted, or unplugged: connections stay, and nothing comes."""
    monkeypatch.setattr(campaign_cluster, 'ANSWER', 1.0)
    made = load_campaign(campaign_file())
    worker = cluster.worker()
    if stage == 'begin':
        # The scheduler knows of it, and does not see either that it is halted.
        with distributed.Client(cluster.address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=PATIENCE)
        worker.send_signal(signal.SIGSTOP)
    with contextlib.closing(on_cluster(made, [[0], *[[1]] * 50], cluster.address)) as found:
        if stage == 'work':
            monkeypatch.setattr(campaign_cluster, 'ANSWER', PATIENCE)
            next(found)
            monkeypatch.setattr(campaign_cluster, 'ANSWER', 1.0)
            cluster.scheduler.send_signal(signal.SIGSTOP)
        with pytest.raises(CampaignError, match='answer.* 1 s'):
            list(found)


def test_worker_of_another_version_is_named(
    cluster: Cluster, study: Callable[..., int], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Its package is another one, with a version of its own."""
    other = tmp_path / 'other' / 'fourbar_ros' / 'studies' / 'campaigns'
    other.mkdir(parents=True)
    for package in (other.parent.parent, other.parent, other):
        (package / '__init__.py').touch()
    (other / 'versions.py').write_text(
        f'def versions():\n    return {({**versions(), "fourbar_ros": "9.9.9"})!r}\n')
    cluster.worker(PYTHONPATH=str(tmp_path / 'other'))
    assert study('out', '--scheduler', cluster.address) == 2
    error = capsys.readouterr().err
    assert f'other versions: fourbar_ros 9.9.9, here {versions()["fourbar_ros"]}' in error
    (other / 'versions.py').unlink()
    cluster.processes.pop().kill()
    cluster.worker(PYTHONPATH=str(tmp_path / 'other'))
    assert study('out', '--scheduler', cluster.address) == 2
    assert 'has no fourbar_ros: install' in capsys.readouterr().err


def test_run_that_kills_workers_is_a_row(
    cluster: Cluster, campaign_file: Callable[..., str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two workers die of run 1, with its batch and by itself; the third makes the rest."""
    monkeypatch.setattr(campaign_cluster, 'work', deadly())
    made = load_campaign(campaign_file())
    for _ in range(3):
        cluster.worker()
    with contextlib.closing(on_cluster(made, [[0, 1], [2]], cluster.address)) as found:
        rows = {row['run']: row for rows in found for row in rows}
    assert sorted(rows) == [0, 1, 2]
    assert rows[1]['failure'].startswith('every worker that took it died')
    assert rows[1]['tracking_rms_rad'] is None and rows[1]['seed'] == made.seed_of(1)
    assert rows[0]['failure'] == rows[2]['failure'] == ''


def deadly() -> Callable[..., Any]:
    """Return what the workers are given instead: it goes there whole."""
    def work(campaign: Any, batch: Any) -> Any:
        import os

        from fourbar_ros.studies.campaigns.run import do_batch
        if 1 in batch:
            os._exit(1)
        return do_batch(campaign, batch)
    return work


def test_difference_names_what_differs() -> None:
    here = versions()
    assert difference(here, dict(here)) == ''
    assert difference(here, {**here, 'numpy': '0.1'}) == f'numpy 0.1, here {here["numpy"]}'
    assert 'sources none' in difference(here, {'fourbar_ros': here['fourbar_ros']})


def test_library_that_is_missing_is_told(
    campaign_file: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with pytest.raises(CampaignError, match=r'pip install fourbar_ros\[analysis\]'):
        next(on_cluster(load_campaign(campaign_file()), [[0]], 'tcp://127.0.0.1:1'))
