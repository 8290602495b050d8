# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Estimate of a link's clock against the host's: offset and drift, from exchanges over the bus.

The link reads its clock between the sending of a request and the arrival of the answer. The filter
takes the middle of that interval as the time of the reading, with an error of at most half the
round trip; the measurement variance grows with the excess over the shortest round trip.
"""

from __future__ import annotations

from math import sqrt

# Initial standard deviation of the drift: tolerance of two quartz oscillators [s/s].
INITIAL_DRIFT = 1e-4
# Random walk of the drift, by temperature [s/s per sqrt(s)].
DRIFT_RANDOM_WALK = 1e-7
# Smallest standard deviation of a measurement [s].
MIN_NOISE = 2e-5
# Standard deviation from unequal delays of the two directions, as a share of the shortest round
# trip. With this share an exchange that is slow in one direction only stays within the gate.
ASYMMETRY = 0.1
# Longer exchanges are ignored [s].
MAX_ROUND_TRIP = 0.05
# The estimate has settled after this number of exchanges, below this standard deviation [s].
SETTLED_EXCHANGES, SETTLED_SIGMA = 4, 3e-4
# Innovation gate, in standard deviations.
GATE = 6.0
# Consecutive exchanges outside the gate after which the link's clock has restarted.
RESTART_AFTER = 5
# Weight of a new squared innovation in their mean; growth of the shortest round trip per exchange,
# so that it follows a bus that becomes slower.
SMOOTHING, FORGETTING = 0.05, 1.002


class LinkClock:
    """
    Kalman filter of a link's clock against the host's.

    :ivar exchanges: number of processed exchanges since the clock's last start.
    :ivar restarts: number of restarts of the clock.
    :ivar settled: whether the estimate can be used; it stays so until a restart.
    """

    def __init__(self) -> None:
        self.exchanges = 0
        self.restarts = 0
        self.settled = False
        self._outside_gate = 0
        self._host_ns = 0
        self._link_us = 0
        # Error of the offset at the last exchange [s], drift, and their covariance.
        self._offset = 0.0
        self._drift = 0.0
        self._p00, self._p01, self._p11 = 0.0, 0.0, 0.0
        self._shortest = MAX_ROUND_TRIP
        self._innovation_square = 0.0

    @property
    def jitter(self) -> float:
        """Root mean square of the innovations [s]."""
        return sqrt(self._innovation_square)

    @property
    def sigma(self) -> float:
        """Standard deviation of the offset at the last exchange, without asymmetry [s]."""
        return sqrt(self._p00)

    @property
    def drift(self) -> float:
        """Relative rate of the link's clock against the host's [s/s]."""
        return self._drift

    def exchange(self, sent_ns: int, received_ns: int, link_us: int) -> bool:
        """
        Update the estimate by an exchange.

        :param sent_ns, received_ns: host times of request and answer [ns].
        :param link_us: unwrapped link time in between [us].
        :returns: whether the exchange was used.
        """
        round_trip = (received_ns - sent_ns) * 1e-9
        if not 0.0 <= round_trip <= MAX_ROUND_TRIP:
            return False
        middle_ns = (sent_ns + received_ns) // 2
        shortest = self._shortest * FORGETTING
        self._shortest = min(round_trip, shortest)
        noise = MIN_NOISE + ASYMMETRY * self._shortest + 0.5 * (round_trip - self._shortest)
        if not self.exchanges:
            self._begin(middle_ns, link_us, noise)
            return True
        elapsed = (middle_ns - self._host_ns) * 1e-9
        if elapsed <= 0.0:
            return False
        offset = self._offset + elapsed * self._drift
        p00 = self._p00 + elapsed * (2.0 * self._p01 + elapsed * self._p11) + 1e-14 * elapsed
        # Earlier exchanges were slower: all may have an error of half the difference.
        p00 += (0.5 * (shortest - self._shortest)) ** 2
        p01 = self._p01 + elapsed * self._p11
        p11 = self._p11 + DRIFT_RANDOM_WALK * DRIFT_RANDOM_WALK * elapsed
        # Measured minus predicted offset; both are relative to the last exchange.
        innovation = (link_us - self._link_us) * 1e-6 - elapsed - offset
        innovation_variance = p00 + noise * noise
        if innovation * innovation > GATE * GATE * innovation_variance:
            self._outside_gate += 1
            if self._outside_gate >= RESTART_AFTER:
                self.restarts += 1
                self._begin(middle_ns, link_us, noise)
            return False
        self._outside_gate = 0
        gain0, gain1 = p00 / innovation_variance, p01 / innovation_variance
        self._offset, self._drift = offset + gain0 * innovation, self._drift + gain1 * innovation
        self._p00, self._p01 = (1.0 - gain0) * p00, (1.0 - gain0) * p01
        self._p11 = p11 - gain1 * p01
        self._innovation_square += SMOOTHING * (innovation * innovation - self._innovation_square)
        # Move the reference to this exchange; whole microseconds go into the link time, so that
        # the offset stays small.
        whole = round(self._offset * 1e6)
        ahead_us = round(elapsed * 1e6)
        self._offset += elapsed - ahead_us * 1e-6 - whole * 1e-6
        self._link_us += ahead_us + whole
        self._host_ns = middle_ns
        self.exchanges += 1
        self.settled |= self.exchanges >= SETTLED_EXCHANGES and self.sigma <= SETTLED_SIGMA
        return True

    def host_ns(self, link_us: int) -> int:
        """Return the host time of an unwrapped link time [ns]."""
        since = (link_us - self._link_us) * 1e-6 - self._offset
        return self._host_ns + round(since / (1.0 + self._drift) * 1e9)

    def link_us(self, host_ns: int) -> int:
        """Return the link time of a host time [us]."""
        since = (host_ns - self._host_ns) * 1e-9
        return self._link_us + round((self._offset + since * (1.0 + self._drift)) * 1e6)

    def unwrapped(self, time_us: int, wrap_us: int, about_ns: int) -> int:
        """
        Unwrap a link time modulo `wrap_us`.

        :param about_ns: host time less than half a period away from it [ns].
        """
        about_us = self.link_us(about_ns)
        return about_us + (time_us - about_us + wrap_us // 2) % wrap_us - wrap_us // 2

    def _begin(self, host_ns: int, link_us: int, noise: float) -> None:
        self._host_ns, self._link_us = host_ns, link_us
        self._offset = self._drift = self._innovation_square = 0.0
        self._p00, self._p01, self._p11 = noise * noise, 0.0, INITIAL_DRIFT * INITIAL_DRIFT
        self._outside_gate, self.exchanges, self.settled = 0, 1, False
