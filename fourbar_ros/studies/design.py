# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Required size of wheels and motors for given manoeuvres, and the best link lengths.

Beyond the paper. The prototype on its table: inverse dynamics with friction and losses over wheel
inertia, motor constant and the ratio of the link lengths; the closed loop repeats the manoeuvres.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import ceil, degrees, inf
from typing import Any

from fourbar_ros.common.checks import at_most, Check, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.control.feasibility import shortest_duration, Wheels
from fourbar_ros.control.setpoint import SetpointError
from fourbar_ros.loop import load_scenario, Scenario, ScriptedSetpoint
from fourbar_ros.loop.run import run_scenario
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import assemble, kinetic_energy, LINK_NAMES, load_mechanism, Mechanism
from fourbar_ros.mechanism.forces import forces_along
from fourbar_ros.plant import load_table, Table
from fourbar_ros.plant.table import surroundings_of
from fourbar_ros.studies import figures, Result
from fourbar_ros.studies.design_model import (
    BEAM,
    Design,
    DURATION,
    evaluate,
    least_energy,
    MANOEUVRES,
    RADIUS,
    RIM,
    SPEED_SHARE,
    THETA,
    TITLES,
    TORQUE_SHARE,
    VOLTAGE_SHARE,
    wheel_mass,
    with_ratio,
    with_wheels,
)
from fourbar_ros.studies.planned_cost import ActuationCost, peak, rest_to_rest
import numpy as np
from scipy.integrate import trapezoid

INERTIAS = np.geomspace(2e-5, 5e-3, 49)
# Length of link a over that of link b at constant circumference.
RATIOS = np.geomspace(0.4, 2.5, 45)
# Relative tolerances of the closed loop against inverse dynamics. In a turn of the whole, sticking
# joints exchange momentum between the pairs, so that only the mean of all wheels is determined.
MEAN_NEAR, END_NEAR = 0.01, 0.05
# Relative error of the energy balance of the inverse dynamics.
BALANCE = 1e-3

CRITERIA: dict[str, Callable[[Design], float]] = {
    'whole_drawn': lambda design: float(design.costs['whole'].energy_drawn[-1]),
    'configuration_drawn': lambda design: float(design.costs['configuration'].energy_drawn[-1]),
    'drawn': lambda design: design.energy_drawn, 'speed': lambda design: design.speed,
    'torque': lambda design: design.torque}


def run(progress: Progress) -> Result:
    """Evaluate all designs, and run the manoeuvres of the prototype in the closed loop."""
    warm_up()
    table, nominal = load_table('prototype'), load_mechanism('prototype')
    variants = [*(with_wheels(nominal, float(value)) for value in INERTIAS),
                *(with_ratio(nominal, float(value)) for value in RATIOS)]
    designs = [evaluate(variant, table) for variant in progress(variants, len(variants))]
    sizes, ratios = designs[:len(INERTIAS)], designs[len(INERTIAS):]
    present = evaluate(nominal, table)
    least = evaluate(with_wheels(nominal, least_wheel(sizes)), table)
    looped = {name: closed_loop(nominal, turn) for name, turn in MANOEUVRES.items()}
    squared_constant = float(nominal.motor_torque_constants[0] ** 2 / nominal.motor_resistances[0])
    data = {
        'duration_s': DURATION, 'manoeuvres_rad': MANOEUVRES,
        'shares': {'speed': SPEED_SHARE, 'torque': TORQUE_SHARE, 'voltage': VOLTAGE_SHARE},
        'rim': RIM, 'radius_m': RADIUS, 'beam_kg_m': BEAM,
        'present': present.as_json(), 'least': least.as_json(),
        'moves_until_speed_limit': moves_until_limit(present),
        'shortest_duration_s': {name: _shortest(nominal, table, turn)
                                for name, turn in MANOEUVRES.items()},
        'copper_j_at_1_n_m_per_sqrt_w': {
            name: float(cost.copper_loss[-1]) * squared_constant
            for name, cost in present.costs.items()},
        'best_ratio': {key: float(RATIOS[int(np.argmin([get(design) for design in ratios]))])
                       for key, get in CRITERIA.items()},
        'in_the_loop': looped,
        'sizes': [design.as_json() for design in sizes],
        'ratios': [design.as_json() for design in ratios]}
    files: dict[str, str | bytes] = {'design.csv': _csv(sizes, ratios)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.design_figure import png
        files['design.png'] = png(sizes, ratios, present, least)
    return Result(_checks(present, least, looped, table), data,
                  _text(present, least, data), files, skipped)


def least_wheel(sizes: Sequence[Design]) -> float:
    """Return the inertia of the lightest wheel within the shares, rounded up to two digits."""
    for design in sizes:
        if design.within_shares:
            digit = 10.0 ** (np.floor(np.log10(design.inertia)) - 1.0)
            return float(ceil(design.inertia / digit - 1e-9) * digit)
    return sizes[-1].inertia


def moves_until_limit(design: Design) -> int:
    """Return the number of configuration moves in one direction until the speed limit."""
    limit = SPEED_SHARE * float(design.mechanism.motor_speed_limits.min())
    moves, speed = 0, 0.0
    while speed + design.speed <= limit and moves < 1000:
        moves += 1
        speed += design.residual_speed
    return moves


def closed_loop(mechanism: Mechanism, turn: tuple[float, float]) -> dict[str, float]:
    """
    Run a manoeuvre in the closed loop, on the prototype's table.

    :param turn: angles by which links a and b turn [rad].
    """
    base = load_scenario('prototype')
    scenario: Scenario = replace(
        base, mechanism=mechanism, model=mechanism,
        setpoints=(ScriptedSetpoint(0.4, LINK_NAMES[:2], (turn[0], THETA + turn[1]), DURATION),))
    peaks, mean, error = np.zeros(4), 0.0, inf
    for step in run_scenario(scenario):
        truth = step.samples.truth
        assert truth is not None
        peaks = np.maximum(peaks, np.abs(truth.wheel_speeds))
        mean = max(mean, abs(float(truth.wheel_speeds.mean())))
        error = peak(truth.link_angles[:2] - scenario.setpoints[0].positions)
        last = truth.wheel_speeds
    return {'peak_speed_rad_s': float(peaks.max()), 'peak_mean_speed_rad_s': mean,
            'final_error_deg': degrees(error), 'end_speed_rad_s': peak(last)}


def imbalance(cost: ActuationCost, table: Table) -> float:
    """Return the error of the energy balance of motors, wheels, links and losses, relative."""
    mechanism, times = cost.mechanism, cost.times
    power = cost.motor_powers.sum(axis=1)
    in_bearings = (cost.bearings * cost.motor_speeds).sum(axis=1)
    external = (forces_along(
        cost.angles, cost.link_rates, np.array([mechanism.constants]),
        np.array([surroundings_of(table)])) * cost.link_rates).sum(axis=1)
    start, end = (kinetic_energy(mechanism, cost.angles[n], cost.link_rates[n], cost.speeds[n])
                  for n in (0, -1))
    missing = float(trapezoid(power - in_bearings + external, times)) - (end - start)
    return abs(missing) / float(trapezoid(np.abs(power), times))


def _shortest(mechanism: Mechanism, table: Table, turn: tuple[float, float]) -> float | None:
    """Return the shortest duration that the motors allow, bearing friction included."""
    segment = rest_to_rest(THETA, turn, DURATION)
    bearing = np.full(4, table.wheel_bearings.coulomb)
    try:
        return shortest_duration(
            mechanism, segment, assemble(mechanism, 0.0, THETA),
            Wheels(np.zeros(4), least_energy(mechanism), bearing))
    except SetpointError:
        return None


def _checks(present: Design, least: Design, looped: Mapping[str, Mapping[str, float]],
            table: Table) -> list[Check]:
    mean = peak(present.costs['whole'].motor_speeds.mean(axis=1))
    limits = least.mechanism
    return [
        within('the loop beside the plan, the whole, mean wheel speed',
               looped['whole']['peak_mean_speed_rad_s'] / mean, '', 1.0 - MEAN_NEAR,
               1.0 + MEAN_NEAR),
        within('the loop beside the plan, configuration, wheel speed at the end',
               looped['configuration']['end_speed_rad_s'] / present.residual_speed, '',
               1.0 - END_NEAR, 1.0 + END_NEAR),
        *(at_most(f'energy that is not accounted for, {name}', imbalance(cost, table), '',
                  BALANCE) for name, cost in present.costs.items()),
        at_most('least wheels: speed over the limit',
                least.speed / float(limits.motor_speed_limits.min()), '', SPEED_SHARE),
        at_most('least wheels: torque over the limit',
                least.torque / float(limits.motor_torque_limits.min()), '', TORQUE_SHARE),
        at_most('least wheels: voltage over the supply',
                least.voltage / float(limits.motor_voltages.min()), '', VOLTAGE_SHARE)]


def _text(present: Design, least: Design, data: Mapping[str, Any]) -> str:
    rows: tuple[tuple[str, Callable[[Design], float]], ...] = (
        ('wheel inertia [kg m^2]', lambda design: design.inertia),
        ('wheel mass [kg]', lambda design: wheel_mass(design.inertia)),
        ('mass of the whole [kg]', lambda design: design.mass),
        ('peak speed [rad/s]', lambda design: design.speed),
        ('peak torque [N m]', lambda design: design.torque),
        ('peak power of a motor [W]', lambda design: design.power),
        ('peak voltage [V]', lambda design: design.voltage),
        ('energy drawn, both manoeuvres [J]', lambda design: design.energy_drawn),
        ('wheel speed after a configuration move [rad/s]', lambda design: design.residual_speed),
        ('configuration moves until half of the speed limit', moves_until_limit))
    lines = [f'{"":<44}{"present":>12}{"least wheels":>14}']
    lines += [f'{label:<52}{get(present):>10.4g}{get(least):>12.4g}' for label, get in rows]
    lines += ['']
    for name, duration in data['shortest_duration_s'].items():
        lines.append(f'shortest duration with the present motors, {TITLES[name]}: '
                     + ('not feasible' if duration is None else f'{duration:.2f} s'))
    best = data['best_ratio']
    lines.append(f'best ratio of lengths a / b by energy: {best["whole_drawn"]:.2f} to turn the '
                 f'whole, {best["configuration_drawn"]:.2f} to turn b alone, {best["drawn"]:.2f} '
                 'for both')
    for name, looped in data['in_the_loop'].items():
        lines.append(f'closed loop, {TITLES[name]}: peak {looped["peak_speed_rad_s"]:.1f} rad/s, '
                     f'mean of the wheels {looped["peak_mean_speed_rad_s"]:.1f} rad/s, end '
                     f'{looped["end_speed_rad_s"]:.1f} rad/s')
    return '\n'.join(lines)


def _csv(sizes: Sequence[Design], ratios: Sequence[Design]) -> str:
    names = [name for name, value in sizes[0].as_json().items() if isinstance(value, float)]
    lines = [','.join(['swept', *names])]
    for kind, designs in (('size', sizes), ('ratio', ratios)):
        for row in (design.as_json() for design in designs):
            lines.append(','.join([kind, *(f'{row[name]:.9g}' for name in names)]))
    return '\n'.join([*lines, ''])
