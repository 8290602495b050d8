# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The progress bar of the commands."""

from __future__ import annotations

from collections.abc import Iterable
import sys
from typing import Any


def show_progress(items: Iterable[Any], total: int) -> Iterable[Any]:
    """Show on stderr how far an iteration is, where that is a terminal and tqdm is installed."""
    try:
        from tqdm import tqdm
    except ImportError:
        return items
    # disable=None: only where stderr is a terminal.
    bar: Iterable[Any] = tqdm(items, total=total, disable=None, leave=False, file=sys.stderr)
    return bar
