# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Energy of four wheels compared with two (paper section 4, Fig. 4), and the limits of eq. 8.

A soft step of a quarter turn in 10 s from rest: eq. 7, eq. 9 as printed, work and copper loss by
inverse dynamics; the integrator repeats each motion. Two further cases show where least wheel
accelerations (eq. 8) are not least energy: unequal wheels, and wheels with initial speeds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import pi
from typing import Any

from fourbar_ros.common.checks import at_least, at_most, Check, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.control.allocation import make_allocation
from fourbar_ros.mechanism import assemble, load_mechanism, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.state import make_state
from fourbar_ros.studies import figures, Result
from fourbar_ros.studies.planned_cost import (
    actuation_cost,
    ActuationCost,
    peak,
    rest_to_rest,
    simulate_torques,
)
import numpy as np
from scipy.integrate import cumulative_trapezoid

DURATION, TURN, THETA = 10.0, pi / 2.0, pi / 3.0
MANOEUVRES = {'whole': (TURN, TURN), 'configuration': (0.0, TURN)}
TITLES = {'whole': 'the whole turns', 'configuration': 'b and d turn, a and c stay'}

# Motor constant of the paper's links [N m/sqrt(W)]. The paper describes no motors; this value
# scales all copper losses and none of their ratios.
MOTOR_CONSTANT = 1e-3

# Wheel inertias of the paper's Fig. 5, relative to those of section 3.
UNEQUAL = (0.88, 0.41, 1.37, 0.77)
# Initial speeds of opposite wheels [rad/s], and the rate at which their difference decays [1/s].
INITIAL_SPEEDS, BALANCING = (80.0, 0.0, -80.0, 0.0), 1.0

# Largest rate of a soft step [turn / time], and the integral of its square [turn^2 / time].
PEAK_RATE, SQUARED_RATE = 15.0 / 8.0, 10.0 / 7.0
# Relative tolerance of the numbers against the closed form.
NEAR = 1e-6
RATIOS = ('peak_speed_rad_s', 'peak_energy_j', 'eq9_j_s', 'work_j', 'copper_j')
# Ratio of four wheels to two. The work differs from it by 0.1 %, because the links take the same.
RATIO, RATIO_TOLERANCE = 0.5, 0.005
# Largest difference between the planned and the integrated motion [rad].
INTEGRATED_RAD = 1e-6

Costs = Mapping[str, Mapping[str, ActuationCost]]


def run(progress: Progress) -> Result:
    """Evaluate all manoeuvres."""
    paper = replace(load_mechanism('paper'), motor_resistances=np.ones(4),
                    motor_torque_constants=np.full(4, MOTOR_CONSTANT))
    costs: dict[str, dict[str, ActuationCost]] = {}
    for name, goal in progress(MANOEUVRES.items(), len(MANOEUVRES)):
        costs[name] = {'two_wheels': turn(paper, goal, 'two_wheels'),
                       'four_wheels': turn(paper, goal, 'min_norm')}
    whole = MANOEUVRES['whole']
    unequal = replace(paper, flywheel_inertias=paper.flywheel_inertias * UNEQUAL)
    costs['unequal_wheels'] = {
        law: turn(unequal, whole, law) for law in ('min_norm', 'min_energy')}
    speeds = np.array(INITIAL_SPEEDS)
    costs['off_balance'] = {'min_norm': turn(paper, whole, 'min_norm', speeds),
                            'balancing': balancing(turn(paper, whole, 'min_energy', speeds))}
    prototype = load_mechanism('prototype')
    costs['prototype'] = {'two_wheels': turn(prototype, whole, 'two_wheels'),
                          'four_wheels': turn(prototype, whole, 'min_norm')}
    totals = {name: {law: cost.totals() for law, cost in laws.items()}
              for name, laws in costs.items()}
    for name, laws in costs.items():
        first = next(iter(laws.values()))
        totals[name]['least'] = {
            'peak_energy_j': float(first.least_energy.max()),
            'eq9_j_s': float(cumulative_trapezoid(2.0 * first.least_energy, first.times)[-1])}
    ratios = {name: {key: totals[name]['four_wheels'][key] / totals[name]['two_wheels'][key]
                     for key in RATIOS} for name in (*MANOEUVRES, 'prototype')}
    data = {
        'duration_s': DURATION, 'turn_rad': TURN,
        'motor_constant_n_m_per_sqrt_w': MOTOR_CONSTANT,
        'unequal_inertias_of_nominal': UNEQUAL, 'off_balance_speeds_rad_s': INITIAL_SPEEDS,
        'balancing_rad_s': BALANCING,
        'two_wheels': totals['whole']['two_wheels'],
        'four_wheels': totals['whole']['four_wheels'], 'ratios_four_to_two': ratios,
        'manoeuvres': totals}
    files: dict[str, str | bytes] = {'energy.csv': _csv(costs)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.energy_figure import png
        files['energy.png'] = png(costs, BALANCING)
    return Result(_checks(costs, totals, ratios), data, _table(totals), files, skipped)


def turn(mechanism: Mechanism, goal: tuple[float, float], law: str, speeds: Array | None = None
         ) -> ActuationCost:
    """
    Turn links a and b by a soft step from rest at theta = pi/3.

    :param goal: angles by which they turn [rad].
    :param law: a name of `control.allocation.ALLOCATIONS`.
    :param speeds: (4,) initial absolute speeds of the wheels, default 0 [rad/s].
    """
    return actuation_cost(
        mechanism, rest_to_rest(THETA, goal, DURATION), assemble(mechanism, 0.0, THETA),
        make_allocation(law, mechanism.flywheel_inertias, [True] * 4), speeds)


def closed_form(wheels: float) -> dict[str, float]:
    """
    Evaluate the turn of the whole by conservation of momentum: each pair has `(2 I + m l^2/2) u`.

    :param wheels: number of wheels that share the momentum of a pair.
    """
    paper = load_mechanism('paper')
    inertia = 2.0 * float(paper.link_inertias[0]) + 0.5 * float(
        paper.link_masses[0] * paper.link_lengths[0] ** 2)
    wheel = wheels * float(paper.flywheel_inertias[0])
    speed = inertia * PEAK_RATE * TURN / DURATION / wheel
    return {'peak_speed_rad_s': speed, 'peak_energy_j': wheel * speed ** 2,
            'eq9_j_s': 2.0 * inertia ** 2 * SQUARED_RATE * TURN ** 2 / DURATION / wheel}


def balancing(cost: ActuationCost) -> ActuationCost:
    """
    Let the speed difference within each pair decay as exp(-BALANCING t), which moves no link.

    :param cost: with the law `min_energy`, which leaves the differences as they are.
    """
    difference = ((cost.speeds - cost.balanced_speeds)
                  * np.exp(-BALANCING * cost.times)[:, None])
    return replace(cost, speeds=cost.balanced_speeds + difference, torques=cost.torques
                   - BALANCING * cost.mechanism.flywheel_inertias * difference)


def integration_error(cost: ActuationCost) -> float:
    """Integrate the motion under its torques; return the largest error of a link angle [rad]."""
    # Every second instant is the middle of a step of the integrator.
    state = make_state(cost.angles[0], cost.link_rates[0], cost.speeds[0])
    angles = simulate_torques(cost.mechanism, state, cost.torques,
                              float(cost.times[2] - cost.times[0]))
    return peak(angles - cost.angles[::2])


def _checks(costs: Costs, totals: Mapping[str, Any], ratios: Mapping[str, Mapping[str, float]]
            ) -> list[Check]:
    checks = [within(f'four wheels / two wheels, {TITLES[name]}, {key}', ratios[name][key], '',
                     RATIO - RATIO_TOLERANCE, RATIO + RATIO_TOLERANCE)
              for name in MANOEUVRES for key in RATIOS]
    for law, wheels in (('two_wheels', 1.0), ('four_wheels', 2.0)):
        for (key, known), unit in zip(closed_form(wheels).items(), ('rad/s', 'J', 'J s')):
            checks.append(within(f'{law}, the whole turns, {key}', totals['whole'][law][key], unit,
                                 known * (1.0 - NEAR), known * (1.0 + NEAR)))
    checks += [at_most(f'{name}, {law}, flown', integration_error(cost), 'rad', INTEGRATED_RAD)
               for name, laws in costs.items() for law, cost in laws.items()]
    # Up to rounding: eq. 8 is the least itself for equal wheels that start balanced.
    checks += [at_least(f'{name}, {law}, eq. 9 over the least',
                        totals[name][law]['eq9_j_s'] / totals[name]['least']['eq9_j_s'], '',
                        1.0 - 1e-9) for name, laws in costs.items() for law in laws]
    return checks


def _table(totals: Mapping[str, Any]) -> str:
    lines = [f'{"":<34}{"peak speed":>12}{"energy":>12}{"eq. 9":>12}{"work":>12}{"copper":>12}',
             f'{"":<34}{"rad/s":>12}{"J":>12}{"J s":>12}{"J":>12}{"J":>12}']
    lines += [f'{name + ", " + law:<34}' + ''.join(
        f'{total[key]:>12.5g}' if key in total else f'{"":>12}' for key in RATIOS)
        for name, laws in totals.items() for law, total in laws.items()]
    return '\n'.join(lines)


def _csv(costs: Costs) -> str:
    """Return the curves of the figure, every 25 ms."""
    wheels = ','.join(f'speed_{letter}_rad_s' for letter in 'abcd')
    lines = [f'manoeuvre,law,t_s,energy_j,eq9_j_s,work_j,copper_j,{wheels}']
    for name, laws in costs.items():
        for law, cost in laws.items():
            table = np.column_stack([cost.times, cost.energy, cost.eq9, cost.work,
                                     cost.copper_loss, cost.speeds])
            lines += [f'{name},{law},' + ','.join(f'{value:.9g}' for value in row)
                      for row in table[::10]]
    return '\n'.join([*lines, ''])
