# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What the runs of a campaign have in common: statistics, correlations, limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan, sqrt

from fourbar_ros.common.checks import at_least, at_most, Check
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies.campaigns.file import Campaign, FAILURE_RATE, Limit
from fourbar_ros.studies.campaigns.run import METRICS
import numpy as np
from scipy.stats import rankdata
from scipy.stats import t as student

CONFIDENCE = 0.95
QUANTILES = (0.05, 0.5, 0.95)
# With fewer runs a correlation says nothing.
FEWEST = 5


@dataclass(frozen=True)
class Statistics:
    """
    Of a metric, over the runs that have it.

    :param n: how many have it.
    :param mean, std: std with n - 1.
    :param mean_low, mean_high: 95 % confidence interval of the mean, after Student.
    :param quantiles: at `QUANTILES`.
    """

    n: int
    mean: float
    std: float
    mean_low: float
    mean_high: float
    quantiles: tuple[float, ...]


@dataclass(frozen=True)
class Correlation:
    """
    Rank correlation of a drawn parameter with a metric, after Spearman.

    :param n: runs.
    :param p_value: of as large a one by chance.
    """

    parameter: str
    metric: str
    n: int
    rho: float
    p_value: float


def statistics(values: Array) -> Statistics:
    """
    Describe a sample.

    :param values: (n,), NaN for none.
    """
    known = values[np.isfinite(values)]
    n = len(known)
    if not n:
        return Statistics(0, nan, nan, nan, nan, (nan,) * len(QUANTILES))
    mean = float(known.mean())
    std = float(known.std(ddof=1)) if n > 1 else nan
    half = float(student.ppf(0.5 + 0.5 * CONFIDENCE, n - 1)) * std / sqrt(n) if n > 1 else nan
    return Statistics(n, mean, std, mean - half, mean + half,
                      tuple(float(each) for each in np.quantile(known, QUANTILES)))


def correlations(parameters: Mapping[str, Array], metrics: Mapping[str, Array]
                 ) -> list[Correlation]:
    """
    Correlate each parameter with each metric, the strongest first.

    :param parameters, metrics: (runs,) by name, NaN for none; what is the same in all runs, and
        so correlates with nothing, is left out.
    """
    found = []
    for name, values in parameters.items():
        for metric, results in metrics.items():
            known = np.isfinite(values) & np.isfinite(results)
            n = int(known.sum())
            if n < FEWEST or np.ptp(values[known]) == 0.0 or np.ptp(results[known]) == 0.0:
                continue
            rho = float(np.corrcoef(rankdata(values[known]), rankdata(results[known]))[0, 1])
            scaled = rho * sqrt((n - 2) / max(1.0 - rho * rho, 1e-300))
            found.append(Correlation(
                name, metric, n, rho, float(2.0 * student.sf(abs(scaled), n - 2))))
    return sorted(found, key=lambda each: (-abs(each.rho), each.parameter, each.metric))


def checks_of(limits: Sequence[Limit], metrics: Mapping[str, Array], failed: int) -> list[Check]:
    """
    Compare with the limits of a campaign.

    A run without the metric counts as one beyond any limit of a quantile; the mean is of those
    that have it.

    :param metrics: (runs,) by name, NaN for none.
    :param failed: number of runs that failed.
    """
    checks = []
    for limit in limits:
        if limit.metric == FAILURE_RATE:
            runs = len(next(iter(metrics.values())))
            name, unit, value = 'failed runs, share', '', failed / runs
        elif limit.quantile is None:
            name, unit = f'{limit.metric}, mean', METRICS[limit.metric].unit
            value = statistics(metrics[limit.metric]).mean
        else:
            name = f'{limit.metric}, quantile {limit.quantile:g}'
            unit = METRICS[limit.metric].unit
            beyond = np.inf if limit.at_most is not None else -np.inf
            values = np.nan_to_num(metrics[limit.metric], nan=beyond, posinf=np.inf,
                                   neginf=-np.inf)
            value = float(np.quantile(values, limit.quantile, method='inverted_cdf'))
        if limit.at_most is not None:
            checks.append(at_most(name, value, unit, limit.at_most))
        elif limit.at_least is not None:
            checks.append(at_least(name, value, unit, limit.at_least))
    return checks


def numeric_columns(campaign: Campaign) -> list[str]:
    """Return what is drawn and has an order."""
    return [name for name, kind in campaign.columns.items() if kind is not str]
