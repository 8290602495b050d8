# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Statistics over the runs of a campaign: moments, quantiles, correlations, checks of limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan, sqrt

from fourbar_ros.common.checks import at_least, at_most, Check
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies.campaigns.campaign import FAILURE_RATE, Limit
from fourbar_ros.studies.campaigns.campaign_metrics import METRICS
import numpy as np
from scipy import stats

# Confidence of all intervals.
CONFIDENCE = 0.95
# Quantiles of the metrics that are reported.
QUANTILES = (0.05, 0.5, 0.95)
# Smallest number of runs for a correlation; with fewer it is not significant.
FEWEST_RUNS = 5


@dataclass(frozen=True)
class Statistics:
    """
    Statistics of a metric, over the runs in which it is defined.

    :param n: number of these runs.
    :param mean, std: std with n - 1 degrees of freedom.
    :param mean_low, mean_high: 95 % confidence interval of the mean, by Student's t.
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
    Spearman's rank correlation of a drawn parameter with a metric.

    :param n: number of runs.
    :param p_value: probability of a correlation at least as large without dependence.
    """

    parameter: str
    metric: str
    n: int
    rho: float
    p_value: float


def statistics(values: Array) -> Statistics:
    """
    Return the statistics of a sample.

    :param values: (n,), NaN where undefined.
    """
    known = values[np.isfinite(values)]
    n = len(known)
    if not n:
        return Statistics(0, nan, nan, nan, nan, (nan,) * len(QUANTILES))
    mean = float(known.mean())
    std = float(known.std(ddof=1)) if n > 1 else nan
    half = float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, n - 1)) * std / sqrt(n) if n > 1 else nan
    return Statistics(n, mean, std, mean - half, mean + half,
                      tuple(np.quantile(known, QUANTILES).tolist()))


def correlations(parameters: Mapping[str, Array], metrics: Mapping[str, Array]
                 ) -> list[Correlation]:
    """
    Correlate each parameter with each metric, the strongest first.

    :param parameters, metrics: (runs,) by name, NaN where undefined; constant ones are skipped.
    """
    found = []
    for name, values in parameters.items():
        for metric, results in metrics.items():
            known = np.isfinite(values) & np.isfinite(results)
            n = int(known.sum())
            if n < FEWEST_RUNS or np.ptp(values[known]) == 0.0 or np.ptp(results[known]) == 0.0:
                continue
            spearman = stats.spearmanr(values[known], results[known])
            found.append(Correlation(
                name, metric, n, float(spearman.statistic), float(spearman.pvalue)))
    return sorted(found, key=lambda each: (-abs(each.rho), each.parameter, each.metric))


def checks_of(limits: Sequence[Limit], metrics: Mapping[str, Array], failed: int) -> list[Check]:
    """
    Check the limits of a campaign.

    In a quantile a run without the metric counts as beyond any limit; a mean ignores it.

    :param metrics: (runs,) by name, NaN where undefined.
    :param failed: number of failed runs.
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
