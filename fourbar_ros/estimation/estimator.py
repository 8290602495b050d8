# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

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
from itertools import combinations
from math import isfinite, pi, sin
from typing import NamedTuple

from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.estimation.correction import LEFT_OUT, REFUSED
from fourbar_ros.estimation.estimate import (
    ACCEPTED,
    Decision,
    Estimate,
    FAULTY,
    GATED,
    Innovation,
    LATE,
    NO_DATA,
    NOT_FINITE,
    REPEATS,
)
from fourbar_ros.estimation.filter import Correction, GYROS, LinkageFilter, Snapshot
from fourbar_ros.estimation.filter_state import ANGLES, RATES, TORQUES
from fourbar_ros.estimation.measurement import Measurement, read_measurement, sensor_name
from fourbar_ros.estimation.sensor_health import SensorHealth
from fourbar_ros.estimation.settings import EstimatorSettings
from fourbar_ros.mechanism import ClosureError, Mechanism, SENSOR_NAMES
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.change_points import ASSEMBLY_DISTANCE, REDUCED_FORM_LIMIT
from fourbar_ros.mechanism.closure import assemblies
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.constrained import project_onto_closure
import numpy as np
from numpy.typing import ArrayLike

# A longer silence, or time going back, means another run of the device: start again.
LONGEST_GAP_NS = 1_000_000_000

# How long the wheels alone carry the estimate; then it is lost.
LONGEST_BLIND_NS = 1_000_000_000

# What is measured within this time counts as measured at once, to start from [ns].
TOGETHER_NS = 20_000_000
# So many measurements in a row of which the gate refuses most mean that the filter is lost.
LOST_AFTER = 10

# How long after its stamp a measurement may arrive; a filter cannot go back for ever.
HISTORY_NS = 100_000_000

# Measurements that wait for their tick; more than ever arrive in one period.
LONGEST_QUEUE = 100

STATE_NAMES = ('phi_a', 'phi_b', 'omega_a', 'omega_b')
"""The free state of the filter, by the names of docs/mechanics.md."""

# Standard deviations at the start of the rates, which are unknown [rad/s], and of the angles, so
# large that the first sample is all that counts [rad].
INITIAL_RATE_SIGMA = 10.0
INITIAL_ANGLE_SIGMA = 0.5

# Where wheels are not measured, their torques are known to their friction only: so much of what
# the motors can give, walking in a second.
UNKNOWN_SHARE = 0.02

# How long a command counts, where there is nothing better; a device disarms after as long.
LONGEST_COMMAND_NS = 100_000_000

# What drives the prediction.
BY_SPEED, BY_EFFORT, BY_COMMAND, BY_NOTHING = (
    'wheel speeds', 'wheel efforts', 'commanded efforts', 'nothing')

# Newton steps that bring measured link angles near alignment onto the closure.
NEWTON_STEPS = 5


@dataclass(eq=False)
class _Period:
    """
    What happened between two ticks.

    :param from_ns: the earlier tick, None before the first one [ns].
    :param to_ns: the later tick [ns].
    :param torques: (4,) If dOmega/dt of the wheels in between [N m].
    :param unknown: how little these are known [N m/sqrt(s)].
    :param measurements: with stamps after the earlier tick and up to the later one, in order.
    :param before: what the filter was at the earlier tick.
    :param reached: what it was at the later tick, before what was measured just then.
    """

    from_ns: int | None
    to_ns: int
    torques: Array
    unknown: float
    measurements: list[Measurement]
    before: _Memory
    reached: _Memory | None = None


class _Memory(NamedTuple):
    """The filter with its snapshot, or None, and what else a run of it changes."""

    linkage: LinkageFilter | None
    snapshot: Snapshot | None
    misfits: int
    starts: int


class _Wheels(NamedTuple):
    """Speeds of the wheels: mean over the period before a tick, and at its end."""

    mean: Array
    last: Array


class Estimator:
    """
    Runs the filter on what comes in.

    :ivar rejected: number of unusable measurements by kind.
    :ivar last_rejection: what was wrong with the last one, or ''.
    :ivar starts: how often the filter was started.
    :ivar waiting_for: what is missing for a start, or '' while the filter runs.
    :ivar driven_by: what the last prediction knew of the wheels: one of BY_SPEED, BY_EFFORT,
        BY_COMMAND, BY_NOTHING.
    """

    def __init__(self, mechanism: Mechanism, settings: EstimatorSettings) -> None:
        self.rejected: Counter[str] = Counter()
        self.last_rejection = ''
        self._gated: Counter[str] = Counter()
        self._health = SensorHealth()
        self.starts = 0
        self.waiting_for = 'flywheel_states'
        self.driven_by = BY_SPEED
        self._mechanism = mechanism
        self._inertias = mechanism.flywheel_inertias
        self._unknown = UNKNOWN_SHARE * float(mechanism.motor_torque_limits.max())
        self._settings = settings
        self._gate, self._variances = settings.gate, settings.variances
        self._variances_of: dict[tuple[int, ...], Array] = {}
        self._filter: LinkageFilter | None = None
        self._pending: list[Measurement] = []
        self._history: list[_Period] = []
        self._stamp_ns: int | None = None
        self._last_angles: Array | None = None
        self._last_rates: Array | None = None
        self._wheels: _Wheels | None = None
        self._commanded: tuple[int, Array] | None = None
        self._misfits = 0
        self._corrected_ns = 0
        self._lost = False
        # The last angle of each sensor while there is no estimate, with its stamp [ns].
        self._before: dict[int, tuple[int, float]] = {}
        self._decisions: dict[int, Decision] = {}
        self._told: dict[int, Decision] = {}
        self._seen: list[tuple[Measurement, Correction]] = []
        # Compile the kernels now, not while time runs.
        square = np.array([0.0, pi / 2.0, 0.0, pi / 2.0])
        linkage = LinkageFilter(mechanism, square, 1.0, 1.0, settings.randomness)
        linkage.move(1e-3, np.zeros(4))
        linkage.correct((0, 1, 2, 3), square, 1.0, self._gate)

    def measure(self, stamp_ns: int, names: Sequence[str], angles: Sequence[float],
                rates: Sequence[float] = ()) -> None:
        """
        Take measured angles; they are used at the next tick at or after their stamp.

        They may arrive up to `HISTORY_NS` later than the last tick, and in any order.

        :param stamp_ns: time of measurement [ns].
        :param names: any of `SENSOR_NAMES`.
        :param angles: orientation of each link, angle in each joint (second link relative to the
            first, any turn) [rad].
        :param rates: of each from its gyro [rad/s], or nothing where none is fitted.
        :raises RejectedError: unusable, taken whole or not at all; also counted.
        """
        try:
            measurement = read_measurement(stamp_ns, names, angles, rates)
            self._check_time(measurement)
        except RejectedError as error:
            self.reject(error)
            if error.kind in ('finite', 'late'):
                reason = LATE if error.kind == 'late' else NOT_FINITE
                for name in names:
                    sensor = SENSOR_NAMES.index(name)
                    self._decide(Decision(sensor, reason))
                    if reason == LATE and self._stamp_ns is not None:
                        self._health.too_late(self._stamp_ns, sensor)
            raise
        if alive := self._alive(measurement):
            insort(self._pending, alive, key=Measurement.in_time)
            del self._pending[:-LONGEST_QUEUE]

    def commanded(self, efforts: Sequence[float]) -> None:
        """
        Take note of what the motors were told, for ticks that do not tell what they did.

        It counts for 0.1 s: who is told nothing any more does nothing.

        :param efforts: (4,) torques on the wheels [N m]; others are no help, and are left alone.
        """
        if len(efforts) == 4 and all(map(isfinite, efforts)):
            self._commanded = self._stamp_ns or 0, np.array(efforts, dtype=float)

    @property
    def gated(self) -> Counter[str]:
        """Number of samples that the gate refused, by sensor."""
        self._take_note()
        return self._gated

    def decisions(self) -> tuple[Decision, ...]:
        """Tell what became, up to the last tick, of every sensor that was ever heard of."""
        self._take_note()
        return tuple(self._told.values())

    def sensor_faults(self) -> dict[str, str]:
        """Tell at the last tick what is wrong with sensors: a few words by the sensor's name."""
        self._take_note()
        if self._stamp_ns is None:
            return {}
        found = self._health.faults(self._stamp_ns)
        if self._filter is None:
            return found
        for sensor, error in self._filter.faulty().items():
            found.setdefault(SENSOR_NAMES[sensor], _off_by(error, []))
        suspected = self._filter.suspected()
        names = [SENSOR_NAMES[sensor] for sensor in suspected]
        if found.keys().isdisjoint(names):
            # Else it is known which of them it is.
            for name, error in zip(names, suspected.values()):
                found[name] = _off_by(error, [other for other in names if other != name])
        return found

    def suspicion(self) -> dict[str, float]:
        """
        Tell how suspicious each sensor is, by its name.

        :returns: by how much a constant error is likelier than none [nats]; nothing while there is
            no estimate.
        """
        if self._filter is None:
            return {}
        return dict(zip(SENSOR_NAMES, self._filter.suspicion().tolist()))

    def _alive(self, measurement: Measurement) -> Measurement | None:
        """Note the samples, and leave out those of a sensor that is stuck."""
        stuck, stamp_ns = set(), measurement.stamp_ns
        arrived_ns = stamp_ns if self._stamp_ns is None else max(stamp_ns, self._stamp_ns)
        for sensor, angle in measurement.angles().items():
            self._health.sample(stamp_ns, sensor, angle, arrived_ns)
            if self._health.stuck(sensor):
                stuck.add(sensor)
                self._decide(Decision(sensor, REPEATS))
        return measurement.without(stuck) if stuck else measurement

    def tick(self, stamp_ns: int, wheel_speeds: ArrayLike, wheel_efforts: ArrayLike = ()
             ) -> Estimate | None:
        """
        Advance to a tick.

        Without speeds the efforts drive the prediction, and without these what was commanded.

        :param wheel_speeds: (4,) measured, relative to the links, mean over the time since the
            last tick [rad/s]; or nothing.
        :param wheel_efforts: (4,) torques on the wheels in that time [N m]; or nothing.
        :returns: the estimate, or None while there is nothing to start from.
        :raises RejectedError: the tick was there already, or speeds or efforts are neither four
            nor none; also counted.
        """
        speeds, efforts = (np.array(given, dtype=float) for given in (wheel_speeds, wheel_efforts))
        try:
            self._check_tick(stamp_ns, speeds, efforts)
        except RejectedError as error:
            self.reject(error)
            raise
        self._take_note()
        self._told, self._decisions = self._decisions, {
            sensor: Decision(sensor, NO_DATA) for sensor in self._decisions}
        self._open_period(stamp_ns, speeds, efforts)
        innovation = self._relive(*self._sort_in())
        self._forget()
        if self._filter is not None and stamp_ns - self._corrected_ns > LONGEST_BLIND_NS:
            self._lost = True
            self._begin_anew()
            self.waiting_for = self._what_is_missing()
        if self._filter is None:
            return None
        self.waiting_for = ''
        return self._estimate(self._filter, stamp_ns, innovation)

    def reset(self) -> None:
        """Forget the estimate and start again, on the same turn, from what is measured next."""
        self._pending.clear()
        self._begin_anew()

    def reject(self, error: RejectedError) -> None:
        """Count a message that cannot be used."""
        self.rejected[error.kind] += 1
        self.last_rejection = str(error)

    def _estimate(self, linkage: LinkageFilter, stamp_ns: int, innovation: Innovation | None
                  ) -> Estimate:
        x, sigmas = linkage.x.copy(), linkage.sigmas()
        self._last_angles, self._last_rates = x[ANGLES], x[RATES]
        return Estimate(
            stamp_ns, x[ANGLES], x[RATES], sigmas[ANGLES], sigmas[RATES], linkage.free_covariance,
            x[TORQUES], sigmas[TORQUES],
            {gyro - GYROS: float(bias) for gyro, bias in zip(linkage.gyros, linkage.gyro_biases)},
            innovation)

    def _decide(self, decision: Decision) -> None:
        self._decisions[decision.sensor] = decision

    def _begin_anew(self) -> None:
        self._filter, self._misfits = None, 0
        if self._history:
            # Where it goes back to, should something late come, is without a filter, too.
            last = self._history[-1]
            last.measurements.clear()
            last.before, last.reached = self._remember(), None
            self._history[:] = [last]

    def _what_is_missing(self) -> str:
        if self._lost:
            return (f'link_angles: the estimate is lost, none was of use for '
                    f'{LONGEST_BLIND_NS * 1e-9:g} s')
        return 'link_angles that tell three of the four links'

    def _open_period(self, stamp_ns: int, speeds: Array, efforts: Array) -> None:
        """Add the period that ends with a tick; without a connection to the last, start anew."""
        last_ns = self._stamp_ns
        if last_ns is not None and not 0 < stamp_ns - last_ns <= LONGEST_GAP_NS:
            self._history.clear()
            self._filter = last_ns = self._wheels = None
            self._last_angles = self._last_rates = None
            self._health = SensorHealth()
            self._decisions.clear()
            self._told.clear()
        self._stamp_ns = stamp_ns
        torques, unknown = self._wheel_torques(stamp_ns, last_ns, speeds, efforts)
        self._history.append(_Period(last_ns, stamp_ns, torques, unknown, [], self._remember()))

    def _wheel_torques(self, stamp_ns: int, last_ns: int | None, speeds: Array, efforts: Array
                       ) -> tuple[Array, float]:
        """
        Work out what moved the wheels since the last tick, and how little that is known.

        :returns: (4,) If dOmega/dt relative to the links [N m]; density of a random walk
            [N m/sqrt(s)], 0 where it was measured.
        """
        before, self._wheels = self._wheels, None
        if speeds.size:
            # A mean over the period is the speed in its middle: half a period on.
            last = speeds + 0.5 * (speeds - before.mean) if before is not None else speeds
            self._wheels = _Wheels(speeds, last)
        if last_ns is None:
            return np.zeros(4), 0.0
        if self._wheels is not None and before is not None:
            self.driven_by = BY_SPEED
            elapsed = (stamp_ns - last_ns) * 1e-9
            return self._inertias * (self._wheels.last - before.last) / elapsed, 0.0
        if efforts.size:
            self.driven_by, given = BY_EFFORT, efforts
        elif self._commanded is not None and stamp_ns - self._commanded[0] <= LONGEST_COMMAND_NS:
            self.driven_by, given = BY_COMMAND, self._commanded[1]
        else:
            self.driven_by = BY_NOTHING
            return np.zeros(4), self._unknown
        # The wheel has the link's acceleration already.
        return given - self._inertias * self._accelerations(), self._unknown

    def _accelerations(self) -> Array:
        """Tell how the links were accelerated lately (4,) [rad/s^2]."""
        if self._last_rates is None or not self._history:
            return np.zeros(4)
        period = self._history[-1]
        memory = period.before
        if memory.snapshot is None or period.from_ns is None:
            return np.zeros(4)
        rates: Array = self._last_rates - memory.snapshot[0][RATES]
        return rates / ((period.to_ns - period.from_ns) * 1e-9)

    def _sort_in(self) -> tuple[int, list[Measurement]]:
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
            ahead_ns = measurement.stamp_ns - history[-1].to_ns
            if ahead_ns > LONGEST_GAP_NS:
                self.reject(RejectedError(
                    'future', f'measured {ahead_ns * 1e-9:g} s after the tick, limit '
                              f'{LONGEST_GAP_NS * 1e-9:g} s'))
            elif ahead_ns > 0:
                waiting.append(measurement)
            elif measurement.stamp_ns > oldest_ns:
                n = self._period_of(measurement.stamp_ns)
                insort(history[n].measurements, measurement, key=Measurement.in_time)
                arrived.append(measurement)
                changed = min(changed, n)
            else:
                self.reject(RejectedError('late', 'measured before all that is remembered'))
        self._pending = waiting
        return changed, arrived

    def _period_of(self, stamp_ns: int) -> int:
        """Return the number of the kept period that a stamp belongs to."""
        n = len(self._history) - 1
        while n > 0 and stamp_ns <= self._history[n - 1].to_ns:
            n -= 1
        return n

    def _relive(self, first: int, arrived: list[Measurement]) -> Innovation | None:
        """
        Bring the filter from the beginning of a period to the last tick.

        :param first: number of the period.
        :param arrived: measurements that the filter has not seen before, the oldest in it.
        :returns: innovation of the newest of these that corrected the filter.
        """
        self.waiting_for = self._what_is_missing()
        period = self._history[first]
        now_ns = period.from_ns
        if first < len(self._history) - 1:
            if period.reached is not None and arrived[0].stamp_ns == period.to_ns:
                # All else in that period is as it was.
                self._recall(period.reached)
                now_ns = period.to_ns
            else:
                self._recall(period.before)
        innovation = None
        for n in range(first, len(self._history)):
            period = self._history[n]
            if n > first:
                period.before, now_ns = self._remember(), period.from_ns
            innovation = self._live(period, now_ns, arrived) or innovation
        return innovation

    def _live(self, period: _Period, now_ns: int | None, arrived: list[Measurement]
              ) -> Innovation | None:
        """Bring the filter through a period, from a time in it; parameters as of _relive."""
        innovation, to_ns = None, period.to_ns
        skipped = now_ns == to_ns
        for measurement in period.measurements:
            stamp_ns = measurement.stamp_ns
            if skipped and stamp_ns < to_ns:
                continue
            if stamp_ns == to_ns and now_ns != to_ns:
                self._move(period, now_ns, to_ns)
                now_ns, period.reached = to_ns, self._remember()
            elif stamp_ns != to_ns:
                self._move(period, now_ns, stamp_ns)
                now_ns = stamp_ns
            seen = self._use(measurement)
            if seen is not None and any(new is measurement for new in arrived):
                innovation = Innovation(
                    measurement.sensors, seen.innovation, seen.squares, seen.used, seen.nis)
                self._seen.append((measurement, seen))
        if now_ns != to_ns:
            self._move(period, now_ns, to_ns)
            period.reached = self._remember()
        return innovation

    def _move(self, period: _Period, from_ns: int | None, to_ns: int) -> None:
        if self._filter is not None and from_ns is not None and from_ns < to_ns:
            self._filter.move((to_ns - from_ns) * 1e-9, period.torques, period.unknown)

    def _take_note(self) -> None:
        """
        Take note of what became of the samples that the last tick saw for the first time.

        Whoever waits for the estimate need not wait for this.
        """
        for measurement, seen in self._seen:
            for sensor, fate, square in zip(
                    measurement.sensors, seen.fate.tolist(), seen.squares.tolist()):
                if fate == REFUSED:
                    self._gated[sensor_name(sensor)] += 1
                if sensor < GYROS:
                    self._health.judged(sensor, square > self._gate)
                    reason = {REFUSED: GATED, LEFT_OUT: FAULTY}.get(fate, ACCEPTED)
                    self._told[sensor] = Decision(sensor, reason, square)
                    self._decisions.setdefault(sensor, Decision(sensor, NO_DATA))
        self._seen.clear()

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

    def _use(self, measurement: Measurement) -> Correction | None:
        """Correct the filter, or start it."""
        if self._filter is None:
            self._start(self._with_those_before(measurement))
            return None
        seen = self._filter.correct(
            measurement.sensors, measurement.values, self._variances_for(measurement.sensors),
            self._gate)
        used = int(seen.used.sum())
        if used:
            self._corrected_ns = max(self._corrected_ns, measurement.stamp_ns)
        if 2 * used >= len(seen.fate):
            self._misfits = 0
        else:
            self._misfits += 1
            if self._misfits >= LOST_AFTER:
                # If this one does not tell enough, the wheels carry on.
                self._start(self._with_those_before(measurement))
        return seen

    def _with_those_before(self, measurement: Measurement) -> Measurement:
        """Add what others measured just before, where one measurement tells too little."""
        for sensor, value in measurement.angles().items():
            self._before[sensor] = measurement.stamp_ns, value
        if np.isfinite(measurement.link_angles()).sum() >= 3:
            return measurement
        together = {sensor: value for sensor, (stamp_ns, value) in sorted(self._before.items())
                    if 0 <= measurement.stamp_ns - stamp_ns <= TOGETHER_NS}
        return Measurement(
            measurement.stamp_ns, tuple(together), np.array(list(together.values())))

    def _variances_for(self, sensors: tuple[int, ...]) -> Array:
        found = self._variances_of.get(sensors)
        if found is None:
            found = self._variances_of[sensors] = self._variances[list(sensors)]
        return found

    def _start(self, measurement: Measurement) -> None:
        """Start the filter from a sample, if it determines the configuration."""
        measured = measurement.link_angles()
        if np.isfinite(measured).sum() < 3:
            return
        try:
            start = self._assembled(measured)
        except ClosureError as error:
            self.waiting_for = f'link angles that fit together: {error}'
            return
        if self._last_angles is not None:
            # On the turn that everybody has seen it on.
            start += 2.0 * pi * np.round((self._last_angles - start) / (2.0 * pi))
        self._filter = LinkageFilter(
            self._mechanism, start, INITIAL_ANGLE_SIGMA ** 2, INITIAL_RATE_SIGMA ** 2,
            self._settings.randomness)
        self._filter.correct(
            measurement.sensors, measurement.values, self._variances_for(measurement.sensors))
        self._corrected_ns, self._lost = measurement.stamp_ns, False
        self.starts += 1
        self._misfits = 0

    def _assembled(self, measured: Array) -> Array:
        """
        Return link angles on the closure that are near measured ones.

        :param measured: (4,), one of them NaN where it is not known [rad].
        :raises ClosureError: there are none.
        """
        if abs(sin(measured[3] - measured[2])) < REDUCED_FORM_LIMIT:
            # Two angles do not tell the others here, but four tell what they are.
            near, rates = tuple(measured.tolist()), (0.0, 0.0, 0.0, 0.0)
            constants = self._mechanism.with_rigid_joints().constants
            exact = self._settings.closure_tolerance == 0.0
            for _ in range(NEWTON_STEPS):
                near, _ = project_onto_closure(near, rates, constants, exact)
            if np.abs(near - measured).max() < ASSEMBLY_DISTANCE:
                return np.array(near)
        known = [link for link in range(4) if isfinite(measured[link])]
        found: list[Array] = []
        failure = None
        # Opposite links of a parallelogram say the same, and folded ones leave the others free.
        for first, second in combinations(known, 2):
            try:
                found += assemblies(self._mechanism, (first, second),
                                    (measured[first], measured[second]), np.nan_to_num(measured))
            except ClosureError as error:
                failure = failure or error
        best, farthest = None, max(ASSEMBLY_DISTANCE, 10.0 * self._settings.angle_noise)
        for angles in found:
            off = float(np.abs(wrap_angles(angles - measured)[known]).max())
            if off < farthest:
                best, farthest = angles, off
        if best is None:
            raise failure or ClosureError(
                f'no assembly is within {farthest:.2g} rad of what was measured')
        return best

    def _check_time(self, measurement: Measurement) -> None:
        """Refuse what comes too late, and what came already."""
        stamp_ns, known = measurement.stamp_ns, self._pending
        if self._stamp_ns is not None and 0 <= self._stamp_ns - stamp_ns < LONGEST_GAP_NS:
            if self._stamp_ns - stamp_ns > HISTORY_NS:
                raise RejectedError('late', f'measured {(self._stamp_ns - stamp_ns) * 1e-9:g} s '
                                            f'before the last tick, limit {HISTORY_NS * 1e-9:g} s')
            known = known + self._history[self._period_of(stamp_ns)].measurements
        for other in known:
            if other.stamp_ns == stamp_ns and not set(measurement.sensors).isdisjoint(
                    other.sensors):
                raise RejectedError('repeated', 'a sample with this stamp was there already')

    def _check_tick(self, stamp_ns: int, speeds: Array, efforts: Array) -> None:
        for quantity, values in (('velocities', speeds), ('efforts', efforts)):
            if values.size and not (values.shape == (4,) and all(map(isfinite, values.tolist()))):
                raise RejectedError('wheels', f'flywheel_states must hold four finite {quantity}')
        if self._stamp_ns is not None and 0 <= self._stamp_ns - stamp_ns < LONGEST_GAP_NS:
            raise RejectedError('stamp', 'tick is not newer than the last one')


def _off_by(error: float, others: list[str]) -> str:
    """Say how far a sensor is off [rad], or one of the others is."""
    said = f'off by {np.degrees(error):.2g} deg'
    return f'{said}, or {" or ".join(others)} is' if others else said
