# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""An estimate with its interval, and how far noise that is not white widens it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.common.errors import FourbarError
import numpy as np

# Of the normal distribution, for 95 %.
WIDTH_95 = 1.959964


class CalibrationError(FourbarError):
    """A recording from which nothing can be estimated, and why."""


@dataclass(frozen=True)
class Quantity:
    """
    One estimate.

    :param name: what it is, for people.
    :param unit: of all numbers here, '' for none.
    :param value: the estimate.
    :param standard_error: of the estimate.
    :param before: what it was taken for, None where nothing is known.
    """

    name: str
    unit: str
    value: float
    standard_error: float
    before: float | None = None

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval."""
        half = WIDTH_95 * self.standard_error
        return self.value - half, self.value + half


def as_json(quantities: Iterable[Quantity]) -> list[dict[str, Any]]:
    """Return quantities as plain data: name, unit, value, standard_error, interval, before."""
    return [{'name': item.name, 'unit': item.unit, 'value': item.value,
             'standard_error': item.standard_error, 'interval': list(item.interval),
             'before': item.before} for item in quantities]


def as_table(quantities: Iterable[Quantity]) -> str:
    """Write quantities as an aligned table: value, half of the interval, change."""
    rows = [('quantity', 'value', '95 %', 'unit', 'before', 'change')]
    for item in quantities:
        change = ''
        if item.before is not None:
            moved = item.value - item.before
            # In percent of next to nothing a number says nothing.
            change = (f'{100.0 * moved / item.before:+.2f} %' if abs(moved) < abs(item.before)
                      else f'{moved:+.3g}')
        rows.append((
            item.name, f'{item.value:.5g}', f'± {WIDTH_95 * item.standard_error:.2g}', item.unit,
            '' if item.before is None else f'{item.before:.5g}', change))
    widths = [max(map(len, column)) for column in zip(*rows)]
    return '\n'.join('  '.join(map(str.ljust, row, widths)).rstrip() for row in rows)


def correlation_factor(pieces: Iterable[Floats]) -> float:
    """
    Estimate by how much the variance of a mean exceeds that of independent residuals.

    The integrated autocorrelation of the residuals, summed up to where it can no longer be told
    from zero; what a model misses stays for many samples, and widens the intervals.

    :param pieces: residuals in order of time, each piece by itself.
    :returns: at least 1.
    """
    kept = [piece - piece.mean() for piece in pieces if len(piece) > 1]
    count = sum(map(len, kept))
    power = sum(float(piece @ piece) for piece in kept)
    if power == 0.0:
        return 1.0
    factor = 1.0
    for lag in range(1, max(map(len, kept)) // 4):
        rho = sum(float(piece[lag:] @ piece[:-lag]) for piece in kept if len(piece) > lag) / power
        if rho < 2.0 / np.sqrt(count):
            break
        factor += 2.0 * rho
    return factor
