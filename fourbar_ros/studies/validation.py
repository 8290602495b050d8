# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
Comparison of the tests of paper section 3 and of reference motions with independent engines.

The paper prescribes the angles of its wheels relative to their links. It does not print their
amplitude; the study uses 100 rad, which turns the links by 54 degrees.
"""

from __future__ import annotations

import json
from typing import Any

from fourbar_ros.common.checks import at_most, Check, within
from fourbar_ros.common.config_files import share_directory
from fourbar_ros.common.progress import Progress
from fourbar_ros.mechanism import angular_momentum, closure_error, load_mechanism, Mechanism
from fourbar_ros.mechanism.case import Case, load_case
from fourbar_ros.mechanism.constants import Array
from fourbar_ros.studies import figures, Result, StudyError
from fourbar_ros.studies.engine_comparison import (
    compare,
    ComparedMotion,
    EngineComparison,
    OURS,
    STEP,
)
import numpy as np

AMPLITUDE = 100.0
FREQUENCY_HZ = 0.1
START = np.array([0.0, np.pi / 3.0, 0.0, np.pi / 3.0])
TIMES = np.linspace(0.0, 10.0, 201)

# Amplitude of each wheel's angle, in units of AMPLITUDE.
PAPER_TESTS = {
    'paper_test_1': (1.0, 0.0, 1.0, 0.0),
    'paper_test_2': (1.0, 1.0, 1.0, 1.0),
    'paper_opposite': (1.0, 0.0, -1.0, 0.0),
}
REFERENCES = ('asymmetric', 'paper_all', 'paper_pair_ac', 'parallelogram_offset_spinning')

# Limit for quantities that are equal up to rounding, which is 1e-12 rad in the reference files.
EXACT = 1e-9
# A cosine held at the middle of each step is too large by (2 pi f h)^2 / 24 of itself: 1.5e-7 at
# 1 ms and the 0.3 Hz of the fastest wheel. The motions are about a radian wide.
MUJOCO_LIMIT = 2e-7
# Ratio of errors at 2 ms and 1 ms. Both error sources are of second order in the step: the hold,
# and the compliance of joint 3, whose time constant is a number of steps.
ORDER_TWO = (3.5, 4.5)


def run(progress: Progress) -> Result:
    """
    Compare all motions.

    :raises FourbarError: see :func:`motions`; or an engine cannot simulate a motion.
    """
    comparisons, sampling, skipped = compare(motions(), progress)
    files: dict[str, str | bytes] = {'validation.csv': _csv(comparisons, sampling)}
    with figures(skipped):
        from fourbar_ros.studies.validation_figure import png
        files['validation.png'] = png(comparisons[:len(PAPER_TESTS)])
    return Result(checks(comparisons), _data(comparisons, sampling), _table(comparisons, sampling),
                  files, skipped)


def motions() -> list[ComparedMotion]:
    """
    Return the paper's three tests, then the reference motions.

    :raises CaseError: the file of a reference motion is missing or broken.
    :raises StudyError: the file has no expected link angles.
    """
    paper = load_mechanism('paper')
    listed = [ComparedMotion(name, paper_test(paper, np.array(shape)))
              for name, shape in PAPER_TESTS.items()]
    for name in REFERENCES:
        path = share_directory() / 'config' / 'reference' / f'{name}.json'
        case = load_case(path)
        expected = np.array(json.loads(path.read_text(encoding='utf-8')).get('link_angles'))
        if expected.shape != (case.times.size, 4):
            raise StudyError(f'{path}: link_angles must have four angles for each t', path=path)
        listed.append(ComparedMotion(name, case, expected))
    return listed


def paper_test(mechanism: Mechanism, shape: Array) -> Case:
    """
    Return a test of section 3: the angle of each wheel relative to its link is a cosine for 10 s.

    :param shape: (4,) amplitudes in units of AMPLITUDE; 0: the wheel rests on its link.
    """
    rest = np.zeros(4)
    return Case(
        mechanism=mechanism, link_angles=START, link_rates=rest, flywheel_speeds_absolute=rest,
        amplitude=AMPLITUDE * shape, frequency_hz=np.full(4, FREQUENCY_HZ), phase=rest,
        times=TIMES, prescribed=np.ones(4, dtype=bool))


def checks(comparisons: list[EngineComparison]) -> list[Check]:
    """Return the checks on all comparisons; missing engines are left out."""
    by_name = {comparison.motion.name: comparison for comparison in comparisons}

    def largest(engine: str) -> float:
        return max(comparison.largest(engine) for comparison in comparisons
                   if engine in comparison.others)

    results = []
    for engine, limit in (('reference', EXACT), ('kane', EXACT), ('mujoco_1ms', MUJOCO_LIMIT),
                          ('mujoco_extrapolated', EXACT)):
        if any(engine in comparison.others for comparison in comparisons):
            results.append(at_most(f'{engine}, largest difference', largest(engine), 'rad', limit))
            if engine == 'mujoco_1ms':
                ratios = [comparison.largest('mujoco_2ms') / comparison.largest('mujoco_1ms')
                          for comparison in comparisons]
                results += [
                    within(f'mujoco, difference at 2 ms / at 1 ms, {word}', value, '', *ORDER_TWO)
                    for word, value in (('least', min(ratios)), ('most', max(ratios)))]

    turned = {name: by_name[name].ours.link_angles - START for name in PAPER_TESTS}
    expected = turn_by_momentum(by_name['paper_test_1'].motion.case)[:, np.newaxis]
    results += [at_most(name, float(np.abs(angles).max()), 'rad', EXACT) for name, angles in (
        ('test 1, a and c beside momentum by hand', turned['paper_test_1'][:, ::2] - expected),
        ('test 1, turn of b and d', turned['paper_test_1'][:, 1::2]),
        ('test 2, all links beside momentum by hand', turned['paper_test_2'] - expected),
        ('test 2, change of configuration', np.diff(turned['paper_test_2'], axis=1)),
        ('opposite commands, turn of any link', turned['paper_opposite']))]
    results.append(at_most('momentum, drift relative to that of the wheels',
                           max(map(momentum_drift, comparisons)), '', EXACT))
    results.append(at_most('closure, widest gap', max(
        closure_error(comparison.motion.case.mechanism, angles)
        for comparison in comparisons for angles in comparison.ours.link_angles), 'm', 1e-12))
    return results


def turn_by_momentum(case: Case) -> Array:
    """
    Return the turn of a pair of equal links with equal wheel motions, by conservation of momentum.

    In a parallelogram of identical uniform links each pair has the inertia `2 I + m l^2 / 2` in
    every configuration, independent of the other pair. From rest its momentum stays zero,
    `(2 I + m l^2 / 2) omega + 2 If (omega + dpsi/dt) = 0`.

    :param case: both wheels of the pair move as wheel a.
    :returns: (n,) [rad].
    """
    mechanism = case.mechanism
    length, mass, inertia, wheel = (float(values[0]) for values in (
        mechanism.link_lengths, mechanism.link_masses, mechanism.link_inertias,
        mechanism.flywheel_inertias))
    share = 2.0 * wheel / (2.0 * inertia + 0.5 * mass * length**2 + 2.0 * wheel)
    turn = 2.0 * np.pi * float(case.frequency_hz[0])
    phase = float(case.phase[0])
    wave: Array = np.cos(turn * case.times + phase) - np.cos(phase)
    return -share * float(case.amplitude[0]) * wave


def momentum_drift(comparison: EngineComparison) -> float:
    """Return the drift of our angular momentum relative to the momentum of the wheels."""
    mechanism, ours = comparison.motion.case.mechanism, comparison.ours
    speeds = ours.flywheel_speeds_absolute
    momentum = np.array([angular_momentum(mechanism, *state) for state in zip(
        ours.link_angles, ours.link_rates, speeds)])
    scale = float((np.abs(speeds) @ mechanism.flywheel_inertias).max())
    return float(np.abs(momentum - momentum[0]).max()) / scale


def _rows(comparisons: list[EngineComparison], sampling: dict[str, str]
          ) -> list[tuple[str, str, float, float]]:
    """Return motion, engine, largest and rms difference [rad]."""
    return [(comparison.motion.name, engine, comparison.largest(engine), comparison.rms(engine))
            for comparison in comparisons for engine in sampling if engine in comparison.others]


def _csv(comparisons: list[EngineComparison], sampling: dict[str, str]) -> str:
    lines = [f'{motion},{engine},{largest:.4g},{rms:.4g},"{sampling[engine]}"'
             for motion, engine, largest, rms in _rows(comparisons, sampling)]
    return '\n'.join(['motion,engine,max_rad,rms_rad,torque', *lines, ''])


def _table(comparisons: list[EngineComparison], sampling: dict[str, str]) -> str:
    width = max(len(comparison.motion.name) for comparison in comparisons)
    lines = [f'{"link angles, ours minus theirs":<{width + 21}}  {"max [rad]":>10} '
             f'{"rms [rad]":>10}']
    lines += [f'{motion:<{width}}  {engine:<19}  {largest:>10.2e} {rms:>10.2e}'
              for motion, engine, largest, rms in _rows(comparisons, sampling)]
    lines += ['', 'torques and prescribed wheel angles']
    lines += [f'{name:<19}  {rule}' for name, rule in {'ours': OURS, **sampling}.items()]
    return '\n'.join([*lines, ''])


def _data(comparisons: list[EngineComparison], sampling: dict[str, str]) -> dict[str, Any]:
    differences: dict[str, dict[str, Any]] = {}
    for motion, engine, largest, rms in _rows(comparisons, sampling):
        differences.setdefault(motion, {})[engine] = {'max_rad': largest, 'rms_rad': rms}
    return {
        'step_s': STEP,
        'paper_tests': {
            'wheel_amplitude_rad': AMPLITUDE, 'frequency_hz': FREQUENCY_HZ,
            'start_rad': START.tolist(),
            'swing_rad': {
                comparison.motion.name: np.ptp(comparison.ours.link_angles, axis=0).tolist()
                for comparison in comparisons if comparison.motion.name in PAPER_TESTS}},
        'torque_sampling': {'ours': OURS, **sampling},
        'differences': differences,
    }
