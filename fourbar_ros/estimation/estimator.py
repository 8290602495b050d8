# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The estimator: measured angles and ticks in, estimates out, one per tick.

A measurement belongs to its stamp, whenever it arrives. What the filter was at each tick of the
last tenth of a second, what the wheels did since, and what was measured is kept; when something
arrives that was measured before the last tick, the filter goes back to the tick before it and
comes forward again. So the estimate depends on what has arrived, and not on when or in what order.
"""

from __future__ import annotations

from bisect import insort
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, isnan, nan, pi
from typing import NamedTuple

from fourbar_ros.estimation.filter import LinkageFilter, Snapshot
from fourbar_ros.estimation.health import SensorHealth
from fourbar_ros.mechanism import (
    ClosureError,
    JOINT_LINKS,
    Mechanism,
    nearest_assembly,
    SENSOR_NAMES,
)
from fourbar_ros.mechanism.angles import wrap
from fourbar_ros.mechanism.by_name import RejectedError, values_by_name
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

# A longer silence, or time going back, means another run of the device: start again.
LONGEST_GAP_NS = 1_000_000_000

# How long the wheels alone carry the estimate; then it is lost.
LONGEST_BLIND_NS = 1_000_000_000

# So many measurements in a row of which the gate refuses most mean that the filter is lost.
LOST_AFTER = 10

# How long after its stamp a measurement may arrive; a filter cannot go back for ever.
HISTORY_NS = 100_000_000

# Measurements that wait for their tick; more than ever arrive in one period.
LONGEST_QUEUE = 100

STATE_NAMES = ('phi_a', 'phi_b', 'omega_a', 'omega_b')
"""The state of the filter, by the names of docs/mechanics.md."""

# Standard deviations at the start of the rates, which are unknown [rad/s], and of the angles, so
# large that the first sample is all that counts [rad].
INITIAL_RATE_SIGMA = 10.0
INITIAL_ANGLE_SIGMA = 0.5


@dataclass(frozen=True)
class EstimatorSettings:
    """
    What the filter assumes.

    :param angle_noise: standard deviation of a link-angle sample [rad].
    :param counts_per_turn: resolution of the link-angle sensors, 0 for none.
    :param disturbance_torque: density of unknown torques on each link [N m/sqrt(Hz)].
    :param gate_probability: share of the samples of a healthy sensor that are used; the rest lies
        farther off than noise should have it.
    """

    angle_noise: float = 1.7453e-3
    counts_per_turn: int = 16384
    disturbance_torque: float = 1e-7
    gate_probability: float = 0.9999

    @property
    def gate(self) -> float:
        """Largest NIS of one sensor that is used: chi-square of one degree of freedom."""
        return float(ndtri(0.5 + 0.5 * self.gate_probability) ** 2)

    @property
    def angle_variance(self) -> float:
        """Variance of one sample, rounding included [rad^2]."""
        step = 2.0 * pi / self.counts_per_turn if self.counts_per_turn else 0.0
        return self.angle_noise ** 2 + step ** 2 / 12.0


@dataclass(frozen=True, eq=False)
class Innovation:
    """
    What one update of the filter saw.

    :param sensors: which measured, as indices of `SENSOR_NAMES`.
    :param angles: (n,) measured minus predicted [rad].
    :param used: (n,) bool, False where the gate refused the sample.
    :param nis: normalised square of the used ones, chi-square of as many degrees of freedom if
        all is well.
    """

    sensors: tuple[int, ...]
    angles: Array
    used: NDArray[np.bool_]
    nis: float

    @property
    def degrees_of_freedom(self) -> int:
        """How many samples were used."""
        return int(self.used.sum())


@dataclass(frozen=True, eq=False)
class Estimate:
    """
    The state of the links at a tick, and how well it is known.

    :param stamp_ns: the tick [ns].
    :param link_angles: (4,) continuous [rad].
    :param link_rates: (4,) [rad/s].
    :param angle_sigmas: (4,) one standard deviation [rad].
    :param rate_sigmas: (4,) one standard deviation [rad/s].
    :param covariance: (4, 4) of the filter's state, see `STATE_NAMES`.
    :param innovation: of the newest measurement that arrived since the last tick and corrected
        the filter, None without one.
    """

    stamp_ns: int
    link_angles: Array
    link_rates: Array
    angle_sigmas: Array
    rate_sigmas: Array
    covariance: Array
    innovation: Innovation | None


class _Measurement(NamedTuple):
    """Angles (n,) [rad] that some sensors measured, as they sort in time."""

    stamp_ns: int
    sensors: tuple[int, ...]
    angles: Array

    def link_angles(self) -> Array:
        """Work out the link angles (4,) that follow without the closure, NaN the others [rad]."""
        measured = dict(zip(self.sensors, self.angles.tolist()))
        found = [measured.get(link, nan) for link in range(4)]
        # Once around the loop from any link, either way.
        for _ in range(3):
            for sensor, (first, second) in enumerate(JOINT_LINKS, 4):
                relative = measured.get(sensor, nan)
                if isnan(found[second]):
                    found[second] = found[first] + relative
                if isnan(found[first]):
                    found[first] = found[second] - relative
        return np.array(found)


@dataclass(eq=False)
class _Period:
    """
    What happened between two ticks.

    :param from_ns: the earlier tick, None before the first one [ns].
    :param to_ns: the later tick [ns].
    :param torques: (4,) If dOmega/dt of the wheels in between [N m].
    :param measurements: with stamps after the earlier tick and up to the later one, in order.
    :param before: what the filter was at the earlier tick.
    """

    from_ns: int | None
    to_ns: int
    torques: Array
    measurements: list[_Measurement]
    before: _Memory


class _Memory(NamedTuple):
    """The filter with its snapshot, or None, and what else a run of it changes."""

    linkage: LinkageFilter | None
    snapshot: Snapshot | None
    misfits: int
    starts: int


class Estimator:
    """
    Runs the filter on what comes in.

    :ivar rejected: number of unusable measurements by kind.
    :ivar last_rejection: what was wrong with the last one, or ''.
    :ivar gated: number of samples that the gate refused, by sensor.
    :ivar starts: how often the filter was started.
    :ivar waiting_for: what is missing for a start, or '' while the filter runs.
    """

    def __init__(self, mechanism: Mechanism, settings: EstimatorSettings) -> None:
        self.rejected: Counter[str] = Counter()
        self.last_rejection = ''
        self.gated: Counter[str] = Counter()
        self._health = SensorHealth()
        self.starts = 0
        self.waiting_for = 'flywheel_states'
        self._mechanism = mechanism
        self._settings = settings
        self._gate = settings.gate
        self._filter: LinkageFilter | None = None
        self._pending: list[_Measurement] = []
        self._history: list[_Period] = []
        self._stamp_ns: int | None = None
        self._last_angles: Array | None = None
        self._wheel_speeds = np.zeros(4)
        self._misfits = 0
        self._corrected_ns = 0
        self._lost = False
        # Compile the kernels now, not while time runs.
        square = np.array([0.0, pi / 2.0, 0.0, pi / 2.0])
        linkage = LinkageFilter(mechanism, square, 1.0, 1.0, 1.0)
        linkage.move(1e-3, np.zeros(4))
        linkage.correct((0, 1, 2, 3), square, 1.0, self._gate)
        linkage.sigmas()

    def measure(self, stamp_ns: int, names: Sequence[str], angles: Sequence[float]) -> None:
        """
        Take measured angles; they are used at the next tick at or after their stamp.

        They may arrive up to `HISTORY_NS` later than the last tick, and in any order.

        :param stamp_ns: time of measurement [ns].
        :param names: any of `SENSOR_NAMES`.
        :param angles: orientation of each link, angle in each joint (second link relative to the
            first, any turn) [rad].
        :raises RejectedError: unusable, taken whole or not at all; also counted.
        """
        try:
            measurement = self._checked(stamp_ns, names, angles)
        except RejectedError as error:
            self.rejected[error.kind] += 1
            self.last_rejection = str(error)
            raise
        if alive := self._alive(measurement):
            insort(self._pending, alive, key=_in_time)
            del self._pending[:-LONGEST_QUEUE]

    def sensor_faults(self) -> dict[str, str]:
        """Tell at the last tick what is wrong with sensors: a few words by the sensor's name."""
        return {} if self._stamp_ns is None else self._health.faults(self._stamp_ns)

    def _alive(self, measurement: _Measurement) -> _Measurement | None:
        """Note the samples, and leave out those of a sensor that is stuck."""
        stamp_ns, sensors, angles = measurement
        for sensor, angle in zip(sensors, angles.tolist()):
            self._health.sample(stamp_ns, sensor, angle)
        kept = [n for n, sensor in enumerate(sensors) if not self._health.stuck(sensor)]
        if len(kept) == len(sensors):
            return measurement
        if not kept:
            return None
        return _Measurement(stamp_ns, tuple(sensors[n] for n in kept), angles[kept])

    def tick(self, stamp_ns: int, wheel_speeds: ArrayLike) -> Estimate | None:
        """
        Advance to a tick.

        :param wheel_speeds: (4,) measured, relative to the links [rad/s].
        :returns: the estimate, or None while there is nothing to start from.
        :raises RejectedError: wheel speeds that cannot be used, or a tick that was there
            already; also counted.
        """
        speeds = np.array(wheel_speeds, dtype=float)
        try:
            self._check_tick(stamp_ns, speeds)
        except RejectedError as error:
            self.rejected[error.kind] += 1
            self.last_rejection = str(error)
            raise
        self._open_period(stamp_ns, speeds)
        innovation = self._relive(*self._sort_in())
        self._forget()
        if self._filter is not None and stamp_ns - self._corrected_ns > LONGEST_BLIND_NS:
            self._lost = True
            self._begin_anew()
            self.waiting_for = self._what_is_missing()
        if self._filter is None:
            return None
        self.waiting_for = ''
        angle_sigmas, rate_sigmas = self._filter.sigmas()
        self._last_angles = self._filter.angles.copy()
        return Estimate(stamp_ns, self._filter.angles.copy(), self._filter.rates, angle_sigmas,
                        rate_sigmas, self._filter.P.copy(), innovation)

    def reset(self) -> None:
        """Forget the estimate and start again, on the same turn, from what is measured next."""
        self._pending.clear()
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._filter, self._misfits = None, 0
        if self._history:
            # Where it goes back to, should something late come, is without a filter, too.
            last = self._history[-1]
            last.measurements.clear()
            last.before = self._remember()
            self._history[:] = [last]

    def _what_is_missing(self) -> str:
        if self._lost:
            return (f'link_angles: the estimate is lost, none was of use for '
                    f'{LONGEST_BLIND_NS * 1e-9:g} s')
        return 'link_angles that tell link_a, link_b and one of link_c, link_d'

    def _open_period(self, stamp_ns: int, speeds: Array) -> None:
        """Add the period that ends with a tick; without a connection to the last, start anew."""
        last_ns = self._stamp_ns
        torques = np.zeros(4)
        if last_ns is not None:
            if 0 < stamp_ns - last_ns <= LONGEST_GAP_NS:
                torques = (self._mechanism.flywheel_inertias * (speeds - self._wheel_speeds)
                           / ((stamp_ns - last_ns) * 1e-9))
            else:
                self._history.clear()
                self._filter = last_ns = self._last_angles = None
                self._health = SensorHealth()
        self._stamp_ns, self._wheel_speeds = stamp_ns, speeds
        self._history.append(_Period(last_ns, stamp_ns, torques, [], self._remember()))

    def _sort_in(self) -> tuple[int, list[_Measurement]]:
        """
        Put what has arrived into the periods that it belongs to.

        :returns: number of the first period that has changed, and what is new in them.
        """
        history = self._history
        oldest_ns = history[0].from_ns
        if oldest_ns is None:
            oldest_ns = history[0].to_ns - HISTORY_NS
        changed = len(history) - 1
        arrived, waiting = [], []
        for measurement in self._pending:
            if measurement.stamp_ns > history[-1].to_ns + LONGEST_GAP_NS:
                continue    # of another run
            if measurement.stamp_ns > history[-1].to_ns:
                waiting.append(measurement)
            elif measurement.stamp_ns > oldest_ns:     # else of another run
                n = self._period_of(measurement.stamp_ns)
                insort(history[n].measurements, measurement, key=_in_time)
                arrived.append(measurement)
                changed = min(changed, n)
        self._pending = waiting
        return changed, arrived

    def _period_of(self, stamp_ns: int) -> int:
        """Return the number of the kept period that a stamp belongs to."""
        n = len(self._history) - 1
        while n > 0 and stamp_ns <= self._history[n - 1].to_ns:
            n -= 1
        return n

    def _relive(self, first: int, arrived: list[_Measurement]) -> Innovation | None:
        """
        Bring the filter from the beginning of a period to the last tick.

        :param first: number of the period.
        :param arrived: measurements that the filter has not seen before.
        :returns: innovation of the newest of these that corrected the filter.
        """
        self.waiting_for = self._what_is_missing()
        if first < len(self._history) - 1:
            self._recall(self._history[first].before)
        innovation = None
        for n in range(first, len(self._history)):
            period = self._history[n]
            if n > first:
                period.before = self._remember()
            now_ns = period.from_ns
            for measurement in period.measurements:
                if self._filter is not None and now_ns is not None and (
                        measurement.stamp_ns > now_ns):
                    self._filter.move((measurement.stamp_ns - now_ns) * 1e-9, period.torques)
                now_ns = measurement.stamp_ns
                seen = self._use(measurement)
                if seen is not None and any(new is measurement for new in arrived):
                    innovation = seen
                    self._note_refusals(seen)
            if self._filter is not None and now_ns is not None and now_ns < period.to_ns:
                self._filter.move((period.to_ns - now_ns) * 1e-9, period.torques)
        return innovation

    def _note_refusals(self, seen: Innovation) -> None:
        """Count the samples that the gate refused."""
        used = seen.used.tolist()
        self._health.judged(seen.sensors, used)
        if not all(used):
            self.gated.update(SENSOR_NAMES[sensor] for sensor, taken in zip(seen.sensors, used)
                              if not taken)

    def _forget(self) -> None:
        """Drop the periods that nothing which is still accepted can belong to."""
        history = self._history
        needed_ns = history[-1].to_ns - HISTORY_NS
        count = 0
        while history[count].to_ns < needed_ns:
            count += 1
        del history[:count]

    def _remember(self) -> _Memory:
        linkage = self._filter
        return _Memory(linkage, None if linkage is None else linkage.snapshot(), self._misfits,
                       self.starts)

    def _recall(self, memory: _Memory) -> None:
        self._filter, self._misfits, self.starts = memory.linkage, memory.misfits, memory.starts
        if memory.linkage is not None and memory.snapshot is not None:
            memory.linkage.restore(memory.snapshot)

    def _use(self, measurement: _Measurement) -> Innovation | None:
        """Correct the filter, or start it."""
        if self._filter is None:
            self._start(measurement)
            return None
        residual, nis, used = self._filter.correct(
            measurement.sensors, measurement.angles, self._settings.angle_variance, self._gate)
        if used.any():
            self._corrected_ns = max(self._corrected_ns, measurement.stamp_ns)
        if 2 * used.sum() >= used.size:
            self._misfits = 0
        else:
            self._misfits += 1
            if self._misfits >= LOST_AFTER:
                # If this one does not tell enough, the wheels carry on.
                self._start(measurement)
        return Innovation(measurement.sensors, residual, used, nis)

    def _start(self, measurement: _Measurement) -> None:
        """Start the filter from a sample, if it determines the configuration."""
        measured = measurement.link_angles()
        known = ~np.isnan(measured)
        if not (known[0] and known[1] and known.sum() > 2):
            return
        near = np.where(np.isnan(measured), measured[[2, 3, 3, 2]], measured)
        try:
            start = nearest_assembly(self._mechanism, (0, 1), (measured[0], measured[1]), near)
        except ClosureError as error:
            self.waiting_for = f'link angles that fit together: {error}'
            return
        if self._last_angles is not None:
            # On the turn that everybody has seen it on.
            start += 2.0 * pi * np.round((self._last_angles - start) / (2.0 * pi))
        self._filter = LinkageFilter(
            self._mechanism, start, INITIAL_ANGLE_SIGMA ** 2, INITIAL_RATE_SIGMA ** 2,
            self._settings.disturbance_torque)
        self._filter.correct(
            measurement.sensors, measurement.angles, self._settings.angle_variance)
        self._corrected_ns, self._lost = measurement.stamp_ns, False
        self.starts += 1
        self._misfits = 0

    def _checked(self, stamp_ns: int, names: Sequence[str], angles: Sequence[float]
                 ) -> _Measurement:
        measured = values_by_name(names, angles, SENSOR_NAMES, 'position')
        sensors = tuple(sorted(measured))
        known = self._pending
        if self._stamp_ns is not None and 0 <= self._stamp_ns - stamp_ns < LONGEST_GAP_NS:
            if self._stamp_ns - stamp_ns > HISTORY_NS:
                raise RejectedError('late', f'measured {(self._stamp_ns - stamp_ns) * 1e-9:g} s '
                                            f'before the last tick, limit {HISTORY_NS * 1e-9:g} s')
            known = known + self._history[self._period_of(stamp_ns)].measurements
        for other in known:
            if other.stamp_ns == stamp_ns and not set(sensors).isdisjoint(other.sensors):
                raise RejectedError('repeated', 'a sample with this stamp was there already')
        return _Measurement(
            stamp_ns, sensors, np.array([wrap(measured[sensor]) for sensor in sensors]))

    def _check_tick(self, stamp_ns: int, speeds: Array) -> None:
        if speeds.shape != (4,) or not all(map(isfinite, speeds.tolist())):
            raise RejectedError('wheels', 'flywheel_states must hold four finite velocities')
        if self._stamp_ns is not None and 0 <= self._stamp_ns - stamp_ns < LONGEST_GAP_NS:
            raise RejectedError('stamp', 'tick is not newer than the last one')


def _in_time(measurement: _Measurement) -> tuple[int, tuple[int, ...]]:
    """Sort by stamp, and samples of one stamp in an order that arrival has no part in."""
    return measurement.stamp_ns, measurement.sensors
