# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Everything that the nodes would publish in a run, as arrays and as a table."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence

from fourbar_ros.common import names
from fourbar_ros.control.actuation_cost import ENERGIES
from fourbar_ros.control.wheel_command import WheelCommand
from fourbar_ros.loop.closed_loop import Step
from fourbar_ros.mechanism import JOINT_NAMES, LINK_NAMES, SENSOR_NAMES
from fourbar_ros.mechanism.constants import Array
import numpy as np
from numpy.typing import NDArray

QUALITY = ('nis', 'degrees_of_freedom')

LINKS = tuple('abcd')
# Of the table: the beginning of the names of the columns, topic, field, and how the names end.
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
     (*QUALITY, *(f'innovation_{kind}{name}' for kind in ('', 'gyro_')
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


class Recording:
    """
    What was published at the ticks of a run.

    Fields go by `topic.field`: positions, velocities and efforts are (n, names) with one row per
    message, in the order of names that the topic has, NaN for what a message left out;
    `topic.stamp_ns` (n,) are the stamps, and `topic.tick_ns` (n,) the ticks they came with.

    :param sensor_names: of the sensors of the links, the order of `link_angles` here.
    :ivar tick_stamps_ns: of all ticks so far [ns].
    """

    def __init__(self, sensor_names: Sequence[str] = LINK_NAMES) -> None:
        self.sensor_names = tuple(sensor_names)
        self.tick_stamps_ns: list[int] = []
        self._stamps: dict[str, tuple[array[int], array[int]]] = {}
        self._values: dict[str, tuple[int, array[float]]] = {}

    def add(self, step: Step) -> None:
        """Take over what belongs to one tick."""
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
            if (seen := estimate.innovation) is not None:
                self._row(names.ESTIMATE_INNOVATION, now, now, position=np.concatenate(
                    [[seen.nis, seen.degrees_of_freedom],
                     _spread(seen.sensors, seen.values, 2 * len(SENSOR_NAMES))]))
        if (control := step.control) is not None:
            self._command(now, control.command)
            self._row(names.REFERENCE, now, now, position=control.reference_angles,
                      velocity=control.reference_rates)
            self._row(names.TRACKING_ERROR, now, now, position=control.angle_errors,
                      velocity=control.rate_errors)
            self._row(names.ENERGY, now, now, position=control.energies)

    def arrays(self) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]:
        """Return copies of all arrays by name."""
        found: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {}
        for topic, (stamps, ticks) in self._stamps.items():
            found[f'{topic}.stamp_ns'] = np.array(stamps, dtype=np.int64)
            found[f'{topic}.tick_ns'] = np.array(ticks, dtype=np.int64)
        for name, (width, values) in self._values.items():
            found[name] = np.array(values).reshape(-1, width)
        return found

    def table(self) -> tuple[tuple[str, ...], NDArray[np.float64]]:
        """
        Arrange it by ticks.

        Times count from the first tick [s]. Of several samples of a sensor at one tick the newest
        counts. NaN where nothing was published.

        :returns: names of the columns, and (ticks, columns).
        """
        found = self.arrays()
        ticks_ns = np.array(self.tick_stamps_ns, dtype=np.int64)
        first_ns = int(ticks_ns[0]) if len(ticks_ns) else 0
        titles = ['t']
        columns: list[Array] = [np.array(ticks_ns - first_ns, dtype=float)[:, None] / 1e9]
        sensors = len(self.sensor_names)
        measured = np.full((len(ticks_ns), 2 * sensors), np.nan)
        rows = self._ticks_of(names.LINK_ANGLES, found)
        for n, row in enumerate(rows):
            angles = found['link_angles.position'][n]
            given = np.flatnonzero(~np.isnan(angles))
            measured[row, given] = angles[given]
            measured[row, sensors + given] = (found['link_angles.stamp_ns'][n] - first_ns) / 1e9
        titles += [f'measured_{name}' for name in self.sensor_names]
        titles += [f'measured_at_{name}' for name in self.sensor_names]
        columns.append(measured)
        for prefix, topic, field, ends in COLUMNS:
            titles += [f'{prefix}{end}' for end in ends]
            column = np.full((len(ticks_ns), len(ends)), np.nan)
            if f'{topic}.{field}' in found:
                column[self._ticks_of(topic, found)] = found[f'{topic}.{field}']
            columns.append(column)
        return tuple(titles), np.hstack(columns)

    def lines(self) -> Iterator[str]:
        """Write the table as CSV: 17 significant digits, nothing where there is no number."""
        titles, table = self.table()
        yield ','.join(titles) + '\n'
        for row in table:
            # Only NaN differs from itself.
            yield ','.join(['%.17g' % value if value == value else ''
                            for value in row.tolist()]) + '\n'

    def _ticks_of(self, topic: str, found: dict[str, NDArray[np.float64] | NDArray[np.int64]]
                  ) -> NDArray[np.intp]:
        """Return the numbers of the ticks that the messages of a topic came with."""
        return np.searchsorted(
            np.array(self.tick_stamps_ns), found.get(f'{topic}.tick_ns', np.empty(0)))

    def _command(self, now: int, command: WheelCommand) -> None:
        """Take over a command: efforts or velocities, of the wheels that have power."""
        values = np.where(command.powered, command.values, np.nan)
        nothing = np.full(len(values), np.nan)
        efforts, velocities = (nothing, values) if command.by_speed else (values, nothing)
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
    """Put values into their places among so many, NaN elsewhere."""
    spread = np.full(width, np.nan)
    spread[list(places)] = values
    return spread
