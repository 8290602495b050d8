# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Output files and folders are complete or absent."""

from collections.abc import Callable
from contextlib import AbstractContextManager
import errno
import os
from pathlib import Path
import stat
import tempfile
from typing import Any

from fourbar_ros.common.output_files import atomic_file, atomic_folder, output_folder, OutputError
import pytest

Refuses = Callable[..., AbstractContextManager[None]]


class GoneWrongError(Exception):
    pass


def test_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    with atomic_file(path) as file:
        file.write('half')
        file.flush()
        assert not path.exists()
        file.write(' and half\n')
    assert path.read_bytes() == b'half and half\n'
    assert os.listdir(tmp_path) == ['out.csv']


def test_failure_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(GoneWrongError), atomic_file(tmp_path / 'out.csv') as file:
        file.write('half')
        raise GoneWrongError
    assert not os.listdir(tmp_path)


def test_interrupt_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), atomic_file(tmp_path / 'out.csv') as file:
        file.write('half')
        raise KeyboardInterrupt
    assert not os.listdir(tmp_path)


def test_failure_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    path.write_text('old')
    with pytest.raises(GoneWrongError), atomic_file(path) as file:
        file.write('new')
        raise GoneWrongError
    assert path.read_text() == 'old'
    assert os.listdir(tmp_path) == ['out.csv']


def test_success_replaces_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    path.write_text('old and longer')
    with atomic_file(path) as file:
        file.write('new')
    assert path.read_text() == 'new'


@pytest.mark.parametrize('mask', [0o022, 0o077])
def test_file_has_the_rights_of_any_other_new_file(mask: int, tmp_path: Path) -> None:
    before = os.umask(mask)
    try:
        with atomic_file(tmp_path / 'out.csv'):
            pass
        assert os.umask(mask) == mask
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / 'out.csv').stat().st_mode) == 0o666 & ~mask


@pytest.mark.parametrize('name', ['no_such_folder/out.csv', 'file/out.csv', 'folder', 'x' * 300])
def test_path_that_cannot_be_written_is_refused(
        name: str, tmp_path: Path, refuses: Refuses) -> None:
    (tmp_path / 'file').write_text('old')
    (tmp_path / 'folder').mkdir()
    with refuses(OutputError, path=tmp_path / name), atomic_file(tmp_path / name) as file:
        file.write('text')
    assert sorted(os.listdir(tmp_path)) == ['file', 'folder']
    assert not os.listdir(tmp_path / 'folder')


def test_pipe_or_device_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    """`-o /dev/null`, also as root, does not replace the device."""
    path = tmp_path / 'pipe'
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with atomic_file(path) as file:
            file.write('text')
    except OutputError:
        pass
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(path.stat().st_mode)
    assert os.listdir(tmp_path) == ['pipe']


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='needs /dev/full')
def test_full_disk_is_refused(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuses: Refuses) -> None:
    made = tempfile.NamedTemporaryFile

    def on_a_full_disk(*args: Any, **kwargs: Any) -> Any:
        file = made(*args, **kwargs)
        os.dup2(os.open('/dev/full', os.O_WRONLY), file.fileno())
        return file
    monkeypatch.setattr(tempfile, 'NamedTemporaryFile', on_a_full_disk)
    with refuses(OutputError, errno=errno.ENOSPC), atomic_file(tmp_path / 'out.csv') as file:
        file.write('text' * 100_000)
    assert not os.listdir(tmp_path)


def test_folder_appears_when_it_is_complete(tmp_path: Path) -> None:
    folder = tmp_path / 'new' / 'out'
    with atomic_folder(folder) as made:
        assert made.name == 'out'
        assert not made.exists()
        made.mkdir()
        (made / 'file').write_text('content')
        assert not folder.exists()
    assert (folder / 'file').read_text() == 'content'
    assert os.listdir(tmp_path / 'new') == ['out']


@pytest.mark.parametrize('error', [GoneWrongError, KeyboardInterrupt])
def test_failure_leaves_no_folder(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), atomic_folder(tmp_path / 'out') as made:
        made.mkdir()
        (made / 'file').write_text('half')
        raise error
    assert not os.listdir(tmp_path)


def test_existing_folder_is_kept(tmp_path: Path, refuses: Refuses) -> None:
    with refuses(OutputError, path=tmp_path), atomic_folder(tmp_path):
        pass
    with refuses(OutputError, errno=errno.ENOSPC), atomic_folder(tmp_path / 'out'):
        raise OSError(errno.ENOSPC, 'No space left on device')
    assert not os.listdir(tmp_path)


def test_folders_of_failed_work_are_removed_while_empty(tmp_path: Path) -> None:
    (tmp_path / 'there').mkdir()
    with pytest.raises(KeyboardInterrupt), output_folder(tmp_path / 'there' / 'deep' / 'folder'):
        raise KeyboardInterrupt
    assert not list((tmp_path / 'there').iterdir())
    with pytest.raises(OutputError), output_folder(tmp_path / 'there' / 'deep' / 'folder'):
        (tmp_path / 'there' / 'deep' / 'half').write_text('done')
        raise OutputError
    assert [path.name for path in (tmp_path / 'there').glob('**/*')] == ['deep', 'half']
    with output_folder(tmp_path / 'empty'):
        pass
    assert (tmp_path / 'empty').is_dir()
