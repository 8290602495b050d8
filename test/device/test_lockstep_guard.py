# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What helps a tick without an answer: nothing, sending it again, or going on."""

from fourbar_ros.device import LockstepClock, LockstepGuard, Participants, Recovery

PERIOD = 4_000_000
TIMEOUT = 1_000_000_000
SETTLE = 500_000_000
FIRST = 1_000_000_000
ALL = Participants(1, 1, 1, 1, 1)


def waiting() -> tuple[LockstepClock, LockstepGuard, int]:
    """Return a lock-step whose first tick just went out to all, its guard and the time."""
    clock = LockstepClock(PERIOD)
    guard = LockstepGuard(clock, TIMEOUT, SETTLE)
    guard.update(ALL, 0)
    guard.update(ALL, SETTLE)
    assert clock.due(SETTLE) == FIRST
    return clock, guard, SETTLE


def test_tick_is_sent_again_after_the_timeout_at_intervals_that_grow() -> None:
    _, guard, start = waiting()
    step = TIMEOUT // 20
    times = [n * step for n in range(20 * 60)
             if guard.recovery(None, start + n * step) is not Recovery.NOTHING]
    intervals = [after - before for before, after in zip([0, *times], times)]
    assert times[0] == TIMEOUT + step
    assert intervals == sorted(intervals)
    assert intervals[1] >= TIMEOUT
    # Soon enough after a long stop that a person would still wait for it.
    assert intervals[-1] <= 10 * TIMEOUT + step


def test_link_angles_go_out_again_only_if_the_estimator_said_nothing() -> None:
    for estimate, recovery in ((None, Recovery.SEND_ALL), (FIRST - PERIOD, Recovery.SEND_ALL),
                               (FIRST, Recovery.SEND_TICK)):
        _, guard, start = waiting()
        assert guard.recovery(estimate, start + TIMEOUT + 1) is recovery


def test_answered_tick_needs_no_help() -> None:
    clock, guard, start = waiting()
    assert clock.answered(FIRST)
    assert guard.recovery(FIRST, start + 100 * TIMEOUT) is Recovery.NOTHING


def test_every_tick_has_its_own_patience() -> None:
    clock, guard, now = waiting()
    for _ in range(3):
        assert guard.recovery(None, now + TIMEOUT) is Recovery.NOTHING
        now += TIMEOUT + 1
        assert guard.recovery(None, now) is Recovery.SEND_ALL
        assert clock.answered(clock.now_ns(now))
        assert clock.due(now) is not None


def test_nothing_is_sent_to_nobody() -> None:
    _, guard, start = waiting()
    guard.update(Participants(1, 1, 0, 1, 0), start + 1)
    assert guard.recovery(None, start + 5 * TIMEOUT) is Recovery.NOTHING


def test_tick_that_went_out_before_somebody_joined_is_given_up() -> None:
    _, guard, start = waiting()
    guard.update(Participants(1, 1, 0, 1, 0), start + 1)
    guard.update(ALL, start + 2 * TIMEOUT)
    recoveries = [guard.recovery(None, start + 2 * TIMEOUT + n * SETTLE // 4) for n in range(12)]
    assert set(recoveries[:4]) == {Recovery.NOTHING}
    assert recoveries[4] is Recovery.GIVE_UP
