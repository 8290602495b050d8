# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimator: measured angles and ticks in, one estimate per tick out.

It checks the inputs, feeds the filter (estimation.retrodiction), and keeps the status of the
sensors.
"""

from __future__ import annotations

from bisect import insort
from collections import Counter
from collections.abc import Sequence
from math import isfinite, pi

from fourbar_ros.common.named_values import RejectedError
from fourbar_ros.estimation.estimate import (
    Estimate,
    GATED,
    Innovation,
    LATE,
    NO_DATA,
    NOT_FINITE,
    SampleStatus,
    STUCK,
)
from fourbar_ros.estimation.estimator_settings import EstimatorSettings
from fourbar_ros.estimation.filter import LinkageFilter
from fourbar_ros.estimation.filter_state import ANGLES, GYROS, RATES, TORQUES
from fourbar_ros.estimation.measurement import Measurement, read_measurement, sensor_name
from fourbar_ros.estimation.retrodiction import HISTORY_NS, RetrodictionFilter
from fourbar_ros.estimation.sensor_faults import SensorFaultDetector
from fourbar_ros.estimation.wheel_motion import WheelMotion
from fourbar_ros.mechanism import Mechanism, SENSOR_NAMES
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import ArrayLike

# Largest time between two ticks of one run [ns]; a longer one, or a step back, begins a new run.
LONGEST_GAP_NS = 1_000_000_000

# Time without an accepted sample after which the estimate is lost [ns]: until then the wheels
# alone carry it.
LONGEST_BLIND_NS = 1_000_000_000

# Largest number of measurements that wait for their tick: more than ever arrive in one period.
LONGEST_QUEUE = 100

STATE_NAMES = ('phi_a', 'phi_b', 'omega_a', 'omega_b')
"""The free state of the filter, by the names of docs/mechanics.md."""


class Estimator:
    """
    Runs the filter on measurements and ticks.

    :ivar rejected: number of rejected messages by kind.
    :ivar last_rejection: reason of the last rejection, or ''.
    :ivar waiting_for: missing input of a start, or '' while the filter runs.
    """

    def __init__(self, mechanism: Mechanism, settings: EstimatorSettings) -> None:
        self.rejected: Counter[str] = Counter()
        self.last_rejection = ''
        self.waiting_for = 'flywheel_states'
        self._gate = settings.gate
        self._tracker = RetrodictionFilter(mechanism, settings)
        self._wheels = WheelMotion(mechanism)
        self._fault_detector = SensorFaultDetector()
        self._stamp_ns: int | None = None
        self._queue: list[Measurement] = []
        self._last_rates: Array | None = None
        self._lost = False
        self._gated: Counter[str] = Counter()
        # Sample statuses at the last tick, and those for the next one, by sensor.
        self._statuses: dict[int, SampleStatus] = {}
        self._next_statuses: dict[int, SampleStatus] = {}
        self._unrecorded: list[tuple[Measurement, Innovation]] = []
        # Compile the kernels now, not at the first tick.
        square = np.array([0.0, pi / 2.0, 0.0, pi / 2.0])
        linkage = LinkageFilter(mechanism, square, 1.0, 1.0, settings.process_noise)
        linkage.predict(1e-3, np.zeros(4))
        linkage.update((0, 1, 2, 3), square, 1.0, self._gate)

    @property
    def starts(self) -> int:
        """Number of starts of the filter."""
        return self._tracker.starts

    @property
    def driven_by(self) -> str:
        """Source of the wheel motion in the last prediction, see estimation.wheel_motion."""
        return self._wheels.source

    @property
    def gated(self) -> Counter[str]:
        """Number of gated samples by sensor."""
        self._record_statuses()
        return self._gated

    def measure(self, stamp_ns: int, names: Sequence[str], angles: Sequence[float],
                rates: Sequence[float] = ()) -> None:
        """
        Queue measured angles for the next tick at or after their stamp.

        They may arrive in any order, and up to `HISTORY_NS` later than the last tick.

        :param stamp_ns: time of measurement [ns].
        :param names: any of `SENSOR_NAMES`.
        :param angles: orientation of each link, angle in each joint (second link relative to the
            first, any turn) [rad].
        :param rates: of each from its gyro [rad/s], or empty without gyros.
        :raises RejectedError: unusable; nothing of the message is used. Also counted.
        """
        try:
            measurement = read_measurement(stamp_ns, names, angles, rates)
            self._check_time(measurement)
        except RejectedError as error:
            self.reject(error)
            status = {'finite': NOT_FINITE, 'late': LATE}.get(error.kind)
            if status is not None:
                self._set_statuses(names, status)
            raise
        if usable := self._without_stuck(measurement):
            insort(self._queue, usable, key=Measurement.in_time)
            del self._queue[:-LONGEST_QUEUE]

    def set_command(self, efforts: Sequence[float]) -> None:
        """
        Set the commanded efforts, for ticks without speeds and efforts of the wheels.

        :param efforts: (4,) torques on the wheels [N m]; unusable ones are ignored.
        """
        self._wheels.set_command(self._stamp_ns or 0, efforts)

    def tick(self, stamp_ns: int, wheel_speeds: ArrayLike, wheel_efforts: ArrayLike = ()
             ) -> Estimate | None:
        """
        Advance to a tick.

        The speeds drive the prediction; without speeds the efforts, without efforts the command.

        :param wheel_speeds: (4,) measured, relative to the links, mean over the time since the
            last tick [rad/s]; or empty.
        :param wheel_efforts: (4,) torques on the wheels in that time [N m]; or empty.
        :returns: the estimate, None before a start.
        :raises RejectedError: the tick is not newer than the last one, or speeds or efforts are
            neither four numbers nor empty; also counted.
        """
        speeds, efforts = np.array(wheel_speeds, float), np.array(wheel_efforts, float)
        try:
            self._check_tick(stamp_ns, speeds, efforts)
        except RejectedError as error:
            self.reject(error)
            raise
        self._record_statuses()
        self._statuses, self._next_statuses = self._next_statuses, {
            sensor: SampleStatus(sensor, NO_DATA) for sensor in self._next_statuses}
        self._open_period(stamp_ns, speeds, efforts)
        self._unrecorded = self._tracker.process(self._take_from_queue(stamp_ns))
        linkage = self._tracker.filter
        if linkage is not None:
            self._lost = stamp_ns - self._tracker.updated_ns > LONGEST_BLIND_NS
            if self._lost:
                self._tracker.discard()
                linkage = None
        if linkage is None:
            self.waiting_for = self._tracker.start_error or (
                f'link_angles: the estimate is lost after {LONGEST_BLIND_NS * 1e-9:g} s without '
                'an accepted sample' if self._lost
                else 'link_angles that determine three of the four links')
            return None
        self.waiting_for = ''
        return self._estimate(linkage, stamp_ns)

    def reset(self) -> None:
        """Discard the estimate; the next measurement starts the filter on the same turn."""
        self._queue.clear()
        self._tracker.discard()

    def reject(self, error: RejectedError) -> None:
        """Count a rejected message."""
        self.rejected[error.kind] += 1
        self.last_rejection = str(error)

    def sample_statuses(self) -> tuple[SampleStatus, ...]:
        """Return the status at the last tick of each sensor that has sent a message."""
        self._record_statuses()
        return tuple(self._statuses.values())

    def sensor_faults(self) -> dict[str, str]:
        """Return the faults of sensors at the last tick, in words, by name."""
        self._record_statuses()
        if self._stamp_ns is None:
            return {}
        faults, linkage = self._fault_detector.faults(self._stamp_ns), self._tracker.filter
        if linkage is None:
            return faults
        for sensor, bias in linkage.faulty().items():
            faults.setdefault(SENSOR_NAMES[sensor], _bias_text(bias, []))
        suspected = {SENSOR_NAMES[sensor]: bias for sensor, bias in linkage.suspected().items()}
        if faults.keys().isdisjoint(suspected):
            # Otherwise the fault of one of them explains the others.
            faults |= {name: _bias_text(bias, [other for other in suspected if other != name])
                       for name, bias in suspected.items()}
        return faults

    def glr_statistics(self) -> dict[str, float]:
        """
        Return the GLR statistic of a bias of each sensor, by name.

        :returns: log-likelihood ratio of a bias to none [nats]; empty without estimate.
        """
        linkage = self._tracker.filter
        return {} if linkage is None else dict(
            zip(SENSOR_NAMES, linkage.glr_statistics().tolist()))

    def _estimate(self, linkage: LinkageFilter, stamp_ns: int) -> Estimate:
        x, sigmas = linkage.x.copy(), linkage.sigmas()
        self._tracker.last_angles, self._last_rates = x[ANGLES], x[RATES]
        return Estimate(
            stamp_ns, x[ANGLES], x[RATES], sigmas[ANGLES], sigmas[RATES], linkage.free_covariance,
            x[TORQUES], sigmas[TORQUES], linkage.gyro_biases,
            self._unrecorded[-1][1] if self._unrecorded else None)

    def _open_period(self, stamp_ns: int, speeds: Array, efforts: Array) -> None:
        """Open the period that ends with a tick; after a gap, begin a new run."""
        last_ns = self._stamp_ns
        if last_ns is not None and not 0 < stamp_ns - last_ns <= LONGEST_GAP_NS:
            last_ns = self._last_rates = None
            self._tracker.clear()
            self._wheels.restart()
            self._fault_detector = SensorFaultDetector()
            self._statuses.clear()
            self._next_statuses.clear()
        self._stamp_ns = stamp_ns
        self._tracker.open_period(last_ns, stamp_ns, self._wheels.torques(
            last_ns, stamp_ns, speeds, efforts,
            lambda: self._tracker.accelerations(self._last_rates)))

    def _take_from_queue(self, now_ns: int) -> list[Measurement]:
        """Take the measurements up to the tick, except for those that are too late."""
        due, waiting = [], []
        for measurement in self._queue:
            ahead_ns = measurement.stamp_ns - now_ns
            if ahead_ns > LONGEST_GAP_NS:
                self.reject(RejectedError(
                    'future', f'measured {ahead_ns * 1e-9:g} s after the tick, limit '
                              f'{LONGEST_GAP_NS * 1e-9:g} s'))
            elif ahead_ns > 0:
                waiting.append(measurement)
            elif measurement.stamp_ns > self._tracker.oldest_ns:
                due.append(measurement)
            else:
                self.reject(RejectedError('late', 'measured before the history begins'))
        self._queue = waiting
        return due

    def _without_stuck(self, measurement: Measurement) -> Measurement | None:
        """Show the samples to the fault detector, and leave out those of a stuck sensor."""
        stuck, stamp_ns = set(), measurement.stamp_ns
        arrived_ns = stamp_ns if self._stamp_ns is None else max(stamp_ns, self._stamp_ns)
        for sensor, angle in measurement.angles().items():
            self._fault_detector.add_sample(stamp_ns, sensor, angle, arrived_ns)
            if self._fault_detector.stuck(sensor):
                stuck.add(sensor)
                self._next_statuses[sensor] = SampleStatus(sensor, STUCK)
        return measurement.without(stuck) if stuck else measurement

    def _set_statuses(self, names: Sequence[str], status: int) -> None:
        """Set the status of the sensors of a rejected message."""
        for name in names:
            if name in SENSOR_NAMES:
                sensor = SENSOR_NAMES.index(name)
                self._next_statuses[sensor] = SampleStatus(sensor, status)
                if status == LATE and self._stamp_ns is not None:
                    self._fault_detector.add_late(self._stamp_ns, sensor)

    def _record_statuses(self) -> None:
        """
        Record the status of the samples that the last tick processed for the first time.

        Not in the tick itself, whose estimate should not wait for it.
        """
        for measurement, innovation in self._unrecorded:
            for sensor, status, nis in zip(measurement.sensors, innovation.statuses.tolist(),
                                           innovation.sample_nis.tolist()):
                if status == GATED:
                    self._gated[sensor_name(sensor)] += 1
                if sensor < GYROS:
                    self._fault_detector.add_gate_result(sensor, nis > self._gate)
                    self._statuses[sensor] = SampleStatus(sensor, status, nis)
                    self._next_statuses.setdefault(sensor, SampleStatus(sensor, NO_DATA))
        self._unrecorded = []

    def _check_time(self, measurement: Measurement) -> None:
        """Reject a measurement that is too late or repeated."""
        stamp_ns, known = measurement.stamp_ns, self._queue
        if self._stamp_ns is not None and 0 <= self._stamp_ns - stamp_ns < LONGEST_GAP_NS:
            if self._stamp_ns - stamp_ns > HISTORY_NS:
                raise RejectedError('late', f'measured {(self._stamp_ns - stamp_ns) * 1e-9:g} s '
                                            f'before the last tick, limit {HISTORY_NS * 1e-9:g} s')
            known = known + self._tracker.measurements_around(stamp_ns)
        for other in known:
            if other.stamp_ns == stamp_ns and not set(measurement.sensors).isdisjoint(
                    other.sensors):
                raise RejectedError('repeated', 'a sample with this stamp was received before')

    def _check_tick(self, stamp_ns: int, speeds: Array, efforts: Array) -> None:
        for quantity, values in (('velocities', speeds), ('efforts', efforts)):
            if values.size and not (values.shape == (4,) and all(map(isfinite, values.tolist()))):
                raise RejectedError('wheels', f'flywheel_states must hold four finite {quantity}')
        if self._stamp_ns is not None and 0 <= self._stamp_ns - stamp_ns < LONGEST_GAP_NS:
            raise RejectedError('stamp', 'the tick is not newer than the last one')


def _bias_text(bias: float, others: list[str]) -> str:
    """Return the fault of a biased sensor [rad] in words, with the others it may be instead."""
    text = f'off by {np.degrees(bias):.2g} deg'
    return f'{text}, or {" or ".join(others)} is' if others else text
