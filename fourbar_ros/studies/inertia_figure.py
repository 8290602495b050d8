# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of the inertia study: front, inertias of the searches, best motion, total inertia."""

from __future__ import annotations

from collections.abc import Sequence
from math import radians

from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS, LINK_DASHES
from fourbar_ros.studies.inertia_search import (
    bound_at_error,
    DURATION,
    PAPER,
    SearchResult,
    TIMES,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np


@style.as_png
def png(results: Sequence[SearchResult], best: SearchResult) -> Figure:
    """Draw front, inertias, the motions of the best wheels, and total inertia."""
    figure, panels = style.panels(6.4, 2, 2)
    by_kind = {kind: [result for result in results if result.kind == kind]
               for kind in ('front', 'seeds', 'total', 'paper')}
    _front(panels[0, 0], [*by_kind['front'], *by_kind['seeds']], by_kind['paper'])
    _shares(panels[0, 1], by_kind['seeds'])
    _motions(panels[1, 0], best)
    _totals(panels[1, 1], by_kind['total'])
    return figure


def _front(axes: Axes, front: Sequence[SearchResult], paper: Sequence[SearchResult]) -> None:
    errors = np.geomspace(1e-3, 20.0, 80)
    axes.plot(errors, [bound_at_error(radians(error)) for error in errors],
              color=COLOURS['ink'], label='least possible at this error')
    for results, marker, colour, size, label in (
            (front, 'o', 'link_a', 4.5, 'CMA-ES'),
            (paper, 's', 'limit', 5.5, "CMA-ES, the paper's inertias")):
        axes.plot([result.error for result in results], [result.ratio for result in results],
                  marker, color=COLOURS[colour], markersize=size, label=label)
    axes.axhline(1.0, color=COLOURS['muted'], linewidth=0.8, linestyle=(0, (4, 3)))
    axes.set(xscale='log', xlabel='tracking error, rms [deg]',
             ylabel='eq. 9 / closed form at zero error', ylim=(0.4, 1.2))
    axes.set_title('a. Less energy for less accuracy')
    axes.legend(loc='lower left')


def _shares(axes: Axes, seeds: Sequence[SearchResult]) -> None:
    inertias = np.array([*(result.candidate.inertias for result in seeds), PAPER])
    labels = [*(f'seed {result.search.seed}' for result in seeds), 'paper']
    # One bar for each pair: its length matters, its division does not.
    places = np.arange(len(labels))
    for pair, side in (((0, 2), 1.0), ((1, 3), -1.0)):
        left = np.zeros(len(labels))
        for wheel in pair:
            widths = side * inertias[:, wheel]
            axes.barh(places, widths, left=left, color=LINK_COLOURS[wheel], height=0.7,
                      edgecolor=COLOURS['paper'], label=f'wheel {"abcd"[wheel]}')
            left += widths
        axes.axvline(2.0 * side, color=COLOURS['ink'], linewidth=0.8, linestyle=(0, (4, 3)))
    axes.set_yticks(places, labels)
    axes.set_xticks((-2.0, -1.0, 0.0, 1.0, 2.0), ('2', '1', '0', '1', '2'))
    axes.invert_yaxis()
    axes.grid(visible=False)
    axes.set(xlabel='pair b and d      inertia over nominal      pair a and c', xlim=(-3.3, 2.6))
    axes.set_title('b. Ten seeds: any shares, equal pairs')
    axes.legend(loc='center left', fontsize=8.0)


def _motions(axes: Axes, best: SearchResult) -> None:
    for wheel, speeds in enumerate(best.candidate.speeds):
        axes.plot(DURATION * TIMES, speeds, color=LINK_COLOURS[wheel],
                  linestyle=LINK_DASHES[wheel], linewidth=2.4 - 0.4 * wheel,
                  label=f'wheel {"abcd"[wheel]}, {best.candidate.inertias[wheel]:.2f}')
    axes.set(xlabel='time [s]', ylabel='speed / mean speed of nominal wheels')
    axes.set_title('c. The best up to 0.1 deg: unequal wheels, one speed')
    axes.legend(loc='upper right')


def _totals(axes: Axes, results: Sequence[SearchResult]) -> None:
    totals = np.geomspace(0.4, 2.5, 50)
    least = bound_at_error(float(np.median([each.candidate.error_rms for each in results])))
    axes.plot(totals, least / totals, color=COLOURS['ink'], label='least possible')
    axes.plot([each.candidate.total for each in results],
              [each.candidate.eq9 for each in results], 'o', color=COLOURS['link_a'],
              markersize=4.5, label='CMA-ES, total inertia free')
    paper = sum(PAPER) / 4.0
    axes.plot(paper, 1.0 / (PAPER[0] + PAPER[2]) + 1.0 / (PAPER[1] + PAPER[3]), 's',
              color=COLOURS['limit'], markersize=5.5, label="the paper's inertias at their best")
    axes.set(xlabel='total wheel inertia / four nominal wheels',
             ylabel='eq. 9 / four nominal wheels')
    axes.set_title('d. Larger wheels, less energy')
    axes.legend(loc='upper right')
