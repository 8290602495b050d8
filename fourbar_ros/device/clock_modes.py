# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Clock modes: ticks in real time, in simulated time, or in lock-step with the answers to them.

Times are arguments. There are two time scales: stamps, the time in messages and of the plant, and
a monotonic clock. While a clock is paused, its stamps stand still.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import astuple, dataclass
from enum import Enum
from math import isfinite

from fourbar_ros.common.errors import FourbarError

# Start of simulated time [ns]; other nodes take 0 for `now` or `never`.
FIRST_STAMP_NS = 1_000_000_000
# Longest interval at which a tick without an answer is sent again [ns].
MAX_REPEAT_NS = 10_000_000_000


class ClockModeError(FourbarError):
    """
    A tick that is not possible now, or an invalid clock.

    Its `values` have `state`: `running`, `not ready` or `pending`, for a tick by `step`.
    """


class ClockMode(ABC):
    """
    Ticks one period apart.

    :param first_ns: stamp of the first tick [ns].
    :param period_ns: [ns].
    :ivar paused: whether ticks are taken by `step` only.
    :ivar ticks: number of ticks so far.
    :ivar skipped: number of ticks that were skipped.
    :ivar pending_ns: stamp of the tick that waits for its answer, None without one [ns].
    """

    def __init__(self, first_ns: int, period_ns: int) -> None:
        self.paused = False
        self.ticks = 0
        self.skipped = 0
        self.pending_ns: int | None = None
        self._period_ns = period_ns
        self._next_ns = first_ns
        self._frozen_ns = first_ns

    @abstractmethod
    def is_due(self, monotonic_ns: int) -> bool:
        """Tell whether a tick is due."""

    @abstractmethod
    def now_ns(self, monotonic_ns: int) -> int:
        """
        Return the time of the watchdogs, on the scale of the stamps [ns].

        It never goes back, and stands still while the clock is paused.
        """

    def due(self, monotonic_ns: int) -> int | None:
        """
        Take the oldest due tick; only one, so that commands are processed between late ticks.

        :returns: its stamp [ns], None if no tick is due.
        """
        return self._take(monotonic_ns) if self.is_due(monotonic_ns) else None

    @property
    def next_ns(self) -> int:
        """Stamp of the next tick, unless it is skipped [ns]."""
        return self._next_ns

    def answered(self, stamp_ns: int) -> bool:
        """Register a command by its stamp; tell whether a tick waited for it."""
        return False

    def give_up(self) -> None:
        """Stop waiting for the answer to the last tick."""
        self.pending_ns = None

    def pause(self, monotonic_ns: int) -> None:
        """Stop the stamps."""
        if not self.paused:
            self._frozen_ns = self.now_ns(monotonic_ns)
            self.paused = True

    def resume(self, monotonic_ns: int) -> None:
        """Continue the stamps from where they were stopped."""
        self.paused = False

    def step(self, monotonic_ns: int) -> int:
        """
        Take the next tick while paused.

        :returns: its stamp [ns].
        :raises ClockModeError: the clock is not paused.
        """
        if not self.paused:
            raise ClockModeError('the clock is running, pause it first', state='running')
        self._frozen_ns = self._take(monotonic_ns)
        return self._frozen_ns

    def _take(self, monotonic_ns: int) -> int:
        stamp_ns = self._next_ns
        self._next_ns += self._period_ns
        self.ticks += 1
        return stamp_ns


class RealtimeClock(ClockMode):
    """
    Ticks at the system time of the start plus elapsed monotonic time, one per period.

    After a short delay all late ticks are taken. After a long one (a suspended machine) the late
    ticks are skipped. A pause is no delay: later stamps are behind system time by its duration.

    :param system_ns: system time now, the stamp of the first tick [ns].
    :param monotonic_ns: monotonic time now [ns].
    :param period_ns: [ns].
    :param catch_up_ns: longest delay after which no tick is skipped [ns].
    """

    def __init__(self, system_ns: int, monotonic_ns: int, period_ns: int, catch_up_ns: int
                 ) -> None:
        super().__init__(system_ns, period_ns)
        self._offset_ns = system_ns - monotonic_ns
        self._catch_up_ns = catch_up_ns

    def is_due(self, monotonic_ns: int) -> bool:
        """Tell whether a tick is due."""
        return not self.paused and monotonic_ns + self._offset_ns >= self._next_ns

    def now_ns(self, monotonic_ns: int) -> int:
        """Return the monotonic time on the scale of the stamps [ns]."""
        return self._frozen_ns if self.paused else monotonic_ns + self._offset_ns

    def resume(self, monotonic_ns: int) -> None:
        """Continue the stamps from where they were stopped."""
        if self.paused:
            self._offset_ns = self._frozen_ns - monotonic_ns
        super().resume(monotonic_ns)

    def _take(self, monotonic_ns: int) -> int:
        behind_ns = self.now_ns(monotonic_ns) - self._next_ns
        if behind_ns > self._catch_up_ns:
            missed = behind_ns // self._period_ns
            self.skipped += missed
            self._next_ns += missed * self._period_ns
        return super()._take(monotonic_ns)


class FastClock(ClockMode):
    """
    Ticks in simulated time, which is faster or slower than monotonic time by a factor.

    If the machine is too slow, simulated time slows down; no tick is skipped.

    :param monotonic_ns: monotonic time now, at which simulated time is 1 s [ns].
    :param period_ns: [ns].
    :param factor: seconds of simulated time per second; 0: as fast as possible.
    :param catch_up_ns: longest delay that is caught up, in monotonic time [ns].
    :raises ClockModeError: the factor is negative or not finite.
    """

    def __init__(self, monotonic_ns: int, period_ns: int, factor: float, catch_up_ns: int) -> None:
        if not (isfinite(factor) and factor >= 0.0):
            raise ClockModeError(
                f'real_time_factor must be 0 (as fast as possible) or positive, got {factor:g}',
                name='real_time_factor', value=factor, limit=0.0)
        super().__init__(FIRST_STAMP_NS, period_ns)
        self._factor = factor
        self._catch_up_ns = catch_up_ns
        self._anchor(FIRST_STAMP_NS, monotonic_ns)

    def is_due(self, monotonic_ns: int) -> bool:
        """Tell whether a tick is due."""
        return not self.paused and self._unbounded_ns(monotonic_ns) >= self._next_ns

    def now_ns(self, monotonic_ns: int) -> int:
        """Return simulated time, at most the stamp of the next tick [ns]."""
        if self.paused:
            return self._frozen_ns
        if not self._factor:
            return self._last_ns
        return min(self._unbounded_ns(monotonic_ns), self._next_ns)

    def resume(self, monotonic_ns: int) -> None:
        """Continue the stamps from where they were stopped."""
        if self.paused:
            self._anchor(self._frozen_ns, monotonic_ns)
        super().resume(monotonic_ns)

    @property
    def _last_ns(self) -> int:
        """Stamp of the last tick, or of the first one before it is taken [ns]."""
        return max(FIRST_STAMP_NS, self._next_ns - self._period_ns)

    def _anchor(self, simulated_ns: int, monotonic_ns: int) -> None:
        self._anchor_ns, self._anchor_monotonic_ns = simulated_ns, monotonic_ns

    def _unbounded_ns(self, monotonic_ns: int) -> int:
        if not self._factor:
            return self._next_ns
        elapsed_ns = monotonic_ns - self._anchor_monotonic_ns
        return self._anchor_ns + round(elapsed_ns * self._factor)

    def _take(self, monotonic_ns: int) -> int:
        behind_ns = self._unbounded_ns(monotonic_ns) - self._next_ns
        if not self.paused and behind_ns > self._catch_up_ns * self._factor:
            self._anchor(self._next_ns, monotonic_ns)
        return super()._take(monotonic_ns)


class LockstepClock(ClockMode):
    """
    The next tick is due when the last one is answered; simulated time is that of the last tick.

    :param period_ns: [ns].
    :ivar ready: whether all participants are connected; no tick is due before.
    """

    def __init__(self, period_ns: int) -> None:
        super().__init__(FIRST_STAMP_NS, period_ns)
        self.ready = False
        self._now_ns = FIRST_STAMP_NS
        self._taken_monotonic_ns = 0

    def is_due(self, monotonic_ns: int) -> bool:
        """Tell whether a tick is due."""
        return self.ready and not self.paused and self.pending_ns is None

    def now_ns(self, monotonic_ns: int) -> int:
        """Return the stamp of the last tick [ns]."""
        return self._now_ns

    def answered(self, stamp_ns: int) -> bool:
        """Register a command by its stamp; tell whether a tick waited for it."""
        if stamp_ns != self.pending_ns:
            return False
        self.pending_ns = None
        return True

    def waiting_ns(self, monotonic_ns: int) -> int:
        """Return the time since the last tick, 0 if it is answered [ns]."""
        return 0 if self.pending_ns is None else monotonic_ns - self._taken_monotonic_ns

    def step(self, monotonic_ns: int) -> int:
        """
        Take the next tick while paused.

        :returns: its stamp [ns].
        :raises ClockModeError: the clock is not paused, a participant is missing, or the last
            tick has no answer yet.
        """
        if self.paused and not self.ready:
            raise ClockModeError('estimator or controller is not connected yet',
                                 state='not ready')
        if self.paused and self.pending_ns is not None:
            raise ClockModeError(f'the tick at {self.pending_ns * 1e-9:.9f} s is not answered yet',
                                 state='pending', pending_ns=self.pending_ns)
        return super().step(monotonic_ns)

    def _take(self, monotonic_ns: int) -> int:
        self._now_ns = self.pending_ns = super()._take(monotonic_ns)
        self._taken_monotonic_ns = monotonic_ns
        return self._now_ns


@dataclass(frozen=True)
class Participants:
    """
    Numbers of connections to the topics of a tick and its answer.

    :param tick_subscribers: of flywheel_states.
    :param angle_subscribers: of link_angles.
    :param command_publishers: of flywheel_command.
    :param estimate_publishers: of estimate/link_states.
    :param estimate_subscribers: of estimate/link_states, in nodes that publish commands.
    """

    tick_subscribers: int = 0
    angle_subscribers: int = 0
    command_publishers: int = 0
    estimate_publishers: int = 0
    estimate_subscribers: int = 0

    def missing(self) -> str:
        """Return the missing node and its missing connection, '' if none is missing."""
        if not self.command_publishers:
            return 'controller: flywheel_command has no publisher'
        if self.estimate_subscribers and not self.estimate_publishers:
            return 'estimator: estimate/link_states has no publisher'
        if self.estimate_publishers and not self.angle_subscribers:
            return 'estimator: link_angles has no subscriber'
        if not self.tick_subscribers:
            return 'controller: flywheel_states has no subscriber'
        return ''


class Recovery(Enum):
    """Action of a lock-step whose tick has no answer."""

    NOTHING = 'nothing'
    SEND_TICK = 'send the tick again'
    SEND_ALL = 'send the tick again, and the link angles before it'
    GIVE_UP = 'go on with the next tick'


class LockstepGuard:
    """
    Monitor of a lock-step: which participants are connected, and which one it waits for.

    :param clock: the lock-step.
    :param timeout_ns: time without an answer after which a tick is late [ns].
    :param settle_ns: time that DDS discovery needs after a node has joined [ns].
    """

    def __init__(self, clock: LockstepClock, timeout_ns: int, settle_ns: int) -> None:
        self._clock = clock
        self._timeout_ns = timeout_ns
        self._settle_ns = settle_ns
        self._present = Participants()
        self._began_ns: int | None = None
        self._joined_ns = 0
        self._answering_joined_ns = 0
        self._repeated_ns: int | None = None
        self._repeat_after_ns = timeout_ns

    def update(self, present: Participants, monotonic_ns: int) -> None:
        """Register the connected participants; the clock is ready once none has joined lately."""
        if self._began_ns is None:
            self._began_ns = monotonic_ns
        before = self._present
        if any(now > then for now, then in zip(astuple(present), astuple(before))):
            self._joined_ns = monotonic_ns
        if (present.command_publishers > before.command_publishers
                or present.estimate_publishers > before.estimate_publishers):
            self._answering_joined_ns = monotonic_ns
        self._present = present
        if not present.missing() and monotonic_ns - self._joined_ns >= self._settle_ns:
            self._clock.ready = True

    def waiting_for(self, estimate_ns: int | None, monotonic_ns: int) -> str:
        """
        Return which node is late, and what it has not sent; '' if none is late.

        :param estimate_ns: stamp of the last estimate, None before the first [ns].
        """
        if not self._clock.ready:
            late = (not self._clock.paused and self._began_ns is not None
                    and monotonic_ns - self._began_ns > self._timeout_ns)
            return self._present.missing() if late else ''
        if self._clock.waiting_ns(monotonic_ns) <= self._timeout_ns:
            return ''
        if missing := self._present.missing():
            return missing
        if self._present.estimate_publishers and estimate_ns != self._clock.pending_ns:
            return 'estimator: no estimate/link_states for this tick'
        return 'controller: no flywheel_command for this tick'

    def recovery(self, estimate_ns: int | None, monotonic_ns: int) -> Recovery:
        """
        Return what to do now about a tick without an answer.

        If a participant joined after the tick, the tick is given up. If all were connected, the
        tick or its answer was lost, for instance during discovery, and the tick is sent again at
        growing intervals. A node that has received it answers as before, so the samples of the
        run do not change.

        :param estimate_ns: stamp of the last estimate, None before the first [ns].
        """
        if self.is_unanswerable(monotonic_ns):
            return Recovery.GIVE_UP
        pending_ns = self._clock.pending_ns
        waiting_ns = self._clock.waiting_ns(monotonic_ns)
        if pending_ns != self._repeated_ns:
            self._repeated_ns, self._repeat_after_ns = pending_ns, self._timeout_ns
        if (pending_ns is None or waiting_ns <= self._repeat_after_ns or self._present.missing()
                or waiting_ns > monotonic_ns - self._answering_joined_ns):
            return Recovery.NOTHING
        self._repeat_after_ns = waiting_ns + min(waiting_ns, MAX_REPEAT_NS)
        return Recovery.SEND_TICK if estimate_ns == pending_ns else Recovery.SEND_ALL

    def is_unanswerable(self, monotonic_ns: int) -> bool:
        """
        Tell whether the last tick was sent before an estimator or controller joined.

        All participants must be connected now, and the tick must be late.
        """
        waiting_ns = self._clock.waiting_ns(monotonic_ns)
        since_join_ns = monotonic_ns - self._answering_joined_ns
        return (waiting_ns > max(self._timeout_ns, since_join_ns)
                and since_join_ns >= self._settle_ns and not self._present.missing())


class RateLimit:
    """
    Limit of the rate of a publication.

    :param interval_ns: smallest interval, in monotonic time [ns].
    """

    def __init__(self, interval_ns: int) -> None:
        self._interval_ns = interval_ns
        self._last_ns: int | None = None

    def passes(self, monotonic_ns: int) -> bool:
        """Tell whether the interval is over, and start the next one if so."""
        if self._last_ns is not None and monotonic_ns - self._last_ns < self._interval_ns:
            return False
        self._last_ns = monotonic_ns
        return True
