# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The sensors of the links: what they make of the truth, and when they say it.

Of kind `absolute` there is one for each link, the orientation of the link in frame `table`. Of
kind `joint` there is an encoder at each joint, the second link relative to the first, and one
absolute sensor on one link, the heading: relative encoders alone cannot observe attitude.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from heapq import heappop, heappush
from itertools import groupby
from math import exp, pi, remainder, sqrt
from operator import itemgetter
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import JOINT_LINKS, JOINT_NAMES, LINK_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant.faults import Fault
import numpy as np

KINDS = ('absolute', 'joint')

TURN = 2.0 * pi
# Random numbers of one sample, always drawn and always all of them, so that no setting and no
# fault shifts those of later samples: normal for noise, random walk, latency, gyro noise and gyro
# walk; uniform for dropout, the intermittent and the garbage fault.
NORMALS, UNIFORMS = 5, 3
# Samples for which random numbers are drawn at once: numpy is slow by the single number.
BLOCK = 64

_Draws = tuple[float, float, float, float, float, float, float, float]
_Pending = tuple[int, int, int, float, float]


class SensorError(FourbarError):
    """A sensor that cannot exist, or that is asked at a time that cannot be."""


# What a key of the settings may be: from, to, unit.
_RANGES = {
    'noise_rms': (0.0, 10.0, 'rad'),
    'bias': (-10.0, 10.0, 'rad'),
    'random_walk': (0.0, 10.0, 'rad/sqrt(s)'),
    'counts_per_turn': (0, 2 ** 31, ''),
    'scale_error': (-0.5, 0.5, ''),
    'latency': (0.0, 10.0, 's'),
    'jitter': (0.0, 10.0, 's'),
    'dropout': (0.0, 1.0, ''),
    'rate': (0.0, 1e5, 'Hz'),
    'gyro_noise_rms': (0.0, 1000.0, 'rad/s'),
    'gyro_bias': (-1000.0, 1000.0, 'rad/s'),
    'gyro_random_walk': (0.0, 1000.0, 'rad/s/sqrt(s)'),
}


@dataclass(frozen=True)
class LinkSensorSettings:
    """
    What the sensors of the links are like; the defaults are perfect ones.

    :param kind: `absolute` or `joint`.
    :param noise_rms: white noise of each sample [rad].
    :param bias: constant error [rad]: one number for all, or one for each sensor, in the order of
        `sensor_names`.
    :param random_walk: drift, grows with the square root of time [rad/sqrt(s)].
    :param counts_per_turn: resolution, 0 for none.
    :param scale_error: relative error of the continuous angle since the sensor's zero.
    :param latency: from measurement to arrival, at least [s].
    :param jitter: rms of the additional latency, a half-normal distribution [s].
    :param dropout: probability that a sample is lost.
    :param rate: samples per second [Hz], 0 for one whenever they are asked.
    :param heading: link with the absolute sensor where the others are at the joints.
    :param gyro: whether the sensors measure rates as well.
    :param gyro_noise_rms: white noise of each sample [rad/s].
    :param gyro_bias: constant error [rad/s], as `bias`.
    :param gyro_random_walk: drift [rad/s/sqrt(s)].
    :raises SensorError: a value that no sensor can have, by its name.
    """

    kind: str = 'absolute'
    noise_rms: float = 0.0
    bias: float | tuple[float, ...] = 0.0
    random_walk: float = 0.0
    counts_per_turn: int = 0
    scale_error: float = 0.0
    latency: float = 0.0
    jitter: float = 0.0
    dropout: float = 0.0
    rate: float = 0.0
    heading: str | None = 'link_a'
    gyro: bool = False
    gyro_noise_rms: float = 0.0
    gyro_bias: float | tuple[float, ...] = 0.0
    gyro_random_walk: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what no sensor can have."""
        if self.kind not in KINDS:
            raise SensorError(
                f'link_sensors.kind must be one of {", ".join(KINDS)}, got {self.kind!r}')
        self._check_heading()
        if not isinstance(self.gyro, bool):
            raise SensorError(f'link_sensors.gyro must be true or false, got {self.gyro!r}')
        for item in fields(self):
            if item.name in ('bias', 'gyro_bias'):
                self._check_each(item.name)
            elif item.name in _RANGES:
                _check(item.name, getattr(self, item.name))
        if self.counts_per_turn != int(self.counts_per_turn):
            raise SensorError('link_sensors.counts_per_turn must be a whole number, got '
                              f'{self.counts_per_turn}')

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors: four links, or four joints and the heading's link."""
        if self.kind == 'absolute':
            return LINK_NAMES
        return (*JOINT_NAMES, str(self.heading))

    def _check_heading(self) -> None:
        if self.kind == 'joint' and self.heading in (None, ''):
            raise SensorError(
                'link_sensors.heading must name a link with an absolute sensor '
                f'({", ".join(LINK_NAMES)}): relative encoders alone cannot observe attitude, '
                'they read the same however the whole linkage is turned on the table')
        if self.heading not in (None, '', *LINK_NAMES):
            raise SensorError(f'link_sensors.heading must be one of {", ".join(LINK_NAMES)}, got '
                              f'{self.heading!r}')

    def _check_each(self, name: str) -> None:
        given = getattr(self, name)
        if not isinstance(given, (list, tuple)):
            _check(name, given)
            return
        if len(given) != len(self.sensor_names):
            raise SensorError(
                f'link_sensors.{name} must be one number or {len(self.sensor_names)} '
                f'({", ".join(self.sensor_names)}), got {len(given)}')
        for index, value in enumerate(given):
            _check(name, value, f'[{index}]')
        object.__setattr__(self, name, tuple(given))


@dataclass(frozen=True, eq=False)
class SensorReading:
    """
    What arrived of the samples of one instant.

    :param stamp_ns: time of measurement [ns].
    :param names: the sensors that gave a sample, in the order of the settings' `sensor_names`.
    :param angles: (n,) orientation of each in frame `table`, or of the joint's second link
        relative to its first, in (-pi, pi] [rad].
    :param rates: (n,) their rates [rad/s], or (0,) where no gyros are fitted.
    """

    stamp_ns: int
    names: tuple[str, ...]
    angles: Array
    rates: Array


class LinkSensors:
    """
    The sensors of the links, with samples on their way.

    Every sensor has random numbers of its own, and uses as many for each sample whatever its
    settings and faults: what befalls one leaves the others as they are, bit for bit.

    :param settings: what they are like.
    :param seeds: parent of the seeds of each.
    """

    def __init__(self, settings: LinkSensorSettings, seeds: np.random.SeedSequence) -> None:
        self.settings = settings
        self.names = settings.sensor_names
        self._sensors = [
            _Sensor(settings, index, np.random.default_rng(seed))
            for index, seed in enumerate(seeds.spawn(len(self.names)))]
        self._queue: list[_Pending] = []
        self._names_of: dict[tuple[int, ...], tuple[str, ...]] = {}
        self._no_rates: Array = np.empty(0)
        self._first_ns = 0
        self._next_ns: int | None = None
        self._last_ns: int | None = None

    @property
    def next_sample_ns(self) -> int | None:
        """Time from which on the next sample is taken [ns], None for at once."""
        return self._next_ns

    def set_faults(self, faults: Mapping[str, Fault]) -> None:
        """
        Break the sensors that are named, from the next sample on, and mend all others.

        :param faults: by what they hit; names of other things change nothing here.
        """
        for name, sensor in zip(self.names, self._sensors):
            sensor.fault = faults.get(name)

    def reset(self) -> None:
        """
        Forget the samples on their way, because the linkage was put somewhere else.

        Random numbers and drifts go on. The next sample may have any stamp.
        """
        self._queue.clear()
        self._next_ns = self._last_ns = None

    def measure(self, stamp_ns: int, link_angles: Array, link_rates: Array) -> None:
        """
        Let every sensor take a sample, at most one each, if one is due by their rate.

        :param stamp_ns: now, later than the time before [ns].
        :param link_angles: (4,) true orientations, continuous [rad].
        :param link_rates: (4,) their rates [rad/s].
        :raises SensorError: time does not go on.
        """
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            raise SensorError(f'a sample at {stamp_ns} ns cannot follow one at {self._last_ns} ns')
        if self._next_ns is not None and stamp_ns < self._next_ns:
            return
        elapsed_s = 0.0 if self._last_ns is None else (stamp_ns - self._last_ns) * 1e-9
        self._schedule_next(stamp_ns)
        self._last_ns = stamp_ns
        angles, rates = link_angles.tolist(), link_rates.tolist()
        if self.settings.kind == 'joint':
            angles, rates = self._at_joints(angles), self._at_joints(rates)
        root_s = sqrt(elapsed_s)
        for sensor, angle, rate in zip(self._sensors, angles, rates):
            sample = sensor.sample(stamp_ns, elapsed_s, root_s, angle, rate)
            if sample is not None:
                heappush(self._queue, sample)

    def due(self, tick_ns: int) -> tuple[SensorReading, ...]:
        """
        Hand out the samples that have arrived by a tick, each once.

        :param tick_ns: now [ns].
        :returns: one reading for each time of measurement, in the order of these.
        """
        queue = self._queue
        arrived = []
        while queue and queue[0][0] <= tick_ns:
            arrived.append(heappop(queue))
        arrived.sort(key=_STAMP_AND_SENSOR)
        return tuple(self._reading(stamp_ns, list(samples))
                     for stamp_ns, samples in groupby(arrived, key=_STAMP))

    def _reading(self, stamp_ns: int, samples: list[_Pending]) -> SensorReading:
        _, _, sensors, angles, rates = zip(*samples)
        names = self._names_of.get(sensors)
        if names is None:
            names = self._names_of[sensors] = tuple(self.names[index] for index in sensors)
        return SensorReading(stamp_ns, names, np.array(angles),
                             np.array(rates) if self.settings.gyro else self._no_rates)

    def _at_joints(self, values: list[float]) -> list[float]:
        heading = LINK_NAMES.index(str(self.settings.heading))
        return [*(values[second] - values[first] for first, second in JOINT_LINKS),
                values[heading]]

    def _schedule_next(self, stamp_ns: int) -> None:
        """Count on from the first sample, so that no rounding adds up."""
        rate = self.settings.rate
        if not rate:
            return
        if self._last_ns is None:
            self._first_ns = stamp_ns
        taken = int((stamp_ns - self._first_ns) * 1e-9 * rate)
        self._next_ns = stamp_ns
        while self._next_ns <= stamp_ns:
            taken += 1
            self._next_ns = self._first_ns + round(taken * 1e9 / rate)


_STAMP = itemgetter(1)
_STAMP_AND_SENSOR = itemgetter(1, 2)


class _Sensor:
    """
    One sensor: its errors, its random numbers and its fault.

    :ivar fault: what is wrong with it now.
    """

    def __init__(self, settings: LinkSensorSettings, index: int,
                 generator: np.random.Generator) -> None:
        self.fault: Fault | None = None
        self._index = index
        self._generator = generator
        self._draws: Iterator[_Draws] = iter(())
        self._gain = 1.0 + settings.scale_error
        self._bias = _of_sensor(settings.bias, index)
        self._noise_rms = settings.noise_rms
        self._random_walk = settings.random_walk
        self._gyro_bias = _of_sensor(settings.gyro_bias, index)
        self._gyro_noise_rms = settings.gyro_noise_rms
        self._gyro_random_walk = settings.gyro_random_walk
        self._counts = int(settings.counts_per_turn)
        self._latency_ns = round(settings.latency * 1e9)
        self._jitter_ns = settings.jitter * 1e9
        self._dropout = settings.dropout
        self._drift = 0.0
        self._gyro_drift = 0.0
        self._given: tuple[float, float] | None = None
        self._before = 0.0
        self._lagged = 0.0

    def sample(self, stamp_ns: int, elapsed_s: float, root_s: float, angle: float,
               rate: float) -> _Pending | None:
        """
        Measure.

        :param elapsed_s, root_s: time since the sample before, and its square root; 0 for the
            first one, and where the linkage jumped since.
        :returns: arrival, stamp, sensor, angle, rate; None where the sample is lost.
        """
        (noise, step, jitter, gyro_noise, gyro_step,
         dropped, interrupted, anywhere) = next(self._draws, None) or self._draw()
        self._drift += self._random_walk * root_s * step
        self._gyro_drift += self._gyro_random_walk * root_s * gyro_step
        angle = self._gain * angle + self._bias + self._drift + self._noise_rms * noise
        rate += self._gyro_bias + self._gyro_drift + self._gyro_noise_rms * gyro_noise
        arrival_ns = stamp_ns + self._latency_ns + round(self._jitter_ns * abs(jitter))
        fault = self.fault
        kind = '' if fault is None else fault.kind
        value = 0.0 if fault is None or fault.value is None else fault.value
        angle = self._low_pass(angle, elapsed_s, value if kind == 'slow' else 0.0)
        if (dropped < self._dropout or kind == 'off'
                or (kind == 'intermittent' and interrupted < value)):
            return None
        if kind == 'wrong':
            angle += value
        elif kind == 'garbage':
            angle = TURN * anywhere
        elif kind == 'delayed':
            arrival_ns += round(value * 1e9)
        if kind != 'stuck' or self._given is None:
            self._given = _in_one_turn(angle, self._counts), rate
        return (arrival_ns, stamp_ns, self._index, *self._given)

    def _low_pass(self, angle: float, elapsed_s: float, time_constant_s: float) -> float:
        """
        Let a first-order lag follow the angle, taken as linear between two samples.

        That makes the lag that of continuous time at any sampling rate.
        """
        before, self._before = self._before, angle
        if not time_constant_s or not elapsed_s:
            self._lagged = angle
        else:
            stays = exp(-elapsed_s / time_constant_s)
            ramp = (angle - before) / elapsed_s * time_constant_s
            self._lagged = angle - ramp + stays * (self._lagged - before + ramp)
        return self._lagged

    def _draw(self) -> _Draws:
        """Draw the random numbers of a block of samples, and return those of the first."""
        block = np.hstack((self._generator.standard_normal((BLOCK, NORMALS)),
                           self._generator.random((BLOCK, UNIFORMS))))
        self._draws = map(tuple, block.tolist())
        return next(self._draws)


def _in_one_turn(angle: float, counts: int) -> float:
    """Bring an angle [rad] into (-pi, pi], rounded to whole counts where there are any."""
    if counts:
        # Whole numbers wrap without rounding, so that every turn has the same grid.
        most_negative = (counts - 1) // 2
        count = (round(angle / TURN * counts) + most_negative) % counts - most_negative
        return min(count * TURN / counts, pi)
    if -pi < angle <= pi:
        return angle
    wrapped = remainder(angle, TURN)
    return pi if wrapped <= -pi else wrapped


def _of_sensor(value: float | tuple[float, ...], index: int) -> float:
    return float(value[index] if isinstance(value, tuple) else value)


def _check(name: str, value: Any, place: str = '') -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise SensorError(f'link_sensors.{name}{place} must be a number, got {value!r}')
    low, high, unit = _RANGES[name]
    if not low <= value <= high:
        raise SensorError(f'link_sensors.{name}{place} must be from {low:g} to {high:g}'
                          f'{" " if unit else ""}{unit}, got {value}')
