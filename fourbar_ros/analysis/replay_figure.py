# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The figure of a replay: both estimates beside the truth, how far they are apart, and NIS."""

from __future__ import annotations

import io
from typing import Any

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.replay import Side
from fourbar_ros.analysis.replay_comparison import Comparison, Difference
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, decimate, LINK_COLOURS, LINK_DASHES
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

LETTERS = 'abcd'
DPI = 120
NIS_WINDOW_S = 1.0
RECORDED: dict[str, Any] = {'color': COLOURS['muted'], 'linewidth': 0.9}
# Room above the largest value that counts; what came before may leave the picture.
MARGIN = 1.15


def png(comparison: Comparison) -> bytes:
    """Draw a comparison, angles in degrees; time is that since the first tick."""
    with rc_context(style.RC):
        buffer = io.BytesIO()
        _draw(comparison).savefig(buffer, format='png', dpi=DPI, facecolor=COLOURS['paper'],
                                  metadata={'Software': None})
        return buffer.getvalue()


def _draw(comparison: Comparison) -> Figure:
    truth = comparison.replayed_minus_truth
    apart = comparison.replayed_minus_recorded
    heights = [1.2] * 4 * (truth is not None) + [1.7] * (apart is not None) + [1.5]
    figure = Figure(figsize=(style.WIDTH_IN, sum(heights) + 0.6), layout='constrained')
    grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
    above: list[Axes] = []
    for column, (kind, unit) in enumerate((('angle', 'deg'), ('rate', 'deg/s'))):
        if truth is not None:
            for link in range(4):
                above.append(figure.add_subplot(grid[link, column]))
                _error(above[-1], comparison, truth, kind, link)
                above[-1].set_ylabel(f'{kind} error\n[{unit}]')
        if apart is not None:
            above.append(figure.add_subplot(grid[-2, column]))
            _apart(above[-1], comparison, apart, kind)
            above[-1].set_ylabel(f'{kind} [{unit}]')
    below = figure.add_subplot(grid[-1, :])
    _nis(below, comparison)
    for axes in above:
        axes.tick_params(labelbottom=False)
        _mark_skipped(axes, comparison)
    # The lowest of each column has the time.
    rows = len(heights) - 1
    for axes in above[rows - 1::rows] if rows else ():
        axes.tick_params(labelbottom=True)
    _mark_skipped(below, comparison)
    below.set_xlabel('time since first tick [s], numbers count from the end of the grey on')
    return figure


def _seconds(comparison: Comparison, stamp_ns: Any) -> Floats:
    seconds: Floats = (stamp_ns - comparison.replay.ticks_ns[0]).astype(np.float64) * 1e-9
    return seconds


def _error(axes: Axes, comparison: Comparison, replayed: Difference, kind: str, link: int
           ) -> None:
    """Plot how wrong both are about one link."""
    recorded = comparison.recorded_minus_truth
    shown = [replayed] if recorded is None else [recorded, replayed]
    if recorded is not None:
        axes.plot(*_curve(comparison, recorded, kind, link), label='recorded \u2212 truth',
                  **RECORDED)
    axes.plot(*_curve(comparison, replayed, kind, link), label='replayed \u2212 truth',
              color=LINK_COLOURS[link], linewidth=1.2)
    _centre(axes, max(_reach(comparison, each, kind) for each in shown))
    axes.set_title(f'link {LETTERS[link]}', color=LINK_COLOURS[link], fontweight='bold')
    if link == 0:
        style.legend_above(axes)


def _apart(axes: Axes, comparison: Comparison, difference: Difference, kind: str) -> None:
    """Plot how far they are apart, all links in one panel."""
    for link in range(4):
        axes.plot(*_curve(comparison, difference, kind, link), color=LINK_COLOURS[link],
                  linestyle=LINK_DASHES[link], linewidth=1.1, label=LETTERS[link])
    _centre(axes, _reach(comparison, difference, kind))
    axes.set_title('replayed \u2212 recorded', fontweight='bold')
    if comparison.identical:
        axes.text(0.5, 0.75, 'equal to the last bit', transform=axes.transAxes, ha='center',
                  color=COLOURS['muted'])
    style.legend_above(axes)


def _values(difference: Difference, kind: str) -> Floats:
    return np.degrees(difference.angles if kind == 'angle' else difference.rates)


def _curve(comparison: Comparison, difference: Difference, kind: str, link: int
           ) -> tuple[Floats, Floats]:
    return decimate(_seconds(comparison, difference.stamp_ns), _values(difference, kind)[:, link])


def _reach(comparison: Comparison, difference: Difference, kind: str) -> float:
    counted = difference.later(comparison.from_ns)
    return MARGIN * float(np.nanmax(np.abs(_values(counted, kind)), initial=0.0))


def _centre(axes: Axes, reach: float) -> None:
    axes.axhline(0.0, color=COLOURS['muted'], linewidth=0.7)
    reach = reach or 1.0
    axes.set_ylim(-reach, reach)


def _mark_skipped(axes: Axes, comparison: Comparison) -> None:
    """Shade the time that the numbers leave out."""
    end = float(_seconds(comparison, np.array([comparison.from_ns]))[0])
    if end > 0.0:
        axes.axvspan(0.0, end, color=COLOURS['grid'], alpha=0.6, linewidth=0, zorder=0)
    axes.set_xlim(0.0, float(_seconds(comparison, np.array(comparison.replay.ticks_ns[-1:]))[0]))


def _nis(axes: Axes, comparison: Comparison) -> None:
    replay = comparison.replay
    looks: tuple[tuple[str, Side, dict[str, Any]], ...] = (
        ('recorded', replay.recorded, {'color': COLOURS['muted'], 'linewidth': 2.4}),
        ('replayed', replay.replayed, {'color': COLOURS['ink'], 'linewidth': 1.3}))
    for label, side, look in looks:
        rows = side.nis.rows()
        if len(rows):
            time = _seconds(comparison, rows[:, 0])
            axes.plot(*_means(time, rows[:, 1], rows[:, 2]), label=label, **look)
    axes.axhline(1.0, color=LINK_COLOURS[2], linewidth=1.0, label='a consistent filter')
    style.log_ticks(axes)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.5), max(high, 2.0))
    axes.set_ylabel('NIS / degrees\nof freedom')
    axes.set_title(f'normalized innovation squared, mean over {NIS_WINDOW_S:g} s',
                   fontweight='bold')
    style.legend_above(axes)


def _means(time: Floats, nis: Floats, degrees: Floats) -> tuple[Floats, Floats]:
    """Return the centre of each window and NIS per degree of freedom in it."""
    window = ((time - time[0]) // NIS_WINDOW_S).astype(int)
    total = np.bincount(window, degrees)
    known = total > 0
    centre = np.bincount(window, time)[known] / np.bincount(window)[known]
    mean: Floats = np.bincount(window, nis)[known] / total[known]
    return centre, mean
