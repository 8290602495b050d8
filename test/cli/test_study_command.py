# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The command `fourbar study`."""

from collections.abc import Callable, Iterable
import csv
from dataclasses import replace
import errno
import json
import math
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

from fourbar_ros import studies
from fourbar_ros.cli.main import main
from fourbar_ros.common.checks import at_most
from fourbar_ros.studies import consistency, consistency_results, Progress, Result, validation
import pytest

Stub = Callable[[Callable[[Progress], Result]], None]


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    """Return a function that replaces the study `validation` by a function."""
    def replace(run: Callable[[Progress], Result]) -> None:
        module = type(sys)('stub')
        module.run = run  # type: ignore[attr-defined]
        monkeypatch.setattr(studies, 'import_module', lambda name: module)
    return replace


def result(value: float) -> Result:
    """Make a result with one check, which passes for values up to 1."""
    return Result([at_most('sum', value, 'rad', 1.0)], {'sum_rad': value}, 'One line.',
                  {'sum.csv': 'sum\n', 'sum.png': b'\x89PNG'}, ['no second line: no ink'])


@pytest.mark.slow
def test_validation_passes_its_checks_and_writes_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    """Run the study with one reference motion."""
    for library in ('sympy', 'mujoco', 'matplotlib'):
        pytest.importorskip(library)
    monkeypatch.setattr(validation, 'REFERENCES', ('asymmetric',))
    monkeypatch.chdir(tmp_path)
    assert main(['study', 'validation', '--json', 'here.json']) == 0
    out, err = capsys.readouterr()
    folder = tmp_path / 'study_validation'
    assert sorted(path.name for path in folder.iterdir()) == [
        'validation.csv', 'validation.json', 'validation.png']
    # The first command announces that it compiles.
    assert [line for line in err.splitlines() if not line.startswith('Compiling')] == []
    assert 'MISSED' not in out

    document = json.loads((tmp_path / 'here.json').read_text())
    assert document == json.loads((folder / 'validation.json').read_text())
    assert [check['name'] for check in document['checks'] if not check['passed']] == []
    assert document['skipped'] == []
    png = (folder / 'validation.png').read_bytes()
    assert png.startswith(b'\x89PNG')
    assert len(png) < 200_000

    with (folder / 'validation.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert {'kane', 'mujoco_1ms', 'mujoco_extrapolated', 'reference'} <= {
        row['engine'] for row in rows}
    for row in rows:
        numbers = document['differences'][row['motion']][row['engine']]
        assert float(row['max_rad']) == pytest.approx(numbers['max_rad'], rel=1e-3)
        assert 0.0 <= float(row['rms_rad']) <= float(row['max_rad'])
        assert row['torque'] == document['torque_sampling'][row['engine']]
        assert row['motion'] in out


@pytest.mark.slow
def test_consistency_does_not_depend_on_the_number_of_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    """Two kinds with three runs of 0.6 s are too few for the limits, so checks fail."""
    pytest.importorskip('matplotlib')
    kinds = [replace(case, scenario=replace(case.scenario, duration=0.6))
             for case in consistency.cases() if case.name in ('matched', 'prototype')]
    monkeypatch.setattr(consistency, 'cases', lambda: kinds)
    monkeypatch.setattr(consistency_results, 'SETTLED_AT', 0.3)
    outputs = []
    for jobs in ('1', '2'):
        folder = tmp_path / jobs
        code = main(['study', 'consistency', '--runs', '3', '--seed', '5', '--jobs', jobs,
                     '-o', str(folder)])
        outputs.append(capsys.readouterr().out.replace(str(folder), ''))
        document = json.loads((folder / 'consistency.json').read_text())
        assert code == (0 if all(check['passed'] for check in document['checks']) else 1)
    assert outputs[0] == outputs[1]
    for name in ('consistency.json', 'consistency.csv'):
        assert (tmp_path / '1' / name).read_bytes() == (tmp_path / '2' / name).read_bytes()
    assert (document['runs'], document['seed'], document['skipped']) == (3, 5, [])
    assert set(document['cases']) == {'matched', 'prototype'}
    assert all(math.isfinite(check['value']) for check in document['checks'])
    assert len({check['name'] for check in document['checks']}) == len(document['checks'])
    png = (folder / 'consistency.png').read_bytes()
    assert png.startswith(b'\x89PNG')
    with (folder / 'consistency.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * kinds[0].scenario.ticks
    assert float(rows[100]['nees_low']) < 4.0 < float(rows[100]['nees_high'])


@pytest.mark.parametrize(('value', 'code', 'word'), [
    (1.0, 0, 'ok'), (2.0, 1, 'MISSED'), (math.nan, 1, 'MISSED')])
def test_failed_check_is_exit_code_1(
    value: float, code: int, word: str, stub: Stub, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stub(lambda progress: Result(result(value).checks, {}, 'One line.'))
    assert main(['study', 'validation', '-o', str(tmp_path)]) == code
    assert word in capsys.readouterr().out
    document = json.loads((tmp_path / 'validation.json').read_text())
    assert [check['passed'] for check in document['checks']] == [code == 0]


def test_files_are_written_to_the_given_paths(
    stub: Stub, tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    stub(lambda progress: result(0.5))
    folder, document = tmp_path / 'new' / 'folder', tmp_path / 'sum.json'
    assert main(['study', 'validation', '-o', str(folder), '--json', str(document)]) == 0
    assert (folder / 'sum.csv').read_text() == 'sum\n'
    assert (folder / 'sum.png').read_bytes() == b'\x89PNG'
    assert json.loads(document.read_text()) == {
        'study': 'validation', 'sum_rad': 0.5, 'skipped': ['no second line: no ink'],
        'checks': [{'name': 'sum', 'value': 0.5, 'unit': 'rad', 'limit': 1.0, 'passed': True}]}
    out, err = capsys.readouterr()
    assert out.startswith('One line.\n')
    assert err == 'fourbar study: no second line: no ink\n'


def test_json_may_go_into_the_new_folder(stub: Stub, tmp_path: Path) -> None:
    stub(lambda progress: result(0.5))
    folder = tmp_path / 'new'
    assert main(['study', 'validation', '-o', str(folder), '--json', str(folder / 'a.json')]) == 0
    assert (folder / 'a.json').read_bytes() == (folder / 'validation.json').read_bytes()


def test_paths_that_are_not_writable_are_refused_before_the_study(
    stub: Stub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The test replaces `os.access`, because root may write everywhere."""
    def fail(progress: Progress) -> Result:
        raise AssertionError('it began to work')

    stub(fail)
    locked = tmp_path / 'locked'
    locked.mkdir()
    monkeypatch.setattr(os, 'access', lambda path, mode: Path(path) != locked)
    assert main(['study', 'validation', '-o', str(locked)]) == 2
    assert main(['study', 'validation', '-o', str(tmp_path / 'out'), '--json',
                 str(locked / 'v.json')]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert str(locked) in lines[0]
    assert str(locked / 'v.json') in lines[1]
    assert list(tmp_path.iterdir()) == [locked]


def test_study_that_cannot_be_written_leaves_no_folder(
    stub: Stub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The replaced function fails as on a full disk."""
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    stub(lambda progress: result(0.5))
    monkeypatch.setattr(os, 'replace', full)
    assert main(['study', 'validation', '-o', str(tmp_path / 'out')]) == 2
    assert 'No space left on device' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_progress_does_not_change_the_items(stub: Stub, tmp_path: Path) -> None:
    seen: list[Any] = []

    def run(progress: Progress) -> Result:
        items: Iterable[Any] = ['a', 'b']
        seen.extend(progress(items, 2))
        return result(0.5)

    stub(run)
    main(['study', 'validation', '-o', str(tmp_path)])
    assert seen == ['a', 'b']


@pytest.mark.parametrize(('arguments', 'words'), [
    (['atlantis'], ["'atlantis'", *studies.STUDIES]),
    (['consistency', '--runs', '0'], ['runs', '1', '0']),
    (['consistency', '--jobs', '0'], ['jobs', '1', '1024', '0']),
    (['consistency', '--seed', '-1'], ['seed', '0', '-1']),
    (['validation', '--runs', '5', '--seed', '1'], ['validation', '--runs', '--seed']),
    (['validation', '-o', 'file/folder'], ['file/folder']),
    (['validation', '--json', 'nowhere/v.json'], ['nowhere/v.json']),
    (['validation', '--json', '.'], ['.']),
    (['validation', '--json', '/dev/null'], ['/dev/null']),
])
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str], stub: Stub,
) -> None:
    """The command finds the error before it runs the study."""
    def fail(progress: Progress) -> Result:
        raise AssertionError('it began to work')

    stub(fail)
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'file').write_text('')
    assert main(['study', *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.startswith('fourbar study: ')
    assert len(err.splitlines()) == 1
    assert all(word in err for word in words)
    assert [path.name for path in tmp_path.iterdir()] == ['file']


def test_study_that_refuses_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(['study', 'montecarlo', 'atlantis', '-o', str(tmp_path / 'deep' / 'folder')]) == 2
    assert "'atlantis'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_help_lists_the_studies_and_needs_no_heavy_library() -> None:
    code = ('import sys; from fourbar_ros.cli.main import main\n'
            'try: main(["study", "--help"])\n'
            'finally: sys.stderr.write(str(sorted('
            '{"numpy", "numba", "sympy", "mujoco", "matplotlib"} & set(sys.modules))))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.stderr == '[]'
    assert all(name in done.stdout for name in studies.STUDIES)
