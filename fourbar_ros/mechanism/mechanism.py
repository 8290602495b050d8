# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters of a four-bar linkage with one flywheel per link, checked when they are made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, MISSING, replace
from functools import cached_property
from math import inf
from typing import Any

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.settings import (
    Setting,
    setting,
    SettingError,
    Settings,
    settings_of,
)
from fourbar_ros.mechanism.change_points import LENGTH_ROUNDING, MATCHING_LENGTHS
from fourbar_ros.mechanism.constants import Array, Constants, FIELDS, JOINTS, PAIRS, record
import numpy as np
from numpy.typing import ArrayLike

LINK_NAMES = ('link_a', 'link_b', 'link_c', 'link_d')
FLYWHEEL_NAMES = ('flywheel_a', 'flywheel_b', 'flywheel_c', 'flywheel_d')
JOINT_NAMES = ('joint_1', 'joint_2', 'joint_3', 'joint_4')

# Names of all possible sensors: of the orientation of a link, or of the angle in a joint.
SENSOR_NAMES = (*LINK_NAMES, *JOINT_NAMES)

# First and second link of each joint; its encoder measures the second relative to the first.
JOINT_LINKS = ((0, 1), (1, 2), (2, 3), (3, 0))

# Signs of the links that line up against the others at a change point: a and d against b and c
# (parallelogram, theta = 0), a and b against c and d (theta = pi), a and c against b and d.
_ALIGNMENTS = np.array([[1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])


class MechanismError(SettingError):
    """A mechanism that cannot exist or is not fully described."""


def _per_link(unit: str, meaning: str, default: float | None = None, **limits: Any) -> Any:
    """Declare a field of one value for each link or joint; without a default it is required."""
    value = MISSING if default is None else (default,) * 4
    return setting(value, unit, meaning, kind=float, **limits)


@dataclass(frozen=True, eq=False)
class Mechanism(Settings):
    """
    A closed loop of four rigid links, one flywheel on each (order a, b, c, d; SI units).

    Fields are arrays (4,), in the order of the links or of joints 1 to 4; `com_positions` is
    (4, 2). Lengths that miss a change point by less than `MATCHING_LENGTHS` are changed to meet
    it.

    :raises SettingError: wrong shape, not finite, or out of range.
    :raises MechanismError: lengths that cannot close, joints of which only some are rigid, or
        windings that are described in part.
    """

    section = 'mechanism'

    link_lengths: Array = _per_link('m', 'distance between the two joints of the link', above=0.0)
    link_masses: Array = _per_link('kg', 'mass of the link with its flywheel', above=0.0)
    link_inertias: Array = _per_link(
        'kg m^2', "inertia about the link's own mass centre, with the mass of the wheel and "
        'without its axial inertia', above=0.0)
    com_positions: Array = _per_link('m', 'mass centre of the link in its link frame, x and y')
    flywheel_inertias: Array = _per_link('kg m^2', 'axial inertia of the wheel', above=0.0)
    motor_torque_limits: Array = _per_link(
        'N m', 'largest torque of the motor', inf, above=0.0, infinite=True)
    motor_speed_limits: Array = _per_link(
        'rad/s', 'largest wheel speed relative to the link', inf, above=0.0, infinite=True)
    motor_time_constants: Array = _per_link(
        's', 'time constant with which the torque follows its command', 0.0, low=0.0)
    motor_torque_constants: Array = _per_link(
        'N m/A', 'torque per current, and voltage per speed; infinite: no current flows', inf,
        above=0.0, infinite=True)
    motor_resistances: Array = _per_link('ohm', 'resistance of the windings', 0.0, low=0.0)
    motor_voltages: Array = _per_link('V', 'supply voltage', inf, above=0.0, infinite=True)
    joint_stiffness: Array = _per_link(
        'N/m', 'stiffness of the joint against a gap; infinite: rigid. All joints are rigid or '
        'none', inf, above=0.0, infinite=True)
    joint_damping: Array = _per_link('N s/m', 'damping of a compliant joint', 0.0, low=0.0)
    link_angle_offsets: Array = _per_link(
        'rad', 'reading of the sensor of the link less the orientation of the link. A real device '
        'subtracts it from `link_angles`; a simulated one has none', 0.0)

    def __post_init__(self) -> None:
        """Check every value and make every array read-only."""
        for row in settings_of(type(self)):
            elements = JOINT_NAMES if row.name.startswith('joint_') else LINK_NAMES
            array = checked_array(row, getattr(self, row.name), elements,
                                  ('x', 'y') if row.name == 'com_positions' else ())
            array.flags.writeable = False
            object.__setattr__(self, row.name, array)
        self._check_that_it_closes()
        self._match_lengths()
        self._check_joints()
        self._check_windings()

    def _check_that_it_closes(self) -> None:
        longest = int(np.argmax(self.link_lengths))
        length = float(self.link_lengths[longest])
        others = float(np.sum(np.delete(self.link_lengths, longest)))
        if length >= others:
            raise MechanismError(
                f'link_lengths cannot close: {LINK_NAMES[longest]} is {length:g} m long, the '
                f'other three reach {others:g} m',
                name=f'link_lengths.{LINK_NAMES[longest]}', value=length, limit=others)

    def _match_lengths(self) -> None:
        missing = _ALIGNMENTS @ self.link_lengths
        relative = np.abs(missing) / self.link_lengths.mean()
        missing[(relative < LENGTH_ROUNDING) | (relative >= MATCHING_LENGTHS)] = 0.0
        matched = self.link_lengths - missing / 4.0 @ _ALIGNMENTS
        matched.flags.writeable = False
        object.__setattr__(self, 'link_lengths', matched)

    def _check_joints(self) -> None:
        rigid = np.isinf(self.joint_stiffness)
        if rigid.any() and not rigid.all():
            first, other = (JOINT_NAMES[int(place(rigid))] for place in (np.argmax, np.argmin))
            raise MechanismError(
                f'joint_stiffness of {first} is infinite and that of {other} is not: make all '
                'four finite, or none', name=f'joint_stiffness.{first}', value=inf)
        if rigid.all() and self.joint_damping.any():
            damped = JOINT_NAMES[int(np.argmax(self.joint_damping))]
            raise MechanismError(
                f'joint_damping of {damped} needs a finite joint_stiffness: the joints are rigid',
                name=f'joint_damping.{damped}', missing='joint_stiffness')

    def _check_windings(self) -> None:
        for wheel, link in enumerate(LINK_NAMES):
            constant, resistance, voltage = (float(values[wheel]) for values in (
                self.motor_torque_constants, self.motor_resistances, self.motor_voltages))
            limited = np.isfinite(voltage)
            if np.isinf(constant) and (resistance > 0.0 or limited):
                name = 'motor_voltages' if limited else 'motor_resistances'
                missing = 'motor_torque_constants'
            elif limited and resistance == 0.0:
                name, missing = 'motor_voltages', 'motor_resistances'
            else:
                continue
            raise MechanismError(f'{name} of {link} needs {missing} too',
                                 name=f'{name}.{link}', missing=missing)

    def with_rigid_joints(self) -> Mechanism:
        """Return the same linkage without compliance."""
        return replace(
            self, joint_stiffness=np.full(4, np.inf), joint_damping=np.zeros(4))

    @cached_property
    def constants(self) -> Constants:
        """Constants of the kernels, all wheels being driven by torques."""
        return self.constants_with(np.zeros(4, dtype=bool))

    def constants_with(self, prescribed: Array) -> Constants:
        """
        Evaluate the constants of the kernels where the motion of some wheels is prescribed.

        :param prescribed: (4,) bool, the wheels with a prescribed angle relative to the link.
        """
        return _constants_of(self, np.asarray(prescribed, dtype=bool))

    @classmethod
    def from_mapping(cls, values: Any, place: str = '') -> Mechanism:
        """
        Make a mechanism from the keys of a mechanism file, the names of the fields.

        :param place: origin of the values, for messages.
        :raises MechanismError: a key is missing or unknown, or a value is refused.
        """
        try:
            return super().from_mapping(values)
        except SettingError as error:
            raise error.at(place, MechanismError) from None


def load_mechanism(name: str) -> Mechanism:
    """
    Read a mechanism file.

    :param name: a preset (`paper` for config/mechanism_paper.yaml) or the path of a YAML file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises MechanismError: what it describes cannot exist.
    """
    path = config_file('mechanism', name)
    return Mechanism.from_mapping(load_yaml(path), str(path))


def checked_array(row: Setting, values: ArrayLike, elements: Sequence[str],
                  inner: Sequence[str] = ()) -> Array:
    """
    Return the values of a setting as a new array.

    :param elements, inner: names of its elements, as of `Setting.check_each`.
    :raises SettingError: wrong shape, or an element is refused.
    """
    listed = values.tolist() if isinstance(values, np.ndarray) else values
    return np.array(row.check_each(listed, elements, inner=inner), dtype=float)


def _constants_of(mechanism: Mechanism, prescribed: Array) -> Constants:
    """
    Evaluate the constants of a mechanism.

    :param prescribed: (4,) bool, wheels whose motion relative to their links is prescribed.
    """
    masses = mechanism.link_masses
    lengths = mechanism.link_lengths
    inertias = mechanism.link_inertias + np.where(prescribed, mechanism.flywheel_inertias, 0.0)
    # Relative to joint 1; c is attached to b (joint 2), d to a (joint 4).
    arms = np.zeros((4, 4, 2))
    arms[range(4), range(4)] = mechanism.com_positions
    arms[2, 1, 0] = lengths[1]
    arms[3, 0, 0] = lengths[0]
    arms -= np.einsum('i,ijx->jx', masses / masses.sum(), arms)
    x, y = arms[..., 0], arms[..., 1]
    cosine = np.einsum('i,ij,ik->jk', masses, x, x) + np.einsum('i,ij,ik->jk', masses, y, y)
    sine = np.einsum('i,ij,ik->jk', masses, y, x) - np.einsum('i,ij,ik->jk', masses, x, y)
    cosine[range(4), range(4)] += inertias
    scale = np.array([1.0, 1.0, lengths[2], lengths[3]])
    pairs = tuple(zip(*PAIRS))
    compliant = bool(np.isfinite(mechanism.joint_stiffness).all())
    return record(
        FIELDS, lengths=lengths, cosine=cosine, sine=sine,
        pair_cosine=(cosine / np.outer(scale, scale))[pairs],
        pair_sine=(sine / np.outer(scale, scale))[pairs], own_inertias=np.diag(cosine), arms=arms,
        masses=masses, inertias=inertias, com_positions=mechanism.com_positions,
        total_mass=masses.sum(), flywheel_inertias=mechanism.flywheel_inertias,
        prescribed=prescribed, joint_stiffness=mechanism.joint_stiffness,
        joint_damping=mechanism.joint_damping, compliant=compliant,
        fastest_joint_mode=_fastest_joint_mode(mechanism) if compliant else 0.0)


def _fastest_joint_mode(mechanism: Mechanism) -> float:
    """
    Bound the fastest motion that the springs and dampers of the joints can cause [rad/s].

    By Gershgorin's theorem on the blocks of J M^-1 J^T, two rows for each joint, weighted with
    the stiffness: the square of a frequency. Likewise with the damping: a decay rate.
    """
    radii = np.hypot(
        mechanism.com_positions[:, :1] - np.column_stack([np.zeros(4), mechanism.link_lengths]),
        mechanism.com_positions[:, 1:])
    mobility = np.zeros((4, 4))
    for row, first in enumerate(JOINTS):
        for column, second in enumerate(JOINTS):
            for link, far in first:
                for other, other_far in second:
                    if link == other:
                        mobility[row, column] += (
                            1.0 / mechanism.link_masses[link]
                            + radii[link, int(far)] * radii[link, int(other_far)]
                            / mechanism.link_inertias[link])
    stiffness, damping = (
        float((np.sqrt(np.outer(weight, weight)) * mobility).sum(axis=1).max())
        for weight in (mechanism.joint_stiffness, mechanism.joint_damping))
    return max(float(np.sqrt(stiffness)), damping)
