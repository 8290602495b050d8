# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The figures of a report. Each takes a View and raises BagError when the bag lacks its data.

Angles are shown in degrees, all else in SI units; time is that since the setpoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fourbar_ros.analysis.bags import BagError, Floats, JointSeries, Nanoseconds, Recording
from fourbar_ros.analysis.manoeuvre import Motion, pair, Paired
from fourbar_ros.analysis.metrics import flywheel_energy
from fourbar_ros.common import names
from fourbar_ros.mechanism import (
    com_positions_in_table,
    FLYWHEEL_NAMES,
    joint_positions,
    LINK_NAMES,
    Mechanism,
)
from fourbar_ros.mechanism.angles import wrap_angles
from fourbar_ros.plotting import style
from fourbar_ros.plotting.style import COLOURS, decimate, LINK_COLOURS, LINK_DASHES
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
import numpy as np

LETTERS = 'abcd'
INSTANTS = 7
# What there is to see before the setpoint: that the loop was at rest.
LEAD_S = 0.5
# Half the width of the close-up of the angles.
MAGNIFIED_NS = 100_000_000
MAGNIFY_FROM_RAD = np.radians(5.0)
NIS_WINDOW_S = 1.0
NIS_BAND = (0.025, 0.975)


@dataclass(frozen=True)
class View:
    """A recording and what it is looked at with."""

    recording: Recording
    motion: Motion
    mechanism: Mechanism | None

    def series(self, name: str) -> JointSeries:
        """Return a topic from just before the setpoint to the end of the recording."""
        series = self.recording.joint_states(name)
        shown = series.rows(series.stamp_ns >= self.motion.start_ns - round(LEAD_S * 1e9))
        if not len(shown):
            raise BagError(f'no message on {series.topic} since the setpoint')
        return shown

    def seconds(self, stamp_ns: Nanoseconds) -> Floats:
        """Return the time since the setpoint [s]."""
        return self.motion.seconds(stamp_ns)

    def links(self) -> JointSeries:
        """Return the ground truth of the links if the bag has it, else the estimate."""
        truth = self.recording.has(names.SIM_LINK_STATES)
        return self.series(names.SIM_LINK_STATES if truth else names.ESTIMATE_LINK_STATES)

    def mark_step(self, axes: Axes) -> None:
        """Mark where the step begins and ends."""
        for moment in self.seconds(np.array([self.motion.start_ns, self.motion.step_end_ns])):
            axes.axvline(moment, color=COLOURS['muted'], linewidth=0.8, linestyle=(0, (1, 2)))


def linkage(view: View) -> Figure:
    """Draw the linkage at a few instants, the mass centre of the whole at the origin."""
    if view.mechanism is None:
        raise BagError('the mechanism of this recording is unknown: give --mechanism')
    links = view.links().select(LINK_NAMES)
    last_ns = min(view.motion.step_end_ns, view.motion.end_ns)
    wanted = np.linspace(view.motion.start_ns, last_ns, INSTANTS).astype(np.int64)
    rows = np.clip(np.searchsorted(links.stamp_ns, wanted), 0, len(links) - 1)
    poses = links.rows(rows)
    if np.any(np.isnan(poses.position)):
        raise BagError('the link angles leave out a link')
    speeds = _absolute_speeds(view, links)[rows]
    fastest = float(np.nanmax(np.abs(speeds), initial=0.0)) if len(speeds) else 0.0
    reach = 1.06 * float(np.max(np.linalg.norm(joint_positions(
        view.mechanism, np.vstack([poses.position, view.motion.goal])), axis=-1)))

    figure = Figure(figsize=(style.WIDTH_IN, 1.75),
                    layout=ConstrainedLayoutEngine(w_pad=0.0, h_pad=0.02, wspace=0.0))
    for index, axes in enumerate(figure.subplots(1, INSTANTS, sharex=True, sharey=True)):
        axes.set_axis_off()
        axes.set_aspect('equal')
        axes.set_xlim(-reach, reach)
        axes.set_ylim(-reach, reach)
        _draw_outline(axes, view.mechanism, view.motion.goal)
        _draw_pose(axes, view.mechanism, poses.position[index], speeds[index] / (fastest or 1.0))
        name = {0: 'start', INSTANTS - 1: 'end of step'}.get(index, '')
        axes.set_title(f'{float(view.seconds(poses.stamp_ns[index])):.1f} s  {name}', loc='center',
                       fontweight='bold' if name else 'normal',
                       color=COLOURS['ink' if name else 'muted'])
    return figure


def _absolute_speeds(view: View, links: JointSeries) -> Floats:
    """Return absolute wheel speeds at the stamps of links (n, 4), NaN where unknown."""
    source = names.SIM_FLYWHEEL_STATES if view.recording.has(names.SIM_FLYWHEEL_STATES) else (
        names.FLYWHEEL_STATES)
    wheels = view.series(source).select(FLYWHEEL_NAMES)
    speeds = np.full((len(links), 4), np.nan)
    _, in_links, in_wheels = np.intersect1d(links.stamp_ns, wheels.stamp_ns, return_indices=True)
    speeds[in_links] = links.velocity[in_links] + wheels.velocity[in_wheels]
    return speeds


def _draw_outline(axes: Axes, mechanism: Mechanism, angles: Floats) -> None:
    if np.all(np.isfinite(angles)):
        corners = joint_positions(mechanism, angles)[[0, 1, 2, 3, 0]]
        axes.plot(*corners.T, color=COLOURS['muted'], linewidth=1.0, linestyle=(0, (2, 2)))


def _draw_pose(axes: Axes, mechanism: Mechanism, angles: Floats, speeds: Floats) -> None:
    joints = joint_positions(mechanism, angles)
    centres = com_positions_in_table(mechanism, angles)
    radius = 0.13 * float(np.min(mechanism.link_lengths))
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    axes.plot(0.0, 0.0, marker='+', color=COLOURS['muted'], markersize=7)
    for link, (near, far) in enumerate(((0, 3), (0, 1), (1, 2), (3, 2))):
        colour = LINK_COLOURS[link]
        axes.plot(*joints[[near, far]].T, color=colour, linewidth=3.2, alpha=0.75)
        axes.fill(*(centres[link] + circle).T, facecolor=COLOURS['paper'], edgecolor=colour,
                  linewidth=0.8, zorder=3)
        if np.isfinite(speeds[link]):
            arc = np.pi / 2 + np.linspace(0.0, 1.8 * np.pi * speeds[link], 40)
            path = centres[link] + radius * np.stack([np.cos(arc), np.sin(arc)], axis=1)
            axes.plot(*path.T, color=colour, linewidth=2.6, solid_capstyle='butt', zorder=4)
        x, y = centres[link]
        axes.text(x, y, LETTERS[link], color=colour, fontweight='bold', fontsize=7.5,
                  ha='center', va='center_baseline', zorder=5)
    axes.plot(*joints.T, linestyle='none', marker='o', markersize=4.2, color=COLOURS['paper'],
              markeredgecolor=COLOURS['ink'], markeredgewidth=1.0, zorder=5)


def angles(view: View) -> Figure:
    """Plot the angle of each link: goal, reference, truth, estimate, raw samples."""
    figure = Figure(figsize=(style.WIDTH_IN, 5.0), layout='constrained')
    panels = figure.subplots(2, 2, sharex=True).ravel()
    reference = view.series(names.REFERENCE).select(LINK_NAMES)
    curves = [('estimate', view.series(names.ESTIMATE_LINK_STATES),
               {'linewidth': 1.3, 'color': COLOURS['ink']}),
              ('reference', reference, {'linewidth': 1.3, 'linestyle': (0, (3, 3))})]
    if view.recording.has(names.SIM_LINK_STATES):
        curves.insert(0, ('ground truth', view.series(names.SIM_LINK_STATES),
                          {'linewidth': 5.0, 'alpha': 0.4}))
    for link, axes in enumerate(panels):
        shown = {'color': LINK_COLOURS[link]}
        _raw_samples(view, axes, link, reference)
        for label, series, look in curves:
            time, angle = decimate(view.seconds(series.stamp_ns), np.degrees(
                series.select(LINK_NAMES).position[:, link]))
            axes.plot(time, angle, label=label, **{**shown, **look})
        _goal_line(view, axes, link, reference)
        _magnify(view, axes, link, curves, reference)
        view.mark_step(axes)
        axes.set_title(f'link {LETTERS[link]}', color=LINK_COLOURS[link], fontweight='bold')
        axes.set_ylabel('angle [deg]' if link % 2 == 0 else '')
        axes.set_xlabel('time since setpoint [s]' if link > 1 else '')
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper right', ncols=len(labels), markerscale=3.0)
    return figure


def _magnify(view: View, axes: Axes, link: int, curves: list[tuple[str, JointSeries, Any]],
             reference: JointSeries) -> None:
    """Show the middle of the step close up: on the scale of the motion all curves are one."""
    middle_ns = (view.motion.start_ns + view.motion.step_end_ns) // 2
    turn = float(view.motion.goal[link] - view.motion.initial[link])
    if view.motion.end_ns <= middle_ns + MAGNIFIED_NS or abs(turn) < MAGNIFY_FROM_RAD:
        return
    # In the corner that the curve leaves free.
    inset = axes.inset_axes((0.60, 0.12 if turn > 0 else 0.44, 0.38, 0.50))
    inset.set_facecolor(COLOURS['paper'])
    near = (middle_ns - MAGNIFIED_NS, middle_ns + MAGNIFIED_NS)
    _raw_samples(view, inset, link, reference, near)
    for _, series, look in curves:
        shown = series.between(*near).select(LINK_NAMES)
        inset.plot(view.seconds(shown.stamp_ns), np.degrees(shown.position[:, link]),
                   **{'color': LINK_COLOURS[link], **look,
                      'linewidth': 0.7 * look['linewidth']})
    inset.set_xlim(*view.seconds(np.array(near)))
    inset.locator_params(nbins=3)
    inset.tick_params(labelsize=7.5)


def _goal_line(view: View, axes: Axes, link: int, reference: JointSeries) -> None:
    # A goal of 350 deg for a link at 0 may be reached at -10: draw it where the reference goes.
    near = reference.position[-1]
    goal = near + wrap_angles(view.motion.goal - near)
    axes.axhline(float(np.degrees(goal[link])), color=COLOURS['limit'], linewidth=1.0,
                 linestyle=(0, (6, 2)), label='goal', zorder=1.5)


def _raw_samples(view: View, axes: Axes, link: int, reference: JointSeries,
                 near: tuple[int, int] | None = None) -> None:
    if not view.recording.has(names.LINK_ANGLES):
        return
    raw = view.series(names.LINK_ANGLES).select(LINK_NAMES)
    if near is not None:
        raw = raw.between(*near)
    # Raw angles lie in (-pi, pi]: show them on the turn that the reference is on.
    nearby = np.interp(raw.stamp_ns, reference.stamp_ns, reference.position[:, link])
    angle = nearby + wrap_angles(raw.position[:, link] - nearby)
    time, angle = style.thin_out(view.seconds(raw.stamp_ns), np.degrees(angle), 500)
    axes.plot(time, angle, linestyle='none', marker='.', markersize=3.5, alpha=0.5,
              color=COLOURS['muted'], markeredgewidth=0, label='raw sample', zorder=2.5)


def errors(view: View) -> Figure:
    """Plot the tracking error of a and b and the estimate error of all links with its band."""
    estimate, reference = view.series(names.ESTIMATE_LINK_STATES), view.series(names.REFERENCE)
    if not view.recording.has(names.SIM_LINK_STATES):
        return _tracking_panels(view, [('estimate', pair(estimate, reference, LINK_NAMES))], 1)[0]
    truth = view.series(names.SIM_LINK_STATES)
    figure, panels = _tracking_panels(view, [
        ('estimate', pair(estimate, reference, LINK_NAMES)),
        ('ground truth', pair(truth, reference, LINK_NAMES))], 3)
    error = pair(estimate, truth, LINK_NAMES)
    for link, axes in enumerate(panels[1:].ravel()):
        _sigma_band(view, axes, link)
        time, angle = decimate(view.seconds(error.stamp_ns), np.degrees(error.difference[:, link]))
        axes.plot(time, angle, color=LINK_COLOURS[link], linewidth=1.0,
                  label='estimate − ground truth')
        view.mark_step(axes)
        axes.set_title(f'link {LETTERS[link]}', color=LINK_COLOURS[link], fontweight='bold')
        axes.set_ylabel('estimate error [deg]' if link % 2 == 0 else '')
    style.legend_above(panels[1, 1])
    for axes in panels[-1]:
        axes.set_xlabel('time since setpoint [s]')
    return figure


def _tracking_panels(view: View, actual: list[tuple[str, Paired]],
                     rows: int) -> tuple[Figure, Any]:
    figure = Figure(figsize=(style.WIDTH_IN, 2.3 * rows + 0.3), layout='constrained')
    panels = figure.subplots(rows, 2, sharex=True, sharey='row', squeeze=False)
    for link, axes in enumerate(panels[0]):
        for word, error in actual:
            best = word == actual[-1][0]
            time, angle = decimate(view.seconds(error.stamp_ns),
                                   np.degrees(error.difference[:, link]))
            axes.plot(time, angle, label=f'{word} − reference', linewidth=1.4 if best else 0.8,
                      color=LINK_COLOURS[link] if best else COLOURS['muted'])
        axes.axhline(0.0, color=COLOURS['muted'], linewidth=0.7)
        view.mark_step(axes)
        axes.set_title(f'link {LETTERS[link]}', color=LINK_COLOURS[link], fontweight='bold')
        axes.set_xlabel('time since setpoint [s]' if rows == 1 else '')
    panels[0, 0].set_ylabel('tracking error [deg]')
    style.legend_above(panels[0, 1])
    return figure, panels


def _sigma_band(view: View, axes: Axes, link: int) -> None:
    if view.recording.has(names.ESTIMATE_SIGMA):
        sigma = view.series(names.ESTIMATE_SIGMA)
        time, width = decimate(view.seconds(sigma.stamp_ns), np.degrees(
            2.0 * sigma.select(LINK_NAMES).position[:, link]), bins=150)
        axes.fill_between(time, -width, width, color=COLOURS['muted'], alpha=0.22, linewidth=0,
                          label='2 sigma of the filter')


def wheels(view: View) -> Figure:
    """Plot wheel speeds and motor torques, with the limits of the motors where in view."""
    figure = Figure(figsize=(style.WIDTH_IN, 4.6), layout='constrained')
    speed_axes, torque_axes = figure.subplots(2, 1, sharex=True)
    truth = view.recording.has(names.SIM_FLYWHEEL_STATES)
    speeds = view.series(names.SIM_FLYWHEEL_STATES if truth else names.FLYWHEEL_STATES)
    states = view.series(names.FLYWHEEL_STATES).select(FLYWHEEL_NAMES)
    limits = (None, None) if view.mechanism is None else (
        view.mechanism.motor_speed_limits, view.mechanism.motor_torque_limits)
    _four_curves(view, speed_axes, speeds.stamp_ns, speeds.select(FLYWHEEL_NAMES).velocity,
                 ('speed relative to the link', 'rad/s'), limits[0], scale=False)
    _four_curves(view, torque_axes, states.stamp_ns, states.effort, ('motor torque', 'N m'),
                 limits[1], scale=True)
    torque_axes.set_xlabel('time since setpoint [s]')
    return figure


def _four_curves(view: View, axes: Axes, stamp_ns: Nanoseconds, values: Floats,
                 quantity: tuple[str, str], limits: Floats | None, scale: bool) -> None:
    name, unit = quantity
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    factor, prefix = style.si_scale(largest) if scale else (1.0, '')
    ends = []
    for link in range(4):
        time, value = decimate(view.seconds(stamp_ns), factor * values[:, link])
        if len(time):
            axes.plot(time, value, color=LINK_COLOURS[link], linestyle=LINK_DASHES[link])
            ends.append((float(value[-1]), LETTERS[link], LINK_COLOURS[link]))
    note = _limit_lines(axes, limits, largest, factor, f'{prefix}{unit}')
    axes.set_title(name[0].upper() + name[1:] + note)
    axes.set_ylabel(f'[{prefix}{unit}]')
    view.mark_step(axes)
    style.label_ends(axes, ends)


def _limit_lines(axes: Axes, limits: Floats | None, largest: float, factor: float,
                 unit: str) -> str:
    """Draw the motor limits if the curves come near them, else return them as a remark."""
    if limits is None or not np.any(np.isfinite(limits)):
        return ''
    lowest = float(np.min(limits))
    if largest < 0.4 * lowest:
        return f'  (motor limit {factor * lowest:g} {unit}, out of view)'
    for sign in (-1.0, 1.0):
        axes.axhline(sign * factor * lowest, color=COLOURS['limit'], linewidth=1.0,
                     linestyle=(0, (6, 2)))
    return f'  (dashed: motor limit {factor * lowest:g} {unit})'


def energy(view: View) -> Figure:
    """Plot flywheel energy by paper eq. 7, its eq. 9, and the work of the motors."""
    figure = Figure(figsize=(style.WIDTH_IN, 2.7), layout='constrained')
    panels = figure.subplots(1, 3)
    curves: list[tuple[int, str, Nanoseconds, Floats, dict[str, Any]]] = []
    reasons = []
    try:
        stamps, truth = flywheel_energy(view.recording, view.motion, view.mechanism)
        curves.append((0, 'ground truth', stamps, truth,
                       {'color': LINK_COLOURS[0], 'linewidth': 5.0, 'alpha': 0.4}))
    except BagError as error:
        reasons.append(error)
    try:
        series = view.series(names.ENERGY).select(('flywheel_energy_j', 'eq9_j_s', 'work_j'))
        curves += [(column, 'controller', series.stamp_ns, series.position[:, column],
                    {'color': COLOURS['ink'], 'linewidth': 1.3}) for column in range(3)]
    except BagError as error:
        reasons.append(error)
    if not curves:
        raise BagError('; '.join(map(str, reasons)))
    titles = (('Flywheel energy, eq. 7', 'J'), ('Eq. 9, accumulated', 'J s'),
              ('Work of the motors, accumulated', 'J'))
    for column, (axes, (title, unit)) in enumerate(zip(panels, titles)):
        chosen = [curve for curve in curves if curve[0] == column]
        factor, prefix = style.si_scale(max(
            [float(np.nanmax(np.abs(curve[3]), initial=0.0)) for curve in chosen], default=1.0))
        for _, label, stamps, values, look in chosen:
            axes.plot(*decimate(view.seconds(stamps), factor * values), label=label, **look)
        view.mark_step(axes)
        axes.set_title(title)
        axes.set_ylabel(f'[{prefix}{unit}]')
        axes.set_xlabel('time since setpoint [s]')
        axes.set_ylim(bottom=0.0)
    if len([curve for curve in curves if curve[0] == 0]) > 1:
        panels[0].legend(loc='upper right', handlelength=1.2)
    return figure


def timing(view: View) -> Figure:
    """Plot the round trip over time and its distribution, with the control period."""
    series = view.series(names.TIMING)
    trips = series.select(('round_trip_s',)).position[:, 0] * 1e3
    known = np.isfinite(trips)
    if not known.any():
        raise BagError('no tick was answered')
    period = float(np.median(np.diff(series.stamp_ns))) * 1e-6 if len(series) > 1 else np.nan
    figure = Figure(figsize=(style.WIDTH_IN, 3.0), layout='constrained')
    over_time, distribution = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    time, trip = style.thin_out(view.seconds(series.stamp_ns), trips, 1200)
    over_time.plot(time, trip, linestyle='none', marker='.', markersize=3.5, alpha=0.6,
                   color=LINK_COLOURS[0], markeredgewidth=0)
    style.log_ticks(over_time)
    bins = np.geomspace(0.9 * np.min(trips[known]), 1.1 * np.max(trips[known]), 41)
    distribution.hist(trips[known], bins=bins, orientation='horizontal', alpha=0.75,
                      color=LINK_COLOURS[0])
    for axes in (over_time, distribution):
        axes.axhline(period, color=COLOURS['limit'], linewidth=1.0, linestyle=(0, (6, 2)))
        for share, look in ((50, '-'), (99, (0, (3, 2)))):
            axes.axhline(float(np.percentile(trips[known], share)), color=COLOURS['ink'],
                         linewidth=0.9, linestyle=look)
    distribution.set_xlim(right=1.9 * distribution.get_xlim()[1])
    for share, word in ((50, 'median'), (99, '99 %')):
        value = float(np.percentile(trips[known], share))
        _name_level(distribution, value, f'{word} {value:.2f} ms', 'ink')
    _name_level(over_time, period, f'control period {period:.3g} ms', 'limit')
    over_time.set_title('From a tick to its command, at the device')
    over_time.set_ylabel('round trip [ms]')
    over_time.set_xlabel('time since setpoint [s]')
    distribution.set_title('Distribution')
    distribution.set_xlabel('ticks')
    view.mark_step(over_time)
    return figure


def _name_level(axes: Axes, value: float, text: str, colour: str) -> None:
    axes.annotate(text, (1.0, value), xycoords=('axes fraction', 'data'), xytext=(-2, 2),
                  textcoords='offset points', ha='right', va='bottom', fontsize=8.0,
                  color=COLOURS[colour])


def innovations(view: View) -> Figure:
    """Plot the innovations, and NIS per degree of freedom with its 95 % band."""
    from scipy.special import gammaincinv

    series = view.recording.arrivals(names.ESTIMATE_INNOVATION).between(
        view.motion.start_ns, view.motion.end_ns)
    nis, degrees = series.select(('nis', 'degrees_of_freedom')).position.T
    used = degrees > 0
    if not used.any():
        raise BagError('no innovation since the setpoint')
    time = view.seconds(series.stamp_ns)
    figure = Figure(figsize=(style.WIDTH_IN, 4.8), layout='constrained')
    above, below = figure.subplots(2, 1, sharex=True)
    values = np.degrees(series.select(LINK_NAMES).position)
    for link in range(4):
        above.plot(*style.thin_out(time, values[:, link], 400), linestyle='none', marker='.',
                   markersize=3.5, alpha=0.6, markeredgewidth=0, color=LINK_COLOURS[link],
                   label=f'link {LETTERS[link]}')
    above.set_title('Innovation: measured minus predicted angle')
    above.set_ylabel('[deg]')
    style.legend_above(above, 2.5)

    below.plot(*style.thin_out(time[used], nis[used] / degrees[used], 900), linestyle='none',
               marker='.', markersize=3.5, alpha=0.4, markeredgewidth=0, color=COLOURS['muted'],
               label='each measurement')
    centre, mean, total = _window_means(time[used], nis[used], degrees[used])
    low, high = (2.0 * gammaincinv(total / 2.0, share) / total for share in NIS_BAND)
    below.fill_between(centre, low, high, color=LINK_COLOURS[2], alpha=0.25, linewidth=0,
                       label='95 % of consistent filters')
    below.plot(centre, mean, color=COLOURS['ink'], linewidth=1.5,
               label=f'mean over {NIS_WINDOW_S:g} s')
    below.axhline(1.0, color=LINK_COLOURS[2], linewidth=1.0)
    style.log_ticks(below)
    below.set_ylim(min(0.3, 0.8 * float(np.min(mean))), max(5.0, 1.25 * float(np.max(mean))))
    below.set_title('Normalized innovation squared per degree of freedom')
    below.set_ylabel('NIS / degrees of freedom')
    below.set_xlabel('time since setpoint [s]')
    style.legend_above(below, 2.5)
    view.mark_step(below)
    return figure


def _window_means(time: Floats, nis: Floats, degrees: Floats) -> tuple[Floats, Floats, Floats]:
    """Return centre, NIS per degree of freedom and degrees of freedom of each window."""
    window = ((time - time[0]) // NIS_WINDOW_S).astype(int)
    # The last window is short: it joins the one before.
    window = np.minimum(window, max(int(window[-1]) - 1, 0))
    total: Floats = np.bincount(window, degrees).astype(np.float64)
    known = total > 0
    centre = np.bincount(window, time)[known] / np.bincount(window)[known]
    return centre, np.bincount(window, nis)[known] / total[known], total[known]
