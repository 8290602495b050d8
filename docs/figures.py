# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Draw all figures of the documents but those of studies: `.venv/bin/python docs/figures.py`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fourbar_ros.analysis.calibration.calibration_figures import links_figure, wheels_figure
from fourbar_ros.analysis.calibration.excitation import Excitation, MultiSine, SpinAndCoast
from fourbar_ros.analysis.calibration.link_identification import link_estimate
from fourbar_ros.analysis.calibration.measurements import (
    link_measurements,
    LinkMeasurements,
    WheelMeasurements,
)
from fourbar_ros.analysis.calibration.wheel_identification import wheel_estimate
from fourbar_ros.control import Controller, ControllerSettings
from fourbar_ros.device.command import drive_by_name
from fourbar_ros.device.interface import no_torque
from fourbar_ros.device.simulated import SimulatedTable
from fourbar_ros.estimation import Estimator, EstimatorSettings
from fourbar_ros.estimation.bias_detection import GLR_THRESHOLD
from fourbar_ros.loop.run import make_loop
from fourbar_ros.loop.scenario import load_scenario
from fourbar_ros.mechanism import (
    assemble,
    LINK_NAMES,
    load_mechanism,
    Mechanism,
    reduced_form,
)
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.geometry import joint_positions
from fourbar_ros.mechanism.integration import move_held, move_with_cosines
from fourbar_ros.mechanism.state import LINK_ANGLES, LINK_RATES, make_state, WHEEL_SPEEDS
from fourbar_ros.plant import Fault, InitialState, LinkSensorSettings, load_table, Plant, Table
from fourbar_ros.plant.bearings import bearing_torque, drives_of
from fourbar_ros.plant.energy_budget import EnergyBudget
from fourbar_ros.plant.table import WheelEncoders
from fourbar_ros.plotting.style import COLOURS, legend_above, LINK_COLOURS, RC
from matplotlib import pyplot, rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IMAGES = Path(__file__).parent / 'images'
NONE = np.zeros(4)


def main() -> None:
    """Write every figure."""
    with rc_context({**RC, 'figure.facecolor': 'white'}):
        for name, draw in (
                ('mechanics_linkage', linkage), ('mechanics_change_point', change_point),
                ('table_friction', friction),
                ('table_stiction', stiction), ('table_energy', energy),
                ('table_sensors', sensors), ('estimation_bias_detection', sensor_bias),
                ('estimation_change_point', fold), ('calibration_wheels', calibrated_wheels),
                ('calibration_links', calibrated_links)):
            draw().savefig(IMAGES / f'{name}.png', dpi=110, bbox_inches='tight')


def linkage() -> Figure:
    """Draw links, joints, angles and a wheel on each link."""
    mechanism = load_mechanism('paper')
    angles = assemble(mechanism, 0.2, 1.35)
    joints = joint_positions(mechanism, angles)
    figure, axes = pyplot.subplots(figsize=(5.2, 4.2))
    axes.set_aspect('equal')
    axes.axis('off')
    for link, (near, far) in enumerate(((0, 3), (0, 1), (1, 2), (3, 2))):
        ends = joints[[near, far]]
        axes.plot(*ends.T, color=LINK_COLOURS[link], linewidth=5)
        middle = ends.mean(axis=0)
        axes.add_patch(Circle(middle, 0.011, facecolor='white', edgecolor=LINK_COLOURS[link],
                              linewidth=2.0, zorder=4))
        axes.annotate('abcd'[link], middle, ha='center', va='center', fontweight='bold',
                      color=LINK_COLOURS[link], zorder=5, fontsize=11)
        # The angle of the link's x axis, at its near joint.
        start = joints[near]
        axes.plot(start[0] + [0.0, 0.045], [start[1]] * 2, color=COLOURS['muted'], linewidth=0.8)
        size = 0.05 if link in (0, 3) else 0.07
        axes.add_patch(Arc(start, size, size, theta2=np.degrees(angles[link]),
                           color=LINK_COLOURS[link], linewidth=1.2))
        half = 0.5 * angles[link]
        beside = (0.5 * size + 0.008) * np.array([np.cos(half), np.sin(half)])
        axes.annotate(rf'$\phi_{"abcd"[link]}$',
                      start + (beside if link in (1, 3) else [0.03, -0.008]), ha='center',
                      va='center', color=LINK_COLOURS[link])
    outwards = joints / np.linalg.norm(joints, axis=1, keepdims=True)
    for joint, place in enumerate(joints):
        axes.plot(*place, 'o', color=COLOURS['ink'], markersize=7, zorder=6)
        axes.annotate(f'{joint + 1}', place + 0.012 * outwards[joint], ha='center', va='center')
    low, high = joints.min(axis=0), joints.max(axis=0)
    axes.set(xlim=(low[0] - 0.06, high[0] + 0.04), ylim=(low[1] - 0.03, high[1] + 0.03))
    corner = low + [-0.05, -0.02]
    for tip, text in (([0.03, 0.0], 'x'), ([0.0, 0.03], 'y')):
        axes.annotate('', corner + tip, corner, arrowprops={'arrowstyle': '->'})
        axes.annotate(text, corner + 1.25 * np.array(tip), ha='center', va='center')
    return figure


def change_point() -> Figure:
    """Draw passages near theta = 0, and one fold against time."""
    figure, (plane, time) = pyplot.subplots(1, 2, figsize=(9.0, 3.6))
    for mismatch, colour in ((0.0, COLOURS['ink']), (1e-4, LINK_COLOURS[0]),
                             (-1e-4, LINK_COLOURS[0]), (1e-3, LINK_COLOURS[1]),
                             (-1e-3, LINK_COLOURS[1])):
        _, states = _passage(mismatch)
        theta, opening = states[:, 1] - states[:, 0], states[:, 2] - states[:, 0]
        plane.plot(theta, opening, color=colour, label=f'{abs(mismatch):g}'
                   if mismatch >= 0.0 else None)
    plane.set(xlabel=r'$\theta = \phi_b - \phi_a$ [rad]', xlim=(-0.2, 0.2), ylim=(-0.2, 0.2),
              ylabel=r'$\varepsilon = \phi_c - \phi_a$ [rad]',
              title='Near the change point, by mismatch of lengths')
    plane.legend(loc='lower left')
    times, states = _passage(1e-3)
    for link in range(4):
        time.plot(times, np.degrees(states[:, link]), color=LINK_COLOURS[link],
                  label='abcd'[link])
    time.set(xlabel='time [s]', ylabel='link angle [deg]', title='Link a longer by 1e-3: it folds')
    time.legend(ncols=4, loc='upper left')
    figure.tight_layout()
    return figure


def _passage(mismatch: float) -> tuple[Array, Array]:
    lengths = np.array([0.1 * (1.0 + mismatch), 0.1, 0.1, 0.1])
    mechanism = Mechanism(
        lengths, np.full(4, 0.02), np.full(4, 2.2e-5), np.column_stack([0.5 * lengths, NONE]),
        np.full(4, 3.4e-7))
    angles = assemble(mechanism, 0.0, -0.3)
    rates = np.array([0.0, 1.0])
    rates = np.concatenate([rates, reduced_form(mechanism, angles, rates).gamma @ rates])
    times = np.arange(0.0, 0.6, 1e-3)
    return times, move_with_cosines(make_state(angles, rates), times, NONE, NONE, NONE, 1e-3,
                                    mechanism.constants, NOTHING)


def friction() -> Figure:
    """Draw the friction of the prototype's wheel bearings against speed."""
    bearings = load_table('prototype').wheel_bearings
    motors = drives_of(load_mechanism('prototype'), bearings)
    figure, (plain, wide) = pyplot.subplots(1, 2, figsize=(9.0, 3.4), sharey=True)
    speeds = np.linspace(-5.0, 5.0, 2001)
    plain.plot(speeds, [1e3 * bearing_torque(speed, 0.0, motors) for speed in speeds],
               color=COLOURS['ink'])
    plain.set(xlabel=r'relative speed $\Omega$ [rad/s]', ylabel='friction [mN m]',
              title='Dry friction at low speed')
    speeds = np.geomspace(1e-6, 300.0, 1000)
    wide.plot(speeds, [1e3 * bearing_torque(speed, 0.0, motors) for speed in speeds],
              color=COLOURS['ink'])
    wide.axvspan(speeds[0], bearings.smoothing, color=COLOURS['grid'])
    for speed, text, place in (
            (bearings.smoothing, 'smoothing', (-4, 4)),
            (bearings.stribeck_speed, 'half of the surplus', (-6, -10))):
        wide.plot(speed, 1e3 * bearing_torque(speed, 0.0, motors), 'o', color=LINK_COLOURS[1],
                  markersize=4)
        wide.annotate(text, (speed, 1e3 * bearing_torque(speed, 0.0, motors)), place,
                      textcoords='offset points', color=LINK_COLOURS[1],
                      ha='right' if place[0] < 0 else 'left')
    wide.set(xscale='log', xlabel=r'relative speed $\Omega$ [rad/s]',
             title='At all speeds (shaded: below the smoothing)')
    figure.tight_layout()
    return figure


def stiction() -> Figure:
    """Draw a wheel that a slow sine of torque drives to and fro."""
    mechanism, table = load_mechanism('prototype'), load_table('prototype')
    plant = Plant(mechanism, Table(LinkSensorSettings(), WheelEncoders(0), table.wheel_bearings),
                  InitialState(), 5e-4, np.random.default_rng(0))
    times = 5e-4 * np.arange(16_001)
    asked = 1.6e-3 * np.sin(0.5 * np.pi * times)
    given, speeds, absolute = (np.zeros(times.size) for _ in range(3))
    for n in range(1, times.size):
        plant.advance(1, np.array([asked[n], 0.0, 0.0, 0.0]))
        truth = plant.truth()
        given[n], speeds[n] = truth.efforts[0], truth.wheel_speeds[0]
        absolute[n] = truth.wheel_speeds[0] + truth.link_rates[0]
    taken = given[1:] - mechanism.flywheel_inertias[0] * np.diff(absolute) / 5e-4
    figure, (torque, speed) = pyplot.subplots(2, 1, figsize=(9.0, 4.2), sharex=True)
    torque.plot(times, 1e3 * given, color=COLOURS['muted'], label='motor')
    torque.plot(times[1:], 1e3 * taken, color=LINK_COLOURS[1], label='friction')
    torque.set(ylabel='torque [mN m]', title='A wheel driven to and fro')
    legend_above(torque)
    speed.plot(times, speeds, color=LINK_COLOURS[0])
    speed.set(xlabel='time [s]', ylabel='relative speed [rad/s]')
    figure.tight_layout()
    return figure


def energy() -> Figure:
    """Draw where the energy of a quarter turn of the prototype is at any time."""
    times, ledgers = quarter_turn()
    figure, axes = pyplot.subplots(figsize=(9.0, 3.8))
    shares = np.array([(ledger.links, ledger.wheels, ledger.copper, ledger.bearings,
                        ledger.joints + ledger.drag) for ledger in ledgers]).T
    axes.stackplot(times, shares, alpha=0.85, colors=(
        COLOURS['limit'], LINK_COLOURS[2], LINK_COLOURS[3], LINK_COLOURS[1], COLOURS['muted']),
        labels=('in the links', 'in the wheels', 'heat in windings', 'heat in wheel bearings',
                'joints and drag'))
    axes.plot(times, [ledger.supplied + ledger.tilt + ledger.disturbance for ledger in ledgers],
              '--', color=COLOURS['ink'], label='came from outside')
    axes.set(xlabel='time [s]', ylabel='energy [J]', title='A quarter turn of the prototype')
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc='upper left')
    figure.tight_layout()
    return figure


def quarter_turn() -> tuple[Array, list[EnergyBudget]]:
    """
    Turn the prototype by 90 degrees in 10 s, seed 0, the controller knowing the true state.

    :returns: times (n,) [s], and the accounts at each.
    """
    mechanism = load_mechanism('prototype')
    plant = Plant(mechanism, load_table('prototype'), InitialState(), 5e-4,
                  np.random.default_rng(0))
    controller = Controller(mechanism, ControllerSettings(setpoint_duration=10.0))
    controller.device_armed(True)
    times = 4e-3 * np.arange(2876.0)
    ledgers = []
    for n in range(times.size):
        truth = plant.truth()
        if n == 125:
            controller.setpoint(('link_a', 'link_b'), (0.5 * np.pi, 5.0 * np.pi / 6.0))
        control = controller.tick(round(1e9 + n * 4e6), truth.link_angles, truth.link_rates,
                                  np.zeros(2), truth.wheel_speeds, truth.efforts)
        ledgers.append(plant.ledger())
        plant.advance(8, control.torques)
    return times, ledgers


def sensors() -> Figure:
    """Draw what four link sensors tell: in detail, and with a fault on each but one."""
    settings = replace(load_table('prototype').link_sensors, dropout=0.05)
    plant = Plant(load_mechanism('prototype'), Table(settings, WheelEncoders(0)),
                  InitialState(rate_a=0.4, rate_b=-0.3), 5e-4, np.random.default_rng(0))
    table = SimulatedTable(plant, 4_000_000)
    table.schedule_faults([
        {'at': 0.5, 'until': 1.5, 'target': target, 'fault': fault, 'value': value}
        for target, fault, value in (('link_b', 'wrong', 0.01), ('link_c', 'slow', 0.05),
                                     ('link_d', 'intermittent', 0.8))], 'figure')
    truth, samples = {}, []
    for n in range(501):
        now = table.step(n * 4_000_000, no_torque())
        assert now.truth is not None
        truth[now.stamp_ns] = now.truth.link_angles
        samples += [(reading.stamp_ns, now.stamp_ns, name, angle) for reading in now.links
                    for name, angle in zip(reading.names, reading.angles)]
    figure = pyplot.figure(figsize=(9.0, 4.2))
    grid = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.6))
    detail = figure.add_subplot(grid[0])
    _draw_arrivals(detail, truth, [sample for sample in samples if sample[2] == 'link_a'])
    panels = grid[1].subgridspec(4, 1).subplots(sharex=True, sharey=True)
    assert isinstance(panels, np.ndarray)
    for link, (name, axes) in enumerate(zip(LINK_NAMES, panels)):
        stamps, errors = np.array([
            (1e-9 * measured, np.remainder(angle - truth[measured][link] + np.pi, 2.0 * np.pi)
             - np.pi) for measured, _, sensor, angle in samples if sensor == name]).T
        axes.plot(stamps, 1e3 * errors, '.', color=LINK_COLOURS[link], markersize=2.5)
        axes.axvspan(0.5, 1.5, color=COLOURS['grid'], alpha=0.6 if link else 0.0)
        axes.annotate(('no fault', 'wrong 0.01', 'slow 0.05', 'intermittent 0.8')[link],
                      (1.0, 0.72 if link == 2 else 0.12), xycoords=('data', 'axes fraction'),
                      ha='center')
        axes.set_ylabel('abcd'[link], rotation=0, va='center', labelpad=8)
    panels[0].set_title('Sample minus truth [mrad], faults in between')
    panels[-1].set_xlabel('time of measurement [s]')
    figure.tight_layout()
    return figure


def sensor_bias() -> Figure:
    """Draw the detection of a small bias of one sensor, and its effect on the estimate."""
    begin, error = 3.0, np.radians(0.35)
    loop = make_loop(load_scenario('prototype'))
    assert isinstance(loop.supervisor.device, SimulatedTable)
    times, samples, errors, sums = [], [], [], []
    for n in range(round((begin + 0.4) / 4e-3)):
        if n == round(begin / 4e-3):
            loop.supervisor.device.break_down('link_c', Fault('link_c', 'wrong', error))
        step = loop.step()
        truth, estimate = step.samples.truth, step.estimate
        if n * 4e-3 < begin - 0.2 or truth is None or estimate is None:
            continue
        now = n * 4e-3 - begin
        times.append(now)
        errors.append((estimate.link_angles[2] - truth.link_angles[2], estimate.angle_sigmas[2]))
        sums.append([loop.estimator.glr_statistics()[name] for name in LINK_NAMES])
        samples += [(now, reading.angles[reading.names.index('link_c')] - truth.link_angles[2])
                    for reading in step.samples.links if 'link_c' in reading.names]
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9.0, 3.4))
    stamps, angles = np.array(samples).T
    left.plot(stamps, np.degrees(angles), '.', color=LINK_COLOURS[2], markersize=3.5,
              label='sample of link c')
    mean, sigma = np.degrees(np.array(errors).T)
    left.plot(times, mean, color=COLOURS['ink'], label='estimate')
    left.fill_between(times, mean - 2.0 * sigma, mean + 2.0 * sigma, color=COLOURS['muted'],
                      alpha=0.3, linewidth=0.0, label='two standard deviations')
    left.set(xlabel='time since link c is off by 0.35 deg [s]', ylabel='angle minus truth [deg]')
    legend_above(left)
    for link, values in enumerate(np.array(sums).T):
        right.plot(times, values, color=LINK_COLOURS[link], label=LINK_NAMES[link])
    right.axhline(GLR_THRESHOLD, color=COLOURS['muted'], linewidth=0.8, linestyle='--')
    right.annotate('threshold, if 10 ahead of all others', (0.06, GLR_THRESHOLD + 0.5), fontsize=8)
    right.set(xlabel='time [s]', ylabel='GLR statistic [nats]')
    legend_above(right)
    figure.tight_layout()
    return figure


def fold() -> Figure:
    """Draw how the filter follows a linkage that folds onto its other branch at theta = 0."""
    mechanism = load_mechanism('prototype')
    estimator = Estimator(mechanism, EstimatorSettings(
        disturbance_torque=1e-5, disturbance_walk=1e-5))
    rng, noise = np.random.default_rng(0), EstimatorSettings().angle_noise
    state = make_state(np.full(4, 0.2), np.zeros(4))
    stamp, speeds, rows = 1_000_000_000, np.zeros(4), []
    for n in range(750):
        torques = 2e-3 * np.sin(3.0 * n * 4e-3) * np.array([1.0, 1.0, -1.0, -1.0])
        move_held(state, torques, 5e-4, 8, mechanism.constants, NOTHING)
        before, speeds = speeds, state[WHEEL_SPEEDS] - state[LINK_RATES]
        stamp += 4_000_000
        estimator.measure(stamp, LINK_NAMES, list(
            state[LINK_ANGLES] + noise * rng.standard_normal(4)))
        estimate = estimator.tick(stamp, 0.5 * (before + speeds))
        assert estimate is not None
        for first in (1, 2):
            rows.append((n * 4e-3, state[first] - state[0], estimate.link_angles[first]
                         - state[first], estimate.angle_sigmas[first]))
    theta, psi = np.array(rows[0::2]).T, np.array(rows[1::2]).T
    figure, (above, below) = pyplot.subplots(2, 1, figsize=(7.0, 4.2), sharex=True)
    for values, colour, label in ((theta, LINK_COLOURS[1], 'link b'),
                                  (psi, LINK_COLOURS[2], 'link c')):
        time, truth, error, sigma = values
        above.plot(time, np.degrees(truth), color=colour, label=label)
        below.plot(time, np.degrees(error), color=colour, linewidth=0.9)
        below.fill_between(time, -2.0 * np.degrees(sigma), 2.0 * np.degrees(sigma), color=colour,
                           alpha=0.2, linewidth=0.0)
    above.set(ylabel='link minus link a [deg]')
    legend_above(above)
    below.set(xlabel='time [s]', ylabel='estimate minus truth [deg]', ylim=(-0.2, 0.2))
    figure.tight_layout()
    return figure


def _draw_arrivals(axes: Axes, truth: dict[int, Array], samples: list[tuple[int, int, str, float]]
                   ) -> None:
    """Draw what link a does in 60 ms, and when which sample of it comes."""
    begin, end = 100_000_000, 160_000_000
    stamps = np.array([stamp for stamp in truth if begin <= stamp <= end])
    axes.plot(1e-6 * stamps, [1e3 * truth[stamp][0] for stamp in stamps], color=COLOURS['ink'],
              label='truth')
    shown = [(1e-6 * measured, 1e-6 * arrived, 1e3 * angle)
             for measured, arrived, _, angle in samples if begin <= measured and arrived <= end]
    for measured, arrived, angle in shown:
        axes.plot([measured, arrived], [angle, angle], color=COLOURS['muted'], linewidth=0.8)
    measured, arrived, angles = np.array(shown).T
    axes.plot(measured, angles, 'o', color=LINK_COLOURS[0], markersize=4, label='measured')
    axes.plot(arrived, angles, 'o', color=LINK_COLOURS[0], markersize=4, fillstyle='none',
              label='handed out')
    axes.set(xlabel='time [ms]', ylabel='link a [mrad]', title='Samples on their way')
    axes.legend(loc='upper left')


def _record(excitation: Excitation, seed: int) -> tuple[LinkMeasurements, WheelMeasurements]:
    """Drive the prototype on its table by an excitation, and keep what it says."""
    device = SimulatedTable(
        Plant(load_mechanism('prototype'), load_table('prototype'), InitialState(), 1e-3,
              np.random.default_rng(seed)), 4_000_000)
    links, angles, ticks, wheels = [], [], [], []
    now, drive = np.full(4, np.nan), no_torque()
    for stamp_ns in range(0, 300_000_000_000, device.period_ns):
        samples = device.step(stamp_ns, drive)
        for reading in samples.links:
            row = np.full(4, np.nan)
            row[[LINK_NAMES.index(name) for name in reading.names]] = reading.angles
            now = np.where(np.isfinite(row), row, now)
            links.append(reading.stamp_ns)
            angles.append(row)
        ticks.append(stamp_ns * 1e-9)
        wheels.append(samples.wheels)
        if np.isfinite(now).all():
            asked = excitation.efforts(stamp_ns * 1e-9, now, samples.wheels.speeds)
            if asked is None:
                break
            drive = drive_by_name(list(asked), (), (), list(asked.values()))
    return link_measurements(np.array(links), np.array(angles), 0), WheelMeasurements(
        np.array(ticks), *(np.array([getattr(sample, name) for sample in wheels])
                           for name in ('angles', 'speeds', 'efforts')))


def calibrated_wheels() -> Figure:
    """Draw the calibration of the four wheels of the prototype."""
    mechanism = load_mechanism('prototype')
    signals = _record(SpinAndCoast(mechanism, range(4), 100.0, 0.02, 10.0), 0)
    return wheels_figure([wheel_estimate(wheel, *signals) for wheel in range(4)])


def calibrated_links() -> Figure:
    """Draw the calibration of its links, from a file that is 5 % off."""
    mechanism = load_mechanism('prototype')
    signals = _record(MultiSine(mechanism, 30.0, 0.02), 0)
    return links_figure(link_estimate(
        replace(mechanism, link_inertias=1.05 * mechanism.link_inertias), *signals))


if __name__ == '__main__':
    main()
