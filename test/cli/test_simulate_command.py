# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""`fourbar simulate` reproduces the reference motions and reports bad input in one line."""

from collections.abc import Callable
from dataclasses import replace
import json
from pathlib import Path
import re
import subprocess
import sys
from typing import Any

from fourbar_ros.cli.main import main
from fourbar_ros.common.config_files import share_directory
from fourbar_ros.loop import load_scenario, record_run
from fourbar_ros.mechanism.case import load_case, simulate
import numpy as np
import pytest

CASES = sorted((Path(__file__).parents[2] / 'config' / 'reference').glob('*.json'))
HEADER = ('t,link_a,link_b,link_c,link_d,rate_a,rate_b,rate_c,rate_d,'
          'flywheel_a,flywheel_b,flywheel_c,flywheel_d')
# Documented accuracy of the command; the references have an error of 1e-10.
EXACT = 1e-8

each_case = pytest.mark.parametrize('case', CASES, ids=lambda case: case.stem)


def read(path: Path) -> tuple[str, np.ndarray[Any, Any]]:
    header, *lines = path.read_text().splitlines()
    return header, np.array([[float(cell) for cell in line.split(',')] for line in lines])


def test_there_are_cases() -> None:
    assert len(CASES) >= 4


@each_case
def test_reference_motion_is_reproduced(
    case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:
    output = tmp_path / 'out.csv'
    assert main(['simulate', str(case), '-o', str(output)]) == 0
    assert capsys.readouterr().out == 'branch: open from t = 0 s\n'
    reference = json.loads(case.read_text())
    header, table = read(output)
    assert header == HEADER
    assert table[:, 0].tolist() == reference['t']
    np.testing.assert_allclose(table[:, 1:5], reference['link_angles'], rtol=0.0, atol=EXACT)
    # Rates have ten times the tolerance of angles; wheel speeds have a relative tolerance.
    np.testing.assert_allclose(table[:, 5:9], reference['link_rates'], rtol=0.0, atol=10 * EXACT)
    np.testing.assert_allclose(
        table[:, 9:], reference['flywheel_speeds_absolute'], rtol=EXACT, atol=EXACT)


@each_case
def test_numbers_have_twelve_significant_digits(case: Path, tmp_path: Path) -> None:
    output = tmp_path / 'out.csv'
    main(['simulate', str(case), '-o', str(output)])
    motion = simulate(load_case(case))
    exact = np.column_stack([motion.times, motion.link_angles, motion.link_rates,
                             motion.flywheel_speeds_absolute])
    # The rounding error of twelve digits is half of the last digit.
    np.testing.assert_allclose(read(output)[1], exact, rtol=0.5e-11, atol=0.0)


@pytest.mark.medium
def test_command_runs_as_a_process(tmp_path: Path) -> None:
    output = tmp_path / 'out.csv'
    done = subprocess.run(
        [sys.executable, '-m', 'fourbar_ros', 'simulate', str(CASES[0]), '-o', str(output)],
        cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, 'branch: open from t = 0 s\n')
    assert len(read(output)[1]) == len(json.loads(CASES[0].read_text())['t'])


@pytest.mark.medium
def test_bad_input_ends_a_process_with_one_line(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, '-m', 'fourbar_ros', 'simulate', str(tmp_path / 'none.json'), '-o',
         str(tmp_path / 'out.csv')], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (2, '')
    assert len(done.stderr.splitlines()) == 1
    assert 'none.json' in done.stderr
    assert not (tmp_path / 'out.csv').exists()


def test_finer_step_gives_the_same_motion(tmp_path: Path) -> None:
    """At a step of 1 ms the truncation error is far below the documented accuracy."""
    tables = []
    for step in ('0.001', '0.0005'):
        output = tmp_path / f'{step}.csv'
        assert main(['simulate', str(CASES[0]), '-o', str(output), '--step', step]) == 0
        tables.append(read(output)[1])
    np.testing.assert_allclose(tables[0][:, 1:5], tables[1][:, 1:5], rtol=0.0, atol=EXACT / 10)


# Bad input

@pytest.fixture
def good() -> dict[str, Any]:
    """Return a short case that runs."""
    content: dict[str, Any] = json.loads(
        next(case for case in CASES if case.stem == 'paper_all').read_text())
    for name in ('link_angles', 'link_rates', 'flywheel_speeds_absolute', 'note'):
        del content[name]
    content['t'] = [0.0, 0.05, 0.1]
    return content


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return a function that runs a refused case and returns the error message."""
    def run(text: str | bytes | None, output: str = 'out.csv', *arguments: str) -> str:
        case = tmp_path / 'case.json'
        if text is not None:
            case.write_bytes(text.encode() if isinstance(text, str) else text)
        before = sorted(tmp_path.rglob('*'))
        code = main(['simulate', str(case), '-o', str(tmp_path / output), *arguments])
        printed = capsys.readouterr()
        assert code == 2
        assert printed.out == ''
        assert printed.err.endswith('\n')
        assert len(printed.err.splitlines()) == 1
        assert printed.err.startswith('fourbar simulate: ')
        assert 'Traceback' not in printed.err
        assert sorted(tmp_path.rglob('*')) == before
        return printed.err
    return run


def changed(content: dict[str, Any], place: str, value: Any) -> str:
    """Return the case with one changed value; `...` removes it."""
    *sections, name = place.split('.')
    section = content
    for key in sections:
        section = section[key]
    if value is ...:
        del section[name]
    else:
        section[name] = value
    return json.dumps(content)


def test_the_case_itself_runs(good: dict[str, Any], tmp_path: Path) -> None:
    case = tmp_path / 'case.json'
    case.write_text(json.dumps(good))
    assert main(['simulate', str(case), '-o', str(tmp_path / 'out.csv')]) == 0


def test_missing_motion_is_rest(good: dict[str, Any], tmp_path: Path) -> None:
    del good['initial']['link_rates'], good['initial']['flywheel_speeds_absolute']
    case = tmp_path / 'case.json'
    case.write_text(json.dumps(good))
    assert main(['simulate', str(case), '-o', str(tmp_path / 'out.csv')]) == 0
    assert not read(tmp_path / 'out.csv')[1][0, 5:].any()


def test_missing_file(refused: Callable[..., str]) -> None:
    assert 'case.json' in refused(None)


@pytest.mark.parametrize('text', [
    '', '{', 'plain text', b'\xff\xfe\x00', '[1, 2]', '3', 'null', '{"t": [0, 1]}', '\ufeff{}'])
def test_broken_file(text: str | bytes, refused: Callable[..., str]) -> None:
    assert 'case.json' in refused(text)


@pytest.mark.parametrize('share', [0.1, 0.5, 0.9, 0.999])
def test_cut_file(share: float, good: dict[str, Any], refused: Callable[..., str]) -> None:
    text = json.dumps(good)
    assert 'cut' in refused(text[:int(share * len(text))])


LISTS = ['initial.link_angles', 'initial.link_rates', 'initial.flywheel_speeds_absolute',
         'motor_torque.amplitude', 'motor_torque.frequency_hz', 'motor_torque.phase']


@pytest.mark.parametrize('place', LISTS)
@pytest.mark.parametrize('value', [
    [0.0, 0.0, 0.0, float('nan')], [0.0, float('inf'), 0.0, 0.0], [0.0, 0.0, 0.0], [0.0] * 5, [],
    [[0.0] * 4], 0.0, None, 'text', ['a', 'b', 'c', 'd'], [0.0, None, 0.0, 0.0],
    [0.0, [1.0], 0.0, 0.0], {}, [10 ** 400, 0, 0, 0]],
    ids=['nan', 'inf', 'three', 'five', 'none', 'nested', 'scalar', 'null', 'text', 'texts',
         'one null', 'ragged', 'object', 'beyond float'])
def test_wrong_list(
    place: str, value: Any, good: dict[str, Any], refused: Callable[..., str],
) -> None:
    assert place.split('.')[1] in refused(changed(good, place, value))


@pytest.mark.parametrize('value', [
    [], [0.0], [0.0, 0.0], [1.0, 0.5], [0.0, float('nan')], [[0.0, 1.0]], 1.0, None, ...])
def test_wrong_times(value: Any, good: dict[str, Any], refused: Callable[..., str]) -> None:
    assert re.search(r'\bt(\.\d+)? (must|is missing)', refused(changed(good, 't', value)))


@pytest.mark.parametrize('place', ['mechanism', 'initial', 'motor_torque'])
@pytest.mark.parametrize('value', [..., None, [], 'text', 3])
def test_missing_or_wrong_section(
    place: str, value: Any, good: dict[str, Any], refused: Callable[..., str],
) -> None:
    assert f'{place} is missing' in refused(changed(good, place, value))


@pytest.mark.parametrize('place', ['initial.link_angles', *LISTS[3:]])
def test_missing_value(place: str, good: dict[str, Any], refused: Callable[..., str]) -> None:
    assert f'{place.split(".")[1]} is missing' in refused(changed(good, place, ...))


@pytest.mark.parametrize('name', [
    'link_lengths', 'link_masses', 'link_inertias', 'com_positions', 'flywheel_inertias'])
@pytest.mark.parametrize('value', [
    ..., [0.1, 0.1, 0.1], [0.1, 0.1, float('nan'), 0.1], 'text', None, [10 ** 400, 1, 1, 1]])
def test_wrong_mechanism(
    name: str, value: Any, good: dict[str, Any], refused: Callable[..., str],
) -> None:
    assert name in refused(changed(good, f'mechanism.{name}', value))


def test_angles_that_do_not_close(good: dict[str, Any], refused: Callable[..., str]) -> None:
    message = refused(changed(good, 'initial.link_angles', [0.0, 1.0, 0.0, 1.1]))
    assert 'do not close the loop' in message
    # The ends of links b and d, 0.1 m each, are 0.1 rad apart.
    assert 'gap 0.009996 m' in message or 'gap 0.01 m' in message


def test_rates_that_open_the_loop(good: dict[str, Any], refused: Callable[..., str]) -> None:
    message = refused(changed(good, 'initial.link_rates', [0.0, 1.0, 0.0, 0.0]))
    assert 'do not keep the loop closed' in message
    assert '0.1 m/s' in message


@pytest.mark.parametrize('output', ['no_such_folder/out.csv', 'case.json/out.csv'])
def test_unwritable_output(
    output: str, good: dict[str, Any], refused: Callable[..., str],
) -> None:
    assert 'cannot write' in refused(json.dumps(good), output)


@pytest.mark.parametrize('step', ['0', '-0.001', 'nan', 'inf'])
def test_impossible_step(
    step: str, good: dict[str, Any], refused: Callable[..., str],
) -> None:
    assert '--step' in refused(json.dumps(good), 'out.csv', f'--step={step}')


def test_motion_that_leaves_the_finite_numbers(
    good: dict[str, Any], refused: Callable[..., str],
) -> None:
    assert 'no longer finite' in refused(
        changed(good, 'motor_torque.amplitude', [1e300, -1e300, 1e300, 0.0]))


# The closed loop

PAPER_SECOND = ('simulate', '--closed-loop', 'paper', '--duration', '1')


def closed_loop(output: Path, *arguments: str) -> bytes:
    """Run a second of the scenario of the paper, and return the table."""
    assert main([*PAPER_SECOND, '-o', str(output), *arguments]) == 0
    return output.read_bytes()


@pytest.mark.slow
def test_same_seed_gives_the_same_bytes_in_another_process(tmp_path: Path) -> None:
    first, other = closed_loop(tmp_path / '1.csv'), tmp_path / '2.csv'
    done = subprocess.run(
        [sys.executable, '-m', 'fourbar_ros', *PAPER_SECOND, '-o', str(other)],
        cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, '')
    assert first == other.read_bytes()
    assert first == closed_loop(tmp_path / '3.csv', '--seed', '0')
    assert first != closed_loop(tmp_path / '4.csv', '--seed', '1')


@pytest.mark.medium
def test_closed_loop_table_is_the_recorded_run(tmp_path: Path) -> None:
    output = tmp_path / 'out.csv'
    assert main(['simulate', '--closed-loop', 'prototype', '--duration', '0.5', '-o',
                 str(output)]) == 0
    scenario = replace(load_scenario('prototype'), duration=0.5)
    assert output.read_text() == ''.join(record_run(scenario).lines())


@pytest.mark.medium
def test_closed_loop_moves_the_mechanism_by_torques_for_the_model(tmp_path: Path) -> None:
    """The tables agree until the first torque, which follows arm_at."""
    config = share_directory() / 'config'
    text = (config / 'scenario_paper.yaml').read_text()
    (tmp_path / 'heavy.yaml').write_text(
        (config / 'mechanism_paper.yaml').read_text().replace('2.2e-5', '4.4e-5'))
    tables = {}
    for name in ('paper', './heavy.yaml'):
        (tmp_path / 'mine.yaml').write_text(f'{text}\nmodel: {name}\n')
        output = tmp_path / 'out.csv'
        assert main(['simulate', '--closed-loop', str(tmp_path / 'mine.yaml'), '--duration',
                     '0.6', '-o', str(output)]) == 0
        header, *lines = output.read_text().splitlines()
        columns = [place for place, column in enumerate(header.split(','))
                   if column == 't' or column.startswith(('true_', 'measured_'))]
        tables[name] = [[line.split(',')[place] for place in columns] for line in lines]
    same = [one == other for one, other in zip(tables['paper'], tables['./heavy.yaml'])]
    armed = round(0.3 * 250.0)
    assert all(same[:armed + 1])
    assert not any(same[armed + 2:])


@pytest.mark.parametrize(('arguments', 'part'), [
    ([], '--closed-loop'),
    (['case.json', '--closed-loop', 'paper'], '--closed-loop'),
    (['case.json', '--seed', '1'], '--seed'),
    (['case.json', '--duration', '1'], '--duration'),
    (['--closed-loop', 'paper', '--step', '0.001'], 'plant.step'),
    (['--closed-loop', 'papre'], "no scenario 'papre'"),
    (['--closed-loop', './none.yaml'], 'none.yaml'),
    (['--closed-loop', 'paper', '--seed', '-1'], 'seed must be'),
    (['--closed-loop', 'paper', '--duration', '0'], 'duration must be'),
    (['--closed-loop', 'paper', '--duration', 'nan'], 'duration must be'),
    (['--closed-loop', './odd.yaml'], 'whole multiple'),
    (['--closed-loop', './late.yaml'], 'setpoints, entry 1 at 0.5 s, refused'),
])
def test_impossible_closed_loop(
    arguments: list[str], part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The command prints one line and writes no file, also if the run ends early."""
    monkeypatch.chdir(tmp_path)
    text = (share_directory() / 'config' / 'scenario_paper.yaml').read_text()
    Path('odd.yaml').write_text(text.replace('step: 5.0e-4', 'step: 3.0e-4'))
    Path('late.yaml').write_text(re.sub(
        r'at: 0.4 .*\n.*\n', 'at: 0.5\n    links: {link_a: 0.0, link_c: 1.0}\n', text))
    before = sorted(tmp_path.iterdir())
    assert main(['simulate', *arguments, '-o', 'out.csv']) == 2
    printed = capsys.readouterr()
    assert printed.out == ''
    assert len(printed.err.splitlines()) == 1
    assert part in printed.err
    assert sorted(tmp_path.iterdir()) == before
