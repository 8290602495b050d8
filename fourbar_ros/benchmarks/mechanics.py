# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
How fast and how exact the mechanics are, beside MuJoCo on the same machine in the same run.

And how fast plant and closed loop are. docs/benchmarks.md says what is timed and how to read it.
All rivals take turns in short stretches, and of each the quickest counts: what else runs on the
machine only ever adds to a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
import os
from pathlib import Path
import platform
import subprocess
import sys
from time import perf_counter_ns
from typing import Any

from fourbar_ros import __version__
from fourbar_ros.common.checks import at_least, at_most, Check, finite_or_none
from fourbar_ros.common.config_files import share_directory
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.progress import Progress
from fourbar_ros.control import Controller
from fourbar_ros.estimation.filter import LinkageFilter
from fourbar_ros.kernels import compiler
from fourbar_ros.loop.run import make_loop, run_scenario
from fourbar_ros.loop.scenario import load_scenario
from fourbar_ros.mechanism import assemble, load_mechanism, Mechanism
from fourbar_ros.mechanism.case import Case, load_case
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.integration import evaluate, move_batch, move_held
from fourbar_ros.mechanism.state import (
    CENTRE_POSITION,
    CENTRE_VELOCITY,
    LINK_ANGLES,
    LINK_RATES,
    make_state,
    STATE_SIZE,
    WHEEL_ANGLES,
    WHEEL_SPEEDS,
)
from fourbar_ros.plant import InitialState, Plant
from fourbar_ros.studies.independent import installed
from fourbar_ros.studies.independent.mujoco_model import MujocoLinkage, State, stiff
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP = 1e-3
LINKAGE = 'asymmetric'
SAMPLING = 'zero-order hold, sampled at the start of each step'

# Steps of one stretch: milliseconds, so that some of many stretches find the machine quiet.
EVALUATIONS = 5000
STEPS = 1000
MUJOCO_STEPS = 400
BATCH_STATES, BATCH_STEPS = 512, 40

# The reference of the errors: steps so short that their error is 1.6e5 times less.
REFERENCE_STEPS = 20

# A paper rhombus that goes through theta = 0, from -0.04 to 0.04 rad in NEAR_STEPS.
NEAR_STEPS = 500
NEAR_START, NEAR_RATE, NEAR_TURN = -0.04, 0.16, 0.5
NEAR_TORQUE = 1e-6

# The plant with every effect on, links and wheels moving, and the closed loop around it.
SCENARIO = 'prototype'
PLANT_STEPS = 400
PLANT_AWAY = InitialState(0.0, 1.0, 'open', 0.3, -0.2)
PLANT_NEAR = InitialState(0.0, 0.04, 'open', 0.3, -0.1)
PLANT_TORQUE = 5e-3
FILTER_STEPS = 200
LOOP_TICKS = 50

# The controller, with motors so weak [N m] that the shortest move takes all they have: so much of
# it is timed [s], from the setpoint on.
WEAK_MOTORS = 3e-3
CONTROL_SECONDS = 2.0

# The right-hand side runs on its own results, by so little that the motion stays: nothing of it
# can be left out or done ahead.
FEEDBACK = 1e-12

# In rounds. Its time varies most, by a fifth on a quiet machine.
FRESH_PROCESS_EVERY = 6
FIRST_STEP = """
import sys, time
begin = time.perf_counter()
sys.path[:] = sys.argv[1:]
import numpy
from fourbar_ros.mechanism import assemble, load_mechanism
from fourbar_ros.mechanism.forces import NOTHING
from fourbar_ros.mechanism.state import make_state
from fourbar_ros.mechanism.integration import move_held
paper = load_mechanism('paper')
state = make_state(assemble(paper, 0.0, 1.0))
move_held(state, numpy.zeros(4), 0.001, 1, paper.constants, NOTHING)
print(time.perf_counter() - begin)
"""

# What is printed: key, unit, what it is.
QUANTITIES = (
    ('rhs_ns', 'ns', 'one right-hand side'),
    ('rk4_step_ns', 'ns', 'one Runge-Kutta step'),
    ('rk4_step_near_alignment_ns', 'ns', 'one Runge-Kutta step, near alignment'),
    ('batch_steps_per_s', '1/s', 'steps of many linkages on all cores'),
    ('plant_step_ns', 'ns', 'one step of the plant, every effect on'),
    ('plant_step_near_alignment_ns', 'ns', 'one step of the plant, near alignment'),
    ('estimator_step_ns', 'ns', 'one step of the filter, prediction and four gated angles'),
    ('control_step_p50_us', 'us', 'one tick of the controller, median'),
    ('control_step_p99_us', 'us', 'one tick of the controller, 99th percentile'),
    ('closed_loop_times_real_time', '', 'closed loop without ROS, times real time'),
    ('mujoco_euler_step_ns', 'ns', 'one step of MuJoCo, Euler'),
    ('mujoco_rk4_step_ns', 'ns', 'one step of MuJoCo, RK4'),
    ('mujoco_euler_lean_step_ns', 'ns', 'one step of MuJoCo, Euler, needless stages off'),
    ('mujoco_rk4_lean_step_ns', 'ns', 'one step of MuJoCo, RK4, needless stages off'),
    ('ratio_vs_mujoco_euler', '', 'MuJoCo / ours, Euler'),
    ('ratio_vs_mujoco_rk4', '', 'MuJoCo / ours, RK4'),
    ('ratio_vs_mujoco_euler_lean', '', 'MuJoCo / ours, Euler, needless stages off'),
    ('ratio_vs_mujoco_rk4_lean', '', 'MuJoCo / ours, RK4, needless stages off'),
    ('error_rad', 'rad', 'largest error of a link angle in 10 s'),
    ('mujoco_euler_error_rad', 'rad', 'the same of MuJoCo, Euler'),
    ('mujoco_rk4_error_rad', 'rad', 'the same of MuJoCo, RK4'),
    ('import_to_first_step_s', 's', 'import to first step, code cached'),
)


class BenchmarkError(FourbarError):
    """A benchmark that cannot run."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """
    A linkage on its way.

    :param mechanism: which one.
    :param start: (STATE_SIZE,).
    :param torques: (4,) held all along [N m].
    """

    mechanism: Mechanism
    start: Array
    torques: Array


@dataclass(frozen=True)
class Rival:
    """
    Something to time.

    :param begin: goes back to the start, not timed.
    :param run: what is timed.
    :param count: how many of what is counted are in one run.
    """

    begin: Callable[[], None]
    run: Callable[[], None]
    count: int


@dataclass(frozen=True, eq=False)
class Takes:
    """
    What came of each turn of the controller, filled as it goes.

    :param times: (n,) of every tick [ns].
    :param active: share of the ticks at which the bounds of the motors were.
    """

    times: list[Array] = field(default_factory=list)
    active: list[float] = field(default_factory=list)


def measure(repeats: int, progress: Progress) -> dict[str, Any]:
    """
    Run the benchmark.

    :param repeats: stretches of each rival.
    :param progress: wraps an iterable that takes time, given also its length.
    :returns: what goes into JSON, flat: names carry their units; `skipped` lists what is missing.
    :raises BenchmarkError: a process of its own does not start, or repeats is not positive.
    :raises CaseError: the reference motion is missing.
    """
    if repeats < 1:
        raise BenchmarkError(f'repeats must be at least 1, got {repeats}')
    case = load_case(share_directory() / 'config' / 'reference' / f'{LINKAGE}.json')
    with_mujoco = installed('mujoco')
    results = _circumstances(repeats, with_mujoco)
    # Two stages of their own, then the rounds, of which the first warms up.
    count = 2 + repeats + 1
    stages = iter(progress(range(count), count))
    next(stages)
    steps = np.rint((case.times - case.times[0]) / STEP).astype(int)
    exact = _held_motion(case, steps, REFERENCE_STEPS)
    results['error_rad'] = _largest_error(_held_motion(case, steps, 1)[:, LINK_ANGLES], exact)
    next(stages)
    if with_mujoco:
        results |= _mujoco_errors(case, exact)
    middle = exact.shape[0] // 2
    away = Stretch(case.mechanism, exact[middle], _torques_at(case, float(case.times[middle])))
    near = Stretch(load_mechanism('paper'), _near_alignment(), np.full(4, NEAR_TORQUE))
    results['smallest_sine'] = float(_sines(away, STEPS).min())
    results['near_alignment_largest_sine'] = float(_sines(near, NEAR_STEPS).max())
    takes = Takes()
    rivals = {'rhs_ns': _right_hand_sides(away), 'rk4_step_ns': _steps(away, STEPS),
              'rk4_step_near_alignment_ns': _steps(near, NEAR_STEPS), 'batch': _batch(away),
              'plant_step_ns': _plant_steps(PLANT_AWAY),
              'plant_step_near_alignment_ns': _plant_steps(PLANT_NEAR),
              'estimator_step_ns': _filter_steps(), 'control': _control_ticks(takes),
              'loop': _loop_ticks()}
    if with_mujoco:
        rivals |= _mujoco_rivals(away)
    results |= _race(rivals, stages)
    results['batch_steps_per_s'] = 1e9 / results.pop('batch')
    del results['control']
    for percent in (50, 99):
        # The first round warms up.
        results[f'control_step_p{percent}_us'] = min(
            float(np.percentile(times, percent)) * 1e-3 for times in takes.times[1:])
    results['control_bounds_active'] = min(takes.active)
    results['closed_loop_times_real_time'] = (
        load_scenario(SCENARIO).plant.period_ns / results.pop('loop'))
    if with_mujoco:
        for name in ('euler', 'rk4', 'euler_lean', 'rk4_lean'):
            results[f'ratio_vs_mujoco_{name}'] = (
                results[f'mujoco_{name}_step_ns'] / results['rk4_step_ns'])
    return {name: finite_or_none(value) if isinstance(value, float) else value
            for name, value in results.items()}


def checks_of(results: Mapping[str, Any]) -> list[Check]:
    """Return what the results of :func:`measure` are held to; what was skipped is not."""
    limits = [
        at_most('rk4_step_ns', _number(results, 'rk4_step_ns'), 'ns', 700.0),
        at_most('rk4_step_near_alignment_ns', _number(results, 'rk4_step_near_alignment_ns'),
                'ns', 4000.0),
        at_least('batch_steps_per_s', _number(results, 'batch_steps_per_s'), '1/s', 4e6),
        at_most('plant_step_ns', _number(results, 'plant_step_ns'), 'ns', 3000.0),
        at_most('plant_step_near_alignment_ns',
                _number(results, 'plant_step_near_alignment_ns'), 'ns', 6000.0),
        at_most('estimator_step_ns', _number(results, 'estimator_step_ns'), 'ns', 60000.0),
        at_most('control_step_p50_us', _number(results, 'control_step_p50_us'), 'us', 40.0),
        at_most('control_step_p99_us', _number(results, 'control_step_p99_us'), 'us', 200.0),
        at_least('closed_loop_times_real_time',
                 _number(results, 'closed_loop_times_real_time'), '', 15.0),
        at_most('import_to_first_step_s', _number(results, 'import_to_first_step_s'), 's', 1.0),
        # That the stretches are what they are called.
        at_least('smallest_sine', _number(results, 'smallest_sine'), '', 0.5),
        at_most('near_alignment_largest_sine', _number(results, 'near_alignment_largest_sine'),
                '', 0.1),
        at_least('control_bounds_active', _number(results, 'control_bounds_active'), '', 0.5)]
    if 'mujoco_euler_step_ns' in results:
        limits += [at_least('ratio_vs_mujoco_euler', _number(results, 'ratio_vs_mujoco_euler'),
                            '', 8.0),
                   at_least('ratio_vs_mujoco_rk4', _number(results, 'ratio_vs_mujoco_rk4'),
                            '', 30.0)]
    return limits


def table(results: Mapping[str, Any]) -> str:
    """Return the results of :func:`measure` for people, in lines."""
    found = [(_text(_number(results, name)), unit, text) for name, unit, text in QUANTITIES
             if name in results]
    width = max(len(text) for _, _, text in found)
    return '\n'.join([
        f'{results["cores"]} cores, {results["cpu"]}, load average '
        f'{results["load_average_1min"]:.2f}',
        ', '.join(f'{name} {text}' for name, text in results['versions'].items()),
        f'linkage {results["linkage"]}, steps of {results["step_s"] * 1e3:g} ms, torques: '
        f'{results["torque_sampling"]}',
        f'times are the {results["statistic"]}',
        *(f'{text:<{width}}  {value:>9} {unit}'.rstrip() for value, unit, text in found)])


def _text(value: float) -> str:
    return f'{value:.0f}' if value >= 1000.0 else f'{value:.3g}'


def _number(results: Mapping[str, Any], name: str) -> float:
    value = results[name]
    return float('nan') if value is None else float(value)


def _circumstances(repeats: int, with_mujoco: bool) -> dict[str, Any]:
    packages = ('numpy', 'numba', *(['mujoco'] if with_mujoco else []))
    return {
        'cores': len(os.sched_getaffinity(0)),
        'cpu': _cpu_model(),
        'versions': {'fourbar_ros': __version__, 'python': platform.python_version(),
                     **{name: version(name) for name in packages}},
        'linkage': LINKAGE,
        'near_alignment_linkage': 'paper',
        'step_s': STEP,
        'torque_sampling': SAMPLING,
        'load_average_1min': os.getloadavg()[0],
        'statistic': f'least of {repeats} stretches of each rival in turn',
        'error_reference': f'ours with {REFERENCE_STEPS} steps in each, the same torques',
        'skipped': [] if with_mujoco else [
            'no comparison with MuJoCo: mujoco is missing (pip install mujoco)']}


def _cpu_model() -> str:
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    except OSError:
        lines = []
    names = [line.split(':', 1)[1].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.processor() or platform.machine()


def _torques_at(case: Case, time: float) -> Array:
    torques: Array = case.amplitude * np.cos(2.0 * np.pi * case.frequency_hz * time + case.phase)
    return torques


def _held_motion(case: Case, steps: NDArray[np.int64], substeps: int) -> Array:
    """
    Follow the motion of a case under torques that are held over each step.

    :param steps: (n,) how many steps each of the case's times is after the first.
    :param substeps: into how many each step is divided.
    :returns: (n, STATE_SIZE).
    """
    state = make_state(case.link_angles, case.link_rates, case.flywheel_speeds_absolute)
    states = [state.copy()]
    for begin, end in zip(steps, steps[1:]):
        for step in range(begin, end):
            move_held(state, _torques_at(case, case.times[0] + step * STEP), STEP / substeps,
                      substeps, case.mechanism.constants, NOTHING)
        states.append(state.copy())
    return np.array(states)


def _largest_error(angles: Array, exact: Array) -> float:
    return float(np.abs(angles - exact[:, LINK_ANGLES]).max())


def _mujoco_errors(case: Case, exact: Array) -> dict[str, float]:
    """Follow the motion of a case with MuJoCo, the torques held likewise."""
    errors = {}
    for name in ('Euler', 'RK4'):
        linkage = MujocoLinkage(case.mechanism, stiff(name, STEP))
        motion = linkage.move(_mujoco_state(exact[0]), case.times,
                              lambda time: _torques_at(case, time))
        errors[f'mujoco_{name.lower()}_error_rad'] = _largest_error(motion.link_angles, exact)
    return {**errors, 'mujoco_error_rad': min(errors.values())}


def _mujoco_state(state: Array) -> State:
    return State(state[LINK_ANGLES], state[LINK_RATES], state[WHEEL_ANGLES], state[WHEEL_SPEEDS],
                 state[CENTRE_POSITION], state[CENTRE_VELOCITY])


def _near_alignment() -> Array:
    """Return a rhombus that moves towards theta = 0 while it turns, (STATE_SIZE,)."""
    return make_state(np.tile([0.0, NEAR_START], 2),
                      np.tile([NEAR_TURN, NEAR_TURN + NEAR_RATE], 2))


def _sines(stretch: Stretch, steps: int) -> Array:
    """Return |sin(phi_d - phi_c)| at every step of a stretch."""
    state = stretch.start.copy()
    differences = [state[3] - state[2]]
    for _ in range(steps):
        move_held(state, stretch.torques, STEP, 1, stretch.mechanism.constants, NOTHING)
        differences.append(state[3] - state[2])
    sines: Array = np.abs(np.sin(differences))
    return sines


def _right_hand_sides(stretch: Stretch) -> Rival:
    constants, torques = stretch.mechanism.constants, stretch.torques
    state, out = stretch.start.copy(), np.empty(STATE_SIZE)
    rate_a = LINK_RATES.start

    # Not kept: the fingerprint of the cache does not cover this file.
    @compiler.kernel(cache=False)
    def evaluate_often(state: Array, torques: Array, constants: Any, around: Any, out: Array,
                       count: int) -> None:
        for _ in range(count):
            evaluate(state, torques, constants, around, out)
            state[rate_a] += FEEDBACK * out[rate_a]

    def begin() -> None:
        state[:] = stretch.start

    return Rival(begin, lambda: evaluate_often(state, torques, constants, NOTHING, out,
                                               EVALUATIONS), EVALUATIONS)


def _steps(stretch: Stretch, count: int) -> Rival:
    constants, state = stretch.mechanism.constants, stretch.start.copy()

    def begin() -> None:
        state[:] = stretch.start

    return Rival(begin, lambda: move_held(state, stretch.torques, STEP, count, constants, NOTHING),
                 count)


def _batch(stretch: Stretch) -> Rival:
    constants = stretch.mechanism.constants
    states = np.tile(stretch.start, (BATCH_STATES, 1))
    torques = np.tile(stretch.torques, (BATCH_STATES, 1))

    def begin() -> None:
        # The other cores have slept while the single-threaded rivals had their turns.
        move_batch(states, torques, STEP, BATCH_STEPS, constants, NOTHING)
        states[:] = stretch.start

    return Rival(begin, lambda: move_batch(states, torques, STEP, BATCH_STEPS, constants, NOTHING),
                 BATCH_STATES * BATCH_STEPS)


def _plant_steps(initial: InitialState) -> Rival:
    scenario = load_scenario(SCENARIO)
    plant = Plant(scenario.mechanism, scenario.table, initial, scenario.plant.step,
                  np.random.default_rng(0))
    torques = np.full(4, PLANT_TORQUE)

    def begin() -> None:
        plant.reset(initial)
        plant.disturb(scenario.plant.step)

    return Rival(begin, lambda: plant.advance(PLANT_STEPS, torques), PLANT_STEPS)


def _filter_steps() -> Rival:
    """Predict over a period and correct with four angles, each gated, again and again."""
    scenario = load_scenario(SCENARIO)
    settings, period_s = scenario.estimator, scenario.plant.period_ns * 1e-9
    angles = assemble(scenario.mechanism, scenario.initial.link_a, scenario.initial.link_b)
    linkage = LinkageFilter(
        scenario.mechanism, angles, settings.angle_variance, 1e-4, settings.randomness)
    torques, variances = np.zeros(4), settings.variances[:4]

    def run() -> None:
        for _ in range(FILTER_STEPS):
            linkage.move(period_s, torques)
            linkage.correct((0, 1, 2, 3), linkage.angles, variances, settings.gate)

    return Rival(lambda: None, run, FILTER_STEPS)


def _control_ticks(takes: Takes) -> Rival:
    """Give the controller what it was given in a run of the closed loop, tick by tick."""
    scenario = load_scenario(SCENARIO)
    mechanism = replace(scenario.mechanism, motor_torque_limits=np.full(4, WEAK_MOTORS))
    setpoint = scenario.setpoints[0]
    scenario = replace(
        scenario, mechanism=mechanism, model=mechanism, duration=setpoint.at + CONTROL_SECONDS,
        controller=replace(scenario.controller, allocation='bounded', command='velocity',
                           setpoint_timing='shortest'))
    given = [(step.samples.stamp_ns, step.estimate.link_angles, step.estimate.link_rates,
              step.estimate.disturbance, step.samples.wheels.speeds, step.samples.wheels.efforts)
             for step in run_scenario(scenario) if step.estimate is not None]
    # Ticks after the setpoint, of which the estimator answers each.
    count = scenario.ticks - 1 - scenario.tick_at(setpoint.at)
    controllers: list[Controller] = []

    def begin() -> None:
        controller = Controller(mechanism, scenario.controller)
        controller.device_armed(True)
        for inputs in given[:-count]:
            controller.tick(*inputs)
        controller.setpoint(setpoint.names, setpoint.positions)
        controllers[:] = [controller]

    def run() -> None:
        controller, times = controllers[0], np.empty(count)
        for place, inputs in enumerate(given[-count:]):
            begun = perf_counter_ns()
            controller.tick(*inputs)
            times[place] = perf_counter_ns() - begun
        takes.times.append(times)
        takes.active.append(controller.saturated / count)

    return Rival(begin, run, count)


def _loop_ticks() -> Rival:
    """Step table, estimator and controller, holding where they are: their work is the same."""
    loop = make_loop(load_scenario(SCENARIO))

    def begin() -> None:
        # Late samples first come after a few ticks.
        loop.step()
        loop.arm()

    def run() -> None:
        for _ in range(LOOP_TICKS):
            loop.step()

    return Rival(begin, run, LOOP_TICKS)


def _mujoco_rivals(stretch: Stretch) -> dict[str, Rival]:
    """Return MuJoCo's integrators, as delivered and without the stages that do nothing here."""
    state = _mujoco_state(stretch.start)

    def rival(name: str, lean: bool) -> Rival:
        linkage = MujocoLinkage(stretch.mechanism, replace(stiff(name, STEP), lean=lean))

        def begin() -> None:
            linkage.set_state(state)
            linkage.apply(stretch.torques)

        return Rival(begin, lambda: linkage.advance(MUJOCO_STEPS), MUJOCO_STEPS)

    return {f'mujoco_{name.lower()}{"_lean" if lean else ""}_step_ns': rival(name, lean)
            for name in ('Euler', 'RK4') for lean in (False, True)}


def _race(rivals: Mapping[str, Rival], rounds: Iterable[Any]) -> dict[str, float]:
    """
    Let the rivals take turns, and fresh processes among them.

    :returns: the least time of each rival [ns per count], and `import_to_first_step_s`.
    """
    least = dict.fromkeys([*rivals, 'import_to_first_step_s'], float('inf'))
    for turn, _ in enumerate(rounds):
        for name, rival in rivals.items():
            rival.begin()
            begin = perf_counter_ns()
            rival.run()
            taken = (perf_counter_ns() - begin) / rival.count
            # The first round may compile, and warms up.
            if turn > 0:
                least[name] = min(least[name], taken)
        if turn % FRESH_PROCESS_EVERY == 0:
            least['import_to_first_step_s'] = min(least['import_to_first_step_s'], _first_step())
    return least


def _first_step() -> float:
    """Time a fresh process from its first import of ours to the end of its first step [s]."""
    done = subprocess.run([sys.executable, '-c', FIRST_STEP, *sys.path], capture_output=True,
                          text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ['no message'])[-1]
        raise BenchmarkError(f'a fresh process cannot take a step: {reason}')
    return float(done.stdout)
