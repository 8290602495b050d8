# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The figure of the study of sizes: wheels, energy, link lengths, motors."""

from __future__ import annotations

from collections.abc import Sequence
import io

from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS
from fourbar_ros.studies.design import (
    Design,
    MANOEUVRES,
    RATIOS,
    SAID,
    SPEED_SHARE,
)
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
import numpy as np

DPI = 120
CURVES = dict(zip(MANOEUVRES, (COLOURS['link_a'], COLOURS['link_b'])))


def png(sizes: Sequence[Design], ratios: Sequence[Design], present: Design, answer: Design
        ) -> bytes:
    """Draw what wheels of a size, links of a ratio and motors of a constant take."""
    with rc_context(style.RC):
        figure = Figure(figsize=(style.WIDTH_IN, 6.4), layout='constrained')
        panels = figure.subplots(2, 2)
        _speeds(panels[0, 0], sizes, present, answer)
        _energies(panels[0, 1], sizes, present, answer)
        _ratios(panels[1, 0], ratios)
        _heat(panels[1, 1], present)
        buffer = io.BytesIO()
        figure.savefig(buffer, format='png', dpi=DPI, facecolor=COLOURS['paper'])
        return buffer.getvalue()


def _inertias(designs: Sequence[Design]) -> list[float]:
    return [float(design.mechanism.flywheel_inertias[0]) for design in designs]


def _mark(axes: Axes, present: Design, answer: Design) -> None:
    for design, text in ((present, 'prototype'), (answer, 'least')):
        axes.axvline(_inertias([design])[0], color=COLOURS['muted'], linewidth=0.8,
                     linestyle=(0, (4, 3)))
        axes.annotate(text, (_inertias([design])[0], 0.02), (3, 0), rotation=90,
                      xycoords=('data', 'axes fraction'), textcoords='offset points',
                      color=COLOURS['muted'], fontsize=8.0)
    axes.set(xscale='log', xlabel='wheel inertia [kg m²]')


def _speeds(axes: Axes, sizes: Sequence[Design], present: Design, answer: Design) -> None:
    for name, colour in CURVES.items():
        axes.plot(_inertias(sizes), [np.abs(design.spendings[name].motor_speeds).max()
                                     for design in sizes], color=colour, label=SAID[name])
    limit = float(present.mechanism.motor_speed_limits.min())
    axes.axhline(SPEED_SHARE * limit, color=COLOURS['limit'], linewidth=0.9,
                 label=f'{100 * SPEED_SHARE:g} % of {limit:g} rad/s')
    axes.set_yscale('log')
    axes.set_ylabel('peak wheel speed [rad/s]')
    axes.set_title('a. Smaller wheels turn faster')
    axes.legend(loc='upper right')
    _mark(axes, present, answer)


def _energies(axes: Axes, sizes: Sequence[Design], present: Design, answer: Design) -> None:
    for name, colour in CURVES.items():
        axes.plot(_inertias(sizes), [design.spendings[name].drawn[-1] for design in sizes],
                  color=colour, label=SAID[name])
    axes.set_yscale('log')
    axes.set_ylabel('energy drawn [J]')
    axes.set_title('b. ... and cost more, until their mass does')
    mass = axes.twinx()
    mass.plot(_inertias(sizes), [design.mass for design in sizes], color=COLOURS['muted'],
              linestyle=(0, (1, 1.5)), label='mass of the whole (right)')
    mass.set_ylabel('mass [kg]')
    mass.set_ylim(0.0, None)
    mass.grid(visible=False)
    lines = [*axes.get_lines(), *mass.get_lines()]
    axes.legend(lines, [str(line.get_label()) for line in lines], loc='upper center')
    _mark(axes, present, answer)


def _ratios(axes: Axes, ratios: Sequence[Design]) -> None:
    for name, colour in CURVES.items():
        drawn = np.array([design.spendings[name].drawn[-1] for design in ratios])
        axes.plot(RATIOS, drawn, color=colour, label=SAID[name])
        best = int(np.argmin(drawn))
        axes.plot(RATIOS[best], drawn[best], 'o', markersize=4.5, color=colour)
    axes.set(xscale='log', xlabel='length of a, c / length of b, d (same circumference)',
             ylabel='energy drawn [J]')
    axes.xaxis.set_major_locator(FixedLocator([0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 2.5]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter('{x:g}')
    axes.set_title('c. The rhombus turns best; what turns alone is better short')
    axes.legend(loc='upper center')


def _heat(axes: Axes, present: Design) -> None:
    mechanism = present.mechanism
    own = float(mechanism.motor_torque_constants[0] / np.sqrt(mechanism.motor_resistances[0]))
    constants = np.geomspace(0.003, 0.1, 50)
    for name, spending in present.spendings.items():
        heat = float(spending.copper[-1]) * own ** 2
        axes.plot(constants, heat / constants ** 2, color=CURVES[name], label=SAID[name])
    axes.axvline(own, color=COLOURS['muted'], linewidth=0.8, linestyle=(0, (4, 3)))
    axes.annotate('prototype', (own, 0.02), (3, 0), rotation=90, fontsize=8.0,
                  xycoords=('data', 'axes fraction'), textcoords='offset points',
                  color=COLOURS['muted'])
    axes.set(xscale='log', yscale='log', xlabel='motor constant [N m/√W]',
             ylabel='heat in the windings [J]')
    axes.set_title('d. Motors: heat of four')
    axes.legend(loc='upper right')
