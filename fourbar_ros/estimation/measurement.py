# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Measurements: the samples of all sensors with one stamp."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan, nan
from typing import NamedTuple

from fourbar_ros.common.named_values import values_by_name
from fourbar_ros.estimation.filter_state import GYROS
from fourbar_ros.mechanism import JOINT_LINKS, SENSOR_NAMES
from fourbar_ros.mechanism.angles import wrap
from fourbar_ros.mechanism.constants import Array
import numpy as np


class Measurement(NamedTuple):
    """
    Samples with one stamp.

    :param stamp_ns: time of measurement [ns].
    :param sensors: indices of `SENSOR_NAMES`, then from `GYROS` on of their gyros.
    :param values: (m,) angles, wrapped [rad], and rates [rad/s].
    """

    stamp_ns: int
    sensors: tuple[int, ...]
    values: Array

    def in_time(self) -> tuple[int, tuple[int, ...]]:
        """Return the sort key: stamp, then sensors, independent of the order of arrival."""
        return self.stamp_ns, self.sensors

    def angles(self) -> dict[int, float]:
        """Return the angles [rad] by index of `SENSOR_NAMES`."""
        return {sensor: value for sensor, value in zip(self.sensors, self.values.tolist())
                if sensor < GYROS}

    def without(self, sensors: set[int]) -> Measurement | None:
        """Return the measurement without some sensors and their gyros; None if it is empty."""
        kept = [n for n, sensor in enumerate(self.sensors) if sensor % GYROS not in sensors]
        if not kept:
            return None
        return Measurement(
            self.stamp_ns, tuple(self.sensors[n] for n in kept), self.values[kept])

    def link_angles(self) -> Array:
        """Return the link angles that follow without the closure (4,), the others NaN [rad]."""
        measured = self.angles()
        links = [measured.get(link, nan) for link in range(4)]
        # Once around the loop from any link, in both senses.
        for _ in range(3):
            for sensor, (first, second) in enumerate(JOINT_LINKS, 4):
                relative = measured.get(sensor, nan)
                if isnan(links[second]):
                    links[second] = links[first] + relative
                if isnan(links[first]):
                    links[first] = links[second] - relative
        return np.array(links)


def sensor_name(sensor: int) -> str:
    """Return the name of a sensor, or of a gyro, by its index in a measurement."""
    return SENSOR_NAMES[sensor] if sensor < GYROS else f'gyro_{SENSOR_NAMES[sensor - GYROS]}'


def read_measurement(stamp_ns: int, names: Sequence[str], angles: Sequence[float],
                     rates: Sequence[float]) -> Measurement:
    """
    Check the samples of a message, and sort them by sensor.

    :param stamp_ns: time of measurement [ns].
    :param names: any of `SENSOR_NAMES`, in any order.
    :param angles: of each, any turn [rad].
    :param rates: of each from its gyro [rad/s], or empty.
    :raises RejectedError: kinds `length`, `names`, `finite`.
    """
    measured = values_by_name(names, angles, SENSOR_NAMES, 'position')
    sensors = sorted(measured)
    values = [wrap(measured[sensor]) for sensor in sensors]
    if len(rates):
        measured = values_by_name(names, rates, SENSOR_NAMES, 'velocity')
        values += [measured[sensor] for sensor in sensors]
        sensors += [GYROS + sensor for sensor in sensors]
    return Measurement(stamp_ns, tuple(sensors), np.array(values))
