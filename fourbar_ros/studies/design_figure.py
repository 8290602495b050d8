# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of the design study: wheels, energy, link lengths, motors."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS
from fourbar_ros.studies.design_model import Design, MANOEUVRES, SPEED_SHARE, TITLES
from fourbar_ros.studies.planned_cost import peak
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
import numpy as np

CURVES = dict(zip(MANOEUVRES, (COLOURS['link_a'], COLOURS['link_b'])))


@style.as_png
def png(sizes: Sequence[Design], ratios: Sequence[Design], present: Design, least: Design
        ) -> Figure:
    """Draw the demands over wheel inertia, ratio of lengths and motor constant."""
    figure, panels = style.panels(6.4, 2, 2)
    _speeds(panels[0, 0], sizes, present)
    _energies(panels[0, 1], sizes)
    for axes in panels[0]:
        for design, text in ((present, 'prototype'), (least, 'least')):
            _mark(axes, design.inertia, text)
        axes.set(xscale='log', xlabel='wheel inertia [kg m²]')
    _ratios(panels[1, 0], ratios)
    _heat(panels[1, 1], present)
    return figure


def _mark(axes: Axes, value: float, text: str) -> None:
    axes.axvline(value, color=COLOURS['muted'], linewidth=0.8, linestyle=(0, (4, 3)))
    axes.annotate(text, (value, 0.02), (3, 0), rotation=90, xycoords=('data', 'axes fraction'),
                  textcoords='offset points', color=COLOURS['muted'], fontsize=8.0)


def _speeds(axes: Axes, sizes: Sequence[Design], present: Design) -> None:
    for name, colour in CURVES.items():
        axes.plot([design.inertia for design in sizes],
                  [peak(design.costs[name].motor_speeds) for design in sizes], color=colour,
                  label=TITLES[name])
    limit = float(present.mechanism.motor_speed_limits.min())
    axes.axhline(SPEED_SHARE * limit, color=COLOURS['limit'], linewidth=0.9,
                 label=f'{100 * SPEED_SHARE:g} % of {limit:g} rad/s')
    axes.set_yscale('log')
    axes.set_ylabel('peak wheel speed [rad/s]')
    axes.set_title('a. Smaller wheels turn faster')
    axes.legend(loc='upper right')


def _energies(axes: Axes, sizes: Sequence[Design]) -> None:
    inertias = [design.inertia for design in sizes]
    for name, colour in CURVES.items():
        axes.plot(inertias, [design.costs[name].energy_drawn[-1] for design in sizes],
                  color=colour, label=TITLES[name])
    axes.set_yscale('log')
    axes.set_ylabel('energy drawn [J]')
    axes.set_title('b. ... and cost more, until their mass does')
    mass = axes.twinx()
    mass.plot(inertias, [design.mass for design in sizes], color=COLOURS['muted'],
              linestyle=(0, (1, 1.5)), label='mass of the whole (right)')
    mass.set_ylabel('mass [kg]')
    mass.set_ylim(0.0, None)
    mass.grid(visible=False)
    lines = [*axes.get_lines(), *mass.get_lines()]
    axes.legend(lines, [str(line.get_label()) for line in lines], loc='upper center')


def _ratios(axes: Axes, ratios: Sequence[Design]) -> None:
    lengths = [design.length_ratio for design in ratios]
    for name, colour in CURVES.items():
        drawn = np.array([design.costs[name].energy_drawn[-1] for design in ratios])
        axes.plot(lengths, drawn, color=colour, label=TITLES[name])
        best = int(np.argmin(drawn))
        axes.plot(lengths[best], drawn[best], 'o', markersize=4.5, color=colour)
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
    for name, cost in present.costs.items():
        axes.plot(constants, float(cost.copper_loss[-1]) * own ** 2 / constants ** 2,
                  color=CURVES[name], label=TITLES[name])
    _mark(axes, own, 'prototype')
    axes.set(xscale='log', yscale='log', xlabel='motor constant [N m/√W]',
             ylabel='heat in the windings [J]')
    axes.set_title('d. Motors: heat of four')
    axes.legend(loc='upper right')
