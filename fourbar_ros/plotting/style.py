# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Style of the figures: colours for light and dark backgrounds, SVG for embedding in an HTML page.

Figures use the light colours. In SVG for a page each colour becomes a CSS variable, so that one
file is legible on a light and on a dark background.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
import io
import re
from typing import Any, ParamSpec

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Colour by name: (on light, on dark). The link colours follow Okabe and Ito (colour-blind).
PALETTE = {
    'paper': ('#ffffff', '#16181c'),
    'ink': ('#1b1e23', '#e9ebee'),
    'muted': ('#666d77', '#a0a7b1'),
    'grid': ('#e2e5e9', '#2e333a'),
    'tile': ('#f5f6f8', '#1f2329'),
    'link_a': ('#0067a6', '#5db8f2'),
    'link_b': ('#cc5500', '#ff9a4d'),
    'link_c': ('#00805d', '#3fd0a2'),
    'link_d': ('#9b3a8f', '#e39ad9'),
    'limit': ('#b3261e', '#ff8a80'),
}

COLOURS = {name: light for name, (light, _) in PALETTE.items()}
LETTERS = 'abcd'
LINK_COLOURS = tuple(COLOURS[f'link_{letter}'] for letter in LETTERS)
# Line styles; in a parallelogram the dashed curves of c and d cover those of a and b.
LINK_DASHES = ('-', '-', (0, (4, 3)), (0, (4, 3)))

# Width of every figure [in].
WIDTH_IN = 10.0
# Resolution of raster images.
DPI = 120
# Bins of a decimated curve: about one for each pixel of a panel.
BINS = 450

# Line style of limits and goals.
DASHED = (0, (6, 2))
# Style of scattered samples.
SAMPLES: dict[str, Any] = {
    'linestyle': 'none', 'marker': '.', 'markersize': 3.5, 'markeredgewidth': 0}
# Averaging time of NIS [s].
NIS_WINDOW_S = 1.0

# Parameters of every figure, for `matplotlib.rc_context`.
RC: dict[Any, Any] = {
    'font.size': 9.0,
    'axes.titlesize': 9.5,
    'axes.titlelocation': 'left',
    'axes.titlepad': 6.0,
    'axes.labelsize': 9.0,
    'axes.edgecolor': COLOURS['muted'],
    'axes.linewidth': 0.7,
    'axes.labelcolor': COLOURS['muted'],
    'axes.titlecolor': COLOURS['ink'],
    'axes.facecolor': 'none',
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.xmargin': 0.01,
    'axes.formatter.useoffset': False,
    'grid.color': COLOURS['grid'],
    'grid.linewidth': 0.7,
    'xtick.color': COLOURS['muted'],
    'ytick.color': COLOURS['muted'],
    'xtick.labelsize': 8.5,
    'ytick.labelsize': 8.5,
    'xtick.major.size': 3.0,
    'ytick.major.size': 3.0,
    'text.color': COLOURS['ink'],
    'legend.frameon': False,
    'legend.fontsize': 8.5,
    'legend.handlelength': 1.8,
    'legend.columnspacing': 1.6,
    'lines.linewidth': 1.4,
    'lines.solid_capstyle': 'round',
    'figure.facecolor': 'none',
    'svg.fonttype': 'none',
}


def render(make: Callable[[], Figure], kind: str, salt: str = 'figure') -> bytes:
    """
    Draw a figure in this style on a light background; the same figure gives the same bytes.

    :param kind: `png` or `svg`.
    :param salt: seed of the identifiers in an SVG.
    """
    with rc_context({**RC, 'svg.hashsalt': salt}):
        buffer = io.BytesIO()
        make().savefig(buffer, format=kind, dpi=DPI, facecolor=COLOURS['paper'],
                       metadata={'Date': None} if kind == 'svg' else None)
    return buffer.getvalue()


def page_svg(make: Callable[[], Figure], salt: str) -> str:
    """
    Draw a figure in this style as an SVG element for an HTML page.

    :param salt: keeps the identifiers of this figure apart from those of other figures.
    """
    with rc_context({**RC, 'svg.hashsalt': salt}):
        buffer = io.StringIO()
        make().savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None})
    return _for_page(buffer.getvalue(), salt)


def _for_page(svg: str, salt: str) -> str:
    svg = svg[svg.index('<svg'):]
    svg = re.sub(r'<metadata>.*?</metadata>', '', svg, flags=re.DOTALL)
    svg = re.sub(r'<svg [^>]*?viewBox="([^"]+)"[^>]*>',
                 rf'<svg viewBox="\1" role="img" aria-label="{salt}" '
                 'xmlns:xlink="http://www.w3.org/1999/xlink">', svg, count=1)
    svg = re.sub(r'<g id="[^"]*"', '<g', svg)
    # A hundredth of a point is below the resolution of screens; further digits double the size.
    svg = re.sub(r'(\d\.\d\d)\d+', r'\1', svg)
    for name, colour in COLOURS.items():
        svg = svg.replace(colour, f'var(--{name.replace("_", "-")})')
    return svg


Arguments = ParamSpec('Arguments')


def as_png(make: Callable[Arguments, Figure]) -> Callable[Arguments, bytes]:
    """Decorate a function that makes a figure; the decorated function returns a PNG image."""
    @wraps(make)
    def draw_png(*args: Arguments.args, **kwargs: Arguments.kwargs) -> bytes:
        return render(lambda: make(*args, **kwargs), 'png')
    return draw_png


def panels(height: float, rows: int, columns: int, **options: Any) -> tuple[Figure, Any]:
    """
    Return a figure of the full width with a grid of axes.

    :param height: [in].
    :param options: for `Figure.subplots`.
    :returns: the figure and its axes, as `Figure.subplots` returns them.
    """
    figure = Figure(figsize=(WIDTH_IN, height), layout='constrained')
    return figure, figure.subplots(rows, columns, **options)


def decimate(x: Floats, y: Floats, bins: int = BINS) -> tuple[Floats, Floats]:
    """
    Reduce a curve to its smallest and largest value in each bin, so that no peak is lost.

    :param x: (n,) ascending.
    :param y: (n,); NaN is left out.
    :returns: at most 2 * bins points, in order.
    """
    known = np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) <= 2 * bins:
        return x, y
    edges = np.linspace(0, len(x), bins + 1).astype(int)
    kept: NDArray[np.int64] = np.unique([
        begin + pick(y[begin:end]) for begin, end in zip(edges[:-1], edges[1:])
        for pick in (np.argmin, np.argmax)])
    return x[kept], y[kept]


def thin_out(x: Floats, y: Floats, count: int) -> tuple[Floats, Floats]:
    """
    Reduce scattered samples evenly, so that their density stays, and keep the extremes.

    :param x: (n,) ascending.
    :param y: (n,); NaN is left out.
    :returns: about `count` points, in order.
    """
    known = np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) <= count:
        return x, y
    peaks = decimate(np.arange(len(x), dtype=float), y, count // 20)[0].astype(int)
    kept = np.union1d(np.linspace(0, len(x) - 1, count).astype(int), peaks)
    return x[kept], y[kept]


def si_scale(largest: float) -> tuple[float, str]:
    """Return the factor and the SI prefix with which the largest value is at least 1."""
    for factor, prefix in ((1.0, ''), (1e3, 'm'), (1e6, 'µ'), (1e9, 'n')):
        if largest * factor >= 1.0:
            return factor, prefix
    return 1.0, ''


def link_title(axes: Axes, link: int) -> None:
    """Set the title of a panel that shows one link, in the colour of the link."""
    axes.set_title(f'link {LETTERS[link]}', color=LINK_COLOURS[link], fontweight='bold')


def windowed_nis(time: Floats, nis: Floats, degrees: Floats) -> tuple[Floats, Floats, Floats]:
    """
    Average NIS over windows of `NIS_WINDOW_S`; a shorter last window is joined to the one before.

    :param time: (n,) ascending [s].
    :param nis: (n,) normalized innovation squared.
    :param degrees: (n,) degrees of freedom.
    :returns: mean time [s], NIS per degree of freedom, and degrees of freedom of each window.
    """
    window = ((time - time[0]) // NIS_WINDOW_S).astype(int)
    window = np.minimum(window, max(int(window[-1]) - 1, 0))
    total: Floats = np.bincount(window, degrees).astype(np.float64)
    used = total > 0
    centre = np.bincount(window, time)[used] / np.bincount(window)[used]
    return centre, np.bincount(window, nis)[used] / total[used], total[used]


def label_ends(axes: Axes, ends: list[tuple[float, str, str]]) -> None:
    """
    Write labels at the right end of curves, moved apart where curves end close together.

    :param ends: (last y, text, colour) of each curve.
    """
    low, high = axes.get_ylim()
    apart = 0.085 * (high - low)
    ends = sorted(ends)
    places = [ends[0][0]] if ends else []
    for y, _, _ in ends[1:]:
        places.append(max(y, places[-1] + apart))
    shift = float(np.mean([end[0] for end in ends]) - np.mean(places)) if ends else 0.0
    for (_, text, colour), place in zip(ends, places):
        axes.annotate(text, (1.0, place + shift), xycoords=('axes fraction', 'data'),
                      xytext=(4, 0), textcoords='offset points', va='center', color=colour,
                      fontweight='bold', annotation_clip=False)


def legend_above(axes: Axes, markerscale: float = 1.0) -> None:
    """Put the legend above the axes, where it covers no curve."""
    labels = axes.get_legend_handles_labels()[1]
    axes.legend(loc='lower right', bbox_to_anchor=(1.0, 1.0), ncols=len(labels),
                borderaxespad=0.1, markerscale=markerscale)


def log_ticks(axes: Axes) -> None:
    """Label a logarithmic y axis at 1, 2, 5, 10, ... in plain numbers."""
    axes.set_yscale('log')
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(lambda value, _: f'{value:g}')
    axes.yaxis.set_minor_locator(NullLocator())
