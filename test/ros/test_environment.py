# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Commands report an unusable ROS environment in one line, before they start a process."""

import os
import subprocess
import sys

from fourbar_ros.ros import environment
import pytest

pytestmark = pytest.mark.node

COMMANDS = {
    'plant': [], 'estimator': [], 'controller': [], 'arm': [], 'status': [],
    'setpoint': ['link_a=0'], 'demo': ['--output', 'demo'], 'record': ['-o', 'bag'],
}
FOREIGN = """\
Metadata-Version: 2.1
Name: rclpy
Version: {version}
"""


def run(folder, name, *arguments, code=None, **variables):
    """Run a command to its end, which comes before the start of a process."""
    command = ['-c', code] if code else ['-m', 'fourbar_ros', name, *arguments]
    done = subprocess.run(
        [sys.executable, *command], cwd=folder, env={**os.environ, **variables},
        capture_output=True, text=True, timeout=60)
    return done.returncode, done.stdout, done.stderr


def assert_one_line(result, name, *words):
    code, out, err = result
    assert (code, out) == (2, ''), err
    line, = err.splitlines()
    assert line.startswith(f'fourbar {name}: ')
    for word in words:
        assert word in line


@pytest.fixture
def foreign(tmp_path):
    """Return a function that puts another rclpy first in the search path."""
    def make(version):
        folder = tmp_path / 'other_ros'
        (folder / 'rclpy').mkdir(parents=True)
        (folder / 'rclpy' / '__init__.py').write_text('raise SystemExit("imported")\n')
        if version:
            information = folder / f'rclpy-{version}.dist-info'
            information.mkdir()
            (information / 'METADATA').write_text(FOREIGN.format(version=version))
        return os.pathsep.join([str(folder), os.environ.get('PYTHONPATH', '')])
    return make


@pytest.mark.parametrize('name', list(COMMANDS))
def test_bad_domain_is_refused_by_every_command(tmp_path, name):
    result = run(tmp_path, name, *COMMANDS[name], ROS_DOMAIN_ID='banana')
    assert_one_line(result, name, 'ROS_DOMAIN_ID', '0 to 232', 'banana')
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('domain', ['-1', '233', '999', '1.5', '0x10', '²', ' '])
def test_bad_domain_is_refused(monkeypatch, refuses, domain):
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    with refuses(environment.RosError, name='ROS_DOMAIN_ID', value=domain):
        environment.check_environment()


@pytest.mark.parametrize('domain', ['', '0', '42', '101', '232'])
def test_good_domain_is_accepted(monkeypatch, domain):
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    environment.check_environment()


@pytest.mark.parametrize('name', ['plant', 'arm', 'demo'])
def test_middleware_that_is_not_installed_is_named(tmp_path, name):
    result = run(tmp_path, name, *COMMANDS[name], RMW_IMPLEMENTATION='rmw_nonsense_cpp')
    assert_one_line(result, name, 'RMW_IMPLEMENTATION', 'rmw_nonsense_cpp')


def test_middleware_that_is_installed_is_accepted(monkeypatch):
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp')
    environment.check_environment()


@pytest.mark.parametrize('name', ['plant', 'status', 'demo'])
def test_rclpy_of_another_ros_is_named_and_never_imported(tmp_path, foreign, name):
    result = run(tmp_path, name, *COMMANDS[name], PYTHONPATH=foreign('3.3.1'))
    assert_one_line(result, name, 'rclpy 3.3.1', str(tmp_path / 'other_ros'), 'Jazzy')


@pytest.mark.parametrize('version', ['7.1.3', '8.0.0', '9.1.0', 'nonsense'])
def test_rclpy_of_another_version_is_refused(tmp_path, foreign, version):
    result = run(tmp_path, 'plant', PYTHONPATH=foreign(version))
    assert_one_line(result, 'plant', f'rclpy {version}')


def test_missing_rclpy_is_reported(tmp_path):
    code = ('import sys; sys.modules["rclpy"] = None; '
            'from fourbar_ros.cli.main import main; sys.exit(main(["plant"]))')
    assert_one_line(run(tmp_path, 'plant', code=code), 'plant', 'rclpy is missing')


def test_commands_that_do_not_use_ros_run_without_it(tmp_path, foreign):
    wrong = {'PYTHONPATH': foreign('3.3.1'), 'RMW_IMPLEMENTATION': 'rmw_nonsense_cpp',
             'ROS_DOMAIN_ID': 'banana'}
    for arguments in (['--help'], ['simulate', '--help'], ['report', '--help']):
        code, out, err = run(tmp_path, *arguments, **wrong)
        assert (code, err) == (0, '')
        assert out.startswith('usage: fourbar')
