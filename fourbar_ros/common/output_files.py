# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Atomic output: a file or folder is complete, or it does not exist."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import tempfile
from typing import cast, TextIO

from fourbar_ros.common.errors import FourbarError


class OutputError(FourbarError):
    """
    An output file or folder that cannot be written.

    Its `values` hold `path` and, where the operating system refused, `errno`.
    """


@contextmanager
def atomic_file(path: Path) -> Iterator[TextIO]:
    """
    Open a text file that appears under its name when it is complete.

    :raises OutputError: the folder is missing or not writable, the disk is full, or the path is
        a folder, a pipe or a device.
    """
    _check_regular(path)
    name = ''
    try:
        with tempfile.NamedTemporaryFile(
                'w', encoding='utf-8', newline='\n', dir=path.parent,
                prefix=f'.{path.name}.', delete=False) as file:
            name = file.name
            yield cast(TextIO, file)
            # So that the name never stands for a file that a power failure left empty.
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException as error:
        if name:
            Path(name).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _write_error(path, error) from None
        raise


def write_files(contents: Mapping[Path, str | bytes]) -> None:
    """
    Write files, each of them atomically.

    :raises OutputError: as :func:`atomic_file`; the files before the refused one are written.
    """
    for path, content in contents.items():
        with atomic_file(path) as file:
            if isinstance(content, bytes):
                file.buffer.write(content)
            else:
                file.write(content)


def check_file(path: Path) -> None:
    """
    Refuse an output file before the work starts, if :func:`atomic_file` could not write it.

    :raises OutputError: with the reason.
    """
    parent = path.absolute().parent
    if not parent.is_dir():
        raise OutputError(f'cannot write {path}: no such folder', path=path)
    _check_regular(path)
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f'cannot write {path}: {parent} is not writable', path=path)


def check_new_folder(folder: Path) -> None:
    """
    Refuse a folder that exists or cannot be made.

    :raises OutputError: with the reason.
    """
    if folder.exists():
        raise OutputError(f'{folder} exists already: choose another name or remove it',
                          path=folder)
    parent = next(above for above in folder.absolute().parents if above.exists())
    if not parent.is_dir():
        raise OutputError(f'cannot make {folder}: {parent} is not a directory', path=folder)
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f'cannot make {folder}: {parent} is not writable', path=folder)


@contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """
    Make a folder and its parents where they are missing, for the files that the block writes.

    If the block fails, the folders that it made and left empty are removed.

    :raises OutputError: the folder cannot be made or is not writable.
    """
    path = folder.absolute()
    missing = [above for above in (path, *path.parents) if not above.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f'cannot make {folder}: {error.strerror}', path=folder,
                          errno=error.errno) from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise OutputError(f'cannot write into {folder}: it is not writable', path=folder)
    try:
        yield
    except BaseException:
        for empty in missing:
            with suppress(OSError):
                empty.rmdir()   # refuses a folder that holds a file
        raise


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """
    Make a folder that appears under its name when it is complete.

    :returns: temporary path of the same name, where the block makes the folder.
    :raises OutputError: the folder exists already or cannot be made, or the disk is full.
    """
    check_new_folder(folder)
    parent = folder.absolute().parent
    try:
        parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=parent, prefix=f'.{folder.name}.') as temporary:
            unfinished = Path(temporary) / folder.name
            yield unfinished
            os.rename(unfinished, folder)
    except OSError as error:
        raise _write_error(folder, error) from None


def _write_error(path: Path, error: OSError) -> OutputError:
    return OutputError(f'cannot write {path}: {error.strerror or error}', path=path,
                       errno=error.errno)


def _check_regular(path: Path) -> None:
    # Replacing a device or a pipe, such as /dev/null, by a file would harm the machine.
    if os.path.exists(path) and not os.path.isfile(path):
        raise OutputError(f'cannot write {path}: it is not a regular file', path=path)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
