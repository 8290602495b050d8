# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Who goes first on a machine with few cores."""

from contextlib import suppress
import os


def go_first():
    """
    Give this process real-time priority, where the user may (limit `rtprio`).

    All its threads, since the middleware has its own; the lowest priority is above all that is
    not real-time. Without the permission everything stays as it is.
    """
    with suppress(PermissionError):
        for thread in os.listdir('/proc/self/task'):
            os.sched_setscheduler(
                int(thread), os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))


def step_back():
    """Let those who work go first: for processes that only watch, on a machine with few cores."""
    os.nice(5)
