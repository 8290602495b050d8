# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Versions of the software that computes the numbers of a run."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
import hashlib
from importlib import metadata
from pathlib import Path
import platform

import fourbar_ros

# Rooms that a closed loop without ROS consists of.
ROOMS = ('common', 'control', 'device', 'estimation', 'kernels', 'loop', 'mechanism', 'plant')
# Modules that draw its parameters and compute its metrics.
MODULES = ('studies/campaigns/campaign.py', 'studies/campaigns/campaign_metrics.py',
           'studies/campaigns/campaign_run.py',
           'studies/campaigns/distributions.py', 'studies/campaigns/parameter_names.py',
           'studies/estimator_statistics.py')
LIBRARIES = ('numpy', 'scipy', 'numba', 'filterpy')


@lru_cache(maxsize=None)
def versions() -> dict[str, str]:
    """Return versions by name; `sources` is a hash of the sources, for equal version numbers."""
    package = Path(fourbar_ros.__file__).parent
    digest = hashlib.sha256()
    for source in sources():
        digest.update(source.relative_to(package).as_posix().encode() + b'\0')
        digest.update(source.read_bytes() + b'\0')
    return {'fourbar_ros': fourbar_ros.__version__, 'sources': digest.hexdigest()[:12],
            'python': '.'.join(platform.python_version_tuple()[:2]),
            **{name: metadata.version(name) for name in LIBRARIES}}


def sources() -> list[Path]:
    """Return the source files that determine the numbers, sorted."""
    package = Path(fourbar_ros.__file__).parent
    return sorted([*(path for room in ROOMS for path in (package / room).rglob('*.py')),
                   *(package / name for name in MODULES)])


def difference(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Return the versions that differ as a text, '' if none does."""
    return ', '.join(f'{name} {there.get(name, "none")}, here {version}'
                     for name, version in here.items() if there.get(name) != version)
