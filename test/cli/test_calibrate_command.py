# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar calibrate --bag`: output files and refused input."""

import json
from pathlib import Path

from fourbar_ros.analysis.calibration.mechanism_file import calibration_notes, mechanism_text
from fourbar_ros.cli.main import main
from fourbar_ros.common.config_files import load_yaml
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES, load_mechanism, Mechanism
import numpy as np
import pytest

POSE = [0.0, np.pi / 3, 0.0, np.pi / 3]
OFFSETS = np.array([0.01, -0.02, 0.03, 0.0])
AT_POSE = ['encoders', '--bag', 'jig', '--pose', 'link_a=0', 'link_b=60deg']


def calibrate(*arguments):
    """Run the command, and return its exit code."""
    return main(['calibrate', *arguments])


@pytest.fixture
def jig(synthetic, tmp_path, monkeypatch):
    """Record links in a jig with known offsets and noise, seed 0, in the working directory."""
    generator = np.random.default_rng(0)
    stamps = range(1_000_000_000, 2_600_000_000, 4_000_000)
    still = np.zeros(4)
    synthetic.write_bag(tmp_path / 'jig', {
        '/device_status': [(1, synthetic.status(state='disarmed', mechanism='prototype'))],
        '/link_angles': [(stamp, synthetic.joint_state(
            stamp, LINK_NAMES, POSE + OFFSETS + 1e-3 * generator.standard_normal(4)))
            for stamp in stamps],
        '/flywheel_states': [(stamp, synthetic.joint_state(
            stamp, FLYWHEEL_NAMES, still, still, still)) for stamp in stamps]})
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_mechanism_file_has_the_offsets_and_the_other_values(jig, capsys):
    """The tolerance is five standard errors of 400 samples."""
    assert calibrate(*AT_POSE, '-o', 'new.yaml', '--json', 'found.json') == 0
    output, errors = capsys.readouterr()
    assert errors == ''
    assert output.splitlines()[-2:] == ['new.yaml', 'found.json']
    before, after = load_mechanism('prototype'), load_mechanism('new.yaml')
    np.testing.assert_allclose(after.link_angle_offsets, OFFSETS, atol=5.0 * 1e-3 / 20.0)
    for key in load_yaml('new.yaml'):
        if key != 'link_angle_offsets':
            np.testing.assert_array_equal(getattr(after, key), getattr(before, key), err_msg=key)
    note, = calibration_notes(Path('new.yaml'))
    assert note.startswith('link_angle_offsets, ') and note.endswith(', from jig')
    found = json.loads(Path('found.json').read_text())
    assert found['quantities'][0]['value'] == after.link_angle_offsets[0]
    assert [check['passed'] for check in found['checks']] == [True] * 8


def test_offsets_are_added_to_earlier_ones_and_comments_are_kept(jig):
    """The device has subtracted the earlier offsets from the samples."""
    assert calibrate(*AT_POSE, '-o', 'first.yaml') == 0
    assert calibrate(*AT_POSE, '--mechanism', 'first.yaml', '-o', 'second.yaml') == 0
    first, second = (load_mechanism(name).link_angle_offsets
                     for name in ('first.yaml', 'second.yaml'))
    np.testing.assert_allclose(second, 2.0 * first, rtol=1e-12)
    assert len(calibration_notes(Path('second.yaml'))) == 2


def test_existing_file_is_kept_unless_forced(jig, capsys):
    Path('new.yaml').write_text('mine')
    assert calibrate(*AT_POSE, '-o', 'new.yaml') == 2
    line, = capsys.readouterr().err.splitlines()
    assert line.startswith('fourbar calibrate: new.yaml') and '--force' in line
    assert Path('new.yaml').read_text() == 'mine'
    assert calibrate(*AT_POSE, '-o', 'new.yaml', '--force') == 0
    assert load_mechanism('new.yaml').link_angle_offsets.any()


@pytest.mark.parametrize(('arguments', 'named'), [
    (['encoders', '--bag', 'jig', '--pose', 'link_a=0', 'link_x=1'],
     'link_x'),
    (['encoders', '--bag', 'jig', '--pose', 'link_a=0'],
     'pose'),
    (['encoders', '--bag', 'jig', '--pose', 'link_a=0', 'link_a=1'],
     'link_a'),
    (['encoders', '--bag', 'jig', '--pose', 'link_a=here', 'link_b=1'],
     "'link_a=here'"),
    (['encoders', '--bag', 'jig', '--pose', 'link_a=0', 'link_b=60deg', 'link_c=20deg'],
     '0.002 rad'),
    ([*AT_POSE, '--mechanism', 'none'], "'none'"),
    ([*AT_POSE, '-o', 'nowhere/new.yaml'], 'nowhere/new.yaml'),
    (['wheels', '--bag', 'jig'], 'jig: no wheel'),
    (['wheels', '--bag', 'jig', '--speed', '-1'], '--speed'),
    (['wheels', '--bag', 'jig', '--figure', 'fit.pdf'],
     'fit.pdf'),
    (['links', '--bag', 'jig'], '8 s'),
    (['links', '--bag', 'none'], 'none: '),
    (['wheels'], '--yes'),
])
def test_bad_input_is_one_line(jig, capsys, monkeypatch, arguments, named):
    monkeypatch.setattr('sys.stdin', Path('/dev/null').open())
    assert calibrate(*arguments) == 2
    error, = capsys.readouterr().err.splitlines()
    assert error.startswith('fourbar calibrate: ')
    assert named in error
    assert [path.name for path in jig.iterdir()] == ['jig']


@pytest.mark.parametrize('kind', ['wheels', 'links', 'encoders'])
def test_bag_without_the_topics_is_refused(synthetic, tmp_path, capsys, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    synthetic.write_bag(tmp_path / 'other', {
        '/device_status': [(1, synthetic.status(state='disarmed', mechanism='prototype'))]})
    pose = ['--pose', 'link_a=0', 'link_b=1'] if kind == 'encoders' else []
    assert calibrate(kind, '--bag', 'other', *pose) == 2
    line, = capsys.readouterr().err.splitlines()
    assert 'other: ' in line
    assert 'link_angles' in line or 'flywheel_states' in line


def test_joint_encoders_are_refused(synthetic, tmp_path, capsys):
    stamps = range(10)
    names = ['joint_1', 'joint_2', 'joint_3', 'joint_4', 'link_a']
    bag = synthetic.write_bag(tmp_path / 'joints', {
        '/device_status': [(1, synthetic.status(mechanism='prototype'))],
        '/link_angles': [(stamp, synthetic.joint_state(stamp, names, np.zeros(5)))
                         for stamp in stamps]})
    assert calibrate('encoders', '--bag', str(bag), '--pose', 'link_a=0', 'link_b=1') == 2
    line, = capsys.readouterr().err.splitlines()
    assert all(joint in line for joint in names[:4])


@pytest.mark.parametrize('name', ['paper', 'prototype'])
def test_mechanism_file_keeps_every_bit(tmp_path, name):
    mechanism = load_mechanism(name)
    path = tmp_path / 'copy.yaml'
    path.write_text(mechanism_text(mechanism, ['once', 'twice']))
    again = load_mechanism(str(path))
    for key in vars(Mechanism)['__dataclass_fields__']:
        np.testing.assert_array_equal(getattr(again, key), getattr(mechanism, key), err_msg=key)
    assert calibration_notes(path) == ['once', 'twice']
