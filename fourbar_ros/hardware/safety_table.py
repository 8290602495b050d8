# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Safety rules of the prototype: conditions, limits, and the reaction when a limit is exceeded.

A lab may change limits and reactions in a file, but each rule has a least severe reaction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, MISSING
from typing import NamedTuple

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import check_keys, setting, SettingError, Settings
from fourbar_ros.device.interface import Reaction


class SafetyError(FourbarError):
    """A table of safety rules that is refused."""


class Condition(NamedTuple):
    """
    What a rule watches.

    :param least: least severe reaction that a file may choose.
    :param text: message, with the fields `value` and `limit`.
    """

    least: Reaction
    text: str


_WARN, _COAST = Reaction.WARN, Reaction.COAST
# By name of the rule. Conditions under which a wheel may be out of control at least coast.
CONDITIONS = {
    'wheel_silent': Condition(
        _COAST, 'no answer from the wheel for {value:.3g} s, limit {limit:g} s'),
    'heartbeat_lost': Condition(_COAST, 'no heartbeat for {value:.3g} s, limit {limit:g} s'),
    'not_armed': Condition(_COAST, 'the wheel has power, but the link is {value}'),
    'link_fault': Condition(_COAST, 'the link reports {value}'),
    'reboot': Condition(_COAST, 'the link has restarted while armed'),
    'two_of_one_id': Condition(_COAST, '{value} links use this identifier'),
    'overspeed': Condition(_COAST, 'wheel speed {value:.4g} rad/s, limit {limit:.4g} rad/s'),
    'unasked_torque': Condition(
        _COAST, 'motor torque {value:.3g} N m without power, limit {limit:.3g} N m'),
    'disagreement': Condition(
        _WARN, 'motor torque differs from the command by {value:.3g} N m, limit {limit:.3g} N m'),
    'hot': Condition(_WARN, 'temperature {value:.3g} deg C, limit {limit:g} deg C'),
    'overtemperature': Condition(_COAST, 'temperature {value:.3g} deg C, limit {limit:g} deg C'),
    'low_voltage': Condition(_WARN, 'supply voltage {value:.3g} V, limit at least {limit:g} V'),
    'undervoltage': Condition(_COAST, 'supply voltage {value:.3g} V, limit at least {limit:g} V'),
    'bad_frames': Condition(_WARN, '{value:.0f} rejected frames per second, limit {limit:g}'),
    'wheel_speed_to_arm': Condition(
        _COAST, 'wheel speed {value:.3g} rad/s, limit for arming {limit:g} rad/s'),
}


@dataclass(frozen=True)
class Rule(Settings):
    """One rule of the table; its limit is in the unit of its condition."""

    limit: float = setting(MISSING, '', 'largest allowed value', low=0.0)
    lasting: float = setting(MISSING, 's', 'time for which the limit may be exceeded', low=0.0)
    reaction: str = setting(MISSING, '', 'reaction after that time',
                            choices=tuple(reaction.name.lower() for reaction in Reaction))

    @property
    def level(self) -> Reaction:
        """The reaction."""
        return Reaction[self.reaction.upper()]


SafetyTable = Mapping[str, Rule]


def load_safety(name: str) -> SafetyTable:
    """
    Read a table of safety rules.

    :param name: a preset (`prototype` for config/safety_prototype.yaml) or the path of a file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises SafetyError: a rule is missing, unknown or refused.
    """
    path = config_file('safety', name)
    values = load_yaml(path)
    check_keys(values, set(CONDITIONS), str(path), SafetyError)
    table = {}
    for name, condition in CONDITIONS.items():
        try:
            rule = table[name] = Rule.from_mapping(values[name], name)
        except SettingError as error:
            raise error.at(path, SafetyError) from None
        if rule.level < condition.least:
            least = condition.least.name.lower()
            raise SafetyError(
                f'{path}: {name}.reaction must be at least {least}, got {rule.reaction}',
                name=f'{name}.reaction', place=str(path), value=rule.reaction, limit=least)
    return table
