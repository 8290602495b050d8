# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Figure of the collapsed linkage: closure, stiffness, generalized forces, ranks, and parking."""

from __future__ import annotations

from collections.abc import Mapping

from fourbar_ros.mechanism.constants import Array
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, LINK_COLOURS
from fourbar_ros.studies.crossing_runs import CrossingOutcome, STIFFNESS
from fourbar_ros.studies.singularity_model import (
    DRIVES,
    joint_motor,
    LOCKS,
    MODES,
    PARKING,
    RANKS,
    TITLES,
    wheel_motor,
)
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Arc
import numpy as np

JOINTS, WHEELS = LINK_COLOURS[1], LINK_COLOURS[0]


@style.as_png
def png(numbers: Mapping[str, Array], parked: Mapping[str, CrossingOutcome]) -> Figure:
    """Draw the locked linkage, stiffness, closure, generalized forces, ranks, and parking."""
    figure, panels = style.panels(7.0, 2, 3)
    _sketch(panels[0, 0])
    _closure(panels[0, 1], numbers)
    _stiffness(panels[0, 2], numbers)
    _forces(panels[1, 0])
    _ranks(panels[1, 1])
    _parking(panels[1, 2], parked)
    return figure


def _sketch(axes: Axes) -> None:
    """Draw the linkage with joint 1 locked, open and collapsed, where c and d are free to turn."""
    axes.set_aspect('equal')
    axes.axis('off')
    for low, theta, ghosts, text in (
            (1.55, 40.0, (), r'$\theta$ = 40°: nothing moves'),
            (0.0, 4.0, (25.0, 50.0), r'$\theta$ = 0: c and d are free to turn')):
        base = np.array([0.0, low])
        first, second = (np.array([np.cos(angle), np.sin(angle)])
                         for angle in (0.0, np.radians(theta)))
        for eta in ghosts:
            turned = np.array([np.cos(np.radians(eta)), np.sin(np.radians(eta))])
            for offset in (0.0, 0.04):
                axes.plot(*np.array([base + first + [0.0, offset],
                                     base + first + [0.0, offset] + turned]).T,
                          color=LINK_COLOURS[2 if offset else 3], alpha=0.3, linewidth=2.5)
        for link, (near, far) in enumerate(((0.0 * first, first), (0.0 * first, second),
                                            (second, first + second), (first, first + second))):
            axes.plot(*np.array([base + near, base + far]).T, color=LINK_COLOURS[link],
                      linewidth=3.0)
        for place in (0.0 * first, first, second, first + second):
            axes.plot(*(base + place), 'o', color=COLOURS['ink'], markersize=4.5, zorder=5)
        axes.plot(*base, 's', color=COLOURS['limit'], markersize=9.0, zorder=6)
        axes.annotate(text, (1.0, low - 0.22), va='center', ha='center')
    axes.add_patch(Arc((1.0, 0.02), 1.5, 1.5, theta1=6.0, theta2=55.0, color=COLOURS['ink'],
                       linewidth=1.0, linestyle=(0, (3, 2))))
    axes.annotate(r'$\eta$', (1.8, 0.36), fontsize=12.0)
    for letter, colour, place in zip('abcd', LINK_COLOURS, (
            (0.5, 1.47), (0.3, 1.95), (1.35, 2.3), (1.52, 1.8))):
        axes.annotate(letter, place, ha='center', va='center', color=colour, fontweight='bold')
    axes.set(xlim=(-0.3, 2.3), ylim=(-0.35, 2.4))
    axes.set_title('a. Input joint (red) locked')


def _closure(axes: Axes, numbers: Mapping[str, Array]) -> None:
    theta = numbers['theta_deg']
    length = float(numbers['closure_larger_m'].max()) / 2.0
    for name, label, colour in (
            ('closure_larger_m', 'closure J, larger', COLOURS['muted']),
            ('closure_smaller_m', 'closure J, smaller', JOINTS)):
        axes.plot(theta, numbers[name] / length, color=colour, label=label)
    axes.plot(theta, numbers['wheel_map_smaller'], color=WHEELS,
              label='wheels to axes, both')
    axes.plot(theta, numbers['opposite_wheels_on_eta'], color=WHEELS, linestyle=(0, (4, 3)),
              label=r'opposite wheels to $\eta$')
    axes.plot(theta, numbers['joint_1_on_eta'], color=JOINTS, linestyle=(0, (4, 3)),
              label=r'motor in joint 1 to $\eta$')
    axes.set(xlabel=r'$\theta$ [deg]', ylabel='singular value, J per link length',
             ylim=(-0.08, 3.6))
    axes.set_title('b. The closure loses rank, wheels do not')
    axes.legend(loc='upper left', fontsize=8.0)


def _stiffness(axes: Axes, numbers: Mapping[str, Array]) -> None:
    theta = numbers['theta_deg']
    least = 1e-3
    axes.plot(theta, np.maximum(numbers['output_stiffness_n_m_rad'], least / 10.0), color=JOINTS,
              label=f'joint 1 locked, joints of {STIFFNESS:.0e} N/m'.replace('e+0', 'e'))
    held = numbers['held_stiffness_n_m_rad']
    axes.plot(theta[held > 0.0], held[held > 0.0], color=WHEELS,
              label=r'four wheels, $\eta$ fed back')
    axes.set(yscale='log', xlabel=r'$\theta$ [deg]', ylabel=r'stiffness against $\eta$ [N m/rad]',
             ylim=(least, 3e4))
    axes.set_title('c. What holds c and d')
    axes.legend(loc='upper center', fontsize=8.0)


def _forces(axes: Axes) -> None:
    motors = {**{f'joint {joint + 1}': joint_motor(joint) for joint in range(4)},
              **{f'wheel {"abcd"[wheel]}': wheel_motor(wheel) for wheel in range(4)}}
    table = np.array([MODES.T @ torques for torques in motors.values()])
    colours = LinearSegmentedColormap.from_list(
        'forces', [LINK_COLOURS[1], COLOURS['tile'], LINK_COLOURS[0]])
    axes.pcolormesh(np.arange(4) - 0.5, np.arange(9) - 0.5, table, cmap=colours, vmin=-1.2,
                    vmax=1.2, edgecolors=COLOURS['paper'], linewidth=2.0)
    for row, values in enumerate(table):
        for column, value in enumerate(values):
            axes.annotate(f'{value + 0.0:g}'.replace('-', '\N{MINUS SIGN}'), (column, row),
                          ha='center', va='center', fontsize=8.5,
                          color=COLOURS['paper' if abs(value) > 0.7 else 'ink'])
    axes.set_yticks(range(8), list(motors))
    axes.set_xticks(range(3), [r'$\phi_a$', r'$\phi_b$', r'$\eta$'])
    axes.set_ylim(7.5, -0.5)
    axes.grid(visible=False)
    axes.set_title(r'd. Force of 1 N m at $\theta = 0$')


def _ranks(axes: Axes) -> None:
    existing = LOCKS[()][0]
    for row, name in enumerate(DRIVES):
        colour = WHEELS if 'wheel' in name else JOINTS
        axes.barh(row, existing, color=COLOURS['tile'], height=0.66)
        axes.barh(row, RANKS[name][0], color=colour, height=0.66)
        axes.annotate(f'{RANKS[name][0]} of {existing}', (RANKS[name][0] - 0.08, row), ha='right',
                      va='center', color=COLOURS['paper'], fontsize=8.5, fontweight='bold')
    axes.set_yticks(range(len(DRIVES)), [TITLES[name] for name in DRIVES])
    axes.invert_yaxis()
    axes.set_xticks(range(existing + 1))
    axes.set_xlabel('motions')
    axes.set_title(r'e. Motions that are driven at $\theta = 0$')
    axes.grid(axis='y', visible=False)


def _parking(axes: Axes, parked: Mapping[str, CrossingOutcome]) -> None:
    for method, label, colour in (('two', 'two wheels', JOINTS),
                                  ('four_held', r'four, $\eta$ fed back', WHEELS)):
        eta = np.abs(np.degrees(parked[method].path[:, 1]))
        axes.plot(np.linspace(0.0, PARKING.duration, len(eta)), np.maximum(eta, 1e-6),
                  color=colour, label=label)
    axes.set(yscale='log', xlabel='time [s]', ylabel=r'$|\eta|$ [deg]', ylim=(1e-5, 1e3))
    axes.axvspan(4.5, PARKING.duration, color=COLOURS['tile'], zorder=0)
    axes.annotate(r'parked at $\theta = 0$', (7.0, 2e-5), ha='center', color=COLOURS['muted'],
                  fontsize=8.5)
    axes.set_title('f. Closed loop, joints that give')
    axes.legend(loc='upper left')
