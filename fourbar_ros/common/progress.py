# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0
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
