# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The versions of what makes the numbers of a run: the same ones make the same numbers."""

from __future__ import annotations

from functools import lru_cache
import hashlib
from importlib import metadata
from pathlib import Path
import platform

import fourbar_ros

# What a closed loop without ROS is made of, what draws it, and what measures it.
ROOMS = ('common', 'control', 'device', 'estimation', 'kernels', 'loop', 'mechanism', 'plant')
MODULES = ('studies/campaigns/draws.py', 'studies/campaigns/file.py',
           'studies/campaigns/names.py', 'studies/campaigns/run.py',
           'studies/consistency_statistics.py')
LIBRARIES = ('numpy', 'scipy', 'numba', 'filterpy')


@lru_cache(maxsize=None)
def versions() -> dict[str, str]:
    """Return versions by name; `sources` tells apart what has the same number."""
    package = Path(fourbar_ros.__file__).parent
    digest = hashlib.sha256()
    for source in sources():
        digest.update(source.relative_to(package).as_posix().encode() + b'\0')
        digest.update(source.read_bytes() + b'\0')
    return {'fourbar_ros': fourbar_ros.__version__, 'sources': digest.hexdigest()[:12],
            'python': '.'.join(platform.python_version_tuple()[:2]),
            **{name: metadata.version(name) for name in LIBRARIES}}


def sources() -> list[Path]:
    """Return the files of which the numbers are made, sorted."""
    package = Path(fourbar_ros.__file__).parent
    return sorted([*(path for room in ROOMS for path in (package / room).rglob('*.py')),
                   *(package / name for name in MODULES)])


def difference(here: dict[str, str], there: dict[str, str]) -> str:
    """Return what differs, in words, or ''."""
    return ', '.join(f'{name} {there.get(name, "none")}, here {version}'
                     for name, version in here.items() if there.get(name) != version)
