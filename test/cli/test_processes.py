# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Child processes are stopped in order and end with their parent."""

from collections.abc import Iterator
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from fourbar_ros.cli import processes
from fourbar_ros.cli.processes import ProcessError, Processes
import pytest

# Replacement of `python -m fourbar_ros NAME ...` that logs its start and its signals. `deaf`
# ignores signals, `brief` ends at once, `mute` ends at once without output.
CHILD = """\
#!{python}
import os, signal, sys, time
name = sys.argv[3]
def note(text):
    with open({journal!r}, 'a') as file:
        file.write(f'{{name}} {{text}} {{os.getpid()}}\\n')
if name == 'brief':
    print('first line\\nthe last word', flush=True)
    sys.exit(3)
if name == 'mute':
    sys.exit(4)
def end(number, frame):
    note(signal.Signals(number).name)
    if name != 'deaf':
        sys.exit(0)
signal.signal(signal.SIGINT, end)
signal.signal(signal.SIGTERM, end)
print('arguments', *sys.argv[1:], flush=True)
print('group', os.getpgrp() == os.getpid(), flush=True)
note('began')
while True:
    time.sleep(0.05)
"""
PARENT = """\
import sys, time
from pathlib import Path
from fourbar_ros.cli.processes import Processes
sys.executable = sys.argv[1]
with Processes(Path(sys.argv[2]), {}) as children:
    children.start('one')
    children.start('two')
    time.sleep(600)
"""
PATIENCE = 30.0
PYTHON = sys.executable


class Stage:
    """A folder with the journal and the logs of the children."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.child = folder / 'child'
        self.journal = folder / 'journal'
        self.journal.touch()
        self.child.write_text(CHILD.format(python=PYTHON, journal=str(self.journal)))
        self.child.chmod(0o755)

    def lines(self) -> list[list[str]]:
        """Return the lines of the journal: name, event, process id."""
        return [line.split() for line in self.journal.read_text().splitlines()]

    def wait_for(self, count: int) -> list[list[str]]:
        """Wait until the journal has this number of lines."""
        end = time.monotonic() + PATIENCE
        while len(self.lines()) < count:
            assert time.monotonic() < end, self.lines()
            time.sleep(0.02)
        return self.lines()

    def events(self) -> list[tuple[str, str]]:
        """Return the journal without process ids."""
        return [(name, what) for name, what, _ in self.lines()]


def alive(pid: str) -> bool:
    """Return whether a process runs; a zombie does not run."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False


@pytest.fixture
def stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    """Replace the package by the child program; kill the children after the test."""
    stage = Stage(tmp_path)
    monkeypatch.setattr(processes.sys, 'executable', str(stage.child))
    monkeypatch.setattr(processes, 'SIGNAL_TIMEOUT_S', 0.3)
    yield stage
    for _, _, pid in stage.lines():
        if alive(pid):
            os.kill(int(pid), signal.SIGKILL)


def test_children_are_stopped_in_reverse_order(stage: Stage) -> None:
    with Processes(stage.folder, os.environ) as children:
        for count, name in enumerate(['one', 'two', 'three']):
            children.start(name)
            stage.wait_for(count + 1)
        children.check()
    assert stage.events()[3:] == [('three', 'SIGINT'), ('two', 'SIGINT'), ('one', 'SIGINT')]
    assert not any(alive(pid) for _, _, pid in stage.lines())


def test_children_are_stopped_when_the_parent_fails(stage: Stage) -> None:
    with pytest.raises(ZeroDivisionError), Processes(stage.folder, os.environ) as children:
        children.start('one')
        stage.wait_for(1)
        raise ZeroDivisionError
    assert stage.events()[-1] == ('one', 'SIGINT')
    assert not alive(stage.lines()[0][2])


def test_single_child_can_be_stopped_before_the_others(stage: Stage) -> None:
    with Processes(stage.folder, os.environ) as children:
        children.start('one')
        children.start('two')
        stage.wait_for(2)
        children.stop('one')
        children.check()
        assert ('one', 'SIGINT') in stage.events()
        assert ('two', 'SIGINT') not in stage.events()


@pytest.mark.medium
def test_child_that_ignores_signals_is_killed(stage: Stage) -> None:
    with Processes(stage.folder, os.environ) as children:
        children.start('deaf')
        stage.wait_for(1)
    assert stage.events() == [('deaf', 'began'), ('deaf', 'SIGINT'), ('deaf', 'SIGTERM')]
    assert not alive(stage.lines()[0][2])


def test_child_has_name_arguments_environment_and_own_group(stage: Stage) -> None:
    """Ctrl-C on the terminal does not reach a process in its own group."""
    with Processes(stage.folder, {**os.environ, 'ANSWER': '42'}) as children:
        children.start('one', ['--rate', '5'])
        pid = stage.wait_for(1)[0][2]
        environment = Path(f'/proc/{pid}/environ').read_text().split('\0')
    assert 'ANSWER=42' in environment
    assert (stage.folder / 'one.log').read_text().splitlines() == [
        'arguments -m fourbar_ros one --rate 5', 'group True']


@pytest.mark.parametrize(('name', 'code', 'words'), [
    ('brief', 3, 'the last word'), ('mute', 4, 'no output')])
def test_end_of_a_child_is_an_error_with_its_last_line(
    name: str, code: int, words: str, stage: Stage,
) -> None:
    with Processes(stage.folder, os.environ) as children:
        children.start('one')
        children.start(name)
        end = time.monotonic() + PATIENCE
        with pytest.raises(ProcessError) as caught:
            while time.monotonic() < end:
                children.check()
                time.sleep(0.02)
    assert str(caught.value) == f'{name} ended with exit code {code}: {words}'


def test_children_end_with_a_parent_that_is_killed(stage: Stage) -> None:
    script = stage.folder / 'parent.py'
    script.write_text(PARENT)
    parent = subprocess.Popen(
        [PYTHON, str(script), str(stage.child), str(stage.folder)],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(path for path in sys.path if path)})
    try:
        pids = [line[2] for line in stage.wait_for(2)]
        assert all(alive(pid) for pid in pids)
    finally:
        parent.kill()
        parent.wait()
    end = time.monotonic() + PATIENCE
    while any(alive(pid) for pid in pids):
        assert time.monotonic() < end
        time.sleep(0.02)
    assert sorted(stage.events()[2:]) == [('one', 'SIGTERM'), ('two', 'SIGTERM')]


@pytest.mark.skipif(sys.version_info < (3, 11), reason='Python does not offer it')
def test_package_in_the_working_directory_is_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The working directory has another checkout of the package."""
    other = tmp_path / 'fourbar_ros'
    other.mkdir()
    (other / '__init__.py').touch()
    (other / '__main__.py').write_text("print('another package', flush=True)")
    monkeypatch.chdir(tmp_path)
    with Processes(tmp_path, os.environ) as children:
        children.start('--version')
        end = time.monotonic() + PATIENCE
        while not (said := (tmp_path / '--version.log').read_text()):
            assert time.monotonic() < end
            time.sleep(0.05)
    assert said.startswith('fourbar_ros ')
