# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Inputs that belong to the same tick, brought together by their stamp, in time or late."""

from __future__ import annotations

from typing import Any

# Ticks that may be incomplete at the same time.
DEPTH = 16

# Two clocks may drift apart so fast [s/s].
DRIFT = 1e-4


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


class Punctuality:
    """
    Tells ticks that come late from those in time, by any clock that goes on steadily.

    Stamps may be of another clock: what counts is how much later than the earliest one comes.
    """

    def __init__(self) -> None:
        self._earliest_ns: float | None = None
        self._stamp_ns = 0
        self._period_ns = 0

    def is_late(self, stamp_ns: int, monotonic_ns: int) -> bool:
        """
        Tell whether a tick comes so late that the next one is due as well.

        :param stamp_ns: of the tick [ns].
        :param steady_ns: now [ns].
        """
        since_ns = stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        behind_ns = monotonic_ns - stamp_ns
        if self._earliest_ns is None or since_ns <= 0:
            self._earliest_ns, self._period_ns = behind_ns, 0
            return False
        self._period_ns = min(since_ns, self._period_ns or since_ns)
        self._earliest_ns = min(behind_ns, self._earliest_ns + DRIFT * since_ns)
        return behind_ns - self._earliest_ns > self._period_ns
