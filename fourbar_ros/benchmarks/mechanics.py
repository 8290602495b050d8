# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Speed and accuracy of the mechanics, compared with MuJoCo on the same machine in the same run.

Also the speed of plant, filter, controller, closed loop and conditioning grid; see
docs/benchmarks.md. All operations take turns in short stretches, and the least time of each
counts, because other load on the machine only adds to a time.
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
from fourbar_ros.studies.conditioning_linkages import ratio_grid
from fourbar_ros.studies.independent import installed
from fourbar_ros.studies.independent.mujoco_model import MujocoLinkage, State, stiff
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP = 1e-3
LINKAGE = 'asymmetric'
SAMPLING = 'zero-order hold, sampled at the start of each step'

# Calls or steps in one stretch. A stretch takes milliseconds, so that some of many stretches run
# without interruption.
EVALUATIONS = 5000
STEPS = 1000
MUJOCO_STEPS = 400
BATCH_STATES, BATCH_STEPS = 512, 40
PLANT_STEPS = 400
FILTER_STEPS = 200
LOOP_TICKS = 50

# Substeps of the reference motion; its error is smaller by 20^4 = 1.6e5.
REFERENCE_STEPS = 20

# Near alignment: a rhombus of the paper passes theta = 0, from -0.04 to 0.04 rad in NEAR_STEPS.
NEAR_STEPS = 500
NEAR_START, NEAR_RATE, NEAR_TURN = -0.04, 0.16, 0.5
NEAR_TORQUE = 1e-6

# The plant with every effect on, links and wheels in motion.
SCENARIO = 'prototype'
PLANT_STATES = {'plant_step_ns': InitialState(0.0, 1.0, 'open', 0.3, -0.2),
                'plant_step_near_alignment_ns': InitialState(0.0, 0.04, 'open', 0.3, -0.1)}
PLANT_TORQUE = 5e-3

# The controller with weak motors [N m], so that the shortest move needs their full torque; time
# after the setpoint that is timed [s].
WEAK_MOTORS = 3e-3
CONTROL_SECONDS = 2.0

# The right-hand side takes its own result as input, scaled by this factor: no call can be omitted
# or overlap with the next, and the motion does not change.
FEEDBACK = 1e-12

# Rounds between two fresh processes, whose times vary by a fifth on a quiet machine.
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


@dataclass(frozen=True)
class Quantity:
    """
    A measured quantity.

    :param unit: '' for a ratio.
    :param text: what it is; '' for a quantity that is checked and not printed.
    :param most, least: limits, None where there is none.
    """

    unit: str
    text: str = ''
    most: float | None = None
    least: float | None = None


QUANTITIES = {
    'rhs_ns': Quantity('ns', 'one right-hand side'),
    'rk4_step_ns': Quantity('ns', 'one Runge-Kutta step', 700.0),
    'rk4_step_near_alignment_ns': Quantity(
        'ns', 'one Runge-Kutta step, near alignment', 4000.0),
    'batch_steps_per_s': Quantity('1/s', 'steps of many linkages on all cores', least=4e6),
    'plant_step_ns': Quantity('ns', 'one step of the plant, every effect on', 3000.0),
    'plant_step_near_alignment_ns': Quantity(
        'ns', 'one step of the plant, near alignment', 6000.0),
    'estimator_step_ns': Quantity(
        'ns', 'one step of the filter, prediction and four gated angles', 60000.0),
    'control_step_p50_us': Quantity('us', 'one tick of the controller, median', 40.0),
    'control_step_p99_us': Quantity('us', 'one tick of the controller, 99th percentile', 200.0),
    'closed_loop_times_real_time': Quantity(
        '', 'closed loop without ROS, times real time', least=15.0),
    'conditioning_grid_s': Quantity('s', 'conditioning of 200 x 200 configurations', 1.0),
    'mujoco_euler_step_ns': Quantity('ns', 'one step of MuJoCo, Euler'),
    'mujoco_rk4_step_ns': Quantity('ns', 'one step of MuJoCo, RK4'),
    'mujoco_euler_lean_step_ns': Quantity('ns', 'one step of MuJoCo, Euler, unused stages off'),
    'mujoco_rk4_lean_step_ns': Quantity('ns', 'one step of MuJoCo, RK4, unused stages off'),
    'ratio_vs_mujoco_euler': Quantity('', 'MuJoCo / ours, Euler', least=8.0),
    'ratio_vs_mujoco_rk4': Quantity('', 'MuJoCo / ours, RK4', least=30.0),
    'ratio_vs_mujoco_euler_lean': Quantity('', 'MuJoCo / ours, Euler, unused stages off'),
    'ratio_vs_mujoco_rk4_lean': Quantity('', 'MuJoCo / ours, RK4, unused stages off'),
    'error_rad': Quantity('rad', 'largest error of a link angle in 10 s'),
    'mujoco_euler_error_rad': Quantity('rad', 'the same of MuJoCo, Euler'),
    'mujoco_rk4_error_rad': Quantity('rad', 'the same of MuJoCo, RK4'),
    'import_to_first_step_s': Quantity('s', 'import to first step, code cached', 1.0),
    # These confirm that the stretches are what their names say.
    'smallest_sine': Quantity('', least=0.5),
    'near_alignment_largest_sine': Quantity('', most=0.1),
    'control_bounds_active': Quantity('', least=0.5)}


class BenchmarkError(FourbarError):
    """A benchmark that cannot run."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """
    A motion under constant torques.

    :param mechanism: the linkage.
    :param start: initial state (STATE_SIZE,).
    :param torques: (4,) [N m].
    """

    mechanism: Mechanism
    start: Array
    torques: Array


@dataclass(frozen=True)
class Operation:
    """
    An operation to time.

    :param begin: restores the start; not timed.
    :param run: the timed function.
    :param count: number of calls or steps in one run.
    """

    begin: Callable[[], None]
    run: Callable[[], None]
    count: int


@dataclass(frozen=True, eq=False)
class ControlTimes:
    """
    Times of the controller, one entry for each run.

    :param times: (n,) of every tick [ns].
    :param active: share of the ticks at which a motor limit was active.
    """

    times: list[Array] = field(default_factory=list)
    active: list[float] = field(default_factory=list)


def measure(repeats: int, progress: Progress) -> dict[str, Any]:
    """
    Run the benchmark.

    :param repeats: stretches of each operation.
    :param progress: wraps an iterable of known length.
    :returns: the content of the JSON, flat: names carry their units; `skipped` lists what is
        missing.
    :raises BenchmarkError: a process does not start, or repeats is not positive.
    :raises CaseError: the reference motion is missing.
    """
    if repeats < 1:
        raise BenchmarkError(f'repeats must be at least 1, got {repeats}', name='repeats',
                             value=repeats, limit=1)
    case = load_case(share_directory() / 'config' / 'reference' / f'{LINKAGE}.json')
    with_mujoco = installed('mujoco')
    results = _circumstances(repeats, with_mujoco)
    # Two stages for the errors, then the rounds, the first of which warms up.
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
    near = Stretch(load_mechanism('paper'), make_state(
        np.tile([0.0, NEAR_START], 2), np.tile([NEAR_TURN, NEAR_TURN + NEAR_RATE], 2)),
        np.full(4, NEAR_TORQUE))
    results['smallest_sine'] = float(_sines(away, STEPS).min())
    results['near_alignment_largest_sine'] = float(_sines(near, NEAR_STEPS).max())
    control = ControlTimes()
    least = _time_in_turns({
        'rhs_ns': _right_hand_sides(away), 'rk4_step_ns': _steps(away, STEPS),
        'rk4_step_near_alignment_ns': _steps(near, NEAR_STEPS), 'batch': _batch(away),
        **{name: _plant_steps(initial) for name, initial in PLANT_STATES.items()},
        'estimator_step_ns': _filter_steps(), 'control': _control_ticks(control),
        'loop': _loop_ticks(),
        'grid': Operation(lambda: None, lambda: _evaluate(ratio_grid), 1),
        **(_mujoco_steps(away) if with_mujoco else {})}, stages)
    results['batch_steps_per_s'] = 1e9 / least.pop('batch')
    results['closed_loop_times_real_time'] = (
        load_scenario(SCENARIO).plant.period_ns / least.pop('loop'))
    results['conditioning_grid_s'] = 1e-9 * least.pop('grid')
    del least['control']
    results |= least
    for percent in (50, 99):
        # The first round warms up.
        results[f'control_step_p{percent}_us'] = min(
            float(np.percentile(times, percent)) * 1e-3 for times in control.times[1:])
    results['control_bounds_active'] = min(control.active)
    if with_mujoco:
        for name in ('euler', 'rk4', 'euler_lean', 'rk4_lean'):
            results[f'ratio_vs_mujoco_{name}'] = (
                results[f'mujoco_{name}_step_ns'] / results['rk4_step_ns'])
    return {name: finite_or_none(value) if isinstance(value, float) else value
            for name, value in results.items()}


def checks_of(results: Mapping[str, Any]) -> list[Check]:
    """Return the checks of the results of :func:`measure`; skipped quantities have none."""
    checks = []
    for name, quantity in QUANTITIES.items():
        if name in results and quantity.most is not None:
            checks.append(at_most(name, _number(results, name), quantity.unit, quantity.most))
        if name in results and quantity.least is not None:
            checks.append(at_least(name, _number(results, name), quantity.unit, quantity.least))
    return checks


def table(results: Mapping[str, Any]) -> str:
    """Return the results of :func:`measure` as text."""
    rows = [(quantity, _number(results, name)) for name, quantity in QUANTITIES.items()
            if quantity.text and name in results]
    width = max(len(quantity.text) for quantity, _ in rows)
    return '\n'.join([
        f'{results["cores"]} cores, {results["cpu"]}, load average '
        f'{results["load_average_1min"]:.2f}',
        ', '.join(f'{name} {text}' for name, text in results['versions'].items()),
        f'linkage {results["linkage"]}, steps of {results["step_s"] * 1e3:g} ms, torques: '
        f'{results["torque_sampling"]}',
        f'times are the {results["statistic"]}',
        *(f'{quantity.text:<{width}}  {_digits(value):>9} {quantity.unit}'.rstrip()
          for quantity, value in rows)])


def _digits(value: float) -> str:
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
        'statistic': f'least of {repeats} stretches of each operation in turn',
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
    Simulate a case under torques that are held over each step.

    :param steps: (n,) number of steps from the first of the case's times to each.
    :param substeps: substeps of each step.
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
    """Simulate a case with MuJoCo under the same held torques."""
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


def _sines(stretch: Stretch, steps: int) -> Array:
    """Return |sin(phi_d - phi_c)| at every step of a stretch."""
    state = stretch.start.copy()
    angles = [state[LINK_ANGLES].copy()]
    for _ in range(steps):
        move_held(state, stretch.torques, STEP, 1, stretch.mechanism.constants, NOTHING)
        angles.append(state[LINK_ANGLES].copy())
    _, _, phi_c, phi_d = np.array(angles).T
    sines: Array = np.abs(np.sin(phi_d - phi_c))
    return sines


def _evaluate(function: Callable[[], Any]) -> None:
    function()


def _right_hand_sides(stretch: Stretch) -> Operation:
    constants, torques = stretch.mechanism.constants, stretch.torques
    state, out = stretch.start.copy(), np.empty(STATE_SIZE)
    rate_a = LINK_RATES.start

    # Not cached: the fingerprint of the cache does not cover this file.
    @compiler.kernel(cache=False)
    def evaluate_often(state: Array, torques: Array, constants: Any, around: Any, out: Array,
                       count: int) -> None:
        for _ in range(count):
            evaluate(state, torques, constants, around, out)
            state[rate_a] += FEEDBACK * out[rate_a]

    return Operation(lambda: np.copyto(state, stretch.start),
                     lambda: evaluate_often(state, torques, constants, NOTHING, out, EVALUATIONS),
                     EVALUATIONS)


def _steps(stretch: Stretch, count: int) -> Operation:
    constants, state = stretch.mechanism.constants, stretch.start.copy()
    return Operation(lambda: np.copyto(state, stretch.start),
                     lambda: move_held(state, stretch.torques, STEP, count, constants, NOTHING),
                     count)


def _batch(stretch: Stretch) -> Operation:
    constants = stretch.mechanism.constants
    states = np.tile(stretch.start, (BATCH_STATES, 1))
    torques = np.tile(stretch.torques, (BATCH_STATES, 1))

    def run() -> None:
        move_batch(states, torques, STEP, BATCH_STEPS, constants, NOTHING)

    def begin() -> None:
        # An untimed run wakes the cores that the single-threaded operations left idle.
        run()
        states[:] = stretch.start

    return Operation(begin, run, BATCH_STATES * BATCH_STEPS)


def _plant_steps(initial: InitialState) -> Operation:
    scenario = load_scenario(SCENARIO)
    plant = Plant(scenario.mechanism, scenario.table, initial, scenario.plant.step,
                  np.random.default_rng(0))
    torques = np.full(4, PLANT_TORQUE)

    def begin() -> None:
        plant.reset(initial)
        plant.disturb(scenario.plant.step)

    return Operation(begin, lambda: plant.advance(PLANT_STEPS, torques), PLANT_STEPS)


def _filter_steps() -> Operation:
    """Predict over a period and correct with four gated angles, repeatedly."""
    scenario = load_scenario(SCENARIO)
    settings, period_s = scenario.estimator, scenario.plant.period_ns * 1e-9
    angles = assemble(scenario.mechanism, scenario.initial.link_a, scenario.initial.link_b)
    linkage = LinkageFilter(
        scenario.mechanism, angles, settings.angle_variance, 1e-4, settings.process_noise)
    torques, variances = np.zeros(4), settings.variances[:4]

    def run() -> None:
        for _ in range(FILTER_STEPS):
            linkage.predict(period_s, torques)
            linkage.update((0, 1, 2, 3), linkage.angles, variances, settings.gate)

    return Operation(lambda: None, run, FILTER_STEPS)


def _control_ticks(control: ControlTimes) -> Operation:
    """Run the controller with the recorded inputs of a closed loop, tick by tick."""
    scenario = load_scenario(SCENARIO)
    mechanism = replace(scenario.mechanism, motor_torque_limits=np.full(4, WEAK_MOTORS))
    setpoint = scenario.setpoints[0]
    scenario = replace(
        scenario, mechanism=mechanism, model=mechanism, duration=setpoint.at + CONTROL_SECONDS,
        controller=replace(scenario.controller, allocation='bounded', command='velocity',
                           setpoint_timing='shortest'))
    inputs = [(step.samples.stamp_ns, step.estimate.link_angles, step.estimate.link_rates,
               step.estimate.disturbance, step.samples.wheels.speeds, step.samples.wheels.efforts)
              for step in run_scenario(scenario) if step.estimate is not None]
    # Ticks after the setpoint; the estimator has an estimate at each.
    count = scenario.ticks - 1 - scenario.tick_at(setpoint.at)
    controllers: list[Controller] = []

    def begin() -> None:
        controller = Controller(mechanism, scenario.controller)
        controller.device_armed(True)
        for row in inputs[:-count]:
            controller.tick(*row)
        controller.setpoint(setpoint.names, setpoint.positions)
        controllers[:] = [controller]

    def run() -> None:
        controller, times = controllers[0], np.empty(count)
        for place, row in enumerate(inputs[-count:]):
            begun = perf_counter_ns()
            controller.tick(*row)
            times[place] = perf_counter_ns() - begun
        control.times.append(times)
        control.active.append(controller.saturated / count)

    return Operation(begin, run, count)


def _loop_ticks() -> Operation:
    """Step table, estimator and controller while they hold, which takes as long as a motion."""
    loop = make_loop(load_scenario(SCENARIO))

    def begin() -> None:
        # Delayed samples arrive after a few ticks.
        loop.step()
        loop.arm()

    def run() -> None:
        for _ in range(LOOP_TICKS):
            loop.step()

    return Operation(begin, run, LOOP_TICKS)


def _mujoco_steps(stretch: Stretch) -> dict[str, Operation]:
    """Return MuJoCo's integrators, with default stages and with the unused stages off."""
    state = _mujoco_state(stretch.start)

    def operation(name: str, lean: bool) -> Operation:
        linkage = MujocoLinkage(stretch.mechanism, replace(stiff(name, STEP), lean=lean))

        def begin() -> None:
            linkage.set_state(state)
            linkage.apply(stretch.torques)

        return Operation(begin, lambda: linkage.advance(MUJOCO_STEPS), MUJOCO_STEPS)

    return {f'mujoco_{name.lower()}{"_lean" if lean else ""}_step_ns': operation(name, lean)
            for name in ('Euler', 'RK4') for lean in (False, True)}


def _time_in_turns(operations: Mapping[str, Operation], rounds: Iterable[Any]
                   ) -> dict[str, float]:
    """
    Time all operations in turn, and fresh processes between them.

    :returns: the least time of each operation [ns per count], and `import_to_first_step_s`.
    """
    least = dict.fromkeys([*operations, 'import_to_first_step_s'], float('inf'))
    for turn, _ in enumerate(rounds):
        for name, operation in operations.items():
            operation.begin()
            begin = perf_counter_ns()
            operation.run()
            duration = (perf_counter_ns() - begin) / operation.count
            # The first round may compile, and warms up.
            if turn > 0:
                least[name] = min(least[name], duration)
        if turn % FRESH_PROCESS_EVERY == 0:
            least['import_to_first_step_s'] = min(least['import_to_first_step_s'], _first_step())
    return least


def _first_step() -> float:
    """Time a fresh process from the first import of this package to the end of a step [s]."""
    done = subprocess.run([sys.executable, '-c', FIRST_STEP, *sys.path], capture_output=True,
                          text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ['no message'])[-1]
        raise BenchmarkError(f'a fresh process cannot take a step: {reason}')
    return float(done.stdout)
