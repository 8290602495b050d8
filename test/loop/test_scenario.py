# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Scenario files: contents, defaults, and errors with key, value and limit."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from math import inf, nan, pi
from pathlib import Path
from typing import Any

from fourbar_ros.common.config_files import ConfigurationError, presets, share_directory
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop import load_scenario, Scenario, ScenarioError
from fourbar_ros.loop.description import describe, load_description
from fourbar_ros.loop.scenario import scenario_from
from fourbar_ros.mechanism import assemble
from fourbar_ros.ros.parameters import TABLES
import numpy as np
import pytest
import yaml

GOOD: dict[str, Any] = {
    'mechanism': 'paper', 'table': 'ideal', 'seed': 3, 'duration': 2.0, 'arm_at': 0.3,
    'initial': {'link_a': 0.1, 'link_b': 1.2, 'branch': 'crossed'},
    'plant': {'rate': 500}, 'estimator': {'counts_per_turn': 0}, 'controller': {'damping': 1},
    'setpoints': [{'at': 0.5, 'links': {'link_a': 0.5, 'link_c': 0.2}},
                  {'at': 1, 'relative': {'link_d': -1}, 'duration': 0.5}],
}
Write = Callable[[dict[str, Any]], str]


@pytest.fixture
def written(tmp_path: Path) -> Write:
    """Return a function that writes a scenario file and returns its path."""
    def write(content: dict[str, Any]) -> str:
        path = tmp_path / 'mine.yaml'
        path.write_text(yaml.safe_dump(content))
        return str(path)
    return write


def changed(place: str, value: Any) -> dict[str, Any]:
    """Return the good scenario with one changed value; `...` removes it."""
    content = deepcopy(GOOD)
    *sections, name = [int(key) if key.isdigit() else key for key in place.split('.')]
    section: Any = content
    for key in sections:
        section = section[key]
    if value is ...:
        del section[name]
    else:
        section[name] = value
    return content


def test_presets_are_the_papers_manoeuvre() -> None:
    """The links a and b turn by 90 degrees in ten seconds, from 0 and 60 degrees at rest."""
    assert {'paper', 'prototype'} <= set(presets('scenario'))
    for name in ('paper', 'prototype'):
        scenario = load_scenario(name)
        assert scenario.mechanism_name == name
        assert (scenario.initial.link_a, scenario.initial.link_b) == (0.0, pi / 3)
        assert scenario.initial.branch == 'open'
        assert (scenario.initial.rate_a, scenario.initial.rate_b) == (0.0, 0.0)
        setpoint, = scenario.setpoints
        assert dict(zip(setpoint.names, setpoint.positions)) == {
            'link_a': pi / 2, 'link_b': pi / 3 + pi / 2}
        assert setpoint.duration == 10.0
        # The run continues for a second after the move.
        assert scenario.duration >= setpoint.at + 10.0 + 1.0


def test_all_values_are_read(written: Write) -> None:
    scenario = load_scenario(written(GOOD))
    assert (scenario.seed, scenario.duration, scenario.arm_at) == (3, 2.0, 0.3)
    assert scenario.plant.rate == 500.0
    assert scenario.plant.period_ns == 2_000_000
    assert scenario.plant.step == 5e-4
    assert scenario.estimator.counts_per_turn == 0
    assert scenario.controller.damping == 1.0
    first, second = scenario.setpoints
    assert (first.at, first.names, first.positions) == (0.5, ('link_a', 'link_c'), (0.5, 0.2))
    assert first.duration is None
    start = assemble(scenario.mechanism, 0.1, 1.2, 'crossed')
    assert (second.at, second.names, second.duration) == (1.0, ('link_d',), 0.5)
    assert second.positions == (start[3] - 1.0,)


def test_events_may_be_missing(written: Write) -> None:
    content = deepcopy(GOOD)
    for name in ('plant', 'estimator', 'controller', 'arm_at', 'setpoints'):
        del content[name]
    scenario = load_scenario(written(content))
    assert scenario.arm_at is None
    assert scenario.setpoints == ()


def test_both_ends_of_the_duration_are_ticks(written: Write) -> None:
    scenario = load_scenario(written(GOOD))
    assert scenario.ticks == 1001
    assert replace(scenario, duration=0.0019).ticks == 1
    assert replace(scenario, duration=0.0021).ticks == 2
    # 0.3 s is a whole number of periods of 2 ms within rounding.
    assert scenario.tick_at(0.3) == 150
    assert scenario.tick_at(0.3001) == 151
    assert scenario.tick_at(0.0) == 0


def test_relative_paths_begin_at_the_file(
    written: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = share_directory() / 'config'
    (tmp_path / 'sub').mkdir()
    (tmp_path / 'sub' / 'm.yaml').write_bytes((source / 'mechanism_prototype.yaml').read_bytes())
    (tmp_path / 't.yaml').write_bytes((source / 'table_ideal.yaml').read_bytes())
    path = written({**GOOD, 'mechanism': 'sub/m.yaml', 'table': './t.yaml'})
    monkeypatch.chdir('/')
    scenario = load_scenario(path)
    assert scenario.mechanism_name == str(tmp_path / 'sub' / 'm.yaml')
    assert scenario.mechanism.link_lengths[0] == 0.3


@pytest.mark.parametrize('name', ['paper', 'prototype'])
def test_model_is_the_mechanism_by_default(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.model_name == scenario.mechanism_name == name
    assert scenario.model is scenario.mechanism


def test_old_key_of_the_model_is_read_and_reported_once(
    written: Write, caplog: pytest.LogCaptureFixture,
) -> None:
    assert load_scenario(written({**GOOD, 'model': 'prototype'})).model_name == 'prototype'
    assert caplog.messages == []
    assert load_scenario(written({**GOOD, 'believed': 'prototype'})).model_name == 'prototype'
    line, = caplog.messages
    assert 'believed' in line
    assert 'model' in line


def test_both_keys_of_the_model_are_refused(written: Write) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(written({**GOOD, 'model': 'paper', 'believed': 'prototype'}))
    assert caught.value.values['name'] == 'believed'


def test_model_may_be_another_preset_or_a_path_from_the_file(
    written: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / 'heavy.yaml').write_text(heavier_wheels())
    monkeypatch.chdir('/')
    scenario = load_scenario(written({**GOOD, 'model': './heavy.yaml'}))
    assert scenario.mechanism_name == 'paper'
    assert scenario.model_name == str(tmp_path / 'heavy.yaml')
    assert scenario.mechanism.flywheel_inertias.tolist() == [3.4e-7] * 4
    assert scenario.model.flywheel_inertias.tolist() == [4e-7] * 4
    assert load_scenario(written({**GOOD, 'model': 'prototype'})).model_name == 'prototype'


def heavier_wheels() -> str:
    """Return the mechanism of the paper with wheels of 4e-7 kg m^2."""
    text = (share_directory() / 'config' / 'mechanism_paper.yaml').read_text()
    return text.replace('3.4e-7', '4.0e-7')


# Parameters of the nodes

def checked(parameters: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Check the values by the tables of the nodes."""
    rows = {node: {row.name: row for row in table} for node, table in TABLES.items()}
    return {node: {name: rows[node][name].check(value) for name, value in values.items()}
            for node, values in parameters.items()}


@pytest.mark.parametrize('name', ['paper', 'prototype'])
def test_parameters_of_the_presets_are_valid_for_the_nodes(name: str) -> None:
    parameters = load_scenario(name).parameters()
    assert set(parameters) == {'plant', 'estimator', 'controller'} <= set(TABLES)
    assert checked(parameters) == parameters


def test_parameters_agree_with_the_file(written: Write) -> None:
    parameters = load_scenario(written(GOOD)).parameters()
    assert parameters['plant']['rate'] == 500.0
    assert parameters['plant']['seed'] == 3
    assert parameters['plant']['initial.branch'] == 'crossed'
    assert parameters['plant']['initial.link_b'] == 1.2
    assert parameters['estimator']['counts_per_turn'] == 0
    assert parameters['controller']['damping'] == 1.0
    assert {values['mechanism'] for values in parameters.values()} == {'paper'}


def test_plant_has_the_mechanism_and_the_others_the_model(
    written: Write, tmp_path: Path,
) -> None:
    (tmp_path / 'heavy.yaml').write_text(heavier_wheels())
    parameters = load_scenario(written({**GOOD, 'model': './heavy.yaml'})).parameters()
    assert {node: values['mechanism'] for node, values in parameters.items()} == {
        'plant': 'paper', 'estimator': str(tmp_path / 'heavy.yaml'),
        'controller': str(tmp_path / 'heavy.yaml')}
    assert checked(parameters) == parameters


def test_defaults_are_those_of_the_nodes(written: Write) -> None:
    content: dict[str, Any] = {**GOOD, 'initial': {}, 'setpoints': []}
    for name in ('plant', 'estimator', 'controller'):
        del content[name]
    parameters = load_scenario(written(content)).parameters()
    rows = {(node, row.name): row for node, table in TABLES.items() for row in table}
    for node, values in parameters.items():
        for name, value in values.items():
            if name == 'seed':
                continue
            if isinstance(value, float):
                # The tables of the nodes round pi / 3 to twelve digits.
                assert value == pytest.approx(rows[node, name].default, abs=1e-12), name
            else:
                assert value == rows[node, name].default, name


# Bad input

def refused(path: str) -> dict[str, Any]:
    """Return the values of the error with which a scenario file is refused."""
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert message.startswith(f'{path}: ')
    assert len(message.splitlines()) == 1
    return caught.value.values


@pytest.mark.parametrize('name', ['mechanism', 'table', 'initial', 'duration', 'seed'])
def test_missing_key(name: str, written: Write) -> None:
    assert refused(written(changed(name, ...)))['missing'] == [name]


@pytest.mark.parametrize('place', [
    'seeed', 'initial.link_c', 'plant.clock', 'estimator.noise', 'controller.gain',
    'setpoints.1.when', 'setpoints.0.links.flywheel_a'])
def test_unknown_key(place: str, written: Write) -> None:
    values = refused(written(changed(place, 1.0)))
    assert values['unknown'] == [place.rpartition('.')[2]]


@pytest.mark.parametrize('value', [nan, inf, -inf, 1e9, -1e9, 10 ** 400, 'x', None, [], True])
@pytest.mark.parametrize('place', [
    'initial.link_a', 'initial.rate_b', 'plant.rate', 'plant.step', 'plant.command_timeout',
    'estimator.angle_noise', 'controller.bandwidth', 'duration', 'setpoints.0.at',
    'setpoints.1.relative.link_d', 'setpoints.0.links.link_a'])
def test_number_of_another_type_or_out_of_range(place: str, value: Any, written: Write) -> None:
    name = refused(written(changed(place, value)))['name']
    if place.startswith('setpoints'):
        _, index, *key = place.split('.')
        assert name == f'setpoints, entry {int(index) + 1}: {".".join(key)}'
    else:
        assert name == place


@pytest.mark.parametrize(('place', 'value', 'name', 'limit'), [
    ('seed', 1.5, 'seed', int),
    ('seed', -1, 'seed', (0, 2 ** 63 - 1)),
    ('seed', 2 ** 63, 'seed', (0, 2 ** 63 - 1)),
    ('arm_at', 2.5, 'arm_at', (0.0, 2.0)),
    ('arm_at', 'soon', 'arm_at', float),
    ('initial.branch', 'third', 'initial.branch', ('open', 'crossed')),
    ('plant.timeout_action', 'explode', 'plant.timeout_action', ('coast', 'hold_speed', 'brake')),
    ('estimator.counts_per_turn', 0.5, 'estimator.counts_per_turn', int),
    ('plant', 3, 'plant', dict),
    ('initial', [], 'initial', dict),
    ('mechanism', 3, 'mechanism', str),
    ('model', 3, 'model', str),
    ('setpoints', 3, 'setpoints', list),
    ('setpoints', {}, 'setpoints', list),
    ('setpoints.1', 3, 'setpoints, entry 2', dict),
    ('setpoints.1.relative', {}, 'relative', dict),
    ('setpoints.1.relative', 0.5, 'relative', dict),
    ('setpoints.1.at', 2.5, 'setpoints, entry 2: at', (0.0, 2.0)),
    ('setpoints.1.duration', 0.0, 'setpoints, entry 2: duration', (0.1, 3600.0)),
    # The time is not after the previous entry, or not after arming.
    ('setpoints.1.at', 0.5, 'at', 0.5),
    ('setpoints.0.at', 0.3, 'at', 0.3)])
def test_wrong_value(place: str, value: Any, name: str, limit: Any, written: Write) -> None:
    values = refused(written(changed(place, value)))
    assert (values['name'], values['value'], values['limit']) == (name, value, limit)


@pytest.mark.parametrize('change', [
    ('setpoints.1.links', {'link_a': 0.0}), ('setpoints.1.relative', ...)])
def test_setpoint_has_either_links_or_relative(change: tuple[str, Any], written: Write) -> None:
    assert refused(written(changed(*change)))['name'] == 'links or relative'


def test_setpoint_without_its_time(written: Write) -> None:
    assert refused(written(changed('setpoints.1.at', ...)))['missing'] == ['at']


def test_setpoint_without_arming(written: Write) -> None:
    assert refused(written(changed('arm_at', ...)))['missing'] == ['arm_at']


@pytest.mark.parametrize('key', ['mechanism', 'model', 'table'])
@pytest.mark.parametrize('name', ['papre', './none.yaml'])
def test_preset_or_file_that_does_not_exist(key: str, name: str, written: Write) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(written(changed(key, name)))
    assert Path(name).name in str(caught.value)
    assert key in str(caught.value)


def test_loop_that_cannot_close_at_the_start(written: Write, tmp_path: Path) -> None:
    (tmp_path / 'm.yaml').write_text(
        (share_directory() / 'config' / 'mechanism_paper.yaml').read_text().replace(
            'link_lengths: [0.1, 0.1, 0.1, 0.1]', 'link_lengths: [0.3, 0.3, 0.1, 0.1]'))
    content = {**GOOD, 'mechanism': './m.yaml', 'initial': {'link_a': 0.0, 'link_b': 3.0}}
    refused(written(content))


@pytest.mark.parametrize(('old', 'new', 'name'), [
    ('4.0e-7', '-4.0e-7', 'flywheel_inertias'), ('link_masses:', 'masses:', 'link_masses'),
    (']', '', 'line 7')])
def test_broken_file_of_the_model(
    old: str, new: str, name: str, written: Write, tmp_path: Path,
) -> None:
    (tmp_path / 'heavy.yaml').write_text(heavier_wheels().replace(old, new))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(written({**GOOD, 'model': './heavy.yaml'}))
    for part in ('model', str(tmp_path / 'heavy.yaml'), name):
        assert part in str(caught.value)


@pytest.mark.parametrize('text', ['', '- 1', 'a: [', 'seed: 1\nseed: 2\n'])
def test_file_that_is_no_mapping(text: str, tmp_path: Path) -> None:
    (tmp_path / 'x.yaml').write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        load_scenario(str(tmp_path / 'x.yaml'))
    assert 'x.yaml' in str(caught.value)


def test_unknown_preset_names_the_presets() -> None:
    with pytest.raises(ConfigurationError) as caught:
        load_scenario('papre')
    for name in presets('scenario'):
        assert name in str(caught.value)


@pytest.mark.parametrize('change', [
    {'seed': -1}, {'duration': 0.0}, {'duration': nan}, {'duration': 1e5}], ids=str)
def test_replaced_values_are_checked_too(change: dict[str, Any], written: Write) -> None:
    scenario: Scenario = load_scenario(written(GOOD))
    with pytest.raises(ScenarioError) as caught:
        replace(scenario, **change)
    assert caught.value.values['name'] == next(iter(change))


def plain(scenario: Scenario) -> dict[str, Any]:
    """Return the contents of a scenario as text, without the names of files."""
    def text(value: Any) -> str:
        return repr({item.name: text(getattr(value, item.name)) for item in fields(value)}
                    if is_dataclass(value) else
                    value.tolist() if isinstance(value, np.ndarray) else value)
    return {item.name: text(getattr(scenario, item.name)) for item in fields(scenario)
            if not item.name.endswith('_name')}


@pytest.mark.parametrize('name', presets('scenario'))
def test_description_makes_the_same_scenario(name: str) -> None:
    """A description that is written to YAML in any folder and read again is the same scenario."""
    description = load_description(name)
    again = scenario_from(yaml.safe_load(yaml.safe_dump(description)), Path('nowhere'))
    assert plain(again) == plain(load_scenario(name))
    assert describe(description, Path('nowhere')) == description


def test_description_keeps_relative_setpoints_and_the_model(written: Write) -> None:
    description = load_description(written({**GOOD, 'model': 'prototype'}))
    assert description['setpoints'][1]['relative'] == {'link_d': -1}
    assert description['model'] != description['mechanism']
    assert load_description(written(GOOD))['model'] == description['mechanism']


def test_nodes_need_files_and_no_descriptions() -> None:
    description = load_description('paper')
    with pytest.raises(ScenarioError) as caught:
        scenario_from(description, Path()).parameters()
    assert caught.value.values['name'] == 'mechanism'


@pytest.mark.parametrize(('place', 'value', 'parts'), [
    ('mechanism.link_masses', [0.02, 0.02, 0.02, -1.0], ['link_masses', 'link_d']),
    ('model.link_masses', [0.02, 0.02, 0.02, -1.0], ['model', 'link_masses', 'link_d']),
    ('mechanism.weight', 1.0, ['mechanism', 'weight']),
    ('table.joints.coulomb', -1.0, ['table', 'joints.coulomb']),
])
def test_error_in_a_described_mechanism_or_table_names_the_key(
        place: str, value: Any, parts: list[str]) -> None:
    description = load_description('paper')
    *sections, name = place.split('.')
    section: Any = description
    for key in sections:
        section = section[key]
    section[name] = value
    with pytest.raises(FourbarError) as caught:
        scenario_from(description, Path())
    for part in parts:
        assert part in str(caught.value)
