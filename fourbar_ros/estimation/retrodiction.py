# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Processing of late measurements: each acts at its stamp, whenever it arrives.

The history keeps, for the ticks of the last tenth of a second, a checkpoint of the filter, the
torques on the wheels and the measurements in between. A late measurement restores the checkpoint
before its stamp, and the filter processes everything from there on again (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, out-of-sequence measurements:
the exact solution). So the estimate depends on what has arrived, and neither on when nor in which
order.
"""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass
from math import pi
from typing import NamedTuple

from fourbar_ros.estimation.acquisition import acquire_angles, RecentAngles
from fourbar_ros.estimation.estimate import Innovation
from fourbar_ros.estimation.estimator_settings import EstimatorSettings
from fourbar_ros.estimation.filter import LinkageFilter, Snapshot
from fourbar_ros.estimation.filter_state import RATES
from fourbar_ros.estimation.measurement import Measurement
from fourbar_ros.estimation.wheel_motion import WheelTorques
from fourbar_ros.mechanism import ClosureError, Mechanism
from fourbar_ros.mechanism.constants import Array
import numpy as np

# Largest age of a measurement on arrival, against the last tick [ns].
HISTORY_NS = 100_000_000

# Number of successive measurements with most samples gated after which the filter restarts.
RESTART_AFTER = 10

# Initial standard deviations of the filter: of the angles [rad], so large that the first sample
# determines them, and of the rates, which are unknown [rad/s].
INITIAL_ANGLE_SIGMA = 0.5
INITIAL_RATE_SIGMA = 10.0


class _Checkpoint(NamedTuple):
    """The filter with a snapshot of it, if there is one, and the counters that a run changes."""

    linkage_filter: LinkageFilter | None
    snapshot: Snapshot | None
    gated_in_a_row: int
    starts: int


@dataclass(eq=False)
class _Period:
    """
    The time between two ticks.

    :param from_ns: the earlier tick, None for the first period [ns].
    :param to_ns: the later tick [ns].
    :param wheels: torques on the wheels in between.
    :param measurements: with stamps after the earlier tick up to the later one, in order.
    :param begin: checkpoint at the earlier tick.
    :param end: checkpoint at the later tick, before the measurements with its stamp.
    """

    from_ns: int | None
    to_ns: int
    wheels: WheelTorques
    measurements: list[Measurement]
    begin: _Checkpoint
    end: _Checkpoint | None = None


class RetrodictionFilter:
    """
    The filter with its history.

    :ivar filter: at the last tick, None without estimate.
    :ivar starts: number of starts of the filter.
    :ivar updated_ns: stamp of the newest measurement with an accepted sample [ns].
    :ivar start_error: reason why the last start failed, or ''.
    :ivar last_angles: (4,) last estimate [rad], None in a new run; a start stays on its turn.
    """

    def __init__(self, mechanism: Mechanism, settings: EstimatorSettings) -> None:
        self.filter: LinkageFilter | None = None
        self.starts = 0
        self.updated_ns = 0
        self.start_error = ''
        self.last_angles: Array | None = None
        self._mechanism, self._settings = mechanism, settings
        self._gate, self._variances = settings.gate, settings.variances
        self._variances_of: dict[tuple[int, ...], Array] = {}
        self._recent = RecentAngles()
        self._periods: list[_Period] = []
        self._gated_in_a_row = 0

    @property
    def oldest_ns(self) -> int:
        """Measurements up to this stamp are too late [ns]."""
        first = self._periods[0]
        return first.to_ns - HISTORY_NS if first.from_ns is None else first.from_ns

    def clear(self) -> None:
        """Forget everything: the next period begins a new run."""
        self._periods.clear()
        self.filter = self.last_angles = None

    def discard(self) -> None:
        """Discard the estimate, also for late measurements."""
        self.filter, self._gated_in_a_row = None, 0
        if self._periods:
            last = self._periods[-1]
            last.measurements.clear()
            last.begin, last.end = self._checkpoint(), None
            self._periods[:] = [last]

    def open_period(self, from_ns: int | None, to_ns: int, wheels: WheelTorques) -> None:
        """Append the period that ends with a tick [ns]."""
        self._periods.append(_Period(from_ns, to_ns, wheels, [], self._checkpoint()))

    def accelerations(self, rates: Array | None) -> Array:
        """
        Return the mean accelerations of the links over the last period (4,) [rad/s^2].

        :param rates: (4,) at its end [rad/s], or None if unknown.
        """
        if rates is None or not self._periods:
            return np.zeros(4)
        period = self._periods[-1]
        if period.begin.snapshot is None or period.from_ns is None:
            return np.zeros(4)
        change: Array = rates - period.begin.snapshot.x[RATES]
        return change / ((period.to_ns - period.from_ns) * 1e-9)

    def measurements_around(self, stamp_ns: int) -> list[Measurement]:
        """Return the processed measurements of the period of a stamp [ns]."""
        return self._periods[self._index_of(stamp_ns)].measurements

    def process(self, arrived: list[Measurement]) -> list[tuple[Measurement, Innovation]]:
        """
        Bring the filter to the last tick.

        :param arrived: new measurements in order, none later than the tick or too late.
        :returns: those of them that updated the filter, with their innovations, oldest first.
        """
        self.start_error = ''
        periods = self._periods
        first = len(periods) - 1
        for measurement in arrived:
            index = self._index_of(measurement.stamp_ns)
            insort(periods[index].measurements, measurement, key=Measurement.in_time)
            first = min(first, index)
        period = periods[first]
        now_ns = period.from_ns
        if first < len(periods) - 1:
            if period.end is not None and arrived[0].stamp_ns == period.to_ns:
                self._restore(period.end)
                now_ns = period.to_ns
            else:
                self._restore(period.begin)
        innovations = self._process_period(period, now_ns, arrived)
        for period in periods[first + 1:]:
            period.begin = self._checkpoint()
            innovations += self._process_period(period, period.from_ns, arrived)
        self._trim()
        return innovations

    def _process_period(self, period: _Period, now_ns: int | None, arrived: list[Measurement]
                        ) -> list[tuple[Measurement, Innovation]]:
        """
        Process the measurements of a period.

        :param now_ns: time of the filter [ns]. At the end of the period, measurements before
            its end have been processed.
        """
        innovations: list[tuple[Measurement, Innovation]] = []
        at_end = now_ns == period.to_ns
        for measurement in period.measurements:
            stamp_ns = measurement.stamp_ns
            if at_end and stamp_ns < period.to_ns:
                continue
            now_ns = self._predict(period, now_ns, stamp_ns)
            innovation = self._update(measurement)
            if innovation is not None and any(new is measurement for new in arrived):
                innovations.append((measurement, innovation))
        self._predict(period, now_ns, period.to_ns)
        return innovations

    def _predict(self, period: _Period, from_ns: int | None, to_ns: int) -> int:
        """Predict within a period, with a checkpoint at its end."""
        if from_ns != to_ns:
            if self.filter is not None and from_ns is not None:
                self.filter.predict((to_ns - from_ns) * 1e-9, *period.wheels)
            if to_ns == period.to_ns:
                period.end = self._checkpoint()
        return to_ns

    def _update(self, measurement: Measurement) -> Innovation | None:
        """Update the filter, or start it."""
        if self.filter is None:
            self._start(self._recent.combine(measurement))
            return None
        innovation = self.filter.update(
            measurement.sensors, measurement.values, self._variances_for(measurement.sensors),
            self._gate)
        used = innovation.degrees_of_freedom
        if used:
            self.updated_ns = max(self.updated_ns, measurement.stamp_ns)
        if 2 * used >= len(measurement.sensors):
            self._gated_in_a_row = 0
        else:
            self._gated_in_a_row += 1
            if self._gated_in_a_row >= RESTART_AFTER:
                # Without a start the wheels alone carry the estimate.
                self._start(self._recent.combine(measurement))
        return innovation

    def _start(self, measurement: Measurement) -> None:
        """Start the filter from a measurement that determines the configuration."""
        measured = measurement.link_angles()
        if np.isfinite(measured).sum() < 3:
            return
        settings = self._settings
        try:
            angles = acquire_angles(self._mechanism, measured, settings.angle_noise,
                                    settings.closure_tolerance == 0.0)
        except ClosureError as error:
            self.start_error = f'consistent link_angles: {error}'
            return
        if self.last_angles is not None:
            angles += 2.0 * pi * np.round((self.last_angles - angles) / (2.0 * pi))
        self.filter = LinkageFilter(
            self._mechanism, angles, INITIAL_ANGLE_SIGMA ** 2, INITIAL_RATE_SIGMA ** 2,
            settings.process_noise)
        self.filter.update(
            measurement.sensors, measurement.values, self._variances_for(measurement.sensors))
        self.updated_ns = measurement.stamp_ns
        self.starts += 1
        self._gated_in_a_row = 0

    def _variances_for(self, sensors: tuple[int, ...]) -> Array:
        variances = self._variances_of.get(sensors)
        if variances is None:
            variances = self._variances_of[sensors] = self._variances[list(sensors)]
        return variances

    def _index_of(self, stamp_ns: int) -> int:
        """Return the index of the period of a stamp [ns]."""
        index = len(self._periods) - 1
        while index > 0 and stamp_ns <= self._periods[index - 1].to_ns:
            index -= 1
        return index

    def _trim(self) -> None:
        """Drop the periods that are too old for any measurement."""
        needed_ns = self._periods[-1].to_ns - HISTORY_NS
        while self._periods[0].to_ns < needed_ns:
            del self._periods[0]

    def _checkpoint(self) -> _Checkpoint:
        return _Checkpoint(self.filter, None if self.filter is None else self.filter.snapshot(),
                           self._gated_in_a_row, self.starts)

    def _restore(self, checkpoint: _Checkpoint) -> None:
        self.filter, self.starts = checkpoint.linkage_filter, checkpoint.starts
        self._gated_in_a_row = checkpoint.gated_in_a_row
        if checkpoint.linkage_filter is not None and checkpoint.snapshot is not None:
            checkpoint.linkage_filter.restore(checkpoint.snapshot)
