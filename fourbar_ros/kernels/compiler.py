# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Compile the numerical kernels, and cache the machine code under a hash of its sources.

Numba checks its cache against the file of the compiled function alone: an edited callee in another
module would go unnoticed. And it refuses to import where no folder is writable. So the code is
cached in the user's cache folder under a hash of all sources and versions. NUMBA_CACHE_DIR selects
another folder, which the user has to clear.
"""

from collections.abc import Callable, Iterator
import contextlib
import functools
import hashlib
import logging
import os
from pathlib import Path
import platform
import re
import shutil
import stat
import sys
import tempfile
import time
from typing import Any, overload, TextIO, TypeVar

import numba
from numba.core import event
import numpy

# Kernels live in these rooms and call nothing outside them.
ROOMS = ('kernels', 'mechanism', 'plant', 'estimation', 'control')
# Seconds after which the code of other versions is dropped.
UNUSED_AFTER = 30 * 24 * 3600.0

# The parallel range of a kernel compiled with `parallel=True`.
prange = numba.prange

# Value of the option `fastmath` with which a product and a sum may be rounded once.
FUSED = {'contract'}

_OPTIONS = {'error_model': 'numpy', 'fastmath': False}
_Function = TypeVar('_Function', bound=Callable[..., Any])


@overload
def kernel(function: _Function, /) -> _Function: ...


@overload
def kernel(**options: Any) -> Callable[[_Function], _Function]: ...


def kernel(function: _Function | None = None, /, **options: Any) -> Any:
    """
    Compile a function with numba in nopython mode, and cache the code.

    Use it bare or with options of `numba.njit`: `@kernel`, `@kernel(parallel=True)`. Division by
    zero gives inf or nan as in numpy, and floating point is not reordered.
    """
    if function is None:
        return functools.partial(kernel, **options)
    directory = cache_directory()
    options = {'cache': directory is not None, **_OPTIONS, **options}
    with _numba_caches_in(directory):
        return numba.njit(**options)(function)


@contextlib.contextmanager
def announced(stream: TextIO | None = None) -> Iterator[None]:
    """
    Print a line if the block compiles kernels.

    Code from the cache prints nothing. On a terminal a second line shows the present kernel; it is
    cleared at the end.

    :param stream: by default stderr.
    """
    show = _Announcement(stream or sys.stderr)
    with event.install_listener('numba:compile', show):
        try:
            yield
        finally:
            show.finish()


class _Announcement(event.Listener):  # type: ignore[misc]
    """Prints the outermost function that is being compiled."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._done = 0

    def on_start(self, occasion: event.Event) -> None:
        if not self._done:
            print('Compiling the kernels, once after an installation (two minutes)',
                  file=self._stream, flush=True)
        self._done += 1
        if self._stream.isatty():
            name = occasion.data['dispatcher'].__name__
            print(f'\r  {self._done:3d} {name:<40}', end='', file=self._stream, flush=True)

    def on_end(self, occasion: event.Event) -> None:
        """Keep the line: the next kernel overwrites it."""

    def finish(self) -> None:
        """Clear the line."""
        if self._done and self._stream.isatty():
            print(f'\r{"":<44}\r', end='', file=self._stream, flush=True)


@functools.lru_cache(maxsize=None)
def cache_directory() -> Path | None:
    """
    Return the folder of the compiled code, None if no folder is writable.

    If the user's cache is not writable, the folder is a private one for temporary files; a warning
    is logged.
    """
    name = _fingerprint()
    if numba.config.CACHE_DIR:
        preferred = Path(numba.config.CACHE_DIR)
    else:
        preferred = _user_cache() / name
        _drop_unused(preferred)
    with contextlib.suppress(OSError):
        return _writable(preferred)
    logger = logging.getLogger(__name__)
    with contextlib.suppress(OSError):
        directory = _writable(_private_temporary() / name)
        logger.warning('cannot write to %s: compiled code is kept in %s', preferred, directory)
        return directory
    logger.warning('cannot write to %s nor to a temporary folder: every start compiles', preferred)
    return None


@contextlib.contextmanager
def _numba_caches_in(directory: Path | None) -> Iterator[None]:
    """
    Set numba's cache folder for one decoration.

    The configuration is used, not the environment, since child processes may run other sources. It
    is restored, so that compiled functions of other packages stay in their own caches.
    """
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(directory or '')
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


def _fingerprint() -> str:
    """Return a hash of all that the machine code depends on, except the processor."""
    digest = hashlib.sha256()
    for version in (platform.python_version(), numba.__version__, numpy.__version__):
        digest.update(version.encode() + b'\0')
    package = Path(__file__).parent.parent
    for room in ROOMS:
        for source in sorted((package / room).rglob('*.py')):
            digest.update(source.relative_to(package).as_posix().encode() + b'\0')
            digest.update(source.read_bytes() + b'\0')
    return digest.hexdigest()[:16]


def _writable(directory: Path) -> Path:
    """Make the folder and set its time of use; raise OSError unless it is writable."""
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=directory).close()
    os.utime(directory)
    return directory


def _private_temporary() -> Path:
    """
    Return this user's folder for temporary files.

    Numba unpickles the files of its cache, so a folder of another user under the same name must
    not be used.
    """
    directory = Path(tempfile.gettempdir()) / f'fourbar_ros-{os.getuid()}'
    with contextlib.suppress(FileExistsError):
        directory.mkdir(mode=0o700)
    status = directory.lstat()
    if (stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
            and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
        return directory
    return Path(tempfile.mkdtemp(prefix='fourbar_ros-'))


def _user_cache() -> Path:
    home = os.environ.get('XDG_CACHE_HOME') or os.path.expanduser('~/.cache')
    return Path(home) / 'fourbar_ros'


def _drop_unused(in_use: Path) -> None:
    """Remove the folders of other versions that were not used for UNUSED_AFTER seconds."""
    oldest = time.time() - UNUSED_AFTER
    with contextlib.suppress(OSError):
        for directory in in_use.parent.iterdir():
            if (re.fullmatch('[0-9a-f]{16}', directory.name) and directory != in_use
                    and directory.stat().st_mtime < oldest):
                shutil.rmtree(directory, ignore_errors=True)
