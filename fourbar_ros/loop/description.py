# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A scenario as one plain mapping with every default and without references to files."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop.scenario import read_scenario, scenario_from, ScenarioError
from fourbar_ros.mechanism import Mechanism


def load_description(name: str) -> dict[str, Any]:
    """
    Read a scenario file and describe it completely.

    :param name: a preset or the path of a YAML file.
    :raises FourbarError: as `load_scenario`.
    """
    values, path = read_scenario(name)
    try:
        return describe(values, path.parent)
    except FourbarError as error:
        raise error.at(path, ScenarioError) from None


def describe(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """
    Describe a scenario completely: `scenario_from` makes the same one from it, in any folder.

    :param values: the keys of a scenario file.
    :param folder: start of relative paths.
    :returns: mechanism, model and table as mappings, every section with every key; setpoints
        unchanged, since a relative one depends on the initial state.
    :raises FourbarError: a key is missing or unknown, or a value is refused.
    """
    scenario = scenario_from(values, folder)
    return {
        'mechanism': _keys_of(scenario.mechanism), 'model': _keys_of(scenario.model),
        'table': _lists(asdict(scenario.table)), 'seed': scenario.seed,
        'duration': scenario.duration, 'initial': asdict(scenario.initial),
        'plant': asdict(scenario.plant), 'estimator': asdict(scenario.estimator),
        'controller': asdict(scenario.controller), 'arm_at': scenario.arm_at,
        'setpoints': deepcopy(values.get('setpoints', []))}


def _keys_of(mechanism: Mechanism) -> dict[str, Any]:
    return {item.name: getattr(mechanism, item.name).tolist() for item in fields(Mechanism)}


def _lists(value: Any) -> Any:
    """Replace tuples by lists, as YAML has them."""
    if isinstance(value, dict):
        return {key: _lists(each) for key, each in value.items()}
    return list(value) if isinstance(value, tuple) else value
