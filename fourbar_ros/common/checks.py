# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Checks: a measured value, its limit, and whether the value keeps the limit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, TextIO


@dataclass(frozen=True)
class Check:
    """
    One measured value and its limit.

    :func:`at_most`, :func:`at_least` and :func:`within` make checks. They raise ValueError for a
    limit that is not finite.

    :param name: what was measured.
    :param value: measured value; a value that is not finite never passes.
    :param unit: of value and limit, '' for none.
    :param limit: a number, or (low, high); the limit itself passes.
    :param passed: whether the value keeps the limit.
    :param relation: '<=', '>=' or 'in', for the printed table.
    """

    name: str
    value: float
    unit: str
    limit: float | tuple[float, float]
    passed: bool
    relation: str = ''


def at_most(name: str, value: float, unit: str, limit: float) -> Check:
    """Check value <= limit."""
    return _check(name, value, unit, limit, value <= limit, '<=')


def at_least(name: str, value: float, unit: str, limit: float) -> Check:
    """Check value >= limit."""
    return _check(name, value, unit, limit, value >= limit, '>=')


def within(name: str, value: float, unit: str, low: float, high: float) -> Check:
    """Check low <= value <= high."""
    return _check(name, value, unit, (low, high), low <= value <= high, 'in')


def print_checks(checks: Sequence[Check], file: TextIO | None = None) -> None:
    """
    Print an aligned table, one check a line, with `ok` or `MISSED` at the end.

    :param file: default standard output.
    """
    rows = [(check.name, f'{check.value:.6g}', check.unit, check.relation, _limit_text(check),
             'ok' if check.passed else 'MISSED') for check in checks]
    widths = [max(map(len, column)) for column in zip(*rows)]
    for row in rows:
        name, value, unit, relation, limit, verdict = map(str.ljust, row, widths)
        print(f'{name}  {value.strip():>{widths[1]}} {unit}  {relation} {limit}  '
              f'{verdict.strip()}', file=file)


def checks_as_json(checks: Iterable[Check]) -> list[dict[str, Any]]:
    """
    Return the list that a JSON file holds under `checks`.

    :returns: per check `name`, `value` (None where it is not finite), `unit`, `limit` (a number
        or [low, high]) and `passed`.
    """
    return [{'name': check.name, 'value': finite_or_none(check.value), 'unit': check.unit,
             'limit': list(check.limit) if isinstance(check.limit, tuple) else check.limit,
             'passed': check.passed} for check in checks]


def finite_or_none(value: float) -> float | None:
    """Return the number, or None in place of NaN and infinity, which JSON lacks."""
    return value if isfinite(value) else None


def _check(name: str, value: float, unit: str, limit: float | tuple[float, float],
           passed: bool, relation: str) -> Check:
    # JSON takes no numpy scalars.
    limit = (float(limit[0]), float(limit[1])) if isinstance(limit, tuple) else float(limit)
    if not all(map(isfinite, limit if isinstance(limit, tuple) else (limit,))):
        raise ValueError(f'limit of {name} must be finite, got {limit}')
    return Check(name, float(value), unit, limit, bool(passed) and isfinite(value), relation)


def _limit_text(check: Check) -> str:
    if isinstance(check.limit, tuple):
        return f'[{check.limit[0]:.6g}, {check.limit[1]:.6g}]'
    return f'{check.limit:.6g}'
