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
