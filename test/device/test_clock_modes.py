# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Clock modes: each tick is made once, on the grid, and time is monotonic."""

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
MONOTONIC = 987_654_321
PERIOD = 4_000_000
PATIENCE = 100_000_000


def realtime(period: int = PERIOD, patience: int = PATIENCE) -> RealtimeClock:
    return RealtimeClock(SYSTEM, MONOTONIC, period, patience)


def fast(factor: float) -> FastClock:
    return FastClock(MONOTONIC, PERIOD, factor, PATIENCE)


def lockstep() -> LockstepClock:
    clock = LockstepClock(PERIOD)
    clock.ready = True
    return clock


CLOCKS = {'realtime': realtime, 'fast': lambda: fast(3.7), 'as fast as it can': lambda: fast(0.0),
          'lockstep': lockstep}
every_clock = pytest.mark.parametrize('make', CLOCKS.values(), ids=list(CLOCKS))


def due(clock: ClockMode, monotonic: int) -> list[int]:
    """Make all due ticks, and return their stamps."""
    stamps = []
    while (stamp := clock.due(monotonic)) is not None:
        stamps.append(stamp)
    assert not clock.is_due(monotonic)
    return stamps


def test_first_tick_is_due_at_once_and_stamped_now() -> None:
    assert due(realtime(), MONOTONIC) == [SYSTEM]


def test_one_tick_per_period_exactly() -> None:
    clock = realtime()
    stamps = []
    # Of eight polls in a period one returns a tick.
    for n in range(8 * 1000):
        stamps += due(clock, MONOTONIC + n * PERIOD // 8)
    assert stamps == [SYSTEM + n * PERIOD for n in range(1000)]
    assert clock.skipped == 0


def test_ticks_of_a_short_delay_are_made_up() -> None:
    clock = realtime()
    due(clock, MONOTONIC)
    stamps = due(clock, MONOTONIC + PERIOD + PATIENCE)
    assert stamps == [SYSTEM + n * PERIOD for n in range(1, 27)]
    assert clock.skipped == 0


def test_longer_delay_skips_all_but_the_newest_tick() -> None:
    clock = realtime()
    due(clock, MONOTONIC)
    assert due(clock, MONOTONIC + 3600 * 10 ** 9 + 5) == [SYSTEM + 3600 * 10 ** 9]
    # An hour of ticks minus the first one and the newest one.
    assert clock.skipped == 3600 * 250 - 1
    assert due(clock, MONOTONIC + 3600 * 10 ** 9 + PERIOD) == [SYSTEM + 3600 * 10 ** 9 + PERIOD]


@settings(derandomize=True)
@given(period=st.integers(1, 10 ** 9), patience=st.integers(0, 10 ** 9),
       pauses=st.lists(st.integers(-10 ** 7, 3 * 10 ** 9), max_size=40))
def test_grid_is_kept_with_any_delays(
    period: int, patience: int, pauses: list[int],
) -> None:
    """Stamps are monotonic, on the grid and never early; each grid point is made or skipped."""
    # The limit keeps the number of ticks per call small.
    patience = min(patience, 100 * period)
    clock = realtime(period, patience)
    now, latest, stamps = MONOTONIC, MONOTONIC - 1, []
    for pause in pauses:
        now += pause
        latest = max(latest, now)
        taken = due(clock, now)
        assert all(stamp - SYSTEM <= now - MONOTONIC for stamp in taken)
        stamps += taken
    assert stamps == sorted(set(stamps))
    assert all((stamp - SYSTEM) % period == 0 for stamp in stamps)
    passed = (latest - MONOTONIC) // period + 1 if latest >= MONOTONIC else 0
    assert len(stamps) + clock.skipped == passed


@every_clock
def test_pause_freezes_time(make: Callable[[], ClockMode]) -> None:
    clock = make()
    clock.due(MONOTONIC)
    clock.pause(MONOTONIC + PERIOD // 2)
    frozen = clock.now_ns(MONOTONIC + PERIOD // 2)
    for later in (PERIOD, 10 ** 9, 3600 * 10 ** 9):
        assert clock.due(MONOTONIC + later) is None
        assert clock.now_ns(MONOTONIC + later) == frozen
        clock.pause(MONOTONIC + later)
    clock.resume(MONOTONIC + 3600 * 10 ** 9)
    assert clock.now_ns(MONOTONIC + 3600 * 10 ** 9) == frozen


@every_clock
def test_ticks_stay_on_the_grid_through_pauses_and_steps(make: Callable[[], ClockMode]) -> None:
    """No tick is skipped or repeated, and the time of the timeouts is monotonic."""
    clock, now = make(), MONOTONIC
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
        clock.step(MONOTONIC)
    assert clock.due(MONOTONIC) is not None


@pytest.mark.parametrize('factor', [0.25, 1.0, 20.0])
def test_fast_time_has_the_given_rate(factor: float) -> None:
    clock = fast(factor)
    stamps = [stamp for n in range(2001) for stamp in due(clock, MONOTONIC + n * PERIOD // 40)]
    elapsed = 2000 * (PERIOD // 40)
    assert stamps == [FIRST_STAMP_NS + n * PERIOD
                      for n in range(int(elapsed * factor) // PERIOD + 1)]


def test_fast_time_slows_down_on_a_slow_machine_and_skips_no_tick() -> None:
    """Every tick takes twice its period."""
    clock = fast(1.0)
    stamps = [clock.due(MONOTONIC + n * 2 * PERIOD) for n in range(1000)]
    assert stamps == [FIRST_STAMP_NS + n * PERIOD for n in range(1000)]
    # The clock does not make up for the accumulated delay.
    late = MONOTONIC + 2000 * PERIOD
    assert len(due(clock, late)) <= PATIENCE // PERIOD + 1


def test_unlimited_fast_time_always_has_a_due_tick() -> None:
    clock = fast(0.0)
    assert [clock.due(MONOTONIC) for _ in range(3)] == [
        FIRST_STAMP_NS + n * PERIOD for n in range(3)]
    assert clock.now_ns(MONOTONIC) == FIRST_STAMP_NS + 2 * PERIOD


@pytest.mark.parametrize('factor', [-1.0, inf, nan])
def test_impossible_factor_is_refused(factor: float, refuses: Callable[..., Any]) -> None:
    with refuses(ClockModeError, name='real_time_factor', limit=0.0):
        fast(factor)


def test_lockstep_waits_for_the_answer_to_this_tick() -> None:
    clock, later = lockstep(), MONOTONIC + 10 ** 12
    assert clock.due(MONOTONIC) == FIRST_STAMP_NS
    assert clock.due(later) is None
    for stamp in (0, FIRST_STAMP_NS - PERIOD, FIRST_STAMP_NS + PERIOD):
        assert not clock.answered(stamp)
        assert clock.due(later) is None
    assert clock.answered(FIRST_STAMP_NS)
    assert not clock.answered(FIRST_STAMP_NS)
    assert clock.due(later) == FIRST_STAMP_NS + PERIOD
    # Simulated time does not depend on the monotonic clock.
    assert clock.now_ns(later + 10 ** 12) == FIRST_STAMP_NS + PERIOD


def test_lockstep_makes_no_tick_before_it_is_ready(refuses: Callable[..., Any]) -> None:
    clock = LockstepClock(PERIOD)
    assert clock.due(MONOTONIC) is None
    clock.pause(MONOTONIC)
    with refuses(ClockModeError, state='not ready'):
        clock.step(MONOTONIC)


def test_lockstep_takes_one_step_at_a_time(refuses: Callable[..., Any]) -> None:
    clock = lockstep()
    clock.pause(MONOTONIC)
    assert clock.step(MONOTONIC) == FIRST_STAMP_NS
    with refuses(ClockModeError, state='pending', pending_ns=1_000_000_000):
        clock.step(MONOTONIC)
    assert clock.answered(FIRST_STAMP_NS)
    assert clock.due(MONOTONIC) is None
    assert clock.step(MONOTONIC) == FIRST_STAMP_NS + PERIOD


def test_rate_limit_holds_the_interval() -> None:
    limit = RateLimit(5_000_000)
    passed = [now for now in range(0, 1_000_000_000, 700_000) if limit.passes(now)]
    assert min(after - before for before, after in zip(passed, passed[1:])) >= 5_000_000
    assert len(passed) > 150
