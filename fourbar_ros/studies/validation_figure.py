# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of the validation study: Fig. 3 of the paper, and the differences of the engines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS, LINK_DASHES
from fourbar_ros.studies.engine_comparison import EngineComparison
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

TITLES = ('a. Test 1: wheels a and c together', 'b. Test 2: all wheels together',
          'c. Wheels a and c opposed')
# Engine: name, marker, marker size, index of the first marked time. The markers of links c and d,
# which coincide with a and b, are in between.
MARKERS = {'kane': ('Kane (SymPy)', 'o', 6.0, 0), 'mujoco_1ms': ('MuJoCo, 1 ms', 'x', 5.5, 6)}
MARKER_EVERY = 24
DIFFERENCES = {
    'kane': ('Kane (SymPy)', COLOURS['ink'], '-'),
    'mujoco_1ms': ('MuJoCo, 1 ms', COLOURS['limit'], '-'),
    'mujoco_extrapolated': ('MuJoCo, extrapolated to a step of zero', COLOURS['limit'],
                            (0, (4, 2))),
}
# Lower limit of the drawn differences [rad], below the rounding of an angle.
LEAST = 1e-17


@style.as_png
def png(comparisons: Sequence[EngineComparison]) -> Figure:
    """
    Draw link orientations and differences over time.

    :param comparisons: one for each of TITLES.
    """
    figure, panels = style.panels(5.2, 2, len(comparisons), sharex=True, sharey='row',
                                  height_ratios=(3, 2))
    for column, (title, comparison) in enumerate(zip(TITLES, comparisons)):
        _orientations(panels[0, column], comparison)
        _differences(panels[1, column], comparison)
        panels[0, column].set_title(title)
        panels[1, column].set_xlabel('time [s]')
    panels[0, 0].set_ylabel('link orientation [deg]')
    panels[1, 0].set_ylabel('ours minus theirs [rad],\nlargest of four links')
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc='outside upper right', ncols=3)
    figure.legend(*panels[1, 0].get_legend_handles_labels(), loc='outside lower right', ncols=3)
    return figure


def _orientations(axes: Axes, comparison: EngineComparison) -> None:
    """Plot our motion as lines and the other engines as markers."""
    times, ours = comparison.ours.times, np.degrees(comparison.ours.link_angles)
    for link in range(4):
        axes.plot(times, ours[:, link], color=LINK_COLOURS[link], linestyle=LINK_DASHES[link])
    axes.plot([], [], color=COLOURS['ink'], label='ours')
    for engine, (name, marker, size, first) in MARKERS.items():
        if engine in comparison.others:
            markers: dict[str, Any] = {
                'marker': marker, 'markersize': size, 'fillstyle': 'none', 'linestyle': ''}
            angles = np.degrees(comparison.others[engine])
            for link in range(4):
                shown = slice(first + MARKER_EVERY // 2 * (link > 1), None, MARKER_EVERY)
                axes.plot(times[shown], angles[shown, link], color=LINK_COLOURS[link], **markers)
            axes.plot([], [], color=COLOURS['ink'], label=name, **markers)
    style.label_ends(axes, [(float(ours[-1, link]), pair, LINK_COLOURS[link])
                            for link, pair in enumerate(('a, c', 'b, d'))])


def _differences(axes: Axes, comparison: EngineComparison) -> None:
    for engine, (name, colour, dashes) in DIFFERENCES.items():
        if engine in comparison.others:
            largest = np.abs(comparison.differences(engine)).max(axis=1)
            axes.plot(comparison.ours.times, np.maximum(largest, LEAST), color=colour,
                      linestyle=dashes, linewidth=1.1, label=name)
    axes.set_yscale('log')
