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
"""How work that takes time tells how far it is, without knowing who shows it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

Progress = Callable[[Iterable[Any], int], Iterable[Any]]
"""Wraps an iterable that takes time, given also its length."""


def remark(shown: Iterable[Any], text: str) -> None:
    """Say something beside the progress, where it is shown."""
    say = getattr(shown, 'set_postfix_str', None)
    if say is not None:
        say(text)


def begin_at(shown: Iterable[Any], done: int) -> None:
    """Let the progress begin with so many steps that were made before, where it is shown."""
    bar: Any = shown
    if hasattr(bar, 'initial'):
        bar.initial = bar.n = bar.last_print_n = done
        bar.refresh()
