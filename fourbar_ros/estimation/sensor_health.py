# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What is wrong with a sensor, as far as its samples tell.

A sensor that gives nothing or loses samples, one that repeats one value, and one whose samples the
gate refuses. A frozen sample fits a filter better than a noisy one, so no test of innovations
finds it while the linkage rests: that it is the same bit for bit does.
"""

from __future__ import annotations

from math import inf

from fourbar_ros.mechanism import SENSOR_NAMES

# A sensor without a sample for so long gives no data [ns].
SILENT_AFTER_NS = 200_000_000

# So many equal samples in a row mean that a sensor is stuck, if each of the others has changed
# within so many: then there is noise, and it should be in this one, too.
STUCK_AFTER = 50
LIVELY = 10

# The samples of a sensor are far off when the gate refuses more than this share of them, over the
# last so many. It refuses some of a healthy one, too.
REFUSED_SHARE = 0.2
REFUSED_OVER = 25

# A sensor loses samples when the time between two of them is on the mean so many times its least,
# over the last so many; a gap counts as this much at the most, since silence is another matter.
GAPPY, GAPS_OVER, LONGEST_GAP = 1.25, 50, 3.0

# Samples of a sensor come late when they take so much longer than those of the others [ns], over
# the last so many.
SLOW_BY_NS, SLOW_OVER = 20_000_000, 10

SILENT, STUCK, FAR_OFF = 'no data', 'repeats one value', 'samples far off'
LOSES, SLOW, TOO_LATE = 'loses samples', 'samples come late', 'samples come too late'


class SensorHealth:
    """Watches the samples of all sensors; those that never gave one do not count."""

    def __init__(self) -> None:
        count = len(SENSOR_NAMES)
        self._newest_ns: list[int | None] = [None] * count
        self._value = [0.0] * count
        self._equal = [0] * count
        self._refused = [0.0] * count
        self._least_gap_ns: list[int | None] = [None] * count
        self._gap = [1.0] * count
        self._lag_ns = [inf] * count
        self._too_late_ns: list[int | None] = [None] * count

    def sample(self, stamp_ns: int, sensor: int, angle: float, arrived_ns: int | None = None
               ) -> None:
        """
        Take note of a sample.

        :param stamp_ns: time of measurement [ns].
        :param sensor: index of `SENSOR_NAMES`.
        :param angle: as it came [rad].
        :param arrived_ns: the last tick when it came, None for the time of measurement [ns].
        """
        lag_ns = 0 if arrived_ns is None else arrived_ns - stamp_ns
        before_ns = self._lag_ns[sensor]
        self._lag_ns[sensor] = (
            lag_ns if before_ns == inf else before_ns + (lag_ns - before_ns) / SLOW_OVER)
        newest_ns = self._newest_ns[sensor]
        if newest_ns is None or angle != self._value[sensor]:
            self._value[sensor], self._equal[sensor] = angle, 1
        else:
            self._equal[sensor] += 1
        if newest_ns is None:
            self._newest_ns[sensor] = stamp_ns
        elif stamp_ns > newest_ns:
            self._newest_ns[sensor] = stamp_ns
            self._note_gap(sensor, stamp_ns - newest_ns)

    def _note_gap(self, sensor: int, gap_ns: int) -> None:
        least_ns = self._least_gap_ns[sensor]
        if least_ns is None or gap_ns < least_ns:
            self._least_gap_ns[sensor] = least_ns = gap_ns
        self._gap[sensor] += (min(gap_ns / least_ns, LONGEST_GAP) - self._gap[sensor]) / GAPS_OVER

    def too_late(self, now_ns: int, sensor: int) -> None:
        """Take note of a sample that came too late to be of use [ns]."""
        self._too_late_ns[sensor] = now_ns

    def judged(self, sensor: int, refused: bool) -> None:
        """Take note of what the gate made of a sample."""
        self._refused[sensor] += (refused - self._refused[sensor]) / REFUSED_OVER

    def stuck(self, sensor: int) -> bool:
        """
        Tell whether a sensor repeats one value while all the others do not.

        Where more of them repeat theirs, links rest under sensors without noise.
        """
        return self._equal[sensor] >= STUCK_AFTER and all(
            equal < LIVELY for other, equal in enumerate(self._equal) if other != sensor)

    def faults(self, now_ns: int) -> dict[str, str]:
        """Tell what is wrong now [ns]: a few words by the name of the sensor."""
        found, least_ns = {}, min(self._lag_ns)
        for sensor, name in enumerate(SENSOR_NAMES):
            newest_ns, late_ns = self._newest_ns[sensor], self._too_late_ns[sensor]
            if late_ns is not None and now_ns - late_ns < SILENT_AFTER_NS:
                found[name] = TOO_LATE
            elif newest_ns is None:
                continue
            elif now_ns - newest_ns > SILENT_AFTER_NS:
                found[name] = SILENT
            elif self.stuck(sensor):
                found[name] = STUCK
            elif self._refused[sensor] > REFUSED_SHARE:
                found[name] = FAR_OFF
            elif self._gap[sensor] > GAPPY:
                found[name] = LOSES
            elif self._lag_ns[sensor] > least_ns + SLOW_BY_NS:
                found[name] = SLOW
        return found
