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

"""The parameters of a four-bar linkage with one flywheel per link, checked when they are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, NamedTuple

from fourbar_ros.configuration import check_keys, config_file, load_yaml
from fourbar_ros.errors import FourbarError
import numpy as np
from numpy.typing import ArrayLike, NDArray

LINK_NAMES = ('link_a', 'link_b', 'link_c', 'link_d')
FLYWHEEL_NAMES = ('flywheel_a', 'flywheel_b', 'flywheel_c', 'flywheel_d')

Array = NDArray[np.float64]


class MechanismError(FourbarError):
    """A mechanism that cannot exist or is not fully described."""


class Constants(NamedTuple):
    """
    What the compiled kernels need of a mechanism, worked out once.

    The position of every mass centre, relative to that of the whole, is linear in the four
    rotations of the links. Hence the mass matrix of the four link angles is
    `M_jk = cosine_jk cos(phi_k - phi_j) + sine_jk sin(phi_k - phi_j)`
    with constant `cosine` (symmetric, link inertias on the diagonal) and `sine` (antisymmetric).
    """

    lengths: Array            # (4,) m
    cosine: Array             # (4, 4) kg m^2
    sine: Array               # (4, 4) kg m^2
    flywheel_inertias: Array  # (4,) kg m^2
    total_mass: float         # kg


@dataclass(frozen=True, eq=False)
class Mechanism:
    """
    A closed loop of four rigid links, one flywheel on each (order a, b, c, d; SI units).

    :param link_lengths: (4,) distance between the two joints of each link [m].
    :param link_masses: (4,) mass of each link with its flywheel [kg].
    :param link_inertias: (4,) about the link's own mass centre, the wheel's mass counted in it,
        without the wheel's axial inertia [kg m^2].
    :param com_positions: (4, 2) mass centre of each link in its link frame [m].
    :param flywheel_inertias: (4,) axial inertia of each wheel [kg m^2].
    :param motor_torque_limits: (4,) largest torque of each motor [N m], default unlimited.
    :param motor_speed_limits: (4,) largest wheel speed relative to the link [rad/s], default
        unlimited.
    :raises MechanismError: wrong shape, not finite, not positive, or lengths that cannot close.
    """

    link_lengths: Array
    link_masses: Array
    link_inertias: Array
    com_positions: Array
    flywheel_inertias: Array
    motor_torque_limits: Array = field(default_factory=lambda: np.full(4, np.inf))
    motor_speed_limits: Array = field(default_factory=lambda: np.full(4, np.inf))

    def __post_init__(self) -> None:
        """Check every value and make every array read-only."""
        for item in fields(self):
            shape = (4, 2) if item.name == 'com_positions' else (4,)
            array = _checked_array(item.name, getattr(self, item.name), shape)
            object.__setattr__(self, item.name, array)
        self._check_that_it_closes()

    def _check_that_it_closes(self) -> None:
        longest = int(np.argmax(self.link_lengths))
        others = float(np.sum(np.delete(self.link_lengths, longest)))
        if self.link_lengths[longest] >= others:
            raise MechanismError(
                f'link_lengths cannot close: {LINK_NAMES[longest]} is '
                f'{self.link_lengths[longest]:g} m long, the other three reach {others:g} m')

    @cached_property
    def constants(self) -> Constants:
        """Work out what the kernels need, see :class:`Constants`."""
        share = self.link_masses / self.link_masses.sum()
        # arm[i, j]: the mass centre of link i is the sum over j of R(phi_j) arm[i, j],
        # measured from joint 1; c hangs on b (joint 2), d hangs on a (joint 4).
        arm = np.zeros((4, 4, 2))
        arm[range(4), range(4)] = self.com_positions
        arm[2, 1, 0] = self.link_lengths[1]
        arm[3, 0, 0] = self.link_lengths[0]
        arm -= np.einsum('i,ijx->jx', share, arm)
        x, y = arm[..., 0], arm[..., 1]
        masses = self.link_masses
        cosine = np.einsum('i,ij,ik->jk', masses, x, x) + np.einsum('i,ij,ik->jk', masses, y, y)
        sine = np.einsum('i,ij,ik->jk', masses, y, x) - np.einsum('i,ij,ik->jk', masses, x, y)
        cosine[range(4), range(4)] += self.link_inertias
        for matrix in (cosine, sine):
            matrix.flags.writeable = False
        return Constants(self.link_lengths, cosine, sine, self.flywheel_inertias,
                         float(masses.sum()))

    @cached_property
    def constants_with_locked_wheels(self) -> Constants:
        """Work out the constants of a linkage whose wheels turn with their links."""
        free = self.constants
        cosine = free.cosine + np.diag(self.flywheel_inertias)
        cosine.flags.writeable = False
        return free._replace(cosine=cosine)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], origin: str) -> Mechanism:
        """
        Make a mechanism from the keys of a mechanism file.

        :param values: the keys are the names of this class's fields.
        :param origin: where the values come from, for messages.
        :raises MechanismError: a key is missing or unknown, or a value is refused.
        """
        motor = {item.name for item in fields(cls) if item.name.startswith('motor_')}
        rest = {item.name for item in fields(cls)} - motor
        check_keys(values, rest, origin, MechanismError, optional=motor)
        try:
            return cls(**values)
        except MechanismError as error:
            raise MechanismError(f'{origin}: {error}') from None


def load_mechanism(name: str) -> Mechanism:
    """
    Read a mechanism file.

    :param name: a preset (`paper` for config/mechanism_paper.yaml) or the path of a YAML file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises MechanismError: what it describes cannot exist.
    """
    path = config_file('mechanism', name)
    return Mechanism.from_mapping(load_yaml(path), str(path))


def numbers(name: str, value: ArrayLike, error: type[FourbarError]) -> Array:
    """
    Make a new array of numbers, and of nothing that merely looks like them.

    :param name: what it is, for the message.
    :param error: what to raise.
    """
    try:
        given = np.asarray(value)
    except ValueError:      # rows of different lengths
        given = np.asarray(None)
    if given.dtype.kind not in 'iuf':
        raise error(f'{name} must hold numbers, got {value!r}')
    return np.array(given, dtype=float)


def _checked_array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = numbers(name, value, MechanismError)
    if array.shape != shape:
        raise MechanismError(f'{name} must have shape {shape}, got {array.shape}')
    unlimited = name.startswith('motor_')
    for index, number in np.ndenumerate(array):
        link = LINK_NAMES[index[0]]
        if np.isnan(number) or (np.isinf(number) and not (unlimited and number > 0)):
            raise MechanismError(f'{name} of {link} must be finite, got {number}')
        if name != 'com_positions' and number <= 0:
            raise MechanismError(f'{name} of {link} must be positive, got {number:g}')
    array.flags.writeable = False
    return array
