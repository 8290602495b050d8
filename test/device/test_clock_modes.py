# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""By every clock each tick comes once, on the grid, and time never goes back."""

from collections.abc import Callable
from math import inf, nan
from typing import Any

from fourbar_ros.device import (
    ClockMode,
    ClockModeError,
    FastClock,
    LockstepClock,
    RateLimit,
    RealtimeClock,
)
from fourbar_ros.device.clock_modes import FIRST_STAMP_NS
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

SYSTEM = 1_700_000_000_000_000_123
STEADY = 987_654_321
PERIOD = 4_000_000
PATIENCE = 100_000_000


def realtime(period: int = PERIOD, patience: int = PATIENCE) -> RealtimeClock:
    return RealtimeClock(SYSTEM, STEADY, period, patience)


def fast(factor: float) -> FastClock:
    return FastClock(STEADY, PERIOD, factor, PATIENCE)


def lockstep() -> LockstepClock:
    clock = LockstepClock(PERIOD)
    clock.ready = True
    return clock


CLOCKS = {'realtime': realtime, 'fast': lambda: fast(3.7), 'as fast as it can': lambda: fast(0.0),
          'lockstep': lockstep}
every_clock = pytest.mark.parametrize('make', CLOCKS.values(), ids=list(CLOCKS))


def due(clock: ClockMode, monotonic: int) -> list[int]:
    """Take all ticks that are due, one by one."""
    stamps = []
    while (stamp := clock.due(monotonic)) is not None:
        stamps.append(stamp)
    assert not clock.is_due(monotonic)
    return stamps


def test_first_tick_is_due_at_once_and_stamped_now() -> None:
    assert due(realtime(), STEADY) == [SYSTEM]


def test_one_tick_per_period_exactly() -> None:
    clock = realtime()
    stamps = []
    # Asked eight times per period, it answers once.
    for n in range(8 * 1000):
        stamps += due(clock, STEADY + n * PERIOD // 8)
    assert stamps == [SYSTEM + n * PERIOD for n in range(1000)]
    assert clock.skipped == 0


def test_delay_within_patience_is_caught_up_with() -> None:
    clock = realtime()
    due(clock, STEADY)
    stamps = due(clock, STEADY + PERIOD + PATIENCE)
    assert stamps == [SYSTEM + n * PERIOD for n in range(1, 27)]
    assert clock.skipped == 0


def test_longer_delay_leaves_out_all_but_the_newest_tick() -> None:
    clock = realtime()
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
    clock = realtime(period, patience)
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


@every_clock
def test_pause_freezes_time_whatever_passes(make: Callable[[], ClockMode]) -> None:
    clock = make()
    clock.due(STEADY)
    clock.pause(STEADY + PERIOD // 2)
    frozen = clock.now_ns(STEADY + PERIOD // 2)
    for later in (PERIOD, 10 ** 9, 3600 * 10 ** 9):
        assert clock.due(STEADY + later) is None
        assert clock.now_ns(STEADY + later) == frozen
        clock.pause(STEADY + later)
    clock.resume(STEADY + 3600 * 10 ** 9)
    assert clock.now_ns(STEADY + 3600 * 10 ** 9) == frozen


@every_clock
def test_ticks_stay_on_the_grid_through_pauses_and_steps(make: Callable[[], ClockMode]) -> None:
    """Not one is left out or comes twice, and the time of the watchdogs never goes back."""
    clock, now = make(), STEADY
    stamps, times = [], []

    def take(stamp: int | None) -> None:
        if stamp is not None:
            stamps.append(stamp)
            clock.answered(stamp)
        times.append(clock.now_ns(now))
    for _ in range(5):
        for _ in range(20):
            now += PERIOD // 5
            take(clock.due(now))
        clock.pause(now)
        for _ in range(3):
            now += 7 * PATIENCE
            take(clock.step(now))
        now += 3 * PATIENCE
        clock.resume(now)
    assert len(stamps) > 20
    assert stamps == [stamps[0] + n * PERIOD for n in range(len(stamps))]
    assert times == sorted(times)
    assert clock.skipped == 0
    assert clock.ticks == len(stamps)


@every_clock
def test_running_clock_is_not_stepped(
        make: Callable[[], ClockMode], refuses: Callable[..., Any]) -> None:
    clock = make()
    with refuses(ClockModeError, state='running'):
        clock.step(STEADY)
    assert clock.due(STEADY) is not None


@pytest.mark.parametrize('factor', [0.25, 1.0, 20.0])
def test_fast_time_passes_so_many_times_as_fast(factor: float) -> None:
    clock = fast(factor)
    stamps = [stamp for n in range(2001) for stamp in due(clock, STEADY + n * PERIOD // 40)]
    elapsed = 2000 * (PERIOD // 40)
    assert stamps == [FIRST_STAMP_NS + n * PERIOD
                      for n in range(int(elapsed * factor) // PERIOD + 1)]


def test_fast_time_slows_down_on_a_slow_machine_and_leaves_no_tick_out() -> None:
    """Every tick takes twice as long as it may."""
    clock = fast(1.0)
    stamps = [clock.due(STEADY + n * 2 * PERIOD) for n in range(1000)]
    assert stamps == [FIRST_STAMP_NS + n * PERIOD for n in range(1000)]
    # The second half of the delay is not caught up with: it was given up on long ago.
    late = STEADY + 2000 * PERIOD
    assert len(due(clock, late)) <= PATIENCE // PERIOD + 1


def test_fastest_time_always_has_a_tick_to_make() -> None:
    clock = fast(0.0)
    assert [clock.due(STEADY) for _ in range(3)] == [
        FIRST_STAMP_NS + n * PERIOD for n in range(3)]
    assert clock.now_ns(STEADY) == FIRST_STAMP_NS + 2 * PERIOD


@pytest.mark.parametrize('factor', [-1.0, inf, nan])
def test_impossible_factor_is_refused(factor: float, refuses: Callable[..., Any]) -> None:
    with refuses(ClockModeError, name='real_time_factor', limit=0.0):
        fast(factor)


def test_lockstep_waits_for_the_answer_to_this_tick() -> None:
    clock, later = lockstep(), STEADY + 10 ** 12
    assert clock.due(STEADY) == FIRST_STAMP_NS
    assert clock.due(later) is None
    for stamp in (0, FIRST_STAMP_NS - PERIOD, FIRST_STAMP_NS + PERIOD):
        assert not clock.answered(stamp)
        assert clock.due(later) is None
    assert clock.answered(FIRST_STAMP_NS)
    assert not clock.answered(FIRST_STAMP_NS)
    assert clock.due(later) == FIRST_STAMP_NS + PERIOD
    # Whatever the clock on the wall says.
    assert clock.now_ns(later + 10 ** 12) == FIRST_STAMP_NS + PERIOD


def test_lockstep_makes_no_tick_before_it_is_ready(refuses: Callable[..., Any]) -> None:
    clock = LockstepClock(PERIOD)
    assert clock.due(STEADY) is None
    clock.pause(STEADY)
    with refuses(ClockModeError, state='not ready'):
        clock.step(STEADY)


def test_lockstep_takes_one_step_at_a_time(refuses: Callable[..., Any]) -> None:
    clock = lockstep()
    clock.pause(STEADY)
    assert clock.step(STEADY) == FIRST_STAMP_NS
    with refuses(ClockModeError, state='pending', pending_ns=1_000_000_000):
        clock.step(STEADY)
    assert clock.answered(FIRST_STAMP_NS)
    assert clock.due(STEADY) is None
    assert clock.step(STEADY) == FIRST_STAMP_NS + PERIOD


def test_rate_limit_holds_the_interval() -> None:
    limit = RateLimit(5_000_000)
    passed = [now for now in range(0, 1_000_000_000, 700_000) if limit.passes(now)]
    assert min(after - before for before, after in zip(passed, passed[1:])) >= 5_000_000
    assert len(passed) > 150
