# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
A scenario: the complete description of a run of the closed loop.

It holds mechanism, table, settings of the nodes, initial state, time of arming, setpoints,
duration and the seed of all random numbers (docs/scenarios.md). Equal scenarios give equal runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
import logging
from math import floor
from pathlib import Path
from typing import Any, TypeVar

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import check_keys, Setting, SettingError, settings_of
from fourbar_ros.control import ControllerSettings
from fourbar_ros.control.settings import SETTINGS as CONTROLLER
from fourbar_ros.device import SupervisorSettings
from fourbar_ros.estimation import EstimatorSettings
from fourbar_ros.estimation.estimator_settings import SETTINGS as ESTIMATOR
from fourbar_ros.mechanism import assemble, LINK_NAMES, load_mechanism, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plant import InitialState, load_table, SimulationSettings, Table

# Longest duration [s]: the memory of a run grows with it.
LONGEST_RUN = 3600.0
# Deprecated name of the key `model`.
OLD_MODEL_KEY = 'believed'

_STEP, _SEED = settings_of(SimulationSettings)
_COMMAND_TIMEOUT, = (row for row in settings_of(SupervisorSettings)
                     if row.name == 'command_timeout')
_DURATION = Setting('duration', 0.0, 's', 'time from the first tick to the last',
                    low=1e-6, high=LONGEST_RUN)
_ANGLE = Setting('', 0.0, 'rad', 'orientation of a link, or change of it', low=-1e6, high=1e6)
_SETPOINT_DURATION, = (
    row for row in CONTROLLER if row.name == 'setpoint_duration')
_Settings = TypeVar('_Settings')


class ScenarioError(FourbarError):
    """A scenario that cannot be run or is not completely described."""


@dataclass(frozen=True)
class PlantSettings(SupervisorSettings):
    """Settings of the node `plant`: those of every device, and the integration step."""

    # Programs that start on a shared computer delay nodes by several tenths of a second, and no
    # hardware can be harmed meanwhile.
    command_timeout: float = field(
        default=1.0, metadata={'setting': replace(_COMMAND_TIMEOUT, default=1.0)})
    step: float = field(default=_STEP.default, metadata={'setting': _STEP})


@dataclass(frozen=True)
class ScriptedSetpoint:
    """
    A setpoint at a time of the run.

    :param at: time after the first tick [s].
    :param names: links.
    :param positions: goal orientation of each link in frame `table` [rad].
    :param duration: time in which it is reached, None for `setpoint_duration` [s].
    """

    at: float
    names: tuple[str, ...]
    positions: tuple[float, ...]
    duration: float | None = None


@dataclass(frozen=True, eq=False)
class Scenario:
    """
    A run of the closed loop.

    :param mechanism_name, model_name, table_name: presets, absolute paths of files, or '' for
        contents of the scenario itself.
    :param mechanism: the linkage on the table.
    :param model: the linkage that estimator and controller assume.
    :param arm_at: time of arming after the first tick, None for never [s].
    :param setpoints: in the order of their times, after arming.
    :param duration: time from the first tick to the last [s].
    :param seed: of all random numbers.
    :raises ScenarioError: duration or seed out of range.
    """

    mechanism_name: str
    mechanism: Mechanism
    model_name: str
    model: Mechanism
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
        """Check duration and seed, which callers replace."""
        _check(_DURATION, self.duration)
        _check(_SEED, self.seed)

    @property
    def ticks(self) -> int:
        """Number of ticks, the first and the last included."""
        return floor(self.duration * 1e9 / self.plant.period_ns + 1e-6) + 1

    def tick_at(self, seconds: float) -> int:
        """Return the number of the first tick at or after a time since the first one, tick 0."""
        return tick_at(seconds, self.plant.period_ns)

    def parameters(self) -> dict[str, dict[str, Any]]:
        """
        Return the parameters with which the nodes run this scenario, by node and name.

        :raises ScenarioError: mechanism, model or table is described in the scenario itself.
        """
        for key in ('mechanism', 'model', 'table'):
            if not getattr(self, f'{key}_name'):
                raise ScenarioError(f'{key} is described in the scenario itself: nodes need a '
                                    'preset or a file of its own', name=key)
        initial = {f'initial.{name}': value for name, value in asdict(self.initial).items()}
        return {
            'plant': {'mechanism': self.mechanism_name, 'table': self.table_name,
                      'seed': self.seed, **asdict(self.plant), **initial},
            'estimator': {'mechanism': self.model_name, **asdict(self.estimator)},
            'controller': {'mechanism': self.model_name, **asdict(self.controller)},
        }


REQUIRED = ('mechanism', 'table', 'initial', 'duration', 'seed')
OPTIONAL = (
    'model', OLD_MODEL_KEY, 'plant', 'estimator', 'controller', 'arm_at', 'setpoints')


def load_scenario(name: str) -> Scenario:
    """
    Read a scenario file.

    :param name: a preset (`paper` for config/scenario_paper.yaml) or the path of a YAML file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    :raises ScenarioError: the scenario, its mechanism or its table is refused.
    """
    values, path = read_scenario(name)
    try:
        return scenario_from(values, path.parent)
    except FourbarError as error:
        raise error.at(path, ScenarioError) from None


def read_scenario(name: str) -> tuple[dict[str, Any], Path]:
    """
    Return the keys of a scenario file, and its path; log a deprecated key.

    :param name: a preset or the path of a YAML file.
    :raises ConfigurationError: no such preset or file, or not YAML.
    """
    path = config_file('scenario', name)
    values = load_yaml(path)
    if OLD_MODEL_KEY in values:
        logging.getLogger(__name__).warning(
            '%s: the key %s is deprecated, write model', path, OLD_MODEL_KEY)
    return values, path


def scenario_from(values: Mapping[str, Any], folder: Path) -> Scenario:
    """
    Make a scenario from the keys of a scenario file.

    :param folder: start of relative paths of mechanism, model and table.
    :raises FourbarError: a key is missing or unknown, or a value is refused.
    """
    check_keys(values, REQUIRED, 'scenario', ScenarioError, optional=OPTIONAL)
    mechanism_name, mechanism = _mechanism('mechanism', values['mechanism'], folder)
    model_name, model = mechanism_name, mechanism
    if (key := _model_key(values)) is not None:
        try:
            model_name, model = _mechanism(key, values[key], folder)
        except FourbarError as error:
            # A scenario names two mechanisms: the message says which one is refused.
            raise error.at(key, ScenarioError) from None
    table_name, table = _table(values['table'], folder)
    initial = _section('initial', InitialState, settings_of(InitialState), values)
    plant = _section('plant', PlantSettings, settings_of(PlantSettings), values)
    start = assemble(mechanism, initial.link_a, initial.link_b, initial.branch)
    duration = _check(_DURATION, values['duration'])
    arm_at = values.get('arm_at')
    if arm_at is not None:
        arm_at = _check(_time('arm_at', duration), arm_at)
    return Scenario(
        mechanism_name, mechanism, model_name, model, table_name, table, initial, plant,
        _section('estimator', EstimatorSettings, ESTIMATOR, values),
        _section('controller', ControllerSettings, CONTROLLER, values), arm_at,
        _setpoints(values.get('setpoints', []), start, arm_at, duration, plant.period_ns),
        duration, _check(_SEED, values['seed']))


def tick_at(seconds: float, period_ns: int) -> int:
    """Return the number of the first tick at or after a time since tick 0 [s]."""
    return -floor(-seconds * 1e9 / period_ns + 1e-6)


def _model_key(values: Mapping[str, Any]) -> str | None:
    """Return the key that names the model, None without one."""
    if 'model' in values and OLD_MODEL_KEY in values:
        raise ScenarioError(f'both model and {OLD_MODEL_KEY}, its deprecated name: remove '
                            f'{OLD_MODEL_KEY}', name=OLD_MODEL_KEY)
    return next((key for key in ('model', OLD_MODEL_KEY) if key in values), None)


def _time(name: str, duration: float) -> Setting:
    """Return the declaration of a time after the first tick."""
    return Setting(name, 0.0, 's', 'time after the first tick', low=0.0, high=duration)


def _setpoints(entries: Any, start: Array, arm_at: float | None, duration: float, period_ns: int
               ) -> tuple[ScriptedSetpoint, ...]:
    """
    Read the list of setpoints.

    :param start: (4,) initial link angles [rad].
    """
    if not isinstance(entries, list):
        raise ScenarioError(f'setpoints must be a list, got {entries!r}',
                            name='setpoints', value=entries, limit=list)
    setpoints: list[ScriptedSetpoint] = []
    for number, entry in enumerate(entries, 1):
        place = f'setpoints, entry {number}'
        if arm_at is None:
            raise ScenarioError(f'{place}: refused, the device is never armed: arm_at is missing',
                                place=place, missing=['arm_at'])
        setpoint = _setpoint(entry, place, start, duration)
        if tick_at(setpoint.at, period_ns) <= tick_at(arm_at, period_ns):
            raise ScenarioError(
                f'{place}: at {setpoint.at:g} s is not a tick after arm_at {arm_at:g} s',
                place=place, name='at', value=setpoint.at, limit=arm_at)
        if setpoints and setpoint.at <= setpoints[-1].at:
            raise ScenarioError(
                f'{place}: at {setpoint.at:g} s is not after entry {number - 1}, '
                f'{setpoints[-1].at:g} s',
                place=place, name='at', value=setpoint.at, limit=setpoints[-1].at)
        setpoints.append(setpoint)
    return tuple(setpoints)


def _setpoint(entry: Any, place: str, start: Array, duration: float) -> ScriptedSetpoint:
    if not isinstance(entry, Mapping):
        raise ScenarioError(f'{place} must have keys (at, links or relative, duration), got '
                            f'{entry!r}', name=place, value=entry, limit=dict)
    check_keys(entry, ('at',), place, ScenarioError, optional=('links', 'relative', 'duration'))
    if ('links' in entry) == ('relative' in entry):
        raise ScenarioError(f'{place}: give either links or relative',
                            place=place, name='links or relative')
    at = _check(_time('at', duration), entry['at'], f'{place}: at')
    key = 'links' if 'links' in entry else 'relative'
    goals = entry[key]
    if not isinstance(goals, Mapping) or not goals:
        raise ScenarioError(f'{place}: {key} must name links, got {goals!r}',
                            place=place, name=key, value=goals, limit=dict)
    check_keys(goals, (), f'{place}: {key}', ScenarioError, optional=LINK_NAMES)
    angles = {name: _check(_ANGLE, angle, f'{place}: {key}.{name}')
              for name, angle in goals.items()}
    if key == 'relative':
        angles = {name: float(start[LINK_NAMES.index(name)]) + angle
                  for name, angle in angles.items()}
    within = entry.get('duration')
    if within is not None:
        within = _check(_SETPOINT_DURATION, within, f'{place}: duration')
    return ScriptedSetpoint(at, tuple(angles), tuple(angles.values()), within)


def _section(name: str, kind: Callable[..., _Settings], rows: Sequence[Setting],
             values: Mapping[str, Any]) -> _Settings:
    """Return the settings of one section; a key that is left out has its default."""
    section = values.get(name, {})
    if not isinstance(section, Mapping):
        raise ScenarioError(f'{name} must be a section of its own, got {section!r}',
                            name=name, value=section, limit=dict)
    check_keys(section, (), name, ScenarioError, optional=[row.name for row in rows])
    return kind(**{row.name: _check(row, section[row.name], f'{name}.{row.name}')
                   for row in rows if row.name in section})


def _check(declared: Setting, value: Any, name: str = '') -> Any:
    try:
        return declared.check(value, name)
    except SettingError as error:
        raise ScenarioError(str(error), **error.values) from None


def _mechanism(key: str, content: Any, folder: Path) -> tuple[str, Mechanism]:
    """Return the mechanism that a key names or describes, and its name or ''."""
    if isinstance(content, Mapping):
        return '', Mechanism.from_mapping(content, 'mechanism')
    name = _file_name(key, content, folder)
    return name, load_mechanism(name)


def _table(content: Any, folder: Path) -> tuple[str, Table]:
    """Return the table that is named or described, and its name or ''."""
    if isinstance(content, Mapping):
        return '', Table.from_mapping(content, 'table')
    name = _file_name('table', content, folder)
    return name, load_table(name)


def _file_name(key: str, name: Any, folder: Path) -> str:
    """Return the name of a preset, or the absolute path of a file."""
    if not isinstance(name, str):
        raise ScenarioError(
            f'{key} must be the name of a preset or file, or keys of its own, got {name!r}',
            name=key, value=name, limit=str)
    path = Path(name).expanduser()
    if '/' in name or path.suffix in ('.yaml', '.yml'):
        return str((folder / path).absolute())
    return name
