# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Paper Fig. 6: condition numbers by hand, spans of offsets, and the output of the study."""

import csv
from io import BytesIO, StringIO
import json

from fourbar_ros.common.config_files import ConfigurationError
from fourbar_ros.studies import load_study, Result
from fourbar_ros.studies.conditioning import ALL_SIGNS, OF_OFFSET, OF_RATIO
from fourbar_ros.studies.conditioning_linkages import (
    condition,
    LENGTH,
    parallelogram,
    rhombus,
    SIGNS,
    span,
    STABLE,
    THETAS,
)
import numpy as np
import pytest

INERTIA, MASS = 2.2e-5, 0.02


def by_hand(offsets: tuple[float, ...], theta: float) -> float:
    """
    Compute cond(A) of a rhombus from the mass centres of its links.

    Each mass centre is `p e^(i phi_a) + q e^(i phi_b)` minus the mean. The inertias of the pairs
    follow from their distances, the coupling from their scalar products.
    """
    a, b, c, d = offsets
    half = 0.5 * LENGTH
    p = np.array([half + 1j * a, 0.0, half + 1j * c, LENGTH])
    q = np.array([0.0, half + 1j * b, LENGTH, half + 1j * d])
    p, q = p - p.mean(), q - q.mean()
    coupling = MASS * float((p * q.conj() * np.exp(-1j * theta)).sum().real)
    first, second = (2.0 * INERTIA + MASS * float((np.abs(arms) ** 2).sum()) for arms in (p, q))
    return float(np.linalg.cond([[first, coupling], [coupling, second]]))


@pytest.mark.parametrize('ratio', [0.25, 0.5, 1.0, 1.7, 2.0, 4.0])
def test_parallelogram_by_hand(ratio: float) -> None:
    """Each pair moves the mass of the other one at half its length, without coupling."""
    a, b = (2.0 * INERTIA + 0.5 * MASS * (scale * LENGTH) ** 2 for scale in (ratio, 1.0))
    for theta in (0.01, 0.3, 1.5, 3.0):
        assert condition(parallelogram(ratio), theta) == pytest.approx(max(a, b) / min(a, b))


@pytest.mark.parametrize('signs', ALL_SIGNS)
def test_offsets_by_hand(signs: tuple[float, ...]) -> None:
    for theta in (0.1, 0.3, 1.0, np.pi / 2.0, 2.5):
        for offset in (-0.04, -0.01, 0.02, 0.06):
            expected = by_hand(tuple(offset * sign for sign in signs), theta)
            assert condition(rhombus(signs, offset), theta) == pytest.approx(expected, rel=1e-9)


def test_known_values() -> None:
    for ratio, known in OF_RATIO.items():
        assert condition(parallelogram(ratio), 1.0) == pytest.approx(known, abs=5e-5)
    for (name, offset), (small, square) in OF_OFFSET.items():
        mechanism = rhombus(SIGNS[name], offset)
        assert condition(mechanism, 0.3) == pytest.approx(small, abs=5e-5)
        assert condition(mechanism, np.pi / 2.0) == pytest.approx(square, abs=5e-5)


def test_offsets_of_a_and_c_inwards_and_b_and_d_outwards_leave_cond_at_1() -> None:
    for theta in (0.1, 0.7, 2.0):
        assert condition(rhombus((1.0, 1.0, -1.0, -1.0), 0.04), theta) == pytest.approx(1.0)


def test_cond_depends_on_the_sign_of_unequal_offsets() -> None:
    """For equal offsets it does not depend on the sign, in any convention."""
    unequal = (1.0, 0.3, 0.5, 0.2)
    assert condition(rhombus(unequal, 0.04), 0.3) != pytest.approx(
        condition(rhombus(unequal, -0.04), 0.3), rel=1e-3)


@pytest.mark.medium
@pytest.mark.parametrize('name', list(SIGNS))
def test_span_ends_where_condition_reaches_its_limit(name: str) -> None:
    for theta in np.radians([14.0, 30.0, 60.0]):
        end = span(SIGNS[name], theta)
        assert condition(rhombus(SIGNS[name], end), theta) == pytest.approx(STABLE, abs=1e-6)
        below = [condition(rhombus(SIGNS[name], offset), theta)
                 for offset in np.linspace(0.0, 0.999 * end, 30)]
        assert max(below) < STABLE
    assert span(SIGNS['same'], np.pi / 2.0) == span(SIGNS['inside'], 0.1) == np.inf


def studied(mechanism: str | None = None) -> Result:
    options = {} if mechanism is None else {'mechanism': mechanism}
    return load_study('conditioning', **options)(lambda items, count: items)


@pytest.fixture(scope='module')
def result() -> Result:
    """Run the study with the prototype as a further linkage."""
    return studied('prototype')


@pytest.mark.slow
def test_checks_pass(result: Result) -> None:
    assert [check.name for check in result.checks if not check.passed] == []
    # The time depends on the machine; `bench` has a limit for it.
    assert 0.0 < result.data['grid_seconds']


@pytest.mark.slow
def test_grids_are_written_and_symmetric(result: Result) -> None:
    for name, first in (('ratio', 'ratio'), ('offset_same', 'offset_m'),
                        ('offset_inside', 'offset_m')):
        rows = list(csv.reader(StringIO(str(result.files[f'conditioning_{name}.csv']))))
        assert rows[0][0].split()[0] == first
        np.testing.assert_allclose(np.array(rows[0][1:], dtype=float), np.degrees(THETAS),
                                   rtol=1e-5)
        numbers = np.array(rows[1:], dtype=float)
        assert numbers.shape == (200, 201)
        assert numbers[:, 1:].min() >= 1.0 - 1e-6
        np.testing.assert_allclose(numbers[:, 1:], numbers[:, :0:-1], rtol=1e-6)
    place = int(np.argmin(np.abs(numbers[:, 0] - 0.02)))
    assert numbers[place, 100] == pytest.approx(
        by_hand((numbers[place, 0],) + (-numbers[place, 0],) * 2 + (numbers[place, 0],),
                THETAS[99]), rel=1e-5)


@pytest.mark.slow
def test_near_a_change_point_four_wheels_keep_the_gain_that_a_and_b_lose(result: Result) -> None:
    """The loss of gain does not show in cond(A) of equal links."""
    rows = list(csv.DictReader(StringIO(str(result.files['conditioning_hidden.csv']))))
    equal = [row for row in rows if row['linkage'] == 'equal links']
    longer = [row for row in rows if row['linkage'] != 'equal links']
    assert len(equal) == len(longer) == len(rows) // 2
    assert all(float(row['cond_a']) == pytest.approx(1.0) for row in equal)
    assert min(float(row['closure_ratio']) for row in equal) < 2e-3
    assert min(float(row['gain_wheels_ab']) for row in longer) < 0.01
    assert min(float(row['gain_four_wheels']) for row in rows) == pytest.approx(1.0)
    assert min(float(row['closure_ratio']) for row in longer) > 0.05


@pytest.mark.slow
def test_further_linkage_is_evaluated_on_both_branches(result: Result) -> None:
    rows = list(csv.DictReader(StringIO(str(result.files['conditioning_linkage.csv']))))
    assert {row['branch'] for row in rows} == {'open', 'crossed'}
    document = json.loads(json.dumps(result.data, allow_nan=False))
    found = document['linkages']['prototype']['open']
    assert found['largest_cond_a'] == pytest.approx(1.0)
    assert found['closes_share'] == 1.0
    assert 'prototype: extremes' in result.text
    pytest.importorskip('matplotlib')
    assert 'conditioning_linkage.png' in result.files


@pytest.mark.slow
def test_without_a_mechanism_there_is_no_third_figure() -> None:
    assert not any('linkage' in name for name in studied().files)
    with pytest.raises(ConfigurationError):
        studied('no such linkage')


@pytest.mark.slow
def test_figures_are_complete(result: Result) -> None:
    """Figures have contents in the middle and none at the left edge."""
    image = pytest.importorskip('matplotlib.image')
    assert result.skipped == []
    for name in ('conditioning', 'conditioning_hidden', 'conditioning_linkage'):
        png = result.files[f'{name}.png']
        assert isinstance(png, bytes)
        pixels = image.imread(BytesIO(png))[..., :3]
        assert pixels.std() > 0.05
        assert pixels[:, 0].min() == pixels[:, -1].min() == 1.0
