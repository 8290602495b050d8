# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The clock of a link, as the host reads it: offset and drift, from exchanges over the bus.

Each exchange bounds the link's time: what left the host at `sent` and was answered at `received`
was with the link in between. In the middle, says the estimate, and that is wrong by half the way
there and back at most; so an exchange counts the less, the longer it took beyond the shortest.
"""

from __future__ import annotations

from math import sqrt

# What the oscillators of two boards may differ by, to begin with [s/s], and how fast that wanders
# with temperature [s/s per sqrt(s)].
DRIFT, WANDER = 1e-4, 1e-7
# How well a way there and back is halved at best [s], and as a share of the shortest: the two
# directions differ. With this share an exchange that was slow one way only, and so is wrong by
# half of its time, stays within the gate: it is never taken for another clock.
FLOOR, SKEW = 2e-5, 0.1
# A longer round trip than this says nothing that is worth having [s].
LONGEST_ROUND_TRIP = 0.05
# Exchanges after which stamps are to be trusted, and the standard deviation [s].
ENOUGH, SURE = 4, 3e-4
# Beyond so many standard deviations, so many times in a row, it is another clock: it started anew.
GATE, ANOTHER_CLOCK = 6.0, 5
# With which means of what is left are taken, and the shortest round trip is forgotten.
SMOOTHING, FORGETTING = 0.05, 1.002


class LinkClock:
    """
    Kalman filter of a link's clock against the host's.

    :ivar exchanges: number of those that counted, since the clock last began.
    :ivar restarts: how often it was another clock.
    :ivar settled: whether its times are to be trusted; once they are they stay so, until it is
        another clock.
    """

    def __init__(self) -> None:
        self.exchanges = 0
        self.restarts = 0
        self.settled = False
        self._refused = 0
        self._host_ns = 0
        self._link_us = 0
        # Error of the offset at the last exchange [s], drift, and their covariance.
        self._offset = 0.0
        self._drift = 0.0
        self._p00, self._p01, self._p11 = 0.0, 0.0, 0.0
        self._shortest = LONGEST_ROUND_TRIP
        self._residual = 0.0

    @property
    def jitter(self) -> float:
        """How far exchanges are from what the filter expects, root mean square [s]."""
        return sqrt(self._residual)

    @property
    def sigma(self) -> float:
        """Standard deviation of the offset at the last exchange, asymmetry apart [s]."""
        return sqrt(self._p00)

    @property
    def drift(self) -> float:
        """How much faster than the host's it runs [s/s]."""
        return self._drift

    def exchange(self, sent_ns: int, received_ns: int, link_us: int) -> bool:
        """
        Learn from a question and its answer.

        :param sent_ns, received_ns: host time [ns].
        :param link_us: link time in between, not modulo anything [us].
        :returns: whether it counted.
        """
        round_trip = (received_ns - sent_ns) * 1e-9
        if not 0.0 <= round_trip <= LONGEST_ROUND_TRIP:
            return False
        middle_ns = (sent_ns + received_ns) // 2
        shortest = self._shortest * FORGETTING
        self._shortest = min(round_trip, shortest)
        noise = FLOOR + SKEW * self._shortest + 0.5 * (round_trip - self._shortest)
        if not self.exchanges:
            self._begin(middle_ns, link_us, noise)
            return True
        elapsed = (middle_ns - self._host_ns) * 1e-9
        if elapsed <= 0.0:
            return False
        offset = self._offset + elapsed * self._drift
        p00 = self._p00 + elapsed * (2.0 * self._p01 + elapsed * self._p11) + 1e-14 * elapsed
        # Those before, all slower, may all have been wrong by half of what they took longer.
        p00 += (0.5 * (shortest - self._shortest)) ** 2
        p01 = self._p01 + elapsed * self._p11
        p11 = self._p11 + WANDER * WANDER * elapsed
        # How far the link is ahead of where its clock would be at the host's pace.
        error = (link_us - self._link_us) * 1e-6 - elapsed - offset
        spread = p00 + noise * noise
        if error * error > GATE * GATE * spread:
            self._refused += 1
            if self._refused >= ANOTHER_CLOCK:
                self.restarts += 1
                self._begin(middle_ns, link_us, noise)
            return False
        self._refused = 0
        gain0, gain1 = p00 / spread, p01 / spread
        self._offset, self._drift = offset + gain0 * error, self._drift + gain1 * error
        self._p00, self._p01 = (1.0 - gain0) * p00, (1.0 - gain0) * p01
        self._p11 = p11 - gain1 * p01
        self._residual += SMOOTHING * (error * error - self._residual)
        # From here on, so that numbers stay small: whole microseconds move to the link's time.
        whole = round(self._offset * 1e6)
        ahead_us = round(elapsed * 1e6)
        self._offset += elapsed - ahead_us * 1e-6 - whole * 1e-6
        self._link_us += ahead_us + whole
        self._host_ns = middle_ns
        self.exchanges += 1
        self.settled |= self.exchanges >= ENOUGH and self.sigma <= SURE
        return True

    def host_ns(self, link_us: int) -> int:
        """Return the host time of a link time, which is not modulo anything [ns]."""
        since = (link_us - self._link_us) * 1e-6 - self._offset
        return self._host_ns + round(since / (1.0 + self._drift) * 1e9)

    def link_us(self, host_ns: int) -> int:
        """Return the link time of a host time [us]."""
        since = (host_ns - self._host_ns) * 1e-9
        return self._link_us + round((self._offset + since * (1.0 + self._drift)) * 1e6)

    def unwrapped(self, time_us: int, wrap_us: int, about_ns: int) -> int:
        """
        Return the link time that a time modulo `wrap_us` stands for.

        :param about_ns: host time from which it is less than half of that away [ns].
        """
        about_us = self.link_us(about_ns)
        return about_us + (time_us - about_us + wrap_us // 2) % wrap_us - wrap_us // 2

    def _begin(self, host_ns: int, link_us: int, noise: float) -> None:
        self._host_ns, self._link_us = host_ns, link_us
        self._offset = self._drift = self._residual = 0.0
        self._p00, self._p01, self._p11 = noise * noise, 0.0, DRIFT * DRIFT
        self._refused, self.exchanges, self.settled = 0, 1, False
