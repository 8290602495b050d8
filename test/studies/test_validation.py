# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The validation study: its laws, its limits, and missing libraries."""

from collections.abc import Iterable
from dataclasses import replace
import sys
from typing import Any

from fourbar_ros.mechanism import Mechanism
from fourbar_ros.mechanism.case import CaseError, simulate
from fourbar_ros.studies import engine_comparison as comparison
from fourbar_ros.studies import validation
from fourbar_ros.studies.engine_comparison import (
    ComparedMotion,
    EngineComparison,
    IndependentEngine,
)
import numpy as np
import pytest


def no_progress(items: Iterable[Any], total: int) -> Iterable[Any]:
    """Return all items, and check their announced number."""
    found = list(items)
    assert len(found) == total
    return found


@pytest.fixture(scope='module')
def comparisons(paper: Mechanism) -> list[EngineComparison]:
    """Run the tests of the paper with our engine, also in place of Kane's method."""
    found = []
    for name, shape in validation.PAPER_TESTS.items():
        motion = ComparedMotion(name, validation.paper_test(paper, np.array(shape)))
        ours = simulate(motion.case, comparison.STEP)
        found.append(EngineComparison(motion, ours, {'kane': ours.link_angles}))
    return found


def outcomes(comparisons: list[EngineComparison]) -> dict[str, bool]:
    return {check.name: check.passed for check in validation.checks(comparisons)}


def test_turn_by_hand_conserves_momentum(paper: Mechanism) -> None:
    """
    The total momentum of links and wheels of a pair is zero at any time.

    The test uses the momentum of the whole, where the other pair rests.
    """
    case = validation.paper_test(paper, np.array([1.0, 0.0, 1.0, 0.0]))
    turn = validation.turn_by_momentum(case)
    rate = np.gradient(turn, case.times, edge_order=2)
    omega = 2.0 * np.pi * validation.FREQUENCY_HZ
    wheel = rate - omega * validation.AMPLITUDE * np.sin(omega * case.times)
    # A pair has two inertias about mass centres, and half of the mass of the other pair.
    momentum = (2.0 * 2.2e-5 + 0.02 * 0.1**2 / 2.0) * rate + 2.0 * 3.4e-7 * wheel
    # The relative error of central differences over 0.05 s is (0.05 omega)^2 / 6.
    scale = 2.0 * 3.4e-7 * np.abs(wheel).max()
    assert np.abs(momentum).max() < 1e-3 * scale
    assert np.ptp(turn) == pytest.approx(0.94, abs=1e-3)


def test_all_checks_pass(comparisons: list[EngineComparison]) -> None:
    assert all(outcomes(comparisons).values())


@pytest.mark.parametrize(('name', 'links', 'missed'), [
    ('paper_test_1', [0, 2], {'test 1, a and c beside momentum by hand'}),
    ('paper_test_1', [1, 3], {'test 1, turn of b and d'}),
    ('paper_test_2', [0, 1, 2, 3], {'test 2, all links beside momentum by hand'}),
    ('paper_test_2', [0, 2], {'test 2, all links beside momentum by hand',
                              'test 2, change of configuration'}),
    ('paper_opposite', [3], {'opposite commands, turn of any link'}),
])
def test_wrong_motion_fails_its_check(
    name: str, links: list[int], missed: set[str], comparisons: list[EngineComparison],
) -> None:
    """The error is two nanoradians at one time; the limit is one, and joint gaps are 1e-12 m."""
    def off(one: EngineComparison) -> EngineComparison:
        angles = one.ours.link_angles.copy()
        angles[100, links] += 2e-9
        return replace(one, ours=replace(one.ours, link_angles=angles))

    changed = [off(one) if one.motion.name == name else one for one in comparisons]
    failed = {name for name, passed in outcomes(changed).items() if not passed}
    assert failed - {'closure, widest gap'} == missed | {'kane, largest difference'}


def test_change_of_momentum_is_detected(comparisons: list[EngineComparison]) -> None:
    one = comparisons[1]
    speeds = one.ours.flywheel_speeds_absolute.copy()
    speeds[50] *= 1.0 + 1e-8
    changed = [replace(one, ours=replace(one.ours, flywheel_speeds_absolute=speeds))]
    assert validation.momentum_drift(one) < 1e-12
    assert validation.momentum_drift(changed[0]) > 1e-9


def test_differences_are_over_all_links_and_times(comparisons: list[EngineComparison]) -> None:
    one = comparisons[0]
    angles = one.ours.link_angles.copy()
    angles[7, 2] -= 3e-6
    angles[9, 1] += 4e-6
    other = replace(one, others={'kane': angles})
    assert other.largest('kane') == pytest.approx(4e-6)
    assert other.rms('kane') == pytest.approx(5e-6 / np.sqrt(angles.size))


def test_extrapolation_removes_the_second_order_error_of_mujoco(
    comparisons: list[EngineComparison], monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Extrapolation is exact for an engine with an error quadratic in its step."""
    def engine(step: float) -> IndependentEngine:
        return IndependentEngine('', lambda motion: (
            simulate(motion.case, comparison.STEP).link_angles + step**2))

    engines = {name: engine(step) for name, step in comparison.MUJOCO_STEPS.items()}
    monkeypatch.setattr(comparison, 'available_engines', lambda: (engines, []))
    motions = [one.motion for one in comparisons]
    compared, sampling, _ = comparison.compare(motions, no_progress)
    assert list(sampling) == [*engines, 'mujoco_extrapolated']
    for one in compared:
        assert one.largest('mujoco_1ms') == pytest.approx(1e-6)
        assert one.largest('mujoco_extrapolated') < 1e-14


@pytest.mark.parametrize(('library', 'engines', 'name'), [
    ('sympy', {'reference', 'mujoco_1ms', 'mujoco_2ms'}, 'Kane'),
    ('mujoco', {'reference', 'kane'}, 'MuJoCo'),
])
def test_engines_that_are_not_installed_are_reported(
    library: str, engines: set[str], name: str, monkeypatch: pytest.MonkeyPatch,
) -> None:
    for module in ('sympy', 'mujoco'):
        pytest.importorskip(module)
    monkeypatch.setitem(sys.modules, library, None)
    found, skipped = comparison.available_engines()
    assert set(found) == engines
    assert [name in line and f'{library} is missing' in line for line in skipped] == [True]


def test_runs_without_any_optional_library(monkeypatch: pytest.MonkeyPatch) -> None:
    for library in ('sympy', 'mujoco', 'matplotlib'):
        monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(
        sys.modules, 'fourbar_ros.studies.validation_figure', raising=False)
    result = validation.run(no_progress)
    assert [line.split()[-3] for line in result.skipped] == ['sympy', 'mujoco', 'matplotlib']
    assert set(result.files) == {'validation.csv'}
    assert {check.name for check in result.checks} >= {
        'reference, largest difference', 'opposite commands, turn of any link'}
    assert all(check.passed for check in result.checks)
    assert 'kane' not in result.text


def test_missing_reference_motion_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, 'REFERENCES', ('atlantis',))
    with pytest.raises(CaseError) as caught:
        validation.motions()
    assert 'atlantis.json' in str(caught.value)
