# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of the study of conditioning: Fig. 6 of the paper, and what it hides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import io

from fourbar_ros.mechanism.conditioning import Conditioning
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from fourbar_ros.studies.conditioning import (
    condition,
    LENGTH,
    Look,
    OFFSETS,
    parallelogram,
    RATIOS,
    SIGNS,
    SOUGHT,
    span,
    SQUARE,
    STABLE,
    THETAS,
    worst_of_three,
)
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
import numpy as np

LEVELS = (1.0, 1.05, 1.1, 1.2, 1.5, 2.0, 3.0, 5.0, 8.0, 12.0)
LABELLED = (1.1, 1.5, 3.0)
EXPLAINED = {'same': 'one sign in\nall body frames', 'inside': 'towards\nthe centre'}
SIGN_COLOURS = {'same': LINK_COLOURS[0], 'inside': LINK_COLOURS[1]}
BRANCH_DASHES = {'open': '-', 'crossed': (0, (3, 2))}
WIDEST = 1e3 * SOUGHT[-1]    # mm
MOST_CONDITION = 1e3
DPI = 120


def png(grids: Mapping[str, Conditioning]) -> bytes:
    """Draw cond(A) over theta and ratio, over theta and offset, and how far each stays stable."""
    with rc_context(style.RC):
        figure = Figure(figsize=(style.WIDTH_IN, 6.6), layout='constrained')
        panels = figure.subplots(2, 3, height_ratios=(1.15, 1.0))
        filled = _contours(panels[0, 0], RATIOS, grids['ratio'].condition)
        panels[0, 0].set(yscale='log', ylabel=r'$l_a / l_b$')
        panels[0, 0].set_yticks((0.25, 0.5, 1.0, 2.0, 4.0), ('0.25', '0.5', '1', '2', '4'))
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
        return _saved(figure)


def looks_png(looks: Sequence[Look]) -> bytes:
    """Draw, of each linkage, cond(A), distance to change points, and what wheels can do."""
    with rc_context(style.RC):
        figure = Figure(figsize=(style.WIDTH_IN, 7.2), layout='constrained')
        panels = figure.subplots(3, len(looks), sharex='col', sharey='row', squeeze=False)
        for column, look in enumerate(looks):
            for branch, found in look.branches.items():
                _condition(panels[0, column], look, branch, found)
                _distance(panels[1, column], look, branch, found)
                _gains(panels[2, column], look, branch, found)
            panels[0, column].set_title(f'{look.title}: condition number')
            panels[1, column].set_title('distance to a change point (0: on it)')
            panels[2, column].set_title('what wheels can do along the motion they drive least')
            panels[2, column].set_xlabel(r'$\theta = \phi_b - \phi_a$ [deg]')
            _blank(list(panels[:, column]), look)
        panels[0, 0].set_ylabel('cond')
        panels[0, 0].set_ylim(0.9, MOST_CONDITION)
        panels[1, 0].set_ylim(-0.03, 1.05)
        panels[2, 0].set_ylabel('gain')
        panels[2, 0].set_ylim(-0.04, 1.08)
        for row in panels:
            row[-1].legend(loc='upper left', bbox_to_anchor=(1.0, 1.0))
        return _saved(figure)


def _saved(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format='png', dpi=DPI, facecolor=COLOURS['paper'])
    return buffer.getvalue()


def _contours(axes: Axes, values: Array, found: Array) -> QuadContourSet:
    colours = LinearSegmentedColormap.from_list(
        'condition', [COLOURS['tile'], '#9cc3dd', LINK_COLOURS[0], COLOURS['ink']])
    degrees = np.degrees(THETAS)
    filled = axes.contourf(degrees, values, np.maximum(found, 1.0), levels=LEVELS, cmap=colours,
                           norm=BoundaryNorm(LEVELS, colours.N), extend='max')
    lines = axes.contour(degrees, values, found, levels=LABELLED, colors=COLOURS['ink'],
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
    axes.set_xticks((0.25, 0.5, 1.0, 2.0, 4.0), ('0.25', '0.5', '1', '2', '4'))
    axes.minorticks_off()
    axes.set_title('d. Unequal lengths always cost')
    axes.legend(loc='upper center')


def _sketches(axes: Axes) -> None:
    """Draw where the mass centres are in either convention."""
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
            near, way = base + starts[letter], along[letter]
            axes.plot(*np.array([near, near + way]).T, color=colour, linewidth=3.0)
            middle = near + 0.5 * way
            centre = middle + sign * offset / LENGTH * np.array([-way[1], way[0]])
            axes.annotate('', centre, middle, arrowprops={
                'arrowstyle': '-|>', 'color': colour, 'shrinkA': 0.0, 'shrinkB': 0.0,
                'mutation_scale': 14.0, 'linewidth': 1.6})
            axes.annotate(letter, near + 0.2 * way, ha='center', va='center', color=colour,
                          fontweight='bold', bbox={
                              'facecolor': COLOURS['paper'], 'edgecolor': 'none', 'pad': 0.8})
        axes.annotate(f"'{name}'", (1.65, low + 0.55), color=SIGN_COLOURS[name],
                      fontweight='bold')
        axes.annotate(EXPLAINED[name], (1.65, low + 0.5), va='top', fontsize=8.0,
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


def _condition(axes: Axes, look: Look, branch: str, found: Conditioning) -> None:
    dashes = BRANCH_DASHES[branch]
    for values, label, colour in (
            (found.condition, r'cond $\mathbf{A}$, axes a and b', LINK_COLOURS[0]),
            (found.condition_of_motions, 'of the motions, any axes', COLOURS['muted'])):
        axes.plot(np.degrees(look.thetas), np.minimum(values[0], 10.0 * MOST_CONDITION),
                  color=colour, linestyle=dashes, label=_label(label, look, branch))
    axes.set_yscale('log')


def _distance(axes: Axes, look: Look, branch: str, found: Conditioning) -> None:
    dashes = BRANCH_DASHES[branch]
    for values, label, colour in (
            (found.closure_ratio, 'singular values of J, ratio', LINK_COLOURS[0]),
            (found.alignment, r'$|\sin(\phi_d - \phi_c)|$', COLOURS['muted'])):
        axes.plot(np.degrees(look.thetas), values[0], color=colour, linestyle=dashes,
                  label=_label(label, look, branch))


def _gains(axes: Axes, look: Look, branch: str, found: Conditioning) -> None:
    dashes = BRANCH_DASHES[branch]
    # The wider line shows on both sides where two coincide.
    for values, label, colour, width in (
            (found.gains[..., 0], 'four wheels', LINK_COLOURS[0], 1.4),
            (worst_of_three(found), 'three, worst one lost', LINK_COLOURS[2], 4.0),
            (found.gains[..., 5], 'two, a and b', LINK_COLOURS[1], 1.4),
            (found.gains[..., 6], 'two, a and c', LINK_COLOURS[3], 1.4)):
        axes.plot(np.degrees(look.thetas), values[0], color=colour, linestyle=dashes,
                  linewidth=width, label=_label(label, look, branch))


def _label(label: str, look: Look, branch: str) -> str:
    return label if len(look.branches) == 1 else f'{label}, {branch}'


def _blank(column: Sequence[Axes], look: Look) -> None:
    """Shade where the loop cannot close on any branch."""
    closed = np.any([np.isfinite(found.closure_ratio[0]) for found in look.branches.values()],
                    axis=0)
    # A single point is a change point, where nothing is blank to the eye.
    if np.count_nonzero(~closed) > 2:
        degrees = np.degrees(look.thetas)
        for axes in column:
            axes.fill_between(degrees, 0.0, 1.0, where=~closed, color=COLOURS['grid'],
                              transform=axes.get_xaxis_transform(), linewidth=0.0)
        column[0].annotate('does not close', (float(np.median(degrees[~closed])), 0.5),
                           xycoords=('data', 'axes fraction'), ha='center',
                           color=COLOURS['muted'])
