# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of the consistency study: statistics step by step, with their bounds."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_ros.estimation import STATE_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from fourbar_ros.studies.consistency_results import CaseResult
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

SHOWN = {'matched': 'matched', 'prototype': 'prototype, a quarter turn of the whole',
         'reshaping': 'prototype, joints sliding'}
DASHED = (0, (4, 2))
BINS = 300


@style.as_png
def png(results: Sequence[CaseResult]) -> Figure:
    """Draw NEES, NIS, errors and bound over time, and the autocorrelation of innovations."""
    cases = {result.case.name: result for result in results}
    shown = [name for name in SHOWN if name in cases]
    figure, panels = style.panels(11.5, 5, len(shown), sharex='row', sharey='row', squeeze=False)
    for column, name in enumerate(shown):
        result, axes = cases[name], panels[:, column]
        axes[0].set_title(SHOWN[name])
        _statistic(axes[0], result.times, *result.nees, 'mean of the runs')
        _statistic(axes[1], result.times, *result.nis, 'mean of the runs')
        _errors(axes[2], result, (0, 1), None)
        _errors(axes[3], result, (2, 3),
                cases.get('matched_encoders') if name == 'matched' else None)
        _whiteness(axes[4], result)
    style.log_ticks(panels[0, 0])
    for row in (1, 4):
        # Room for the legend.
        low, high = panels[row, 0].get_ylim()
        panels[row, 0].set_ylim(low, high + 0.25 * (high - low))
    for row, columns in ((2, slice(0, 2)), (3, slice(2, 4))):
        style.log_ticks(panels[row, 0])
        # The large errors of the first steps would fill the axis.
        panels[row, 0].set_ylim(*_limits([cases[name] for name in shown], columns))
    for row, text in enumerate((
            'NEES', 'NIS / degrees of freedom', 'rms error of angles [deg]',
            'rms error of rates [deg/s]', 'autocorrelation of innovations')):
        panels[row, 0].set_ylabel(text)
        for axes in panels[row]:
            axes.set_xlabel('lag [measurements]' if row == 4 else 'time [s]')
        panels[row, 0].legend(loc='upper right', ncols=(2, 2, 1, 1, 3)[row], borderaxespad=0.1,
                              columnspacing=1.0, handletextpad=0.5)
    return figure


def _statistic(axes: Axes, times: Array, values: Array, low: Array, high: Array, name: str
               ) -> None:
    axes.plot(*style.decimate(times, values, BINS), color=COLOURS['link_a'], linewidth=0.8,
              label=name)
    for bound, label in ((low, '95 % bounds'), (high, None)):
        axes.plot(*style.decimate(times, bound, BINS), color=COLOURS['limit'], linewidth=1.0,
                  linestyle=DASHED, label=label)


def _errors(axes: Axes, result: CaseResult, columns: tuple[int, int], rounded: CaseResult | None
            ) -> None:
    if rounded is not None:
        axes.plot(*style.decimate(rounded.times, _degrees(rounded.mean_squares[:, columns[0]]),
                                  BINS), color=LINK_COLOURS[2], linewidth=0.8,
                  label=f'{STATE_NAMES[columns[0]]}, 14-bit encoders')
    for column, colour in zip(columns, LINK_COLOURS):
        axes.plot(*style.decimate(result.times, _degrees(result.mean_squares[:, column]), BINS),
                  color=colour, linewidth=0.8, label=STATE_NAMES[column])
    axes.plot(*style.decimate(result.times, _degrees(result.bound[:, columns[0]]), BINS),
              color=COLOURS['limit'], linestyle=DASHED, linewidth=1.2, label='Cramer-Rao bound')


def _whiteness(axes: Axes, result: CaseResult) -> None:
    found, bounds = result.whiteness
    lags = np.arange(1, len(found) + 1)
    for link, colour in enumerate(LINK_COLOURS):
        axes.plot(lags, found[:, link], linestyle='', marker='o', markersize=2.5, color=colour,
                  label=f'link_{"abcd"[link]}')
    for sign in (1.0, -1.0):
        axes.plot(lags, sign * bounds.max(axis=1), color=COLOURS['limit'], linestyle=DASHED,
                  linewidth=1.0, label='95 % bounds' if sign > 0.0 else None)


def _degrees(squares: Array) -> Array:
    degrees: Array = np.degrees(np.sqrt(squares))
    return degrees


def _limits(cases: Sequence[CaseResult], columns: slice) -> tuple[float, float]:
    """Return limits of an axis for the errors of all but the first steps [deg] or [deg/s]."""
    errors = np.concatenate([
        _degrees(squares[:, columns][squares.shape[0] // 50:]).ravel()
        for result in cases for squares in (result.mean_squares, result.bound)])
    known = errors[np.isfinite(errors) & (errors > 0.0)]
    if not known.size:
        return 1e-3, 1.0
    # Room for the legend above.
    return 0.8 * float(known.min()), 5.0 * float(known.max())
