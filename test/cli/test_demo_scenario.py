# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the demo from a scenario, and refused scenarios; no process is started."""

from pathlib import Path
from typing import Any

from fourbar_ros.cli.demo import load_one_move, write_parameters
from fourbar_ros.common.config_files import share_directory
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.loop import load_scenario
from fourbar_ros.ros.parameters import TABLES
import pytest
import yaml


@pytest.mark.parametrize('name', ['paper', 'prototype'])
def test_nodes_have_the_parameters_of_scenario_and_setpoint(
    name: str, tmp_path: Path,
) -> None:
    scenario = load_scenario(name)
    path = tmp_path / 'parameters.yaml'
    write_parameters(scenario, 'simulated', path)
    written = {key.removeprefix('/**/'): section['ros__parameters']
               for key, section in yaml.safe_load(path.read_text()).items()}
    wanted = scenario.parameters()
    wanted['controller']['setpoint_duration'] = 10.0
    # The command timeout is longer, because a busy machine delays commands.
    assert written['plant'].pop('command_timeout') >= wanted['plant'].pop('command_timeout')
    assert written == wanted


def test_estimator_and_controller_have_the_model(tmp_path: Path) -> None:
    content = yaml.safe_load((share_directory() / 'config' / 'scenario_paper.yaml').read_text())
    heavy = (share_directory() / 'config' / 'mechanism_paper.yaml').read_text().replace(
        '3.4e-7', '4.0e-7')
    (tmp_path / 'heavy.yaml').write_text(heavy)
    (tmp_path / 'mine.yaml').write_text(yaml.safe_dump({**content, 'model': './heavy.yaml'}))
    write_parameters(
        load_one_move(str(tmp_path / 'mine.yaml')), 'simulated', tmp_path / 'parameters.yaml')
    written = yaml.safe_load((tmp_path / 'parameters.yaml').read_text())
    assert {key: section['ros__parameters']['mechanism'] for key, section in written.items()} == {
        '/**/plant': 'paper', '/**/estimator': str(tmp_path / 'heavy.yaml'),
        '/**/controller': str(tmp_path / 'heavy.yaml')}


@pytest.mark.parametrize(('preset', 'expected'), [
    ('papre', {}), ('./none.yaml', {}),
    ('./twice.yaml', {'name': 'setpoints', 'value': 2}),
    ('./still.yaml', {'name': 'setpoints', 'value': 0}),
    ('./wrong.yaml', {})])
def test_scenario_without_exactly_one_setpoint_is_refused(
    preset: str, expected: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    content = yaml.safe_load((share_directory() / 'config' / 'scenario_paper.yaml').read_text())
    later = {'at': 1.0, 'links': {'link_a': 0.0}}
    for name, change in (('twice', {'setpoints': [*content['setpoints'], later]}),
                         ('still', {'setpoints': []}), ('wrong', {'seed': 'x'})):
        Path(f'{name}.yaml').write_text(yaml.safe_dump({**content, **change}))
    with pytest.raises(FourbarError) as caught:
        load_one_move(preset)
    assert {name: caught.value.values.get(name) for name in expected} == expected
    assert '\n' not in str(caught.value)
    assert preset.strip('./') in str(caught.value) or 'seed' in str(caught.value)


def test_parameters_of_the_plant_are_divided_between_the_nodes_on_a_bus(tmp_path: Path) -> None:
    """Each node has the parameters of its table, and the two ends of the bus are peers."""
    path = tmp_path / 'parameters.yaml'
    write_parameters(load_one_move('prototype'), 'prototype', path)
    written = {key.rpartition('/')[2]: values['ros__parameters']
               for key, values in yaml.safe_load(path.read_text()).items()}
    assert set(written) == {'prototype_emulator', 'hardware', 'estimator', 'controller'}
    for node, values in written.items():
        rows = {row.name: row for row in TABLES[node]}
        assert all(rows[name].check(value) == value for name, value in values.items())
    links, host = written['prototype_emulator'], written['hardware']
    assert links['bus.options'] == f'peers={host["bus.channel"]}'
    assert host['bus.options'] == f'peers={links["bus.channel"]}'
