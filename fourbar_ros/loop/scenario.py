# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
A scenario: everything that makes a run of the closed loop the same one every time.

Mechanism, table, parameters of the nodes, where the linkage starts, when the device is armed, what
it is told to do, for how long, and the seed of all random numbers (docs/scenarios.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from math import floor
from pathlib import Path
from typing import Any, cast, TypeVar

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import check_keys, Setting, settings_of
from fourbar_ros.control import ControllerSettings
from fourbar_ros.control.parameters import SETTINGS as CONTROLLER
from fourbar_ros.device import SupervisorSettings
from fourbar_ros.estimation import EstimatorSettings
from fourbar_ros.estimation.parameters import SETTINGS as ESTIMATOR
from fourbar_ros.mechanism import assemble, LINK_NAMES, load_mechanism, Mechanism
from fourbar_ros.mechanism.closure import BRANCHES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant import InitialState, load_table, Table

LARGEST_SEED = 2 ** 63 - 1
LONGEST_RUN = 3600.0
"""A run takes memory by its length [s]."""

# What a number may be, with its unit; what a word may be.
Allowed = tuple[float, float, str] | tuple[str, ...]
_Section = TypeVar('_Section')


class ScenarioError(FourbarError):
    """A scenario that cannot be run or is not fully described."""


@dataclass(frozen=True)
class PlantSettings:
    """
    The plant's parameters, as the node of that name has them.

    :param rate: ticks per second [Hz].
    :param step: integration step, the period is a whole multiple of it [s].
    :param command_timeout: longest time without a command while armed [s].
    :param sensor_timeout: a link without a sample for so long is silent [s].
    :param timeout_action: what the wheels do when commands stay away.
    """

    rate: float = 250.0
    step: float = 5e-4
    command_timeout: float = 0.1
    sensor_timeout: float = 0.2
    timeout_action: str = 'coast'

    @property
    def period_ns(self) -> int:
        """Time between two ticks [ns]."""
        return round(1e9 / self.rate)


@dataclass(frozen=True)
class ScriptedSetpoint:
    """
    A setpoint of the script.

    :param at: when it is given, after the first tick [s].
    :param names: links.
    :param positions: goal orientation of each in frame `table` [rad].
    :param duration: time in which it is reached, None for the controller's parameter [s].
    """

    at: float
    names: tuple[str, ...]
    positions: tuple[float, ...]
    duration: float | None = None


@dataclass(frozen=True, eq=False)
class Scenario:
    """
    A run of the closed loop.

    :param mechanism_name, table_name, believed_name: presets, absolute paths of files, or '' for
        what is described in the scenario itself.
    :param mechanism, table: what is in them.
    :param believed: the linkage that estimator and controller believe to have.
    :param initial: where the linkage starts.
    :param plant, estimator, controller: parameters of the nodes.
    :param arm_at: when the device is armed, after the first tick, None for never [s].
    :param setpoints: in the order of their times, after arming.
    :param duration: from the first tick to the last [s].
    :param seed: of all random numbers.
    :raises ScenarioError: duration or seed out of range.
    """

    mechanism_name: str
    mechanism: Mechanism
    believed_name: str
    believed: Mechanism
    table_name: str
    table: Table
    initial: InitialState
    plant: PlantSettings
    estimator: EstimatorSettings
    controller: ControllerSettings
    arm_at: float | None
    setpoints: tuple[ScriptedSetpoint, ...]
    duration: float
    seed: int

    def __post_init__(self) -> None:
        """Check what a command may replace."""
        _checked('duration', self.duration, 0.0, (1e-6, LONGEST_RUN, 's'))
        _checked('seed', self.seed, 0, (0, LARGEST_SEED, ''))

    @property
    def ticks(self) -> int:
        """Count the ticks, the first one and that at the end included."""
        return floor(self.duration * 1e9 / self.plant.period_ns + 1e-6) + 1

    def tick_at(self, seconds: float) -> int:
        """Return the number of the first tick at or after a time since the first one, tick 0."""
        return tick_at(seconds, self.plant.period_ns)

    def parameters(self) -> dict[str, dict[str, Any]]:
        """
        Return the parameters that make nodes run this scenario, by node and name.

        :raises ScenarioError: it describes what nodes take from a file only.
        """
        for kind in ('mechanism', 'believed', 'table'):
            if not getattr(self, f'{kind}_name'):
                raise ScenarioError(f'{kind} is described in the scenario itself: nodes need a '
                                    'preset or a file of its own')
        initial = {f'initial.{name}': value for name, value in asdict(self.initial).items()}
        return {
            'plant': {'mechanism': self.mechanism_name, 'table': self.table_name,
                      'seed': self.seed, **asdict(self.plant), **initial},
            'estimator': {'mechanism': self.believed_name, **asdict(self.estimator)},
            'controller': {'mechanism': self.believed_name, **asdict(self.controller)},
        }


def _allowed(rows: Sequence[Setting]) -> dict[str, Allowed]:
    """Return what the table of a node allows."""
    allowed: dict[str, Allowed] = {}
    for row in rows:
        if row.limits is not None:
            allowed[row.name] = (*row.limits, row.unit)
        elif row.choices is not None:
            allowed[row.name] = row.choices
    return allowed


# The same as in the tables of the nodes.
ALLOWED: dict[str, dict[str, Allowed]] = {
    'initial': {
        'link_a': (-1e6, 1e6, 'rad'), 'link_b': (-1e6, 1e6, 'rad'), 'branch': BRANCHES,
        'rate_a': (-100.0, 100.0, 'rad/s'), 'rate_b': (-100.0, 100.0, 'rad/s')},
    'plant': {
        'step': (1e-6, 0.1, 's'), **_allowed(settings_of(SupervisorSettings))},
    'estimator': _allowed(ESTIMATOR),
    'controller': _allowed(CONTROLLER),
}
REQUIRED = ('mechanism', 'table', 'initial', 'duration', 'seed')
OPTIONAL = ('believed', 'plant', 'estimator', 'controller', 'arm_at', 'setpoints')


def load_scenario(name: str) -> Scenario:
    """
    Read a scenario file.

    :param name: a preset (`paper` for config/scenario_paper.yaml) or the path of a YAML file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises ScenarioError: what it describes cannot be run, or its mechanism or table is refused.
    """
    path = config_file('scenario', name)
    values = load_yaml(path)
    try:
        return scenario_from(values, path.parent)
    except FourbarError as error:
        raise ScenarioError(f'{path}: {error}') from None


def scenario_from(values: Mapping[str, Any], folder: Path) -> Scenario:
    """
    Make a scenario from the keys of a scenario file.

    :param folder: where relative paths of mechanisms and table begin.
    :raises FourbarError: a key is missing or unknown, or a value is refused.
    """
    check_keys(values, REQUIRED, 'scenario', ScenarioError, optional=OPTIONAL)
    mechanism_name, mechanism = _mechanism('mechanism', values['mechanism'], folder)
    believed_name, believed = mechanism_name, mechanism
    if 'believed' in values:
        try:
            believed_name, believed = _mechanism('believed', values['believed'], folder)
        except FourbarError as error:
            # There are two of its kind: say which.
            raise ScenarioError(f'believed: {error}') from None
    table_name, table = _table(values['table'], folder)
    initial = _section('initial', InitialState, values)
    plant = _section('plant', PlantSettings, values)
    start = assemble(mechanism, initial.link_a, initial.link_b, initial.branch)
    duration = float(_checked('duration', values['duration'], 0.0, (1e-6, LONGEST_RUN, 's')))
    arm_at = values.get('arm_at')
    if arm_at is not None:
        arm_at = float(_checked('arm_at', arm_at, 0.0, (0.0, duration, 's')))
    return Scenario(
        mechanism_name, mechanism, believed_name, believed, table_name, table, initial, plant,
        _section('estimator', EstimatorSettings, values),
        _section('controller', ControllerSettings, values), arm_at,
        _script(values.get('setpoints', []), start, arm_at, duration, plant.period_ns), duration,
        _checked('seed', values['seed'], 0, (0, LARGEST_SEED, '')))


def tick_at(seconds: float, period_ns: int) -> int:
    """Return the number of the first tick at or after a time since tick 0 [s]."""
    return -floor(-seconds * 1e9 / period_ns + 1e-6)


def _script(entries: Any, start: Array, arm_at: float | None, duration: float, period_ns: int
            ) -> tuple[ScriptedSetpoint, ...]:
    """
    Read the list of setpoints.

    :param start: (4,) initial link angles [rad].
    """
    if not isinstance(entries, list):
        raise ScenarioError(f'setpoints must be a list, got {entries!r}')
    setpoints: list[ScriptedSetpoint] = []
    for number, entry in enumerate(entries, 1):
        place = f'setpoints, entry {number}'
        if arm_at is None:
            raise ScenarioError(f'{place}: refused, the device is never armed: arm_at is missing')
        setpoint = _setpoint(entry, place, start, duration)
        if tick_at(setpoint.at, period_ns) <= tick_at(arm_at, period_ns):
            raise ScenarioError(f'{place}: at {setpoint.at:g} s is not a tick after arm_at '
                                f'{arm_at:g} s')
        if setpoints and setpoint.at <= setpoints[-1].at:
            raise ScenarioError(f'{place}: at {setpoint.at:g} s is not after entry {number - 1}, '
                                f'{setpoints[-1].at:g} s')
        setpoints.append(setpoint)
    return tuple(setpoints)


def _setpoint(entry: Any, place: str, start: Array, duration: float) -> ScriptedSetpoint:
    if not isinstance(entry, Mapping):
        raise ScenarioError(f'{place} must have keys (at, links or relative, duration), got '
                            f'{entry!r}')
    check_keys(entry, ('at',), place, ScenarioError, optional=('links', 'relative', 'duration'))
    if ('links' in entry) == ('relative' in entry):
        raise ScenarioError(f'{place}: give either links or relative')
    at = float(_checked(f'{place}: at', entry['at'], 0.0, (0.0, duration, 's')))
    kind = 'links' if 'links' in entry else 'relative'
    goals = entry[kind]
    if not isinstance(goals, Mapping) or not goals:
        raise ScenarioError(f'{place}: {kind} must name links, got {goals!r}')
    check_keys(goals, (), f'{place}: {kind}', ScenarioError, optional=LINK_NAMES)
    angles = {name: float(_checked(f'{place}: {kind}.{name}', angle, 0.0, (-1e6, 1e6, 'rad')))
              for name, angle in goals.items()}
    if kind == 'relative':
        angles = {name: float(start[LINK_NAMES.index(name)]) + angle
                  for name, angle in angles.items()}
    within = entry.get('duration')
    if within is not None:
        within = float(_checked(f'{place}: duration', within, 0.0,
                                ALLOWED['controller']['setpoint_duration']))
    return ScriptedSetpoint(at, tuple(angles), tuple(angles.values()), within)


def _section(name: str, kind: type[_Section], values: Mapping[str, Any]) -> _Section:
    """Make the settings in one section; what is left out has its default."""
    section = values.get(name, {})
    if not isinstance(section, Mapping):
        raise ScenarioError(f'{name} must be a section of its own, got {section!r}')
    allowed = ALLOWED[name]
    check_keys(section, (), name, ScenarioError, optional=allowed)
    defaults = {item.name: item.default for item in fields(kind)}  # type: ignore[arg-type]
    return kind(**{
        key: _checked(f'{name}.{key}', value, defaults[key], allowed[key])
        for key, value in section.items()})


def _checked(name: str, value: Any, default: Any, allowed: Allowed) -> Any:
    """
    Return a value in the type of its default.

    :param allowed: smallest and largest number with their unit, or all words.
    """
    if isinstance(default, str):
        if value not in allowed:
            raise ScenarioError(f'{name} must be one of {", ".join(map(str, allowed))}, got '
                                f'{value!r}')
        return value
    whole = isinstance(default, int)
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        raise ScenarioError(f'{name} must be a {"whole " if whole else ""}number, got {value!r}')
    low, high, unit = cast(tuple[float, float, str], allowed)
    # Written so that NaN fails.
    if not low <= value <= high:
        raise ScenarioError(f'{name} must be between {low:g} and {high:g} {unit}'.rstrip()
                            + f', got {value!r:.40}')
    return value if whole else float(value)


def _mechanism(kind: str, given: Any, folder: Path) -> tuple[str, Mechanism]:
    """Return the name, '' without one, and the mechanism that is named or described."""
    if isinstance(given, Mapping):
        return '', Mechanism.from_mapping(given, 'mechanism')
    name = _file_name(kind, given, folder)
    return name, load_mechanism(name)


def _table(given: Any, folder: Path) -> tuple[str, Table]:
    """Return the name, '' without one, and the table that is named or described."""
    if isinstance(given, Mapping):
        return '', Table.from_mapping(given, 'table')
    name = _file_name('table', given, folder)
    return name, load_table(name)


def _file_name(kind: str, name: Any, folder: Path) -> str:
    """Turn the name of a preset or file in a scenario into one that holds everywhere."""
    if not isinstance(name, str):
        raise ScenarioError(
            f'{kind} must be the name of a preset or file, or keys of its own, got {name!r}')
    path = Path(name).expanduser()
    if '/' in name or path.suffix in ('.yaml', '.yml'):
        return str((folder / path).absolute())
    return name
