# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Pairing of the inputs of a tick by their stamps, and detection of late ticks."""

from __future__ import annotations

from typing import Any

# Number of ticks that may be incomplete at the same time.
DEPTH = 16
# Largest drift between the clock of the stamps and the monotonic clock [s/s].
DRIFT = 1e-4


class StampPairs:
    """Keeps the first half of a pair until the second arrives; DDS promises no order of topics."""

    def __init__(self) -> None:
        self._halves: dict[int, dict[str, Any]] = {}

    def complete(self, stamp_ns: int, kind: str, value: Any) -> dict[str, Any] | None:
        """
        Add one half.

        :param kind: name of the half.
        :returns: both halves by kind once both are known; this and older stamps are discarded.
        """
        pair = self._halves.setdefault(stamp_ns, {})
        pair[kind] = value
        if len(pair) == 2:
            self._halves = {stamp: half for stamp, half in self._halves.items()
                            if stamp > stamp_ns}
            return pair
        if len(self._halves) > DEPTH:
            # The oldest by arrival: a device that restarts may have older stamps.
            del self._halves[next(iter(self._halves))]
        return None


class LatenessDetector:
    """
    Detects ticks that arrive late.

    Stamps may be of another clock: the delay of a tick is measured from the smallest delay so far.
    """

    def __init__(self) -> None:
        self._least_delay_ns: float | None = None
        self._stamp_ns = 0
        self._period_ns = 0

    def is_late(self, stamp_ns: int, monotonic_ns: int) -> bool:
        """
        Return whether a tick arrives so late that the next one is due too.

        :param stamp_ns: of the tick [ns].
        :param monotonic_ns: present time [ns].
        """
        elapsed_ns = stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        delay_ns = monotonic_ns - stamp_ns
        if self._least_delay_ns is None or elapsed_ns <= 0:
            self._least_delay_ns, self._period_ns = delay_ns, 0
            return False
        self._period_ns = min(elapsed_ns, self._period_ns or elapsed_ns)
        self._least_delay_ns = min(delay_ns, self._least_delay_ns + DRIFT * elapsed_ns)
        return delay_ns - self._least_delay_ns > self._period_ns
