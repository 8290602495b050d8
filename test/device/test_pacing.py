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

"""In real time every tick comes once, on the grid, and time never goes back."""

from fourbar_ros.device import RealtimePace
from hypothesis import given, settings
from hypothesis import strategies as st

SYSTEM = 1_700_000_000_000_000_123
STEADY = 987_654_321
PERIOD = 4_000_000
PATIENCE = 100_000_000


def pace(period: int = PERIOD, patience: int = PATIENCE) -> RealtimePace:
    return RealtimePace(SYSTEM, STEADY, period, patience)


def due(clock: RealtimePace, steady: int) -> list[int]:
    """Take all ticks that are due, one by one."""
    stamps = []
    while (stamp := clock.due(steady)) is not None:
        stamps.append(stamp)
    assert not clock.is_due(steady)
    return stamps


def test_first_tick_is_due_at_once_and_stamped_now() -> None:
    assert due(pace(), STEADY) == [SYSTEM]


def test_one_tick_per_period_exactly() -> None:
    clock = pace()
    stamps = []
    # Asked eight times per period, it answers once.
    for n in range(8 * 1000):
        stamps += due(clock, STEADY + n * PERIOD // 8)
    assert stamps == [SYSTEM + n * PERIOD for n in range(1000)]
    assert clock.skipped == 0


def test_delay_within_patience_is_caught_up_with() -> None:
    clock = pace()
    due(clock, STEADY)
    stamps = due(clock, STEADY + PERIOD + PATIENCE)
    assert stamps == [SYSTEM + n * PERIOD for n in range(1, 27)]
    assert clock.skipped == 0


def test_longer_delay_leaves_out_all_but_the_newest_tick() -> None:
    clock = pace()
    due(clock, STEADY)
    assert due(clock, STEADY + 3600 * 10 ** 9 + 5) == [SYSTEM + 3600 * 10 ** 9]
    # An hour of ticks less the first one and the one that came.
    assert clock.skipped == 3600 * 250 - 1
    assert due(clock, STEADY + 3600 * 10 ** 9 + PERIOD) == [SYSTEM + 3600 * 10 ** 9 + PERIOD]


@settings(derandomize=True)
@given(period=st.integers(1, 10 ** 9), patience=st.integers(0, 10 ** 9),
       pauses=st.lists(st.integers(-10 ** 7, 3 * 10 ** 9), max_size=40))
def test_grid_is_kept_whatever_the_delays(
    period: int, patience: int, pauses: list[int],
) -> None:
    """Stamps rise, sit on the grid, are never early; each grid point is ticked or skipped."""
    # No more ticks per call than a test has time for.
    patience = min(patience, 100 * period)
    clock = pace(period, patience)
    now, latest, stamps = STEADY, STEADY - 1, []
    for pause in pauses:
        now += pause
        latest = max(latest, now)
        taken = due(clock, now)
        assert all(stamp - SYSTEM <= now - STEADY for stamp in taken)
        stamps += taken
    assert stamps == sorted(set(stamps))
    assert all((stamp - SYSTEM) % period == 0 for stamp in stamps)
    passed = (latest - STEADY) // period + 1 if latest >= STEADY else 0
    assert len(stamps) + clock.skipped == passed
