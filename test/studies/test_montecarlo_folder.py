# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The folder of a campaign: nothing that was finished is lost, nothing is there twice."""

from collections.abc import Callable, Iterator
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
import time
from typing import Any

from fourbar_ros.cli.main import main
from fourbar_ros.common.progress import resume_at
from fourbar_ros.loop import ClosedLoop
from fourbar_ros.studies import montecarlo, Result, StudyError
from fourbar_ros.studies.campaigns import folder as campaign_folder
from fourbar_ros.studies.campaigns import processes as campaign_processes
from fourbar_ros.studies.campaigns import versions as campaign_versions
from fourbar_ros.studies.campaigns.draws import Parameter
from fourbar_ros.studies.campaigns.file import Campaign, load_campaign
from fourbar_ros.studies.campaigns.folder import CampaignFolder
from fourbar_ros.studies.campaigns.names import place_of
from fourbar_ros.studies.campaigns.processes import as_ready, CampaignError
from fourbar_ros.studies.campaigns.run import do_run
from fourbar_ros.studies.consistency_statistics import normalised_squares
import pyarrow.parquet
import pytest
from tqdm import tqdm

PATIENCE = 300.0


@pytest.fixture
def campaign(campaign_file: Callable[..., str]) -> Campaign:
    """Load the campaign of short runs."""
    return load_campaign(campaign_file())


@pytest.fixture
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every run be a batch of its own."""
    monkeypatch.setattr(montecarlo, 'MOST_IN_BATCH', 1)


def quiet(items: Any, total: int) -> Any:
    """Show no progress."""
    return items


def run(path: str, folder: Path, **given: Any) -> Result:
    """Run a campaign in this process."""
    return montecarlo.run(quiet, folder, path, **{'jobs': 1, **given})


def until(condition: Callable[[], bool], what: str) -> None:
    """Wait for something."""
    give_up = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < give_up, f'{what} did not come about within {PATIENCE} s'
        time.sleep(0.02)


def parts(folder: Path) -> list[Path]:
    """Return the files with rows."""
    return sorted((folder / 'parts').glob('*.parquet'))


def numbers(files: list[Path]) -> list[int]:
    """Return the runs in some files."""
    return [run for file in files
            for run in pyarrow.parquet.read_table(file)['run'].to_pylist()]


@pytest.mark.parametrize('jobs', [1, 2])
def test_campaign_that_is_killed_goes_on(
        campaign_file: Callable[..., str], tmp_path: Path, jobs: int) -> None:
    """SIGKILL in the middle: what was kept stays as it is, all the rest is made, no run twice."""
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
        until(lambda: len(parts(folder)) >= 3, 'a third part')
        process.kill()
        assert process.wait() == -signal.SIGKILL
    finally:
        process.kill()
        process.wait()
    until(lambda: not alive(process.pid), 'the end of the processes of the campaign')
    kept = {file: file.read_bytes() for file in parts(folder)}
    before = numbers(list(kept))
    assert 3 <= len(before) < runs, 'killed too late to tell anything'
    assert len(set(before)) == len(before)

    made: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(montecarlo, 'do_batch', lambda campaign, batch: [
            made.append(run) or do_run(campaign, run) for run in batch])
        run(path, folder, runs=runs)
    assert sorted(made + before) == list(range(runs))
    whole = tmp_path / 'whole'
    run(path, whole, runs=runs)
    assert (folder / 'runs.parquet').read_bytes() == (whole / 'runs.parquet').read_bytes()
    assert numbers(parts(folder)) == list(range(runs))
    assert not list(folder.rglob('.*'))


def alive(group: int) -> bool:
    """Tell whether any process of a group is left."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_finished_campaign_is_not_run_again_and_takes_more_runs(
        campaign_file: Callable[..., str], tmp_path: Path) -> None:
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
    with pytest.raises(StudyError, match='up to number 4, more than --runs 4'):
        run(path, folder, runs=4)


def test_progress_begins_with_what_is_done() -> None:
    bar = tqdm(iter(range(7)), total=10, file=StringIO(), mininterval=0.0, miniters=1)
    resume_at(bar, 3)
    assert [bar.n for _ in bar][-1] == 9
    assert (bar.n, bar.initial) == (10, 3)
    resume_at([1, 2], 1)


@pytest.mark.parametrize(('change', 'told'), [
    ({'seed': 6}, 'seed differs'),
    ({'duration': 0.4}, 'scenario.duration differs'),
    ({'vary': {'initial.link_a': {'uniform': [0.0, 0.1]}}}, 'vary.*and more'),
])
def test_other_campaign_is_not_resumed_into_the_folder(
        campaign_file: Callable[..., str], tmp_path: Path, change: dict[str, Any], told: str
) -> None:
    folder = tmp_path / 'out'
    run(campaign_file(), folder, runs=2)
    before = {file: file.read_bytes() for file in folder.rglob('*') if file.is_file()}
    with pytest.raises(CampaignError, match=told) as caught:
        run(campaign_file('other', **change), folder, runs=2)
    assert 'another campaign' in str(caught.value) and '\n' not in str(caught.value)
    assert {file: file.read_bytes() for file in before} == before


def test_folder_in_which_nothing_was_finished_belongs_to_no_campaign(
        campaign_file: Callable[..., str], tmp_path: Path) -> None:
    """Left empty by one that came to nothing, or as a killed one leaves it."""
    first, other = load_campaign(campaign_file()), load_campaign(campaign_file('other', seed=6))
    place = tmp_path / 'out'
    with CampaignFolder(place, first):
        assert (place / 'campaign.json').exists()
    assert not list(place.iterdir())
    CampaignFolder(place, first).__enter__()._let_go()
    with CampaignFolder(place, other) as folder:
        folder.add([do_run(other, 0)])
    with pytest.raises(CampaignError, match='another campaign'):
        CampaignFolder(place, first).__enter__()


def test_versions_are_of_all_that_makes_the_numbers() -> None:
    """What draws them is not the least of it."""
    hashed = {path.resolve() for path in campaign_versions.sources()}
    for made_by in (Campaign, Parameter, place_of, do_run, normalised_squares, ClosedLoop):
        assert Path(str(inspect.getsourcefile(made_by))).resolve() in hashed


def test_other_versions_are_not_mixed(
        campaign_file: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, folder = campaign_file(), tmp_path / 'out'
    run(path, folder, runs=1)
    identity = json.loads((folder / 'campaign.json').read_text())
    identity['versions']['numpy'] = identity['hash'] = 'another'
    (folder / 'campaign.json').write_text(json.dumps(identity))
    with pytest.raises(CampaignError, match='versions.numpy differs'):
        run(path, folder, runs=1)


def test_folder_is_of_one_process(campaign: Campaign, tmp_path: Path) -> None:
    with CampaignFolder(tmp_path / 'out', campaign):
        with pytest.raises(CampaignError, match='in use by another campaign'):
            CampaignFolder(tmp_path / 'out', campaign).__enter__()
    with CampaignFolder(tmp_path / 'out', campaign):
        pass
    # No lock is left.
    descriptor = os.open(tmp_path / 'out', os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(descriptor)


@pytest.mark.usefixtures('small_batches')
def test_full_disk_is_told_and_what_is_finished_kept(
    campaign_file: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """From the fourth part on there is no room; then somebody clears the disk."""
    path, folder = campaign_file(), tmp_path / 'out'
    given = ['study', 'montecarlo', path, '-o', str(folder), '--jobs', '1', '--runs', '6']
    full = monkeypatch.context()
    with full as patch:
        def fsync(descriptor: int) -> None:
            if len(parts(folder)) >= 3:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        patch.setattr(campaign_folder.os, 'fsync', fsync)
        assert main(given) == 2
    error = capsys.readouterr().err
    assert error.count('\n') == 1
    assert 'No space left on device; 3 of 6 runs are finished and kept' in error
    assert numbers(parts(folder)) == [0, 1, 2]
    assert not list(folder.rglob('.*'))
    assert main(given) == 0
    assert pyarrow.parquet.read_table(folder / 'runs.parquet')['run'].to_pylist() == list(range(6))


@pytest.mark.usefixtures('small_batches')
def test_many_parts_are_put_together_and_those_that_are_left_count_once(
        campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign_folder, 'MOST_PARTS', 4)
    rows = [do_run(campaign, run) for run in range(8)]
    with CampaignFolder(tmp_path, campaign) as folder:
        for row in rows:
            folder.add([row])
            assert len(parts(tmp_path)) <= 4
        before = folder.rows()
        assert before.to_pylist() == rows
    # As after a death between the new file and the end of the old ones.
    with CampaignFolder(tmp_path, campaign) as folder:
        folder.add(rows[2:4])
        (tmp_path / 'parts' / '.from_0000000_1.parquet.unfinished').write_bytes(b'PAR1')
    with CampaignFolder(tmp_path, campaign) as folder:
        assert folder.rows() == before
        folder.finish()
    assert len(parts(tmp_path)) == 1
    assert not list(tmp_path.rglob('.*'))


def test_damaged_files_are_told(campaign: Campaign, tmp_path: Path) -> None:
    with CampaignFolder(tmp_path, campaign) as folder:
        folder.add([do_run(campaign, 0)])
        part, = parts(tmp_path)
        part.write_bytes(part.read_bytes()[:100])
        with pytest.raises(CampaignError, match='from_0000000_1.parquet is damaged') as caught:
            folder.rows()
        assert '\n' not in str(caught.value)
    (tmp_path / 'campaign.json').write_text('{')
    with pytest.raises(CampaignError, match='campaign.json is damaged'):
        CampaignFolder(tmp_path, campaign).__enter__()
    (tmp_path / 'campaign.json').unlink()
    with pytest.raises(CampaignError, match='holds runs but no campaign.json'):
        CampaignFolder(tmp_path, campaign).__enter__()


def test_folder_that_cannot_be_used_is_told(campaign: Campaign, tmp_path: Path) -> None:
    (tmp_path / 'file').touch()
    with pytest.raises(CampaignError, match='cannot use .*file'):
        CampaignFolder(tmp_path / 'file', campaign).__enter__()


# Local processes

def slow_first(item: int) -> int:
    """Take a while for item 0."""
    time.sleep(0.5 if item == 0 else 0.0)
    return item


def die_once(given: tuple[str, int]) -> int:
    """Die at item 2, the first time."""
    folder, item = given
    if item == 2:
        try:
            Path(folder, 'died').touch(exist_ok=False)
        except FileExistsError:
            return item
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def die(item: int) -> int:
    """Die at item 2."""
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def imported(name: str) -> Any:
    """Return a function of this file as a module that other processes can import."""
    from importlib import import_module
    return getattr(import_module('test_montecarlo_folder'), name)


@pytest.fixture
def importable(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let processes that are started here import this file."""
    folder = str(Path(__file__).parent)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv('PYTHONPATH', folder)
    yield
    sys.modules.pop('test_montecarlo_folder', None)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Let interrupts reach this process: one in the background of a shell ignores them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures('interruptible')
def test_interrupt_while_processes_are_started_is_not_lost() -> None:
    """And is for this process alone."""
    asked = 'import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))'
    answers = []
    with pytest.raises(KeyboardInterrupt):
        with campaign_processes._interrupts_ignored():
            os.kill(os.getpid(), signal.SIGINT)
            answers.append(subprocess.check_output([sys.executable, '-c', asked]))
    assert answers == [b'True\n']
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures('importable')
def test_what_is_ready_comes_first() -> None:
    found = list(as_ready(imported('slow_first'), list(range(6)), 2))
    assert sorted(found) == list(range(6))
    assert found[0] != 0


@pytest.mark.usefixtures('importable')
def test_what_a_dead_process_had_is_done_by_another(tmp_path: Path) -> None:
    found = list(as_ready(imported('die_once'), [(str(tmp_path), n) for n in range(8)], 2))
    assert sorted(found) == list(range(8))
    assert (tmp_path / 'died').exists()


@pytest.mark.usefixtures('importable')
def test_processes_that_die_again_and_again_are_told() -> None:
    """And all else is done, also what was lost with them."""
    found = []
    with pytest.raises(CampaignError, match='processes of the campaign died'):
        for item in as_ready(imported('die'), list(range(6)), 2):
            found.append(item)
    assert sorted(found) == [0, 1, 3, 4, 5]
