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
Studies of the paper that can be run again, one module each.

A study is a module with `run(progress)` that returns a `Result`. It reads no files but presets
and writes none: the command does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from fourbar_ros.analysis.checks import Check
from fourbar_ros.analysis.progress import Progress
from fourbar_ros.errors import FourbarError

STUDIES = {
    'validation': 'section 3: our motions beside other engines and reference motions',
}


class StudyError(FourbarError):
    """A study that does not exist or cannot run."""


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


def load_study(name: str) -> Callable[[Progress], Result]:
    """
    Return the function that runs a study.

    :raises StudyError: there is no study of this name.
    """
    if name not in STUDIES:
        raise StudyError(f'no study {name!r} (known are {", ".join(STUDIES)})')
    run: Callable[[Progress], Result] = import_module(f'{__name__}.{name}').run
    return run
