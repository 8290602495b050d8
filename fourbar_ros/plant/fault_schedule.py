# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The present faults, set by hand or by a schedule.

A schedule is a list of entries, in a YAML file under `faults`:

    faults:
      - {at: 2.0, until: 5.0, target: link_b, fault: wrong, value: 0.1}
      - {at: 8.0, target: flywheel_a, fault: dead}

Times are simulated seconds since the start. A fault without `until` stays; one without `value` has
the default of its kind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from fourbar_ros.common.config_files import load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import check_keys, Setting
from fourbar_ros.plant.faults import Fault, fault_kinds, FaultError, parse_fault

# Latest time of a schedule [s]: 30 years, which fits the integer nanoseconds of a stamp.
LATEST_S = 1e9

_TIMES = {name: Setting(name, 0.0, 's', meaning, low=0.0, high=LATEST_S)
          for name, meaning in (('at', 'begin of the fault'), ('until', 'end of the fault'))}


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
    A fault with its times since the start.

    :param at_ns: begin [ns].
    :param until_ns: end, None for ever [ns].
    """

    fault: Fault
    at_ns: int
    until_ns: int | None


@dataclass(frozen=True)
class FaultChange:
    """
    The begin or end of a fault.

    :param elapsed_ns: its time since the start [ns].
    :param target: sensor or wheel.
    :param fault: None at its end.
    """

    elapsed_ns: int
    target: str
    fault: Fault | None


def parse_schedule(entries: Any, targets: Sequence[str], origin: str,
                   elapsed_ns: int = 0) -> tuple[ScheduledFault, ...]:
    """
    Check a schedule.

    :param entries: list of mappings, see the head of this module.
    :param targets: names of the present sensors and wheels.
    :param origin: file or parameter of the entries, for messages.
    :param elapsed_ns: now, since the start [ns].
    :returns: in the order of the entries.
    :raises FaultError: an entry is invalid, lies in the past, or overlaps with another entry on
        the same target; `values['entry']` is its number, from 1.
    """
    if isinstance(entries, (str, Mapping)) or not isinstance(entries, Sequence):
        raise FaultError(f'{origin}: a schedule of faults must be a list, got {entries!r}',
                         place=origin, value=entries, limit=list)
    schedule: list[ScheduledFault] = []
    for number, entry in enumerate(entries, 1):
        place = f'{origin}, entry {number}'
        if not isinstance(entry, Mapping):
            raise FaultError(
                f'{place} must be a mapping with at, target and fault, got {entry!r}',
                place=place, entry=number, value=entry, limit=dict)
        check_keys(entry, ('at', 'target', 'fault'), place, FaultError, ('until', 'value'))
        try:
            scheduled = _parse_entry(entry, targets, elapsed_ns)
        except FourbarError as error:
            raise error.at(place, FaultError) from None
        for earlier, other in enumerate(schedule, 1):
            if _overlap(scheduled, other):
                raise FaultError(
                    f'{place}: overlaps with entry {earlier} on {scheduled.fault.target}, which '
                    'can have one fault at a time', place=place, entry=number, overlaps=earlier,
                    name=scheduled.fault.target)
        schedule.append(scheduled)
    return tuple(schedule)


class FaultBoard:
    """
    The faults of a testbed, at most one for each sensor and wheel.

    :param targets: names of its sensors and wheels.
    """

    def __init__(self, targets: Sequence[str]) -> None:
        self.targets = tuple(targets)
        self._faults: dict[str, Fault] = {}
        self._scheduled: list[tuple[int, bool, ScheduledFault]] = []

    @property
    def faults(self) -> Mapping[str, Fault]:
        """The present faults by target; a view that follows the changes."""
        return MappingProxyType(self._faults)

    def parse(self, target: str, text: str) -> Fault | None:
        """
        Read a fault of a target of this testbed, as `parse_fault` does.

        :raises FaultError: as there, or the testbed has no such sensor or wheel.
        """
        fault = parse_fault(target, text)
        if fault is not None:
            _check_target(target, self.targets)
        return fault

    def set_fault(self, target: str, fault: Fault | None) -> None:
        """
        Set the fault of a target, None for no fault.

        The fault stays until the next change, by hand or by the schedule. A scheduled end removes
        only the fault of its own entry.

        :raises FaultError: no such sensor or wheel, or a fault of another target.
        """
        _check_target(target, self.targets)
        if fault is None:
            self._faults.pop(target, None)
        elif fault.target != target:
            raise FaultError(f'a fault of {fault.target} cannot be set on {target}',
                             name=target, value=fault.target)
        else:
            self._faults[target] = fault

    def load(self, entries: Any, origin: str, elapsed_ns: int = 0) -> None:
        """
        Replace the schedule.

        Faults of the old schedule that have not ended yet end now.

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
        Apply the schedule up to a time.

        :param elapsed_ns: since the start [ns].
        :returns: the changes in the order of their times; at the same time in the order of the
            schedule, ends first.
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
        """Remove a scheduled fault, unless it was replaced; return whether it was removed."""
        fault = scheduled.fault
        if self._faults.get(fault.target) is not fault:
            return False
        del self._faults[fault.target]
        return True


def _events(scheduled: ScheduledFault) -> list[tuple[int, bool, ScheduledFault]]:
    """Return the times of a scheduled fault, each with whether it begins then."""
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
    at_ns = _nanoseconds('at', entry)
    if at_ns < elapsed_ns:
        raise FaultError(f'at {entry["at"]} s lies in the past, now is {elapsed_ns * 1e-9:g} s',
                         name='at', value=entry['at'], limit=elapsed_ns * 1e-9)
    if entry.get('until') is None:
        return ScheduledFault(fault, at_ns, None)
    until_ns = _nanoseconds('until', entry)
    if until_ns <= at_ns:
        raise FaultError(f'until {entry["until"]} s must be later than at {entry["at"]} s',
                         name='until', value=entry['until'], limit=entry['at'])
    return ScheduledFault(fault, at_ns, until_ns)


def _check_target(target: Any, targets: Sequence[str]) -> None:
    fault_kinds(target)
    if target not in targets:
        raise FaultError(f'this testbed has no {target} (it has {", ".join(targets)})',
                         name='target', value=target, limit=tuple(targets))


def _nanoseconds(name: str, entry: Mapping[str, Any]) -> int:
    seconds: float = _TIMES[name].check(entry[name])
    return round(seconds * 1e9)
