# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The figure of the consistency study: the statistics step by step, and their bounds."""

from __future__ import annotations

from collections.abc import Sequence
import io
from typing import TYPE_CHECKING

from fourbar_ros.estimation import STATE_NAMES
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

if TYPE_CHECKING:
    from fourbar_ros.studies.consistency import Outcome

SHOWN = {'matched': 'matched', 'prototype': 'prototype, a quarter turn of the whole',
         'reshaping': 'prototype, joints sliding'}
LETTERS = 'abcdefghijklmno'
DASHED = (0, (4, 2))
BINS = 300
DPI = 110


def png(outcomes: Sequence[Outcome]) -> bytes:
    """Draw NEES, NIS, errors and bound over time, and the autocorrelation of innovations."""
    with rc_context(style.RC):
        buffer = io.BytesIO()
        _draw({outcome.case.name: outcome for outcome in outcomes}).savefig(
            buffer, format='png', dpi=DPI, facecolor=COLOURS['paper'])
        return buffer.getvalue()


def _draw(outcomes: dict[str, Outcome]) -> Figure:
    shown = [name for name in SHOWN if name in outcomes]
    figure = Figure(figsize=(style.WIDTH_IN, 11.5), layout='constrained')
    panels = figure.subplots(5, len(shown), sharex='row', sharey='row', squeeze=False)
    for column, name in enumerate(shown):
        outcome, axes = outcomes[name], panels[:, column]
        axes[0].set_title(SHOWN[name])
        _statistic(axes[0], outcome.times, *outcome.nees, 'mean of the runs')
        _statistic(axes[1], outcome.times, *outcome.nis, 'mean of the runs')
        _errors(axes[2], outcome, (0, 1), None)
        _errors(axes[3], outcome, (2, 3),
                outcomes.get('matched_encoders') if name == 'matched' else None)
        _whiteness(axes[4], outcome)
    style.log_ticks(panels[0, 0])
    for row in (1, 4):
        # Room for the legend.
        low, high = panels[row, 0].get_ylim()
        panels[row, 0].set_ylim(low, high + 0.25 * (high - low))
    for row, columns in ((2, slice(0, 2)), (3, slice(2, 4))):
        style.log_ticks(panels[row, 0])
        # The first steps, which know next to nothing, would take all the room.
        panels[row, 0].set_ylim(*_limits([outcomes[name] for name in shown], columns))
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


def _errors(axes: Axes, outcome: Outcome, columns: tuple[int, int], rounded: Outcome | None
            ) -> None:
    if rounded is not None:
        axes.plot(*style.decimate(rounded.times, _degrees(rounded.mean_squares[:, columns[0]]),
                                  BINS), color=LINK_COLOURS[2], linewidth=0.8,
                  label=f'{STATE_NAMES[columns[0]]}, 14-bit encoders')
    for column, colour in zip(columns, LINK_COLOURS):
        axes.plot(*style.decimate(outcome.times, _degrees(outcome.mean_squares[:, column]), BINS),
                  color=colour, linewidth=0.8, label=STATE_NAMES[column])
    axes.plot(*style.decimate(outcome.times, _degrees(outcome.bound[:, columns[0]]), BINS),
              color=COLOURS['limit'], linestyle=DASHED, linewidth=1.2, label='Cramer-Rao bound')


def _whiteness(axes: Axes, outcome: Outcome) -> None:
    found, bounds = outcome.whiteness
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


def _limits(outcomes: Sequence[Outcome], columns: slice) -> tuple[float, float]:
    """Return limits of an axis for the errors of all but the first steps [deg] or [deg/s]."""
    errors = np.concatenate([
        _degrees(squares[:, columns][squares.shape[0] // 50:]).ravel()
        for outcome in outcomes for squares in (outcome.mean_squares, outcome.bound)])
    known = errors[np.isfinite(errors) & (errors > 0.0)]
    if not known.size:
        return 1e-3, 1.0
    # Room for the legend above.
    return 0.8 * float(known.min()), 5.0 * float(known.max())
