# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of a replay: errors of both estimates, their difference, and NIS over time."""

from __future__ import annotations

from typing import Any

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.replay_comparison import ReplayComparison, StateDifference
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, decimate, LETTERS, LINK_COLOURS, LINK_DASHES
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

# Limit of an axis over the largest value of the statistics; earlier values may exceed it.
MARGIN = 1.15


def comparison_figure(comparison: ReplayComparison) -> Figure:
    """Draw a comparison, angles in degrees; time counts from the first tick."""
    truth, apart = comparison.replayed_minus_truth, comparison.replayed_minus_recorded
    heights = [1.2] * 4 * (truth is not None) + [1.7] * (apart is not None) + [1.5]
    figure = Figure(figsize=(style.WIDTH_IN, sum(heights) + 0.6), layout='constrained')
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
    above: list[Axes] = []
    for column, (kind, unit) in enumerate((('angle', 'deg'), ('rate', 'deg/s'))):
        if truth is not None:
            for link in range(4):
                above.append(figure.add_subplot(grid[link, column]))
                _plot_error(above[-1], comparison, truth, kind, link)
                above[-1].set_ylabel(f'{kind} error\n[{unit}]')
        if apart is not None:
            above.append(figure.add_subplot(grid[-2, column]))
            _plot_difference(above[-1], comparison, apart, kind)
            above[-1].set_ylabel(f'{kind} [{unit}]')
    below = figure.add_subplot(grid[-1, :])
    _plot_nis(below, comparison)
    for axes in above:
        axes.tick_params(labelbottom=False)
        _mark_skipped(axes, comparison)
    # Only the lowest panel of each column labels the time.
    rows = len(heights) - 1
    for axes in above[rows - 1::rows] if rows else ():
        axes.tick_params(labelbottom=True)
    _mark_skipped(below, comparison)
    below.set_xlabel('time since first tick [s]; statistics begin at the end of the grey area')
    return figure


def _plot_error(axes: Axes, comparison: ReplayComparison, replayed: StateDifference, kind: str,
                link: int) -> None:
    """Plot the errors of both estimates of one link."""
    recorded = comparison.recorded_minus_truth
    shown = [replayed]
    if recorded is not None:
        shown.append(recorded)
        axes.plot(*_curve(comparison, recorded, kind, link), label='recorded \u2212 truth',
                  color=COLOURS['muted'], linewidth=0.9)
    axes.plot(*_curve(comparison, replayed, kind, link), label='replayed \u2212 truth',
              color=LINK_COLOURS[link], linewidth=1.2)
    _set_limits(axes, max(_largest(comparison, each, kind) for each in shown))
    style.link_title(axes, link)
    if link == 0:
        style.legend_above(axes)


def _plot_difference(axes: Axes, comparison: ReplayComparison, difference: StateDifference,
                     kind: str) -> None:
    """Plot the difference of both estimates, all links in one panel."""
    for link in range(4):
        axes.plot(*_curve(comparison, difference, kind, link), color=LINK_COLOURS[link],
                  linestyle=LINK_DASHES[link], linewidth=1.1, label=LETTERS[link])
    _set_limits(axes, _largest(comparison, difference, kind))
    axes.set_title('replayed \u2212 recorded', fontweight='bold')
    if comparison.identical:
        axes.text(0.5, 0.75, 'equal bit for bit', transform=axes.transAxes, ha='center',
                  color=COLOURS['muted'])
    style.legend_above(axes)


def _values(difference: StateDifference, kind: str) -> Floats:
    return np.degrees(difference.angles if kind == 'angle' else difference.rates)


def _curve(comparison: ReplayComparison, difference: StateDifference, kind: str, link: int
           ) -> tuple[Floats, Floats]:
    return decimate(comparison.seconds(difference.stamp_ns), _values(difference, kind)[:, link])


def _largest(comparison: ReplayComparison, difference: StateDifference, kind: str) -> float:
    return float(np.nanmax(
        np.abs(_values(difference.since(comparison.from_ns), kind)), initial=0.0))


def _set_limits(axes: Axes, largest: float) -> None:
    axes.axhline(0.0, color=COLOURS['muted'], linewidth=0.7)
    limit = MARGIN * largest or 1.0
    axes.set_ylim(-limit, limit)


def _mark_skipped(axes: Axes, comparison: ReplayComparison) -> None:
    """Shade the time before the statistics."""
    begin, end = comparison.seconds([comparison.from_ns, comparison.replay.ticks_ns[-1]])
    if begin > 0.0:
        axes.axvspan(0.0, begin, color=COLOURS['grid'], alpha=0.6, linewidth=0, zorder=0)
    axes.set_xlim(0.0, end)


def _plot_nis(axes: Axes, comparison: ReplayComparison) -> None:
    styles: dict[str, dict[str, Any]] = {
        'recorded': {'color': COLOURS['muted'], 'linewidth': 2.4},
        'replayed': {'color': COLOURS['ink'], 'linewidth': 1.3}}
    for source, options in styles.items():
        stamps, nis, degrees = getattr(comparison.replay, source).nis()
        if len(stamps):
            centre, mean, _ = style.windowed_nis(comparison.seconds(stamps), nis, degrees)
            axes.plot(centre, mean, label=source, **options)
    axes.axhline(1.0, color=LINK_COLOURS[2], linewidth=1.0, label='consistent filter')
    style.log_ticks(axes)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.5), max(high, 2.0))
    axes.set_ylabel('NIS / degrees\nof freedom')
    axes.set_title(f'normalized innovation squared, mean over {style.NIS_WINDOW_S:g} s',
                   fontweight='bold')
    style.legend_above(axes)
