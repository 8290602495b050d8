# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What the host has heard of one link, and what it makes of it."""

from __future__ import annotations

from collections import Counter, deque
from math import pi, remainder

from fourbar_ros.hardware.link_clock import LinkClock
from fourbar_ros.hardware.messages import (
    AngleReport,
    ClockReport,
    COUNTERS,
    Heartbeat,
    LinkState,
    MotorReport,
    SEQUENCES,
    WheelReport,
)

# Stamps may be so much after the arrival of what they are of, for the clock is an estimate [ns].
AHEAD_NS = 2_000_000
# A sample that is older when it arrives is none [ns].
OLDEST_NS = 500_000_000

# A heartbeat that is behind the last one is an old one, unless that is so long ago that nobody
# knows how many were lost; later than when its loss is noticed [ns].
BEAT_MEMORY_NS = 1_000_000_000

# Electronics that were started before others within this time are two at once [ns].
BOOT_MEMORY_NS = 3_000_000_000


class LinkTelemetry:
    """
    One link: its wheel, its angle sensor, its clock, its health; times are the host's [ns].

    :ivar counts: of frames that were lost or not taken, by why.
    :ivar wheel_angle: of the last answer, unwrapped [rad].
    :ivar wheel_speed: mean between the last two answers [rad/s].
    :ivar wheel_ns: when the last answer was measured, None before the first.
    :ivar torque: that the motor says it applied, mean since the answer before [N m].
    :ivar state: of its electronics as it last told, None before.
    :ivar heartbeat: the last one, None before the first.
    :ivar heartbeat_ns, answer_ns: when the last ones arrived, None before the first.
    :ivar angles: samples that were not handed on yet: stamp [ns], angle [rad], rate [rad/s].
    :ivar boots: how often it was found to have started anew.
    :ivar twins: how many others answer in its place.
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
        self.boots = 0
        self.twins = 0
        self._answered: int | None = None
        self._motor_answered = False
        self._angle_sequence: int | None = None
        self._beat: int | None = None
        self._boot_ns: dict[int, int] = {}
        self._boot: int | None = None

    def asked(self) -> None:
        """Expect a new answer, the wheel's and the motor's."""
        self._answered, self._motor_answered = None, False

    @property
    def complete(self) -> bool:
        """Whether wheel and motor have answered."""
        return self.missing == 0

    @property
    def missing(self) -> int:
        """How many of the two answers are not there yet, the wheel's and the motor's."""
        return (self._answered is None) + (not self._motor_answered)

    def take_wheel(self, report: WheelReport, counter: int, sent_ns: int, arrival_ns: int) -> None:
        """
        Take the answer of the wheel encoder.

        :param counter, sent_ns: of the last `Sync`.
        """
        if not self._in_time(report.counter, counter):
            return
        if self._answered is not None:
            self.counts['replayed'] += 1
            return
        measured_ns = self._measured_ns(report.time_us, report.wrap_us, arrival_ns)
        if measured_ns is None:
            measured_ns = (sent_ns + arrival_ns) // 2
        if not arrival_ns - OLDEST_NS <= measured_ns <= arrival_ns + AHEAD_NS:
            self.counts['wrong_time'] += 1
            return
        last_ns = self.wheel_ns
        if last_ns is not None and measured_ns <= last_ns:
            if measured_ns < last_ns - AHEAD_NS:
                self.counts['wrong_time'] += 1
                return
            # Nothing new was measured since: the speed stays.
            measured_ns = last_ns
        elapsed = 0.0 if last_ns is None else (measured_ns - last_ns) * 1e-9
        expected = self.wheel_angle + self.wheel_speed * elapsed
        angle = expected + remainder(report.angle - expected, report.turn)
        if report.speed is not None:
            self.wheel_speed = report.speed
        elif elapsed > 0.0:
            self.wheel_speed = (angle - self.wheel_angle) / elapsed
        if last_ns is None:
            angle = report.angle
        self.wheel_angle, self.wheel_ns = angle, measured_ns
        self.answer_ns, self._answered = arrival_ns, counter

    def take_motor(self, report: MotorReport, counter: int) -> None:
        """
        Take what the motor did.

        :param counter: of the last `Sync`.
        """
        if not self._in_time(report.counter, counter):
            return
        if self._motor_answered:
            self.counts['replayed'] += 1
            return
        self._motor_answered = True
        self.torque = report.torque
        if report.state is not None:
            self.state = report.state

    def take_angle(self, report: AngleReport, arrival_ns: int) -> None:
        """Take a sample of the angle sensor."""
        if not self.clock.settled:
            # Nobody knows yet when that was.
            self.counts['before_clock'] += 1
            self._angle_sequence = report.sequence
            return
        measured_ns = self._measured_ns(report.time_us, report.wrap_us, arrival_ns)
        assert measured_ns is not None
        last_ns = self.angle_ns
        if last_ns is not None and last_ns - OLDEST_NS < measured_ns <= last_ns:
            self.counts['replayed'] += 1
            return
        if not arrival_ns - OLDEST_NS <= measured_ns <= arrival_ns + AHEAD_NS:
            self.counts['wrong_time'] += 1
            return
        if self._angle_sequence is not None:
            missed = (report.sequence - self._angle_sequence - 1) % SEQUENCES
            self.counts['lost_angles'] += missed
        self._angle_sequence = report.sequence
        self.angle_ns = measured_ns
        self.angles.append((measured_ns, remainder(report.angle, 2.0 * pi), report.rate))

    def take_clock(self, report: ClockReport, sent_ns: int | None, arrival_ns: int) -> None:
        """
        Take the link's time when a `Sync` came.

        :param sent_ns: when that `Sync` went out, None if that is not known any more.
        """
        self._started(report.boot, arrival_ns)
        if sent_ns is None:
            self.counts['replayed'] += 1
            return
        link_us = report.time_us
        if self.clock.exchanges:
            link_us = self.clock.unwrapped(report.time_us, 1 << 32, arrival_ns)
        self.clock.exchange(sent_ns, arrival_ns, link_us)

    def take_heartbeat(self, report: Heartbeat, arrival_ns: int) -> None:
        """Take a sign of life."""
        if report.boot is not None:
            self._started(report.boot, arrival_ns)
        if report.sequence is not None and self._beat is not None:
            ahead = (report.sequence - self._beat) % SEQUENCES
            assert self.heartbeat_ns is not None
            if not 0 < ahead <= SEQUENCES // 2 and (
                    arrival_ns - self.heartbeat_ns < BEAT_MEMORY_NS):
                self.counts['replayed'] += 1
                return
            self.counts['lost_heartbeats'] += (ahead - 1) % SEQUENCES
        self._beat = report.sequence
        self.heartbeat, self.heartbeat_ns = report, arrival_ns
        self.state = report.state

    def wheel_at(self, stamp_ns: int) -> float:
        """Return the angle of the wheel at a host time near its last answer [rad]."""
        assert self.wheel_ns is not None
        return self.wheel_angle + self.wheel_speed * (stamp_ns - self.wheel_ns) * 1e-9

    def _in_time(self, answered: int | None, counter: int) -> bool:
        """Tell whether an answer is one to the last question, and count it if not."""
        if answered is None or answered == counter:
            return True
        behind = (counter - answered) % COUNTERS
        self.counts['late' if behind < COUNTERS // 2 else 'replayed'] += 1
        return False

    def _measured_ns(self, time_us: int | None, wrap_us: int, arrival_ns: int) -> int | None:
        if time_us is None or not self.clock.settled:
            return None
        return self.clock.host_ns(self.clock.unwrapped(time_us, wrap_us, arrival_ns))

    def _started(self, boot: int, now_ns: int) -> None:
        """Notice that its electronics started anew, or that there are two of them."""
        known_ns = self._boot_ns.get(boot)
        self._boot_ns[boot] = now_ns
        if boot == self._boot:
            if self.twins and all(now_ns - heard_ns > BOOT_MEMORY_NS for other, heard_ns
                                  in self._boot_ns.items() if other != boot):
                self.twins = 0
            return
        if self._boot is not None:
            if known_ns is not None and now_ns - known_ns < BOOT_MEMORY_NS:
                self.twins = 1
            else:
                self.boots += 1
            self.clock = LinkClock()
            self._beat = self._angle_sequence = self.angle_ns = None
        self._boot = boot
