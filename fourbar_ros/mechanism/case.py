# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
A motion to simulate, described by a file: mechanism, initial state, motor torques, times.

The file is JSON with the keys `mechanism` (those of a mechanism file), `initial` (`link_angles`,
and optionally `link_rates` and `flywheel_speeds_absolute`), `motor_torque` (`amplitude`,
`frequency_hz`, `phase`: torque on the wheel = amplitude cos(2 pi frequency_hz t + phase)) and `t`.
Other keys are ignored, so that a file may carry its expected result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any

from fourbar_ros.errors import FourbarError
from fourbar_ros.mechanism.closure import closure_error
from fourbar_ros.mechanism.dynamics import closure_jacobian
from fourbar_ros.mechanism.motion import (
    LINK_ANGLES,
    LINK_RATES,
    move_with_cosine_torques,
    STATE_SIZE,
    WHEEL_ANGLES,
    WHEEL_SPEEDS,
)
from fourbar_ros.mechanism.parameters import Array, LINK_NAMES, Mechanism, numbers
import numpy as np

# How far an initial state may be off the closure, relative to the longest link (and per second):
# generous to files with rounded digits, far below any real mistake.
CLOSURE_TOLERANCE = 1e-6

DEFAULT_STEP = 1e-3


class CaseError(FourbarError):
    """A case file that is missing, broken, or describes an impossible motion."""


@dataclass(frozen=True, eq=False)
class Case:
    """
    One motion to simulate.

    :param mechanism: the linkage.
    :param link_angles: (4,) initial angles on the closure [rad].
    :param link_rates: (4,) initial rates consistent with the closure [rad/s].
    :param flywheel_speeds_absolute: (4,) initial link rate plus wheel speed [rad/s].
    :param amplitude: (4,) of the motor torques [N m].
    :param frequency_hz: (4,) [Hz].
    :param phase: (4,) [rad].
    :param times: (n,) increasing, the first one is that of the initial state [s].
    """

    mechanism: Mechanism
    link_angles: Array
    link_rates: Array
    flywheel_speeds_absolute: Array
    amplitude: Array
    frequency_hz: Array
    phase: Array
    times: Array


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


def load_case(path: Path) -> Case:
    """
    Read and check a case file.

    :raises CaseError: missing, unreadable, not JSON, or a value is missing or impossible.
    :raises MechanismError: the mechanism is refused.
    """
    try:
        with open(path, encoding='utf-8') as file:
            values = json.load(file)
    except OSError as error:
        raise CaseError(f'cannot read {path}: {error.strerror}') from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CaseError(f'{path} is not JSON, or is cut: {error}') from None
    try:
        return _case_from(values, str(path))
    except CaseError as error:
        raise CaseError(f'{path}: {error}') from None


def simulate(case: Case, step: float = DEFAULT_STEP) -> Motion:
    """
    Integrate the motion of a case.

    :param step: longest integration step [s].
    :raises CaseError: the motion left the finite numbers.
    """
    state = np.zeros(STATE_SIZE)
    state[LINK_ANGLES] = case.link_angles
    state[LINK_RATES] = case.link_rates
    state[WHEEL_SPEEDS] = case.flywheel_speeds_absolute
    states = move_with_cosine_torques(
        state, case.times, case.amplitude, case.frequency_hz, case.phase, step,
        case.mechanism.constants)
    finite = np.isfinite(states).all(axis=1)
    if not finite.all():
        raise CaseError(
            f'the motion is no longer finite at t = {case.times[np.argmin(finite)]:g} s: '
            f'torques too large for a step of {step:g} s')
    return Motion(
        case.times, states[:, LINK_ANGLES], states[:, LINK_RATES], states[:, WHEEL_ANGLES],
        states[:, WHEEL_SPEEDS])


def _case_from(values: Any, origin: str) -> Case:
    mechanism = Mechanism.from_mapping(_section(values, 'mechanism'), f'{origin}, mechanism')
    initial = _section(values, 'initial')
    torque = _section(values, 'motor_torque')
    zeros = [0.0, 0.0, 0.0, 0.0]
    case = Case(
        mechanism,
        _array(initial, 'link_angles', (4,)),
        _array({'link_rates': zeros, **initial}, 'link_rates', (4,)),
        _array({'flywheel_speeds_absolute': zeros, **initial}, 'flywheel_speeds_absolute', (4,)),
        _array(torque, 'amplitude', (4,)),
        _array(torque, 'frequency_hz', (4,)),
        _array(torque, 'phase', (4,)),
        _array(values, 't', None))
    if case.times.size < 2 or not (np.diff(case.times) > 0.0).all():
        raise CaseError('t must hold at least two increasing times')
    _check_closure(case)
    return case


def _check_closure(case: Case) -> None:
    limit = CLOSURE_TOLERANCE * float(case.mechanism.link_lengths.max())
    gap = closure_error(case.mechanism, case.link_angles)
    if gap > limit:
        raise CaseError(
            f'initial link_angles do not close the loop: gap {gap:.3g} m, limit {limit:.3g} m')
    jacobian = closure_jacobian(case.link_angles, case.mechanism.constants.lengths)
    slip = float(np.hypot(*(jacobian @ case.link_rates)))
    if slip > limit:
        raise CaseError(
            'initial link_rates do not keep the loop closed: joint 3 would open at '
            f'{slip:.3g} m/s, limit {limit:.3g} m/s')


def _section(values: Any, name: str) -> Mapping[str, Any]:
    if not isinstance(values, Mapping):
        raise CaseError('must hold a JSON object')
    section = values.get(name)
    if not isinstance(section, Mapping):
        raise CaseError(f'{name} is missing or is not an object')
    return section


def _array(values: Mapping[str, Any], name: str, shape: tuple[int, ...] | None) -> Array:
    if name not in values:
        raise CaseError(f'{name} is missing')
    array = numbers(name, values[name], CaseError)
    if array.ndim != 1 or (shape is not None and array.shape != shape):
        wanted = f'{shape[0]} numbers, in the order {", ".join(LINK_NAMES)}' if shape else 'a list'
        raise CaseError(f'{name} must be {wanted}, got shape {array.shape}')
    if not np.isfinite(array).all():
        raise CaseError(f'{name} must be finite, got {array[~np.isfinite(array)][0]}')
    return array
