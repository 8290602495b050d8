# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The monotonic clock of the suite."""

import time


def monotonic_ns() -> int:
    """
    Read the raw monotonic clock [ns], which cannot be set and is not disciplined by NTP.

    The timers of rcutils run on the same clock. `time.monotonic_ns` drifts against them by the
    frequency correction of NTP.
    """
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
