# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Which faults there are now, set by hand or by a schedule.

A schedule is a list of entries, in a YAML file under `faults`:

    faults:
      - {at: 2.0, until: 5.0, target: link_b, fault: wrong, value: 0.1}
      - {at: 8.0, target: flywheel_a, fault: dead}

with times in simulated seconds since the start. Without `until` a fault stays, without `value` it
has the default of its kind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from fourbar_ros.common.config_files import load_yaml
from fourbar_ros.common.settings import check_keys
from fourbar_ros.plant.faults import Fault, fault_kinds, FaultError, parse_fault

LATEST_S = 1e9
"""End of the times that a schedule may name [s]."""


def read_schedule(path: str) -> Any:
    """
    Read the entries of a schedule from a YAML file, its list `faults`.

    :raises ConfigurationError: it cannot be read or is not YAML.
    :raises FaultError: there is no such list.
    """
    content = load_yaml(path)
    check_keys(content, ('faults',), path, FaultError)
    return content['faults']


@dataclass(frozen=True)
class ScheduledFault:
    """
    A fault with its time, since the start.

    :param at_ns: from when on [ns].
    :param until_ns: until when, None for ever [ns].
    """

    fault: Fault
    at_ns: int
    until_ns: int | None


@dataclass(frozen=True)
class FaultChange:
    """
    A fault that came or went.

    :param elapsed_ns: when, since the start [ns].
    :param target: what it hits.
    :param fault: None where it went.
    """

    elapsed_ns: int
    target: str
    fault: Fault | None


def parse_schedule(entries: Any, targets: Sequence[str], origin: str,
                   elapsed_ns: int = 0) -> tuple[ScheduledFault, ...]:
    """
    Check a schedule.

    :param entries: list of mappings, see the head of this module.
    :param targets: names of the sensors and wheels that there are.
    :param origin: where the entries come from, for messages.
    :param elapsed_ns: now, since the start [ns].
    :returns: in the order given.
    :raises FaultError: an entry means nothing, lies in the past, or overlaps with another one on
        the same target; the message says which, counted from 1.
    """
    if isinstance(entries, (str, Mapping)) or not isinstance(entries, Sequence):
        raise FaultError(f'{origin}: a schedule of faults must be a list, got {entries!r}')
    schedule: list[ScheduledFault] = []
    for number, entry in enumerate(entries, 1):
        place = f'{origin}, entry {number}'
        if not isinstance(entry, Mapping):
            raise FaultError(
                f'{place} must be a mapping with at, target and fault, got {entry!r}')
        check_keys(entry, ('at', 'target', 'fault'), place, FaultError, ('until', 'value'))
        try:
            scheduled = _parse_entry(entry, targets, elapsed_ns)
        except FaultError as error:
            raise FaultError(f'{place}: {error}') from None
        for earlier, other in enumerate(schedule, 1):
            if _overlap(scheduled, other):
                raise FaultError(
                    f'{place}: overlaps with entry {earlier} on {scheduled.fault.target}, which '
                    'can have one fault at a time')
        schedule.append(scheduled)
    return tuple(schedule)


class FaultBoard:
    """
    The faults of a testbed, at most one for each sensor and wheel.

    :param targets: names of the sensors and wheels that there are.
    """

    def __init__(self, targets: Sequence[str]) -> None:
        self.targets = tuple(targets)
        self._faults: dict[str, Fault] = {}
        self._scheduled: list[tuple[int, bool, ScheduledFault]] = []

    @property
    def faults(self) -> Mapping[str, Fault]:
        """The faults there are now, by what they hit; a view that follows the changes."""
        return MappingProxyType(self._faults)

    def parse(self, target: str, text: str) -> Fault | None:
        """
        Read a fault of something that is here, as `parse_fault` does.

        :raises FaultError: as there, or there is no such sensor or wheel.
        """
        fault = parse_fault(target, text)
        if fault is not None:
            _check_target(target, self.targets)
        return fault

    def set_fault(self, target: str, fault: Fault | None) -> None:
        """
        Break something now, or mend it with None.

        It counts until the next change, by hand or by the schedule. A scheduled end only takes
        away the fault that the same entry brought.

        :raises FaultError: there is no such sensor or wheel, or the fault is of another one.
        """
        _check_target(target, self.targets)
        if fault is None:
            self._faults.pop(target, None)
        elif fault.target != target:
            raise FaultError(f'a fault of {fault.target} cannot be one of {target}')
        else:
            self._faults[target] = fault

    def load(self, entries: Any, origin: str, elapsed_ns: int = 0) -> None:
        """
        Follow a schedule from now on, instead of the one so far.

        What the one so far has broken and would have mended later is mended now.

        :param entries, origin, elapsed_ns: see `parse_schedule`.
        :raises FaultError: the schedule is refused; then nothing was changed.
        """
        schedule = parse_schedule(entries, self.targets, origin, elapsed_ns)
        for _, begins, scheduled in self._scheduled:
            if not begins:
                self._end(scheduled)
        self._scheduled = [event for scheduled in schedule for event in _events(scheduled)]
        # Ends come before beginnings, so that one fault may follow another on the same target
        # at once; else the order is that of the schedule.
        self._scheduled.sort(key=lambda event: event[:2])

    def at_time(self, elapsed_ns: int) -> tuple[FaultChange, ...]:
        """
        Apply all that the schedule says up to a time.

        :param elapsed_ns: since the start [ns].
        :returns: what changed, in the order of its times; those that are due at the same time in
            the order of the schedule, ends first.
        """
        changes = []
        while self._scheduled and self._scheduled[0][0] <= elapsed_ns:
            at_ns, begins, scheduled = self._scheduled.pop(0)
            fault = scheduled.fault
            if begins:
                self._faults[fault.target] = fault
                changes.append(FaultChange(at_ns, fault.target, fault))
            elif self._end(scheduled):
                changes.append(FaultChange(at_ns, fault.target, None))
        return tuple(changes)

    def _end(self, scheduled: ScheduledFault) -> bool:
        """Mend what a scheduled fault broke, unless somebody else did or broke it otherwise."""
        fault = scheduled.fault
        if self._faults.get(fault.target) is not fault:
            return False
        del self._faults[fault.target]
        return True


def _events(scheduled: ScheduledFault) -> list[tuple[int, bool, ScheduledFault]]:
    """Return when a scheduled fault ends (False) and begins (True)."""
    begin = (scheduled.at_ns, True, scheduled)
    if scheduled.until_ns is None:
        return [begin]
    return [begin, (scheduled.until_ns, False, scheduled)]


def _overlap(one: ScheduledFault, other: ScheduledFault) -> bool:
    return (one.fault.target == other.fault.target
            and (one.until_ns is None or other.at_ns < one.until_ns)
            and (other.until_ns is None or one.at_ns < other.until_ns))


def _parse_entry(entry: Mapping[str, Any], targets: Sequence[str],
                 elapsed_ns: int) -> ScheduledFault:
    _check_target(entry['target'], targets)
    # YAML reads a bare off as false.
    kind = 'off' if entry['fault'] is False else entry['fault']
    fault = Fault(entry['target'], kind, entry.get('value'))
    at_ns = _nanoseconds('at', entry['at'])
    if at_ns < elapsed_ns:
        raise FaultError(f'at {entry["at"]} s lies in the past, it is {elapsed_ns * 1e-9:g} s now')
    if entry.get('until') is None:
        return ScheduledFault(fault, at_ns, None)
    until_ns = _nanoseconds('until', entry['until'])
    if until_ns <= at_ns:
        raise FaultError(f'until {entry["until"]} s must be later than at {entry["at"]} s')
    return ScheduledFault(fault, at_ns, until_ns)


def _check_target(target: Any, targets: Sequence[str]) -> None:
    fault_kinds(target)
    if target not in targets:
        raise FaultError(f'there is no {target} here (there are {", ".join(targets)})')


def _nanoseconds(name: str, seconds: Any) -> int:
    if isinstance(seconds, bool) or not isinstance(seconds, (int, float)):
        raise FaultError(f'{name} must be a number of seconds, got {seconds!r}')
    if not 0.0 <= seconds <= LATEST_S:
        raise FaultError(f'{name} must be from 0 to {LATEST_S:g} s, got {seconds}')
    return round(seconds * 1e9)
