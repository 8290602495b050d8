# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
What four wheels save over two, paper section 4 and Fig. 4, and where its rule is not the best.

A soft step of a quarter turn in 10 s from rest: eq. 7, eq. 9 as printed, work and copper loss, by
inverse dynamics; each is flown once more through the integrator. Then the two cases in which least
wheel accelerations (eq. 8) are not least energy: unequal wheels, and wheels that turn beforehand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import io
from math import pi
from typing import Any

from fourbar_ros.common.checks import at_least, at_most, Check, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.control.allocation import mobilities
from fourbar_ros.control.soft_step import SoftStep
from fourbar_ros.mechanism import assemble, load_mechanism, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.state import make_state
from fourbar_ros.studies import figures, Result
from fourbar_ros.studies.actuation_cost import fly, spend, Spending
import numpy as np
from scipy.integrate import cumulative_trapezoid

DURATION, TURN, THETA = 10.0, pi / 2.0, pi / 3.0
MANOEUVRES = {'whole': (TURN, TURN), 'configuration': (0.0, TURN)}
SAID = {'whole': 'the whole turns', 'configuration': 'b and d turn, a and c stay'}

# The paper describes no windings. Its links get motors of so much torque per root of lost power,
# which scales all copper losses and no ratio of them [N m/sqrt(W)].
MOTOR_CONSTANT = 1e-3

# Wheel inertias of the paper's Fig. 5, in units of those of section 3.
UNEQUAL = (0.88, 0.41, 1.37, 0.77)
# Wheels a and c turn against each other beforehand [rad/s], and are brought to equal speeds so
# fast [rad/s].
SPUN, BALANCING = (80.0, 0.0, -80.0, 0.0), 1.0

# Of a soft step the largest rate [turn / time], and the integral of its square [turn^2 / time].
PEAK_RATE, SQUARED_RATE = 15.0 / 8.0, 10.0 / 7.0
# How near to what these give by hand the numbers must be, as a share.
NEAR = 1e-6
RATIOS = ('peak_speed_rad_s', 'peak_energy_j', 'eq9_j_s', 'work_j', 'copper_j')
RATIO, RATIO_WITHIN = 0.5, 0.005
# How far the motion that the torques make may be from the one that they were worked out for.
FLOWN_RAD = 1e-6


def run(progress: Progress) -> Result:
    """Work out all manoeuvres."""
    paper = with_windings(load_mechanism('paper'))
    found: dict[str, dict[str, Spending]] = {}
    for name, goal in progress(MANOEUVRES.items(), len(MANOEUVRES)):
        found[name] = {'two_wheels': turn(paper, goal, 'two_wheels'),
                       'four_wheels': turn(paper, goal, 'min_norm')}
    whole = MANOEUVRES['whole']
    unequal = replace(paper, flywheel_inertias=paper.flywheel_inertias * UNEQUAL)
    found['unequal_wheels'] = {
        'min_norm': turn(unequal, whole, 'min_norm'),
        'min_energy': turn(unequal, whole, 'min_energy')}
    spun = np.array(SPUN)
    kept = turn(paper, whole, 'min_energy', spun)
    found['off_balance'] = {
        'min_norm': turn(paper, whole, 'min_norm', spun), 'balancing': balancing(kept)}
    prototype = load_mechanism('prototype')
    found['prototype'] = {'two_wheels': turn(prototype, whole, 'two_wheels'),
                          'four_wheels': turn(prototype, whole, 'min_norm')}
    totals = {name: {law: spending.totals() for law, spending in laws.items()}
              for name, laws in found.items()}
    for name, laws in found.items():
        least = least_energy(next(iter(laws.values())))
        totals[name]['least'] = {
            'peak_energy_j': float(least.max()),
            'eq9_j_s': float(cumulative_trapezoid(
                2.0 * least, next(iter(laws.values())).times)[-1])}
    ratios = {name: {key: totals[name]['four_wheels'][key] / totals[name]['two_wheels'][key]
                     for key in RATIOS} for name in (*MANOEUVRES, 'prototype')}
    data = {
        'duration_s': DURATION, 'turn_rad': TURN,
        'motor_constant_n_m_per_sqrt_w': MOTOR_CONSTANT,
        'unequal_inertias_of_nominal': UNEQUAL, 'off_balance_speeds_rad_s': SPUN,
        'balancing_rad_s': BALANCING,
        'two_wheels': totals['whole']['two_wheels'],
        'four_wheels': totals['whole']['four_wheels'], 'ratios_four_to_two': ratios,
        'manoeuvres': totals}
    files: dict[str, str | bytes] = {'energy.csv': _csv(found)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.energy_figure import png
        files['energy.png'] = png(found)
    return Result(_checks(found, totals, ratios), data, _table(totals), files, skipped)


def with_windings(mechanism: Mechanism) -> Mechanism:
    """Give its motors windings of `MOTOR_CONSTANT` that take any voltage."""
    return replace(mechanism, motor_torque_constants=np.full(4, MOTOR_CONSTANT),
                   motor_resistances=np.ones(4))


def turn(mechanism: Mechanism, goal: tuple[float, float], law: str, speeds: Array | None = None
         ) -> Spending:
    """
    Turn links a and b by a soft step from rest, theta = pi/3.

    :param goal: by how much [rad].
    :param law: of `control.allocation.ALLOCATIONS`.
    :param speeds: (4,) of the wheels beforehand, absolute, default 0 [rad/s].
    """
    start = np.zeros((3, 2))
    start[0] = 0.0, THETA
    return spend(
        mechanism, SoftStep(start, start[0] + goal, DURATION), assemble(mechanism, 0.0, THETA),
        mobilities(law, mechanism.flywheel_inertias, [True] * 4), speeds)


def by_momentum(wheels: float) -> dict[str, float]:
    """
    Work out by hand what the quarter turn of the whole takes: each pair holds `(2 I + m l^2/2) u`.

    :param wheels: that share the momentum of a pair.
    """
    paper = load_mechanism('paper')
    inertia = 2.0 * float(paper.link_inertias[0]) + 0.5 * float(
        paper.link_masses[0] * paper.link_lengths[0] ** 2)
    wheel = wheels * float(paper.flywheel_inertias[0])
    peak = inertia * PEAK_RATE * TURN / DURATION / wheel
    return {'peak_speed_rad_s': peak, 'peak_energy_j': wheel * peak ** 2,
            'eq9_j_s': 2.0 * inertia ** 2 * SQUARED_RATE * TURN ** 2 / DURATION / wheel}


def balanced_speeds(spending: Spending) -> Array:
    """
    Return the speeds with the least energy for the momentum that each pair holds.

    Of a parallelogram: equal speeds within each pair, of unequal wheels too.

    :returns: (n, 4) [rad/s].
    """
    inertias = spending.mechanism.flywheel_inertias
    balanced = np.empty_like(spending.speeds)
    for pair in ([0, 2], [1, 3]):
        momentum = spending.speeds[:, pair] @ inertias[pair]
        balanced[:, pair] = (momentum / inertias[pair].sum())[:, None]
    return balanced


def least_energy(spending: Spending) -> Array:
    """Return the least kinetic energy of wheels that make the same motion (n,) [J]."""
    found: Array = 0.5 * balanced_speeds(spending) ** 2 @ spending.mechanism.flywheel_inertias
    return found


def balancing(spending: Spending) -> Spending:
    """
    Let what the wheels of a pair differ by decay as exp(-BALANCING t), which moves no link.

    :param spending: of wheels that keep their differences: of the law `min_energy`.
    """
    balanced = balanced_speeds(spending)
    fading = (spending.speeds - balanced) * np.exp(-BALANCING * spending.times)[:, None]
    inertias = spending.mechanism.flywheel_inertias
    return replace(spending, speeds=balanced + fading,
                   torques=spending.torques - BALANCING * inertias * fading)


def flown(spending: Spending) -> float:
    """
    Let the torques drive the linkage through the integrator.

    :returns: how far a link comes off the way for which they were worked out [rad].
    """
    # Every second instant is the middle of a step of the integrator.
    state = make_state(spending.angles[0], spending.link_rates[0], spending.speeds[0])
    angles = fly(spending.mechanism, state, spending.torques,
                 float(spending.times[2] - spending.times[0]))
    return float(np.abs(angles - spending.angles[::2]).max())


def _checks(found: Mapping[str, Mapping[str, Spending]], totals: Mapping[str, Any],
            ratios: Mapping[str, Mapping[str, float]]) -> list[Check]:
    checks = [within(f'four wheels / two wheels, {SAID[name]}, {key}', ratios[name][key], '',
                     RATIO - RATIO_WITHIN, RATIO + RATIO_WITHIN)
              for name in MANOEUVRES for key in RATIOS]
    for law, wheels in (('two_wheels', 1.0), ('four_wheels', 2.0)):
        for (key, by_hand), unit in zip(by_momentum(wheels).items(), ('rad/s', 'J', 'J s')):
            checks.append(within(f'{law}, the whole turns, {key}', totals['whole'][law][key], unit,
                                 by_hand * (1.0 - NEAR), by_hand * (1.0 + NEAR)))
    checks += [at_most(f'{name}, {law}, flown', flown(spending), 'rad', FLOWN_RAD)
               for name, laws in found.items() for law, spending in laws.items()]
    for name, laws in found.items():
        for law in laws:
            # To rounding: eq. 8 is the least itself where wheels are equal and start balanced.
            checks.append(at_least(
                f'{name}, {law}, eq. 9 over the least',
                totals[name][law]['eq9_j_s'] / totals[name]['least']['eq9_j_s'], '', 1.0 - 1e-9))
    return checks


def _table(totals: Mapping[str, Any]) -> str:
    lines = [f'{"":<34}{"peak speed":>12}{"energy":>12}{"eq. 9":>12}{"work":>12}{"copper":>12}',
             f'{"":<34}{"rad/s":>12}{"J":>12}{"J s":>12}{"J":>12}{"J":>12}']
    for name, laws in totals.items():
        for law, numbers in laws.items():
            lines.append(f'{name + ", " + law:<34}' + ''.join(
                f'{numbers[key]:>12.5g}' if key in numbers else f'{"":>12}' for key in RATIOS))
    return '\n'.join(lines)


def _csv(found: Mapping[str, Mapping[str, Spending]]) -> str:
    """Return what the figure shows, every 25 ms."""
    file = io.StringIO()
    wheels = ','.join(f'speed_{letter}_rad_s' for letter in 'abcd')
    file.write(f'manoeuvre,law,t_s,energy_j,eq9_j_s,work_j,copper_j,{wheels}\n')
    for name, laws in found.items():
        for law, spending in laws.items():
            table = np.column_stack([
                spending.times, spending.energy, spending.eq9, spending.work, spending.copper,
                spending.speeds])
            for row in table[::10]:
                file.write(f'{name},{law},' + ','.join(f'{value:.9g}' for value in row) + '\n')
    return file.getvalue()
