# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Scenario files: what they mean, and that whatever is wrong with them is told by its name."""

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
from fourbar_ros.loop.scenario import ALLOWED, scenario_from
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
    """Return the good scenario with one value changed, or dropped if it is `...`."""
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
    """Links a and b from 0 and 60 degrees, by a quarter turn in ten seconds, at rest, open."""
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
        # What comes after the end of the move shows whether it stays.
        assert scenario.duration >= setpoint.at + 10.0 + 1.0


def test_everything_is_taken_over(written: Write) -> None:
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


def test_script_may_be_left_out(written: Write) -> None:
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
    # 0.3 s in floating point is no whole number of periods of 2 ms, but meant as one.
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
def test_believed_is_the_mechanism_unless_told(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.believed_name == scenario.mechanism_name == name
    assert scenario.believed is scenario.mechanism


def test_believed_may_be_another_preset_or_a_path_from_the_file(
    written: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / 'heavy.yaml').write_text(heavier_wheels())
    monkeypatch.chdir('/')
    scenario = load_scenario(written({**GOOD, 'believed': './heavy.yaml'}))
    assert scenario.mechanism_name == 'paper'
    assert scenario.believed_name == str(tmp_path / 'heavy.yaml')
    assert scenario.mechanism.flywheel_inertias.tolist() == [3.4e-7] * 4
    assert scenario.believed.flywheel_inertias.tolist() == [4e-7] * 4
    assert load_scenario(written({**GOOD, 'believed': 'prototype'})).believed_name == 'prototype'


def heavier_wheels() -> str:
    """Return the paper's mechanism with wheels of 4e-7 kg m^2."""
    text = (share_directory() / 'config' / 'mechanism_paper.yaml').read_text()
    return text.replace('3.4e-7', '4.0e-7')


# What the nodes get

def checked(parameters: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Let the nodes' own tables check the values."""
    rows = {node: {row.name: row for row in table} for node, table in TABLES.items()}
    return {node: {name: rows[node][name].checked(value) for name, value in values.items()}
            for node, values in parameters.items()}


@pytest.mark.parametrize('name', ['paper', 'prototype'])
def test_parameters_of_the_presets_are_good_for_the_nodes(name: str) -> None:
    parameters = load_scenario(name).parameters()
    assert set(parameters) == {'plant', 'estimator', 'controller'} <= set(TABLES)
    assert checked(parameters) == parameters


def test_parameters_say_what_the_file_says(written: Write) -> None:
    parameters = load_scenario(written(GOOD)).parameters()
    assert parameters['plant']['rate'] == 500.0
    assert parameters['plant']['seed'] == 3
    assert parameters['plant']['initial.branch'] == 'crossed'
    assert parameters['plant']['initial.link_b'] == 1.2
    assert parameters['estimator']['counts_per_turn'] == 0
    assert parameters['controller']['damping'] == 1.0
    assert {values['mechanism'] for values in parameters.values()} == {'paper'}


def test_plant_has_the_mechanism_and_the_others_the_believed_one(
    written: Write, tmp_path: Path,
) -> None:
    (tmp_path / 'heavy.yaml').write_text(heavier_wheels())
    parameters = load_scenario(written({**GOOD, 'believed': './heavy.yaml'})).parameters()
    assert {node: values['mechanism'] for node, values in parameters.items()} == {
        'plant': 'paper', 'estimator': str(tmp_path / 'heavy.yaml'),
        'controller': str(tmp_path / 'heavy.yaml')}
    assert checked(parameters) == parameters


def test_what_is_left_out_and_what_is_allowed_is_as_in_the_nodes(written: Write) -> None:
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
                # The nodes round pi / 3 to twelve digits.
                assert value == pytest.approx(rows[node, name].default, abs=1e-12), name
            else:
                assert value == rows[node, name].default, name
    for section, names in ALLOWED.items():
        for name, allowed in names.items():
            row = rows['plant', f'initial.{name}'] if section == 'initial' else (
                rows[section, name])
            if row.choices is not None:
                assert allowed == row.choices, name
            else:
                assert allowed == (*row.limits, row.unit), name


# Bad input

def refused(path: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    message = str(caught.value)
    assert message.startswith(f'{path}: ')
    assert len(message.splitlines()) == 1
    return message


@pytest.mark.parametrize('name', ['mechanism', 'table', 'initial', 'duration', 'seed'])
def test_missing_key(name: str, written: Write) -> None:
    assert f'{name} missing' in refused(written(changed(name, ...)))


@pytest.mark.parametrize(('place', 'told'), [
    ('seeed', 'seeed'), ('initial.link_c', 'initial: unknown link_c'),
    ('plant.clock', 'plant: unknown clock'), ('estimator.noise', 'estimator: unknown noise'),
    ('controller.gain', 'controller: unknown gain'),
    ('setpoints.1.when', 'setpoints, entry 2: unknown when'),
    ('setpoints.0.links.flywheel_a', 'setpoints, entry 1: links: unknown flywheel_a')])
def test_unknown_key(place: str, told: str, written: Write) -> None:
    assert told in refused(written(changed(place, 1.0)))


@pytest.mark.parametrize('value', [nan, inf, -inf, 1e9, -1e9, 10 ** 400, 'x', None, [], True])
@pytest.mark.parametrize('place', [
    'initial.link_a', 'initial.rate_b', 'plant.rate', 'plant.step', 'plant.command_timeout',
    'estimator.angle_noise', 'controller.bandwidth', 'duration', 'setpoints.0.at',
    'setpoints.1.relative.link_d', 'setpoints.0.links.link_a'])
def test_number_that_is_none_or_out_of_range(place: str, value: Any, written: Write) -> None:
    message = refused(written(changed(place, value)))
    name = place.rpartition('.')[2]
    assert f'{name} must be' in message
    if place.startswith('setpoints'):
        assert f'entry {int(place.split(".")[1]) + 1}' in message


@pytest.mark.parametrize(('place', 'value', 'told'), [
    ('seed', 1.5, 'seed must be a whole number'),
    ('seed', -1, 'seed must be between 0'),
    ('seed', 2 ** 63, 'seed must be between 0'),
    ('arm_at', 2.5, 'arm_at must be between 0 and 2 s, got 2.5'),
    ('arm_at', 'soon', 'arm_at must be a number'),
    ('initial.branch', 'third', 'initial.branch must be one of open, crossed'),
    ('initial.branch', 3, 'initial.branch must be one of open, crossed'),
    ('plant.timeout_action', 'explode', 'plant.timeout_action must be one of coast'),
    ('estimator.counts_per_turn', 0.5, 'estimator.counts_per_turn must be a whole number'),
    ('plant', 3, 'plant must be a section'),
    ('initial', [], 'initial must be a section'),
    ('mechanism', 'papre', "no mechanism 'papre'"),
    ('mechanism', 3, 'mechanism must be the name'),
    ('believed', 'papre', "believed: no mechanism 'papre'"),
    ('believed', './none.yaml', 'none.yaml: no such file'),
    ('believed', 3, 'believed must be the name'),
    ('table', './none.yaml', 'none.yaml: no such file'),
    ('setpoints', 3, 'setpoints must be a list'),
    ('setpoints', {}, 'setpoints must be a list'),
    ('setpoints.1', 3, 'setpoints, entry 2 must have keys'),
    ('setpoints.1.at', ..., 'setpoints, entry 2: at missing'),
    ('setpoints.1.at', 0.5, 'setpoints, entry 2: at 0.5 s is not after entry 1, 0.5 s'),
    ('setpoints.1.at', 2.5, 'setpoints, entry 2: at must be between 0 and 2 s'),
    ('setpoints.0.at', 0.3, 'setpoints, entry 1: at 0.3 s is not a tick after arm_at 0.3 s'),
    ('setpoints.1.links', {'link_a': 0.0}, 'setpoints, entry 2: give either links or relative'),
    ('setpoints.1.relative', ..., 'setpoints, entry 2: give either links or relative'),
    ('setpoints.1.relative', {}, 'setpoints, entry 2: relative must name links'),
    ('setpoints.1.relative', 0.5, 'setpoints, entry 2: relative must name links'),
    ('setpoints.1.duration', 0.0, 'setpoints, entry 2: duration must be between 0.1 and 3600 s'),
    ('arm_at', ..., 'setpoints, entry 1: refused, the device is never armed')])
def test_wrong_value(place: str, value: Any, told: str, written: Write) -> None:
    assert told in refused(written(changed(place, value)))


def test_loop_that_cannot_close_at_the_start(written: Write, tmp_path: Path) -> None:
    (tmp_path / 'm.yaml').write_text(
        (share_directory() / 'config' / 'mechanism_paper.yaml').read_text().replace(
            'link_lengths: [0.1, 0.1, 0.1, 0.1]', 'link_lengths: [0.3, 0.3, 0.1, 0.1]'))
    content = {**GOOD, 'mechanism': './m.yaml', 'initial': {'link_a': 0.0, 'link_b': 3.0}}
    assert 'cannot close' in refused(written(content))


@pytest.mark.parametrize(('old', 'new', 'told'), [
    ('4.0e-7', '-4.0e-7', 'flywheel_inertias'), ('link_masses:', 'masses:', 'link_masses missing'),
    (']', '', 'line 7')])
def test_believed_mechanism_that_is_broken(
    old: str, new: str, told: str, written: Write, tmp_path: Path,
) -> None:
    (tmp_path / 'heavy.yaml').write_text(heavier_wheels().replace(old, new))
    message = refused(written({**GOOD, 'believed': './heavy.yaml'}))
    assert f'believed: {tmp_path / "heavy.yaml"}' in message
    assert told in message


@pytest.mark.parametrize('text', ['', '- 1', 'a: [', 'seed: 1\nseed: 2\n'])
def test_file_that_is_no_mapping(text: str, tmp_path: Path) -> None:
    (tmp_path / 'x.yaml').write_text(text)
    with pytest.raises(ConfigurationError, match='x.yaml'):
        load_scenario(str(tmp_path / 'x.yaml'))


def test_unknown_preset_names_those_there_are() -> None:
    with pytest.raises(ConfigurationError, match='paper, prototype'):
        load_scenario('papre')


@pytest.mark.parametrize('change', [
    {'seed': -1}, {'duration': 0.0}, {'duration': nan}, {'duration': 1e5}], ids=str)
def test_replaced_values_are_checked_too(change: dict[str, Any], written: Write) -> None:
    scenario: Scenario = load_scenario(written(GOOD))
    with pytest.raises(ScenarioError, match=f'{next(iter(change))} must be'):
        replace(scenario, **change)


def test_table_of_what_is_allowed_is_whole() -> None:
    """Nothing in the table of a section is without an entry in the settings, nor the reverse."""
    scenario = load_scenario('paper')
    for section in ALLOWED:
        settings = getattr(scenario, section)
        assert set(ALLOWED[section]) == set(settings.__dataclass_fields__)
    assert np.isfinite(scenario.mechanism.link_lengths).all()


def plain(scenario: Scenario) -> dict[str, Any]:
    """Return what a scenario holds as text that tells any two apart, names of files left out."""
    def text(value: Any) -> str:
        return repr({item.name: text(getattr(value, item.name)) for item in fields(value)}
                    if is_dataclass(value) else
                    value.tolist() if isinstance(value, np.ndarray) else value)
    return {item.name: text(getattr(scenario, item.name)) for item in fields(scenario)
            if not item.name.endswith('_name')}


@pytest.mark.parametrize('name', presets('scenario'))
def test_description_makes_the_same_scenario(name: str) -> None:
    """Written to YAML and read again it is still the same, whatever the folder."""
    description = load_description(name)
    again = scenario_from(yaml.safe_load(yaml.safe_dump(description)), Path('nowhere'))
    assert plain(again) == plain(load_scenario(name))
    assert describe(description, Path('nowhere')) == description


def test_description_keeps_relative_setpoints_and_what_is_believed(written: Write) -> None:
    description = load_description(written({**GOOD, 'believed': 'prototype'}))
    assert description['setpoints'][1]['relative'] == {'link_d': -1}
    assert description['believed'] != description['mechanism']
    assert load_description(written(GOOD))['believed'] == description['mechanism']


def test_nodes_are_not_given_what_a_scenario_describes_itself() -> None:
    description = load_description('paper')
    with pytest.raises(ScenarioError, match='mechanism is described in the scenario itself'):
        scenario_from(description, Path()).parameters()


@pytest.mark.parametrize(('place', 'value', 'told'), [
    ('mechanism.link_masses', [0.02, 0.02, 0.02, -1.0], 'link_masses of link_d'),
    ('believed.link_masses', [0.02, 0.02, 0.02, -1.0], 'believed: .*link_masses of link_d'),
    ('mechanism.weight', 1.0, 'mechanism: unknown weight'),
    ('table.joints.coulomb', -1.0, 'table: joints.coulomb'),
])
def test_what_is_wrong_in_a_described_mechanism_or_table_is_told(
        place: str, value: Any, told: str) -> None:
    description = load_description('paper')
    *sections, name = place.split('.')
    section: Any = description
    for key in sections:
        section = section[key]
    section[name] = value
    with pytest.raises(FourbarError, match=told):
        scenario_from(description, Path())
