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

"""Inputs that belong to the same tick, brought together by their stamp."""

from __future__ import annotations

from typing import Any

# Ticks that may be incomplete at the same time.
DEPTH = 16


class StampPairs:
    """Keep the halves of a pair until both are there; the middleware promises no order."""

    def __init__(self) -> None:
        self._halves: dict[int, dict[str, Any]] = {}

    def complete(self, stamp_ns: int, kind: str, value: Any) -> dict[str, Any] | None:
        """
        Add one half.

        :param kind: which half.
        :returns: both halves by kind if they are there now, and forgets this and older stamps.
        """
        pair = self._halves.setdefault(stamp_ns, {})
        pair[kind] = value
        if len(pair) == 2:
            self._halves = {stamp: half for stamp, half in self._halves.items()
                            if stamp > stamp_ns}
            return pair
        if len(self._halves) > DEPTH:
            # The oldest by arrival: a device that starts again may be behind in time.
            del self._halves[next(iter(self._halves))]
        return None
