# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""An output file is whole or not there."""

import os
from pathlib import Path
import stat
import tempfile
from typing import Any

from fourbar_ros.common.output_files import kept_folder, OutputError, whole_folder, write_whole
import pytest


class GoneWrongError(Exception):
    pass


def test_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    with write_whole(path) as file:
        file.write('half')
        file.flush()
        assert not path.exists()
        file.write(' and half\n')
    assert path.read_bytes() == b'half and half\n'
    assert os.listdir(tmp_path) == ['out.csv']


def test_failure_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(GoneWrongError), write_whole(tmp_path / 'out.csv') as file:
        file.write('half')
        raise GoneWrongError
    assert not os.listdir(tmp_path)


def test_interrupt_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), write_whole(tmp_path / 'out.csv') as file:
        file.write('half')
        raise KeyboardInterrupt
    assert not os.listdir(tmp_path)


def test_failure_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    path.write_text('old')
    with pytest.raises(GoneWrongError), write_whole(path) as file:
        file.write('new')
        raise GoneWrongError
    assert path.read_text() == 'old'
    assert os.listdir(tmp_path) == ['out.csv']


def test_success_replaces_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    path.write_text('old and longer')
    with write_whole(path) as file:
        file.write('new')
    assert path.read_text() == 'new'


@pytest.mark.parametrize('mask', [0o022, 0o077])
def test_file_has_the_rights_of_any_other_new_file(mask: int, tmp_path: Path) -> None:
    before = os.umask(mask)
    try:
        with write_whole(tmp_path / 'out.csv'):
            pass
        assert os.umask(mask) == mask
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / 'out.csv').stat().st_mode) == 0o666 & ~mask


@pytest.mark.parametrize('name', ['no_such_folder/out.csv', 'file/out.csv', 'folder', 'x' * 300])
def test_place_that_cannot_be_written_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('old')
    (tmp_path / 'folder').mkdir()
    with pytest.raises(OutputError, match='cannot write') as caught, write_whole(
            tmp_path / name) as file:
        file.write('text')
    assert str(tmp_path / name) in str(caught.value)
    assert '\n' not in str(caught.value)
    assert sorted(os.listdir(tmp_path)) == ['file', 'folder']
    assert not os.listdir(tmp_path / 'folder')


def test_pipe_or_device_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    """`-o /dev/stdout` or `-o /dev/null`, and be it as root, must not cost the machine these."""
    path = tmp_path / 'pipe'
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with write_whole(path) as file:
            file.write('text')
    except OutputError:
        pass
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(path.stat().st_mode)
    assert os.listdir(tmp_path) == ['pipe']


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='needs /dev/full')
def test_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = tempfile.NamedTemporaryFile

    def on_a_full_disk(*args: Any, **kwargs: Any) -> Any:
        file = made(*args, **kwargs)
        os.dup2(os.open('/dev/full', os.O_WRONLY), file.fileno())
        return file
    monkeypatch.setattr(tempfile, 'NamedTemporaryFile', on_a_full_disk)
    with pytest.raises(OutputError, match='No space left'), write_whole(
            tmp_path / 'out.csv') as file:
        file.write('text' * 100_000)
    assert not os.listdir(tmp_path)


def test_folder_appears_when_it_is_complete(tmp_path: Path) -> None:
    folder = tmp_path / 'new' / 'out'
    with whole_folder(folder) as made:
        assert made.name == 'out'
        assert not made.exists()
        made.mkdir()
        (made / 'file').write_text('content')
        assert not folder.exists()
    assert (folder / 'file').read_text() == 'content'
    assert os.listdir(tmp_path / 'new') == ['out']


@pytest.mark.parametrize('error', [GoneWrongError, KeyboardInterrupt])
def test_failure_leaves_no_folder_behind(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), whole_folder(tmp_path / 'out') as made:
        made.mkdir()
        (made / 'file').write_text('half')
        raise error
    assert not os.listdir(tmp_path)


def test_folder_that_is_there_is_kept(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match='exists already'), whole_folder(tmp_path):
        pass
    with pytest.raises(OutputError, match='No space'), whole_folder(tmp_path / 'out'):
        raise OSError(28, 'No space left on device')
    assert not os.listdir(tmp_path)


def test_folder_of_which_nothing_comes_does_not_stay(tmp_path: Path) -> None:
    (tmp_path / 'there').mkdir()
    with pytest.raises(KeyboardInterrupt), kept_folder(tmp_path / 'there' / 'deep' / 'folder'):
        raise KeyboardInterrupt
    assert not list((tmp_path / 'there').iterdir())
    with pytest.raises(OutputError), kept_folder(tmp_path / 'there' / 'deep' / 'folder'):
        (tmp_path / 'there' / 'deep' / 'half').write_text('done')
        raise OutputError
    assert [path.name for path in (tmp_path / 'there').glob('**/*')] == ['deep', 'half']
    with kept_folder(tmp_path / 'empty'):
        pass
    assert (tmp_path / 'empty').is_dir()
