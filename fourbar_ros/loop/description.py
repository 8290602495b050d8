# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A scenario as one plain mapping, nothing left to defaults and nothing in other files."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from fourbar_ros.common.config_files import config_file, load_yaml
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop.scenario import scenario_from, ScenarioError
from fourbar_ros.mechanism import Mechanism


def load_description(name: str) -> dict[str, Any]:
    """
    Read a scenario file and spell it out.

    :param name: a preset or the path of a YAML file.
    :raises FourbarError: as `load_scenario`.
    """
    path = config_file('scenario', name)
    values = load_yaml(path)
    try:
        return describe(values, path.parent)
    except FourbarError as error:
        raise ScenarioError(f'{path}: {error}') from None


def describe(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """
    Spell out a scenario: `scenario_from` makes the same one of it, in any folder.

    :param values: the keys of a scenario file.
    :param folder: where relative paths in it begin.
    :returns: mechanism, believed and table as mappings, every section with every key; setpoints
        as they are written, since a relative one means something else elsewhere.
    :raises FourbarError: a key is missing or unknown, or a value is refused.
    """
    scenario = scenario_from(values, folder)
    return {
        'mechanism': _keys_of(scenario.mechanism), 'believed': _keys_of(scenario.believed),
        'table': _lists(asdict(scenario.table)), 'seed': scenario.seed,
        'duration': scenario.duration, 'initial': asdict(scenario.initial),
        'plant': asdict(scenario.plant), 'estimator': asdict(scenario.estimator),
        'controller': asdict(scenario.controller), 'arm_at': scenario.arm_at,
        'setpoints': deepcopy(values.get('setpoints', []))}


def _keys_of(mechanism: Mechanism) -> dict[str, Any]:
    return {item.name: getattr(mechanism, item.name).tolist() for item in fields(Mechanism)}


def _lists(value: Any) -> Any:
    """Turn tuples into the lists that YAML has."""
    if isinstance(value, dict):
        return {key: _lists(each) for key, each in value.items()}
    return list(value) if isinstance(value, tuple) else value
