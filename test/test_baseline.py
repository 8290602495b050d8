# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The numbers of the first edition are reproduced (test/data/baseline, made by commit 33b3bad).

Tables are compared byte by byte first. Where the order of arithmetic has changed, values agree
within 1e-9 of the largest value of their column.
"""

import gzip
import json
from math import isclose
from pathlib import Path
from typing import Any

from fourbar_ros.cli.main import main
from fourbar_ros.common.config_files import share_directory
import numpy as np
import pytest

BASELINE = Path(__file__).parent / 'data' / 'baseline'
# Relative tolerance for a changed order of arithmetic.
TOLERANCE = 1e-9
# Absolute tolerance for residuals, which are differences of numbers of order one.
ROUNDING = 1e-12
CASES = ('paper_all', 'paper_pair_ac', 'asymmetric', 'parallelogram_offset_spinning')
STUDIES = ('energy', 'conditioning', 'inertia', 'singularity', 'validation', 'design')


def compare_tables(found: Path, name: str) -> None:
    """Compare a CSV table with that of the baseline."""
    expected = gzip.decompress((BASELINE / f'{name}.csv.gz').read_bytes())
    if found.read_bytes() == expected:
        return
    header, *rows = expected.decode().splitlines()
    found_header, *found_rows = found.read_text().splitlines()
    assert found_header == header
    assert len(found_rows) == len(rows)
    before, after = (np.genfromtxt(lines, delimiter=',') for lines in (rows, found_rows))
    assert np.array_equal(np.isnan(before), np.isnan(after))
    scale = np.nanmax(np.abs(before), axis=0)
    assert np.nanmax(np.abs(after - before) - TOLERANCE * scale) <= 0.0


@pytest.mark.slow
@pytest.mark.parametrize('scenario', ['paper', 'prototype'])
def test_closed_loop(scenario: str, tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    assert main(['simulate', '--closed-loop', scenario, '-o', str(path)]) == 0
    compare_tables(path, f'closed_loop_{scenario}')


@pytest.mark.parametrize('case', CASES)
def test_reference_motion(case: str, tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    file = share_directory() / 'config' / 'reference' / f'{case}.json'
    assert main(['simulate', str(file), '-o', str(path)]) == 0
    compare_tables(path, f'reference_{case}')


def differences(before: Any, after: Any, place: str = '') -> list[str]:
    """List the places where two JSON documents differ by more than the tolerance."""
    if isinstance(before, dict) and isinstance(after, dict):
        places = [f'{place}.{key}: only in one' for key in before.keys() ^ after.keys()]
        return places + [line for key in before.keys() & after.keys()
                         for line in differences(before[key], after[key], f'{place}.{key}')]
    if isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            return [f'{place}: {len(before)} and {len(after)} entries']
        return [line for index, pair in enumerate(zip(before, after))
                for line in differences(*pair, f'{place}[{index}]')]
    if isinstance(before, float) and isinstance(after, int | float):
        equal = isclose(before, after, rel_tol=TOLERANCE, abs_tol=ROUNDING)
    else:
        equal = before == after
    return [] if equal else [f'{place}: {before!r} and {after!r}']


def without_times(document: dict[str, Any]) -> dict[str, Any]:
    """Remove wall times and rounding residuals, which depend on the machine."""
    return {**{key: value for key, value in document.items() if key != 'grid_seconds'},
            'checks': [check for check in document['checks']
                       if check['unit'] != 's' and not is_residual(check)]}


def is_residual(check: dict[str, Any]) -> bool:
    """Return whether a check bounds a rounding error."""
    limit = check['limit']
    return not isinstance(limit, list) and 0.0 < limit <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize('study', STUDIES)
def test_study(study: str, tmp_path: Path) -> None:
    path = tmp_path / 'study.json'
    assert main(['study', study, '-o', str(tmp_path / 'study'), '--json', str(path)]) == 0
    before, after = (without_times(json.loads(file.read_text()))
                     for file in (BASELINE / f'study_{study}.json', path))
    assert differences(before, after) == []
