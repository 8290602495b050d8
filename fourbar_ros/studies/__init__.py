# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Reproducible studies, one module each.

A study is a module with a function `run(progress)` that returns a `Result`. It takes further
arguments as its entry in `STUDIES` declares: a `Sample` if it draws at random, a folder if it can
be resumed. It reads presets and the files named in its arguments. It writes no file, except that a
study which can be resumed stores finished work in its folder; the command writes the `Result`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from fourbar_ros.common.settings import setting, Settings


@dataclass(frozen=True)
class Study:
    """
    Declaration of a study, known before its module is imported.

    :param summary: one line.
    :param options: names of `OPTIONS` that it takes.
    :param runs: default number of runs of each kind; the study takes the options of a `Sample`
        as one. None for a study that takes them by name.
    :param resumes: whether it takes a `folder`, where it stores finished work.
    """

    summary: str
    options: tuple[str, ...] = ()
    runs: int | None = 100
    resumes: bool = False


@dataclass(frozen=True)
class Option:
    """
    Declaration of an option of studies.

    :param metavar, meaning: for the help.
    :param kind: converts the text of the command line.
    :param positional: a required argument without a name.
    """

    metavar: str
    meaning: str
    kind: Callable[[str], Any] = str
    positional: bool = False


OPTIONS = {
    'campaign': Option('CAMPAIGN', 'preset (prototype) or YAML file', positional=True),
    'runs': Option('N', 'number of runs of each kind (default: the number that the limits are '
                   'made for, 100; crossing: 300; montecarlo: that of the campaign)', int),
    'seed': Option('S', 'seed of the first run of each kind; run k has seed S + k (default 0)',
                   int),
    'jobs': Option('N', 'number of processes; the results do not depend on it (default: one per '
                   'core)', int),
    'mechanism': Option('NAME', 'another linkage to include, a preset or a mechanism file'),
    'scheduler': Option('tcp://HOST:PORT', 'Dask scheduler whose workers execute the runs, '
                        'instead of processes of this machine'),
    'only': Option('K', 'execute run K again, alone, and print it', int),
}
_DRAWN = ('runs', 'seed', 'jobs')

STUDIES = {
    'validation': Study('section 3: our motions beside other engines and reference motions'),
    'consistency': Study('the estimator in random closed loops: NEES, NIS, errors beside their '
                         'Cramer-Rao bound', _DRAWN),
    'crossing': Study('change points with four wheels and with two: crossing, parking, turning '
                      'there', _DRAWN, runs=300),
    'cad': Study('section 3, Fig. 3: which defect of a CAD model makes its differences'),
    'montecarlo': Study('a campaign: random closed loops over any parameters of a scenario',
                        ('campaign', *_DRAWN, 'scheduler', 'only'), runs=None, resumes=True),
    'energy': Study('section 4, Fig. 4: what four wheels save over two, and when not'),
    'inertia': Study('section 4, Fig. 5: a search for wheel inertias, beside the closed form',
                     ('seed', 'jobs'), resumes=True),
    'conditioning': Study('section 5, Fig. 6: cond(A) over lengths and offsets, and what it hides',
                          ('mechanism',)),
    'singularity': Study('sections 1 and 5: a collapsed four-bar, driven at joints and by wheels'),
    'design': Study('wheels, motors and links for given manoeuvres, applied to the prototype'),
    'bus': Study('ten minutes of the prototype on a bus over loopback: lost frames, round trips'),
}

# Largest seed of a scenario.
LARGEST_SEED = 2 ** 63 - 1
MOST_RUNS = 1_000_000
MOST_JOBS = 1024


class StudyError(FourbarError):
    """A study that does not exist or cannot run."""


def cores() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass(frozen=True)
class Sample(Settings):
    """
    Random runs of a study.

    :param runs: number of runs of each kind.
    :param seed: of the first run of each kind; the others have the following seeds.
    :param jobs: number of processes; the result does not depend on it.
    :raises SettingError: a value is out of range.
    """

    runs: int = setting(100, '', 'number of runs of each kind', low=1, high=MOST_RUNS)
    seed: int = setting(0, '', 'seed of the first run', low=0, high=LARGEST_SEED - MOST_RUNS)
    jobs: int = setting(1, '', 'number of processes', low=1, high=MOST_JOBS)


@dataclass(frozen=True)
class Result:
    """
    Result of a study.

    :param checks: numbers that have a limit.
    :param data: content of the JSON file.
    :param text: tables for the terminal.
    :param files: content of each file to write, by name.
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
    """Execute the block that draws figures; if a library is missing, append that to skipped."""
    try:
        yield
    except ImportError as error:
        skipped.append(f'no figure: {error.name} is missing')


def csv_text(columns: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return the text of a CSV file from its header and formatted cells."""
    return ''.join(','.join(map(str, row)) + '\n' for row in (columns, *rows))


def load_study(name: str, folder: Path | None = None, **options: Any
               ) -> Callable[[Progress], Result]:
    """
    Return the function that runs a study.

    :param folder: where a study that can be resumed stores finished work.
    :param options: values of `OPTIONS`.
    :raises FourbarError: no such study, or an option is unknown, missing or refused.
    """
    study = STUDIES.get(name)
    if study is None:
        raise StudyError(f'no study {name!r} (known are {", ".join(STUDIES)})', name=name)
    if unknown := [option for option in options if option not in study.options]:
        raise StudyError(f'study {name} takes no {", ".join(map(option_text, unknown))}',
                         name=name, unknown=unknown)
    if missing := [option for option in study.options
                   if OPTIONS[option].positional and option not in options]:
        raise StudyError(f'study {name} needs {", ".join(map(option_text, missing))}',
                         name=name, missing=missing)
    if 'seed' in study.options and study.runs is not None:
        drawn = {option: options.pop(option) for option in _DRAWN if option in options}
        options['sample'] = Sample(**{'runs': study.runs, 'jobs': cores(), **drawn})
    if study.resumes:
        options['folder'] = folder
    try:
        run: Callable[..., Result] = import_module(f'{__name__}.{name}').run
    except ModuleNotFoundError as error:
        raise StudyError(f'{error.name} is missing: pip install fourbar_ros[analysis,hardware]',
                         name=error.name) from None
    return partial(run, **options)


def option_text(option: str) -> str:
    """Return an option as on the command line."""
    return OPTIONS[option].metavar if OPTIONS[option].positional else f'--{option}'
