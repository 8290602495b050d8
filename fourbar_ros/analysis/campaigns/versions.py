# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The versions of what makes the numbers of a run: the same ones make the same numbers."""

from __future__ import annotations

from functools import lru_cache
import hashlib
from importlib import metadata
from pathlib import Path
import platform

import fourbar_ros

# What a closed loop without ROS is made of, what draws it, and what measures it.
ROOMS = ('control', 'device', 'estimation', 'loop', 'mechanism', 'plant')
MODULES = ('analysis/campaigns/draws.py', 'analysis/campaigns/file.py',
           'analysis/campaigns/names.py', 'analysis/campaigns/run.py', 'analysis/consistency.py')
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
