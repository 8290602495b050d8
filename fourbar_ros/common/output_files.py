# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Output files that are either whole or not there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import tempfile
from typing import cast, TextIO

from fourbar_ros.common.errors import FourbarError


class OutputError(FourbarError):
    """An output file or folder that cannot be written."""


@contextmanager
def write_whole(path: Path) -> Iterator[TextIO]:
    """
    Open a text file that appears under its name only once it is complete.

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
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException as error:
        if name:
            Path(name).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f'cannot write {path}: {error.strerror or error}') from None
        raise


def write_files(contents: Mapping[Path, str | bytes]) -> None:
    """
    Write files, each whole or not at all.

    :raises OutputError: as :func:`write_whole`; those before it are written.
    """
    for path, content in contents.items():
        with write_whole(path) as file:
            if isinstance(content, bytes):
                file.buffer.write(content)
            else:
                file.write(content)


def check_file(path: Path) -> None:
    """
    Refuse a file that :func:`write_whole` could not write, before the work that it is for.

    :raises OutputError: with what stands in the way.
    """
    parent = path.absolute().parent
    if not parent.is_dir():
        raise OutputError(f'cannot write {path}: no such folder')
    _check_regular(path)
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f'cannot write {path}: {parent} is not writable')


def check_new_folder(folder: Path) -> None:
    """
    Refuse a folder that exists or cannot be made.

    :raises OutputError: with what stands in the way.
    """
    if folder.exists():
        raise OutputError(f'{folder} exists already: choose another name or remove it')
    parent = next(above for above in folder.absolute().parents if above.exists())
    if not parent.is_dir():
        raise OutputError(f'cannot make {folder}: {parent} is not a directory')
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f'cannot make {folder}: {parent} is not writable')


@contextmanager
def kept_folder(folder: Path) -> Iterator[None]:
    """
    Make a folder if it is missing, and its parents; if nothing comes of it, not even those stay.

    :raises OutputError: it cannot be made, or nothing can be written into it.
    """
    path = folder.absolute()
    missing = [above for above in (path, *path.parents) if not above.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f'cannot make {folder}: {error.strerror}') from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise OutputError(f'cannot write into {folder}: it is not writable')
    try:
        yield
    except BaseException:
        for made in missing:
            with suppress(OSError):
                made.rmdir()    # one that holds something stays
        raise


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """
    Make a folder that appears under its name only once it is complete.

    :returns: where to make it: a path of the same name, with nothing there.
    :raises OutputError: it exists already, cannot be made, or the disk is full.
    """
    check_new_folder(folder)
    parent = folder.absolute().parent
    try:
        parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=parent, prefix=f'.{folder.name}.') as temporary:
            made = Path(temporary) / folder.name
            yield made
            os.rename(made, folder)
    except OSError as error:
        raise OutputError(f'cannot write {folder}: {error.strerror or error}') from None


def _check_regular(path: Path) -> None:
    if os.path.exists(path) and not os.path.isfile(path):
        raise OutputError(f'cannot write {path}: it is not a regular file')


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
