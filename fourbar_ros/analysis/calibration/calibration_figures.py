# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figures of a calibration: measured and fitted motion, and residuals."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_ros.analysis.bags import Floats
from fourbar_ros.analysis.calibration.link_identification import LinkEstimate
from fourbar_ros.analysis.calibration.wheel_identification import WheelEstimate
from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import LINK_COLOURS, LINK_DASHES, thin_out
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

POINTS = 600
# Samples per averaged residual; averages show errors below the noise.
AVERAGED = 25


def wheels_figure(estimates: Sequence[WheelEstimate]) -> Figure:
    """Draw the speeds of the wheels in all segments, and the residuals of their angles."""
    figure, speeds, residuals = _panels(5.0)
    for estimate in estimates:
        colour = LINK_COLOURS[estimate.wheel]
        for number, segment in enumerate(estimate.segments):
            label = FLYWHEEL_NAMES[estimate.wheel] if number == 0 else None
            speeds.plot(*thin_out(segment.times, segment.speeds, POINTS), color=colour,
                        label=label)
            _plot_residuals(residuals, segment.times, segment.residuals, colour)
    speeds.set_ylabel('wheel speed [rad/s]')
    speeds.set_title('Fitted spin-ups and coast-downs')
    residuals.set_ylabel('wheel and link angle,\nresidual [deg]')
    style.legend_above(speeds)
    return figure


def links_figure(estimate: LinkEstimate) -> Figure:
    """Draw simulated link angles, and the residuals."""
    figure, angles, residuals = _panels(5.6)
    for link, (times, measured, left) in enumerate(estimate.residuals):
        order = np.argsort(times)
        angles.plot(times[order], np.degrees(measured - left)[order], color=LINK_COLOURS[link],
                    linestyle=LINK_DASHES[link], label=LINK_NAMES[link])
        _plot_residuals(residuals, times[order], left[order], LINK_COLOURS[link])
    angles.set_ylabel('link orientation [deg]')
    angles.set_title('Simulation with the calibrated linkage')
    residuals.set_ylabel('measured minus\nsimulated [deg]')
    style.legend_above(angles)
    return figure


def _panels(height_in: float) -> tuple[Figure, Axes, Axes]:
    figure, (above, below) = style.panels(height_in, 2, 1, sharex=True, height_ratios=(3, 2))
    below.set_title(f'Residuals; lines: mean of {AVERAGED} samples')
    below.set_xlabel('time [s]')
    return figure, above, below


def _plot_residuals(axes: Axes, times: Floats, values: Floats, colour: str) -> None:
    degrees = np.degrees(values)
    axes.plot(*thin_out(times, degrees, POINTS), '.', color=colour, markersize=1.5, alpha=0.4)
    groups = len(times) // AVERAGED
    if groups > 1:
        means = [part[:groups * AVERAGED].reshape(groups, AVERAGED).mean(axis=1)
                 for part in (times, degrees)]
        axes.plot(*means, color=colour, linewidth=1.0)
