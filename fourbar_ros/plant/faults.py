# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What can break on the table: a sensor of the links, or the drive of a flywheel.

A fault hits one sensor or wheel, by its name in the topics, and there is at most one at a time on
each.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import nan, pi
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import FLYWHEEL_NAMES, SENSOR_NAMES
from fourbar_ros.mechanism.constants import Array
import numpy as np


class FaultError(FourbarError):
    """A fault that cannot be, of something that is not there, or at a time that cannot be."""


@dataclass(frozen=True)
class FaultKind:
    """
    One way to break.

    :param meaning: what it does, for people.
    :param quantity: what its value is, for people; empty where it takes none.
    :param unit: of the value, empty where it is a pure number.
    :param default: value where none is given.
    :param low, high: range of the value, both included.
    """

    meaning: str
    quantity: str = ''
    unit: str = ''
    default: float | None = None
    low: float = 0.0
    high: float = 0.0


SENSOR_FAULTS = {
    'off': FaultKind('gives no sample'),
    'stuck': FaultKind('repeats the last sample it gave, bit for bit, with new stamps'),
    'garbage': FaultKind('gives any angle, all equally likely; the gyro goes on'),
    'wrong': FaultKind('adds a constant to the angle', 'angle', 'rad', 0.1, -pi, pi),
    'slow': FaultKind('low-passes the angle', 'time constant', 's', 0.2, 0.0, 10.0),
    'delayed': FaultKind('gives its samples later', 'added latency', 's', 0.1, 0.0, 10.0),
    'intermittent': FaultKind('loses samples at random', 'probability', '', 0.5, 0.0, 1.0),
}
"""Faults of a link sensor."""

WHEEL_FAULTS = {
    'dead': FaultKind('the motor gives no torque'),
    'stuck': FaultKind('a brake holds the wheel to its link', 'torque', 'N m', 0.1, 0.0, 10.0),
    'weak': FaultKind('the motor gives a part of its torque', 'part', '', 0.5, 0.0, 1.0),
    'dragging': FaultKind('more friction in the bearing', 'torque', 'N m', 1e-4, 0.0, 10.0),
    'runaway': FaultKind('while powered the motor gives this torque, as far as it can, whatever '
                         'it is told', 'torque', 'N m', 10.0, -10.0, 10.0),
    'shorted': FaultKind('the power stage gives this torque, as far as the motor can, and cannot '
                         'be cut', 'torque', 'N m', 10.0, -10.0, 10.0),
    'delayed': FaultKind('the motor follows its commands later', 'delay', 's', 0.05, 0.0, 1.0),
}
"""Faults of a flywheel drive."""


@dataclass(frozen=True)
class Fault:
    """
    One fault of one sensor or wheel.

    :param target: what it hits: `link_a`, `joint_2`, `flywheel_c`.
    :param kind: one of SENSOR_FAULTS or WHEEL_FAULTS.
    :param value: how much, in the unit of the kind; the default of the kind where none is given,
        and None where it takes none.
    :raises FaultError: unknown target or kind, or a value that this kind cannot have.
    """

    target: str
    kind: str
    value: float | None = None

    def __post_init__(self) -> None:
        """Refuse what cannot break like this, and fill in the value."""
        kinds = fault_kinds(self.target)
        if self.kind not in tuple(kinds):
            raise FaultError(f'unknown fault {self.kind!r} of {self.target} '
                             f'(known are {", ".join(kinds)})')
        value = _checked_value(f'{self.kind} of {self.target}', kinds[self.kind], self.value)
        object.__setattr__(self, 'value', value)

    def __str__(self) -> str:
        """Write what `parse_fault` reads: `wrong 0.1`."""
        return self.kind if self.value is None else f'{self.kind} {self.value!r}'


def fault_kinds(target: str) -> Mapping[str, FaultKind]:
    """
    Return the ways in which a sensor or wheel can break, by name.

    :raises FaultError: there is no such sensor or wheel.
    """
    if target in SENSOR_NAMES:
        return SENSOR_FAULTS
    if target in FLYWHEEL_NAMES:
        return WHEEL_FAULTS
    known = ', '.join((*SENSOR_NAMES, *FLYWHEEL_NAMES))
    raise FaultError(f'nothing to break by the name of {target!r} (known are {known})')


def parse_fault(target: str, text: str) -> Fault | None:
    """
    Read a fault as people write it.

    :param target: what it hits.
    :param text: `KIND` or `KIND VALUE`; empty or `none` where nothing is broken.
    :returns: the fault, or None for none.
    :raises FaultError: unknown target or kind, or a value that this kind cannot have.
    """
    fault_kinds(target)
    words = text.split()
    if words in ([], ['none']):
        return None
    if len(words) > 2:
        raise FaultError(f'fault of {target} must be KIND or KIND VALUE, got {text!r}')
    if len(words) == 1:
        return Fault(target, words[0])
    try:
        value = float(words[1])
    except ValueError:
        raise FaultError(
            f'value of the fault {words[0]!r} of {target} must be a number, got {words[1]!r}'
        ) from None
    return Fault(target, words[0], value)


@dataclass(frozen=True, eq=False)
class WheelFaults:
    """
    What the faults of the four wheels do to their drives; the arrays are read-only.

    :param torque_scale: (4,) of the motor torque, 1 in health.
    :param extra_friction: (4,) Coulomb friction beyond that of the bearing [N m].
    :param forced_torque: (4,) torque of a powered motor whatever the command is [N m], NaN in
        health. It is not cut to what the motor can give.
    :param shorted_torque: (4,) likewise, powered or not.
    :param hold_torque: (4,) greatest torque of a brake between wheel and link [N m].
    :param command_delay_s: (4,) [s].
    """

    torque_scale: Array
    extra_friction: Array
    forced_torque: Array
    shorted_torque: Array
    hold_torque: Array
    command_delay_s: Array


def wheel_faults(faults: Iterable[Fault]) -> WheelFaults:
    """
    Turn faults into what they do to the drives of the wheels.

    :param faults: at most one for each target; those of sensors change nothing here.
    """
    made = WheelFaults(np.ones(4), np.zeros(4), np.full(4, nan), np.full(4, nan), np.zeros(4),
                       np.zeros(4))
    acts_on = {'dead': made.torque_scale, 'weak': made.torque_scale, 'stuck': made.hold_torque,
               'dragging': made.extra_friction, 'runaway': made.forced_torque,
               'shorted': made.shorted_torque, 'delayed': made.command_delay_s}
    for fault in faults:
        if fault.target in FLYWHEEL_NAMES:
            wheel = FLYWHEEL_NAMES.index(fault.target)
            acts_on[fault.kind][wheel] = fault.value or 0.0
    for array in acts_on.values():
        array.flags.writeable = False
    return made


def _checked_value(what: str, kind: FaultKind, value: Any) -> float | None:
    if kind.default is None:
        if value is not None:
            raise FaultError(f'{what} takes no value, got {value!r}')
        return None
    if value is None:
        return kind.default
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise FaultError(f'{kind.quantity} of {what} must be a number, got {value!r}')
    if not kind.low <= value <= kind.high:
        unit = f' {kind.unit}' if kind.unit else ''
        raise FaultError(f'{kind.quantity} of {what} must be from {kind.low:g} to '
                         f'{kind.high:g}{unit}, got {value}')
    return float(value)
