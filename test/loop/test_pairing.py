# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Pairing of two messages of a tick in any order and with lost messages."""

from fourbar_ros.loop.stamp_pairing import DEPTH, LatenessDetector, StampPairs
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

PERIOD = 4_000_000


@pytest.mark.parametrize('kinds', [('estimate', 'wheels'), ('wheels', 'estimate')])
def test_pair_is_complete_with_its_second_half(kinds: tuple[str, str]) -> None:
    pairs = StampPairs()
    assert pairs.complete(5, kinds[0], 'first') is None
    assert pairs.complete(5, kinds[1], 'second') == {kinds[0]: 'first', kinds[1]: 'second'}


def test_halves_of_different_ticks_are_no_pair() -> None:
    pairs = StampPairs()
    assert pairs.complete(1, 'estimate', 'one') is None
    assert pairs.complete(2, 'wheels', 'two') is None
    assert pairs.complete(2, 'estimate', 'two') is not None


def test_same_half_twice_is_no_pair() -> None:
    pairs = StampPairs()
    assert pairs.complete(1, 'wheels', 'old') is None
    assert pairs.complete(1, 'wheels', 'new') is None
    assert pairs.complete(1, 'estimate', 'e') == {'wheels': 'new', 'estimate': 'e'}


def test_older_ticks_are_dropped_when_a_newer_one_is_complete() -> None:
    pairs = StampPairs()
    pairs.complete(1, 'wheels', 'one')
    pairs.complete(2, 'wheels', 'two')
    assert pairs.complete(2, 'estimate', 'two') is not None
    assert pairs.complete(1, 'estimate', 'one') is None


@settings(derandomize=True)
@given(ahead=st.lists(st.integers(-DEPTH // 2, DEPTH // 2), min_size=1, max_size=60),
       lost=st.sets(st.tuples(st.integers(0, 59), st.sampled_from('ew'))))
def test_each_tick_is_complete_once_and_in_order(
    ahead: list[int], lost: set[tuple[int, str]],
) -> None:
    """Each topic is in order; one leads the other by a few ticks; some messages are lost."""
    count = len(ahead)
    arrivals = []
    delay = 0.0
    for n, lead in enumerate(ahead):
        delay = max(delay, n + lead)
        arrivals += [(n, 0, n, 'e'), (delay, 1, n, 'w')]
    pairs = StampPairs()
    complete = []
    for _, _, stamp, kind in sorted(arrivals):
        pair = None if (stamp, kind) in lost else pairs.complete(stamp, kind, (stamp, kind))
        if pair is not None:
            assert pair == {kind: (stamp, kind) for kind in 'ew'}
            complete.append(stamp)
    assert complete == [n for n in range(count) if not {(n, 'e'), (n, 'w')} & lost]


def test_lost_halves_do_not_accumulate() -> None:
    pairs = StampPairs()
    for n in range(1000):
        assert pairs.complete(n, 'wheels', n) is None
    # The newest of the thousand halves is kept, the first one is dropped.
    assert pairs.complete(0, 'estimate', 0) is None
    assert pairs.complete(999, 'estimate', 999) is not None


@pytest.mark.parametrize('lost', [1, DEPTH, 3 * DEPTH])
def test_device_that_starts_again_at_an_earlier_time_is_paired_again(lost: int) -> None:
    """Halves of an earlier run with later stamps do not block the next run."""
    pairs = StampPairs()
    for n in range(lost):
        pairs.complete(10 ** 18 + n * PERIOD, 'wheels', n)
    complete = []
    for n in range(2 * DEPTH):
        stamp = 10 ** 9 + n * PERIOD
        pairs.complete(stamp, 'wheels', n)
        complete.append(pairs.complete(stamp, 'estimate', n) is not None)
    assert any(complete)
    assert all(complete[complete.index(True):])
    assert complete.index(True) <= DEPTH


def lateness(delays_ms: list[float], drift: float = 0.0) -> list[bool]:
    """Return whether ticks with these delays are late, for a clock with offset and drift."""
    lateness = LatenessDetector()
    return [lateness.is_late(
        n * PERIOD, 10 ** 15 + round((n * PERIOD + delay * 1e6) * (1.0 + drift)))
        for n, delay in enumerate(delays_ms)]


def test_tick_is_late_when_the_next_one_is_due() -> None:
    # After a delay of 22 ms only the last of the waiting ticks are in time.
    assert lateness([1.0, 0.5, 0.7, 22.0, 18.0, 14.0, 10.0, 6.0, 2.0, 0.6]) == (
        [False] * 3 + [True] * 5 + [False] * 2)


@pytest.mark.parametrize('drift', [-5e-5, 5e-5])
def test_clocks_that_drift_apart_make_no_tick_late(drift: float) -> None:
    assert not any(lateness([0.5] * 50_000, drift))


def test_first_tick_after_a_restart_of_time_is_in_time() -> None:
    lateness = LatenessDetector()
    assert not lateness.is_late(10 ** 10, 0)
    assert not lateness.is_late(10 ** 9, 10 ** 12)
    assert not lateness.is_late(10 ** 9 + PERIOD, 10 ** 12 + PERIOD)
