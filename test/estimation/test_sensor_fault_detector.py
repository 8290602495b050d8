# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Detection of sensor faults from samples."""

from fourbar_ros.estimation.sensor_faults import CHANGED_WITHIN, SensorFaultDetector, STUCK_AFTER
import numpy as np
import pytest

PERIOD_NS = 4_000_000


def watched(values: dict[int, list[float]]) -> tuple[SensorFaultDetector, int]:
    """Add samples by sensor, one a period; return the detector and the last stamp."""
    detector = SensorFaultDetector()
    count = max(map(len, values.values()))
    for n in range(count):
        for sensor, given in values.items():
            if n < len(given):
                detector.add_sample(n * PERIOD_NS, sensor, given[n])
    return detector, (count - 1) * PERIOD_NS


def noisy(count: int) -> list[float]:
    """Return values of which no two neighbours are equal."""
    return [1e-3 * (n % 7) for n in range(count)]


@pytest.mark.parametrize(('equal', 'named'), [(STUCK_AFTER - 1, False), (STUCK_AFTER, True)])
def test_stuck_after_a_number_of_equal_samples(equal: int, named: bool) -> None:
    detector, now_ns = watched({0: noisy(equal), 1: [0.5] * equal})
    assert detector.stuck(1) is named
    assert detector.faults(now_ns) == ({'link_b': 'repeats one value'} if named else {})


def test_value_that_changes_by_a_bit_is_not_stuck() -> None:
    detector, _ = watched({0: noisy(60), 1: [0.5] * 59 + [0.5 + 1e-16 * 2]})
    assert not detector.stuck(1)


@pytest.mark.parametrize('rest', [CHANGED_WITHIN, 60])
def test_two_that_repeat_may_be_links_at_rest(rest: int) -> None:
    """Without noise, in a motion that moves some of the links."""
    detector, now_ns = watched({0: noisy(60), 1: [0.5] * 60, 3: noisy(60 - rest) + [0.7] * rest})
    assert detector.faults(now_ns) == {}


def test_sensor_without_any_sample_has_no_fault() -> None:
    detector, now_ns = watched({0: noisy(60), 5: noisy(5)})
    assert detector.faults(now_ns) == {'joint_2': 'no data'}


def test_late_samples_do_not_make_a_sensor_silent() -> None:
    """The newest stamp counts, in any order of arrival."""
    detector = SensorFaultDetector()
    detector.add_sample(300_000_000, 0, 0.1)
    detector.add_sample(0, 0, 0.2)
    assert detector.faults(400_000_000) == {}
    assert detector.faults(600_000_000) == {'link_a': 'no data'}


@pytest.mark.parametrize('step', [1, 2, 7])
@pytest.mark.parametrize(('dropout', 'named'), [(0.01, False), (0.1, False), (0.5, True)])
def test_lost_samples_are_detected_by_gaps(dropout: float, named: bool, step: int) -> None:
    """At any rate of the sensor; seed 3."""
    rng = np.random.default_rng(3)
    detector = SensorFaultDetector()
    reported = []
    for n in range(0, 1000 * step, step):
        if rng.random() >= dropout:
            detector.add_sample(n * PERIOD_NS, 0, rng.random())
        if n > 300 * step:
            reported.append('link_a' in detector.faults(n * PERIOD_NS))
    # The mean of 50 gaps is far from 1.25 for expected gaps of 1.75 and of 1.11.
    assert all(reported) if named else not any(reported)


def test_one_silence_is_not_a_loss_of_samples() -> None:
    detector, now_ns = watched({0: noisy(100)})
    later_ns = now_ns + 10_000_000_000
    detector.add_sample(later_ns, 0, 0.5)
    assert detector.faults(later_ns) == {}


def test_far_off_takes_many_gated_samples() -> None:
    detector, now_ns = watched({0: noisy(5), 1: noisy(5)})
    for _ in range(5):
        detector.add_gate_result(0, False)
        detector.add_gate_result(1, True)
    assert detector.faults(now_ns) == {}
    # One more: 1 - (24/25)^6 = 0.22.
    detector.add_gate_result(1, True)
    assert detector.faults(now_ns) == {'link_b': 'samples far off'}
    for _ in range(3):
        detector.add_gate_result(1, False)
    assert detector.faults(now_ns) == {}
