# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The figure of the crossing study: who passes, how, and where nobody does."""

from __future__ import annotations

import io

from fourbar_ros.analysis import style
from fourbar_ros.analysis.studies.crossing import (
    CROSSINGS,
    MISMATCHES,
    stiffness_text,
    STIFFNESSES,
    success,
    Tally,
    TIMES,
    TITLES,
)
from fourbar_ros.analysis.studies.crossing_runs import METHODS
from fourbar_ros.analysis.style import COLOURS, LINK_COLOURS
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
import numpy as np

SHORT = {'motion': 'crossing in motion', 'parking': 'parking and turning', 'mismatch':
         'slow crossing, mismatch 1e-3, 1e4 N/m'}
METHOD_COLOURS = dict(zip(METHODS, LINK_COLOURS))
# Paths of so many runs of each kind are drawn.
PATHS = 12
DPI = 110

Map = dict[tuple[float, float, float], Tally]


def png(counted: dict[tuple[str, str], Tally], of_map: Map) -> bytes:
    """Draw shares that pass with their confidence, eta along the way, and the map."""
    with rc_context(style.RC):
        buffer = io.BytesIO()
        _draw(counted, of_map).savefig(
            buffer, format='png', dpi=DPI, facecolor=COLOURS['paper'])
        return buffer.getvalue()


def _draw(counted: dict[tuple[str, str], Tally], of_map: Map) -> Figure:
    figure = Figure(figsize=(style.WIDTH_IN, 10.0), layout='constrained')
    panels = figure.subplots(3, len(CROSSINGS), sharey='row')
    for axes, name in zip(panels[0], CROSSINGS):
        _shares(axes, {method: counted[name, method] for method in METHODS})
        axes.set_title(SHORT[name])
    for axes, name in zip(panels[1], CROSSINGS):
        _paths(axes, {method: counted[name, method] for method in METHODS})
    panels[0, 0].set_ylabel('passed [%]')
    panels[1, 0].set_ylabel(r'$\eta = \phi_c - \phi_a$ [deg]')
    panels[1, 0].legend(loc='upper left')
    for axes, time in zip(panels[2], TIMES):
        _map(axes, of_map, time)
    panels[2, 0].set_yticks(range(len(STIFFNESSES)),
                            [stiffness_text(stiffness) for stiffness in STIFFNESSES])
    panels[2, 0].set_ylabel('stiffness of the joints')
    return figure


def _shares(axes: Axes, tallies: dict[str, Tally]) -> None:
    for place, (method, tally) in enumerate(tallies.items()):
        share = 100.0 * tally.passed / tally.runs
        low, high = (100.0 * bound for bound in tally.interval)
        axes.bar(place, share, color=METHOD_COLOURS[method], width=0.6)
        axes.errorbar(place, share, yerr=[[share - low], [high - share]], color=COLOURS['ink'],
                      capsize=3.0, linewidth=1.0)
        axes.annotate(f'{tally.passed} of {tally.runs}', (place, high), (0.0, 3.0),
                      textcoords='offset points', ha='center', fontsize=8.0)
    axes.set_xticks(range(len(tallies)), [TITLES[method].replace(', ', ',\n')
                                          for method in tallies])
    axes.set_ylim(0.0, 112.0)
    axes.grid(axis='x', visible=False)


def _paths(axes: Axes, tallies: dict[str, Tally]) -> None:
    # Those that fail lie beneath.
    for method, tally in reversed(tallies.items()):
        for number, passage in enumerate(tally.passages[:PATHS]):
            theta, eta = np.degrees(passage.path).T
            axes.plot(theta, np.clip(eta, -60.0, 60.0), color=METHOD_COLOURS[method],
                      linewidth=0.8, alpha=0.7, label=None if number else TITLES[method])
    axes.set_xlabel(r'$\theta = \phi_b - \phi_a$ [deg]')
    axes.set_ylim(-60.0, 60.0)


def _map(axes: Axes, of_map: Map, time: float) -> None:
    shares = success(of_map, time)
    colours = LinearSegmentedColormap.from_list('shares', [COLOURS['tile'], LINK_COLOURS[0]])
    axes.imshow(shares, cmap=colours, vmin=0.0, vmax=1.0, aspect='auto')
    for row in range(len(STIFFNESSES)):
        for column in range(len(MISMATCHES)):
            share = shares[row, column]
            axes.annotate(f'{100.0 * share:.0f}', (column, row), ha='center', va='center',
                          color=COLOURS['paper' if share > 0.5 else 'ink'], fontsize=8.5)
    axes.set_title(f'40 deg in {time:g} s, eta fed back: passed [%]')
    axes.set_xticks(range(len(MISMATCHES)), [f'{mismatch:g}' for mismatch in MISMATCHES])
    axes.set_xlabel('mismatch of a length')
    axes.grid(visible=False)
