# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures of a report. Each takes a ReportData and raises BagError if the bag lacks its data.

Angles are shown in degrees, all other quantities in SI units; time counts from the setpoint.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fourbar_ros.analysis.bag_reader import BagError
from fourbar_ros.analysis.bags import Floats, JointSeries, Nanoseconds
from fourbar_ros.analysis.manoeuvre import Manoeuvre, match_stamps, MatchedSeries
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
from fourbar_ros.plotting.style import (
    COLOURS,
    DASHED,
    decimate,
    LETTERS,
    LINK_COLOURS,
    LINK_DASHES,
    SAMPLES,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
import numpy as np

TIME_LABEL = 'time since setpoint [s]'
# Number of poses of the linkage.
INSTANTS = 7
# Time shown before the setpoint [s]; it shows that the loop was at rest.
LEAD_S = 0.5
# Half of the time in the insets of the angles [ns].
INSET_NS = 100_000_000
# Smallest turn of a link whose panel gets an inset [rad].
INSET_MIN_TURN_RAD = np.radians(5.0)
# Quantiles of the band that contains the mean NIS of 95 % of consistent filters.
NIS_BAND = (0.025, 0.975)
LAST_NS = 2 ** 63 - 1


@dataclass(frozen=True)
class ReportData:
    """A manoeuvre, and the mechanism if it is known."""

    manoeuvre: Manoeuvre
    mechanism: Mechanism | None

    def has(self, name: str) -> bool:
        """Return whether the bag has messages of a topic."""
        return self.manoeuvre.bag.has(name)

    def series(self, name: str) -> JointSeries:
        """Return a topic from `LEAD_S` before the setpoint to the end of the bag."""
        return self.manoeuvre.series(name, LAST_NS, LEAD_S)

    def truth_or(self, truth: str, other: str) -> JointSeries:
        """Return a topic of ground truth if the bag has it, else another topic."""
        return self.series(truth if self.has(truth) else other)

    def seconds(self, stamp_ns: Nanoseconds) -> Floats:
        """Return the time since the setpoint [s]."""
        return self.manoeuvre.seconds(stamp_ns)

    def mark_step(self, axes: Axes) -> None:
        """Mark the begin and the end of the step."""
        step = np.array([self.manoeuvre.start_ns, self.manoeuvre.step_end_ns])
        for moment in self.seconds(step):
            axes.axvline(moment, color=COLOURS['muted'], linewidth=0.8, linestyle=(0, (1, 2)))


def linkage(data: ReportData) -> Figure:
    """Draw the linkage at equal intervals, with its centre of mass at the origin."""
    if data.mechanism is None:
        raise BagError('the mechanism of this bag is unknown: give --mechanism')
    links = data.truth_or(names.SIM_LINK_STATES, names.ESTIMATE_LINK_STATES).select(LINK_NAMES)
    last_ns = min(data.manoeuvre.step_end_ns, data.manoeuvre.end_ns)
    instants = np.linspace(data.manoeuvre.start_ns, last_ns, INSTANTS).astype(np.int64)
    rows = np.clip(np.searchsorted(links.stamp_ns, instants), 0, len(links) - 1)
    poses = links.rows(rows)
    if np.any(np.isnan(poses.position)):
        raise BagError('the link states lack a link')
    speeds = _absolute_speeds(data, links)[rows]
    fastest = float(np.nanmax(np.abs(speeds), initial=0.0)) if len(speeds) else 0.0
    reach = 1.06 * float(np.max(np.linalg.norm(joint_positions(
        data.mechanism, np.vstack([poses.position, data.manoeuvre.goal])), axis=-1)))

    figure = Figure(figsize=(style.WIDTH_IN, 1.75),
                    layout=ConstrainedLayoutEngine(w_pad=0.0, h_pad=0.02, wspace=0.0))
    for index, axes in enumerate(figure.subplots(1, INSTANTS, sharex=True, sharey=True)):
        axes.set_axis_off()
        axes.set_aspect('equal')
        axes.set_xlim(-reach, reach)
        axes.set_ylim(-reach, reach)
        _draw_outline(axes, data.mechanism, data.manoeuvre.goal)
        _draw_pose(axes, data.mechanism, poses.position[index], speeds[index] / (fastest or 1.0))
        name = {0: 'start', INSTANTS - 1: 'end of step'}.get(index, '')
        axes.set_title(f'{float(data.seconds(poses.stamp_ns[index])):.1f} s  {name}', loc='center',
                       fontweight='bold' if name else 'normal',
                       color=COLOURS['ink' if name else 'muted'])
    return figure


def _absolute_speeds(data: ReportData, links: JointSeries) -> Floats:
    """Return absolute wheel speeds at the stamps of links (n, 4), NaN where unknown."""
    wheels = data.truth_or(names.SIM_FLYWHEEL_STATES, names.FLYWHEEL_STATES).select(FLYWHEEL_NAMES)
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


def angles(data: ReportData) -> Figure:
    """Plot the angle of each link: goal, reference, truth, estimate, raw samples."""
    figure, grid = style.panels(5.0, 2, 2, sharex=True)
    panels = grid.ravel()
    reference = data.series(names.REFERENCE).select(LINK_NAMES)
    curves = [('estimate', data.series(names.ESTIMATE_LINK_STATES),
               {'linewidth': 1.3, 'color': COLOURS['ink']}),
              ('reference', reference, {'linewidth': 1.3, 'linestyle': (0, (3, 3))})]
    if data.has(names.SIM_LINK_STATES):
        curves.insert(0, ('ground truth', data.series(names.SIM_LINK_STATES),
                          {'linewidth': 5.0, 'alpha': 0.4}))
    for link, axes in enumerate(panels):
        shown = {'color': LINK_COLOURS[link]}
        _raw_samples(data, axes, link, reference)
        for label, series, options in curves:
            time, angle = decimate(data.seconds(series.stamp_ns), np.degrees(
                series.select(LINK_NAMES).position[:, link]))
            axes.plot(time, angle, label=label, **{**shown, **options})
        _goal_line(data, axes, link, reference)
        _inset(data, axes, link, curves, reference)
        data.mark_step(axes)
        style.link_title(axes, link)
        axes.set_ylabel('angle [deg]' if link % 2 == 0 else '')
        axes.set_xlabel(TIME_LABEL if link > 1 else '')
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper right', ncols=len(labels), markerscale=3.0)
    return figure


def _inset(data: ReportData, axes: Axes, link: int, curves: list[tuple[str, JointSeries, Any]],
           reference: JointSeries) -> None:
    """Magnify the middle of the step: the curves coincide on the scale of the motion."""
    middle_ns = (data.manoeuvre.start_ns + data.manoeuvre.step_end_ns) // 2
    turn = float(data.manoeuvre.goal[link] - data.manoeuvre.initial[link])
    if data.manoeuvre.end_ns <= middle_ns + INSET_NS or abs(turn) < INSET_MIN_TURN_RAD:
        return
    # In the corner without curve.
    inset = axes.inset_axes((0.60, 0.12 if turn > 0 else 0.44, 0.38, 0.50))
    inset.set_facecolor(COLOURS['paper'])
    near = (middle_ns - INSET_NS, middle_ns + INSET_NS)
    _raw_samples(data, inset, link, reference, near)
    for _, series, options in curves:
        shown = series.between(*near).select(LINK_NAMES)
        inset.plot(data.seconds(shown.stamp_ns), np.degrees(shown.position[:, link]),
                   **{'color': LINK_COLOURS[link], **options,
                      'linewidth': 0.7 * options['linewidth']})
    inset.set_xlim(*data.seconds(np.array(near)))
    inset.locator_params(nbins=3)
    inset.tick_params(labelsize=7.5)


def _goal_line(data: ReportData, axes: Axes, link: int, reference: JointSeries) -> None:
    # A goal of 350 deg for a link at 0 may be reached at -10 deg: draw the equivalent angle.
    near = reference.position[-1]
    goal = near + wrap_angles(data.manoeuvre.goal - near)
    axes.axhline(float(np.degrees(goal[link])), color=COLOURS['limit'], linewidth=1.0,
                 linestyle=DASHED, label='goal', zorder=1.5)


def _raw_samples(data: ReportData, axes: Axes, link: int, reference: JointSeries,
                 near: tuple[int, int] | None = None) -> None:
    if not data.has(names.LINK_ANGLES):
        return
    raw = data.series(names.LINK_ANGLES).select(LINK_NAMES)
    if near is not None:
        raw = raw.between(*near)
    # Raw angles lie in (-pi, pi]: add the full turns of the reference.
    nearby = np.interp(raw.stamp_ns, reference.stamp_ns, reference.position[:, link])
    angle = nearby + wrap_angles(raw.position[:, link] - nearby)
    time, angle = style.thin_out(data.seconds(raw.stamp_ns), np.degrees(angle), 500)
    axes.plot(time, angle, alpha=0.5, color=COLOURS['muted'], label='raw sample', zorder=2.5,
              **SAMPLES)


def errors(data: ReportData) -> Figure:
    """Plot the tracking error of links a and b, and the estimate error of all links."""
    estimate, reference = data.series(names.ESTIMATE_LINK_STATES), data.series(names.REFERENCE)
    tracking = [('estimate', match_stamps(estimate, reference, LINK_NAMES))]
    if not data.has(names.SIM_LINK_STATES):
        return _tracking_panels(data, tracking, 1)[0]
    truth = data.series(names.SIM_LINK_STATES)
    tracking.append(('ground truth', match_stamps(truth, reference, LINK_NAMES)))
    figure, panels = _tracking_panels(data, tracking, 3)
    error = match_stamps(estimate, truth, LINK_NAMES)
    for link, axes in enumerate(panels[1:].ravel()):
        _sigma_band(data, axes, link)
        time, angle = decimate(data.seconds(error.stamp_ns), np.degrees(error.difference[:, link]))
        axes.plot(time, angle, color=LINK_COLOURS[link], linewidth=1.0,
                  label='estimate − ground truth')
        data.mark_step(axes)
        style.link_title(axes, link)
        axes.set_ylabel('estimate error [deg]' if link % 2 == 0 else '')
    style.legend_above(panels[1, 1])
    for axes in panels[-1]:
        axes.set_xlabel(TIME_LABEL)
    return figure


def _tracking_panels(data: ReportData, actual: list[tuple[str, MatchedSeries]],
                     rows: int) -> tuple[Figure, Any]:
    figure, panels = style.panels(2.3 * rows + 0.3, rows, 2, sharex=True, sharey='row',
                                  squeeze=False)
    for link, axes in enumerate(panels[0]):
        for label, error in actual:
            best = label == actual[-1][0]
            time, angle = decimate(data.seconds(error.stamp_ns),
                                   np.degrees(error.difference[:, link]))
            axes.plot(time, angle, label=f'{label} − reference', linewidth=1.4 if best else 0.8,
                      color=LINK_COLOURS[link] if best else COLOURS['muted'])
        axes.axhline(0.0, color=COLOURS['muted'], linewidth=0.7)
        data.mark_step(axes)
        style.link_title(axes, link)
        axes.set_xlabel(TIME_LABEL if rows == 1 else '')
    panels[0, 0].set_ylabel('tracking error [deg]')
    style.legend_above(panels[0, 1])
    return figure, panels


def _sigma_band(data: ReportData, axes: Axes, link: int) -> None:
    if data.has(names.ESTIMATE_SIGMA):
        sigma = data.series(names.ESTIMATE_SIGMA)
        time, width = decimate(data.seconds(sigma.stamp_ns), np.degrees(
            2.0 * sigma.select(LINK_NAMES).position[:, link]), bins=150)
        axes.fill_between(time, -width, width, color=COLOURS['muted'], alpha=0.22, linewidth=0,
                          label='2 sigma of the filter')


def wheels(data: ReportData) -> Figure:
    """Plot wheel speeds and motor torques, with the motor limits if they are in view."""
    figure, (speed_axes, torque_axes) = style.panels(4.6, 2, 1, sharex=True)
    speeds = data.truth_or(names.SIM_FLYWHEEL_STATES, names.FLYWHEEL_STATES)
    states = data.series(names.FLYWHEEL_STATES).select(FLYWHEEL_NAMES)
    limits = (None, None) if data.mechanism is None else (
        data.mechanism.motor_speed_limits, data.mechanism.motor_torque_limits)
    _four_curves(data, speed_axes, speeds.stamp_ns, speeds.select(FLYWHEEL_NAMES).velocity,
                 ('speed relative to the link', 'rad/s'), limits[0], scale=False)
    _four_curves(data, torque_axes, states.stamp_ns, states.effort, ('motor torque', 'N m'),
                 limits[1], scale=True)
    torque_axes.set_xlabel(TIME_LABEL)
    return figure


def _four_curves(data: ReportData, axes: Axes, stamp_ns: Nanoseconds, values: Floats,
                 quantity: tuple[str, str], limits: Floats | None, scale: bool) -> None:
    name, unit = quantity
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    factor, prefix = style.si_scale(largest) if scale else (1.0, '')
    ends = []
    for link in range(4):
        time, value = decimate(data.seconds(stamp_ns), factor * values[:, link])
        if len(time):
            axes.plot(time, value, color=LINK_COLOURS[link], linestyle=LINK_DASHES[link])
            ends.append((float(value[-1]), LETTERS[link], LINK_COLOURS[link]))
    note = _limit_lines(axes, limits, largest, factor, f'{prefix}{unit}')
    axes.set_title(name[0].upper() + name[1:] + note)
    axes.set_ylabel(f'[{prefix}{unit}]')
    data.mark_step(axes)
    style.label_ends(axes, ends)


def _limit_lines(axes: Axes, limits: Floats | None, largest: float, factor: float,
                 unit: str) -> str:
    """Draw the motor limits if the curves come near them; return a note for the title."""
    if limits is None or not np.any(np.isfinite(limits)):
        return ''
    lowest = float(np.min(limits))
    if largest < 0.4 * lowest:
        return f'  (motor limit {factor * lowest:g} {unit}, out of view)'
    for sign in (-1.0, 1.0):
        axes.axhline(sign * factor * lowest, color=COLOURS['limit'], linewidth=1.0,
                     linestyle=DASHED)
    return f'  (dashed: motor limit {factor * lowest:g} {unit})'


def energy(data: ReportData) -> Figure:
    """Plot the energy of the wheels, eq. 7 and 9 of the paper, and the work of the motors."""
    figure, panels = style.panels(2.7, 1, 3)
    curves: list[tuple[int, str, Nanoseconds, Floats, dict[str, Any]]] = []
    reasons = []
    try:
        stamps, truth = flywheel_energy(data.manoeuvre, data.mechanism)
        curves.append((0, 'ground truth', stamps, truth,
                       {'color': LINK_COLOURS[0], 'linewidth': 5.0, 'alpha': 0.4}))
    except BagError as error:
        reasons.append(error)
    try:
        series = data.series(names.ENERGY).select(('flywheel_energy_j', 'eq9_j_s', 'work_j'))
        curves += [(column, 'controller', series.stamp_ns, series.position[:, column],
                    {'color': COLOURS['ink'], 'linewidth': 1.3}) for column in range(3)]
    except BagError as error:
        reasons.append(error)
    if not curves:
        raise BagError('; '.join(map(str, reasons)))
    titles = (('Flywheel energy, eq. 7', 'J'), ('Eq. 9, accumulated', 'J s'),
              ('Work of the motors, accumulated', 'J'))
    for column, (axes, (title, unit)) in enumerate(zip(panels, titles)):
        selected = [curve for curve in curves if curve[0] == column]
        factor, prefix = style.si_scale(max(
            [float(np.nanmax(np.abs(curve[3]), initial=0.0)) for curve in selected], default=1.0))
        for _, label, stamps, values, options in selected:
            axes.plot(*decimate(data.seconds(stamps), factor * values), label=label, **options)
        data.mark_step(axes)
        axes.set_title(title)
        axes.set_ylabel(f'[{prefix}{unit}]')
        axes.set_xlabel(TIME_LABEL)
        axes.set_ylim(bottom=0.0)
    if len([curve for curve in curves if curve[0] == 0]) > 1:
        panels[0].legend(loc='upper right', handlelength=1.2)
    return figure


def timing(data: ReportData) -> Figure:
    """Plot the round trip over time and its distribution, with the control period."""
    series = data.series(names.TIMING)
    trips = series.select(('round_trip_s',)).position[:, 0] * 1e3
    # In lock-step no simulated time passes between a tick and its answer: all round trips are 0.
    known = trips > 0.0
    if not known.any():
        raise BagError('no tick was answered, or the clock was in lock-step')
    period = float(np.median(np.diff(series.stamp_ns))) * 1e-6 if len(series) > 1 else np.nan
    figure, (over_time, distribution) = style.panels(3.0, 1, 2, sharey=True, width_ratios=(3, 1))
    time, trip = style.thin_out(data.seconds(series.stamp_ns), trips, 1200)
    over_time.plot(time, trip, alpha=0.6, color=LINK_COLOURS[0], **SAMPLES)
    style.log_ticks(over_time)
    bins = np.geomspace(0.9 * np.min(trips[known]), 1.1 * np.max(trips[known]), 41)
    distribution.hist(trips[known], bins=bins, orientation='horizontal', alpha=0.75,
                      color=LINK_COLOURS[0])
    for axes in (over_time, distribution):
        axes.axhline(period, color=COLOURS['limit'], linewidth=1.0, linestyle=DASHED)
        for share, dashes in ((50, '-'), (99, (0, (3, 2)))):
            axes.axhline(float(np.percentile(trips[known], share)), color=COLOURS['ink'],
                         linewidth=0.9, linestyle=dashes)
    distribution.set_xlim(right=1.9 * distribution.get_xlim()[1])
    for share, label in ((50, 'median'), (99, '99 %')):
        value = float(np.percentile(trips[known], share))
        _label_level(distribution, value, f'{label} {value:.2f} ms', 'ink')
    _label_level(over_time, period, f'control period {period:.3g} ms', 'limit')
    over_time.set_title('From a tick to its command, at the device')
    over_time.set_ylabel('round trip [ms]')
    over_time.set_xlabel(TIME_LABEL)
    distribution.set_title('Distribution')
    distribution.set_xlabel('ticks')
    data.mark_step(over_time)
    return figure


def _label_level(axes: Axes, value: float, text: str, colour: str) -> None:
    axes.annotate(text, (1.0, value), xycoords=('axes fraction', 'data'), xytext=(-2, 2),
                  textcoords='offset points', ha='right', va='bottom', fontsize=8.0,
                  color=COLOURS[colour])


def innovations(data: ReportData) -> Figure:
    """Plot the innovations, and NIS per degree of freedom with its 95 % band."""
    from scipy.special import gammaincinv

    series = data.manoeuvre.bag.arrivals(names.ESTIMATE_INNOVATION).between(
        data.manoeuvre.start_ns, data.manoeuvre.end_ns)
    nis, degrees = series.select(('nis', 'degrees_of_freedom')).position.T
    used = degrees > 0
    if not used.any():
        raise BagError('no innovation since the setpoint')
    time = data.seconds(series.stamp_ns)
    figure, (above, below) = style.panels(4.8, 2, 1, sharex=True)
    values = np.degrees(series.select(LINK_NAMES).position)
    for link in range(4):
        above.plot(*style.thin_out(time, values[:, link], 400), alpha=0.6,
                   color=LINK_COLOURS[link], label=f'link {LETTERS[link]}', **SAMPLES)
    above.set_title('Innovation: measured minus predicted angle')
    above.set_ylabel('[deg]')
    style.legend_above(above, 2.5)

    below.plot(*style.thin_out(time[used], nis[used] / degrees[used], 900), alpha=0.4,
               color=COLOURS['muted'], label='each measurement', **SAMPLES)
    centre, mean, total = style.windowed_nis(time[used], nis[used], degrees[used])
    low, high = (2.0 * gammaincinv(total / 2.0, share) / total for share in NIS_BAND)
    below.fill_between(centre, low, high, color=LINK_COLOURS[2], alpha=0.25, linewidth=0,
                       label='95 % of consistent filters')
    below.plot(centre, mean, color=COLOURS['ink'], linewidth=1.5,
               label=f'mean over {style.NIS_WINDOW_S:g} s')
    below.axhline(1.0, color=LINK_COLOURS[2], linewidth=1.0)
    style.log_ticks(below)
    below.set_ylim(min(0.3, 0.8 * float(np.min(mean))), max(5.0, 1.25 * float(np.max(mean))))
    below.set_title('Normalized innovation squared per degree of freedom')
    below.set_ylabel('NIS / degrees of freedom')
    below.set_xlabel(TIME_LABEL)
    style.legend_above(below, 2.5)
    data.mark_step(below)
    return figure
