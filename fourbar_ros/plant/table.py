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

"""The parameters of a table and of the sensors on it, checked when they are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import isfinite, pi
from typing import Any

from fourbar_ros.configuration import check_keys, config_file, load_yaml
from fourbar_ros.errors import FourbarError


class TableError(FourbarError):
    """A table or sensor that cannot exist or is not fully described."""


@dataclass(frozen=True)
class LinkSensors:
    """
    The sensors of the four link orientations.

    :param noise_rms: white noise of each sample [rad].
    :param counts_per_turn: resolution, 0 for none.
    """

    noise_rms: float
    counts_per_turn: int

    def __post_init__(self) -> None:
        """Refuse what no sensor can have."""
        _check('link_sensors.noise_rms', self.noise_rms)
        _check_counts('link_sensors.counts_per_turn', self.counts_per_turn)


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
class Table:
    """Everything around the linkage that the plant simulates."""

    link_sensors: LinkSensors
    wheel_encoders: WheelEncoders

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], origin: str) -> Table:
        """
        Make a table from the sections of a table file.

        :param origin: where the values come from, for messages.
        :raises TableError: a section or key is missing or unknown, or a value is refused.
        """
        sections = {'link_sensors': LinkSensors, 'wheel_encoders': WheelEncoders}
        check_keys(values, sections, origin, TableError)
        made = {}
        for name, kind in sections.items():
            section = values[name]
            if not isinstance(section, Mapping):
                raise TableError(f'{origin}: {name} must be a section of its own')
            keys = {item.name for item in fields(kind)}
            check_keys(section, keys, f'{origin}, {name}', TableError)
            try:
                made[name] = kind(**section)
            except TableError as error:
                raise TableError(f'{origin}: {error}') from None
        return cls(**made)


def load_table(name: str) -> Table:
    """
    Read a table file.

    :param name: a preset (`ideal` for config/table_ideal.yaml) or the path of a YAML file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises TableError: what it describes cannot exist.
    """
    path = config_file('table', name)
    return Table.from_mapping(load_yaml(path), str(path))


def quantum(counts_per_turn: int) -> float:
    """Turn a resolution in counts per turn into an angle [rad], 0 for none."""
    return 2.0 * pi / counts_per_turn if counts_per_turn else 0.0


def _check(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TableError(f'{name} must be a number, got {value!r}')
    if not isfinite(value) or value < 0:
        raise TableError(f'{name} must be finite and not negative, got {value}')


def _check_counts(name: str, value: Any) -> None:
    _check(name, value)
    if value != int(value):
        raise TableError(f'{name} must be a whole number, got {value}')
