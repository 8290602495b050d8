# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures of a calibration: what was measured and fitted, and what is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import io

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.links import LinkEstimate
from fourbar_ros.analysis.calibration.wheels import WheelEstimate
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS, LINK_DASHES, thin_out
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

DPI = 120
POINTS = 600
# Residuals are averaged over so many samples, to show what noise would hide.
AVERAGED = 25


def rendered(make: Callable[[], Figure], kind: str) -> bytes:
    """
    Draw a figure.

    :param kind: `png` or `svg`.
    """
    with rc_context({**style.RC, 'svg.hashsalt': 'calibration'}):
        buffer = io.BytesIO()
        metadata = {'Date': None} if kind == 'svg' else {}
        make().savefig(buffer, format=kind, dpi=DPI, facecolor=COLOURS['paper'],
                       metadata=metadata)
        return buffer.getvalue()


def wheels_figure(estimates: Sequence[WheelEstimate]) -> Figure:
    """Draw the speeds of the wheels in all pieces, and the residuals of their angles."""
    figure = Figure(figsize=(style.WIDTH_IN, 5.0), layout='constrained')
    speeds, residuals = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for estimate in estimates:
        colour = LINK_COLOURS[estimate.wheel]
        for number, piece in enumerate(estimate.pieces):
            label = FLYWHEEL_NAMES[estimate.wheel] if number == 0 else None
            speeds.plot(*thin_out(piece.times, piece.speeds, POINTS), color=colour, label=label)
            _scatter(residuals, piece.times, piece.residuals, colour)
    speeds.set_ylabel('wheel speed [rad/s]')
    speeds.set_title('Spin-ups and coast-downs that were fitted')
    residuals.set_ylabel('wheel and link angle,\nresidual [deg]')
    residuals.set_title(f'What is left; lines: mean of {AVERAGED} samples')
    residuals.set_xlabel('time [s]')
    style.legend_above(speeds)
    return figure


def links_figure(estimate: LinkEstimate) -> Figure:
    """Draw measured and simulated link angles, and what is left."""
    figure = Figure(figsize=(style.WIDTH_IN, 5.6), layout='constrained')
    angles, residuals = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for link, (times, measured, left) in enumerate(estimate.residuals):
        order = np.argsort(times)
        angles.plot(times[order], np.degrees(measured - left)[order], color=LINK_COLOURS[link],
                    linestyle=LINK_DASHES[link], label=LINK_NAMES[link])
        _scatter(residuals, times[order], left[order], LINK_COLOURS[link])
    angles.set_ylabel('link orientation [deg]')
    angles.set_title('Simulated with the calibrated linkage')
    residuals.set_ylabel('measured minus\nsimulated [deg]')
    residuals.set_title(f'What is left; lines: mean of {AVERAGED} samples')
    residuals.set_xlabel('time [s]')
    style.legend_above(angles)
    return figure


def _scatter(axes: Axes, times: Floats, values: Floats, colour: str) -> None:
    degrees = np.degrees(values)
    axes.plot(*thin_out(times, degrees, POINTS), '.', color=colour, markersize=1.5, alpha=0.4)
    groups = len(times) // AVERAGED
    if groups > 1:
        means = [part[:groups * AVERAGED].reshape(groups, AVERAGED).mean(axis=1)
                 for part in (times, degrees)]
        axes.plot(*means, color=colour, linewidth=1.0)
