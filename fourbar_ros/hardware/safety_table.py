# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What the host watches on the prototype, with its limits, and what each leads to: a table in a file.

A lab may change limits and reactions, but not let go on what nobody can go on with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import check_keys
from fourbar_ros.device.interface import DeviceFault, Reaction


class SafetyError(FourbarError):
    """A table of limits and reactions that is refused."""


@dataclass(frozen=True)
class Rule:
    """
    One row of the table.

    :param limit: what is still allowed, in the row's own unit.
    :param lasting: for how long more is borne [s].
    :param reaction: what it leads to then.
    """

    limit: float
    lasting: float
    reaction: Reaction


# The rows, with the least reaction to each. Where a wheel is not heard, or turns for no reason,
# there is no going on.
LEAST = {
    'wheel_silent': Reaction.COAST, 'heartbeat_lost': Reaction.COAST,
    'not_armed': Reaction.COAST, 'link_fault': Reaction.COAST, 'reboot': Reaction.COAST,
    'two_of_one_id': Reaction.COAST, 'overspeed': Reaction.COAST,
    'unasked_torque': Reaction.COAST, 'disagreement': Reaction.WARN, 'hot': Reaction.WARN,
    'overtemperature': Reaction.COAST, 'low_voltage': Reaction.WARN,
    'undervoltage': Reaction.COAST, 'bad_frames': Reaction.WARN,
    'wheel_speed_to_arm': Reaction.COAST,
}
SafetyTable = Mapping[str, Rule]


def load_safety(name: str) -> SafetyTable:
    """
    Read a table of limits and reactions.

    :param name: a preset (`prototype` for config/safety_prototype.yaml) or the path of a file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises SafetyError: a row is missing, unknown or refused.
    """
    path = config_file('safety', name)
    values = load_yaml(path)
    check_keys(values, set(LEAST), str(path), SafetyError)
    return {row: _rule(values[row], f'{path}: {row}', LEAST[row]) for row in LEAST}


def _rule(values: Any, origin: str, least: Reaction) -> Rule:
    if not isinstance(values, dict):
        raise SafetyError(f'{origin} must be limit, lasting and reaction, got {values!r}')
    check_keys(values, {'limit', 'lasting', 'reaction'}, origin, SafetyError)
    for key in ('limit', 'lasting'):
        value = values[key]
        if isinstance(value, bool) or not isinstance(value, int | float) or not (
                isfinite(value) and value >= 0.0):
            raise SafetyError(f'{origin}: {key} must be a number and not negative, got {value!r}')
    choices = {reaction.name.lower(): reaction for reaction in Reaction}
    reaction = choices.get(values['reaction'])
    if reaction is None:
        raise SafetyError(f'{origin}: reaction must be one of {", ".join(choices)}, '
                          f'got {values["reaction"]!r}')
    if reaction < least:
        raise SafetyError(f'{origin}: reaction must be at least {least.name.lower()}, '
                          f'got {values["reaction"]}')
    return Rule(float(values['limit']), float(values['lasting']), reaction)


class SafetyWatch:
    """
    Takes down what is beyond its limit, and since when.

    :param table: the limits and reactions.
    """

    def __init__(self, table: SafetyTable) -> None:
        self.table = table
        self._since_ns: dict[tuple[str, str], int] = {}
        self._found: dict[tuple[str, str], str] = {}

    def look(self, row: str, where: str, beyond: bool, value: object, text: str, now_ns: int
             ) -> None:
        """
        Take a look at one thing.

        :param row: of the table.
        :param where: the link, or the bus.
        :param beyond: whether it is beyond its limit now.
        :param value: what it is now.
        :param text: to say it with, `{0}` for the value and `{1}` for the limit.
        :param now_ns: any clock that does not go back [ns].
        """
        key = row, where
        if not beyond:
            self._since_ns.pop(key, None)
            self._found.pop(key, None)
            return
        since_ns = self._since_ns.setdefault(key, now_ns)
        if now_ns - since_ns >= self.table[row].lasting * 1e9:
            self._found[key] = text.format(value, self.table[row].limit)

    def faults(self) -> tuple[DeviceFault, ...]:
        """Return what is beyond its limit for too long, the worst first."""
        found = [DeviceFault(self.table[row].reaction, f'{where}: {text}')
                 for (row, where), text in self._found.items()]
        return tuple(sorted(found, key=lambda finding: -finding.reaction))
