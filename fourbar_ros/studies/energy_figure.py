# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of the energy study: Fig. 4 of the paper, and the cases where eq. 8 is not the best."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS, LINK_DASHES
from fourbar_ros.studies.planned_cost import ActuationCost
from matplotlib.axes import Axes
from matplotlib.figure import Figure

TWO, FOUR, LEAST = COLOURS['link_b'], COLOURS['link_a'], COLOURS['muted']
# A wide, light line that stays visible below curves that coincide with it.
WIDE: Mapping[str, Any] = {'linewidth': 3.5, 'alpha': 0.35, 'zorder': 1}


@style.as_png
def png(costs: Mapping[str, Mapping[str, ActuationCost]], balancing: float) -> Figure:
    """
    Draw energies and wheel speeds over time.

    :param balancing: rate at which the differences of speeds decay [1/s].
    """
    figure, panels = style.panels(6.4, 2, 2)
    _energies(panels[0, 0], costs['whole'])
    _sums(panels[0, 1], costs)
    _unequal(panels[1, 0], costs['unequal_wheels']['min_norm'])
    _off_balance(panels[1, 1], costs['off_balance'], balancing)
    for axes in panels.flat:
        axes.set_xlabel('time [s]')
    return figure


def _energies(axes: Axes, laws: Mapping[str, ActuationCost]) -> None:
    for law, label, colour in (('two_wheels', 'two wheels', TWO),
                               ('four_wheels', 'four wheels', FOUR)):
        axes.plot(laws[law].times, laws[law].energy * 1e3, color=colour, label=label)
    axes.set_title('a. Kinetic energy of the wheels (eq. 7), the whole turns')
    axes.set_ylabel('energy [mJ]')
    axes.legend(loc='upper left')


def _sums(axes: Axes, costs: Mapping[str, Mapping[str, ActuationCost]]) -> None:
    for name, label, dashes in (('whole', 'the whole turns', '-'),
                                ('configuration', 'b and d turn', (0, (4, 3)))):
        for law, wheels, colour in (('two_wheels', 'two', TWO), ('four_wheels', 'four', FOUR)):
            axes.plot(costs[name][law].times, costs[name][law].eq9 * 1e3, color=colour,
                      linestyle=dashes, label=f'{wheels} wheels, {label}')
    axes.set_title('b. Cumulative "power" as eq. 9 is printed')
    axes.set_ylabel('eq. 9 [mJ s]')
    axes.legend(loc='upper left')


def _unequal(axes: Axes, cost: ActuationCost) -> None:
    for wheel, letter in enumerate('abcd'):
        axes.plot(cost.times, cost.speeds[:, wheel], color=LINK_COLOURS[wheel],
                  linestyle=LINK_DASHES[wheel], label=f'wheel {letter}')
    for pair, label in ((0, 'least energy: equal speeds in each pair'), (1, None)):
        axes.plot(cost.times, cost.balanced_speeds[:, pair], color=LEAST, label=label, **WIDE)
    axes.set_title('c. Unequal wheels by eq. 8: in each pair the larger is the faster')
    axes.set_ylabel('absolute speed [rad/s]')
    axes.set_ylim(1.5 * axes.get_ylim()[0], 5.0)
    axes.legend(loc='lower left', ncols=2)


def _off_balance(axes: Axes, laws: Mapping[str, ActuationCost], balancing: float) -> None:
    by_eq8 = laws['min_norm']
    axes.plot(by_eq8.times, by_eq8.energy * 1e3, color=TWO, label='eq. 8: differences stay')
    axes.plot(by_eq8.times, laws['balancing'].energy * 1e3, color=FOUR,
              label=f'balancing at {balancing:g} rad/s')
    axes.plot(by_eq8.times, by_eq8.least_energy * 1e3, color=LEAST, label='least energy', **WIDE)
    axes.set_title('d. Wheels a and c turn against each other beforehand')
    axes.set_ylabel('energy [mJ]')
    axes.set_ylim(0.0, axes.get_ylim()[1] * 1.3)
    axes.legend(loc='upper right')
