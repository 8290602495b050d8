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

"""The estimator: link angles and ticks in, estimates out, one per tick."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

from fourbar_ros.estimation.filter import LinkageFilter
from fourbar_ros.mechanism import ClosureError, LINK_NAMES, Mechanism, nearest_assembly
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.mechanism.by_name import RejectedError, values_by_name
from fourbar_ros.mechanism.parameters import Array
import numpy as np

# A longer silence, or time going back, means another run of the device: start again.
LONGEST_GAP_NS = 1_000_000_000

# So many innovations in a row that no sensor noise explains mean that the filter is lost.
LOST_NIS_PER_ANGLE = 100.0
LOST_AFTER = 10

# Measurements that wait for their tick; more than ever arrive in one period.
LONGEST_QUEUE = 100

# Standard deviation of the unknown rates at the start [rad/s].
INITIAL_RATE_SIGMA = 1.0


@dataclass(frozen=True)
class EstimatorSettings:
    """
    What the filter assumes.

    :param angle_noise: standard deviation of a link-angle sample [rad].
    :param counts_per_turn: resolution of the link-angle sensors, 0 for none.
    :param disturbance_torque: density of unknown torques on each link [N m/sqrt(Hz)].
    """

    angle_noise: float = 1.7453e-3
    counts_per_turn: int = 16384
    disturbance_torque: float = 1e-7

    @property
    def angle_variance(self) -> float:
        """Variance of one sample, rounding included [rad^2]."""
        step = 2.0 * pi / self.counts_per_turn if self.counts_per_turn else 0.0
        return self.angle_noise ** 2 + step ** 2 / 12.0


@dataclass(frozen=True, eq=False)
class Innovation:
    """
    What one update of the filter saw.

    :param links: indices of the measured links.
    :param angles: (n,) measured minus predicted [rad].
    :param nis: normalised innovation squared, chi-square of n degrees of freedom if all is well.
    """

    links: tuple[int, ...]
    angles: Array
    nis: float


@dataclass(frozen=True, eq=False)
class Estimate:
    """
    The state of the links at a tick, and how well it is known.

    :param stamp_ns: the tick [ns].
    :param link_angles: (4,) continuous [rad].
    :param link_rates: (4,) [rad/s].
    :param angle_sigmas: (4,) one standard deviation [rad].
    :param rate_sigmas: (4,) one standard deviation [rad/s].
    :param innovation: of the last update at this tick, None without a measurement.
    """

    stamp_ns: int
    link_angles: Array
    link_rates: Array
    angle_sigmas: Array
    rate_sigmas: Array
    innovation: Innovation | None


class Estimator:
    """
    Runs the filter on what comes in.

    :ivar rejected: number of unusable measurements by kind.
    :ivar last_rejection: what was wrong with the last one, or ''.
    :ivar starts: how often the filter was started.
    :ivar waiting_for: what is missing for a start, or '' while the filter runs.
    """

    def __init__(self, mechanism: Mechanism, settings: EstimatorSettings) -> None:
        self.rejected: Counter[str] = Counter()
        self.last_rejection = ''
        self.starts = 0
        self.waiting_for = 'flywheel_states'
        self._mechanism = mechanism
        self._settings = settings
        self._filter: LinkageFilter | None = None
        self._pending: list[tuple[int, tuple[int, ...], Array]] = []
        self._newest_ns = [-LONGEST_GAP_NS] * 4
        self._stamp_ns: int | None = None
        self._wheel_speeds = np.zeros(4)
        self._misfits = 0
        # Compile the kernels now, not while time runs.
        square = np.array([0.0, pi / 2.0, 0.0, pi / 2.0])
        linkage = LinkageFilter(mechanism, square, 1.0, 1.0, 1.0)
        linkage.move(1e-3, np.zeros(4))
        linkage.correct((0, 1, 2, 3), square, 1.0)

    def measure(self, stamp_ns: int, names: Sequence[str], angles: Sequence[float]) -> None:
        """
        Take measured link angles; they are used at the next tick at or after their stamp.

        :param stamp_ns: time of measurement [ns].
        :param names: any of the four links.
        :param angles: orientation of each [rad].
        :raises RejectedError: unusable, taken whole or not at all; also counted.
        """
        try:
            measurement = self._checked(stamp_ns, names, angles)
        except RejectedError as error:
            self.rejected[error.kind] += 1
            self.last_rejection = str(error)
            raise
        for link in measurement[1]:
            self._newest_ns[link] = stamp_ns
        self._pending.append(measurement)
        self._pending.sort(key=lambda item: item[0])
        del self._pending[:-LONGEST_QUEUE]

    def tick(self, stamp_ns: int, wheel_speeds: Sequence[float]) -> Estimate | None:
        """
        Advance to a tick.

        :param wheel_speeds: (4,) measured, relative to the links [rad/s].
        :returns: the estimate, or None while there is nothing to start from.
        :raises RejectedError: wheel speeds that cannot be used, or a tick that was there
            already; also counted.
        """
        speeds = np.asarray(wheel_speeds, dtype=float)
        try:
            self._check_tick(stamp_ns, speeds)
        except RejectedError as error:
            self.rejected[error.kind] += 1
            self.last_rejection = str(error)
            raise
        if self._stamp_ns is not None:
            last_ns = self._stamp_ns
            if 0 < stamp_ns - last_ns <= LONGEST_GAP_NS:
                self._pending = [item for item in self._pending if item[0] >= last_ns]
            else:
                self._filter = None
        innovation = None
        if self._filter is not None and self._stamp_ns is not None:
            innovation = self._advance(self._filter, self._stamp_ns, stamp_ns, speeds)
        self._stamp_ns, self._wheel_speeds = stamp_ns, speeds
        if self._filter is None:
            self._start(stamp_ns)
        self._pending = [item for item in self._pending if item[0] > stamp_ns]
        if self._filter is None:
            return None
        angle_sigmas, rate_sigmas = self._filter.sigmas()
        return Estimate(stamp_ns, self._filter.angles.copy(), self._filter.rates, angle_sigmas,
                        rate_sigmas, innovation)

    def _advance(self, linkage: LinkageFilter, from_ns: int, to_ns: int, speeds: Array
                 ) -> Innovation | None:
        torques = (self._mechanism.flywheel_inertias * (speeds - self._wheel_speeds)
                   / ((to_ns - from_ns) * 1e-9))
        innovation = None
        now_ns = from_ns
        for stamp_ns, links, angles in self._pending:
            if stamp_ns > to_ns:
                break
            if stamp_ns > now_ns:
                linkage.move((stamp_ns - now_ns) * 1e-9, torques)
                now_ns = stamp_ns
            residual, nis = linkage.correct(links, angles, self._settings.angle_variance)
            innovation = Innovation(links, residual, nis)
            self._judge(innovation)
        if now_ns < to_ns:
            linkage.move((to_ns - now_ns) * 1e-9, torques)
        return innovation

    def _judge(self, innovation: Innovation) -> None:
        if innovation.nis <= LOST_NIS_PER_ANGLE * len(innovation.links):
            self._misfits = 0
            return
        self._misfits += 1
        if self._misfits >= LOST_AFTER:
            self._filter = None

    def _start(self, stamp_ns: int) -> None:
        """Start the filter from the newest sample that determines the configuration."""
        self.waiting_for = 'link_angles with link_a, link_b and one of link_c, link_d'
        for _, links, angles in reversed(self._pending):
            if not {0, 1} < set(links):
                continue
            measured = np.full(4, np.nan)
            measured[list(links)] = angles
            near = np.where(np.isnan(measured), measured[[2, 3, 3, 2]], measured)
            try:
                start = nearest_assembly(
                    self._mechanism, (0, 1), (measured[0], measured[1]), near)
            except ClosureError as error:
                self.waiting_for = f'link angles that fit together: {error}'
                continue
            self._filter = LinkageFilter(
                self._mechanism, start, self._settings.angle_variance, INITIAL_RATE_SIGMA ** 2,
                self._settings.disturbance_torque)
            rest = [i for i, link in enumerate(links) if link > 1]
            self._filter.correct(
                tuple(links[i] for i in rest), np.asarray(angles)[rest],
                self._settings.angle_variance)
            self.starts += 1
            self._misfits = 0
            self.waiting_for = ''
            return

    def _checked(self, stamp_ns: int, names: Sequence[str], angles: Sequence[float]
                 ) -> tuple[int, tuple[int, ...], Array]:
        measured = values_by_name(names, angles, LINK_NAMES, 'position')
        links = tuple(sorted(measured))
        # A sample of the last tick itself that was overtaken by it still serves the next one.
        if self._stamp_ns is not None and 0 < self._stamp_ns - stamp_ns < LONGEST_GAP_NS:
            raise RejectedError('late', 'measured before the last tick')
        if any(0 <= self._newest_ns[link] - stamp_ns < LONGEST_GAP_NS for link in links):
            raise RejectedError('repeated', 'stamp is not newer than that of the last sample')
        return stamp_ns, links, wrap_angles([measured[link] for link in links])

    def _check_tick(self, stamp_ns: int, speeds: Array) -> None:
        if speeds.shape != (4,) or not np.isfinite(speeds).all():
            raise RejectedError('wheels', 'flywheel_states must hold four finite velocities')
        if self._stamp_ns is not None and 0 <= self._stamp_ns - stamp_ns < LONGEST_GAP_NS:
            raise RejectedError('stamp', 'tick is not newer than the last one')
