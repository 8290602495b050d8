# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A check passes at its limit, fails beyond it, and is written as valid JSON."""

import json
from math import inf, nan
from typing import Any

from fourbar_ros.common.checks import (
    at_least,
    at_most,
    Check,
    checks_as_json,
    print_checks,
    within,
)
import numpy as np
import pytest


@pytest.mark.parametrize(('check', 'passed'), [
    (at_most('gap', 1.0, 'm', 1.0), True),
    (at_most('gap', 1.0 + 1e-15, 'm', 1.0), False),
    (at_most('gap', -5.0, 'm', 1.0), True),
    (at_least('ratio', 8.0, '', 8.0), True),
    (at_least('ratio', 7.999, '', 8.0), False),
    (within('cond', 1.0, '', 1.0, 2.0), True),
    (within('cond', 2.0, '', 1.0, 2.0), True),
    (within('cond', 0.999, '', 1.0, 2.0), False),
    (within('cond', 2.001, '', 1.0, 2.0), False),
])
def test_limit_itself_passes(check: Check, passed: bool) -> None:
    assert check.passed is passed


@pytest.mark.parametrize('value', [nan, inf, -inf])
def test_value_that_is_not_finite_fails_and_is_null(value: float) -> None:
    checks = [at_most('x', value, 's', 1.0), at_least('x', value, 's', 1.0),
              within('x', value, 's', -1.0, 1.0)]
    assert not any(check.passed for check in checks)
    assert [entry['value'] for entry in checks_as_json(checks)] == [None] * 3


@pytest.mark.parametrize('limit', [nan, inf])
def test_invalid_limit_is_refused(limit: float) -> None:
    with pytest.raises(ValueError, match='gap'):
        at_most('gap', 1.0, 'm', limit)
    with pytest.raises(ValueError, match='gap'):
        within('gap', 1.0, 'm', 0.0, limit)


def test_json_is_strict_and_complete() -> None:
    checks = [at_most('a', np.float64(0.5), 'rad', np.int64(1)), within('b', 3, 'm', 1, 2),
              at_least('c', nan, '', 0.0)]
    text = json.dumps(checks_as_json(checks), allow_nan=False)
    assert json.loads(text) == [
        {'name': 'a', 'value': 0.5, 'unit': 'rad', 'limit': 1.0, 'passed': True},
        {'name': 'b', 'value': 3.0, 'unit': 'm', 'limit': [1.0, 2.0], 'passed': False},
        {'name': 'c', 'value': None, 'unit': '', 'limit': 0.0, 'passed': False}]


def test_table_is_aligned_and_names_failed_checks(capsys: pytest.CaptureFixture[str]) -> None:
    print_checks([at_most('closure', 3e-12, 'm', 1e-11),
                  at_least('steps_per_s', 3.5e6, '1/s', 4e6),
                  within('ratio', nan, '', 1.0, 2.0)])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines] == ['ok', 'MISSED', 'MISSED']
    ends = [line.rindex(result) for line, result in zip(lines, ('ok', 'MISSED', 'MISSED'))]
    assert len(set(ends)) == 1
    assert '<= 1e-11' in lines[0]
    assert '>= 4e+06' in lines[1]
    assert 'in [1, 2]' in lines[2]


def test_table_without_checks_is_empty(capsys: pytest.CaptureFixture[str]) -> None:
    nothing: list[Any] = []
    print_checks(nothing)
    assert capsys.readouterr().out == ''
    assert checks_as_json(nothing) == []
