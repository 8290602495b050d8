# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The clocks that ticks may follow: each a pace, and how often to look at it."""

import time

from fourbar_ros.common.monotonic_clock import monotonic_ns
from fourbar_ros.device import FastClock, LockstepClock, RealtimeClock

# Up to this delay every tick is caught up with; after longer ones real time leaves them out and
# fast time slows down [ns].
PATIENCE_NS = 100_000_000

# The shortest and the longest time between two looks at a clock [ns]; what is due in between is
# caught up.
SHORTEST_POLL_NS = 500_000
LONGEST_POLL_NS = 50_000_000


def realtime_pace(_values, period_ns):
    """Make the pace of the real world, to be looked at once per period."""
    return RealtimeClock(time.time_ns(), monotonic_ns(), period_ns, PATIENCE_NS), period_ns


def fast_pace(values, period_ns):
    """Make the pace of simulated time that passes faster or slower."""
    factor = values['real_time_factor']
    poll_ns = round(period_ns / factor) if factor else 0
    return (FastClock(monotonic_ns(), period_ns, factor, PATIENCE_NS),
            max(SHORTEST_POLL_NS, min(poll_ns, LONGEST_POLL_NS)))


def lockstep_pace(_values, period_ns):
    """Make the pace of simulated time that waits for the answer to every tick."""
    return LockstepClock(period_ns), LONGEST_POLL_NS
