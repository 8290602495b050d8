# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""State of one link at the host, from the reports of the link."""

from __future__ import annotations

from collections import Counter, deque
from math import pi, remainder

from fourbar_ros.hardware import messages
from fourbar_ros.hardware.link_clock import LinkClock
from fourbar_ros.hardware.messages import COUNTERS, Heartbeat, LinkState, SEQUENCES

# A time of measurement may be later than the arrival by this, the error of the clock estimate
# [ns].
MAX_STAMP_AHEAD_NS = 2_000_000
# Maximum age of a sample on arrival [ns].
MAX_SAMPLE_AGE_NS = 500_000_000
# After this time without a heartbeat any sequence number is accepted [ns]; longer than the limit
# of `heartbeat_lost`.
HEARTBEAT_REORDER_NS = 1_000_000_000
# Two boot numbers that alternate within this time are two links with one identifier [ns].
DUPLICATE_WINDOW_NS = 3_000_000_000


class LinkTelemetry:
    """
    Wheel, angle sensor, clock and health of one link; times are of the host's clock [ns].

    :ivar counts: number of lost and rejected reports, by reason.
    :ivar clock: estimate of the link's clock.
    :ivar wheel_angle: of the last answer, unwrapped [rad].
    :ivar wheel_speed: measured, or mean between the last two answers [rad/s].
    :ivar wheel_ns: time of measurement of the last answer, None before the first.
    :ivar torque: mean torque applied to the wheel since the answer before [N m].
    :ivar state: last reported state, None before the first.
    :ivar heartbeat: the last one, None before the first.
    :ivar heartbeat_ns, answer_ns: arrival of the last ones, None before the first.
    :ivar angle_ns: time of measurement of the last angle sample, None before the first.
    :ivar angles: new angle samples: stamp [ns], angle [rad], rate [rad/s] or None.
    :ivar restarts: number of restarts of the electronics.
    :ivar duplicates: number of other links with the same identifier.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.clock = LinkClock()
        self.wheel_angle = 0.0
        self.wheel_speed = 0.0
        self.wheel_ns: int | None = None
        self.torque = 0.0
        self.state: LinkState | None = None
        self.heartbeat: Heartbeat | None = None
        self.heartbeat_ns: int | None = None
        self.answer_ns: int | None = None
        self.angle_ns: int | None = None
        self.angles: deque[tuple[int, float, float | None]] = deque(maxlen=1000)
        self.restarts = 0
        self.duplicates = 0
        self._wheel_answered = self._motor_answered = False
        self._angle_sequence: int | None = None
        self._heartbeat_sequence: int | None = None
        self._boot_ns: dict[int, int] = {}
        self._boot: int | None = None

    def start_cycle(self) -> None:
        """Expect new answers of wheel and motor."""
        self._wheel_answered = self._motor_answered = False

    @property
    def missing(self) -> int:
        """Number of answers that this cycle still lacks, of wheel and motor."""
        return (not self._wheel_answered) + (not self._motor_answered)

    def update_wheel(self, report: messages.WheelReport, counter: int, sent_ns: int,
                     arrival_ns: int) -> None:
        """
        Process the answer of the wheel encoder.

        :param counter, sent_ns: of the last `Sync`.
        """
        if not self._is_new(report.counter, counter, self._wheel_answered):
            return
        measured_ns = self._measured_ns(report.time_us, report.wrap_us, arrival_ns)
        if measured_ns is None:
            measured_ns = (sent_ns + arrival_ns) // 2
        last_ns = self.wheel_ns
        if not _is_plausible(measured_ns, arrival_ns) or (
                last_ns is not None and measured_ns < last_ns - MAX_STAMP_AHEAD_NS):
            self.counts['wrong_time'] += 1
            return
        if last_ns is None:
            self.wheel_angle, last_ns = report.angle, measured_ns
        # Not before the last one: within the error of the clock it is the same measurement.
        measured_ns = max(measured_ns, last_ns)
        elapsed = (measured_ns - last_ns) * 1e-9
        expected = self.wheel_angle + self.wheel_speed * elapsed
        angle = expected + remainder(report.angle - expected, report.turn)
        if report.speed is not None:
            self.wheel_speed = report.speed
        elif elapsed > 0.0:
            self.wheel_speed = (angle - self.wheel_angle) / elapsed
        self.wheel_angle, self.wheel_ns = angle, measured_ns
        self.answer_ns, self._wheel_answered = arrival_ns, True

    def update_motor(self, report: messages.MotorReport, counter: int) -> None:
        """
        Process the answer of the motor.

        :param counter: of the last `Sync`.
        """
        if self._is_new(report.counter, counter, self._motor_answered):
            self._motor_answered = True
            self.torque = report.torque
            if report.state is not None:
                self.state = report.state

    def update_angle(self, report: messages.AngleReport, arrival_ns: int) -> None:
        """Process a sample of the angle sensor."""
        measured_ns = self._measured_ns(report.time_us, report.wrap_us, arrival_ns)
        if measured_ns is None:
            # Without a clock estimate the time of measurement is unknown.
            self.counts['before_clock'] += 1
            self._angle_sequence = report.sequence
            return
        last_ns = self.angle_ns
        if last_ns is not None and last_ns - MAX_SAMPLE_AGE_NS < measured_ns <= last_ns:
            self.counts['replayed'] += 1
            return
        if not _is_plausible(measured_ns, arrival_ns):
            self.counts['wrong_time'] += 1
            return
        if self._angle_sequence is not None:
            missed = (report.sequence - self._angle_sequence - 1) % SEQUENCES
            self.counts['lost_angles'] += missed
        self._angle_sequence = report.sequence
        self.angle_ns = measured_ns
        self.angles.append((measured_ns, remainder(report.angle, 2.0 * pi), report.rate))

    def update_clock(self, report: messages.ClockReport, sent_ns: int | None, arrival_ns: int
                     ) -> None:
        """
        Process the link time at which a `Sync` arrived.

        :param sent_ns: when that `Sync` was sent, None if it is too old to know.
        """
        self._update_boot(report.boot, arrival_ns)
        if sent_ns is None:
            self.counts['replayed'] += 1
            return
        link_us = report.time_us
        if self.clock.exchanges:
            link_us = self.clock.unwrapped(report.time_us, 1 << 32, arrival_ns)
        self.clock.exchange(sent_ns, arrival_ns, link_us)

    def update_heartbeat(self, report: Heartbeat, arrival_ns: int) -> None:
        """Process a heartbeat."""
        if report.boot is not None:
            self._update_boot(report.boot, arrival_ns)
        if report.sequence is not None and self._heartbeat_sequence is not None:
            ahead = (report.sequence - self._heartbeat_sequence) % SEQUENCES
            assert self.heartbeat_ns is not None
            if not 0 < ahead <= SEQUENCES // 2 and (
                    arrival_ns - self.heartbeat_ns < HEARTBEAT_REORDER_NS):
                self.counts['replayed'] += 1
                return
            self.counts['lost_heartbeats'] += (ahead - 1) % SEQUENCES
        self._heartbeat_sequence = report.sequence
        self.heartbeat, self.heartbeat_ns = report, arrival_ns
        self.state = report.state

    def wheel_at(self, stamp_ns: int) -> float:
        """Extrapolate the wheel angle to a host time close to its last answer [rad]."""
        if self.wheel_ns is None:
            return 0.0
        return self.wheel_angle + self.wheel_speed * (stamp_ns - self.wheel_ns) * 1e-9

    def _is_new(self, answered: int | None, counter: int, is_repeated: bool) -> bool:
        """Tell whether an answer belongs to the last `Sync` and is the first; count it if not."""
        if answered is not None and answered != counter:
            behind = (counter - answered) % COUNTERS
            self.counts['late' if behind < COUNTERS // 2 else 'replayed'] += 1
            return False
        if is_repeated:
            self.counts['replayed'] += 1
        return not is_repeated

    def _measured_ns(self, time_us: int | None, wrap_us: int, arrival_ns: int) -> int | None:
        """Return the host time of a link time, None without a clock estimate."""
        if time_us is None or not self.clock.settled:
            return None
        return self.clock.host_ns(self.clock.unwrapped(time_us, wrap_us, arrival_ns))

    def _update_boot(self, boot: int, now_ns: int) -> None:
        """Detect a restart of the electronics, or a second link with this identifier."""
        known_ns = self._boot_ns.get(boot)
        self._boot_ns[boot] = now_ns
        if boot == self._boot:
            if self.duplicates and all(now_ns - last_ns > DUPLICATE_WINDOW_NS for other, last_ns
                                       in self._boot_ns.items() if other != boot):
                self.duplicates = 0
            return
        if self._boot is not None:
            if known_ns is not None and now_ns - known_ns < DUPLICATE_WINDOW_NS:
                self.duplicates = 1
            else:
                self.restarts += 1
            self.clock = LinkClock()
            self._heartbeat_sequence = self._angle_sequence = self.angle_ns = None
        self._boot = boot


def _is_plausible(measured_ns: int, arrival_ns: int) -> bool:
    """Tell whether a time of measurement fits to the arrival of the sample."""
    return arrival_ns - MAX_SAMPLE_AGE_NS <= measured_ns <= arrival_ns + MAX_STAMP_AHEAD_NS
