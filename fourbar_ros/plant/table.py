# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters of a table and of the sensors on it, checked when they are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, MISSING
from math import inf, isfinite, pi, sin
from typing import Any

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import check_keys
from fourbar_ros.mechanism.forces import Surroundings, surroundings
from fourbar_ros.plant.sensors import LinkSensorSettings, SensorError

# A steeper table is a slide [rad].
STEEPEST = 0.1
# Standard gravity [m/s^2].
GRAVITY = 9.80665


class TableError(FourbarError):
    """A table or sensor that cannot exist or is not fully described."""


@dataclass(frozen=True)
class WheelEncoders:
    """
    The encoders between each wheel and its link.

    :param counts_per_turn: resolution, 0 for none.
    """

    counts_per_turn: int

    def __post_init__(self) -> None:
        """Refuse what no encoder can have."""
        _check_counts('wheel_encoders.counts_per_turn', self.counts_per_turn)


@dataclass(frozen=True)
class WheelBearings:
    """
    Friction between each wheel and its link.

    :param viscous: torque per relative speed [N m s].
    :param coulomb: torque of dry friction [N m].
    :param static_ratio: how much more than that it takes to break away.
    :param stribeck_speed: relative speed at which half of the surplus is left [rad/s].
    :param smoothing: relative speed below which friction fades away, so that rest is rest [rad/s].
    """

    viscous: float = 0.0
    coulomb: float = 0.0
    static_ratio: float = 1.0
    stribeck_speed: float = 1.0
    smoothing: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse what no bearing can have."""
        _check_friction('wheel_bearings', self, self.stribeck_speed, 'stribeck_speed')


@dataclass(frozen=True)
class Joints:
    """
    Friction in the four passive joints.

    :param viscous: torque per relative rate [N m s].
    :param coulomb: torque of dry friction [N m].
    :param static_ratio: how much more than that it takes to break away.
    :param stribeck_rate: relative rate at which half of the surplus is left [rad/s].
    :param smoothing: relative rate below which friction fades away, so that rest is rest [rad/s].
    """

    viscous: float = 0.0
    coulomb: float = 0.0
    static_ratio: float = 1.0
    stribeck_rate: float = 0.1
    smoothing: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse what no joint can have."""
        _check_friction('joints', self, self.stribeck_rate, 'stribeck_rate')


@dataclass(frozen=True)
class Links:
    """
    Air drag on each link.

    :param drag: force against the speed of its mass centre [N s/m].
    :param spin_drag: torque against its rate [N m s].
    """

    drag: float = 0.0
    spin_drag: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what feeds energy in."""
        _check('links.drag', self.drag)
        _check('links.spin_drag', self.spin_drag)


@dataclass(frozen=True)
class Surface:
    """
    The table itself: a rectangle about the origin of the frame `table`.

    :param tilt_x, tilt_y: slope down towards +x and +y [rad].
    :param size_x, size_y: extent, infinite by default [m].
    :param restitution: share of its speed with which a joint leaves the edge that it met, 0 to 1.
    """

    tilt_x: float = 0.0
    tilt_y: float = 0.0
    size_x: float = inf
    size_y: float = inf
    restitution: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no table."""
        for name in ('tilt_x', 'tilt_y'):
            _check(f'surface.{name}', getattr(self, name), least=-STEEPEST, most=STEEPEST)
        for name in ('size_x', 'size_y'):
            size = getattr(self, name)
            if size != inf:
                _check(f'surface.{name}', size)
            if not size > 0.0:
                raise TableError(f'surface.{name} must be positive, got {size}')
        _check('surface.restitution', self.restitution, most=1.0)


@dataclass(frozen=True)
class Disturbance:
    """
    Random torques on the links, held over each control period.

    :param torque_density: of white noise on each link [N m/sqrt(Hz)].
    :param torque_walk: of a random walk on links a and b, beside it [N m/sqrt(s)].
    """

    torque_density: float = 0.0
    torque_walk: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no density."""
        _check('disturbance.torque_density', self.torque_density)
        _check('disturbance.torque_walk', self.torque_walk)

    @property
    def acting(self) -> bool:
        """Whether there is any."""
        return self.torque_density > 0.0 or self.torque_walk > 0.0


@dataclass(frozen=True)
class Table:
    """Everything around the linkage that the plant simulates; what is left out does not act."""

    link_sensors: LinkSensorSettings
    wheel_encoders: WheelEncoders
    wheel_bearings: WheelBearings = field(default_factory=WheelBearings)
    joints: Joints = field(default_factory=Joints)
    links: Links = field(default_factory=Links)
    surface: Surface = field(default_factory=Surface)
    disturbance: Disturbance = field(default_factory=Disturbance)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], origin: str) -> Table:
        """
        Make a table from the sections of a table file.

        :param origin: where the values come from, for messages.
        :raises TableError: a section or key is missing or unknown, or a value is refused.
        """
        check_keys(values, REQUIRED, origin, TableError, optional=set(SECTIONS) - REQUIRED)
        made: dict[str, Any] = {}
        for name, section in values.items():
            kind = SECTIONS[name]
            if not isinstance(section, Mapping):
                raise TableError(f'{origin}: {name} must be a section of its own')
            required = {item.name for item in fields(kind) if item.default is MISSING}
            optional = {item.name for item in fields(kind)} - required
            check_keys(section, required, f'{origin}, {name}', TableError, optional=optional)
            try:
                made[name] = kind(**section)
            except (SensorError, TableError) as error:
                raise TableError(f'{origin}: {error}') from None
        return cls(**made)


SECTIONS: dict[str, Any] = {
    'link_sensors': LinkSensorSettings, 'wheel_encoders': WheelEncoders,
    'wheel_bearings': WheelBearings, 'joints': Joints, 'links': Links, 'surface': Surface,
    'disturbance': Disturbance}
REQUIRED = {'link_sensors', 'wheel_encoders'}


def load_table(name: str) -> Table:
    """
    Read a table file.

    :param name: a preset (`ideal` for config/table_ideal.yaml) or the path of a YAML file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises TableError: what it describes cannot exist.
    """
    path = config_file('table', name)
    return Table.from_mapping(load_yaml(path), str(path))


def surroundings_of(table: Table) -> Surroundings:
    """Collect what acts on the links there, but for random torques."""
    joints, surface = table.joints, table.surface
    return surroundings(
        joint_coulomb=joints.coulomb, joint_viscous=joints.viscous,
        joint_static_ratio=joints.static_ratio, stribeck_rate=joints.stribeck_rate,
        smoothing=joints.smoothing, link_drag=table.links.drag,
        link_spin_drag=table.links.spin_drag,
        gravity=[GRAVITY * sin(surface.tilt_x), GRAVITY * sin(surface.tilt_y)])


def quantum(counts_per_turn: int) -> float:
    """Turn a resolution in counts per turn into an angle [rad], 0 for none."""
    return 2.0 * pi / counts_per_turn if counts_per_turn else 0.0


def _check(name: str, value: Any, least: float = 0.0, most: float = inf) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TableError(f'{name} must be a number, got {value!r}')
    if not (isfinite(value) and least <= value <= most):
        limits = ('finite and not negative' if (least, most) == (0.0, inf)
                  else f'between {least:g} and {most:g}' if isfinite(most)
                  else f'finite and at least {least:g}')
        raise TableError(f'{name} must be {limits}, got {value}')


def _check_counts(name: str, value: Any) -> None:
    _check(name, value)
    if value != int(value):
        raise TableError(f'{name} must be a whole number, got {value}')


def _check_friction(section: str, values: WheelBearings | Joints, stribeck: float, name: str
                    ) -> None:
    _check(f'{section}.viscous', values.viscous)
    _check(f'{section}.coulomb', values.coulomb)
    _check(f'{section}.static_ratio', values.static_ratio, least=1.0)
    _check(f'{section}.{name}', stribeck, least=1e-6)
    _check(f'{section}.smoothing', values.smoothing, least=1e-6)
