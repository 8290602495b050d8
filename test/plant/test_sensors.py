# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Link sensors: errors, timing, dropout and faults of their samples."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from math import inf, nan, pi
from typing import Any

from fourbar_ros.common.settings import SettingError
from fourbar_ros.mechanism import LINK_NAMES
from fourbar_ros.mechanism.samples import LinkSample
from fourbar_ros.plant.faults import Fault, parse_fault, SENSOR_FAULTS
from fourbar_ros.plant.sensors import LinkSensors, LinkSensorSettings, SensorError
import hypothesis
from hypothesis import strategies as st
import numpy as np
from numpy.typing import NDArray
import pytest
from scipy import stats

Array = NDArray[np.float64]

Refuses = Callable[..., AbstractContextManager[None]]
MS = 1_000_000
S = 1000 * MS
PERIOD = 4 * MS
# Two-sided confidence of every statistical bound below. The seeds are fixed, so a test either
# passes always or never.
CONFIDENCE = 0.999
NORMAL_BOUND = stats.norm.interval(CONFIDENCE)[1]
SEED = 5
COUNT = 4000
ANGLES = np.array([0.1, 0.9, -0.4, 1.2])
RATES = np.array([0.3, -0.2, 0.5, 0.7])
PERFECT = LinkSensorSettings()
NASTY = LinkSensorSettings(
    noise_rms=2e-3, bias=0.05, random_walk=1e-3, counts_per_turn=16384, scale_error=0.01,
    latency=5e-3, jitter=2e-3, dropout=0.2, gyro=True, gyro_noise_rms=0.01, gyro_bias=0.02,
    gyro_random_walk=1e-3)
HEALTHY: Mapping[str, Fault] = {}


@dataclass
class Samples:
    """Samples of one sensor in the order of measurement."""

    stamps: NDArray[np.int64]
    ticks: NDArray[np.int64]
    angles: Array
    rates: Array


def make(settings: LinkSensorSettings, seed: int = SEED) -> LinkSensors:
    return LinkSensors(settings, np.random.SeedSequence(seed))


def fault(text: str, target: str = 'link_b') -> dict[str, Fault]:
    parsed = parse_fault(target, text)
    assert parsed is not None
    return {target: parsed}


def at_rest(stamp_ns: int) -> Array:
    """Return the angles of a linkage at rest."""
    return ANGLES


def observe(sensors: LinkSensors, ticks: Sequence[int], truth: Callable[[int], Array] = at_rest,
            *, patience: int = 20 * S) -> list[tuple[int, LinkSample]]:
    """Measure at every tick, and return the samples with the ticks of their arrival."""
    readings = []
    for tick in ticks:
        sensors.measure(tick, truth(tick), RATES)
        readings += [(tick, reading) for reading in sensors.due(tick)]
    end = ticks[-1] + patience
    return readings + [(end, reading) for reading in sensors.due(end)]


def by_sensor(readings: Sequence[tuple[int, LinkSample]], name: str) -> Samples:
    """Return the samples of one sensor."""
    found = sorted((reading.stamp_ns, tick, *(
        values[reading.names.index(name)] if len(values) else nan
        for values in (reading.angles, reading.rates)))
        for tick, reading in readings if name in reading.names)
    stamps, ticks, angles, rates = zip(*found) if found else ((), (), (), ())
    return Samples(np.array(stamps), np.array(ticks), np.array(angles), np.array(rates))


def ticks_of(count: int, period: int = PERIOD, start: int = S) -> list[int]:
    return [start + n * period for n in range(count)]


def run(settings: LinkSensorSettings, faults: Mapping[str, Fault] = HEALTHY, count: int = COUNT,
        truth: Callable[[int], Array] = at_rest, seed: int = SEED) -> dict[str, Samples]:
    """Run sensors with faults from the start, and return the samples by sensor."""
    sensors = make(settings, seed)
    sensors.set_faults(faults)
    readings = observe(sensors, ticks_of(count), truth)
    return {name: by_sensor(readings, name) for name in sensors.names}


def same(one: Samples, other: Samples) -> bool:
    """Compare bit for bit."""
    return all(getattr(one, item.name).tobytes() == getattr(other, item.name).tobytes()
               for item in fields(Samples))


def assert_normal(errors: Array, rms: float, what: str) -> None:
    """Check the mean, the rms and the normal distribution of errors."""
    size = errors.size
    low, high = stats.chi2.interval(CONFIDENCE, size)
    assert low < float(errors @ errors) / rms ** 2 < high, f'{what}, seed {SEED}'
    assert abs(errors.mean()) * np.sqrt(size) / rms < NORMAL_BOUND, f'{what}, seed {SEED}'
    assert stats.kstest(errors / rms, 'norm').pvalue > 1.0 - CONFIDENCE, f'{what}, seed {SEED}'


def assert_rate(lost: int, count: int, probability: float) -> None:
    low, high = stats.binom.interval(CONFIDENCE, count, probability)
    assert low <= lost <= high, f'{lost} of {count} lost, seed {SEED}'


def test_the_defaults_are_perfect_sensors() -> None:
    readings = make(PERFECT), make(replace(PERFECT, gyro=True))
    for sensors in readings:
        sensors.measure(S, ANGLES, RATES)
    (plain,), (with_gyro,) = (sensors.due(S) for sensors in readings)
    assert plain.names == LINK_NAMES
    assert plain.angles.tobytes() == with_gyro.angles.tobytes() == ANGLES.tobytes()
    assert with_gyro.rates.tobytes() == RATES.tobytes()
    assert plain.rates.shape == (0,)


def test_noise_is_normal_with_the_rms_asked_for() -> None:
    for name, samples in run(LinkSensorSettings(noise_rms=2e-3)).items():
        assert_normal(samples.angles - ANGLES[LINK_NAMES.index(name)], 2e-3, name)


def test_noise_is_white_and_each_sensor_has_its_own() -> None:
    """There is no correlation in time up to 20 samples, and none between two sensors."""
    samples = run(LinkSensorSettings(noise_rms=2e-3))
    noise = np.array([samples[name].angles for name in LINK_NAMES]).T - ANGLES
    noise /= 2e-3
    bound = stats.norm.interval(1.0 - (1.0 - CONFIDENCE) / (16 * 20 + 6))[1]
    for lag in range(21):
        later, earlier = noise[lag:], noise[:len(noise) - lag]
        correlations = later.T @ earlier / np.sqrt(len(later))
        if lag == 0:
            correlations = correlations[np.triu_indices(4, 1)]
        assert np.abs(correlations).max() < bound, f'lag {lag}, seed {SEED}'


@pytest.mark.parametrize('bias', [0.05, -0.2, (0.1, -0.2, 0.3, 0.0), [0.1, -0.2, 0.3, 0.0]])
@pytest.mark.parametrize('key', ['bias', 'gyro_bias'])
def test_bias_is_added_to_all_or_to_each(key: str, bias: Any) -> None:
    sensors = make(LinkSensorSettings(gyro=True, **{key: bias}))
    sensors.measure(S, ANGLES, RATES)
    reading, = sensors.due(S)
    values, truth = ((reading.angles, ANGLES) if key == 'bias' else (reading.rates, RATES))
    np.testing.assert_allclose(values, truth + np.array(bias), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize('key', ['random_walk', 'gyro_random_walk'])
def test_random_walk_grows_with_the_root_of_the_time_between_samples(key: str) -> None:
    """Increments divided by the root of their time have one normal distribution."""
    walk = 3e-3
    uneven = np.random.default_rng(SEED).integers(1, 4000, COUNT) * MS
    ticks = [S + int(time) for time in np.cumsum(uneven)]
    readings = observe(make(LinkSensorSettings(gyro=True, **{key: walk})), ticks)
    for name in LINK_NAMES:
        samples = by_sensor(readings, name)
        values = samples.angles if key == 'random_walk' else samples.rates
        steps = np.diff(np.unwrap(values)) / np.sqrt(np.diff(samples.stamps) * 1e-9)
        assert_normal(steps, walk, name)


@pytest.mark.parametrize('counts', [1, 2, 3, 4, 1000, 4095, 16384, 10 ** 6])
@pytest.mark.parametrize('turns', [0, 1, -7, 1000])
def test_samples_are_on_the_nearest_count(counts: int, turns: int) -> None:
    step = 2.0 * pi / counts
    sensors = make(LinkSensorSettings(counts_per_turn=counts))
    sensors.measure(S, ANGLES + turns * 2.0 * pi, RATES)
    reading, = sensors.due(S)
    np.testing.assert_allclose(
        reading.angles / step, np.round(reading.angles / step), rtol=0.0, atol=1e-9)
    errors = np.angle(np.exp(1j * (reading.angles - ANGLES)))
    # The rounding error of a thousand turns is 1e-12 rad.
    assert (np.abs(errors) <= step / 2.0 + 2e-12).all()


@pytest.mark.medium
@hypothesis.settings(deadline=None, max_examples=300, derandomize=True)
@hypothesis.given(angle=st.floats(-1e4, 1e4) | st.integers(-9, 9).map(lambda n: n * pi)
                  | st.integers(-9, 9).map(lambda n: float(np.nextafter(n * pi, 0.0))),
                  counts=st.sampled_from([0, 0, 1, 2, 7, 26, 1000, 16384]))
@hypothesis.example(pi, 26)
def test_samples_lie_in_one_turn(angle: float, counts: int) -> None:
    """13 / 26 of a turn, worked out like any other count, is more than pi."""
    sensors = make(LinkSensorSettings(counts_per_turn=counts))
    sensors.measure(S, np.full(4, angle), RATES)
    sample = sensors.due(S)[0].angles[0]
    assert -pi < sample <= pi
    if not counts:
        # The rounding error of a turn is 1e-16 of it.
        assert abs(np.exp(1j * sample) - np.exp(1j * angle)) < 1e-15 * max(10.0, abs(angle))


def test_scale_error_grows_with_the_angle_since_zero() -> None:
    scale = 0.02
    sensors = make(LinkSensorSettings(scale_error=scale))
    turned = ANGLES + np.array([0.0, 2.0, -4.0, 20.0]) * pi
    sensors.measure(S, turned, RATES)
    reading, = sensors.due(S)
    errors = np.angle(np.exp(1j * (reading.angles - turned - scale * turned)))
    np.testing.assert_allclose(errors, 0.0, atol=1e-13)


def test_gyro_noise_is_normal_and_not_that_of_the_angle() -> None:
    samples = run(LinkSensorSettings(gyro=True, gyro_noise_rms=0.02, noise_rms=2e-3))['link_c']
    gyro, angle = samples.rates - RATES[2], samples.angles - ANGLES[2]
    assert_normal(gyro, 0.02, 'gyro')
    correlation = float(gyro @ angle) / (0.02 * 2e-3 * np.sqrt(COUNT))
    assert abs(correlation) < NORMAL_BOUND, f'seed {SEED}'


@pytest.mark.parametrize('heading', LINK_NAMES)
def test_joint_encoders_measure_the_second_link_relative_to_the_first(heading: str) -> None:
    sensors = make(LinkSensorSettings(kind='joint', heading=heading, gyro=True))
    sensors.measure(S, ANGLES + 4.0 * pi, RATES)
    reading, = sensors.due(S)
    assert reading.names == ('joint_1', 'joint_2', 'joint_3', 'joint_4', heading)
    for values, (a, b, c, d), atol in ((reading.angles, ANGLES, 1e-14), (reading.rates, RATES, 0)):
        own = dict(zip(LINK_NAMES, (a, b, c, d)))[heading]
        np.testing.assert_allclose(
            values, [b - a, c - b, d - c, a - d, own], rtol=1e-15, atol=atol)


def test_joint_encoders_do_not_depend_on_the_orientation_of_the_whole() -> None:
    sensors = make(LinkSensorSettings(kind='joint'))
    sensors.measure(S, ANGLES, RATES)
    sensors.measure(2 * S, ANGLES + 0.5, RATES)
    before, after = sensors.due(2 * S)
    moved = after.angles - before.angles
    np.testing.assert_allclose(moved, [0.0, 0.0, 0.0, 0.0, 0.5], rtol=0.0, atol=1e-15)


def test_each_joint_encoder_has_its_own_bias() -> None:
    bias = (0.1, 0.2, 0.3, 0.4, -0.5)
    sensors = make(LinkSensorSettings(kind='joint', bias=bias))
    sensors.measure(S, np.zeros(4), RATES)
    assert sensors.due(S)[0].angles.tolist() == list(bias)


@pytest.mark.parametrize(('latency', 'ticks_later'), [
    (0.0, 0), (1e-9, 1), (3.999999e-3, 1), (4e-3, 1), (4.000001e-3, 2), (5e-3, 2), (0.1, 25)])
def test_sample_arrives_at_the_first_tick_at_or_after_its_latency(
    latency: float, ticks_later: int,
) -> None:
    readings = observe(make(LinkSensorSettings(latency=latency)), ticks_of(100))
    early = readings[:100 - ticks_later]
    assert [tick - reading.stamp_ns for tick, reading in early] == [ticks_later * PERIOD] * len(
        early)
    assert [reading.stamp_ns for _, reading in readings] == ticks_of(100)


def test_sample_has_the_time_and_the_angle_of_its_measurement() -> None:
    def moving(stamp_ns: int) -> Array:
        return ANGLES * stamp_ns / (2 * S)

    for _, reading in observe(make(LinkSensorSettings(latency=0.05)), ticks_of(200), moving):
        assert reading.angles.tobytes() == moving(reading.stamp_ns).tobytes()


def test_sample_arrives_once() -> None:
    sensors = make(LinkSensorSettings(latency=5e-3))
    sensors.measure(S, ANGLES, RATES)
    assert sensors.due(S + 5 * MS - 1) == ()
    assert len(sensors.due(S + 5 * MS)) == 1
    assert sensors.due(S + 6 * MS) == ()


def test_late_tick_receives_all_measurements_oldest_first() -> None:
    sensors = make(LinkSensorSettings(latency=1e-3, jitter=0.05))
    for tick in ticks_of(50):
        sensors.measure(tick, ANGLES, RATES)
    assert [reading.stamp_ns for reading in sensors.due(10 * S)] == ticks_of(50)


def arrivals(settings: LinkSensorSettings, count: int = COUNT) -> dict[str, Array]:
    """Return the delays (count,) of the samples [s], seen by ticks of 10 us."""
    fine = 10_000
    sensors = make(settings)
    delays: dict[str, list[float]] = {name: [] for name in sensors.names}
    for n in range(count):
        stamp = S + n * S
        sensors.measure(stamp, ANGLES, RATES)
        for k in range(1, 2000):
            for reading in sensors.due(stamp + k * fine):
                for name in reading.names:
                    delays[name].append((k - 0.5) * fine * 1e-9)
    return {name: np.array(values) for name, values in delays.items()}


@pytest.mark.medium
def test_jitter_is_half_normal_beyond_the_latency() -> None:
    latency, jitter = 4e-3, 2e-3
    for name, delays in arrivals(LinkSensorSettings(latency=latency, jitter=jitter), 400).items():
        extra = delays - latency
        assert len(extra) == 400
        assert extra.min() > 0.0
        low, high = stats.chi2.interval(CONFIDENCE, extra.size)
        assert low < float(extra @ extra) / jitter ** 2 < high, f'{name}, seed {SEED}'
        fit = stats.kstest(extra / jitter, 'halfnorm')
        assert fit.pvalue > 1.0 - CONFIDENCE, f'{name}, seed {SEED}'


def test_jitter_separates_samples_of_one_instant() -> None:
    readings = observe(make(LinkSensorSettings(latency=4e-3, jitter=5e-3)), ticks_of(200))
    stamps = [reading.stamp_ns for _, reading in readings]
    assert len(set(stamps)) < len(stamps)
    for name in LINK_NAMES:
        assert by_sensor(readings, name).stamps.tolist() == ticks_of(200)


@pytest.mark.parametrize(('rate', 'every'), [
    (0.0, 1), (250.0, 1), (1e4, 1), (125.0, 2), (62.5, 4), (1.0, 250)])
def test_rate_takes_every_nth_tick(rate: float, every: int) -> None:
    readings = observe(make(LinkSensorSettings(rate=rate)), ticks_of(1000))
    assert [reading.stamp_ns for _, reading in readings] == ticks_of(1000)[::every]


@pytest.mark.parametrize('rate', [1.7, 30.0, 100.0, 249.9])
def test_rate_that_does_not_fit_the_ticks_is_right_on_average(rate: float) -> None:
    """Sample n is measured at the first tick at or after n / rate."""
    readings = observe(make(LinkSensorSettings(rate=rate)), ticks_of(5000))
    for n, (tick, _) in enumerate(readings):
        assert 0.0 <= (tick - S) * 1e-9 - n / rate + 1e-9 < PERIOD * 1e-9 + 1e-9
    assert len(readings) == pytest.approx(5000 * PERIOD * 1e-9 * rate, abs=1.0)


def test_time_of_the_next_sample_is_known() -> None:
    sensors = make(LinkSensorSettings(rate=100.0))
    assert sensors.next_sample_ns is None
    sensors.measure(S, ANGLES, RATES)
    assert sensors.next_sample_ns == S + 10 * MS
    sensors.measure(S + 10 * MS - 1, ANGLES, RATES)
    assert len(sensors.due(2 * S)) == 1
    sensors.measure(S + 10 * MS, ANGLES, RATES)
    assert len(sensors.due(2 * S)) == 1


@pytest.mark.parametrize('later', [0, -1, -S])
def test_time_that_does_not_increase_is_refused(later: int, refuses: Refuses) -> None:
    sensors = make(PERFECT)
    sensors.measure(S, ANGLES, RATES)
    with refuses(SensorError, value=S + later, limit=S):
        sensors.measure(S + later, ANGLES, RATES)


@pytest.mark.parametrize('dropout', [0.01, 0.3, 0.9])
def test_dropout_loses_the_part_asked_for(dropout: float) -> None:
    for samples in run(LinkSensorSettings(dropout=dropout)).values():
        assert_rate(COUNT - len(samples.stamps), COUNT, dropout)


def test_each_sensor_loses_its_own_samples() -> None:
    samples = run(LinkSensorSettings(dropout=0.3))
    lost = [set(ticks_of(COUNT)) - set(samples[name].stamps.tolist()) for name in LINK_NAMES]
    for n, one in enumerate(lost):
        for other in lost[:n]:
            assert_rate(len(one & other), COUNT, 0.09)


def test_no_dropout_loses_nothing_and_dropout_1_everything() -> None:
    assert len(run(LinkSensorSettings(dropout=0.0))['link_a'].stamps) == COUNT
    assert observe(make(LinkSensorSettings(dropout=1.0)), ticks_of(COUNT)) == []


def test_sensor_without_a_sample_is_missing_in_the_message() -> None:
    """There is neither NaN nor 0 in its place, and the other angles belong to their names."""
    readings = observe(make(LinkSensorSettings(dropout=0.5, gyro=True)), ticks_of(200))
    truth = dict(zip(LINK_NAMES, zip(ANGLES, RATES)))
    sizes = set()
    for _, reading in readings:
        sizes.add(len(reading.names))
        pairs = dict(zip(reading.names, zip(reading.angles, reading.rates, strict=True),
                         strict=True))
        assert pairs == {name: truth[name] for name in reading.names}
        assert list(reading.names) == sorted(reading.names)
    assert sizes == {1, 2, 3, 4}


@pytest.mark.parametrize('kind', ['absolute', 'joint'])
def test_same_seed_same_bytes(kind: str) -> None:
    nasty = replace(NASTY, kind=kind)
    one, other = run(nasty, seed=7, count=500), run(nasty, seed=7, count=500)
    assert all(same(one[name], other[name]) for name in one)
    different = run(nasty, seed=8, count=500)
    assert not any(same(one[name], different[name]) for name in one)


@pytest.mark.parametrize('kind', SENSOR_FAULTS)
def test_fault_of_one_sensor_leaves_the_others_bit_for_bit(kind: str) -> None:
    healthy, broken = run(NASTY, count=500), run(NASTY, fault(kind), count=500)
    assert not same(healthy['link_b'], broken['link_b'])
    for name in ('link_a', 'link_c', 'link_d'):
        assert same(healthy[name], broken[name]), name


@pytest.mark.parametrize('kind', SENSOR_FAULTS)
def test_sensor_after_a_fault_equals_one_without_a_fault(kind: str) -> None:
    sensors, never = make(NASTY), make(NASTY)
    sensors.set_faults(fault(kind))
    ticks = ticks_of(600)
    for tick in ticks[:300]:
        for each in (sensors, never):
            each.measure(tick, ANGLES, RATES)
            each.due(tick)
    sensors.set_faults({})
    mended, expected = (by_sensor(observe(each, ticks[300:]), 'link_b')
                        for each in (sensors, never))
    since = mended.stamps >= ticks[300]
    assert mended.angles[since].tobytes() == expected.angles[
        expected.stamps >= ticks[300]].tobytes()


@pytest.mark.medium
@pytest.mark.parametrize('changed', [
    {'dropout': 0.2}, {'jitter': 5e-3}, {'gyro': True, 'gyro_noise_rms': 0.1}, {'latency': 0.1}])
def test_other_settings_do_not_change_the_noise(changed: dict[str, Any]) -> None:
    plain = LinkSensorSettings(noise_rms=2e-3, random_walk=1e-3)
    reference, samples = run(plain)['link_a'], run(replace(plain, **changed))['link_a']
    arrived = np.isin(reference.stamps, samples.stamps)
    assert arrived.sum() > COUNT / 2
    assert samples.angles.tobytes() == reference.angles[arrived].tobytes()


def test_off_gives_no_sample() -> None:
    samples = run(PERFECT, fault('off'))
    assert len(samples['link_b'].stamps) == 0
    assert len(samples['link_a'].stamps) == COUNT


def test_earlier_samples_arrive_after_a_sensor_goes_off() -> None:
    sensors = make(LinkSensorSettings(latency=0.1))
    sensors.measure(S, ANGLES, RATES)
    sensors.set_faults(fault('off'))
    sensors.measure(S + PERIOD, ANGLES, RATES)
    assert ['link_b' in reading.names for reading in sensors.due(2 * S)] == [True, False]


def test_stuck_repeats_the_last_sample_given_bit_for_bit() -> None:
    """Angle and gyro are repeated with new stamps."""
    sensors = make(replace(NASTY, latency=0.0, jitter=0.0))
    ticks = ticks_of(200)
    before = by_sensor(observe(sensors, ticks[:100], patience=0), 'link_b')
    sensors.set_faults(fault('stuck'))
    after = by_sensor(observe(sensors, ticks[100:], patience=0), 'link_b')
    assert after.stamps.min() >= ticks[100]
    assert len(after.stamps) > 50
    assert set(after.angles) == {before.angles[-1]}
    assert set(after.rates) == {before.rates[-1]}


def test_stuck_from_the_start_repeats_the_first_sample() -> None:
    samples = run(LinkSensorSettings(noise_rms=2e-3), fault('stuck'))['link_b']
    assert set(samples.angles) == {run(LinkSensorSettings(noise_rms=2e-3))['link_b'].angles[0]}


def test_garbage_is_uniform_over_a_turn() -> None:
    angles = run(PERFECT, fault('garbage'))['link_b'].angles
    assert ((angles > -pi) & (angles <= pi)).all()
    fit = stats.kstest(angles, stats.uniform(-pi, 2.0 * pi).cdf)
    assert fit.pvalue > 1.0 - CONFIDENCE, f'seed {SEED}'
    correlation = np.corrcoef(angles[1:], angles[:-1])[0, 1] * np.sqrt(COUNT)
    assert abs(correlation) < NORMAL_BOUND, f'seed {SEED}'


def test_garbage_of_an_encoder_is_whole_counts() -> None:
    angles = run(LinkSensorSettings(counts_per_turn=8), fault('garbage'))['link_b'].angles
    assert len(np.unique(angles)) == 8


@pytest.mark.medium
@pytest.mark.parametrize('value', [0.1, -0.7, pi])
def test_wrong_adds_its_value(value: float) -> None:
    noisy = LinkSensorSettings(noise_rms=2e-3)
    healthy, wrong = run(noisy)['link_b'], run(noisy, fault(f'wrong {value}'))['link_b']
    difference = np.angle(np.exp(1j * (wrong.angles - healthy.angles - value)))
    np.testing.assert_allclose(difference, 0.0, atol=1e-14)


def slow_response(period: int, truth: Callable[[int], Array], time_constant: float) -> Samples:
    """Observe a sensor that becomes slow at time 1 s, for 2 s."""
    sensors = make(PERFECT)
    sensors.measure(S, truth(S), RATES)
    sensors.due(S)
    sensors.set_faults(fault(f'slow {time_constant}'))
    ticks = ticks_of(2 * S // period, period, S + period)
    return by_sensor(observe(sensors, ticks, truth), 'link_b')


@pytest.mark.parametrize('period', [MS, 4 * MS, 50 * MS])
def test_slow_lags_behind_a_ramp_as_a_first_order_system_does(period: int) -> None:
    """The lag is rate * T * (1 - exp(-t / T)) at any rate of the sensor."""
    rate, time_constant = 0.8, 0.3

    def ramp(stamp_ns: int) -> Array:
        return np.full(4, rate * (stamp_ns - S) * 1e-9)

    samples = slow_response(period, ramp, time_constant)
    time = (samples.stamps - S) * 1e-9
    lag = rate * time - samples.angles
    # Bound of the rounding errors: some hundred roundings of 1e-16 of one sign.
    np.testing.assert_allclose(
        lag, rate * time_constant * (1.0 - np.exp(-time / time_constant)), rtol=0.0, atol=1e-12)


def test_slow_forgets_a_jump_with_its_time_constant() -> None:
    time_constant, jump = 0.3, 0.5

    def jumping(stamp_ns: int) -> Array:
        return np.full(4, jump if stamp_ns > S else 0.0)

    samples = slow_response(4 * MS, jumping, time_constant)
    left = jump - samples.angles
    np.testing.assert_allclose(
        left[1:] / left[:-1], np.exp(-4e-3 / time_constant), rtol=1e-9)
    assert left[0] == pytest.approx(jump, rel=4e-3 / time_constant)


def test_slow_follows_through_the_cut_at_pi() -> None:
    """The angle of a turning link is filtered without a jump."""
    def turning(stamp_ns: int) -> Array:
        return np.full(4, 3.0 * stamp_ns / S)

    samples = slow_response(4 * MS, turning, 0.05)
    errors = np.angle(np.exp(1j * (3.0 * samples.stamps / S - samples.angles)))
    assert errors.max() < 3.0 * 0.05 + 1e-9


@pytest.mark.parametrize(('value', 'ticks_later'), [(0.0, 2), (1e-3, 2), (3e-3, 2), (0.1, 27)])
def test_delayed_adds_to_the_latency(value: float, ticks_later: int) -> None:
    samples = run(LinkSensorSettings(latency=5e-3), fault(f'delayed {value}'), count=200)
    broken, healthy = samples['link_b'], samples['link_a']
    assert set((broken.ticks - broken.stamps)[:150]) == {ticks_later * PERIOD}
    assert set((healthy.ticks - healthy.stamps)[:150]) == {2 * PERIOD}


@pytest.mark.parametrize('value', [0.1, 0.8])
def test_intermittent_loses_the_part_asked_for(value: float) -> None:
    samples = run(PERFECT, fault(f'intermittent {value}'))['link_b']
    assert_rate(COUNT - len(samples.stamps), COUNT, value)


def test_intermittent_and_dropout_are_independent() -> None:
    samples = run(LinkSensorSettings(dropout=0.4), fault('intermittent 0.5'))['link_b']
    assert_rate(len(samples.stamps), COUNT, 0.6 * 0.5)


def test_fault_of_a_joint_encoder_changes_only_that_encoder() -> None:
    samples = run(LinkSensorSettings(kind='joint'), fault('off', 'joint_3'), count=10)
    assert [name for name in samples if not len(samples[name].stamps)] == ['joint_3']


def test_fault_of_the_heading_does_not_change_the_encoders() -> None:
    samples = run(LinkSensorSettings(kind='joint', heading='link_c'), fault('off', 'link_c'),
                  count=10)
    assert [name for name in samples if not len(samples[name].stamps)] == ['link_c']


def test_reset_drops_pending_samples_and_accepts_any_time() -> None:
    sensors = make(LinkSensorSettings(latency=5e-3, rate=100.0))
    sensors.measure(S, ANGLES, RATES)
    sensors.reset()
    assert sensors.due(2 * S) == ()
    sensors.measure(10 * MS, ANGLES, RATES)
    assert [reading.stamp_ns for reading in sensors.due(S)] == [10 * MS]


def test_random_numbers_continue_after_reset() -> None:
    sensors, without = (make(LinkSensorSettings(noise_rms=2e-3)) for _ in range(2))
    for each in (sensors, without):
        each.measure(S, ANGLES, RATES)
        each.due(S)
    sensors.reset()
    for each in (sensors, without):
        each.measure(2 * S, ANGLES, RATES)
    assert sensors.due(2 * S)[0].angles.tobytes() == without.due(2 * S)[0].angles.tobytes()


def test_drift_continues_after_reset() -> None:
    sensors = make(LinkSensorSettings(random_walk=0.1))
    for tick in ticks_of(50):
        sensors.measure(tick, ANGLES, RATES)
    last = sensors.due(2 * S)[-1].angles
    sensors.reset()
    sensors.measure(3 * S, ANGLES, RATES)
    assert sensors.due(3 * S)[0].angles.tobytes() == last.tobytes()


def test_slow_sensor_starts_at_the_angle_after_a_reset() -> None:
    sensors = make(PERFECT)
    sensors.set_faults(fault('slow 5'))
    sensors.measure(S, ANGLES, RATES)
    sensors.reset()
    sensors.measure(2 * S, ANGLES + 1.0, RATES)
    assert sensors.due(2 * S)[0].angles.tobytes() == (ANGLES + 1.0).tobytes()


NUMBERS = [item.name for item in fields(LinkSensorSettings)
           if item.name not in ('kind', 'heading', 'gyro')]
NEVER_NEGATIVE = [name for name in NUMBERS if name not in ('bias', 'gyro_bias', 'scale_error')]


@pytest.mark.parametrize('name', NUMBERS)
@pytest.mark.parametrize('value', [nan, inf, -inf, 1e300, '1', True, None, {}])
def test_bad_value_is_refused_by_name(name: str, value: Any, refuses: Refuses) -> None:
    with refuses(SettingError, name=f'link_sensors.{name}'):
        LinkSensorSettings(**{name: value})


@pytest.mark.parametrize('name', NEVER_NEGATIVE)
def test_negative_value_is_refused(name: str, refuses: Refuses) -> None:
    value = -1 if name == 'counts_per_turn' else -1e-12
    with refuses(SettingError, name=f'link_sensors.{name}', value=value):
        LinkSensorSettings(**{name: value})


def test_probability_above_1_is_refused(refuses: Refuses) -> None:
    with refuses(SettingError, name='link_sensors.dropout', value=1.01, limit=(0.0, 1.0)):
        LinkSensorSettings(dropout=1.01)


@pytest.mark.parametrize('name', [name for name in NUMBERS if 'bias' not in name])
def test_a_list_where_one_number_is_needed_is_refused(name: str, refuses: Refuses) -> None:
    with refuses(SettingError, name=f'link_sensors.{name}', value=[0.1] * 4):
        LinkSensorSettings(**{name: [0.1] * 4})


def test_half_a_count_is_refused(refuses: Refuses) -> None:
    with refuses(SettingError, name='link_sensors.counts_per_turn', value=16.5, limit=int):
        LinkSensorSettings(counts_per_turn=16.5)  # type: ignore[arg-type]


@pytest.mark.parametrize('kind', ['relative', '', None, True, ['joint']])
def test_unknown_kind_is_refused(kind: Any, refuses: Refuses) -> None:
    with refuses(SettingError, name='link_sensors.kind', value=kind):
        LinkSensorSettings(kind=kind)


@pytest.mark.parametrize('heading', ['', None])
def test_joint_encoders_without_heading_are_refused(heading: Any, refuses: Refuses) -> None:
    with refuses(SettingError, name='link_sensors.heading', limit=LINK_NAMES):
        LinkSensorSettings(kind='joint', heading=heading)
    assert LinkSensorSettings(kind='absolute', heading=heading).sensor_names == LINK_NAMES


@pytest.mark.parametrize('kind', ['absolute', 'joint'])
@pytest.mark.parametrize('heading', ['link_e', 'joint_1', 1, ['link_a']])
def test_heading_that_is_no_link_is_refused(kind: str, heading: Any, refuses: Refuses) -> None:
    with refuses(SettingError, name='link_sensors.heading'):
        LinkSensorSettings(kind=kind, heading=heading)


@pytest.mark.parametrize('gyro', [1, 'yes', None, 0.0])
def test_gyro_that_is_neither_true_nor_false_is_refused(gyro: Any, refuses: Refuses) -> None:
    with refuses(SettingError, name='link_sensors.gyro', value=gyro, limit=bool):
        LinkSensorSettings(gyro=gyro)


@pytest.mark.parametrize('name', ['bias', 'gyro_bias'])
@pytest.mark.parametrize(('kind', 'size', 'needed'), [
    ('absolute', 3, 4), ('absolute', 0, 4), ('absolute', 5, 4), ('joint', 4, 5)])
def test_biases_that_are_not_one_for_each_are_refused(
    name: str, kind: str, size: int, needed: int, refuses: Refuses,
) -> None:
    with refuses(SettingError, name=f'link_sensors.{name}', value=size, limit=needed):
        LinkSensorSettings(kind=kind, **{name: [0.1] * size})


@pytest.mark.parametrize('value', [nan, inf, '0.1', True, None, [0.1]])
def test_one_bad_bias_is_refused_by_its_sensor(value: Any, refuses: Refuses) -> None:
    with refuses(SettingError, name='link_sensors.bias.link_c'):
        LinkSensorSettings(bias=[0.0, 0.0, value, 0.0])  # type: ignore[arg-type]
