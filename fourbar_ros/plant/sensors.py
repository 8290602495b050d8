# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The sensors of the links: errors, resolution and latency of their samples.

Sensors of kind `absolute` measure the orientation of each link in frame `table`. Those of kind
`joint` are an encoder at each joint, which measures the second link relative to the first, and an
absolute sensor on one link, the heading: relative encoders alone cannot observe attitude.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import groupby
from math import exp, pi, remainder, sqrt
from operator import itemgetter

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import setting, SettingError, Settings, settings_of
from fourbar_ros.mechanism import JOINT_LINKS, JOINT_NAMES, LINK_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.samples import LinkSample
from fourbar_ros.plant.faults import Fault
import numpy as np

KINDS = ('absolute', 'joint')

TURN = 2.0 * pi
# Random numbers of one sample: normal for noise, random walk, latency, gyro noise and gyro walk;
# uniform for dropout, the intermittent and the garbage fault. All of them are always drawn, so
# that no setting and no fault shifts those of later samples.
NORMALS, UNIFORMS = 5, 3
# Samples for which random numbers are drawn at once: numpy is slow for a single number.
BLOCK = 64

_Draws = tuple[float, float, float, float, float, float, float, float]
_Pending = tuple[int, int, int, float, float]


class SensorError(FourbarError):
    """A sample at a time that cannot follow the one before."""


@dataclass(frozen=True)
class LinkSensorSettings(Settings):
    """
    The settings of the sensors of the links; the defaults describe perfect sensors.

    `bias` and `gyro_bias` are one number for all sensors, or one for each sensor in the order of
    `sensor_names`.

    :raises SettingError: a value is refused.
    """

    section = 'link_sensors'

    kind: str = setting('absolute', '', 'where the sensors are', choices=KINDS)
    noise_rms: float = setting(0.0, 'rad', 'white noise of each sample', low=0.0, high=10.0)
    bias: float | tuple[float, ...] = setting(
        0.0, 'rad', 'constant error', low=-10.0, high=10.0)
    random_walk: float = setting(
        0.0, 'rad/sqrt(s)', 'drift, which grows with the square root of time', low=0.0, high=10.0)
    counts_per_turn: int = setting(
        0, 'counts per turn', 'resolution, 0 for unlimited', low=0, high=2**31)
    scale_error: float = setting(
        0.0, '', 'relative error of the continuous angle since the zero of the sensor',
        low=-0.5, high=0.5)
    latency: float = setting(
        0.0, 's', 'shortest time from measurement to arrival', low=0.0, high=10.0)
    jitter: float = setting(
        0.0, 's', 'rms of the additional latency, of a half-normal distribution', low=0.0,
        high=10.0)
    dropout: float = setting(0.0, '', 'probability that a sample is lost', low=0.0, high=1.0)
    rate: float = setting(
        0.0, 'Hz', 'sampling rate, 0 for a sample at every tick', low=0.0, high=1e5)
    heading: str | None = setting(
        'link_a', '', 'link with the absolute sensor where the others are joint encoders',
        choices=('', *LINK_NAMES))
    gyro: bool = setting(False, '', 'whether the sensors measure rates, too')
    gyro_noise_rms: float = setting(
        0.0, 'rad/s', 'white noise of each sample', low=0.0, high=1000.0)
    gyro_bias: float | tuple[float, ...] = setting(
        0.0, 'rad/s', 'constant error', low=-1000.0, high=1000.0)
    gyro_random_walk: float = setting(
        0.0, 'rad/s/sqrt(s)', 'drift', low=0.0, high=1000.0)

    def __post_init__(self) -> None:
        """Check every value."""
        rows = {row.name: row for row in settings_of(type(self))}
        lists = {name: value for name in ('bias', 'gyro_bias')
                 if isinstance(value := getattr(self, name), (list, tuple))}
        for name in lists:
            object.__setattr__(self, name, 0.0)
        if self.heading is None:
            object.__setattr__(self, 'heading', '')
        super().__post_init__()
        if self.kind == 'joint' and not self.heading:
            raise SettingError(
                'link_sensors.heading must name a link with an absolute sensor '
                f'({", ".join(LINK_NAMES)}): relative encoders alone cannot observe attitude',
                name='link_sensors.heading', value=self.heading, limit=LINK_NAMES)
        for name, value in lists.items():
            object.__setattr__(self, name, tuple(rows[name].check_each(
                value, self.sensor_names, f'link_sensors.{name}')))

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors: four links, or four joints and the link of the heading."""
        if self.kind == 'absolute':
            return LINK_NAMES
        return (*JOINT_NAMES, str(self.heading))


class LinkSensors:
    """
    The sensors of the links, with samples on their way.

    Every sensor has random numbers of its own and uses the same number of them for each sample:
    the settings and faults of one sensor leave the samples of the others unchanged, bit for bit.

    :param settings: of all sensors.
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
        """Earliest time of the next sample [ns], None for any time."""
        return self._next_ns

    def set_faults(self, faults: Mapping[str, Fault]) -> None:
        """
        Set the faults of all sensors, from the next sample on.

        :param faults: by the name of the target; those of other targets are ignored.
        """
        for name, sensor in zip(self.names, self._sensors):
            sensor.fault = faults.get(name)

    def reset(self) -> None:
        """
        Discard the samples on their way after a jump of the linkage.

        Random numbers and drifts go on. The next sample may have any stamp.
        """
        self._queue.clear()
        self._next_ns = self._last_ns = None

    def measure(self, stamp_ns: int, link_angles: Array, link_rates: Array) -> None:
        """
        Take a sample of every sensor if one is due by the sampling rate.

        :param stamp_ns: now, later than in the call before [ns].
        :param link_angles: (4,) true orientations, continuous [rad].
        :param link_rates: (4,) their rates [rad/s].
        :raises SensorError: the time does not increase.
        """
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            raise SensorError(f'a sample at {stamp_ns} ns cannot follow one at {self._last_ns} ns',
                              value=stamp_ns, limit=self._last_ns)
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

    def due(self, tick_ns: int) -> tuple[LinkSample, ...]:
        """
        Return the samples that have arrived by a tick, each once.

        :param tick_ns: now [ns].
        :returns: one reading for each time of measurement, in order.
        """
        queue = self._queue
        arrived = []
        while queue and queue[0][0] <= tick_ns:
            arrived.append(heappop(queue))
        arrived.sort(key=_STAMP_AND_SENSOR)
        return tuple(self._reading(stamp_ns, list(samples))
                     for stamp_ns, samples in groupby(arrived, key=_STAMP))

    def _reading(self, stamp_ns: int, samples: list[_Pending]) -> LinkSample:
        _, _, sensors, angles, rates = zip(*samples)
        names = self._names_of.get(sensors)
        if names is None:
            names = self._names_of[sensors] = tuple(self.names[index] for index in sensors)
        return LinkSample(stamp_ns, names, np.array(angles),
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
