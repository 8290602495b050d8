# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Faults of the simulated table: of a sensor of the links, or of the drive of a flywheel.

A fault has one target, a sensor or wheel by its name in the topics. Each target has at most one
fault at a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import nan, pi

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import Setting, SettingError
from fourbar_ros.mechanism import FLYWHEEL_NAMES, SENSOR_NAMES
from fourbar_ros.mechanism.constants import Array
import numpy as np


class FaultError(FourbarError):
    """A fault of an unknown kind, target, value or time."""


@dataclass(frozen=True)
class FaultKind:
    """
    One kind of fault.

    :param meaning: its effect.
    :param quantity: name of its value; empty for a fault without a value.
    :param unit: of the value, '' for a pure number.
    :param default: of the value.
    :param low, high: smallest and largest value, both allowed.
    """

    meaning: str
    quantity: str = ''
    unit: str = ''
    default: float | None = None
    low: float = 0.0
    high: float = 0.0


# Faults of a link sensor.
SENSOR_FAULTS = {
    'off': FaultKind('takes no samples'),
    'stuck': FaultKind('repeats its last sample, bit for bit, with new stamps'),
    'garbage': FaultKind('measures random angles, uniformly distributed; the gyro still works'),
    'wrong': FaultKind('adds a constant to the angle', 'angle', 'rad', 0.1, -pi, pi),
    'slow': FaultKind('low-passes the angle', 'time constant', 's', 0.2, 0.0, 10.0),
    'delayed': FaultKind('delivers its samples later', 'added latency', 's', 0.1, 0.0, 10.0),
    'intermittent': FaultKind('loses samples at random', 'probability', '', 0.5, 0.0, 1.0),
}

WHEEL_FAULTS = {
    'dead': FaultKind('the motor produces no torque'),
    'stuck': FaultKind('a brake holds the wheel to its link', 'torque', 'N m', 0.1, 0.0, 10.0),
    'weak': FaultKind('the motor produces a part of its torque', 'part', '', 0.5, 0.0, 1.0),
    'dragging': FaultKind('more friction in the bearing', 'torque', 'N m', 1e-4, 0.0, 10.0),
    'runaway': FaultKind('a powered motor produces this torque, within its limits, whatever its '
                         'command', 'torque', 'N m', 10.0, -10.0, 10.0),
    'shorted': FaultKind('the power stage produces this torque, within the limits of the motor, '
                         'and cannot be cut', 'torque', 'N m', 10.0, -10.0, 10.0),
    'delayed': FaultKind('the motor follows its commands later', 'delay', 's', 0.05, 0.0, 1.0),
}


@dataclass(frozen=True)
class Fault:
    """
    One fault of one sensor or wheel.

    :param target: its sensor or wheel: `link_a`, `joint_2`, `flywheel_c`.
    :param kind: one of SENSOR_FAULTS or WHEEL_FAULTS.
    :param value: in the unit of the kind, None for its default or for a fault without a value.
    :raises FaultError: unknown target or kind, or a value that this kind cannot have.
    """

    target: str
    kind: str
    value: float | None = None

    def __post_init__(self) -> None:
        """Check target and kind, and fill in the value."""
        kinds = fault_kinds(self.target)
        if self.kind not in tuple(kinds):
            raise FaultError(
                f'unknown fault {self.kind!r} of {self.target} (known are {", ".join(kinds)})',
                name=self.target, value=self.kind, limit=tuple(kinds))
        object.__setattr__(self, 'value', self._checked_value(kinds[self.kind]))

    def _checked_value(self, kind: FaultKind) -> float | None:
        name = f'{self.target}.{self.kind}'
        if kind.default is None:
            if self.value is not None:
                raise FaultError(f'{self.kind} of {self.target} takes no value, got '
                                 f'{self.value!r}', name=name, value=self.value, limit=None)
            return None
        row = Setting(kind.quantity, kind.default, kind.unit, kind.meaning, kind.low, kind.high)
        try:
            return float(row.check(kind.default if self.value is None else self.value, name))
        except SettingError as error:
            raise FaultError(f'{kind.quantity} of {error}', **error.values) from None

    def __str__(self) -> str:
        """Write what `parse_fault` reads: `wrong 0.1`."""
        return self.kind if self.value is None else f'{self.kind} {self.value!r}'


def fault_kinds(target: str) -> Mapping[str, FaultKind]:
    """
    Return the kinds of fault of a sensor or wheel, by name.

    :raises FaultError: there is no such sensor or wheel.
    """
    if target in SENSOR_NAMES:
        return SENSOR_FAULTS
    if target in FLYWHEEL_NAMES:
        return WHEEL_FAULTS
    known = (*SENSOR_NAMES, *FLYWHEEL_NAMES)
    raise FaultError(f'no sensor or wheel {target!r} (known are {", ".join(known)})',
                     name='target', value=target, limit=known)


def parse_fault(target: str, text: str) -> Fault | None:
    """
    Read a fault from text.

    :param target: its sensor or wheel.
    :param text: `KIND` or `KIND VALUE`; empty or `none` for no fault.
    :returns: the fault, or None.
    :raises FaultError: unknown target or kind, or a value that this kind cannot have.
    """
    fault_kinds(target)
    words = text.split()
    if words in ([], ['none']):
        return None
    if len(words) > 2:
        raise FaultError(f'fault of {target} must be KIND or KIND VALUE, got {text!r}',
                         name=target, value=text)
    if len(words) == 1:
        return Fault(target, words[0])
    try:
        value = float(words[1])
    except ValueError:
        raise FaultError(
            f'value of the fault {words[0]!r} of {target} must be a number, got {words[1]!r}',
            name=f'{target}.{words[0]}', value=words[1], limit=float) from None
    return Fault(target, words[0], value)


@dataclass(frozen=True, eq=False)
class WheelFaults:
    """
    The effects of the faults of the four wheels on their drives; the arrays are read-only.

    :param torque_scale: (4,) factor of the motor torque, 1 without a fault.
    :param extra_friction: (4,) Coulomb friction beyond that of the bearing [N m].
    :param forced_torque: (4,) torque of a powered motor whatever its command [N m], NaN without a
        fault; not limited to the range of the motor.
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
    Return the effects of faults on the drives of the wheels.

    :param faults: at most one for each target; those of sensors are ignored.
    """
    effects = WheelFaults(np.ones(4), np.zeros(4), np.full(4, nan), np.full(4, nan), np.zeros(4),
                          np.zeros(4))
    acts_on = {'dead': effects.torque_scale, 'weak': effects.torque_scale,
               'stuck': effects.hold_torque, 'dragging': effects.extra_friction,
               'runaway': effects.forced_torque, 'shorted': effects.shorted_torque,
               'delayed': effects.command_delay_s}
    for fault in faults:
        if fault.target in FLYWHEEL_NAMES:
            wheel = FLYWHEEL_NAMES.index(fault.target)
            acts_on[fault.kind][wheel] = fault.value or 0.0
    for array in acts_on.values():
        array.flags.writeable = False
    return effects
