# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The clock that nobody can set."""

import time


def monotonic_ns() -> int:
    """
    Read the clock that nobody can set [ns].

    The very one that timers run on (rcutils): Python's monotonic clock is disciplined by NTP and
    would slowly slide past it.
    """
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
