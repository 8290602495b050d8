# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What samples tell of their sensors."""

from fourbar_ros.estimation.sensor_health import LIVELY, SensorHealth, STUCK_AFTER
import numpy as np
import pytest

PERIOD_NS = 4_000_000


def watched(values: dict[int, list[float]]) -> tuple[SensorHealth, int]:
    """Watch samples by sensor, one a period; return the last stamp too."""
    health = SensorHealth()
    count = max(map(len, values.values()))
    for n in range(count):
        for sensor, given in values.items():
            if n < len(given):
                health.sample(n * PERIOD_NS, sensor, given[n])
    return health, (count - 1) * PERIOD_NS


def noisy(count: int) -> list[float]:
    """Return values of which no two neighbours are equal."""
    return [1e-3 * (n % 7) for n in range(count)]


@pytest.mark.parametrize(('equal', 'named'), [(STUCK_AFTER - 1, False), (STUCK_AFTER, True)])
def test_stuck_takes_so_many_equal_samples(equal: int, named: bool) -> None:
    health, now_ns = watched({0: noisy(equal), 1: [0.5] * equal})
    assert health.stuck(1) is named
    assert health.faults(now_ns) == ({'link_b': 'repeats one value'} if named else {})


def test_value_that_changes_by_a_bit_is_not_stuck() -> None:
    health, _ = watched({0: noisy(60), 1: [0.5] * 59 + [0.5 + 1e-16 * 2]})
    assert not health.stuck(1)


@pytest.mark.parametrize('rest', [LIVELY, 60])
def test_two_that_repeat_may_be_links_at_rest(rest: int) -> None:
    """Without noise, in a motion that moves some of the links."""
    health, now_ns = watched({0: noisy(60), 1: [0.5] * 60, 3: noisy(60 - rest) + [0.7] * rest})
    assert health.faults(now_ns) == {}


def test_sensor_that_never_spoke_is_not_missed() -> None:
    health, now_ns = watched({0: noisy(60), 5: noisy(5)})
    assert health.faults(now_ns) == {'joint_2': 'no data'}


def test_late_samples_do_not_make_a_sensor_silent() -> None:
    """The newest stamp counts, in whatever order they come."""
    health = SensorHealth()
    health.sample(300_000_000, 0, 0.1)
    health.sample(0, 0, 0.2)
    assert health.faults(400_000_000) == {}
    assert health.faults(600_000_000) == {'link_a': 'no data'}


@pytest.mark.parametrize('step', [1, 2, 7])
@pytest.mark.parametrize(('dropout', 'named'), [(0.01, False), (0.1, False), (0.5, True)])
def test_lost_samples_tell_by_the_gaps(dropout: float, named: bool, step: int) -> None:
    """At any rate of the sensor; seed 3."""
    rng = np.random.default_rng(3)
    health = SensorHealth()
    told = []
    for n in range(0, 1000 * step, step):
        if rng.random() >= dropout:
            health.sample(n * PERIOD_NS, 0, rng.random())
        if n > 300 * step:
            told.append('link_a' in health.faults(n * PERIOD_NS))
    # A mean of 50 gaps of 1.75 is not below 1.25 by chance, nor one of 1.11 above it.
    assert all(told) if named else not any(told)


def test_one_silence_is_no_loss_of_samples() -> None:
    health, now_ns = watched({0: noisy(100)})
    later_ns = now_ns + 10_000_000_000
    health.sample(later_ns, 0, 0.5)
    assert health.faults(later_ns) == {}


def test_far_off_is_a_matter_of_many_samples() -> None:
    health, now_ns = watched({0: noisy(5), 1: noisy(5)})
    for _ in range(5):
        health.judged(0, False)
        health.judged(1, True)
    assert health.faults(now_ns) == {}
    # One more: 1 - (24/25)^6 = 0.22.
    health.judged(1, True)
    assert health.faults(now_ns) == {'link_b': 'samples far off'}
    for _ in range(3):
        health.judged(1, False)
    assert health.faults(now_ns) == {}
