# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
A motion to simulate, described by a file: mechanism, initial state, motor torques, times.

The file is JSON with the keys `mechanism` (those of a mechanism file), `initial` (`link_angles`,
and optionally `link_rates` and `flywheel_speeds_absolute`), `motor_torque` (`amplitude`,
`frequency_hz`, `phase`: torque on the wheel = amplitude cos(2 pi frequency_hz t + phase)) and `t`.
With `wheel_angle` (`flywheels`, and for each of them `amplitude`, `frequency_hz`, `phase`) some
wheels have a prescribed angle relative to their links instead of a torque. Other keys are ignored,
so that a file may contain its expected result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import json
from pathlib import Path
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import Setting
from fourbar_ros.mechanism.closure import branch_of, check_motion, ClosureError
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.forces import NOTHING, Surroundings
from fourbar_ros.mechanism.integration import move_with_cosines
from fourbar_ros.mechanism.mechanism import checked_array, FLYWHEEL_NAMES, LINK_NAMES, Mechanism
from fourbar_ros.mechanism.state import (
    LINK_ANGLES,
    LINK_RATES,
    make_state,
    WHEEL_ANGLES,
    WHEEL_SPEEDS,
)
import numpy as np

DEFAULT_STEP = 1e-3


class CaseError(FourbarError):
    """A case file that is missing, broken, or describes an impossible motion."""


@dataclass(frozen=True, eq=False)
class Case:
    """
    A motion to simulate.

    :param mechanism: the linkage.
    :param link_angles: (4,) initial angles on the closure [rad].
    :param link_rates: (4,) initial rates consistent with the closure [rad/s].
    :param flywheel_speeds_absolute: (4,) initial link rate plus wheel speed [rad/s].
    :param amplitude: (4,) of the motor torques [N m], or of the prescribed wheel angles [rad].
    :param frequency_hz: (4,) [Hz].
    :param phase: (4,) [rad].
    :param times: (n,) increasing, the first one is that of the initial state [s].
    :param prescribed: (4,) bool, wheels whose angle relative to the link is
        `amplitude cos(2 pi frequency_hz t + phase)`, up to a constant. Their initial speed follows
        from it.
    """

    mechanism: Mechanism
    link_angles: Array
    link_rates: Array
    flywheel_speeds_absolute: Array
    amplitude: Array
    frequency_hz: Array
    phase: Array
    times: Array
    prescribed: Array = field(default_factory=lambda: np.zeros(4, dtype=bool))


@dataclass(frozen=True, eq=False)
class Motion:
    """
    A simulated motion.

    :param times: (n,) [s].
    :param link_angles: (n, 4) continuous [rad].
    :param link_rates: (n, 4) [rad/s].
    :param flywheel_angles: (n, 4) relative to the link, 0 at the start [rad].
    :param flywheel_speeds_absolute: (n, 4) [rad/s].
    """

    times: Array
    link_angles: Array
    link_rates: Array
    flywheel_angles: Array
    flywheel_speeds_absolute: Array

    def branches(self) -> list[tuple[float, str]]:
        """Return the branches of the motion, each with the time from which it holds [s]."""
        changes: list[tuple[float, str]] = []
        for time, angles in zip(self.times, self.link_angles):
            branch = branch_of(angles)
            if not changes or branch != changes[-1][1]:
                changes.append((float(time), branch))
        return changes


def load_case(path: Path) -> Case:
    """
    Read and check a case file.

    :raises CaseError: missing, unreadable, not JSON, or a value is missing or impossible.
    """
    try:
        with open(path, encoding='utf-8') as file:
            values = json.load(file)
    except OSError as error:
        raise CaseError(f'cannot read {path}: {error.strerror}', file=str(path)) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaseError(f'{path} is not JSON, or is cut: {error}', file=str(path)) from None
    try:
        return _case_from(values)
    except FourbarError as error:
        raise error.at(path, CaseError) from None


def simulate(case: Case, step: float = DEFAULT_STEP, around: Surroundings = NOTHING) -> Motion:
    """
    Integrate the motion of a case.

    :param step: longest integration step [s].
    :param around: forces besides those of the motors.
    :raises ClosureError: the linkage cannot be in the initial state.
    :raises CaseError: the motion is no longer finite.
    """
    check_motion(case.mechanism, case.link_angles, case.link_rates)
    omega = 2.0 * np.pi * case.frequency_hz
    prescribed_speeds = -case.amplitude * omega * np.sin(omega * case.times[0] + case.phase)
    state = make_state(case.link_angles, case.link_rates, np.where(
        case.prescribed, case.link_rates + prescribed_speeds, case.flywheel_speeds_absolute))
    states = move_with_cosines(
        state, case.times, case.amplitude, case.frequency_hz, case.phase, step,
        case.mechanism.constants_with(case.prescribed), around)
    finite = np.isfinite(states).all(axis=1)
    if not finite.all():
        raise CaseError(
            f'the motion is no longer finite at t = {case.times[np.argmin(finite)]:g} s: '
            f'torques too large for a step of {step:g} s', step=step)
    return Motion(
        case.times, states[:, LINK_ANGLES], states[:, LINK_RATES], states[:, WHEEL_ANGLES],
        states[:, WHEEL_SPEEDS])


_FIELDS = {row.name: row for row in (
    Setting('link_angles', 0.0, 'rad', 'initial angles on the closure'),
    Setting('link_rates', 0.0, 'rad/s', 'initial rates'),
    Setting('flywheel_speeds_absolute', 0.0, 'rad/s', 'initial speeds'),
    Setting('amplitude', 0.0, '', 'of the torque [N m] or the prescribed angle [rad]'),
    Setting('frequency_hz', 0.0, 'Hz', 'of the torque or the prescribed angle'),
    Setting('phase', 0.0, 'rad', 'of the torque or the prescribed angle'),
    Setting('t', 0.0, 's', 'times, the first one that of the initial state'),
)}
_COSINE = ('amplitude', 'frequency_hz', 'phase')


def _case_from(values: Any) -> Case:
    mechanism = Mechanism.from_mapping(_section(values, 'mechanism'), 'mechanism')
    initial = {'link_rates': [0.0] * 4, 'flywheel_speeds_absolute': [0.0] * 4,
               **_section(values, 'initial')}
    angles, rates, speeds = (_array(initial, name, LINK_NAMES) for name in (
        'link_angles', 'link_rates', 'flywheel_speeds_absolute'))
    cosines, prescribed = _wheel_cosines(values)
    times = _array(values, 't', None)
    if times.size < 2 or not (np.diff(times) > 0.0).all():
        raise CaseError('t must hold at least two increasing times', name='t')
    try:
        check_motion(mechanism, angles, rates)
    except ClosureError as error:
        raise CaseError(f'initial: {error}', **error.values) from None
    return Case(mechanism, angles, rates, speeds, cosines[0], cosines[1], cosines[2], times,
                prescribed)


def _wheel_cosines(values: Mapping[str, Any]) -> tuple[Array, Array]:
    """Read amplitudes, frequencies and phases (3, 4), and which wheels are prescribed (4,)."""
    prescribed = np.zeros(4, dtype=bool)
    wheels: list[int] = []
    if 'wheel_angle' in values:
        wheels = _wheels(_section(values, 'wheel_angle').get('flywheels'))
        prescribed[wheels] = True
    cosines = np.zeros((3, 4))
    if 'motor_torque' in values or not prescribed.all():
        torque = _section(values, 'motor_torque')
        cosines[:] = [_array(torque, name, FLYWHEEL_NAMES) for name in _COSINE]
        if wheels and cosines[0, wheels].any():
            name = FLYWHEEL_NAMES[wheels[int(np.argmax(cosines[0, wheels] != 0.0))]]
            raise CaseError(f'{name} has a prescribed angle and a motor torque: remove one of '
                            'the two', name=name)
    if wheels:
        names = [FLYWHEEL_NAMES[wheel] for wheel in wheels]
        cosines[:, wheels] = [_array(values['wheel_angle'], name, names) for name in _COSINE]
    return cosines, prescribed


def _wheels(names: Any) -> list[int]:
    if not isinstance(names, list) or not names or len(set(map(str, names))) < len(names):
        raise CaseError(f'wheel_angle needs flywheels, a list of different names, got {names!r}',
                        name='flywheels', value=names)
    if unknown := [name for name in names if name not in FLYWHEEL_NAMES]:
        raise CaseError(f'wheel_angle: no flywheel {unknown[0]!r} (known are '
                        f'{", ".join(FLYWHEEL_NAMES)})', name='flywheels', value=unknown[0],
                        limit=FLYWHEEL_NAMES)
    return [FLYWHEEL_NAMES.index(name) for name in names]


def _section(values: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(values, Mapping):
        raise CaseError('must hold a JSON object', value=values, limit=dict)
    section = values.get(name)
    if not isinstance(section, Mapping):
        raise CaseError(f'{name} is missing or is not an object', name=name, value=section)
    return section


def _array(values: Mapping[str, Any], name: str, elements: Sequence[str] | None) -> Array:
    """
    Return the list of that name.

    :param elements: names of its elements, None for any number of them.
    """
    if name not in values:
        raise CaseError(f'{name} is missing', name=name)
    if elements is None and isinstance(values[name], list):
        elements = [str(place) for place in range(len(values[name]))]
    return checked_array(_FIELDS[name], values[name], elements or ())
