# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Estimation of the clock of a link from exchanges over a bus with random delays."""

from fourbar_ros.hardware.link_clock import LinkClock, SETTLED_EXCHANGES
import numpy as np
import pytest

START_NS, STEP_NS = 3_000_000_000, 64_000_000


def link_us(host_ns: int, offset_s: float, drift: float) -> int:
    return round((offset_s + (host_ns - START_NS) * 1e-9 * (1.0 + drift)) * 1e6)


def exchanges(clock: LinkClock, rng: np.random.Generator, count: int, drift: float,
              slowest_s: float, offset_s: float = 77.0, begin_ns: int = START_NS) -> int:
    """Make exchanges with a fixed and a random delay each way; return the time of their end."""
    now_ns = begin_ns
    for _ in range(count):
        there, back = (6e-5 + rng.exponential(slowest_s) for _ in range(2))
        at_ns = now_ns + round(there * 1e9)
        clock.exchange(now_ns, at_ns + round(back * 1e9), link_us(at_ns, offset_s, drift))
        now_ns += STEP_NS
    return now_ns


@pytest.mark.parametrize('drift', [-1e-4, 0.0, 3e-5, 1e-4])
@pytest.mark.parametrize(('slowest_s', 'allowed_s'), [(1e-5, 1e-5), (5e-4, 1e-4), (3e-3, 1e-3)])
def test_times_of_the_link_are_found(drift: float, slowest_s: float, allowed_s: float) -> None:
    for seed in range(5):
        clock, rng = LinkClock(), np.random.default_rng(seed)
        now_ns = exchanges(clock, rng, 500, drift, slowest_s)
        error_s = (clock.host_ns(link_us(now_ns, 77.0, drift)) - now_ns) * 1e-9
        assert abs(error_s) < allowed_s, f'seed {seed}'
        # The inverse conversion has the same error.
        assert clock.link_us(now_ns) == pytest.approx(
            link_us(now_ns, 77.0, drift), abs=1e6 * allowed_s)


def test_clock_is_settled_after_a_few_exchanges_and_not_before() -> None:
    clock, rng = LinkClock(), np.random.default_rng(0)
    exchanges(clock, rng, SETTLED_EXCHANGES - 1, 0.0, 1e-5)
    assert not clock.settled
    exchanges(clock, rng, 1, 0.0, 1e-5, begin_ns=START_NS + 10 * STEP_NS)
    assert clock.settled


def test_restart_of_the_link_clock_is_detected() -> None:
    clock, rng = LinkClock(), np.random.default_rng(0)
    now_ns = exchanges(clock, rng, 100, 2e-5, 1e-4)
    now_ns = exchanges(clock, rng, 100, 2e-5, 1e-4, offset_s=0.5, begin_ns=now_ns)
    assert clock.restarts == 1
    assert abs(clock.host_ns(link_us(now_ns, 0.5, 2e-5)) - now_ns) < 100_000


@pytest.mark.parametrize('slow_s', [5e-4, 1e-3, 4e-3, 2e-2])
@pytest.mark.parametrize('way', ['there', 'back'])
def test_one_way_delay_is_not_taken_for_a_restart(slow_s: float, way: str) -> None:
    """A delay of one way looks like a clock offset of half the delay."""
    clock, rng = LinkClock(), np.random.default_rng(0)
    now_ns = exchanges(clock, rng, 300, 3e-5, 1e-5)
    worst_s = 0.0
    for step in range(300):
        there, back = 6e-5 + rng.exponential(1e-5, 2)
        slow = slow_s * (step < 156)
        there, back = there + slow * (way == 'there'), back + slow * (way == 'back')
        at_ns = now_ns + round(there * 1e9)
        clock.exchange(now_ns, at_ns + round(back * 1e9), link_us(at_ns, 77.0, 3e-5))
        worst_s = max(worst_s, abs(
            clock.host_ns(link_us(now_ns, 77.0, 3e-5)) - now_ns) * 1e-9)
        now_ns += STEP_NS
    assert clock.restarts == 0
    assert clock.settled
    assert worst_s < 1e-4


@pytest.mark.parametrize('way', [0.0, 1.0])
def test_slow_first_exchanges_do_not_settle_the_clock(way: float) -> None:
    """The shortest of slow round trips is no bound on the error."""
    clock, now_ns = LinkClock(), START_NS
    for round_trip_s in (0.04, 0.03, 0.03, 0.03, 0.02):
        at_ns = now_ns + round(way * round_trip_s * 1e9)
        clock.exchange(now_ns, now_ns + round(round_trip_s * 1e9), link_us(at_ns, 77.0, 0.0))
        now_ns += STEP_NS
    assert clock.exchanges == 5
    assert not clock.settled
    now_ns = exchanges(clock, np.random.default_rng(0), 100, 0.0, 1e-5, begin_ns=now_ns)
    assert clock.restarts == 0
    assert clock.settled
    assert abs(clock.host_ns(link_us(now_ns, 77.0, 0.0)) - now_ns) < 50_000


def test_one_wrong_exchange_is_rejected() -> None:
    clock, rng = LinkClock(), np.random.default_rng(0)
    now_ns = exchanges(clock, rng, 100, 2e-5, 1e-4)
    assert not clock.exchange(now_ns, now_ns + 200_000, link_us(now_ns, 77.0, 2e-5) + 50_000)
    assert abs(clock.host_ns(link_us(now_ns, 77.0, 2e-5)) - now_ns) < 100_000


def test_exchange_with_a_slow_or_a_negative_round_trip_is_rejected() -> None:
    clock = LinkClock()
    assert not clock.exchange(START_NS, START_NS + 10 ** 9, 5)
    assert not clock.exchange(START_NS, START_NS - 1, 5)
    assert clock.exchanges == 0


@pytest.mark.parametrize('wrap_us', [2 ** 20, 10 * 2 ** 20, 2 ** 32])
@pytest.mark.parametrize('away_s', [-0.4, -0.001, 0.0, 0.4])
def test_wrapped_times_are_unwrapped(wrap_us: int, away_s: float) -> None:
    clock, rng = LinkClock(), np.random.default_rng(0)
    now_ns = exchanges(clock, rng, 2000, 3e-5, 1e-5, offset_s=4000.0)
    then_ns = now_ns + round(away_s * 1e9)
    time_us = link_us(then_ns, 4000.0, 3e-5)
    found = clock.unwrapped(time_us % wrap_us, wrap_us, now_ns)
    assert abs(clock.host_ns(found) - then_ns) < 50_000
