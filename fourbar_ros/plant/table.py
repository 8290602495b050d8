# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The settings of a table and of the sensors on it, checked when they are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, MISSING
from math import inf, pi, sin
from typing import Any

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.settings import check_keys, setting, SettingError, Settings
from fourbar_ros.mechanism.forces import Surroundings, surroundings
from fourbar_ros.plant.sensors import LinkSensorSettings

# Largest slope of a table [rad]: on a steeper one the linkage slides off within a second.
STEEPEST = 0.1

# Standard gravity [m/s^2].
GRAVITY = 9.80665

# Smallest rate of the friction laws [rad/s], far below what an encoder resolves.
_SLOWEST = 1e-6


class TableError(SettingError):
    """A table or sensor that cannot exist or is not fully described."""


@dataclass(frozen=True)
class WheelEncoders(Settings):
    """The encoders between each wheel and its link."""

    section = 'wheel_encoders'

    counts_per_turn: int = setting(
        MISSING, 'counts per turn', 'resolution, 0 for unlimited', low=0, kind=int)


@dataclass(frozen=True)
class WheelBearings(Settings):
    """Friction between each wheel and its link."""

    section = 'wheel_bearings'

    viscous: float = setting(0.0, 'N m s', 'friction torque per relative speed', low=0.0)
    coulomb: float = setting(0.0, 'N m', 'Coulomb friction torque', low=0.0)
    static_ratio: float = setting(1.0, '', 'static over Coulomb friction', low=1.0)
    stribeck_speed: float = setting(
        1.0, 'rad/s', 'relative speed at which half of the excess of static friction is left',
        low=_SLOWEST)
    smoothing: float = setting(
        1e-4, 'rad/s', 'relative speed below which dry friction fades, so that a wheel can rest',
        low=_SLOWEST)


@dataclass(frozen=True)
class Joints(Settings):
    """Friction in the four passive joints."""

    section = 'joints'

    viscous: float = setting(0.0, 'N m s', 'friction torque per relative rate', low=0.0)
    coulomb: float = setting(0.0, 'N m', 'Coulomb friction torque', low=0.0)
    static_ratio: float = setting(1.0, '', 'static over Coulomb friction', low=1.0)
    stribeck_rate: float = setting(
        0.1, 'rad/s', 'relative rate at which half of the excess of static friction is left',
        low=_SLOWEST)
    smoothing: float = setting(
        1e-4, 'rad/s', 'relative rate below which dry friction fades, so that a joint can rest',
        low=_SLOWEST)


@dataclass(frozen=True)
class Links(Settings):
    """Air drag on each link."""

    section = 'links'

    drag: float = setting(0.0, 'N s/m', 'force against the speed of the mass centre', low=0.0)
    spin_drag: float = setting(0.0, 'N m s', 'torque against the rate of the link', low=0.0)


@dataclass(frozen=True)
class Surface(Settings):
    """The table itself: a rectangle about the origin of the frame `table`."""

    section = 'surface'

    tilt_x: float = setting(0.0, 'rad', 'slope down towards +x', low=-STEEPEST, high=STEEPEST)
    tilt_y: float = setting(0.0, 'rad', 'slope down towards +y', low=-STEEPEST, high=STEEPEST)
    size_x: float = setting(inf, 'm', 'extent along x', above=0.0, infinite=True)
    size_y: float = setting(inf, 'm', 'extent along y', above=0.0, infinite=True)
    restitution: float = setting(
        0.0, '', 'speed of a joint after a contact with the edge over that before', low=0.0,
        high=1.0)


@dataclass(frozen=True)
class Disturbance(Settings):
    """Random torques on the links, held over each control period."""

    section = 'disturbance'

    torque_density: float = setting(
        0.0, 'N m/sqrt(Hz)', 'density of white noise on each link', low=0.0)
    torque_walk: float = setting(
        0.0, 'N m/sqrt(s)', 'density of a random walk on links a and b, besides the noise',
        low=0.0)

    @property
    def acting(self) -> bool:
        """Whether there is any random torque."""
        return self.torque_density > 0.0 or self.torque_walk > 0.0


@dataclass(frozen=True)
class Table:
    """The surroundings of the linkage that the plant simulates; a missing section does not act."""

    link_sensors: LinkSensorSettings
    wheel_encoders: WheelEncoders
    wheel_bearings: WheelBearings = field(default_factory=WheelBearings)
    joints: Joints = field(default_factory=Joints)
    links: Links = field(default_factory=Links)
    surface: Surface = field(default_factory=Surface)
    disturbance: Disturbance = field(default_factory=Disturbance)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], place: str) -> Table:
        """
        Make a table from the sections of a table file.

        :param place: origin of the values, for messages.
        :raises TableError: a section or key is missing or unknown, or a value is refused.
        """
        try:
            check_keys(values, REQUIRED, 'table', TableError, optional=SECTIONS)
            sections: dict[str, Any] = {
                name: SECTIONS[name].from_mapping(keys) for name, keys in values.items()}
            return cls(**sections)
        except SettingError as error:
            raise error.at(place, TableError) from None


SECTIONS: dict[str, type[Settings]] = {kind.section: kind for kind in (
    LinkSensorSettings, WheelEncoders, WheelBearings, Joints, Links, Surface, Disturbance)}
REQUIRED = ('link_sensors', 'wheel_encoders')


def load_table(name: str) -> Table:
    """
    Read a table file.

    :param name: a preset (`ideal` for config/table_ideal.yaml) or the path of a YAML file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises TableError: the table cannot exist.
    """
    path = config_file('table', name)
    return Table.from_mapping(load_yaml(path), str(path))


def surroundings_of(table: Table) -> Surroundings:
    """Return the forces of a table on the links, without random torques."""
    joints, surface = table.joints, table.surface
    return surroundings(
        joint_coulomb=joints.coulomb, joint_viscous=joints.viscous,
        joint_static_ratio=joints.static_ratio, stribeck_rate=joints.stribeck_rate,
        smoothing=joints.smoothing, link_drag=table.links.drag,
        link_spin_drag=table.links.spin_drag,
        gravity=[GRAVITY * sin(surface.tilt_x), GRAVITY * sin(surface.tilt_y)])


def quantum(counts_per_turn: int) -> float:
    """Return the angle of one count [rad], 0 for unlimited resolution."""
    return 2.0 * pi / counts_per_turn if counts_per_turn else 0.0
