# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Recovery of a tick without an answer: wait, send it again, or give up."""

from fourbar_ros.device import LockstepClock, LockstepGuard, Participants, Recovery

PERIOD = 4_000_000
TIMEOUT = 1_000_000_000
SETTLE = 500_000_000
FIRST = 1_000_000_000
ALL = Participants(1, 1, 1, 1, 1)


def waiting() -> tuple[LockstepClock, LockstepGuard, int]:
    """Return a lock-step clock whose first tick has just been sent, its guard and the time."""
    clock = LockstepClock(PERIOD)
    guard = LockstepGuard(clock, TIMEOUT, SETTLE)
    guard.update(ALL, 0)
    guard.update(ALL, SETTLE)
    assert clock.due(SETTLE) == FIRST
    return clock, guard, SETTLE


def test_tick_is_repeated_after_the_timeout_at_growing_intervals() -> None:
    _, guard, start = waiting()
    step = TIMEOUT // 20
    times = [n * step for n in range(20 * 60)
             if guard.recovery(None, start + n * step) is not Recovery.NOTHING]
    intervals = [after - before for before, after in zip([0, *times], times)]
    assert times[0] == TIMEOUT + step
    assert intervals == sorted(intervals)
    assert intervals[1] >= TIMEOUT
    # The longest interval limits the delay after a long stop.
    assert intervals[-1] <= 10 * TIMEOUT + step


def test_link_angles_are_repeated_only_without_an_estimate() -> None:
    for estimate, recovery in ((None, Recovery.SEND_ALL), (FIRST - PERIOD, Recovery.SEND_ALL),
                               (FIRST, Recovery.SEND_TICK)):
        _, guard, start = waiting()
        assert guard.recovery(estimate, start + TIMEOUT + 1) is recovery


def test_answered_tick_is_not_repeated() -> None:
    clock, guard, start = waiting()
    assert clock.answered(FIRST)
    assert guard.recovery(FIRST, start + 100 * TIMEOUT) is Recovery.NOTHING


def test_every_tick_has_its_own_timeout() -> None:
    clock, guard, now = waiting()
    for _ in range(3):
        assert guard.recovery(None, now + TIMEOUT) is Recovery.NOTHING
        now += TIMEOUT + 1
        assert guard.recovery(None, now) is Recovery.SEND_ALL
        assert clock.answered(clock.now_ns(now))
        assert clock.due(now) is not None


def test_tick_is_not_repeated_without_participants() -> None:
    _, guard, start = waiting()
    guard.update(Participants(1, 1, 0, 1, 0), start + 1)
    assert guard.recovery(None, start + 5 * TIMEOUT) is Recovery.NOTHING


def test_tick_is_given_up_after_a_participant_joins() -> None:
    _, guard, start = waiting()
    guard.update(Participants(1, 1, 0, 1, 0), start + 1)
    guard.update(ALL, start + 2 * TIMEOUT)
    recoveries = [guard.recovery(None, start + 2 * TIMEOUT + n * SETTLE // 4) for n in range(12)]
    assert set(recoveries[:4]) == {Recovery.NOTHING}
    assert recoveries[4] is Recovery.GIVE_UP
