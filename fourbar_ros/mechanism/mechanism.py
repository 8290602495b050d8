# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters of a four-bar linkage with one flywheel per link, checked when they are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, MISSING, replace
from functools import cached_property
from typing import Any

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import check_keys
from fourbar_ros.mechanism.change_points import LENGTH_ROUNDING, MATCHING_LENGTHS
from fourbar_ros.mechanism.constants import Array, Constants, constants_of
import numpy as np
from numpy.typing import ArrayLike

LINK_NAMES = ('link_a', 'link_b', 'link_c', 'link_d')
FLYWHEEL_NAMES = ('flywheel_a', 'flywheel_b', 'flywheel_c', 'flywheel_d')
JOINT_NAMES = ('joint_1', 'joint_2', 'joint_3', 'joint_4')

# What may be measured: orientations of links, and angles in joints.
SENSOR_NAMES = (*LINK_NAMES, *JOINT_NAMES)

# First and second link of each joint; an encoder there measures the second relative to the first.
JOINT_LINKS = ((0, 1), (1, 2), (2, 3), (3, 0))

# Which links line up against the others at a change point: a and d against b and c (parallelogram,
# theta = 0), a and b against c and d (theta = pi), a and c against b and d.
ALIGNMENTS = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])

# Least values of those that need not be positive.
LOWEST = {'com_positions': -np.inf, 'link_angle_offsets': -np.inf, 'joint_damping': 0.0,
          'motor_time_constants': 0.0, 'motor_resistances': 0.0}


class MechanismError(FourbarError):
    """A mechanism that cannot exist or is not fully described."""


@dataclass(frozen=True, eq=False)
class Mechanism:
    """
    A closed loop of four rigid links, one flywheel on each (order a, b, c, d; SI units).

    Lengths that miss a change point, where all links lie on a line, by less than
    `MATCHING_LENGTHS` are made to meet it.

    :param link_lengths: (4,) distance between the two joints of each link [m].
    :param link_masses: (4,) mass of each link with its flywheel [kg].
    :param link_inertias: (4,) about the link's own mass centre, the wheel's mass counted in it,
        without the wheel's axial inertia [kg m^2].
    :param com_positions: (4, 2) mass centre of each link in its link frame [m].
    :param flywheel_inertias: (4,) axial inertia of each wheel [kg m^2].
    :param motor_torque_limits: (4,) largest torque of each motor [N m], default unlimited.
    :param motor_speed_limits: (4,) largest wheel speed relative to the link [rad/s], default
        unlimited.
    :param motor_time_constants: (4,) with which the torque follows what is asked for [s],
        default 0.
    :param motor_torque_constants: (4,) torque per current, and voltage per speed [N m/A, V s/rad],
        default infinite: no current flows.
    :param motor_resistances: (4,) of the windings [ohm], default 0.
    :param motor_voltages: (4,) of the supply [V], default unlimited.
    :param joint_stiffness: (4,) how hard the two ends in joints 1 to 4 are pulled together [N/m],
        default infinite: rigid. Either all four joints are rigid or none.
    :param joint_damping: (4,) of the same, for joints that are not rigid [N s/m], default 0.
    :param link_angle_offsets: (4,) what the sensors of the links read beyond the orientation of
        their links [rad], default 0. A real device takes it out of `link_angles`; a simulated one
        has nothing to take out.
    :raises MechanismError: wrong shape, not finite, not positive, lengths that cannot close, or
        joints of which only some are rigid.
    """

    link_lengths: Array
    link_masses: Array
    link_inertias: Array
    com_positions: Array
    flywheel_inertias: Array
    motor_torque_limits: Array = field(default_factory=lambda: np.full(4, np.inf))
    motor_speed_limits: Array = field(default_factory=lambda: np.full(4, np.inf))
    motor_time_constants: Array = field(default_factory=lambda: np.zeros(4))
    motor_torque_constants: Array = field(default_factory=lambda: np.full(4, np.inf))
    motor_resistances: Array = field(default_factory=lambda: np.zeros(4))
    motor_voltages: Array = field(default_factory=lambda: np.full(4, np.inf))
    joint_stiffness: Array = field(default_factory=lambda: np.full(4, np.inf))
    joint_damping: Array = field(default_factory=lambda: np.zeros(4))
    link_angle_offsets: Array = field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        """Check every value and make every array read-only."""
        for item in fields(self):
            shape = (4, 2) if item.name == 'com_positions' else (4,)
            array = _checked_array(item.name, getattr(self, item.name), shape)
            object.__setattr__(self, item.name, array)
        self._check_that_it_closes()
        self._match_lengths()
        self._check_joints()
        self._check_windings()

    def _check_that_it_closes(self) -> None:
        longest = int(np.argmax(self.link_lengths))
        others = float(np.sum(np.delete(self.link_lengths, longest)))
        if self.link_lengths[longest] >= others:
            raise MechanismError(
                f'link_lengths cannot close: {LINK_NAMES[longest]} is '
                f'{self.link_lengths[longest]:g} m long, the other three reach {others:g} m')

    def _match_lengths(self) -> None:
        missing = ALIGNMENTS @ self.link_lengths
        relative = np.abs(missing) / self.link_lengths.mean()
        missing[(relative < LENGTH_ROUNDING) | (relative >= MATCHING_LENGTHS)] = 0.0
        matched = self.link_lengths - missing / 4.0 @ ALIGNMENTS
        matched.flags.writeable = False
        object.__setattr__(self, 'link_lengths', matched)

    def _check_joints(self) -> None:
        rigid = np.isinf(self.joint_stiffness)
        if rigid.any() and not rigid.all():
            raise MechanismError(
                f'joint_stiffness of joint {int(np.argmax(rigid)) + 1} is infinite and that of '
                f'joint {int(np.argmin(rigid)) + 1} is not: give all four, or none')
        if rigid.all() and self.joint_damping.any():
            raise MechanismError(
                f'joint_damping of joint {int(np.argmax(self.joint_damping)) + 1} is given, but '
                'the joints are rigid: give joint_stiffness too')

    def _check_windings(self) -> None:
        for wheel, name in enumerate(LINK_NAMES):
            constant, resistance, voltage = (float(given[wheel]) for given in (
                self.motor_torque_constants, self.motor_resistances, self.motor_voltages))
            if np.isinf(constant) and (resistance > 0.0 or np.isfinite(voltage)):
                raise MechanismError(
                    f'motor_resistances or motor_voltages of {name} is given: give '
                    'motor_torque_constants too')
            if np.isfinite(voltage) and resistance == 0.0:
                raise MechanismError(
                    f'motor_voltages of {name} is given: give motor_resistances too')

    def with_rigid_joints(self) -> Mechanism:
        """Return the same linkage without compliance."""
        return replace(
            self, joint_stiffness=np.full(4, np.inf), joint_damping=np.zeros(4))

    @cached_property
    def constants(self) -> Constants:
        """Work out what the kernels need, all wheels being driven by torques."""
        return self.constants_with(np.zeros(4, dtype=bool))

    def constants_with(self, prescribed: Array) -> Constants:
        """
        Work out the same where the motion of some wheels is prescribed instead.

        :param prescribed: (4,) bool, the wheels whose angle relative to the link is given.
        """
        return constants_of(self, np.asarray(prescribed, dtype=bool))

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], origin: str) -> Mechanism:
        """
        Make a mechanism from the keys of a mechanism file.

        :param values: the keys are the names of this class's fields.
        :param origin: where the values come from, for messages.
        :raises MechanismError: a key is missing or unknown, or a value is refused.
        """
        names = {item.name for item in fields(cls)}
        optional = {item.name for item in fields(cls) if item.default_factory is not MISSING}
        check_keys(values, names - optional, origin, MechanismError, optional=optional)
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
    lowest = LOWEST.get(name)
    unlimited = name.startswith(('motor_', 'joint_')) and lowest is None
    for index, number in np.ndenumerate(array):
        place = f'joint {index[0] + 1}' if name.startswith('joint_') else LINK_NAMES[index[0]]
        if np.isnan(number) or (np.isinf(number) and not (unlimited and number > 0)):
            raise MechanismError(f'{name} of {place} must be finite, got {number}')
        if lowest is None and number <= 0:
            raise MechanismError(f'{name} of {place} must be positive, got {number:g}')
        if lowest is not None and number < lowest:
            raise MechanismError(f'{name} of {place} must not be negative, got {number:g}')
    array.flags.writeable = False
    return array
