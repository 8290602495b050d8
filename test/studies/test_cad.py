# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Defects of a CAD model: momentum by hand, Kane's method, and the fits to the paper."""

import csv
from io import BytesIO, StringIO
import json

from fourbar_ros.mechanism import angular_momentum, assemble, load_mechanism
from fourbar_ros.mechanism.case import Case
from fourbar_ros.studies import cad, load_study, Result
from fourbar_ros.studies.cad import fit_two, fit_wheel_counted_twice, size_curve, size_for
from fourbar_ros.studies.cad_defects import (
    defective,
    DEFECTS,
    Effects,
    effects_of,
    RMS,
    rms,
    simulate_test,
    THETA,
    TIMES,
)
import numpy as np
import pytest

PAPER = load_mechanism('paper')
AMPLITUDE = 50.0


def gain(inertia: float, wheel: float, length: float = 0.1, mass: float = 0.02) -> float:
    """Return the turn of a pair per turn of its wheels, from momentum by hand."""
    return 2.0 * wheel / (2.0 * inertia + 0.5 * mass * length ** 2 + 2.0 * wheel)


NOMINAL = gain(2.2e-5, 3.4e-7)
WAVE = float(np.degrees(AMPLITUDE * np.sqrt(
    ((np.cos(0.2 * np.pi * TIMES) - 1.0) ** 2).mean())))


@pytest.mark.parametrize(('name', 'changed', 'moves_bd'), [
    ('inertia_all', gain(2.2e-5 * 1.03, 3.4e-7), True),
    ('inertia_ac', gain(2.2e-5 * 1.03, 3.4e-7), False),
    ('wheel_all', gain(2.2e-5, 3.4e-7 * 1.03), True),
    ('wheel_ac', gain(2.2e-5, 3.4e-7 * 1.03), False),
    ('length_ac', gain(2.2e-5, 3.4e-7, length=0.103), False),
    ('mass_bd', gain(2.2e-5, 3.4e-7, mass=0.0206), False)])
def test_uncoupled_pairs_by_hand(name: str, changed: float, moves_bd: bool) -> None:
    """Each pair keeps its own momentum, so test 1 is half of what all links do."""
    pair = abs(changed - NOMINAL) * WAVE * np.sqrt(0.5)
    assert rms({name: 0.03}, 0, AMPLITUDE) == pytest.approx(pair, rel=1e-6)
    assert rms({name: 0.03}, 1, AMPLITUDE) == pytest.approx(
        pair * np.sqrt(2.0 if moves_bd else 1.0), rel=1e-6)
    # Links b and d stay at rest, unlike in the paper.
    assert effects_of({name: 0.03}, AMPLITUDE).resting_turn < 1e-9


def test_any_defect_keeps_momentum() -> None:
    """Links and wheels start at rest, and the total stays zero."""
    for name in DEFECTS:
        mechanism = defective({name: 0.3 * DEFECTS[name].largest})
        for test in (0, 1):
            angles = simulate_test(mechanism, test, AMPLITUDE)
            rates = np.gradient(angles, TIMES, axis=0, edge_order=2)
            driving = -AMPLITUDE * 0.2 * np.pi * np.sin(0.2 * np.pi * TIMES)
            driven = np.array([[1.0, 0.0, 1.0, 0.0], [1.0, 1.0, 1.0, 1.0]])[test]
            middle = slice(10, -10, 10)
            momenta = [angular_momentum(mechanism, *state) for state in zip(
                angles[middle], rates[middle], rates[middle] + np.outer(driving, driven)[middle])]
            # Accuracy of differences of angles over a tenth of a second.
            limit = 0.01 * 3.4e-7 * driven.sum() * np.abs(driving).max()
            assert float(np.abs(momenta).max()) < limit, name


def test_offset_along_the_link_has_the_effect_of_one_across() -> None:
    """The square of the distance couples the pairs, docs/studies/cad.md."""
    for size in (0.003, 0.01):
        for test in (0, 1):
            assert rms({'offset_x_same': size}, test, AMPLITUDE) == pytest.approx(
                rms({'offset_y_same': size}, test, AMPLITUDE), rel=1e-6)


@pytest.mark.parametrize('name', [name for name, defect in DEFECTS.items() if defect.even])
def test_sign_of_even_defects_has_no_effect(name: str) -> None:
    for test in (0, 1):
        assert rms({name: -0.01}, test, AMPLITUDE) == pytest.approx(
            rms({name: 0.01}, test, AMPLITUDE), rel=1e-9)


def test_no_defect_is_no_difference() -> None:
    for test in (0, 1):
        assert rms({}, test, AMPLITUDE) == 0.0
    effects = effects_of({}, AMPLITUDE)
    assert effects.resting_turn < 1e-9
    assert effects.swing == 0.0
    assert effects.configuration < 1e-9
    assert Effects(0.1, -0.01, 0.1).as_stated == (True, True, True)
    assert Effects(0.001, 0.01, 0.001).as_stated == (False, False, False)


@pytest.mark.parametrize(('name', 'sign', 'test'), [
    ('offset_y_same', 1.0, 0), ('offset_y_inside', -1.0, 1), ('inertia_ac', -1.0, 0),
    ('length_a', 1.0, 1)])
def test_size_reproduces_the_difference(name: str, sign: float, test: int) -> None:
    size = size_for(name, sign, test, AMPLITUDE)
    assert np.sign(size) == sign
    assert rms({name: size}, test, AMPLITUDE) == pytest.approx(RMS[test], rel=1e-8)


def test_defect_without_effect_has_no_size() -> None:
    assert np.isnan(size_for('inertia_bd', 1.0, 0, AMPLITUDE))
    # The size of this difference would exceed its limit.
    assert np.isnan(size_for('inertia_all', -1.0, 0, 0.1))


@pytest.fixture(scope='module')
def fitted():
    """Return the fits that the study checks, computed with few amplitudes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cad, 'AMPLITUDES', np.array([40.0, 60.0]))
        best, = size_curve('offset_y_same', 1.0).fits
    return best, fit_wheel_counted_twice()


@pytest.mark.medium
def test_fits_reproduce_both_numbers_and_all_statements(fitted) -> None:
    best, twice = fitted
    assert best.sizes['offset_y_same'] == pytest.approx(7.40e-3, abs=5e-6)
    assert best.amplitude == pytest.approx(48.23, abs=5e-3)
    assert twice.sizes['inertia_all'] == pytest.approx(3.4e-7 / 2.2e-5)
    assert twice.sizes['offset_y_inside'] == pytest.approx(0.494e-3, abs=1e-6)
    for each in fitted:
        assert np.abs(each.residuals).max() < 1e-9
        assert each.effects.as_stated == (True, True, True)


@pytest.mark.slow
def test_kanes_method_gives_the_same_differences(fitted) -> None:
    """Nominal and defective linkage by SymPy along the chain, integrated by SciPy."""
    pytest.importorskip('sympy')
    from fourbar_ros.studies.independent import kane

    def angles(mechanism, test, amplitude):
        rest = np.zeros(4)
        shape = np.array([[1.0, 0.0, 1.0, 0.0], [1.0, 1.0, 1.0, 1.0]])[test]
        return kane.simulate(Case(
            mechanism, assemble(mechanism, 0.0, THETA), rest, rest, amplitude * shape,
            np.full(4, 0.1), rest, TIMES, np.ones(4, dtype=bool))).link_angles

    for each in fitted:
        for test in (0, 1):
            difference = (angles(defective(each.sizes), test, each.amplitude)
                          - angles(PAPER, test, each.amplitude))
            found = float(np.degrees(np.sqrt((difference ** 2).mean())))
            assert found == pytest.approx(RMS[test], abs=1e-7)


@pytest.mark.medium
def test_two_defects_do_not_determine_the_amplitude(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cad, 'PAIR_AMPLITUDES', np.array([20.0, 80.0]))
    found = fit_two(('inertia_all', 'offset_y_inside'))
    assert [each.amplitude for each in found] == [20.0, 80.0]
    for each in found:
        assert np.abs(each.residuals).max() < cad.SOLVED
        assert each.effects.as_stated == (True, True, True)


@pytest.fixture(scope='module')
def result() -> Result:
    """Run the study with few amplitudes."""
    pytest.importorskip('matplotlib')
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cad, 'AMPLITUDES', np.array([10.0, 40.0, 60.0, 100.0]))
        patch.setattr(cad, 'PAIR_AMPLITUDES', np.array([50.0]))
        patch.setattr(cad, 'START_THETAS', (60.0, 90.0))
        return load_study('cad')(lambda items, count: items)


@pytest.mark.slow
def test_study_passes_its_checks_and_rules_out_defects(result: Result) -> None:
    assert [check.name for check in result.checks if not check.passed] == []
    assert len({check.name for check in result.checks}) == len(result.checks)
    document = json.loads(json.dumps(result.data, allow_nan=False))
    assert document['best']['words_configuration_changes']
    reproduced = {name for name, each in document['single'].items() if each['explanations']}
    assert {'offset_y_same', 'offset_x_same'} <= reproduced
    assert not any(name.startswith(('inertia', 'wheel', 'mass', 'offset_y_inside'))
                   for name in reproduced)
    assert document['single']['inertia_all_more']['largest_ratio'] == pytest.approx(
        np.sqrt(0.5), rel=1e-6)
    assert document['best_by_start_theta_deg']['90'] is None
    assert document['best_by_start_theta_deg']['60'] == document['best']
    # In radians the offset would be more than half a link.
    assert max(document['rms_of_largest_offset_deg']) < np.degrees(0.1)


@pytest.mark.slow
def test_tables_contain_the_results(result: Result) -> None:
    rows = list(csv.DictReader(StringIO(str(result.files['cad.csv']))))
    assert len(rows) == 4 * len(result.data['single'])
    for row in rows:
        if row['defect'] == 'offset_y_same' and row['amplitude_rad'] == '40':
            assert rms({'offset_y_same': float(row['size_for_test_1'])}, 0, 40.0) == (
                pytest.approx(RMS[0], rel=1e-5))
    pairs = list(csv.DictReader(StringIO(str(result.files['cad_pairs.csv']))))
    assert {row['first'] for row in pairs} <= set(DEFECTS)
    assert all(float(row['amplitude_rad']) == 50.0 for row in pairs)
    assert 'never both' in result.text


@pytest.mark.slow
def test_figure_is_complete(result: Result) -> None:
    """The figure has contents in the middle and none at the edges."""
    image = pytest.importorskip('matplotlib.image')
    assert result.skipped == []
    png = result.files['cad.png']
    assert isinstance(png, bytes)
    pixels = image.imread(BytesIO(png))[..., :3]
    assert pixels.std() > 0.05
    for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
        assert edge.min() == 1.0
