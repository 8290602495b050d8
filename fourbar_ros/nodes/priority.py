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
