# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of the crossing study: shares of runs that pass, paths of eta, and the map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import cast

from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from fourbar_ros.studies.crossing_runs import (
    CrossingStatistics,
    MANOEUVRES,
    Map,
    METHODS,
    MISMATCHES,
    stiffness_text,
    STIFFNESSES,
    success,
    TIMES,
)
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure, SubFigure
import numpy as np

SHORT = {'motion': 'crossing in motion', 'parking': 'parking and turning there',
         'mismatch': 'slow, mismatch 1e-3, 1e4 N/m'}
METHOD_COLOURS = dict(zip(METHODS, LINK_COLOURS))
# Number of paths drawn of each kind.
PATHS = 12
# Ends of the linear and of the logarithmic range of the axis of eta [deg].
LINEAR, LARGEST = 0.1, 180.0
ETA_TICKS = (-100.0, -10.0, -1.0, -0.1, 0.0, 0.1, 1.0, 10.0, 100.0)


@style.as_png
def png(by_kind: Mapping[tuple[str, str], CrossingStatistics], of_map: Map) -> Figure:
    """Draw shares that pass with their confidence intervals, paths of eta, and the map."""
    figure = Figure(figsize=(style.WIDTH_IN, 11.0), layout='constrained')
    shares, paths, maps = cast(Iterable[SubFigure], figure.subfigures(
        3, 1, height_ratios=(1.0, 1.15, 1.15), hspace=0.04))
    for part, title in ((shares, 'Runs that passed, with their 95 % confidence'),
                        (paths, 'Angle between opposite links during the manoeuvre'),
                        (maps, f'Slow crossing of 40 deg, {METHODS["four_held"]}: passed [%]')):
        part.suptitle(title, x=0.01, ha='left', fontsize=10.5, fontweight='bold')
    row = shares.subplots(1, len(MANOEUVRES), sharey=True)
    for axes, name in zip(row, MANOEUVRES):
        _shares(axes, {method: by_kind[name, method] for method in METHODS})
        axes.set_title(SHORT[name])
    row[0].set_ylabel('passed [%]')
    row = paths.subplots(1, len(MANOEUVRES), sharey=True)
    for axes, name in zip(row, MANOEUVRES):
        _paths(axes, {method: by_kind[name, method] for method in METHODS})
        axes.set_title(SHORT[name])
    row[0].set_ylabel(r'$\eta = \phi_c - \phi_a$ [deg]')
    handles, labels = row[0].get_legend_handles_labels()
    for handle in handles:
        handle.set_linewidth(2.0)
    paths.legend(handles[::-1], labels[::-1], loc='outside lower center', ncols=len(METHODS))
    row = maps.subplots(1, len(TIMES), sharey=True)
    for axes, time in zip(row, TIMES):
        _map(axes, success(of_map, time))
        axes.set_title(f'in {time:g} s')
    row[0].set_yticks(range(len(STIFFNESSES)),
                      [stiffness_text(stiffness) for stiffness in STIFFNESSES])
    row[0].set_ylabel('stiffness of the joints')
    return figure


def _shares(axes: Axes, statistics: dict[str, CrossingStatistics]) -> None:
    for place, (method, each) in enumerate(statistics.items()):
        share = 100.0 * each.passed / each.runs
        low, high = (100.0 * bound for bound in each.interval)
        axes.bar(place, share, color=METHOD_COLOURS[method], width=0.6)
        axes.errorbar(place, share, yerr=[[share - low], [high - share]], color=COLOURS['ink'],
                      capsize=3.0, linewidth=1.0)
        axes.annotate(f'{each.passed} of {each.runs}', (place, high), (0.0, 4.0),
                      textcoords='offset points', ha='center', fontsize=8.0)
    axes.set_xticks(range(len(statistics)), [METHODS[method].replace(', ', ',\n')
                                             for method in statistics])
    axes.set_xlim(-0.6, len(statistics) - 0.4)
    axes.set_ylim(0.0, 115.0)
    axes.set_yticks(range(0, 101, 20))
    axes.grid(axis='x', visible=False)


def _paths(axes: Axes, statistics: dict[str, CrossingStatistics]) -> None:
    # Paths of methods that fail lie beneath the others.
    for method, each in reversed(statistics.items()):
        for number, outcome in enumerate(each.outcomes[:PATHS]):
            axes.plot(*_unbroken(np.degrees(outcome.path)), color=METHOD_COLOURS[method],
                      linewidth=0.8, alpha=0.7, label=None if number else METHODS[method])
    axes.set_xlabel(r'$\theta = \phi_b - \phi_a$ [deg]')
    # Paths that pass are small, paths that fail are large.
    axes.set_yscale('symlog', linthresh=LINEAR, linscale=0.5)
    axes.set_ylim(-LARGEST, LARGEST)
    axes.set_yticks(ETA_TICKS,
                    [f'{tick:g}'.replace('-', '\N{MINUS SIGN}') for tick in ETA_TICKS])
    axes.minorticks_off()


def _unbroken(path: Array) -> Array:
    """Return theta and eta (2, m) with a gap where eta goes round the circle, in degrees."""
    jumps = np.flatnonzero(np.abs(np.diff(path[:, 1])) > LARGEST) + 1
    unbroken: Array = np.insert(path, jumps, np.nan, axis=0).T
    return unbroken


def _map(axes: Axes, shares: Array) -> None:
    colours = LinearSegmentedColormap.from_list('shares', [COLOURS['tile'], LINK_COLOURS[0]])
    rows, columns = shares.shape
    axes.pcolormesh(np.arange(columns + 1) - 0.5, np.arange(rows + 1) - 0.5, shares, cmap=colours,
                    vmin=0.0, vmax=1.0, edgecolors=COLOURS['paper'], linewidth=2.0)
    for row in range(rows):
        for column in range(columns):
            share = shares[row, column]
            axes.annotate(f'{100.0 * share:.0f}', (column, row), ha='center', va='center',
                          color=COLOURS['paper' if share > 0.5 else 'ink'], fontsize=8.5)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.set_xticks(range(columns), [f'{mismatch:.0e}'.replace('e-0', 'e-')
                                     for mismatch in MISMATCHES])
    axes.set_xlabel('mismatch of a length')
    axes.grid(visible=False)
