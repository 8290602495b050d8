# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Detection of sensor faults from the samples alone.

Faults are silence, lost, slow or late samples, a repeated value, and many gated samples. A frozen
sample fits a filter better than a noisy one. While the linkage rests, no test of innovations
detects it, but a comparison of the samples does.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from fourbar_ros.mechanism import SENSOR_NAMES

# Time without a sample after which a sensor is silent [ns].
SILENT_AFTER_NS = 200_000_000

# Number of equal samples in a row of a stuck sensor, if each other sensor has changed within fewer
# samples than the second number: then there is noise, and this sensor should have some, too.
STUCK_AFTER = 50
CHANGED_WITHIN = 10

# Fraction of gated samples of a sensor that is far off, and the number of samples of this mean. A
# few samples of a healthy sensor are gated, too.
GATED_SHARE = 0.2
GATED_SAMPLES = 25

# A sensor loses samples when the time between two samples is on average this many times its least
# value. Number of samples of this mean, and largest ratio that one gap counts: silence is another
# fault.
LOSS_RATIO = 1.25
GAP_SAMPLES = 50
LARGEST_GAP_RATIO = 3.0

# Samples are slow when they arrive later than those of the quickest sensor by this time [ns], and
# the number of samples of this mean.
SLOW_BY_NS = 20_000_000
SLOW_SAMPLES = 10

SILENT, REPEATS, FAR_OFF = 'no data', 'repeats one value', 'samples far off'
LOSSES, SLOW, TOO_LATE = 'loses samples', 'samples come late', 'samples come too late'


@dataclass
class _Sensor:
    """
    Statistics of one sensor.

    :ivar newest_ns: newest stamp, None before the first sample [ns].
    :ivar value: last sample [rad].
    :ivar equal: number of equal samples in a row.
    :ivar gated: mean fraction of gated samples.
    :ivar least_gap_ns: least time between two samples [ns].
    :ivar gap_ratio: mean time between two samples over the least one.
    :ivar lag_ns: mean time from stamp to arrival [ns].
    :ivar too_late_ns: last arrival of a sample that was too late [ns].
    """

    newest_ns: int | None = None
    value: float = 0.0
    equal: int = 0
    gated: float = 0.0
    least_gap_ns: int | None = None
    gap_ratio: float = 1.0
    lag_ns: float = inf
    too_late_ns: int | None = None


class SensorFaultDetector:
    """Detects faults of all sensors; a sensor without any sample does not exist."""

    def __init__(self) -> None:
        self._sensors = [_Sensor() for _ in SENSOR_NAMES]

    def add_sample(self, stamp_ns: int, sensor: int, angle: float,
                   arrived_ns: int | None = None) -> None:
        """
        Add a sample.

        :param stamp_ns: time of measurement [ns].
        :param sensor: index of `SENSOR_NAMES`.
        :param angle: as received [rad].
        :param arrived_ns: last tick on arrival, None for the time of measurement [ns].
        """
        state = self._sensors[sensor]
        lag_ns = 0 if arrived_ns is None else arrived_ns - stamp_ns
        state.lag_ns = (lag_ns if state.lag_ns == inf
                        else state.lag_ns + (lag_ns - state.lag_ns) / SLOW_SAMPLES)
        if state.newest_ns is None or angle != state.value:
            state.value, state.equal = angle, 1
        else:
            state.equal += 1
        if state.newest_ns is None:
            state.newest_ns = stamp_ns
        elif stamp_ns > state.newest_ns:
            gap_ns, state.newest_ns = stamp_ns - state.newest_ns, stamp_ns
            if state.least_gap_ns is None or gap_ns < state.least_gap_ns:
                state.least_gap_ns = gap_ns
            ratio = min(gap_ns / state.least_gap_ns, LARGEST_GAP_RATIO)
            state.gap_ratio += (ratio - state.gap_ratio) / GAP_SAMPLES

    def add_late(self, now_ns: int, sensor: int) -> None:
        """Add a sample that arrived too late for the filter [ns]."""
        self._sensors[sensor].too_late_ns = now_ns

    def add_gate_result(self, sensor: int, gated: bool) -> None:
        """Add the result of the gate for a sample."""
        state = self._sensors[sensor]
        state.gated += (gated - state.gated) / GATED_SAMPLES

    def stuck(self, sensor: int) -> bool:
        """
        Tell whether a sensor repeats one value while all other sensors change.

        Where several repeat their values, links are at rest and sensors have no noise.
        """
        return self._sensors[sensor].equal >= STUCK_AFTER and all(
            other.equal < CHANGED_WITHIN for n, other in enumerate(self._sensors) if n != sensor)

    def faults(self, now_ns: int) -> dict[str, str]:
        """Return the faults at a time [ns], in words, by the name of the sensor."""
        faults, least_ns = {}, min(state.lag_ns for state in self._sensors)
        for sensor, (name, state) in enumerate(zip(SENSOR_NAMES, self._sensors)):
            if state.too_late_ns is not None and now_ns - state.too_late_ns < SILENT_AFTER_NS:
                faults[name] = TOO_LATE
            elif state.newest_ns is None:
                continue
            elif now_ns - state.newest_ns > SILENT_AFTER_NS:
                faults[name] = SILENT
            elif self.stuck(sensor):
                faults[name] = REPEATS
            elif state.gated > GATED_SHARE:
                faults[name] = FAR_OFF
            elif state.gap_ratio > LOSS_RATIO:
                faults[name] = LOSSES
            elif state.lag_ns > least_ns + SLOW_BY_NS:
                faults[name] = SLOW
        return faults
