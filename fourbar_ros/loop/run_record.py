# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Record of a run: the messages that the nodes would publish, as arrays and as a table."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence

from fourbar_ros.common import names
from fourbar_ros.control.actuation_cost_sums import ENERGIES
from fourbar_ros.control.wheel_command import WheelCommand
from fourbar_ros.loop.closed_loop import Step
from fourbar_ros.mechanism import JOINT_NAMES, LINK_NAMES, SENSOR_NAMES
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

INNOVATION_STATISTICS = ('nis', 'degrees_of_freedom')
LINKS = tuple('abcd')
# Columns of the table: prefix of their names, topic, field, and suffixes of their names.
COLUMNS = (
    ('flywheel_angle_', names.FLYWHEEL_STATES, 'position', LINKS),
    ('flywheel_speed_', names.FLYWHEEL_STATES, 'velocity', LINKS),
    ('flywheel_effort_', names.FLYWHEEL_STATES, 'effort', LINKS),
    ('true_link_', names.SIM_LINK_STATES, 'position', LINKS),
    ('true_rate_', names.SIM_LINK_STATES, 'velocity', LINKS),
    ('true_flywheel_angle_', names.SIM_FLYWHEEL_STATES, 'position', LINKS),
    ('true_flywheel_speed_', names.SIM_FLYWHEEL_STATES, 'velocity', LINKS),
    ('true_flywheel_effort_', names.SIM_FLYWHEEL_STATES, 'effort', LINKS),
    ('estimate_link_', names.ESTIMATE_LINK_STATES, 'position', LINKS),
    ('estimate_rate_', names.ESTIMATE_LINK_STATES, 'velocity', LINKS),
    ('sigma_link_', names.ESTIMATE_SIGMA, 'position', LINKS),
    ('sigma_rate_', names.ESTIMATE_SIGMA, 'velocity', LINKS),
    ('', names.ESTIMATE_INNOVATION, 'position',
     (*INNOVATION_STATISTICS, *(f'innovation_{kind}{name}' for kind in ('', 'gyro_')
                                for name in (*LINKS, *JOINT_NAMES)))),
    ('disturbance_', names.ESTIMATE_DISTURBANCE, 'position', ('a', 'b', 'sigma_a', 'sigma_b')),
    ('reference_link_', names.REFERENCE, 'position', LINKS),
    ('reference_rate_', names.REFERENCE, 'velocity', LINKS),
    ('error_link_', names.TRACKING_ERROR, 'position', LINKS),
    ('error_rate_', names.TRACKING_ERROR, 'velocity', LINKS),
    ('', names.ENERGY, 'position', ENERGIES),
    ('command_', names.FLYWHEEL_COMMAND, 'effort', LINKS),
    ('command_speed_', names.FLYWHEEL_COMMAND, 'velocity', LINKS),
)

Arrays = dict[str, 'NDArray[np.float64] | NDArray[np.int64]']


class RunRecord:
    """
    Record of the messages of a run.

    Arrays are named `topic.field`. Positions, velocities and efforts are (n, names): one row per
    message, columns in the order of the names of the topic, NaN for a name that a message leaves
    out. `topic.stamp_ns` (n,) are the stamps of the messages, and `topic.tick_ns` (n,) the stamps
    of the ticks with which they were published.

    :param sensor_names: of the link-angle sensors, the order of columns of `link_angles`.
    :ivar tick_stamps_ns: stamps of all recorded ticks [ns].
    """

    def __init__(self, sensor_names: Sequence[str] = LINK_NAMES) -> None:
        self.sensor_names = tuple(sensor_names)
        self.tick_stamps_ns: list[int] = []
        self._stamps: dict[str, tuple[array[int], array[int]]] = {}
        self._values: dict[str, tuple[int, array[float]]] = {}

    def add(self, step: Step) -> None:
        """Record the messages of one tick."""
        samples, now = step.samples, step.samples.stamp_ns
        self.tick_stamps_ns.append(now)
        for sample in samples.links:
            places = [self.sensor_names.index(name) for name in sample.names]
            width = len(self.sensor_names)
            rates = {'velocity': _spread(places, sample.rates, width)} if sample.rates.size else {}
            self._row(names.LINK_ANGLES, sample.stamp_ns, now,
                      position=_spread(places, sample.angles, width), **rates)
        wheels = samples.wheels
        self._row(names.FLYWHEEL_STATES, now, now, position=wheels.angles, velocity=wheels.speeds,
                  effort=wheels.efforts)
        if (truth := samples.truth) is not None:
            self._row(names.SIM_LINK_STATES, now, now, position=truth.link_angles,
                      velocity=truth.link_rates)
            self._row(names.SIM_FLYWHEEL_STATES, now, now, position=truth.wheel_angles,
                      velocity=truth.wheel_speeds, effort=truth.efforts)
        if (estimate := step.estimate) is not None:
            self._row(names.ESTIMATE_LINK_STATES, now, now, position=estimate.link_angles,
                      velocity=estimate.link_rates, effort=estimate.link_torques)
            self._row(names.ESTIMATE_SIGMA, now, now, position=estimate.angle_sigmas,
                      velocity=estimate.rate_sigmas)
            self._row(names.ESTIMATE_DISTURBANCE, now, now, position=np.concatenate(
                [estimate.disturbance, estimate.disturbance_sigmas]))
            if (innovation := estimate.innovation) is not None:
                self._row(names.ESTIMATE_INNOVATION, now, now, position=np.concatenate(
                    [[innovation.nis, innovation.degrees_of_freedom],
                     _spread(innovation.sensors, innovation.values, 2 * len(SENSOR_NAMES))]))
        if (control := step.control) is not None:
            self._command(now, control.command)
            self._row(names.REFERENCE, now, now, position=control.reference_angles,
                      velocity=control.reference_rates)
            self._row(names.TRACKING_ERROR, now, now, position=control.angle_errors,
                      velocity=control.rate_errors)
            self._row(names.ENERGY, now, now, position=control.energies)

    def arrays(self) -> Arrays:
        """Return copies of all arrays by name."""
        arrays: Arrays = {}
        for topic, (stamps, ticks) in self._stamps.items():
            arrays[f'{topic}.stamp_ns'] = np.array(stamps, dtype=np.int64)
            arrays[f'{topic}.tick_ns'] = np.array(ticks, dtype=np.int64)
        for name, (width, values) in self._values.items():
            arrays[name] = np.array(values).reshape(-1, width)
        return arrays

    def table(self) -> tuple[tuple[str, ...], NDArray[np.float64]]:
        """
        Return a table with one row per tick.

        Times count from the first tick [s]. Of several samples of a sensor at one tick the table
        holds the newest. A value that was not published is NaN.

        :returns: names of the columns, and (ticks, columns).
        """
        arrays = self.arrays()
        ticks_ns = np.array(self.tick_stamps_ns, dtype=np.int64)
        first_ns = int(ticks_ns[0]) if len(ticks_ns) else 0
        titles = ['t']
        columns: list[Array] = [np.array(ticks_ns - first_ns, dtype=float)[:, None] / 1e9]
        sensors = len(self.sensor_names)
        measured = np.full((len(ticks_ns), 2 * sensors), np.nan)
        rows = self._ticks_of(names.LINK_ANGLES, arrays)
        for n, row in enumerate(rows):
            angles = arrays['link_angles.position'][n]
            present = np.flatnonzero(~np.isnan(angles))
            measured[row, present] = angles[present]
            measured[row, sensors + present] = (arrays['link_angles.stamp_ns'][n] - first_ns) / 1e9
        titles += [f'measured_{name}' for name in self.sensor_names]
        titles += [f'measured_at_{name}' for name in self.sensor_names]
        columns.append(measured)
        for prefix, topic, field, ends in COLUMNS:
            titles += [f'{prefix}{end}' for end in ends]
            column = np.full((len(ticks_ns), len(ends)), np.nan)
            if f'{topic}.{field}' in arrays:
                column[self._ticks_of(topic, arrays)] = arrays[f'{topic}.{field}']
            columns.append(column)
        return tuple(titles), np.hstack(columns)

    def lines(self) -> Iterator[str]:
        """Yield the lines of the table as CSV: 17 significant digits, NaN as an empty field."""
        titles, table = self.table()
        yield ','.join(titles) + '\n'
        for row in table:
            # Only NaN differs from itself.
            yield ','.join(['%.17g' % value if value == value else ''
                            for value in row.tolist()]) + '\n'

    def _ticks_of(self, topic: str, arrays: Arrays) -> NDArray[np.intp]:
        """Return the index of the tick of each message of a topic."""
        return np.searchsorted(
            np.array(self.tick_stamps_ns), arrays.get(f'{topic}.tick_ns', np.empty(0)))

    def _command(self, now: int, command: WheelCommand) -> None:
        """Record a command: efforts or velocities of the powered wheels."""
        values = np.where(command.powered, command.values, np.nan)
        absent = np.full(len(values), np.nan)
        efforts, velocities = (absent, values) if command.by_speed else (values, absent)
        self._row(names.FLYWHEEL_COMMAND, now, now, effort=efforts, velocity=velocities)

    def _row(self, topic: str, stamp_ns: int, tick_ns: int, **values: Array) -> None:
        if topic not in self._stamps:
            self._stamps[topic] = array('q'), array('q')
            for field, row in values.items():
                self._values[f'{topic}.{field}'] = len(row), array('d')
        stamps, ticks = self._stamps[topic]
        stamps.append(stamp_ns)
        ticks.append(tick_ns)
        for field, row in values.items():
            self._values[f'{topic}.{field}'][1].frombytes(row.tobytes())


def _spread(places: Sequence[int], values: Array, width: int) -> Array:
    """Return an array of this width with values at their places, NaN elsewhere."""
    spread = np.full(width, np.nan)
    spread[list(places)] = values
    return spread
