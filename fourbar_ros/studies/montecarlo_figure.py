# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figures of a campaign: histograms of the metrics, and the strongest correlations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil
from typing import Any

from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from fourbar_ros.studies.campaigns.campaign import Limit
from fourbar_ros.studies.campaigns.campaign_metrics import METRICS
from fourbar_ros.studies.campaigns.campaign_summary import Correlation, Statistics
from fourbar_ros.studies.campaigns.distributions import Parameter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np

TITLES = {
    'tracking_rms_rad': 'Tracking error, rms', 'tracking_peak_rad': 'Tracking error, largest',
    'final_error_rad': 'Error at the goal', 'estimate_rms_rad': 'Estimation error, rms',
    'estimate_peak_rad': 'Estimation error, largest',
    'nees_per_degree_of_freedom': 'NEES per degree of freedom',
    'nis_per_degree_of_freedom': 'NIS per degree of freedom',
    'peak_wheel_speed_rad_s': 'Largest wheel speed', 'peak_torque_n_m': 'Largest torque',
    'work_j': 'Work of the motors', 'copper_loss_j': 'Copper loss', 'eq9_j_s': 'Paper eq. 9',
    'speed_margin': 'Speed margin',
}
MAIN = ('tracking_rms_rad', 'final_error_rad', 'estimate_rms_rad', 'nees_per_degree_of_freedom',
        'peak_wheel_speed_rad_s', 'work_j')
HOW = {'': '', 'scale': ', times nominal', 'add': ', added'}
COLUMNS, PANELS = 3, 6
BINS = 30
SUPTITLE: Any = {'x': 0.01, 'ha': 'left', 'fontsize': 10.5, 'fontweight': 'bold'}
# Correlations of a smaller size are not drawn.
LEAST_RHO = 0.1


@style.as_png
def distributions_png(metrics: Mapping[str, Array], summary: Mapping[str, Statistics],
                      limits: Sequence[Limit], failed: int) -> Figure:
    """
    Draw a histogram of each main metric, with its quantiles and the limits of the campaign.

    :param metrics: (runs,) by name, NaN where undefined.
    """
    figure, panels = style.panels(6.0, ceil(len(MAIN) / COLUMNS), COLUMNS)
    for panel, name in zip(np.ravel(panels), MAIN):
        _histogram(panel, name, metrics[name], summary[name],
                   [limit for limit in limits if limit.metric == name])
    for row in panels:
        row[0].set_ylabel('runs')
    runs = len(next(iter(metrics.values())))
    figure.suptitle(f'{runs} runs, {failed} failed', **SUPTITLE)
    return figure


@style.as_png
def scatter_png(parameters: Sequence[Parameter], drawn: Mapping[str, Array],
                metrics: Mapping[str, Array], strongest: Sequence[Correlation]) -> Figure:
    """
    Draw the strongest correlations, at most two of each main metric.

    :param parameters: that vary.
    :param drawn, metrics: (runs,) by name, NaN where undefined.
    :param strongest: correlations in this order.
    """
    labels = {name: name + HOW[parameter.distribution.how] for parameter in parameters
              for name in parameter.columns}
    shown = _shown(strongest)
    rows = ceil(len(shown) / COLUMNS)
    figure, panels = style.panels(0.4 + 2.9 * rows, rows, COLUMNS, squeeze=False)
    for panel, each in zip(panels.flat, shown):
        _scatter(panel, each, drawn[each.parameter], metrics[each.metric])
        panel.set_xlabel(labels[each.parameter], fontsize=8.0)
    for panel in panels.flat[len(shown):]:
        panel.set_visible(False)
    figure.suptitle('Strongest dependences of the metrics', **SUPTITLE)
    return figure


def _shown(strongest: Sequence[Correlation]) -> list[Correlation]:
    found: list[Correlation] = []
    for each in strongest:
        of_metric = sum(other.metric == each.metric for other in found)
        if each.metric in MAIN and of_metric < 2 and len(found) < PANELS and (
                abs(each.rho) >= LEAST_RHO):
            found.append(each)
    return found or list(strongest[:1])


def _histogram(axes: Axes, name: str, values: Array, statistics: Statistics,
               limits: Sequence[Limit]) -> None:
    axes.set_title(TITLES[name])
    if not statistics.n:
        axes.annotate('in no run', (0.5, 0.5), xycoords='axes fraction', ha='center',
                      color=COLOURS['muted'])
        axes.set_xticks([])
        axes.set_yticks([])
        return
    factor, unit = _scale(name, values)
    known = factor * values[np.isfinite(values)]
    axes.hist(known, bins=max(5, min(BINS, round(2.0 * statistics.n ** 0.5))),
              color=LINK_COLOURS[0], alpha=0.75, edgecolor=COLOURS['paper'], linewidth=0.5)
    top = axes.get_ylim()[1]
    axes.set_ylim(0.0, 1.22 * top)
    for value, text, dash in zip(
            statistics.quantiles, ('5 %', 'median', '95 %'), ('--', '-', '--')):
        axes.axvline(factor * value, ymax=0.85, color=COLOURS['ink'], linewidth=1.0,
                     linestyle=dash)
        axes.annotate(text, (factor * value, 0.87), xycoords=('data', 'axes fraction'),
                      ha='center', fontsize=7.5, color=COLOURS['ink'])
    low, high = axes.get_xlim()
    for limit in limits:
        bound = limit.at_most if limit.at_most is not None else limit.at_least
        if bound is None:
            continue
        of = 'mean' if limit.quantile is None else f'{100.0 * limit.quantile:g} %'
        text, inside = f'limit of {of}: {factor * bound:.3g}', low < factor * bound < high
        if inside:
            axes.axvline(factor * bound, ymax=0.85, color=COLOURS['limit'], linewidth=1.2)
        # A limit outside the axis would compress the histogram.
        if factor * bound >= high:
            text += ' \N{RIGHTWARDS ARROW}'
        elif not inside:
            text = '\N{LEFTWARDS ARROW} ' + text
        left = factor * bound < 0.5 * (low + high)
        axes.annotate(text, (0.01 if left else 0.99, 0.94), xycoords='axes fraction',
                      ha='left' if left else 'right', fontsize=8.0, color=COLOURS['limit'])
    axes.set_xlabel(unit)
    axes.xaxis.set_major_locator(MaxNLocator(6))


def _scatter(axes: Axes, correlation: Correlation, drawn: Array, values: Array) -> None:
    factor, unit = _scale(correlation.metric, values)
    axes.plot(drawn, factor * values, '.', color=LINK_COLOURS[0], markersize=4.0, alpha=0.6)
    axes.set_title(f'{TITLES[correlation.metric]}   \N{GREEK SMALL LETTER RHO} = '
                   f'{correlation.rho:+.2f}'.replace('-', '\N{MINUS SIGN}'))
    axes.set_ylabel(unit)
    axes.margins(x=0.03)


def _scale(name: str, values: Array) -> tuple[float, str]:
    """Return a factor and a unit that give short numbers."""
    unit = METRICS[name].unit
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if unit == 'rad':
        return float(np.degrees(1.0)), 'deg'
    if not unit or not largest:
        return 1.0, unit
    factor, prefix = style.si_scale(largest)
    return factor, prefix + unit
