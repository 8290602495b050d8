# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figures of the conditioning study: Fig. 6 of the paper, and linkages near a change point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fourbar_ros.mechanism.conditioning import Conditioning
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from fourbar_ros.studies.conditioning_linkages import (
    condition,
    LENGTH,
    LinkageConditioning,
    OFFSETS,
    parallelogram,
    RATIOS,
    SIGNS,
    span,
    SPAN_OFFSETS,
    SQUARE,
    STABLE,
    THETAS,
    worst_of_three,
)
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
import numpy as np

LEVELS = (1.0, 1.05, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0)
LABELLED = (1.1, 1.5, 3.0)
CONVENTIONS = {'same': 'one sign in\nall body frames', 'inside': 'towards\nthe centre'}
SIGN_COLOURS = {'same': LINK_COLOURS[0], 'inside': LINK_COLOURS[1]}
BRANCH_DASHES = {'open': '-', 'crossed': (0, (3, 2))}
WIDEST = 1e3 * SPAN_OFFSETS[-1]    # mm
MOST_CONDITION = 1e3
RATIO_TICKS = {value: f'{value:g}' for value in (0.25, 0.5, 1.0, 2.0, 4.0)}


@style.as_png
def png(grids: Mapping[str, Conditioning]) -> Figure:
    """Draw cond(A) over theta and ratio, over theta and offset, and the spans of offsets."""
    figure, panels = style.panels(6.6, 2, 3, height_ratios=(1.15, 1.0))
    filled = _contours(panels[0, 0], RATIOS, grids['ratio'].condition)
    panels[0, 0].set(yscale='log', ylabel=r'$l_a / l_b$')
    panels[0, 0].set_yticks(*zip(*RATIO_TICKS.items()))
    panels[0, 0].minorticks_off()
    panels[0, 0].set_title('a. Fig. 6a: length ratio')
    for axes, name, letter in ((panels[0, 1], 'same', 'b'), (panels[0, 2], 'inside', 'c')):
        _contours(axes, 1e3 * OFFSETS, grids[name].condition)
        axes.set_ylabel('offset y [mm]')
        axes.set_title(f'{letter}. Fig. 6b, offset {name!r}')
    bar = figure.colorbar(filled, ax=panels[0].tolist(), ticks=LEVELS, shrink=0.95,
                          format='%g', pad=0.015)
    bar.set_label(r'cond $\mathbf{A}$')
    bar.outline.set_visible(False)
    bar.ax.minorticks_off()
    _ratios(panels[1, 0])
    _sketches(panels[1, 1])
    _spans(panels[1, 2])
    return figure


@style.as_png
def linkages_png(linkages: Sequence[LinkageConditioning]) -> Figure:
    """Draw, for each linkage, cond(A), distance to change points, and gains of the wheels."""
    figure, panels = style.panels(7.2, 3, len(linkages), sharex='col', sharey='row', squeeze=False)
    for column, linkage in zip(panels.T, linkages):
        for branch, conditioning in linkage.branches.items():
            for axes, curves in zip(column, _curves(conditioning)):
                for values, label, colour, width in curves:
                    axes.plot(np.degrees(linkage.thetas), values[0], color=colour,
                              linestyle=BRANCH_DASHES[branch], linewidth=width,
                              label=label if len(linkage.branches) == 1 else f'{label}, {branch}')
        column[0].set_title(f'{linkage.title}: condition number')
        column[1].set_title('distance to a change point (0: on it)')
        column[2].set_title('gain of the wheels along their weakest motion')
        column[2].set_xlabel(r'$\theta = \phi_b - \phi_a$ [deg]')
        _shade(column, linkage)
    panels[0, 0].set(yscale='log', ylabel='cond', ylim=(0.9, MOST_CONDITION))
    panels[1, 0].set_ylim(-0.03, 1.05)
    panels[2, 0].set(ylabel='gain', ylim=(-0.04, 1.08))
    for row in panels:
        row[-1].legend(loc='upper left', bbox_to_anchor=(1.0, 1.0))
    return figure


def _curves(conditioning: Conditioning) -> tuple[list[tuple[Array, str, str, float]], ...]:
    """Return values, label, colour and width of all curves, for each of the three panels."""
    highest, gains = 10.0 * MOST_CONDITION, conditioning.gains
    return ([
        (np.minimum(conditioning.condition, highest), r'cond $\mathbf{A}$, axes a and b',
         LINK_COLOURS[0], 1.4),
        (np.minimum(conditioning.condition_of_motions, highest), 'of the motions, any axes',
         COLOURS['muted'], 1.4)], [
        (conditioning.closure_ratio, 'singular values of J, ratio', LINK_COLOURS[0], 1.4),
        (conditioning.alignment, r'$|\sin(\phi_d - \phi_c)|$', COLOURS['muted'], 1.4)], [
        (gains[..., 0], 'four wheels', LINK_COLOURS[0], 1.4),
        # The wider line stays visible where two curves coincide.
        (worst_of_three(conditioning), 'three, worst one lost', LINK_COLOURS[2], 4.0),
        (gains[..., 5], 'two, a and b', LINK_COLOURS[1], 1.4),
        (gains[..., 6], 'two, a and c', LINK_COLOURS[3], 1.4)])


def _contours(axes: Axes, values: Array, conditions: Array) -> QuadContourSet:
    colours = LinearSegmentedColormap.from_list(
        'condition', [COLOURS['tile'], '#9cc3dd', LINK_COLOURS[0], COLOURS['ink']])
    degrees = np.degrees(THETAS)
    filled = axes.contourf(degrees, values, np.maximum(conditions, 1.0), levels=LEVELS,
                           cmap=colours, norm=BoundaryNorm(LEVELS, colours.N), extend='max')
    lines = axes.contour(degrees, values, conditions, levels=LABELLED, colors=COLOURS['ink'],
                         linewidths=0.6)
    axes.clabel(lines, fmt='%g', fontsize=7.5)
    axes.set_xlabel(r'$\theta$ [deg]')
    axes.set_xticks(range(0, 181, 45))
    axes.grid(visible=False)
    return filled


def _ratios(axes: Axes) -> None:
    for label, with_length, dashes in (
            ('mass the same (paper)', False, '-'), ('mass with length', True, (0, (4, 3)))):
        axes.plot(RATIOS, [condition(parallelogram(ratio, with_length), SQUARE)
                           for ratio in RATIOS], color=COLOURS['ink'], linestyle=dashes,
                  label=label)
    axes.set(xscale='log', xlabel=r'$l_a / l_b$', ylabel=r'cond $\mathbf{A}$ (any $\theta$)')
    style.log_ticks(axes)
    axes.set_xticks(*zip(*RATIO_TICKS.items()))
    axes.minorticks_off()
    axes.set_title('d. Unequal lengths always cost')
    axes.legend(loc='upper center')


def _sketches(axes: Axes) -> None:
    """Draw the mass centres in both conventions."""
    axes.set_aspect('equal')
    axes.axis('off')
    theta, offset = np.radians(60.0), 0.25 * LENGTH
    along = {letter: np.array([np.cos(angle), np.sin(angle)]) for letter, angle in zip(
        'abcd', (0.0, theta, 0.0, theta))}
    starts = {'a': np.zeros(2), 'b': np.zeros(2), 'c': along['b'], 'd': along['a']}
    for number, name in enumerate(SIGNS):
        low = -1.35 * number
        base = np.array([0.0, low])
        for letter, sign, colour in zip('abcd', SIGNS[name], LINK_COLOURS):
            near, direction = base + starts[letter], along[letter]
            axes.plot(*np.array([near, near + direction]).T, color=colour, linewidth=3.0)
            middle = near + 0.5 * direction
            centre = middle + sign * offset / LENGTH * np.array([-direction[1], direction[0]])
            axes.annotate('', centre, middle, arrowprops={
                'arrowstyle': '-|>', 'color': colour, 'shrinkA': 0.0, 'shrinkB': 0.0,
                'mutation_scale': 14.0, 'linewidth': 1.6})
            axes.annotate(letter, near + 0.2 * direction, ha='center', va='center', color=colour,
                          fontweight='bold', bbox={
                              'facecolor': COLOURS['paper'], 'edgecolor': 'none', 'pad': 0.8})
        axes.annotate(f"'{name}'", (1.65, low + 0.55), color=SIGN_COLOURS[name],
                      fontweight='bold')
        axes.annotate(CONVENTIONS[name], (1.65, low + 0.5), va='top', fontsize=8.0,
                      color=COLOURS['muted'])
    axes.set(xlim=(-0.3, 2.9), ylim=(-1.5, 1.15))
    axes.set_title('e. Where y > 0 puts the mass centres')


def _spans(axes: Axes) -> None:
    thetas = np.radians(np.linspace(1.0, 90.0, 90))
    for name, signs in SIGNS.items():
        spans = 1e3 * np.array([span(signs, theta) for theta in thetas])
        axes.plot(np.degrees(thetas), np.minimum(spans, WIDEST), color=SIGN_COLOURS[name],
                  label=f'{name!r}')
    axes.set(xlabel=r'$\theta$ [deg]', ylabel=f'offset with cond \N{LESS-THAN OR EQUAL TO} '
             f'{STABLE:g} [mm]', ylim=(0.0, 1.04 * WIDEST))
    axes.set_xticks(range(0, 91, 15))
    axes.set_title('f. Span of offsets that keeps cond small')
    axes.legend(loc='center right')


def _shade(column: Sequence[Axes], linkage: LinkageConditioning) -> None:
    """Shade where the loop cannot close on any branch."""
    closed = np.any([np.isfinite(conditioning.closure_ratio[0])
                     for conditioning in linkage.branches.values()], axis=0)
    # A single point is a change point and too narrow to see.
    if np.count_nonzero(~closed) > 2:
        degrees = np.degrees(linkage.thetas)
        for axes in column:
            axes.fill_between(degrees, 0.0, 1.0, where=~closed, color=COLOURS['grid'],
                              transform=axes.get_xaxis_transform(), linewidth=0.0)
        column[0].annotate('does not close', (float(np.median(degrees[~closed])), 0.5),
                           xycoords=('data', 'axes fraction'), ha='center',
                           color=COLOURS['muted'])
