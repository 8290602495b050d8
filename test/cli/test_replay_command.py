# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The command `fourbar replay`."""

from dataclasses import replace
import json
from pathlib import Path
import shutil

from fourbar_ros.analysis.bags import read_bag
from fourbar_ros.cli.main import main
from fourbar_ros.common.config_files import share_directory
from fourbar_ros.estimation import EstimatorSettings
from fourbar_ros.estimation.estimator_settings import SETTINGS
from fourbar_ros.loop import load_scenario
import pytest


@pytest.fixture(scope='module')
def recorded(synthetic, tmp_path_factory):
    scenario = replace(load_scenario('prototype'), duration=1.2,
                       estimator=EstimatorSettings())
    return synthetic.write_bag(tmp_path_factory.mktemp('bag') / 'run1',
                               synthetic.closed_loop_messages(scenario))


@pytest.fixture
def bag(recorded, tmp_path, monkeypatch):
    """Return the name of a bag in a working directory without other files."""
    shutil.copytree(recorded, tmp_path / 'run1')
    monkeypatch.chdir(tmp_path)
    return 'run1'


@pytest.mark.slow
def test_all_files_are_beside_the_bag(bag, capsys):
    assert main(['replay', bag, '--json', 'numbers.json']) == 0
    output, errors = capsys.readouterr()
    assert errors == ''
    assert sorted(path.name for path in Path().iterdir()) == [
        'numbers.json', 'run1', 'run1_replay']
    new = Path('run1_replay')
    assert sorted(path.name for path in new.iterdir()) == [
        'comparison.json', 'comparison.png', 'metadata.yaml', 'run1_replay.mcap']
    assert output.splitlines()[-4:] == [
        str(Path.cwd() / new), *(str(Path.cwd() / new / name) for name in (
            'comparison.json', 'comparison.png')), 'numbers.json']
    numbers = json.loads((new / 'comparison.json').read_text())
    assert numbers == json.loads(Path('numbers.json').read_text())
    assert numbers['identical'] is True
    assert len(read_bag(new).joint_states('estimate/link_states')) > 250


@pytest.mark.medium
def test_used_settings_are_printed(bag, capsys):
    assert main(['replay', bag, '-o', 'new', '--angle-noise', '0.004',
                 '--counts-per-turn', '4096', '--gate-probability', '1']) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    for wanted in (['mechanism', 'prototype'], ['angle_noise', '0.004', 'rad'],
                   ['counts_per_turn', '4096'], ['gate_probability', '1'],
                   ['disturbance_torque', '1e-07', 'N', 'm/sqrt(Hz)']):
        assert wanted in lines
    settings = json.loads(Path('new/comparison.json').read_text())['settings']
    assert settings == {'angle_noise': 0.004, 'counts_per_turn': 4096, 'gate_probability': 1.0,
                        'gyro_noise': 5e-3, 'gyro_walk': 1e-4,
                        'disturbance_torque': 1e-7, 'disturbance_walk': 1e-7,
                        'closure_tolerance': 0.0}


@pytest.mark.medium
def test_parameters_file_is_read_and_options_override_it(bag):
    text = (share_directory() / 'config' / 'nodes.yaml').read_text()
    Path('nodes.yaml').write_text(
        text.replace('angle_noise: 0.0017453', 'angle_noise: 0.003')
        .replace('counts_per_turn: 16384', 'counts_per_turn: 512'))
    assert main(['replay', bag, '-o', 'new', '--params-file', 'nodes.yaml',
                 '--counts-per-turn', '0', '--mechanism', 'prototype']) == 0
    numbers = json.loads(Path('new/comparison.json').read_text())
    assert (numbers['mechanism'], numbers['settings']['angle_noise'],
            numbers['settings']['counts_per_turn']) == ('prototype', 0.003, 0)


def test_every_setting_has_its_option(capsys):
    with pytest.raises(SystemExit):
        main(['replay', '--help'])
    text = ' '.join(capsys.readouterr().out.split())
    for row in SETTINGS:
        assert f'--{row.name.replace("_", "-")} X' in text
        assert f'(default {row.default:g})' in text


@pytest.mark.medium
@pytest.mark.parametrize(('arguments', 'named'), [
    (['nowhere'], 'nowhere: '),
    (['run1', '-o', 'taken'], 'taken '),
    (['run1', '-o', 'run1/metadata.yaml/new'], 'run1/metadata.yaml/new'),
    (['run1', '--json', 'none/numbers.json'], 'none/numbers.json'),
    (['run1', '--angle-noise', '2'], 'angle_noise'),
    (['run1', '--angle-noise', 'much'], "'much'"),
    (['run1', '--counts-per-turn', '0.5'], 'counts_per_turn'),
    (['run1', '--mechanism', 'papre'], 'papre'),
    (['run1', '--namespace', 'lab'], 'namespace /lab'),
    (['run1', '--skip', '-1'], '--skip'),
    (['run1', '--skip', '9'], '--skip'),
    (['run1', '--params-file', 'none.yaml'], 'none.yaml'),
    (['run1', '--params-file', 'odd.yaml'], 'angle_nose'),
    (['run1', '--params-file', 'flat.yaml'], 'ros__parameters'),
    (['run1', '--params-file', 'others.yaml'], 'others.yaml')])
def test_bad_input_is_one_line_and_leaves_no_file(bag, capsys, arguments, named):
    Path('taken').mkdir()
    for name, text in (('odd', '/**/estimator: {ros__parameters: {angle_nose: 1.0}}'),
                       ('flat', 'estimator: {angle_noise: 1.0}'),
                       ('others', '/**/plant: {ros__parameters: {rate: 100.0}}')):
        Path(f'{name}.yaml').write_text(text)
    before = sorted(Path().iterdir())
    assert main(['replay', *arguments]) == 2
    output, errors = capsys.readouterr()
    line, = errors.splitlines()
    assert line.startswith('fourbar replay: ')
    assert named in line
    assert output == ''
    assert sorted(Path().iterdir()) == before


def test_unknown_option_is_refused(bag):
    with pytest.raises(SystemExit) as caught:
        main(['replay', bag, '--angle-nose', '1'])
    assert caught.value.code == 2
