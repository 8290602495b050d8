# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar bench`: all quantities are measured, and the exit code is that of the checks."""

from importlib.util import find_spec
import json
from pathlib import Path
import sys
from typing import Any

from fourbar_ros.benchmarks import mechanics as benchmark
from fourbar_ros.cli.main import main
import pytest

needs_mujoco = pytest.mark.skipif(find_spec('mujoco') is None, reason='mujoco is not installed')

OURS = ('rhs_ns', 'rk4_step_ns', 'rk4_step_near_alignment_ns', 'batch_steps_per_s', 'error_rad',
        'import_to_first_step_s', 'plant_step_ns', 'plant_step_near_alignment_ns',
        'closed_loop_times_real_time', 'estimator_step_ns', 'control_step_p50_us',
        'control_step_p99_us', 'control_bounds_active', 'conditioning_grid_s')
BESIDE_MUJOCO = (
    'mujoco_euler_step_ns', 'mujoco_rk4_step_ns', 'mujoco_euler_lean_step_ns',
    'mujoco_rk4_lean_step_ns', 'ratio_vs_mujoco_euler', 'ratio_vs_mujoco_rk4',
    'ratio_vs_mujoco_euler_lean', 'ratio_vs_mujoco_rk4_lean', 'mujoco_error_rad',
    'mujoco_euler_error_rad', 'mujoco_rk4_error_rad')

# Results of a fast and idle machine.
GOOD = {
    'rhs_ns': 100.0, 'rk4_step_ns': 400.0, 'rk4_step_near_alignment_ns': 1000.0,
    'batch_steps_per_s': 5e6, 'error_rad': 1e-13, 'import_to_first_step_s': 0.5,
    'smallest_sine': 0.9, 'near_alignment_largest_sine': 0.05, 'mujoco_euler_step_ns': 5000.0,
    'mujoco_rk4_step_ns': 20000.0, 'ratio_vs_mujoco_euler': 12.5, 'ratio_vs_mujoco_rk4': 50.0,
    'plant_step_ns': 2000.0, 'plant_step_near_alignment_ns': 4000.0,
    'closed_loop_times_real_time': 30.0, 'estimator_step_ns': 2e4,
    'control_step_p50_us': 20.0, 'control_step_p99_us': 50.0, 'control_bounds_active': 0.7,
    'conditioning_grid_s': 0.2,
    'cores': 2, 'cpu': 'a fast one',
    'load_average_1min': 0.0, 'versions': {'python': '3'},
    'linkage': 'asymmetric', 'step_s': 1e-3, 'torque_sampling': 'held', 'statistic': 'least',
    'skipped': []}


def strict(path: Path) -> dict[str, Any]:
    """Read JSON that has neither nan nor infinity."""
    def refuse(constant: str) -> None:
        raise AssertionError(f'{constant} is not JSON')

    document: dict[str, Any] = json.loads(path.read_text(), parse_constant=refuse)
    return document


@pytest.fixture(scope='module')
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, dict[str, Any]]:
    """Return exit code and document of a real, short run."""
    path = tmp_path_factory.mktemp('bench') / 'bench.json'
    return main(['bench', '--repeats', '2', '--json', str(path)]), strict(path)


@pytest.mark.slow
def test_exit_code_is_that_of_the_checks(measured: tuple[int, dict[str, Any]]) -> None:
    code, document = measured
    assert len(document['checks']) >= 6
    assert code == (0 if all(check['passed'] for check in document['checks']) else 1)


@pytest.mark.slow
def test_all_quantities_are_measured(measured: tuple[int, dict[str, Any]]) -> None:
    document = measured[1]
    for name in (*OURS, *(BESIDE_MUJOCO if find_spec('mujoco') else ())):
        assert document[name] > 0.0, name
    for check in document['checks']:
        assert check['value'] == document[check['name']]


@pytest.mark.slow
def test_stretches_agree_with_their_names(measured: tuple[int, dict[str, Any]]) -> None:
    document = measured[1]
    assert document['near_alignment_largest_sine'] < 0.1 < 0.5 < document['smallest_sine']
    # The motors are at their bounds at most ticks, and not at all of them.
    assert 0.5 < document['control_bounds_active'] < 0.95
    assert document['control_step_p50_us'] <= document['control_step_p99_us']


@pytest.mark.slow
def test_error_of_the_motion_is_of_order_four(measured: tuple[int, dict[str, Any]]) -> None:
    """
    The error is of order four in h times the fastest rate.

    Links turn at up to 0.3 rad/s and torques vary with 2 pi 0.23 Hz, so (omega h)^4 = 4e-12.
    """
    assert measured[1]['error_rad'] < 4e-12


@pytest.mark.slow
@needs_mujoco
def test_mujoco_error_is_that_of_rk4(measured: tuple[int, dict[str, Any]]) -> None:
    document = measured[1]
    assert document['mujoco_rk4_error_rad'] < 1e-8 < document['mujoco_euler_error_rad'] < 1e-3
    assert document['mujoco_error_rad'] == document['mujoco_rk4_error_rad']
    for name in ('euler', 'rk4', 'euler_lean', 'rk4_lean'):
        assert document[f'ratio_vs_mujoco_{name}'] == pytest.approx(
            document[f'mujoco_{name}_step_ns'] / document['rk4_step_ns'])


@pytest.mark.slow
def test_without_mujoco_the_rest_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, 'mujoco', None)
    path = tmp_path / 'bench.json'
    code = main(['bench', '--repeats', '1', '--json', str(path)])
    document = strict(path)
    assert {name for name in document if 'mujoco' in name} == set()
    assert {check['name'] for check in document['checks']} <= {
        *OURS, 'smallest_sine', 'near_alignment_largest_sine'}
    assert code == (0 if all(check['passed'] for check in document['checks']) else 1)
    for name in OURS:
        assert document[name] > 0.0
    # The command announces the compilation of its own kernels, so the message is the last line.
    assert capsys.readouterr().err.splitlines()[-1] == f'fourbar bench: {document["skipped"][0]}'
    assert 'mujoco' in document['skipped'][0]


@pytest.mark.parametrize(('change', 'code'), [
    ({}, 0),
    ({'rk4_step_ns': 700.0}, 0),
    ({'rk4_step_ns': 701.0}, 1),
    ({'rk4_step_near_alignment_ns': 4001.0}, 1),
    ({'batch_steps_per_s': 3.9e6}, 1),
    ({'import_to_first_step_s': 1.1}, 1),
    ({'plant_step_ns': 3001.0}, 1),
    ({'plant_step_near_alignment_ns': 6001.0}, 1),
    ({'closed_loop_times_real_time': 14.9}, 1),
    ({'estimator_step_ns': 60001.0}, 1),
    ({'control_step_p50_us': 40.1}, 1),
    ({'control_step_p99_us': 200.1}, 1),
    ({'control_bounds_active': 0.49}, 1),
    ({'conditioning_grid_s': 1.1}, 1),
    ({'ratio_vs_mujoco_euler': 7.9}, 1),
    ({'ratio_vs_mujoco_rk4': 29.9}, 1),
    ({'near_alignment_largest_sine': 0.2}, 1),
    ({'batch_steps_per_s': None}, 1),
], ids=str)
def test_limits(
    change: dict[str, Any], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(benchmark, 'measure', lambda repeats, progress: {**GOOD, **change})
    path = tmp_path / 'bench.json'
    assert main(['bench', '--json', str(path)]) == code
    missed = [check['name'] for check in strict(path)['checks'] if not check['passed']]
    assert missed == [name for name in change if code]
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed if line.endswith('MISSED')] == missed


@pytest.mark.parametrize(('arguments', 'name'), [
    (['--json', 'no_such_folder/bench.json'], 'no_such_folder/bench.json'),
    (['--json', '.'], '.'),
    (['--repeats', '0'], 'repeats'),
])
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(['bench', *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == ''
    assert len(printed.err.splitlines()) == 1
    assert printed.err.startswith('fourbar bench: ')
    assert name in printed.err
    assert list(tmp_path.iterdir()) == []
