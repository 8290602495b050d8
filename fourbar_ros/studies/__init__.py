# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Studies that can be run again, one module each.

A study is a module with `run(progress)` that returns a `Result`; one that draws at random takes a
`Sample` as well, and others what their entry in `STUDIES` lists. It reads no files but presets and
those that it is given, and writes none: the command does. Only one that can be resumed keeps what
is finished in its folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
import os
from pathlib import Path
from typing import Any

from fourbar_ros.common.checks import Check
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.progress import Progress


@dataclass(frozen=True)
class Study:
    """
    What there is to know of a study before its module is imported.

    :param summary: one line.
    :param options: names of `OPTIONS` that it takes. With `seed` it is given a `sample`, of which
        these are parts; the others it is given by name.
    :param runs: of each kind, unless told; None for one that is given no sample, but all by name.
    :param resumes: whether it is given a `folder`, where it keeps what is finished.
    """

    summary: str
    options: tuple[str, ...] = ()
    runs: int | None = 100
    resumes: bool = False


@dataclass(frozen=True)
class Option:
    """
    What a study can be told.

    :param metavar, meaning: for the help.
    :param kind: makes it of what was typed.
    :param positional: given without its name; the study cannot do without it.
    """

    metavar: str
    meaning: str
    kind: Callable[[str], Any] = str
    positional: bool = False


OPTIONS = {
    'campaign': Option('CAMPAIGN', 'preset (prototype) or YAML file', positional=True),
    'runs': Option('N', 'runs of each kind (default as many as the limits are made for: 100, of '
                   'crossing 300, of montecarlo what its campaign says)', int),
    'seed': Option('S', 'of the first run of each kind, the others follow it (default 0)', int),
    'jobs': Option('N', 'processes, which change nothing but the time (default all cores)', int),
    'mechanism': Option('NAME', 'a linkage to look at as well, a preset or a mechanism file'),
    'scheduler': Option('tcp://HOST:PORT', 'a Dask scheduler whose workers make the runs, instead '
                        'of processes here'),
    'only': Option('K', 'make run K again, alone, and print it', int),
}
_DRAWN = ('runs', 'seed', 'jobs')

STUDIES = {
    'validation': Study('section 3: our motions beside other engines and reference motions'),
    'consistency': Study('the estimator in closed loops at random: NEES, NIS, errors beside their '
                         'bound', _DRAWN),
    'crossing': Study('change points with four wheels and with two: crossing, parking, turning '
                      'there', _DRAWN, runs=300),
    'cad': Study('section 3, Fig. 3: which defect of a CAD model makes its differences'),
    'montecarlo': Study('a campaign: closed loops at random over anything of a scenario',
                        ('campaign', *_DRAWN, 'scheduler', 'only'), runs=None, resumes=True),
    'energy': Study('section 4, Fig. 4: what four wheels save over two, and when not'),
    'inertia': Study('section 4, Fig. 5: a search for wheel inertias, beside the closed form',
                     ('seed', 'jobs'), resumes=True),
    'conditioning': Study('section 5, Fig. 6: cond(A) over lengths and offsets, and what it hides',
                          ('mechanism',)),
    'singularity': Study('sections 1 and 5: a collapsed four-bar, driven at joints and by wheels'),
    'design': Study('wheels, motors and links for wanted manoeuvres, answered for the prototype'),
    'bus': Study('ten minutes of the prototype on a bus over loopback: lost frames, round trips'),
}

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
    :param document: name of the JSON file in the folder, '' for that of the study.
    """

    checks: Sequence[Check]
    data: Mapping[str, Any]
    text: str
    files: Mapping[str, str | bytes] = field(default_factory=dict)
    skipped: Sequence[str] = ()
    document: str = ''


@contextmanager
def figures(skipped: list[str]) -> Iterator[None]:
    """Let a study draw, or say in what it skipped which library is missing for that."""
    try:
        yield
    except ImportError as error:
        skipped.append(f'no figure: {error.name} is missing')


def load_study(name: str, folder: Path | None = None, **given: Any
               ) -> Callable[[Progress], Result]:
    """
    Return the function that runs a study.

    :param folder: where one that can be resumed keeps what is finished.
    :param given: options by name.
    :raises StudyError: there is no study of this name, it does not take that, or needs more.
    """
    study = STUDIES.get(name)
    if study is None:
        raise StudyError(f'no study {name!r} (known are {", ".join(STUDIES)})')
    if unknown := [written(option) for option in given if option not in study.options]:
        raise StudyError(f'study {name} takes no {", ".join(unknown)}')
    if missing := [written(option) for option in study.options
                   if OPTIONS[option].positional and option not in given]:
        raise StudyError(f'study {name} needs {", ".join(missing)}')
    if 'seed' in study.options and study.runs is not None:
        drawn = {option: given.pop(option) for option in _DRAWN if option in given}
        given['sample'] = Sample(**{'runs': study.runs, **drawn})
    if study.resumes:
        given['folder'] = folder
    try:
        run: Callable[..., Result] = import_module(f'{__name__}.{name}').run
    except ImportError as error:
        raise StudyError(
            f'{error.name} is missing: pip install fourbar_ros[analysis,hardware]') from None
    return partial(run, **given)


def written(option: str) -> str:
    """Return an option as it is written on the command line."""
    return OPTIONS[option].metavar if OPTIONS[option].positional else f'--{option}'
