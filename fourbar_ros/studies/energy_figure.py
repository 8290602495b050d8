# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The figure of the energy study: Fig. 4 of the paper, and where its rule is not the best."""

from __future__ import annotations

from collections.abc import Mapping
import io

from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS, LINK_DASHES
from fourbar_ros.studies.actuation_cost import Spending
from fourbar_ros.studies.energy import balanced_speeds, BALANCING, least_energy
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

TWO, FOUR, LEAST = COLOURS['link_b'], COLOURS['link_a'], COLOURS['muted']
DPI = 120


def png(found: Mapping[str, Mapping[str, Spending]]) -> bytes:
    """Draw energies over time."""
    with rc_context(style.RC):
        figure = Figure(figsize=(style.WIDTH_IN, 6.4), layout='constrained')
        panels = figure.subplots(2, 2)
        _energies(panels[0, 0], found['whole'])
        _sums(panels[0, 1], found)
        _unequal(panels[1, 0], found['unequal_wheels'])
        _off_balance(panels[1, 1], found['off_balance'])
        for axes in panels.flat:
            axes.set_xlabel('time [s]')
        buffer = io.BytesIO()
        figure.savefig(buffer, format='png', dpi=DPI, facecolor=COLOURS['paper'])
        return buffer.getvalue()


def _energies(axes: Axes, laws: Mapping[str, Spending]) -> None:
    for law, label, colour in (('two_wheels', 'two wheels', TWO),
                               ('four_wheels', 'four wheels', FOUR)):
        axes.plot(laws[law].times, laws[law].energy * 1e3, color=colour, label=label)
    axes.set_title('a. Kinetic energy of the wheels (eq. 7), the whole turns')
    axes.set_ylabel('energy [mJ]')
    axes.legend(loc='upper left')


def _sums(axes: Axes, found: Mapping[str, Mapping[str, Spending]]) -> None:
    for name, label, dashes in (('whole', 'the whole turns', '-'),
                                ('configuration', 'b and d turn', (0, (4, 3)))):
        for law, wheels, colour in (('two_wheels', 'two', TWO), ('four_wheels', 'four', FOUR)):
            spending = found[name][law]
            axes.plot(spending.times, spending.eq9 * 1e3, color=colour, linestyle=dashes,
                      label=f'{wheels} wheels, {label}')
    axes.set_title('b. Cumulative "power" as eq. 9 is printed')
    axes.set_ylabel('eq. 9 [mJ s]')
    axes.legend(loc='upper left')


def _unequal(axes: Axes, laws: Mapping[str, Spending]) -> None:
    spending, balanced = laws['min_norm'], balanced_speeds(laws['min_norm'])
    for wheel, letter in enumerate('abcd'):
        axes.plot(spending.times, spending.speeds[:, wheel], color=LINK_COLOURS[wheel],
                  linestyle=LINK_DASHES[wheel], label=f'wheel {letter}')
    for pair, label in ((0, 'least energy: equal speeds in each pair'), (1, None)):
        axes.plot(spending.times, balanced[:, pair], color=LEAST, linewidth=3.5, alpha=0.35,
                  label=label, zorder=1)
    axes.set_title('c. Unequal wheels by eq. 8: in each pair the larger is the faster')
    axes.set_ylabel('absolute speed [rad/s]')
    axes.set_ylim(1.5 * axes.get_ylim()[0], 5.0)
    axes.legend(loc='lower left', ncols=2)


def _off_balance(axes: Axes, laws: Mapping[str, Spending]) -> None:
    times = laws['min_norm'].times
    axes.plot(times, laws['min_norm'].energy * 1e3, color=TWO, label='eq. 8: differences stay')
    axes.plot(times, laws['balancing'].energy * 1e3, color=FOUR,
              label=f'balancing at {BALANCING:g} rad/s')
    axes.plot(times, least_energy(laws['min_norm']) * 1e3, color=LEAST, linewidth=3.5, alpha=0.35,
              label='least energy', zorder=1)
    axes.set_title('d. Wheels a and c turn against each other beforehand')
    axes.set_ylabel('energy [mJ]')
    axes.set_ylim(0.0, axes.get_ylim()[1] * 1.3)
    axes.legend(loc='upper right')
