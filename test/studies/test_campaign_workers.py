# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Worker processes of this machine: order, lost processes, interrupts."""

from collections.abc import Callable, Iterator
from importlib import import_module
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from fourbar_ros.studies.campaigns import CampaignError
from fourbar_ros.studies.campaigns.workers import (
    completed_locally,
    interrupts_blocked,
    map_ordered,
    THREAD_VARIABLES,
)
import pytest


def slow_first(item: int) -> int:
    """Take a while for item 0."""
    time.sleep(1.5 if item == 0 else 0.0)
    return item


def die_once(arguments: tuple[str, int]) -> int:
    """Die at item 2, the first time."""
    folder, item = arguments
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


def threads(_: int) -> list[str | None]:
    """Return the numbers of threads that linear algebra libraries read."""
    return [os.environ.get(name) for name in THREAD_VARIABLES]


@pytest.fixture
def imported(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Any]]:
    """Return a function of this file in a module that other processes can import."""
    folder = str(Path(__file__).parent)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv('PYTHONPATH', folder)
    yield lambda name: getattr(import_module('test_campaign_workers'), name)
    sys.modules.pop('test_campaign_workers', None)


def singles(items: list[Any]) -> list[list[Any]]:
    """Return batches of one item each."""
    return [[item] for item in items]


@pytest.mark.slow
def test_results_come_in_the_order_of_the_items(imported: Callable[[str], Any]) -> None:
    assert list(map_ordered(abs, [-3, 2, -1], 2)) == [3, 2, 1]
    assert list(map_ordered(abs, [-3], 2)) == [3]
    assert list(map_ordered(abs, [-3, -1], 1)) == [3, 1]
    assert list(map_ordered(imported('slow_first'), list(range(6)), 2)) == list(range(6))


@pytest.mark.medium
def test_results_that_are_ready_come_first(imported: Callable[[str], Any]) -> None:
    found = list(completed_locally(imported('slow_first'), singles(list(range(6))), 2))
    assert sorted(found) == singles(list(range(6)))
    assert found[0] != [0]


@pytest.mark.medium
def test_linear_algebra_takes_one_thread_in_each_process(
        imported: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """A number that the user sets is kept."""
    for name in THREAD_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(THREAD_VARIABLES[0], '3')
    assert list(map_ordered(imported('threads'), [0, 1], 2)) == [['3', '1', '1']] * 2


@pytest.mark.slow
def test_work_of_a_dead_process_is_repeated(
        tmp_path: Path, imported: Callable[[str], Any]) -> None:
    items = [(str(tmp_path), n) for n in range(8)]
    found = list(completed_locally(imported('die_once'), singles(items), 2))
    assert sorted(found) == singles(list(range(8)))
    assert (tmp_path / 'died').exists()


@pytest.mark.slow
def test_item_that_kills_its_process_again_is_an_error(imported: Callable[[str], Any]) -> None:
    """All other items are finished, also those that were lost with it."""
    found = []
    with pytest.raises(CampaignError):
        for results in completed_locally(imported('die'), singles(list(range(6))), 2):
            found += results
    assert sorted(found) == [0, 1, 3, 4, 5]


@pytest.mark.medium
def test_no_process_is_left(imported: Callable[[str], Any]) -> None:
    pids = set(map_ordered(imported('process_id'), list(range(8)), 2))
    assert os.getpid() not in pids
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def process_id(_: int) -> int:
    """Return the process that executes an item."""
    return os.getpid()


@pytest.mark.usefixtures('interruptible')
def test_interrupt_while_processes_start_is_not_lost() -> None:
    """It is delivered after the block, and the processes never receive it."""
    code = 'import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))'
    answers = []
    with pytest.raises(KeyboardInterrupt):
        with interrupts_blocked():
            os.kill(os.getpid(), signal.SIGINT)
            answers.append(subprocess.check_output([sys.executable, '-c', code]))
    assert answers == [b'True\n']
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.slow
def test_interrupt_of_all_processes_ends_them_without_output(
        wait_until: Callable[[Callable[[], Any], str], None]) -> None:
    # A process in the background of a shell ignores interrupts.
    code = ('import signal, time\n'
            'from fourbar_ros.studies.campaigns.workers import map_ordered\n'
            'if __name__ == "__main__":\n'
            '    signal.signal(signal.SIGINT, signal.default_int_handler)\n'
            '    try:\n'
            '        for _ in map_ordered(time.sleep, [0.2] * 500, 2):\n'
            '            print("running", flush=True)\n'
            '    except KeyboardInterrupt:\n'
            '        print("interrupted", flush=True)\n')
    process = subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    process.stdout.readline()
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60.0)
    # The interrupt may come between a word and the end of its line.
    assert out.endswith('interrupted\n')
    assert err == ''
    assert process.returncode == 0
    wait_until(lambda: not group_exists(process.pid), 'end of the processes')


def group_exists(group: int) -> bool:
    """Return whether any process of a group exists."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True
