# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
When ticks are due: in real time, in simulated time, or when the last one is answered.

Times come in as arguments. There are two: stamps, the time that messages carry and the plant
lives in, and a steady clock that nobody can set. While a pace is paused its time stands still.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import astuple, dataclass
from enum import Enum
from math import isfinite

from fourbar_ros.common.errors import FourbarError

# Where simulated time starts: 0 would mean `now` or `never` to others.
FIRST_STAMP_NS = 1_000_000_000


# A tick without an answer is sent again at ever longer intervals, up to this one [ns].
LONGEST_REPEAT_NS = 10_000_000_000


class ClockModeError(FourbarError):
    """A tick that cannot be made now, or a pace that there is not."""


class ClockMode(ABC):
    """
    Ticks one period apart.

    :param first_ns: stamp of the first tick [ns].
    :param period_ns: [ns].
    :ivar paused: whether ticks come by `step` only.
    :ivar ticks: how many there were.
    :ivar skipped: how many were left out.
    :ivar pending_ns: stamp of the tick that waits for its answer, None if none does [ns].
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
        """Tell whether there is a tick to make."""

    @abstractmethod
    def now_ns(self, monotonic_ns: int) -> int:
        """
        Read the time that watchdogs run on; it never goes back.

        :returns: a time on the scale of the stamps, standing still while paused [ns].
        """

    def due(self, monotonic_ns: int) -> int | None:
        """
        Take the oldest tick that is due.

        One at a time, so that commands get their turn between two ticks that are both late.

        :returns: its stamp [ns], None if no tick is due.
        """
        return self._take(monotonic_ns) if self.is_due(monotonic_ns) else None

    @property
    def next_ns(self) -> int:
        """Stamp of the next tick, if none is left out [ns]."""
        return self._next_ns

    def answered(self, stamp_ns: int) -> bool:
        """Take note of a command, by its stamp; tell whether a tick waited for it."""
        return False

    def give_up(self) -> None:
        """Wait no longer for an answer to the last tick."""
        self.pending_ns = None

    def pause(self, monotonic_ns: int) -> None:
        """Let time stand still."""
        if not self.paused:
            self._frozen_ns = self.now_ns(monotonic_ns)
            self.paused = True

    def resume(self, monotonic_ns: int) -> None:
        """Let time go on from where it stood still."""
        self.paused = False

    def step(self, monotonic_ns: int) -> int:
        """
        Take the next tick while paused.

        :returns: its stamp [ns].
        :raises PaceError: it is not paused.
        """
        if not self.paused:
            raise ClockModeError('the clock is running, pause it first')
        self._frozen_ns = self._take(monotonic_ns)
        return self._frozen_ns

    def _take(self, monotonic_ns: int) -> int:
        stamp_ns = self._next_ns
        self._next_ns += self._period_ns
        self.ticks += 1
        return stamp_ns


class RealtimeClock(ClockMode):
    """
    Ticks at system time at start plus steady elapsed time, one per period.

    Small delays are caught up with, tick by tick. After a long one (a suspended machine) the
    ticks that nobody could have answered are left out. A pause is no delay: what comes after it
    is stamped as if it had not been, behind system time by so much.

    :param system_ns: system time now, the stamp of the first tick [ns].
    :param steady_ns: steady time now [ns].
    :param period_ns: [ns].
    :param patience_ns: how long a delay is caught up with [ns].
    """

    def __init__(self, system_ns: int, monotonic_ns: int, period_ns: int, patience_ns: int
                 ) -> None:
        super().__init__(system_ns, period_ns)
        self._offset_ns = system_ns - monotonic_ns
        self._patience_ns = patience_ns

    def is_due(self, monotonic_ns: int) -> bool:
        """Tell whether there is a tick to make."""
        return not self.paused and monotonic_ns + self._offset_ns >= self._next_ns

    def now_ns(self, monotonic_ns: int) -> int:
        """Read the steady clock on the scale of the stamps [ns]."""
        return self._frozen_ns if self.paused else monotonic_ns + self._offset_ns

    def resume(self, monotonic_ns: int) -> None:
        """Let time go on from where it stood still."""
        if self.paused:
            self._offset_ns = self._frozen_ns - monotonic_ns
        super().resume(monotonic_ns)

    def _take(self, monotonic_ns: int) -> int:
        behind_ns = self.now_ns(monotonic_ns) - self._next_ns
        if behind_ns > self._patience_ns:
            missed = behind_ns // self._period_ns
            self.skipped += missed
            self._next_ns += missed * self._period_ns
        return super()._take(monotonic_ns)


class FastClock(ClockMode):
    """
    Ticks in simulated time that passes so many times as fast as steady time.

    Where the machine cannot keep up, simulated time slows down; no tick is left out.

    :param steady_ns: steady time now, when simulated time is 1 s [ns].
    :param period_ns: [ns].
    :param factor: seconds of simulated time per second; 0 for as fast as it can.
    :param patience_ns: how long a delay is caught up with [ns of steady time].
    :raises PaceError: a factor that is negative or not finite.
    """

    def __init__(self, monotonic_ns: int, period_ns: int, factor: float, patience_ns: int) -> None:
        if not (isfinite(factor) and factor >= 0.0):
            raise ClockModeError(
                f'the real-time factor must be 0 (as fast as it can) or positive, got {factor:g}')
        super().__init__(FIRST_STAMP_NS, period_ns)
        self._factor = factor
        self._patience_ns = patience_ns
        self._anchor(FIRST_STAMP_NS, monotonic_ns)

    def is_due(self, monotonic_ns: int) -> bool:
        """Tell whether there is a tick to make."""
        return not self.paused and self._unbounded_ns(monotonic_ns) >= self._next_ns

    def now_ns(self, monotonic_ns: int) -> int:
        """Read simulated time, which does not pass a tick that is still to be made [ns]."""
        if self.paused:
            return self._frozen_ns
        if not self._factor:
            return self._last_ns
        return min(self._unbounded_ns(monotonic_ns), self._next_ns)

    def resume(self, monotonic_ns: int) -> None:
        """Let time go on from where it stood still."""
        if self.paused:
            self._anchor(self._frozen_ns, monotonic_ns)
        super().resume(monotonic_ns)

    @property
    def _last_ns(self) -> int:
        """Return the stamp of the last tick, or of the first before it [ns]."""
        return max(FIRST_STAMP_NS, self._next_ns - self._period_ns)

    def _anchor(self, simulated_ns: int, monotonic_ns: int) -> None:
        self._anchor_ns, self._anchor_steady_ns = simulated_ns, monotonic_ns

    def _unbounded_ns(self, monotonic_ns: int) -> int:
        if not self._factor:
            return self._next_ns
        elapsed_ns = monotonic_ns - self._anchor_steady_ns
        return self._anchor_ns + round(elapsed_ns * self._factor)

    def _take(self, monotonic_ns: int) -> int:
        behind_ns = self._unbounded_ns(monotonic_ns) - self._next_ns
        if not self.paused and behind_ns > self._patience_ns * self._factor:
            self._anchor(self._next_ns, monotonic_ns)
        return super()._take(monotonic_ns)


class LockstepClock(ClockMode):
    """
    The next tick is due when the last one is answered; simulated time is the last tick's.

    :param period_ns: [ns].
    :ivar ready: whether there is somebody to answer; no tick is due before.
    """

    def __init__(self, period_ns: int) -> None:
        super().__init__(FIRST_STAMP_NS, period_ns)
        self.ready = False
        self._now_ns = FIRST_STAMP_NS
        self._taken_steady_ns = 0

    def is_due(self, monotonic_ns: int) -> bool:
        """Tell whether there is a tick to make."""
        return self.ready and not self.paused and self.pending_ns is None

    def now_ns(self, monotonic_ns: int) -> int:
        """Return the stamp of the last tick [ns]."""
        return self._now_ns

    def answered(self, stamp_ns: int) -> bool:
        """Take note of a command, by its stamp; tell whether a tick waited for it."""
        if stamp_ns != self.pending_ns:
            return False
        self.pending_ns = None
        return True

    def waiting_ns(self, monotonic_ns: int) -> int:
        """Return for how long the last tick has had no answer, 0 if it has one [ns]."""
        return 0 if self.pending_ns is None else monotonic_ns - self._taken_steady_ns

    def step(self, monotonic_ns: int) -> int:
        """
        Take the next tick while paused.

        :returns: its stamp [ns].
        :raises PaceError: it is not paused, nobody is there, or the last tick has no answer yet.
        """
        if self.paused and not self.ready:
            raise ClockModeError('nobody is there yet to answer a tick')
        if self.paused and self.pending_ns is not None:
            raise ClockModeError(f'the tick at {self.pending_ns * 1e-9:.9f} s is not answered yet')
        return super().step(monotonic_ns)

    def _take(self, monotonic_ns: int) -> int:
        self._now_ns = self.pending_ns = super()._take(monotonic_ns)
        self._taken_steady_ns = monotonic_ns
        return self._now_ns


@dataclass(frozen=True)
class Participants:
    """
    How many are connected to the topics that a tick and its answer pass through.

    :param tick_subscribers: of flywheel_states.
    :param angle_subscribers: of link_angles.
    :param command_publishers: of flywheel_command.
    :param estimate_publishers: of estimate/link_states.
    :param estimate_subscribers: of estimate/link_states, among those who publish commands.
    """

    tick_subscribers: int = 0
    angle_subscribers: int = 0
    command_publishers: int = 0
    estimate_publishers: int = 0
    estimate_subscribers: int = 0

    def missing(self) -> str:
        """Tell which node cannot answer since it is not there, '' if all are."""
        if not self.command_publishers:
            return 'controller: nobody publishes flywheel_command'
        if self.estimate_subscribers and not self.estimate_publishers:
            return 'estimator: nobody publishes estimate/link_states'
        if self.estimate_publishers and not self.angle_subscribers:
            return 'estimator: nobody takes link_angles'
        if not self.tick_subscribers:
            return 'controller: nobody takes flywheel_states'
        return ''


class Recovery(Enum):
    """What helps a lock-step whose tick has no answer."""

    NOTHING = 'nothing'
    SEND_TICK = 'send the tick again'
    SEND_ALL = 'send the tick again, and the link angles before it'
    GIVE_UP = 'go on with the next tick'


class LockstepGuard:
    """
    Watch over a lock-step: who is there, for whom it waits, and who joined meanwhile.

    :param pace: the lock-step.
    :param timeout_ns: how long a tick may wait before it is worth a word [ns].
    :param settle_ns: how long nodes need to find each other after one has joined [ns].
    """

    def __init__(self, pace: LockstepClock, timeout_ns: int, settle_ns: int) -> None:
        self._pace = pace
        self._timeout_ns = timeout_ns
        self._settle_ns = settle_ns
        self._present = Participants()
        self._began_ns: int | None = None
        self._joined_ns = 0
        self._answerer_joined_ns = 0
        self._repeated_ns: int | None = None
        self._repeat_after_ns = timeout_ns

    def look(self, present: Participants, monotonic_ns: int) -> None:
        """Take note of who is there now; the pace is ready once all were for a while."""
        if self._began_ns is None:
            self._began_ns = monotonic_ns
        before = self._present
        if any(now > then for now, then in zip(astuple(present), astuple(before))):
            self._joined_ns = monotonic_ns
        if (present.command_publishers > before.command_publishers
                or present.estimate_publishers > before.estimate_publishers):
            self._answerer_joined_ns = monotonic_ns
        self._present = present
        if not present.missing() and monotonic_ns - self._joined_ns >= self._settle_ns:
            self._pace.ready = True

    def awaited(self, estimate_ns: int | None, monotonic_ns: int) -> str:
        """
        Tell for whom the pace has waited longer than it should.

        :param estimate_ns: stamp of the last estimate, None before the first [ns].
        :returns: the node and what did not come from it, '' if nobody is late.
        """
        if not self._pace.ready:
            late = (not self._pace.paused and self._began_ns is not None
                    and monotonic_ns - self._began_ns > self._timeout_ns)
            return self._present.missing() if late else ''
        if self._pace.waiting_ns(monotonic_ns) <= self._timeout_ns:
            return ''
        if missing := self._present.missing():
            return missing
        if self._present.estimate_publishers and estimate_ns != self._pace.pending_ns:
            return 'estimator: no estimate/link_states for this tick'
        return 'controller: no flywheel_command for this tick'

    def remedy(self, estimate_ns: int | None, monotonic_ns: int) -> Recovery:
        """
        Tell what to do now about a tick without an answer.

        Either somebody joined after it went out, and it is given up; or all were there, and the
        tick or what answers it was lost on the way, perhaps because two nodes did not know each
        other yet. Then it is sent again, at intervals that grow: whoever has it already answers
        as before, so the samples of the run stay the same.

        :param estimate_ns: stamp of the last estimate, None before the first [ns].
        """
        if self.is_hopeless(monotonic_ns):
            return Recovery.GIVE_UP
        pending_ns = self._pace.pending_ns
        waiting_ns = self._pace.waiting_ns(monotonic_ns)
        if pending_ns != self._repeated_ns:
            self._repeated_ns, self._repeat_after_ns = pending_ns, self._timeout_ns
        if (pending_ns is None or waiting_ns <= self._repeat_after_ns or self._present.missing()
                or waiting_ns > monotonic_ns - self._answerer_joined_ns):
            return Recovery.NOTHING
        self._repeat_after_ns = waiting_ns + min(waiting_ns, LONGEST_REPEAT_NS)
        return Recovery.SEND_TICK if estimate_ns == pending_ns else Recovery.SEND_ALL

    def is_hopeless(self, monotonic_ns: int) -> bool:
        """
        Tell whether the tick should be given up, since who should answer was not there yet.

        That is so when an estimator or controller joined after it went out, all are there, and
        it stays without an answer for longer than it should.
        """
        waiting_ns = self._pace.waiting_ns(monotonic_ns)
        since_join_ns = monotonic_ns - self._answerer_joined_ns
        return (waiting_ns > max(self._timeout_ns, since_join_ns)
                and since_join_ns >= self._settle_ns and not self._present.missing())


class ClockLimit:
    """
    How often the simulated time is told.

    :param shortest_ns: between two times [ns of steady time].
    """

    def __init__(self, shortest_ns: int) -> None:
        self._shortest_ns = shortest_ns
        self._last_ns: int | None = None

    def passes(self, monotonic_ns: int) -> bool:
        """Tell whether it may be told now, and take it as told if so."""
        if self._last_ns is not None and monotonic_ns - self._last_ns < self._shortest_ns:
            return False
        self._last_ns = monotonic_ns
        return True
