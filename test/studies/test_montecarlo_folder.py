# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The folder of a campaign: every finished run is stored exactly once."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
import errno
import fcntl
import inspect
from io import StringIO
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
from typing import Any

from fourbar_ros.cli.main import main
from fourbar_ros.common.progress import resume_at
from fourbar_ros.loop import ClosedLoop
from fourbar_ros.studies import montecarlo, Result, StudyError
from fourbar_ros.studies.campaigns import CampaignError, result_folder
from fourbar_ros.studies.campaigns import versions as campaign_versions
from fourbar_ros.studies.campaigns.campaign import Campaign, load_campaign
from fourbar_ros.studies.campaigns.campaign_run import execute_run
from fourbar_ros.studies.campaigns.distributions import Parameter
from fourbar_ros.studies.campaigns.parameter_names import place_of
from fourbar_ros.studies.campaigns.result_folder import ResultFolder
from fourbar_ros.studies.estimator_statistics import normalised_squares
import pyarrow.parquet
import pytest
from tqdm import tqdm

Refuses = Callable[..., AbstractContextManager[None]]
Wait = Callable[[Callable[[], Any], str], None]


@pytest.fixture
def campaign(campaign_file: Callable[..., str]) -> Campaign:
    """Load the campaign of short runs."""
    return load_campaign(campaign_file())


@pytest.fixture
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every run its own batch."""
    monkeypatch.setattr(montecarlo, 'MOST_IN_BATCH', 1)


def quiet(items: Any, total: int) -> Any:
    """Show no progress."""
    return items


def run(path: str, folder: Path, **given: Any) -> Result:
    """Run a campaign in this process."""
    return montecarlo.run(quiet, folder, path, **{'jobs': 1, **given})


def parts(folder: Path) -> list[Path]:
    """Return the files with rows."""
    return sorted((folder / 'parts').glob('*.parquet'))


def numbers(files: list[Path]) -> list[int]:
    """Return the runs in some files."""
    return [run for file in files
            for run in pyarrow.parquet.read_table(file)['run'].to_pylist()]


@pytest.mark.slow
@pytest.mark.parametrize('jobs', [1, 2])
def test_killed_campaign_is_resumed(
        campaign_file: Callable[..., str], tmp_path: Path, wait_until: Wait, jobs: int) -> None:
    """After SIGKILL stored rows stay, only the other runs are executed, and no process is left."""
    path, folder, runs = campaign_file(), tmp_path / 'killed', 16
    code = ('import sys\n'
            'from fourbar_ros.studies import montecarlo\n'
            'from fourbar_ros.cli.main import main\n'
            "if __name__ == '__main__':\n"
            '    montecarlo.MOST_IN_BATCH = 1\n'
            '    sys.exit(main(sys.argv[1:]))\n')
    script = tmp_path / 'script.py'
    script.write_text(code)
    command = [sys.executable, str(script), 'study', 'montecarlo', path, '-o', str(folder),
               '--jobs', str(jobs), '--runs', str(runs)]
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
    try:
        wait_until(lambda: len(parts(folder)) >= 3, 'third part')
        process.kill()
        assert process.wait() == -signal.SIGKILL
    finally:
        process.kill()
        process.wait()
    wait_until(lambda: not alive(process.pid), 'end of the processes of the campaign')
    kept = {file: file.read_bytes() for file in parts(folder)}
    before = numbers(list(kept))
    assert 3 <= len(before) < runs, 'killed too late'
    assert len(set(before)) == len(before)

    made: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(montecarlo, 'execute_run', lambda campaign, run: (
            made.append(run) or execute_run(campaign, run)))
        run(path, folder, runs=runs)
    assert sorted(made + before) == list(range(runs))
    whole = tmp_path / 'whole'
    run(path, whole, runs=runs)
    assert (folder / 'runs.parquet').read_bytes() == (whole / 'runs.parquet').read_bytes()
    assert numbers(parts(folder)) == list(range(runs))
    assert not list(folder.rglob('.*'))


def alive(group: int) -> bool:
    """Return whether any process of a group exists."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_finished_campaign_is_not_run_again_and_takes_more_runs(
        campaign_file: Callable[..., str], tmp_path: Path, refuses: Refuses) -> None:
    path, folder = campaign_file(), tmp_path / 'out'
    shown: list[tuple[int, int]] = []

    class Bar:

        def __init__(self, items: Any, total: int) -> None:
            self.items, self.total, self.initial, self.n = items, total, 0, 0

        def refresh(self) -> None:
            shown.append((self.n, self.total))

        def __iter__(self) -> Iterator[Any]:
            for item in self.items:
                self.n += 1
                yield item
            shown.append((self.n, self.total))
    for runs in (3, 3, 5):
        montecarlo.run(Bar, folder, path, runs=runs, jobs=1)
    assert shown == [(0, 3), (3, 3), (3, 3), (3, 3), (3, 5), (5, 5)]
    with refuses(StudyError, value=4, limit=4):
        run(path, folder, runs=4)


def test_progress_begins_with_the_finished_runs() -> None:
    bar = tqdm(iter(range(7)), total=10, file=StringIO(), mininterval=0.0, miniters=1)
    resume_at(bar, 3)
    assert [bar.n for _ in bar][-1] == 9
    assert (bar.n, bar.initial) == (10, 3)
    resume_at([1, 2], 1)


@pytest.mark.medium
@pytest.mark.parametrize(('change', 'different'), [
    ({'seed': 6}, ['seed']),
    ({'duration': 0.4}, ['scenario.duration']),
    ({'vary': {'initial.link_a': {'uniform': [0.0, 0.1]}}},
     ['vary.mechanism.flywheel_inertias', 'vary.table.link_sensors.noise_rms',
      'vary.controller.allocation', 'vary.initial.link_a']),
])
def test_folder_of_another_campaign_is_refused(
        campaign_file: Callable[..., str], tmp_path: Path, change: dict[str, Any],
        different: list[str], refuses: Refuses) -> None:
    folder = tmp_path / 'out'
    run(campaign_file(), folder, runs=2)
    before = {file: file.read_bytes() for file in folder.rglob('*') if file.is_file()}
    with refuses(CampaignError, path=folder, different=different):
        run(campaign_file('other', **change), folder, runs=2)
    assert {file: file.read_bytes() for file in before} == before


def test_folder_without_finished_runs_belongs_to_no_campaign(
        campaign_file: Callable[..., str], tmp_path: Path, refuses: Refuses) -> None:
    """A campaign without a finished run, or a killed one, has left the folder."""
    first, other = load_campaign(campaign_file()), load_campaign(campaign_file('other', seed=6))
    place = tmp_path / 'out'
    with ResultFolder(place, first):
        assert (place / 'campaign.json').exists()
    assert not list(place.iterdir())
    (place / 'parts').mkdir()
    (place / 'campaign.json').write_text(json.dumps({'hash': first.digest, **first.identity}))
    with ResultFolder(place, other) as folder:
        folder.add([execute_run(other, 0)])
    with refuses(CampaignError, path=place, different=['seed']):
        ResultFolder(place, first).__enter__()


def test_versions_cover_all_modules_that_determine_the_numbers() -> None:
    hashed = {path.resolve() for path in campaign_versions.sources()}
    for made_by in (Campaign, Parameter, place_of, execute_run, normalised_squares, ClosedLoop):
        assert Path(str(inspect.getsourcefile(made_by))).resolve() in hashed


@pytest.mark.medium
def test_other_versions_are_not_mixed(
        campaign_file: Callable[..., str], tmp_path: Path, refuses: Refuses) -> None:
    path, folder = campaign_file(), tmp_path / 'out'
    run(path, folder, runs=1)
    identity = json.loads((folder / 'campaign.json').read_text())
    identity['versions']['numpy'] = identity['hash'] = 'another'
    (folder / 'campaign.json').write_text(json.dumps(identity))
    with refuses(CampaignError, path=folder, different=['versions.numpy']):
        run(path, folder, runs=1)


def test_folder_is_locked_by_one_process(
        campaign: Campaign, tmp_path: Path, refuses: Refuses) -> None:
    with ResultFolder(tmp_path / 'out', campaign):
        with refuses(CampaignError, path=tmp_path / 'out'):
            ResultFolder(tmp_path / 'out', campaign).__enter__()
    with ResultFolder(tmp_path / 'out', campaign):
        pass
    # The lock is released.
    descriptor = os.open(tmp_path / 'out', os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(descriptor)


@pytest.mark.slow
@pytest.mark.usefixtures('small_batches')
def test_full_disk_is_reported_and_finished_runs_are_stored(
    campaign_file: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The disk is full from the fourth part on; later it has room again."""
    path, folder = campaign_file(), tmp_path / 'out'
    given = ['study', 'montecarlo', path, '-o', str(folder), '--jobs', '1', '--runs', '6']
    full = monkeypatch.context()
    with full as patch:
        def fsync(descriptor: int) -> None:
            if len(parts(folder)) >= 3:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        patch.setattr(os, 'fsync', fsync)
        assert main(given) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert os.strerror(errno.ENOSPC) in error and '3 of 6 runs' in error
    assert numbers(parts(folder)) == [0, 1, 2]
    assert not list(folder.rglob('.*'))
    assert main(given) == 0
    assert pyarrow.parquet.read_table(folder / 'runs.parquet')['run'].to_pylist() == list(range(6))


@pytest.mark.medium
@pytest.mark.usefixtures('small_batches')
def test_many_parts_are_merged_and_duplicate_rows_count_once(
        campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(result_folder, 'MOST_PARTS', 4)
    rows = [execute_run(campaign, run) for run in range(8)]
    with ResultFolder(tmp_path, campaign) as folder:
        for row in rows:
            folder.add([row])
            assert len(parts(tmp_path)) <= 4
        before = folder.rows()
        assert before.to_pylist() == rows
    # The state is that after a crash between the new file and the removal of the old ones.
    with ResultFolder(tmp_path, campaign) as folder:
        folder.add(rows[2:4])
        (tmp_path / 'parts' / '.from_0000000_1.parquet.abcd').write_bytes(b'PAR1')
    with ResultFolder(tmp_path, campaign) as folder:
        assert folder.rows() == before
        folder.finish()
    assert len(parts(tmp_path)) == 1
    assert not list(tmp_path.rglob('.*'))


def test_damaged_files_are_refused(campaign: Campaign, tmp_path: Path, refuses: Refuses) -> None:
    with ResultFolder(tmp_path, campaign) as folder:
        folder.add([execute_run(campaign, 0)])
        part, = parts(tmp_path)
        part.write_bytes(part.read_bytes()[:100])
        with refuses(CampaignError, path=part):
            folder.rows()
    identity = tmp_path / 'campaign.json'
    identity.write_text('{')
    with refuses(CampaignError, path=identity):
        ResultFolder(tmp_path, campaign).__enter__()
    identity.unlink()
    with refuses(CampaignError, path=identity):
        ResultFolder(tmp_path, campaign).__enter__()


def test_folder_that_cannot_be_used_is_refused(
        campaign: Campaign, tmp_path: Path, refuses: Refuses) -> None:
    (tmp_path / 'file').touch()
    with refuses(CampaignError, path=tmp_path / 'file', errno=errno.EEXIST):
        ResultFolder(tmp_path / 'file', campaign).__enter__()
