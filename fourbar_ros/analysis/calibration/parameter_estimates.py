# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Parameter estimates with confidence intervals, also for correlated residuals."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.common.errors import FourbarError
import numpy as np

# Quantile of the standard normal distribution for a two-sided 95 % interval.
QUANTILE_95 = 1.959964


class CalibrationError(FourbarError):
    """
    A calibration that is not possible with this recording, pose or excitation.

    Its `values` hold `reason`, and `name`, `value`, `limit` where these exist.
    """


@dataclass(frozen=True)
class ParameterEstimate:
    """
    Estimate of one parameter.

    :param name: for messages and files.
    :param unit: of all numbers here, '' for none.
    :param value: the estimate.
    :param standard_error: of the estimate.
    :param before: value before the calibration, None if unknown.
    """

    name: str
    unit: str
    value: float
    standard_error: float
    before: float | None = None

    @property
    def half_width(self) -> float:
        """Half of the 95 % confidence interval."""
        return QUANTILE_95 * self.standard_error

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval."""
        return self.value - self.half_width, self.value + self.half_width


def as_json(estimates: Iterable[ParameterEstimate]) -> list[dict[str, Any]]:
    """Return estimates for JSON: name, unit, value, standard_error, interval, before."""
    return [{'name': item.name, 'unit': item.unit, 'value': item.value,
             'standard_error': item.standard_error, 'interval': list(item.interval),
             'before': item.before} for item in estimates]


def as_table(estimates: Iterable[ParameterEstimate]) -> str:
    """Return an aligned table: value, half width of the interval, change."""
    rows = [('quantity', 'value', '95 %', 'unit', 'before', 'change')]
    for item in estimates:
        before, change = '', ''
        if item.before is not None:
            step = item.value - item.before
            # A change larger than the value before it is not given in percent.
            change = (f'{100.0 * step / item.before:+.2f} %' if abs(step) < abs(item.before)
                      else f'{step:+.3g}')
            before = f'{item.before:.5g}'
        rows.append((item.name, f'{item.value:.5g}', f'± {item.half_width:.2g}', item.unit,
                     before, change))
    widths = [max(map(len, column)) for column in zip(*rows)]
    return '\n'.join('  '.join(map(str.ljust, row, widths)).rstrip() for row in rows)


def variance_inflation(sequences: Iterable[Floats]) -> float:
    """
    Return the factor by which correlated residuals increase the variance of a mean.

    The factor is the integrated autocorrelation, summed up to the first lag at which the
    autocorrelation is within two standard errors of zero. Residuals of an incomplete model are
    correlated over many samples and widen the confidence intervals.

    :param sequences: residuals in order of time, one array for each uninterrupted sequence.
    :returns: at least 1.
    """
    centred = [sequence - sequence.mean() for sequence in sequences if len(sequence) > 1]
    count = sum(map(len, centred))
    power = sum(float(sequence @ sequence) for sequence in centred)
    if power == 0.0:
        return 1.0
    factor = 1.0
    for lag in range(1, max(map(len, centred)) // 4):
        rho = sum(float(sequence[lag:] @ sequence[:-lag]) for sequence in centred
                  if len(sequence) > lag) / power
        if rho < 2.0 / np.sqrt(count):
            break
        factor += 2.0 * rho
    return factor
