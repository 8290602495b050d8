# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of a campaign: how the metrics spread, and what they depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import io
from math import ceil

from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from fourbar_ros.studies.campaigns.campaign import Limit
from fourbar_ros.studies.campaigns.campaign_run import METRICS
from fourbar_ros.studies.campaigns.campaign_summary import Correlation, Statistics
from fourbar_ros.studies.campaigns.distributions import Parameter
from matplotlib import rc_context
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
DPI = 110
# Weaker ones are not worth a picture.
LEAST_RHO = 0.1


def distributions_png(metrics: Mapping[str, Array], described: Mapping[str, Statistics],
                      limits: Sequence[Limit], failed: int) -> bytes:
    """
    Draw a histogram of each main metric, with its quantiles and the limits of the campaign.

    :param metrics: (runs,) by name, NaN for none.
    """
    def draw() -> Figure:
        figure = Figure(figsize=(style.WIDTH_IN, 6.0), layout='constrained')
        axes = np.ravel(figure.subplots(ceil(len(MAIN) / COLUMNS), COLUMNS))
        for panel, name in zip(axes, MAIN):
            _histogram(panel, name, metrics[name], described[name],
                       [limit for limit in limits if limit.metric == name])
        for row in range(0, len(MAIN), COLUMNS):
            axes[row].set_ylabel('runs')
        runs = len(next(iter(metrics.values())))
        figure.suptitle(f'{runs} runs, {failed} failed', x=0.01, ha='left', fontsize=10.5,
                        fontweight='bold')
        return figure
    return _png(draw)


def scatter_png(parameters: Sequence[Parameter], drawn: Mapping[str, Array],
                metrics: Mapping[str, Array], strongest: Sequence[Correlation]) -> bytes:
    """
    Draw the strongest correlations, of each main metric at most two.

    :param parameters: that are drawn.
    :param drawn, metrics: (runs,) by name, NaN for none.
    :param strongest: in this order.
    """
    labels = {name: name + HOW[parameter.distribution.how] for parameter in parameters
              for name in parameter.columns}

    def draw() -> Figure:
        shown = _shown(strongest)
        rows = ceil(len(shown) / COLUMNS)
        figure = Figure(figsize=(style.WIDTH_IN, 0.4 + 2.9 * rows), layout='constrained')
        axes = np.ravel(figure.subplots(rows, COLUMNS))
        for panel, each in zip(axes, shown):
            _scatter(panel, each, drawn[each.parameter], metrics[each.metric])
            panel.set_xlabel(labels[each.parameter], fontsize=8.0)
        for panel in axes[len(shown):]:
            panel.set_visible(False)
        figure.suptitle('What the runs depend on most', x=0.01, ha='left', fontsize=10.5,
                        fontweight='bold')
        return figure
    return _png(draw)


def _shown(strongest: Sequence[Correlation]) -> list[Correlation]:
    found: list[Correlation] = []
    for each in strongest:
        of_metric = sum(other.metric == each.metric for other in found)
        if each.metric in MAIN and of_metric < 2 and len(found) < PANELS and (
                abs(each.rho) >= LEAST_RHO):
            found.append(each)
    return found or list(strongest[:1])


def _histogram(axes: Axes, name: str, values: Array, found: Statistics, limits: Sequence[Limit]
               ) -> None:
    axes.set_title(TITLES[name])
    if not found.n:
        axes.annotate('in no run', (0.5, 0.5), xycoords='axes fraction', ha='center',
                      color=COLOURS['muted'])
        axes.set_xticks([])
        axes.set_yticks([])
        return
    factor, unit = _scale(name, values)
    known = factor * values[np.isfinite(values)]
    axes.hist(known, bins=max(5, min(BINS, round(2.0 * found.n ** 0.5))),
              color=LINK_COLOURS[0], alpha=0.75, edgecolor=COLOURS['paper'], linewidth=0.5)
    top = axes.get_ylim()[1]
    axes.set_ylim(0.0, 1.22 * top)
    for value, text, dash in zip(found.quantiles, ('5 %', 'median', '95 %'), ('--', '-', '--')):
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
        # One far off would leave the histogram no room.
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
    """Return a factor and a unit in which the values read well."""
    unit = METRICS[name].unit
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if unit == 'rad':
        return float(np.degrees(1.0)), 'deg'
    if not unit or not largest:
        return 1.0, unit
    factor, prefix = style.si_scale(largest)
    return factor, prefix + unit


def _png(draw: Callable[[], Figure]) -> bytes:
    with rc_context(style.RC):
        buffer = io.BytesIO()
        draw().savefig(buffer, format='png', dpi=DPI, facecolor=COLOURS['paper'])
        return buffer.getvalue()
