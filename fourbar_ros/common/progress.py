# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Progress of long work; the caller decides how it is shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

Progress = Callable[[Iterable[Any], int], Iterable[Any]]
"""Wraps an iterable of known length; a progress bar, or nothing."""


def no_progress(items: Iterable[Any], total: int) -> Iterable[Any]:
    """Return the iterable itself: a :data:`Progress` without a progress bar."""
    return items


def show_note(shown: Iterable[Any], text: str) -> None:
    """Show a note beside the progress bar, if there is one."""
    set_note = getattr(shown, 'set_postfix_str', None)
    if set_note is not None:
        set_note(text)


def resume_at(shown: Iterable[Any], done: int) -> None:
    """Start the progress bar, if there is one, at the number of steps done before."""
    bar: Any = shown
    if hasattr(bar, 'initial'):
        bar.initial = bar.n = bar.last_print_n = done
        bar.refresh()
