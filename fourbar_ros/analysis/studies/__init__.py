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

"""
Studies that can be run again, one module each.

A study is a module with `run(progress)` that returns a `Result`; one that draws at random takes a
`Sample` as well. It reads no files but presets and writes none: the command does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
import os
from typing import Any

from fourbar_ros.analysis.checks import Check
from fourbar_ros.analysis.progress import Progress
from fourbar_ros.errors import FourbarError

STUDIES = {
    'validation': 'section 3: our motions beside other engines and reference motions',
    'consistency': 'the estimator in closed loops at random: NEES, NIS, errors beside their bound',
    'crossing': 'change points with four wheels and with two: crossing, parking, turning there',
    'bus': 'ten minutes of the prototype on a bus over loopback: lost frames, round trips',
}
RANDOM = {'consistency': 100, 'crossing': 300}
"""Those that draw at random, and how many runs of each kind unless told."""

LARGEST_SEED = 2 ** 63 - 1
MOST_RUNS = 1_000_000
MOST_JOBS = 1024


class StudyError(FourbarError):
    """A study that does not exist or cannot run."""


def cores() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class Sample:
    """
    What a study draws.

    :param runs: of each kind.
    :param seed: of the first run of each kind; the others have those that follow.
    :param jobs: processes; the result is the same for any number.
    :raises StudyError: that is no sample.
    """

    runs: int = 100
    seed: int = 0
    jobs: int = field(default_factory=cores)

    def __post_init__(self) -> None:
        """Refuse what cannot be drawn."""
        for name, low, high in (('runs', 1, MOST_RUNS), ('seed', 0, LARGEST_SEED - MOST_RUNS),
                                ('jobs', 1, MOST_JOBS)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise StudyError(f'--{name} must be from {low} to {high}, got {value}')


@dataclass(frozen=True)
class Result:
    """
    What a study found.

    :param checks: the numbers that have a limit.
    :param data: the study's own numbers, for JSON.
    :param text: the same for people, in lines.
    :param files: the content of each file to write, by name.
    :param skipped: what was left out and why, one line each.
    """

    checks: Sequence[Check]
    data: Mapping[str, Any]
    text: str
    files: Mapping[str, str | bytes] = field(default_factory=dict)
    skipped: Sequence[str] = ()


def load_study(name: str, **sample: int) -> Callable[[Progress], Result]:
    """
    Return the function that runs a study.

    :param sample: what is given of a `Sample`.
    :raises StudyError: there is no study of this name, or it does not draw that.
    """
    if name not in STUDIES:
        raise StudyError(f'no study {name!r} (known are {", ".join(STUDIES)})')
    if sample and name not in RANDOM:
        raise StudyError(f'study {name} draws nothing at random: it takes no '
                         + ', '.join(f'--{option}' for option in sample))
    drawn = {'sample': Sample(**{'runs': RANDOM[name], **sample})} if name in RANDOM else {}
    try:
        run: Callable[..., Result] = import_module(f'{__name__}.{name}').run
    except ImportError as error:
        raise StudyError(
            f'{error.name} is missing: pip install fourbar_ros[analysis,hardware]') from None
    return partial(run, **drawn)
