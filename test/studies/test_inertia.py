# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The search for wheel inertias: the lower bound, reproducibility and resumption."""

from dataclasses import replace
import errno
from math import degrees, pi, radians
import os
from pathlib import Path

from fourbar_ros.mechanism import load_mechanism
from fourbar_ros.studies import inertia, inertia_search, Sample, StudyError
from fourbar_ros.studies.energy import turn
from fourbar_ros.studies.inertia_search import (
    BASIS,
    bound_at_error,
    bound_at_weight,
    Candidate,
    decode,
    Search,
    SOFT_STEP,
    SQUARED_RATE,
    TERMS,
    TIMES,
    TURN,
    VARIABLES,
)
import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.linalg import solveh_banded

PAPER = load_mechanism('paper')


@pytest.fixture(autouse=True)
def cma() -> None:
    """Skip the test where CMA-ES is not installed."""
    pytest.importorskip('cma')


def candidate(inertias=(1.0, 1.0, 1.0, 1.0), **coefficients: float) -> Candidate:
    table = np.zeros((4, TERMS))
    table[:, 0] = 1.0
    for wheel, value in coefficients.items():
        table['abcd'.index(wheel), 1] = value
    return Candidate(np.array(inertias), table)


def test_nominal_wheels_follow_exactly_and_are_the_closed_form() -> None:
    nominal = candidate()
    assert nominal.error_rms == pytest.approx(0.0, abs=1e-14)
    assert nominal.eq9 == pytest.approx(1.0, abs=1e-13)
    assert nominal.eq9_without_error == pytest.approx(1.0, abs=1e-13)
    np.testing.assert_allclose(BASIS[0], SOFT_STEP.deriv()(TIMES), atol=1e-12)
    assert decode(np.zeros(VARIABLES)).eq9 == pytest.approx(1.0, abs=1e-13)


def test_eq9_is_that_of_inverse_dynamics() -> None:
    """Unequal wheels have equal speeds in each pair; units are those of the energy study."""
    shares = np.array([0.7, 1.2, 1.3, 0.8])
    mechanism = replace(PAPER, flywheel_inertias=PAPER.flywheel_inertias * shares)
    of_unequal = turn(mechanism, (pi / 2.0, pi / 2.0), 'min_energy')
    of_nominal = turn(PAPER, (pi / 2.0, pi / 2.0), 'min_norm')
    table = np.zeros((4, TERMS))
    table[:, 0] = 2.0 / np.tile(shares[:2] + shares[2:], 2)
    assert Candidate(shares, table).error_rms == pytest.approx(0.0, abs=1e-14)
    assert Candidate(shares, table).eq9 == pytest.approx(
        of_unequal.eq9[-1] / of_nominal.eq9[-1], rel=1e-7)


def test_correction_to_zero_error_keeps_the_differences_within_pairs() -> None:
    """Opposite changes within a pair need energy and turn no link."""
    apart = candidate(a=0.3, c=-0.3, b=0.1)
    assert apart.eq9_without_error > 1.0 + 1e-3
    assert candidate(b=0.1, d=0.1).eq9_without_error == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize('weight', [1e-6, 3e-5, 1e-3, 0.1, 30.0])
def test_least_at_a_weight_is_that_of_finite_elements(weight: float) -> None:
    """Piecewise linear functions give the same minimum by a positive definite linear system."""
    count = 4000
    s = np.linspace(0.0, 1.0, count + 1)
    h, mu = 1.0 / count, weight * (TURN / radians(0.1)) ** 2 * SQUARED_RATE
    diagonal = np.full(count, 2.0 / h + 4.0 * mu * h / 6.0)
    diagonal[-1] = 1.0 / h + 2.0 * mu * h / 6.0
    off = np.full(count - 1, -1.0 / h + mu * h / 6.0)
    reference = SOFT_STEP(s)
    mass = np.full(count + 1, 4.0 * h / 6.0)
    mass[-1] = 2.0 * h / 6.0
    load = mu * (mass[1:] * reference[1:] + h / 6.0 * reference[:-1])
    load[:-1] += mu * h / 6.0 * reference[2:]
    phi = np.concatenate([[0.0], solveh_banded(
        np.array([diagonal, np.concatenate([off, [0.0]])]), load, lower=True)])
    error, eq9 = bound_at_weight(weight)
    assert eq9 == pytest.approx(float((np.diff(phi) ** 2).sum() / h) / SQUARED_RATE, rel=1e-5)
    assert error == pytest.approx(
        TURN * np.sqrt(trapezoid((phi - reference) ** 2, s)), rel=1e-4)


@pytest.mark.slow
def test_equal_pairs_are_the_best() -> None:
    """The root of the least eq. 9 is convex in the squared error, so equal errors are best."""
    errors = np.radians(np.linspace(0.05, 20.0, 60))
    roots = np.sqrt([bound_at_error(error) for error in errors])
    slopes = np.diff(roots) / np.diff(errors ** 2)
    assert (np.diff(slopes) > 0.0).all()
    assert bound_at_error(0.0) == 1.0


@pytest.mark.slow
def test_search_reaches_the_bound_and_repeats_with_its_seed() -> None:
    search = Search(0.01, seed=3)
    variables, evaluations = inertia_search.run_search(search)
    found = decode(variables)
    ratio = found.eq9 * found.total
    least = bound_at_error(found.error_rms)
    assert degrees(found.error_rms) < 0.1, 'seed 3'
    assert least * (1.0 - 1e-9) < ratio < least * 1.001, 'seed 3'
    np.testing.assert_allclose(found.inertias[:2] + found.inertias[2:], 2.0, atol=0.01)
    assert inertia.integration_error(found) < 1e-9
    np.random.seed(0)
    again, evaluations_again = inertia_search.run_search(search)
    np.testing.assert_array_equal(again, variables)
    assert evaluations_again == evaluations


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Make searches short and few; return the list of their seeds."""
    seeds: list[int] = []
    search_once = inertia_search.run_search

    def counted(search: Search):
        seeds.append(search.seed)
        return search_once(search)

    monkeypatch.setattr(inertia_search, 'GENERATIONS', 10)
    monkeypatch.setattr(inertia, 'WEIGHTS', (0.01,))
    monkeypatch.setattr(inertia, 'SEEDS', 2)
    monkeypatch.setattr(inertia, 'INERTIA_WEIGHTS', (1.0,))
    monkeypatch.setattr(inertia, 'run_search', counted)
    return seeds


def study(folder: Path | None, seed: int = 0):
    return inertia.run(lambda items, _: items, Sample(seed=seed, jobs=1), folder)


@pytest.mark.slow
def test_finished_searches_are_not_repeated(quick: list[int], tmp_path: Path) -> None:
    whole = study(tmp_path)
    assert quick == [0, 1, 2, 3, 4]
    stored = sorted((tmp_path / 'searches').iterdir())
    assert [path.name for path in stored] == [f'seed_{seed}.json' for seed in range(5)]
    # As after a kill, one result is missing, one is truncated, and one has other settings.
    stored[1].unlink()
    stored[2].write_text(stored[2].read_text()[:50])
    text = stored[3].read_text()
    stored[3].write_text(text.replace('"error_weight": 0.01', '"error_weight": 9'))
    quick.clear()
    again = study(tmp_path)
    assert quick == [1, 2, 3]
    assert again.data == whole.data
    assert again.files == whole.files
    assert study(None).data == whole.data


@pytest.mark.slow
def test_another_seed_is_another_search(quick: list[int], tmp_path: Path) -> None:
    study(tmp_path)
    quick.clear()
    study(tmp_path, seed=5)
    assert quick == [5, 6, 7, 8, 9]


def test_search_that_cannot_be_stored_is_an_error(quick: list[int], tmp_path: Path, refuses
                                                  ) -> None:
    (tmp_path / 'searches').write_text('a file with the name of the folder')
    with refuses(StudyError, path=tmp_path / 'searches' / 'seed_0.json'):
        study(tmp_path)


def test_full_disk_leaves_no_incomplete_file(
        quick: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuses) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(os, 'replace', full)
    with refuses(StudyError, path=tmp_path / 'searches' / 'seed_0.json'):
        study(tmp_path)
    assert not list((tmp_path / 'searches').iterdir())


@pytest.mark.slow
def test_two_processes_with_the_same_searches_do_not_disturb_each_other(
        quick: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other process stores all its searches just before this one stores its first."""
    replace_file, nested = os.replace, []

    def disturbed(source: str, target: str) -> None:
        if not nested:
            nested.append(True)
            study(tmp_path)
        replace_file(source, target)
    monkeypatch.setattr(os, 'replace', disturbed)
    study(tmp_path)
    assert len(list((tmp_path / 'searches').iterdir())) == 5


@pytest.mark.slow
def test_paper_inertias_are_worse_by_what_their_pairs_differ(quick: list[int]) -> None:
    paper = study(None).data['paper_inertias']
    assert paper['eq9_least_over_four_nominal'] == pytest.approx(1 / 2.25 + 1 / 1.18)
    assert paper['eq9_min_energy_over_four_nominal'] == pytest.approx(
        paper['eq9_least_over_four_nominal'], rel=1e-7)
    assert paper['eq9_eq8_over_four_nominal'] > paper['eq9_least_over_four_nominal']
