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

"""When ticks are due in real time."""

from __future__ import annotations


class RealtimePace:
    """
    Ticks at system time at start plus steady elapsed time, one per period.

    Small delays are caught up with, tick by tick. After a long one (a suspended machine) the
    ticks that nobody could have answered are left out.

    :param system_ns: system time now, the stamp of the first tick [ns].
    :param steady_ns: steady time now [ns].
    :param period_ns: [ns].
    :param patience_ns: how long a delay is caught up with [ns].
    """

    def __init__(self, system_ns: int, steady_ns: int, period_ns: int, patience_ns: int) -> None:
        self.skipped = 0
        self._offset_ns = system_ns - steady_ns
        self._period_ns = period_ns
        self._patience_ns = patience_ns
        self._next_ns = system_ns

    def is_due(self, steady_ns: int) -> bool:
        """Tell whether there is a tick to make."""
        return steady_ns + self._offset_ns >= self._next_ns

    def due(self, steady_ns: int) -> int | None:
        """
        Take the oldest tick that is due.

        One at a time, so that commands get their turn between two ticks that are both late.

        :returns: its stamp [ns], None if no tick is due.
        """
        if not self.is_due(steady_ns):
            return None
        behind_ns = steady_ns + self._offset_ns - self._next_ns
        if behind_ns > self._patience_ns:
            missed = behind_ns // self._period_ns
            self.skipped += missed
            self._next_ns += missed * self._period_ns
        stamp_ns = self._next_ns
        self._next_ns += self._period_ns
        return stamp_ns
