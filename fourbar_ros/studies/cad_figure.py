# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of the CAD study: which defects reproduce both numbers of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from fourbar_ros.studies.cad_defects import (
    defective,
    DEFECTS,
    Fit,
    NAMED,
    RMS,
    rms,
    simulate_test,
    SizeCurve,
    TIMES,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

# Defects that are drawn, with label and colour.
KINDS = {
    'offset_y_same': ('offset, same in all frames', LINK_COLOURS[0]),
    'offset_y_inside': ('offset to the inside', LINK_COLOURS[1]),
    'inertia_all': ('inertia or length, all', LINK_COLOURS[3]),
    'inertia_ac': ('inertia or length, a and c', LINK_COLOURS[2]),
    'length_ab': ('length, a and b', COLOURS['muted']),
    'length_a': ('length, a', COLOURS['ink'])}
PAIR = ('inertia_all', 'offset_y_inside')
# Largest number [deg], and largest ratio, that the axes show.
WIDEST, LARGEST_RATIO = 0.16, 1.6


@style.as_png
def png(curves: Sequence[SizeCurve], pairs: Mapping[tuple[str, str], Sequence[Fit]],
        best: Fit, twice: Fit) -> Figure:
    """Draw both numbers of each kind, sizes over amplitude, and the motions of the best fit."""
    figure, panels = style.panels(7.0, 2, 3)
    _numbers(panels[0, 0], best.amplitude)
    _ratios(panels[0, 1], curves)
    _sizes(panels[0, 2], next(curve for curve in curves if curve.name == NAMED), best)
    _pair(panels[1, 0], pairs[PAIR], twice)
    _motions(panels[1, 1], panels[1, 2], best)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc='outside upper center', ncols=4)
    return figure


def _numbers(axes: Axes, amplitude: float) -> None:
    for name, (label, colour) in KINDS.items():
        defect = DEFECTS[name]
        sizes = np.geomspace(1e-3, 1.0, 60) * defect.largest
        numbers = np.array([[rms({name: size}, test, amplitude) for test in (0, 1)]
                            for size in sizes])
        shown = numbers[(numbers < WIDEST).all(axis=1)]
        axes.plot(*np.vstack([[0.0, 0.0], shown]).T, color=colour, label=label)
        axes.plot(*shown[-1], marker='>', color=colour, markersize=4.0)
    axes.plot(*RMS, '*', color=COLOURS['limit'], markersize=13.0, label='the paper', zorder=6)
    axes.set(xlabel='rms of test 1 [deg]', ylabel='rms of test 2 [deg]', xlim=(0.0, WIDEST),
             ylim=(0.0, WIDEST), aspect='equal')
    axes.set_xticks((0.0, 0.05, 0.1, 0.15))
    axes.set_yticks((0.0, 0.05, 0.1, 0.15))
    axes.set_title(f'a. Growing defects, {amplitude:.0f} rad')


def _ratios(axes: Axes, curves: Sequence[SizeCurve]) -> None:
    for curve in curves:
        if curve.name in KINDS and curve.sign > 0.0:
            _, colour = KINDS[curve.name]
            axes.plot(curve.amplitudes, np.minimum(curve.ratio, 2.0 * LARGEST_RATIO),
                      color=colour)
            for fit in curve.fits:
                axes.plot(fit.amplitude, RMS[0] / RMS[1], 'o', color=colour, markersize=5.0)
    axes.axhline(RMS[0] / RMS[1], color=COLOURS['limit'], linestyle=(0, (4, 3)), linewidth=1.0)
    axes.annotate('the paper', (103.0, RMS[0] / RMS[1] - 0.03), ha='right', va='top',
                  color=COLOURS['limit'], fontsize=8.5)
    axes.set(xlabel='amplitude of the wheels [rad]', ylabel='rms of test 1 / rms of test 2',
             ylim=(0.0, LARGEST_RATIO))
    axes.set_title('b. Their ratio')


def _sizes(axes: Axes, curve: SizeCurve, best: Fit) -> None:
    for test, dashes in ((0, '-'), (1, (0, (4, 3)))):
        axes.plot(curve.amplitudes, 1e3 * curve.sizes[:, test], color=KINDS[NAMED][1],
                  linestyle=dashes, label=f'{RMS[test]:.3f} deg in test {test + 1}')
    size = 1e3 * best.sizes[NAMED]
    axes.plot(best.amplitude, size, '*', color=COLOURS['limit'], markersize=12.0)
    axes.annotate(f'{size:.1f} mm at {best.amplitude:.0f} rad', (best.amplitude, size),
                  (8.0, 10.0), textcoords='offset points', color=COLOURS['limit'])
    axes.set(xlabel='amplitude of the wheels [rad]', ylabel='offset [mm]', ylim=(0.0, 30.0))
    axes.set_title('c. Offset, same in all frames: size')
    axes.legend(loc='upper right')


def _pair(axes: Axes, fits: Sequence[Fit], twice: Fit) -> None:
    for name, dashes in zip(PAIR, ('-', (0, (4, 3)))):
        defect = DEFECTS[name]
        scale, unit = (1e3, 'mm') if defect.metres else (100.0, '%')
        axes.plot([fit.amplitude for fit in fits],
                  [scale * abs(fit.sizes[name]) for fit in fits], color=KINDS[name][1],
                  linestyle=dashes, marker='o', markersize=3.5, label=f'{defect.title} [{unit}]')
        size = scale * twice.sizes[name]
        axes.plot(twice.amplitude, size, '*', color=COLOURS['limit'], markersize=12.0, zorder=5)
        axes.annotate(f'{size:.2f} {unit}' + ('' if defect.metres else ': wheel counted twice'),
                      (twice.amplitude, size), (6.0, 9.0), textcoords='offset points',
                      color=COLOURS['limit'])
    axes.set(xlabel='amplitude of the wheels [rad]', ylabel='size [%], [mm]', ylim=(0.0, 6.0))
    axes.set_title('d. Two defects at once: any amplitude')
    axes.legend(loc='upper right')


def _motions(first: Axes, second: Axes, best: Fit) -> None:
    errors = [np.degrees(simulate_test(defective(best.sizes), test, best.amplitude)
                         - simulate_test(defective({}), test, best.amplitude)) for test in (0, 1)]
    for pair, label in ((0, 'a, c: smaller swing'), (1, 'b, d: should rest')):
        first.plot(TIMES, errors[0][:, pair], color=LINK_COLOURS[pair], label=label)
        second.plot(TIMES, errors[1][:, pair], color=LINK_COLOURS[pair], label='a, c' if pair == 0
                    else 'b, d')
    second.plot(TIMES, errors[1][:, 1] - errors[1][:, 0], color=COLOURS['ink'],
                linestyle=(0, (4, 3)), label='configuration')
    for axes, number, letter in ((first, 1, 'e'), (second, 2, 'f')):
        axes.set(xlabel='time [s]', ylabel='defective less nominal [deg]')
        axes.set_title(f'{letter}. Test {number} with the offset of (c)')
        axes.legend(loc='best')
