# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
How large wheels and motors must be for wanted manoeuvres, and which links are best for them.

Beyond the paper. The prototype on its table: inverse dynamics with friction and losses over wheel
inertia, motor, and the ratio of the link lengths; then the answer, in the closed loop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
import io
from math import ceil, degrees, inf, pi
from typing import Any

from fourbar_ros.common.checks import at_most, Check, within
from fourbar_ros.common.progress import Progress
from fourbar_ros.control.feasibility import shortest_duration, Wheels
from fourbar_ros.control.setpoint import SetpointError
from fourbar_ros.control.soft_step import SoftStep
from fourbar_ros.loop import load_scenario, Scenario, ScriptedSetpoint
from fourbar_ros.loop.run import run_scenario
from fourbar_ros.loop.warm_up import warm_up
from fourbar_ros.mechanism import assemble, kinetic_energy, LINK_NAMES, load_mechanism, Mechanism
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.mechanism.forces import forces_along
from fourbar_ros.plant import load_table, Table
from fourbar_ros.plant.table import surroundings_of
from fourbar_ros.studies import figures, Result
from fourbar_ros.studies.actuation_cost import spend, Spending
import numpy as np
from scipy.integrate import trapezoid

DURATION, THETA = 10.0, pi / 3.0
# By how much links a and b turn [rad].
MANOEUVRES = {'whole': (pi / 2.0, pi / 2.0), 'configuration': (0.0, pi / 4.0)}
SAID = {'whole': 'the whole by 90 deg', 'configuration': 'link b by 45 deg'}
SAMPLES = 801

# Of what a motor can, a manoeuvre may take such shares; the rest is for feedback, for what
# friction leaves in the wheels, and for being wrong.
SPEED_SHARE, TORQUE_SHARE, VOLTAGE_SHARE = 0.5, 0.5, 0.8

# A wheel is a rim: I = RIM m r^2, with a radius that the link has room for [m].
RIM, RADIUS = 0.7, 0.05
INERTIAS = np.geomspace(2e-5, 5e-3, 49)
# Length of a over that of b, their mean being kept; of a link's mass so much goes with its length.
RATIOS = np.geomspace(0.4, 2.5, 45)
BEAM = 0.5      # kg/m
# What the loop needs may differ so much from what was worked out, as a share. In a turn of the
# whole, joints that stick shift momentum between the pairs, as it happens; the mean of all wheels
# is what is left.
MEAN_NEAR, END_NEAR = 0.01, 0.05
# Energy that inverse dynamics may lose or find, as a share.
BALANCE = 1e-3


@dataclass(frozen=True)
class Design:
    """
    What a linkage takes for the manoeuvres.

    :param mechanism: the linkage.
    :param spendings: by manoeuvre.
    """

    mechanism: Mechanism
    spendings: Mapping[str, Spending]

    @property
    def speed(self) -> float:
        """Largest speed of a motor [rad/s]."""
        return max(_peak(spending.motor_speeds) for spending in self.spendings.values())

    @property
    def torque(self) -> float:
        """Largest torque of a motor [N m]."""
        return max(_peak(spending.motor_torques) for spending in self.spendings.values())

    @property
    def power(self) -> float:
        """Largest mechanical power of a motor [W]."""
        return max(_peak(spending.motor_torques * spending.motor_speeds)
                   for spending in self.spendings.values())

    @property
    def voltage(self) -> float:
        """Largest voltage at a winding [V]."""
        mechanism = self.mechanism
        return max(_peak(spending.currents * mechanism.motor_resistances
                         + spending.motor_speeds * mechanism.motor_torque_constants)
                   for spending in self.spendings.values())

    @property
    def drawn(self) -> float:
        """Energy that the supplies give for all manoeuvres together [J]."""
        return sum(float(spending.drawn[-1]) for spending in self.spendings.values())

    @property
    def mass(self) -> float:
        """Mass of all links [kg]."""
        return float(self.mechanism.link_masses.sum())

    @property
    def left_over(self) -> float:
        """Largest speed of a wheel after the configuration move, which friction left [rad/s]."""
        return _peak(self.spendings['configuration'].motor_speeds[-1])

    def keeps(self) -> bool:
        """Tell whether the shares are kept."""
        mechanism = self.mechanism
        return (self.speed <= SPEED_SHARE * float(mechanism.motor_speed_limits.min())
                and self.torque <= TORQUE_SHARE * float(mechanism.motor_torque_limits.min())
                and self.voltage <= VOLTAGE_SHARE * float(mechanism.motor_voltages.min()))

    def as_json(self) -> dict[str, Any]:
        """Return its numbers."""
        return {
            'link_a_over_link_b': float(np.divide(*self.mechanism.link_lengths[:2])),
            'flywheel_inertia_kg_m2': float(self.mechanism.flywheel_inertias[0]),
            'flywheel_mass_kg': wheel_mass(float(self.mechanism.flywheel_inertias[0])),
            'total_mass_kg': self.mass, 'peak_speed_rad_s': self.speed,
            'peak_torque_n_m': self.torque, 'peak_power_w': self.power,
            'peak_voltage_v': self.voltage, 'drawn_j': self.drawn,
            'end_speed_rad_s': self.left_over, 'keeps_shares': self.keeps(),
            'manoeuvres': {name: spending.totals()
                           for name, spending in self.spendings.items()}}


FIGURES_OF_MERIT: dict[str, Callable[[Design], float]] = {
    'whole_drawn': lambda design: float(design.spendings['whole'].drawn[-1]),
    'configuration_drawn': lambda design: float(design.spendings['configuration'].drawn[-1]),
    'drawn': lambda design: design.drawn, 'speed': lambda design: design.speed,
    'torque': lambda design: design.torque}


def run(progress: Progress) -> Result:
    """Work out all designs, and let the loop make the manoeuvres of the answer."""
    warm_up()
    table, nominal = load_table('prototype'), load_mechanism('prototype')
    present = evaluate(nominal, table)
    sizes, ratios = [], []
    jobs = [('size', float(value)) for value in INERTIAS] + [
        ('ratio', float(value)) for value in RATIOS]
    for kind, value in progress(jobs, len(jobs)):
        if kind == 'size':
            sizes.append(evaluate(with_wheels(nominal, value), table))
        else:
            ratios.append(evaluate(with_ratio(nominal, value), table))
    answer = evaluate(with_wheels(nominal, least_wheel(sizes)), table)
    shortest = {name: _shortest(nominal, table, goal) for name, goal in MANOEUVRES.items()}
    looped = {name: in_the_loop(nominal, goal) for name, goal in MANOEUVRES.items()}
    heat = {name: float((spending.copper[-1])) * _squared_constant(nominal)
            for name, spending in present.spendings.items()}
    data = {
        'duration_s': DURATION, 'manoeuvres_rad': MANOEUVRES,
        'shares': {'speed': SPEED_SHARE, 'torque': TORQUE_SHARE, 'voltage': VOLTAGE_SHARE},
        'rim': RIM, 'radius_m': RADIUS, 'beam_kg_m': BEAM,
        'present': present.as_json(), 'least': answer.as_json(),
        'moves_until_speed_limit': moves_until_limit(present),
        'shortest_duration_s': shortest,
        'copper_j_at_1_n_m_per_sqrt_w': heat,
        'best_ratio': {key: float(RATIOS[int(np.argmin([get(design) for design in ratios]))])
                       for key, get in FIGURES_OF_MERIT.items()},
        'in_the_loop': looped,
        'sizes': [design.as_json() for design in sizes],
        'ratios': [design.as_json() for design in ratios]}
    files: dict[str, str | bytes] = {'design.csv': _csv(sizes, ratios)}
    skipped: list[str] = []
    with figures(skipped):
        from fourbar_ros.studies.design_figure import png
        files['design.png'] = png(sizes, ratios, present, answer)
    return Result(_checks(present, answer, looped, table), data,
                  _text(present, answer, data), files, skipped)


def evaluate(mechanism: Mechanism, table: Table) -> Design:
    """Work out what the manoeuvres take of four wheels that share for the least energy."""
    return Design(mechanism, {name: spend(
        mechanism, _step(goal, DURATION), assemble(mechanism, 0.0, THETA),
        mechanism.flywheel_inertias, table=table, samples=SAMPLES)
        for name, goal in MANOEUVRES.items()})


def wheel_mass(inertia: float) -> float:
    """Return the mass of a wheel [kg]."""
    return inertia / (RIM * RADIUS ** 2)


def with_wheels(nominal: Mechanism, inertia: float) -> Mechanism:
    """Put other wheels on, at the mass centres of the links, which become as much heavier."""
    change = wheel_mass(inertia) - wheel_mass(float(nominal.flywheel_inertias[0]))
    return replace(nominal, flywheel_inertias=np.full(4, inertia),
                   link_masses=nominal.link_masses + change)


def with_ratio(nominal: Mechanism, ratio: float) -> Mechanism:
    """
    Make a parallelogram of the same circumference.

    Of each link a beam goes with its length, what sits at its mass centre does not.

    :param ratio: length of a over that of b.
    """
    length = float(nominal.link_lengths[0])
    long = 2.0 * length / (1.0 + ratio)
    lengths = np.array([ratio * long, long, ratio * long, long])
    lump = float(nominal.link_masses[0]) - BEAM * length
    turning = float(nominal.link_inertias[0]) - BEAM * length ** 3 / 12.0
    return replace(
        nominal, link_lengths=lengths, link_masses=lump + BEAM * lengths,
        link_inertias=turning + BEAM * lengths ** 3 / 12.0,
        com_positions=np.column_stack([0.5 * lengths, np.zeros(4)]))


def least_wheel(sizes: Sequence[Design]) -> float:
    """Return the inertia of the lightest wheel with which the shares are kept, to two digits."""
    for design in sizes:
        if design.keeps():
            inertia = float(design.mechanism.flywheel_inertias[0])
            digit = 10.0 ** (np.floor(np.log10(inertia)) - 1.0)
            return float(ceil(inertia / digit - 1e-9) * digit)
    return float(sizes[-1].mechanism.flywheel_inertias[0])


def moves_until_limit(design: Design) -> int:
    """Return how many configuration moves in one direction a wheel can take, from rest."""
    limit = SPEED_SHARE * float(design.mechanism.motor_speed_limits.min())
    moves, speed, peak = 0, 0.0, design.speed
    while speed + peak <= limit and moves < 1000:
        moves += 1
        speed += design.left_over
    return moves


def in_the_loop(mechanism: Mechanism, goal: tuple[float, float]) -> dict[str, float]:
    """
    Make a manoeuvre in the closed loop, on the prototype's table.

    :param goal: by how much links a and b turn [rad].
    """
    base = load_scenario('prototype')
    scenario: Scenario = replace(
        base, mechanism=mechanism, believed=mechanism,
        setpoints=(ScriptedSetpoint(0.4, LINK_NAMES[:2], (goal[0], THETA + goal[1]), DURATION),))
    peaks, mean, error = np.zeros(4), 0.0, inf
    for step in run_scenario(scenario):
        truth = step.samples.truth
        assert truth is not None
        peaks = np.maximum(peaks, np.abs(truth.wheel_speeds))
        mean = max(mean, abs(float(truth.wheel_speeds.mean())))
        error = float(np.abs(truth.link_angles[:2] - scenario.setpoints[0].positions).max())
        last = truth.wheel_speeds
    return {'peak_speed_rad_s': float(peaks.max()), 'peak_mean_speed_rad_s': mean,
            'final_error_deg': degrees(error), 'end_speed_rad_s': _peak(last)}


def _step(goal: tuple[float, float], duration: float) -> SoftStep:
    start = np.zeros((3, 2))
    start[0] = 0.0, THETA
    return SoftStep(start, start[0] + goal, duration)


def _shortest(mechanism: Mechanism, table: Table, goal: tuple[float, float]) -> float | None:
    """Return the shortest duration that the motors allow, friction of the bearings included."""
    way = _step(goal, DURATION)
    bearing = np.full(4, table.wheel_bearings.coulomb)
    try:
        return shortest_duration(
            mechanism, way.start, way.goal, assemble(mechanism, 0.0, THETA),
            Wheels(np.zeros(4), mechanism.flywheel_inertias, bearing))
    except SetpointError:
        return None


def _squared_constant(mechanism: Mechanism) -> float:
    return float(mechanism.motor_torque_constants[0] ** 2 / mechanism.motor_resistances[0])


def _peak(values: Array) -> float:
    return float(np.abs(values).max())


def imbalance(spending: Spending, table: Table) -> float:
    """
    Compare what the motors do with where it goes: wheels, links, and losses.

    :returns: the difference over the work that is done.
    """
    mechanism, times = spending.mechanism, spending.times
    power = (spending.motor_torques * spending.motor_speeds).sum(axis=1)
    in_bearings = (spending.bearings * spending.motor_speeds).sum(axis=1)
    outside = (forces_along(spending.angles, spending.link_rates,
                            np.array([mechanism.constants]),
                            np.array([surroundings_of(table)])) * spending.link_rates).sum(axis=1)
    gained = [kinetic_energy(mechanism, spending.angles[n], spending.link_rates[n],
                             spending.speeds[n]) for n in (0, -1)]
    missing = float(trapezoid(power - in_bearings + outside, times)) - (gained[1] - gained[0])
    return abs(missing) / float(trapezoid(np.abs(power), times))


def _checks(present: Design, answer: Design, looped: Mapping[str, Mapping[str, float]],
            table: Table) -> list[Check]:
    mean = _peak(present.spendings['whole'].motor_speeds.mean(axis=1))
    limits = answer.mechanism
    return [
        within('the loop beside the plan, the whole, mean wheel speed',
               looped['whole']['peak_mean_speed_rad_s'] / mean, '', 1.0 - MEAN_NEAR,
               1.0 + MEAN_NEAR),
        within('the loop beside the plan, configuration, wheel speed at the end',
               looped['configuration']['end_speed_rad_s'] / present.left_over, '',
               1.0 - END_NEAR, 1.0 + END_NEAR),
        *(at_most(f'energy that is not accounted for, {name}', imbalance(spending, table), '',
                  BALANCE) for name, spending in present.spendings.items()),
        at_most('least wheels: speed over the limit',
                answer.speed / float(limits.motor_speed_limits.min()), '', SPEED_SHARE),
        at_most('least wheels: torque over the limit',
                answer.torque / float(limits.motor_torque_limits.min()), '', TORQUE_SHARE),
        at_most('least wheels: voltage over the supply',
                answer.voltage / float(limits.motor_voltages.min()), '', VOLTAGE_SHARE)]


def _text(present: Design, answer: Design, data: Mapping[str, Any]) -> str:
    lines = [f'{"":<44}{"present":>12}{"least wheels":>14}']
    for label, unit, get in (
            ('wheel inertia', 'kg m^2', lambda one: float(one.mechanism.flywheel_inertias[0])),
            ('wheel mass', 'kg', lambda one: wheel_mass(
                float(one.mechanism.flywheel_inertias[0]))),
            ('mass of the whole', 'kg', lambda one: one.mass),
            ('peak speed', 'rad/s', lambda one: one.speed),
            ('peak torque', 'N m', lambda one: one.torque),
            ('peak power of a motor', 'W', lambda one: one.power),
            ('peak voltage', 'V', lambda one: one.voltage),
            ('energy drawn, both manoeuvres', 'J', lambda one: one.drawn),
            ('wheel speed that a configuration move leaves', 'rad/s',
             lambda one: one.left_over),
            ('such moves until half of the speed limit', '', moves_until_limit)):
        first, second = get(present), get(answer)
        lines.append(f'{f"{label} [{unit}]" if unit else label:<52}'
                     f'{first:>10.4g}{second:>12.4g}')
    lines += ['']
    for name, duration in data['shortest_duration_s'].items():
        lines.append(f'shortest time for {SAID[name]} with the present motors: {duration:.2f} s')
    best = data['best_ratio']
    lines.append(f'best length of a over that of b: {best["whole_drawn"]:.2f} to turn the whole, '
                 f'{best["configuration_drawn"]:.2f} to turn b alone, {best["drawn"]:.2f} for '
                 'both (energy)')
    for name, looped in data['in_the_loop'].items():
        lines.append(f'closed loop, {SAID[name]}: peak {looped["peak_speed_rad_s"]:.1f} rad/s, '
                     f'mean of the wheels {looped["peak_mean_speed_rad_s"]:.1f} rad/s, end '
                     f'{looped["end_speed_rad_s"]:.1f} rad/s')
    return '\n'.join(lines)


def _csv(sizes: Sequence[Design], ratios: Sequence[Design]) -> str:
    file = io.StringIO()
    names = [name for name, value in sizes[0].as_json().items() if isinstance(value, float)]
    file.write(','.join(['swept', *names]) + '\n')
    for kind, designs in (('size', sizes), ('ratio', ratios)):
        for design in designs:
            numbers = design.as_json()
            file.write(','.join([kind, *(f'{numbers[name]:.9g}' for name in names)]) + '\n')
    return file.getvalue()
